"""Tests the comparison on household tasks, two of them also with the paper's numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.experiments import run_experiment
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.experiments.comparison import COMPARED_PLANNERS, place_objects
from vkc_pin.experiments.household import (
    COMPARISON,
    PAPER,
    TABLE_TOP,
    TASKS,
    make_paper_home,
    sample_cup_pose,
)
from vkc_pin.world.models.shapes import compute_clearance, list_placed_shapes
from vkc_pin.world.scene.placed_object import make_world_shapes


def place_cup(scene: vkc.Scene, placement: pin.SE3) -> Any:
    """Return the shapes of the cup at a placement."""
    placed = scene.with_placement("cup", placement).objects["cup"]
    return list_placed_shapes(make_world_shapes(placed))


@pytest.mark.long
def test_variant_has_the_numbers_of_the_papers_code() -> None:
    home = make_paper_home()
    (place,) = PAPER.tasks["cup"].steps
    cup = place_cup(home, pin.SE3(np.eye(3), np.array(place.pose)))
    clearance = compute_clearance(cup, list_placed_shapes(home.obstacles))
    assert clearance == pytest.approx(1e-3, abs=1e-6), "the cup rests on the table"
    dishwasher = home.objects["dishwasher"].object
    assert dishwasher.upper[dishwasher.coordinates.names.index("rack")] == 0.8
    assert vkc.Scene.from_document(home.document, home.folder).document == home.document
    plain, paper = (
        comparison.specify(trials=2, seed=3, tasks=list(TASKS), methods=["VKC"], max_evaluations=7)
        for comparison in (COMPARISON, PAPER)
    )
    assert plain == paper, "the starts are the same"


@pytest.mark.long
def test_variant_is_run_and_reported(tmp_path: Path) -> None:
    arguments = "household --variant paper --trials 1 --methods VKC --jobs 1"
    table, trials = run_experiment(arguments, tmp_path)
    assert table.startswith("# Two tasks in a home, with the numbers of the paper's code\n")
    assert [(t["scene"], t["success"]) for t in trials] == [("cup", True), ("dishwasher", True)]
    for name in ("success", "base_path_length", "arm_path_length", "planning_time", "cup_joints"):
        assert f"]({name}.png)" in table
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    saved = vkc.Plan.load(tmp_path / "shown/cup_0000_VKC.npz")
    first, last = saved.scene.objects["cup"].placement, saved.end_scene().objects["cup"].placement
    np.testing.assert_allclose(first.translation, trials[0]["placed"]["cup"][:3], atol=1e-6)
    np.testing.assert_allclose(last.translation, [-0.6, -1.6, 1.11], atol=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("method", COMPARED_PLANNERS)
@pytest.mark.parametrize("name", TASKS)
def test_every_task_is_planned(name: str, method: str) -> None:
    task = TASKS[name]
    (spec,) = COMPARISON.specify(trials=1, seed=7, tasks=[name], methods=[method])
    scene = place_objects(vkc.load_scene(task.scene), spec).with_start(base=spec["base"])
    plan = COMPARISON.plan_trial(scene, spec)
    if method == "VKC":
        assert plan.success, plan.summary()
    report = vkc.validate(scene, task.steps, plan.trajectory, plan.options)
    assert report.ok == plan.success
    assert report.contradictions(plan.report) == []


def test_tasks_can_be_compiled() -> None:
    for task in TASKS.values():
        assert make_program(vkc.load_scene(task.scene), task.steps).segments > 0


def test_cup_rests_entirely_on_the_coffee_table() -> None:
    scene, rng = vkc.load_scene("household"), np.random.default_rng(0)
    labelled = zip(scene.obstacles, scene.obstacle_labels, strict=True)
    table = [shape for shape, label in labelled if label == "coffee_table"]
    plate = max(table, key=lambda shape: shape.placement.translation[2])
    assert isinstance(plate.geometry, coal.Box)
    center, half = plate.placement.translation[:2], plate.geometry.halfSide[:2]
    np.testing.assert_allclose(np.transpose(TABLE_TOP), [center - half, center + half])
    others = list_placed_shapes([shape for shape in scene.obstacles if shape is not plate])
    poses = np.array([sample_cup_pose(scene, rng)["cup"] for _ in range(300)])
    for pose in poses[:40]:
        cup = place_cup(scene, pin.SE3(pin.rpy.rpyToMatrix(*pose[3:]), pose[:3]))
        assert np.all(np.abs(pose[:2] - center) + 0.035 < half), "the whole foot is on the plate"
        on_plate = compute_clearance(cup, list_placed_shapes([plate]))
        assert on_plate == pytest.approx(1e-3, abs=1e-6)
        assert compute_clearance(cup, others, reach=0.1) > 0.02
    assert (np.ptp(poses[:, [0, 1, 5]], axis=0) > [0.35, 0.85, 6.0]).all()
    assert not np.ptp(poses[:, 2:5], axis=0).any()


def test_cup_poses_and_starts_depend_on_seed_and_task_alone() -> None:
    specs = COMPARISON.specify(trials=2, seed=3, tasks=list(TASKS), methods=["B1", "VKC"])
    assert all(s["seed"] == 3 + s["number"] for s in specs)
    rng, scene = np.random.default_rng([3, 0]), vkc.load_scene("household")
    for number in (0, 1):
        pose = sample_cup_pose(scene, rng)
        base = place_objects(scene, {"placed": pose}).sample_start(rng).start[:3].tolist()
        selected = [s for s in specs if (s["scene"], s["number"]) == ("cup", number)]
        assert [(s["placed"], s["base"]) for s in selected] == 2 * [(pose, base)]
    assert all("placed" not in s for s in specs if s["scene"] != "cup")
    (alone,) = COMPARISON.specify(trials=1, seed=3, tasks=["dishwasher"], methods=["VKC"])
    assert alone in specs
