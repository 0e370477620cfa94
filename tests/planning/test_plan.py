"""Plans and their statistics are saved, loaded, reported and exported."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import VIOLATION

import vkc_pin as vkc
from vkc_pin.planning.plan import STAGES, PlanningStatistics
from vkc_pin.validation.report import Report
from vkc_pin.world.trajectory.formats.archives import FORMAT


def test_statistics_add_field_by_field() -> None:
    one = PlanningStatistics(1.0, 0.5, 3, 2, 100, coal_time=0.25)
    other = PlanningStatistics(0.5, 0.0, 1, 1, 11, coal_time=0.5, ipopt_time=0.125)
    total = sum([one, other], start=PlanningStatistics())
    assert total == PlanningStatistics(1.5, 0.5, 4, 3, 111, coal_time=0.75, ipopt_time=0.125)


def test_records_keep_their_keys() -> None:
    times = {stage: float(k) for k, stage in enumerate(STAGES)}
    statistics = PlanningStatistics(2.0, 1.0, 7, 3, 500).with_times(times)
    metrics = statistics.to_metrics()
    assert metrics == {
        "planning_time": 2.0,
        "build_time": 1.0,
        "iterations": 7.0,
        "rounds": 3.0,
        "evaluations": 500.0,
        **{f"time_{stage}": value for stage, value in times.items()},
    }
    assert PlanningStatistics.from_metrics(metrics) == statistics
    assert PlanningStatistics.from_metrics({}) == PlanningStatistics()


TETRAHEDRON = "v 0 0 0\nv 0.4 0 0\nv 0 0.4 0\nv 0 0 0.4\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def check_equal(first: vkc.Plan, second: vkc.Plan) -> None:
    for name in ("options", "report", "status", "seed", "initialization", "success"):
        assert getattr(first, name) == getattr(second, name), name
    assert repr(first.steps) == repr(second.steps)
    assert dict(first.metrics) == dict(second.metrics)
    assert [dict(row) for row in first.history] == [dict(row) for row in second.history]
    a, b = first.trajectory, second.trajectory
    assert (a.names, a.phases, a.robot_size) == (b.names, b.phases, b.robot_size)
    np.testing.assert_array_equal(a.positions, b.positions)
    np.testing.assert_array_equal(a.times, b.times)
    assert (first.scene.document, first.scene.name) == (second.scene.document, second.scene.name)
    np.testing.assert_array_equal(first.scene.start, second.scene.start)
    assert first.summary() == second.summary()


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any], **arrays: Any) -> Path:
    """Change the description and replace arrays of a saved plan."""
    with np.load(path, allow_pickle=False) as archive:
        data = dict(archive)
    about = json.loads(str(data["about"]))
    change(about)
    np.savez_compressed(path, **{**data, "about": np.array(json.dumps(about)), **arrays})
    return path


@pytest.fixture
def saved(door_plan: vkc.Plan, tmp_path: Path) -> Path:
    return door_plan.save(tmp_path / "door.npz")


def test_round_trip(
    door_plan: vkc.Plan, saved: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Plans of packaged scenes are loaded in any folder."""
    assert not np.array_equal(door_plan.scene.start, vkc.load_scene("door").start)
    elsewhere = tmp_path / "far" / "away"
    elsewhere.mkdir(parents=True)
    shutil.move(saved, elsewhere / "moved.npz")
    monkeypatch.chdir(elsewhere)
    loaded = vkc.Plan.load("moved.npz")
    check_equal(door_plan, loaded)
    again = vkc.validate(loaded.scene, loaded.steps, loaded.trajectory, loaded.options)
    assert again == door_plan.report
    check_equal(door_plan, vkc.Plan.load(loaded.save(tmp_path / "again.npz")))


def test_file_has_no_pickles_and_no_absolute_paths(saved: Path) -> None:
    with np.load(saved, allow_pickle=False) as archive:
        assert all(array.dtype != object for array in archive.values())
        text = str(archive["about"])
    assert json.loads(text)["folder"] == {"package": "scenes"}
    package = Path(vkc.__file__).resolve().parent.parent
    for folder in map(str, (Path.home(), package, saved.parent)):
        assert folder == "/" or folder not in text


def test_plan_file_moves_with_and_without_its_scene(tmp_path: Path) -> None:
    """The scene refers to a mesh file in its folder."""
    home = tmp_path / "work" / "scenes"
    home.mkdir(parents=True)
    (home / "heap.obj").write_text(TETRAHEDRON)
    (home / "yard.yaml").write_text(
        "robot: husky_ur5e\nstart: {base: [0, 0, 0]}\n"
        "obstacles: [{name: heap, type: mesh, file: heap.obj, position: [2.0, 1.0, 0.0]}]\n"
    )
    plan = vkc.plan(vkc.load_scene(home / "yard.yaml"), [vkc.GoTo(0.3, 0.0)])
    assert plan.success, plan.summary()
    path = plan.save(tmp_path / "work" / "out" / "yard.npz")
    alone = shutil.copy(path, tmp_path / "yard.npz")
    check_equal(plan, vkc.Plan.load(alone))
    shutil.move(tmp_path / "work", tmp_path / "home")
    loaded = vkc.Plan.load(tmp_path / "home" / "out" / "yard.npz")
    check_equal(plan, loaded)
    assert loaded.scene.folder.resolve() == (tmp_path / "home" / "scenes").resolve()
    assert vkc.validate(loaded.scene, loaded.steps, loaded.trajectory, loaded.options).ok
    check_refused(alone, r"there is no such file.*heap\.obj")


