from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.datasets import SMALL

from vkc_pin.datasets.problems import NoProblemError, find_grasping_start, sample_problem
from vkc_pin.datasets.recipe import load_recipe
from vkc_pin.options import Options
from vkc_pin.planning.planner import Planner
from vkc_pin.planning.prepare import plan
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene, load_scene
from vkc_pin.world.task.steps import Actuate, Grasp, Place, step_to_dict

GOALS = {"drawer": {"slide": 0.2}, "door": {"hinge": 0.6}}


def compute_grasp_error(scene: Scene, name: str) -> float:
    """Return the largest deviation of the hand from its grasp [m] or [rad]."""
    (hold,) = scene.holds
    placed = scene.objects[name]
    grasp = placed.object.attachments[hold.attachment]
    expected = placed.link_placement(grasp.link) * grasp.tool(hold.at)
    return float(np.abs(pin.log6(expected.actInv(scene.tool_placement())).vector).max())


@pytest.mark.parametrize("name", GOALS)
def test_grasping_start_places_the_hand_at_the_attachment(name: str) -> None:
    scene = load_scene(name)
    step = Actuate(name, GOALS[name], next(iter(scene.objects[name].object.attachments)))
    rng, planner = np.random.default_rng(0), Planner()
    bases = []
    for _ in range(4):
        found = find_grasping_start(scene, step, rng, Options(), planner)
        assert found is not None
        assert compute_grasp_error(found, name) < 1e-5
        assert found.held == {name: step.attachment}
        bases.append(tuple(found.start[:3]))
    assert len(set(bases)) == 4
    assert plan(found, [step], planner=planner).success


def test_blocked_grasp_has_no_grasping_start() -> None:
    scene = load_scene("drawer")
    placed = scene.objects["drawer"]
    name = next(iter(placed.object.attachments))
    position = placed.link_placement(placed.object.attachments[name].link).translation.tolist()
    block = {"name": "block", "type": "box", "size": [1.0, 1.0, 1.0], "position": position}
    obstacles = [*scene.document["obstacles"], block]
    with pytest.warns(UserWarning, match="overlap other shapes"):
        blocked = Scene.from_document({**scene.document, "obstacles": obstacles}, scene.folder)
    step, rng = Actuate("drawer", {"slide": 0.2}, name), np.random.default_rng(0)
    assert find_grasping_start(blocked, step, rng, Options(), Planner()) is None


PLANNER = Planner()


def sample(number: int, **changes: Any) -> Any:
    return sample_problem(load_recipe({**SMALL, **changes}), number, {}, PLANNER)


def describe(problem: Any) -> Any:
    return (
        problem.scene.document,
        [step_to_dict(step) for step in problem.steps],
        problem.about,
        problem.seed,
    )


@pytest.mark.parametrize("task", ["given-open", "drive-open", "fetch-place"])
def test_problem_is_determined_by_recipe_and_number(task: str) -> None:
    for number in range(3):
        one = describe(sample(number, tasks=[task]))
        describe(sample(number + 5, tasks=[task]))  # earlier samples must not matter
        assert describe(sample(number, tasks=[task])) == one
    assert describe(sample(0, tasks=[task])) != describe(sample(1, tasks=[task]))


def test_consecutive_numbers_share_a_room() -> None:
    rooms = [sample(number).about["room"] for number in range(8)]
    assert rooms == ["room_0", "room_0", "room_1", "room_1"] * 2


def test_robots_alternate() -> None:
    robots = [{"name": "husky_ur5e"}, {"name": "husky_ur5e", "height": 0.4}]
    heights = [sample(number, robots=robots).scene.described.start.z for number in range(0, 8, 2)]
    assert heights == [None, 0.4, 0.4, None]  # both robots in each room


def test_variants_differ_only_in_the_seed() -> None:
    first, second, other = (sample(number, variants=2) for number in range(3))
    assert describe(first)[:2] == describe(second)[:2]
    assert [one.seed for one in (first, second, other)] == [0, 1, 0]
    assert describe(first)[:2] != describe(other)[:2]


def test_open_task_respects_the_ranges() -> None:
    ranges = {"goal": {"share": [0.2, 0.3]}, "start": {"distance": [1.0, 4.0]}}
    for number in range(6):
        problem = sample(number, tasks=["drive-open"], **ranges)
        (step,) = problem.steps
        assert isinstance(step, Actuate)
        placed = problem.scene.objects[step.object]
        ((joint, goal),) = step.joints.items()
        k = placed.object.coordinates.index(joint)
        fraction = abs(goal - placed.state[k]) / (placed.object.upper[k] - placed.object.lower[k])
        assert 0.199 <= fraction <= 0.301
        away = problem.scene.start[:2] - placed.placement.translation[:2]
        assert 1.0 <= np.linalg.norm(away) <= 4.0
        assert problem.scene.start_clearance() >= START_CLEARANCE
        assert problem.scene.held == {}


def test_fetched_object_is_placed_on_another_table() -> None:
    problem = sample(0, tasks=["fetch-place"])
    assert [type(step) for step in problem.steps] == [Grasp, Place]
    top = problem.scene.obstacles[problem.scene.obstacle_labels.index("table_2_top")]
    local = top.placement.actInv(np.array(problem.about["goal"]))
    assert (np.abs(local[:2]) <= np.asarray(top.geometry.halfSide)[:2]).all()
    # the ball's radius above the table top
    assert local[2] == pytest.approx(top.geometry.halfSide[2] + 0.035 + 0.001, abs=2e-3)


def test_any_grasp_is_one_of_the_hand() -> None:
    """The ball's attachment `pull` is for the tip of a stick."""
    recipe = {"tasks": ["fetch-place"], "carried": ["ball"], "grasps": "any"}
    assert {sample(k, **recipe).about["attachment"] for k in range(6)} == {"grip"}


def test_impossible_ranges_are_reported() -> None:
    with pytest.raises(NoProblemError, match="no free start in room_0"):
        sample(0, tasks=["drive-open"], start={"distance": [50.0, 60.0]})
    crowded = {"objects": 3, "width": [4.0, 4.0], "front": 3.0, "clutter": [1.0, 1.0]}
    objects = ["random_door", "random_oven", "random_chest"]
    with pytest.raises(NoProblemError, match="room 0 for husky_ur5e"):
        sample(0, tasks=["fetch-place"], objects=objects, rooms=crowded)
