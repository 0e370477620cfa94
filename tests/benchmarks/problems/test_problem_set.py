"""The sixty problems: the same every time, and none that cannot be done for want of room or reach."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.problems import poses
from vkc_pin.benchmarks.problems.problem_set import KINDS, NUMBER, TASKS, kind_of, problem, started
from vkc_pin.procedural.rooms.random_room import sample_layout
from vkc_pin.world.models.shapes import compute_shape_distance
from vkc_pin.world.scene.scene import START_CLEARANCE
from vkc_pin.world.task.compiler import compile_task


def test_kinds() -> None:
    assert Counter(map(kind_of, range(NUMBER))) == dict(
        zip(KINDS, (10, 10, 10, 10, 20), strict=True)
    )


@pytest.mark.parametrize("number", [-1, 60, 1.0, True])
def test_there_are_no_others(number: int) -> None:
    with pytest.raises(vkc.InputError) as found:
        problem(number)
    assert (found.value.expected, found.value.got) == ("0 to 59", repr(number))


@pytest.mark.parametrize("number", [0, 1, 10, 11, 20, 23, 30, 40, 44, 54, 55])
def test_a_problem_is_the_same_every_time_and_can_be_asked_for(number: int) -> None:
    one, other = problem(number), problem(number)
    assert (one.number, one.kind, one.name) == (number, kind_of(number), other.name)
    assert one.scene.document == other.scene.document
    assert [str(step) for step in one.steps] == [str(step) for step in other.steps]
    assert one.scene.start_clearance() >= START_CLEARANCE
    assert compile_task(one.scene, one.steps, vkc.Options()).phases


def test_fixed_starts_are_of_all_scenes() -> None:
    """Those of the paper, and the two beside; each of the home's tasks has one, the others two."""
    names = [problem(number).name.rpartition(" ")[0] for number in range(40, NUMBER)]
    assert Counter(names) == {name: 1 if name.startswith("household") else 2 for name in TASKS}


def test_starts_depend_on_task_seed_and_number() -> None:
    starts = [
        started(*which).start[:3].tolist()
        for which in (("door", 1, 0), ("door", 1, 0), ("door", 1, 1), ("door", 2, 0))
    ]
    assert starts[0] == starts[1]
    assert len({tuple(start) for start in starts}) == 3
    cups = [
        started("household_cup", 1, number).objects["cup"].placement.translation
        for number in (0, 1)
    ]
    assert not np.allclose(*cups)


def free(scene: vkc.Scene, at: pin.SE3, z: np.ndarray) -> None:
    """Assert that a configuration has its tool at a pose, and touches nothing."""
    robot = scene.robot
    there = scene.with_start(base=z[:3], arm=z[3:])
    assert there.tool_placement().isApprox(at)
    assert there.start_clearance() >= poses.CLEAR
    data, shapes = robot.model.createData(), robot.collision.createData()
    pin.updateGeometryPlacements(robot.model, data, robot.collision, shapes, robot.coordinates.q(z))
    geometry = robot.collision.geometryObjects
    for pair in robot.collision.collisionPairs:
        a, b = pair.first, pair.second
        assert (
            compute_shape_distance(
                geometry[a].geometry, shapes.oMg[a], geometry[b].geometry, shapes.oMg[b]
            )
            >= poses.CLEAR
        )


@pytest.mark.parametrize("number", [1, 2])
def test_poses_are_those_of_configurations_that_touch_nothing(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[pin.SE3, np.ndarray]] = []
    draw = poses._drawn
    monkeypatch.setattr(poses, "_drawn", lambda *given: drawn.append(draw(*given)) or drawn[-1])  # type: ignore[func-returns-value]
    layout, rng = sample_layout(number, clutter=0.6), np.random.default_rng(number)
    scene, table = layout.make_scene(), layout.find_part("table_1")

    over = poses.pose_over(layout, scene, table, rng)
    free(scene, over, drawn[-1][1])
    assert table.footprint.compute_distances([over.translation[:2]])[0] == 0.0
    assert 0.05 < over.translation[2] - table.size[2] < 0.45

    among = poses.pose_among(layout, scene, rng)
    z = drawn[-1][1]
    free(scene, among, z)
    assert scene.with_start(base=z[:3], arm=z[3:]).start_clearance() < poses.NEAR
    assert np.linalg.norm(z[:2] - layout.start[:2]) >= poses.FAR
    places = [layout.start[:2], (float(z[0]), float(z[1]))]
    assert layout.floor.is_connected(
        [part.footprint for part in layout.parts], layout.radius, places
    )


def test_poses_that_cannot_be_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(poses, "_TRIES", 3)
    layout = sample_layout(0)
    for find in (
        lambda: poses.pose_over(
            layout, layout.make_scene(), layout.find_part("table_1"), np.random.default_rng(0)
        ),
        lambda: poses.pose_among(layout, layout.make_scene(), np.random.default_rng(0)),
    ):
        with pytest.raises(vkc.InputError, match="no configuration"):
            find()