def flip_bytes(data: bytes) -> bytes:
    return bytes(
        byte ^ 0xFF if k in range(200, len(data) - 400, 97) else byte for k, byte in enumerate(data)
    )


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"this is not a plan at all" * 20,
        lambda data: data[: len(data) // 2],
        flip_bytes,
    ],
    ids=["garbage", "truncated", "flipped bytes"],
)
def test_damaged_files_are_refused(saved: Path, damage: Callable[[bytes], bytes]) -> None:
    saved.write_bytes(damage(saved.read_bytes()))
    check_refused(saved, "not a saved plan")


def check_refused(path: Path, message: str) -> None:
    with pytest.raises(vkc.InputError, match=message) as caught:
        vkc.Plan.load(path)
    assert caught.value.file == path
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("about", "message"),
    [
        (None, "not a saved plan"),
        (np.array({"format": FORMAT}, dtype=object), "not a saved plan"),  # a pickle
        (np.array("[1, 2]"), r"wrong value .expected fields"),
        (np.array(json.dumps({"format": FORMAT + 1})), f"unknown format .*{FORMAT + 1}"),
    ],
    ids=["foreign", "pickle", "list", "another format"],
)
def test_other_archives_are_refused(tmp_path: Path, about: Any, message: str) -> None:
    arrays = {"times": np.zeros(2), "positions": np.zeros((2, 9))}
    np.savez(tmp_path / "a.npz", **arrays, **({} if about is None else {"about": about}))
    check_refused(tmp_path / "a.npz", message)


@pytest.mark.parametrize("name", ["none.npz", ""], ids=["missing", "folder"])
def test_unreadable_files_are_reported(tmp_path: Path, name: str) -> None:
    check_refused(tmp_path / name, "cannot read the plan")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda about: about.pop("scene"), "scene"),
        (lambda about: about.pop("status"), "status"),
        (lambda about: about.update(status="<b>"), "status"),
        (lambda about: about.update(steps=3), "steps: wrong value"),
        (lambda about: about["steps"][0].update(step="Actuat"), "did you mean 'Actuate'"),
        (lambda about: about["options"].update(dt=-1.0), "Options.dt"),
        (lambda about: about["options"].update(dist_saf=0.1), "dist_safe"),
        (lambda about: about["validation"].pop("violations"), "violations"),
        (lambda about: about["trajectory"].update(names=["base_x"]), r"Trajectory\.positions"),
        (lambda about: about["scene"]["robot"].update(name="husky_ur5"), "husky_ur5e"),
        (lambda about: about.update(folder=7), "folder: wrong value"),
    ],
)
def test_inconsistent_files_are_refused(
    saved: Path, change: Callable[[dict[str, Any]], Any], text: str
) -> None:
    check_refused(rewrite(saved, change), text)


def test_missing_self_distance_defaults_to_dist_safe(saved: Path) -> None:
    def change(about: dict[str, Any]) -> None:
        del about["options"]["self_distance"]
        about["options"]["dist_safe"] = 0.013

    options = vkc.Plan.load(rewrite(saved, change)).options
    assert (options.dist_safe, options.self_distance) == (0.013, 0.013)


def test_report_of_a_success(door_plan: vkc.Plan) -> None:
    first, *rest = door_plan.summary().splitlines()
    assert first == "door: success — reach door.handle, turn door.knob, move door.hinge, door.knob"
    report, m = "\n".join(rest), door_plan.metrics
    for text in (
        f"{m['duration']:.1f} s, {len(door_plan.trajectory.times)} waypoints",
        f"base {m['base_path_length']:.2f} m",
        f"arm {m['arm_path_length']:.2f} rad",
        f"{1e3 * m['clearance']:.1f} mm at the closest",
        f"{m['planning_time']:.3f} s after {m['build_time']:.2f} s of symbolic build",
        f"{int(m['iterations'])} Ipopt iterations",
        "every constraint holds",
    ):
        assert text in " ".join(report.split())
    assert max(map(len, rest)) <= 100, "wider than a notebook's output"
    once = dataclasses.replace(door_plan.statistics, rounds=1, iterations=1)
    short = " ".join(dataclasses.replace(door_plan, statistics=once).summary().split())
    assert "; 1 round, 1 Ipopt iteration, " in short


def test_success_requires_status_and_validation(door_plan: vkc.Plan) -> None:
    assert door_plan.success
    assert not dataclasses.replace(door_plan, status="not converged").success
    failed = dataclasses.replace(door_plan, status="rejected", report=Report((VIOLATION,)))
    assert not dataclasses.replace(failed, status="success").success
    report = failed.summary()
    assert report.startswith("door: FAILED, rejected — reach")
    assert "penetration forearm_link – sofa: overlap by 30 mm (waypoint 9, 4.00 s)" in report


def test_plan_is_converted_to_plain_data(door_plan: vkc.Plan) -> None:
    open_space = dataclasses.replace(door_plan.report, clearance=float("inf"))
    plan = dataclasses.replace(door_plan, report=open_space)
    data = json.loads(json.dumps(plan.to_dict(), allow_nan=False))
    assert (data["scene"], data["success"], data["status"]) == ("door", True, "success")
    actuate = {"step": "Actuate", "object": "door", "joints": {"hinge": 1.2}, "attachment": None}
    assert (data["steps"], data["violations"]) == ([actuate], [])
    assert data["metrics"]["clearance"] is None
    assert data["trajectory"] == json.loads(json.dumps(plan.trajectory.to_dict()))
