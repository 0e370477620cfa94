"""Plans and their statistics are saved, loaded, reported and exported."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.planning.plan import STAGES, PlanningStatistics
from vkc_pin.validation.report import Report, Violation
from vkc_pin.world.trajectory.formats.archives import FORMAT


def test_statistics_add_field_by_field() -> None:
    one = PlanningStatistics(1.0, 0.5, 3, 2, 100, coal_time=0.25)
    other = PlanningStatistics(0.5, 0.0, 1, 1, 11, coal_time=0.5, ipopt_time=0.125)
    total = one + other
    assert dataclasses.astuple(total) == (1.5, 0.5, 4, 3, 111, 0.0, 0.75, 0.0, 0.125, 0.0, 0.0, 0.0)
    assert sum([one, other], start=PlanningStatistics()) == total


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


TETRAHEDRON = """v 0 0 0
v 0.4 0 0
v 0 0.4 0
v 0 0 0.4
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


def check_equal(first: vkc.Plan, second: vkc.Plan) -> None:
    for name in ("steps", "options", "report", "status", "seed", "initialization", "success"):
        a, b = getattr(first, name), getattr(second, name)
        if name == "steps":
            a, b = [repr(step) for step in a], [repr(step) for step in b]
        assert a == b, name
    assert dict(first.metrics) == dict(second.metrics)
    assert [dict(row) for row in first.history] == [dict(row) for row in second.history]
    a, b = first.trajectory, second.trajectory
    assert (a.names, a.phases, a.robot_size) == (b.names, b.phases, b.robot_size)
    assert a.positions.tobytes() == b.positions.tobytes()
    assert a.times.tobytes() == b.times.tobytes()
    assert first.scene.document == second.scene.document
    np.testing.assert_array_equal(first.scene.start, second.scene.start)
    assert first.scene.name == second.scene.name
    assert first.summary() == second.summary()


def read_contents(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as archive:
        return {
            "about": json.loads(str(archive["about"])),
            **{k: archive[k] for k in archive.files if k != "about"},
        }


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    data = read_contents(path)
    change(data["about"])
    np.savez_compressed(path, **{**data, "about": np.array(json.dumps(data["about"]))})
    return path


@pytest.fixture
def saved(door_plan: vkc.Plan, tmp_path: Path) -> Path:
    return door_plan.save(tmp_path / "door.npz")


@pytest.fixture
def own_scene(tmp_path: Path) -> vkc.Scene:
    """Load a user's scene that refers to a mesh file in its folder."""
    home = tmp_path / "work" / "scenes"
    home.mkdir(parents=True)
    (home / "heap.obj").write_text(TETRAHEDRON)
    (home / "yard.yaml").write_text(
        "robot: husky_ur5e\nstart: {base: [0, 0, 0]}\n"
        "obstacles: [{name: heap, type: mesh, file: heap.obj, position: [2.0, 1.0, 0.0]}]\n"
    )
    return vkc.load_scene(home / "yard.yaml")


def plan_short_drive(scene: vkc.Scene) -> vkc.Plan:
    plan = vkc.plan(scene, [vkc.GoTo(0.3, 0.0)], options=vkc.Options(reach_waypoints=8))
    assert plan.success, plan.summary()
    return plan


def test_round_trip(door_plan: vkc.Plan, saved: Path) -> None:
    loaded = vkc.Plan.load(saved)
    check_equal(door_plan, loaded)
    assert (
        vkc.validate(loaded.scene, loaded.steps, loaded.trajectory, loaded.options)
        == door_plan.report
    )
    check_equal(door_plan, vkc.Plan.load(loaded.save(saved.parent / "again.npz")))


def test_plan_of_a_package_scene_loads_anywhere(
    door_plan: vkc.Plan, saved: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    elsewhere = tmp_path / "far" / "away"
    elsewhere.mkdir(parents=True)
    moved = shutil.move(saved, elsewhere / "moved.npz")
    monkeypatch.chdir(elsewhere)
    check_equal(door_plan, vkc.Plan.load("moved.npz"))
    assert Path(moved).is_file()


def test_file_has_no_pickles_and_no_absolute_paths(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        for name in archive.namelist():
            array = np.load(io.BytesIO(archive.read(name)), allow_pickle=False)
            assert array.dtype != object
    about = json.dumps(read_contents(saved)["about"])
    assert read_contents(saved)["about"]["folder"] == {"package": "scenes"}
    for folder in (
        str(Path.home()),
        str(Path(vkc.__file__).resolve().parent.parent),
        str(saved.parent),
    ):
        assert folder == "/" or folder not in about


def test_plan_file_moves_with_its_scene(own_scene: vkc.Scene, tmp_path: Path) -> None:
    plan = plan_short_drive(own_scene)
    plan.save(tmp_path / "work" / "out" / "yard.npz")
    assert read_contents(tmp_path / "work" / "out" / "yard.npz")["about"]["folder"][
        "relative"
    ] == str(Path("..", "scenes"))
    shutil.move(tmp_path / "work", tmp_path / "home")
    loaded = vkc.Plan.load(tmp_path / "home" / "out" / "yard.npz")
    check_equal(plan, loaded)
    assert loaded.scene.folder.resolve() == (tmp_path / "home" / "scenes").resolve()
    assert vkc.validate(loaded.scene, loaded.steps, loaded.trajectory, loaded.options).ok


def test_plan_file_moves_without_its_scene(own_scene: vkc.Scene, tmp_path: Path) -> None:
    plan = plan_short_drive(own_scene)
    path = plan.save(tmp_path / "work" / "out" / "yard.npz")
    alone = shutil.move(path, tmp_path / "yard.npz")
    check_equal(plan, vkc.Plan.load(alone))
    shutil.rmtree(tmp_path / "work")
    with pytest.raises(vkc.InputError, match=r"there is no such file.*heap\.obj") as caught:
        vkc.Plan.load(alone)
    assert caught.value.file == tmp_path / "yard.npz"


def test_changed_start_is_saved(door_plan: vkc.Plan, saved: Path) -> None:
    assert not np.array_equal(door_plan.scene.start, vkc.load_scene("door").start)
    np.testing.assert_array_equal(vkc.Plan.load(saved).scene.start, door_plan.scene.start)


def _write_garbage(path: Path) -> None:
    path.write_bytes(b"this is not a plan at all" * 20)


def _truncate(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def _flip_bytes(path: Path) -> None:
    data = bytearray(path.read_bytes())
    for at in range(200, len(data) - 400, 97):
        data[at] ^= 0xFF
    path.write_bytes(bytes(data))


def _write_foreign(path: Path) -> None:
    np.savez(path, weights=np.zeros(3))


def _write_pickle(path: Path) -> None:
    np.savez(
        path,
        about=np.array({"format": FORMAT}, dtype=object),
        times=np.zeros(2),
        positions=np.zeros((2, 9)),
    )


DAMAGES = (_write_garbage, _truncate, _flip_bytes, _write_foreign, _write_pickle)


def _write_list(path: Path) -> None:
    np.savez(path, about=np.array("[1, 2]"), times=np.zeros(2), positions=np.zeros((2, 9)))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        *((damage, "not a saved plan") for damage in DAMAGES),
        (_write_list, r"wrong value .expected fields"),
    ],
)
def test_damaged_files_are_refused(
    saved: Path, damage: Callable[[Path], None], message: str
) -> None:
    damage(saved)
    with pytest.raises(vkc.InputError, match=message) as caught:
        vkc.Plan.load(saved)
    assert caught.value.file == saved
    assert str(saved) in str(caught.value)


def test_unknown_format_is_refused(saved: Path) -> None:
    rewrite(saved, lambda about: (about.update(format=FORMAT + 1), about.pop("trajectory")))
    with pytest.raises(vkc.InputError, match="unknown format") as caught:
        vkc.Plan.load(saved)
    assert (caught.value.file, caught.value.expected, caught.value.got) == (
        saved,
        FORMAT,
        FORMAT + 1,
    )


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda about: about.pop("scene"), "scene"),
        (lambda about: about.pop("status"), "status"),
        (lambda about: about.update(steps=3), "steps: wrong value"),
        (lambda about: about["steps"][0].update(step="Actuat"), "did you mean 'Actuate'"),
        (lambda about: about["options"].update(dt=-1.0), "Options.dt"),
        (lambda about: about["options"].update(speed=1.0), "speed"),
        (lambda about: about["validation"].pop("violations"), "violations"),
        (lambda about: about["trajectory"].update(names=["base_x"]), r"Trajectory\.positions"),
        (lambda about: about["options"].update(dist_saf=0.1), "dist_safe"),
        (lambda about: about["scene"]["robot"].update(name="husky_ur5"), "husky_ur5e"),
        (lambda about: about.update(folder=7), "folder: wrong value"),
    ],
)
def test_inconsistent_files_are_refused(
    saved: Path, change: Callable[[dict[str, Any]], Any], text: str
) -> None:
    rewrite(saved, change)
    with pytest.raises(vkc.InputError, match=text) as caught:
        vkc.Plan.load(saved)
    assert caught.value.file == saved


def test_missing_self_distance_defaults_to_dist_safe(saved: Path) -> None:
    rewrite(
        saved,
        lambda about: (
            about["options"].pop("self_distance"),
            about["options"].update(dist_safe=0.013),
        ),
    )
    options = vkc.Plan.load(saved).options
    assert (options.dist_safe, options.self_distance) == (0.013, 0.013)


def test_missing_file_is_reported(tmp_path: Path) -> None:
    for path in (tmp_path / "none.npz", tmp_path):
        with pytest.raises(vkc.InputError, match="cannot read the plan") as caught:
            vkc.Plan.load(path)
        assert caught.value.file == path


def test_report_of_a_success(door_plan: vkc.Plan) -> None:
    report, m = door_plan.summary(), door_plan.metrics
    assert (
        report.splitlines()[0]
        == "door: success — reach door.handle, turn door.knob, move door.hinge, door.knob"
    )
    for text in (
        f"{m['duration']:.1f} s, {len(door_plan.trajectory.times)} waypoints",
        f"base {m['base_path_length']:.2f} m",
        f"arm {m['arm_path_length']:.2f} rad",
        f"{1e3 * m['clearance']:.1f} mm at the closest",
        f"{m['planning_time']:.3f} s after {m['build_time']:.2f} s of symbolic build",
        "guesses ",
        "coal ",
        "CasADi ",
        "Ipopt ",
        f"{int(m['iterations'])} Ipopt iterations",
        "every constraint holds",
    ):
        assert text in report


def test_report_of_a_failure(door_plan: vkc.Plan) -> None:
    violation = Violation(
        "penetration",
        "forearm_link – sofa",
        waypoint=9,
        time=4.0,
        amount=0.03,
        unit="m",
        detail="overlap by 30 mm",
    )
    failed = dataclasses.replace(
        door_plan, status="rejected", report=Report((violation,), -0.03, states=100)
    )
    report = failed.summary()
    assert report.startswith("door: FAILED, rejected — reach")
    assert "penetration forearm_link – sofa: overlap by 30 mm (waypoint 9, 4.00 s)" in report


def test_success_requires_status_and_validation(door_plan: vkc.Plan) -> None:
    assert door_plan.success
    assert not dataclasses.replace(door_plan, status="not converged").success
    violation = Violation(
        "goal", "base", waypoint=9, time=4.0, amount=0.03, unit="m", detail="elsewhere"
    )
    assert not dataclasses.replace(door_plan, report=Report((violation,))).success


def test_plan_is_converted_to_plain_data(door_plan: vkc.Plan) -> None:
    data = json.loads(json.dumps(door_plan.to_dict(), allow_nan=False))
    assert (data["scene"], data["success"], data["status"]) == ("door", True, "success")
    assert data["steps"] == [
        {"step": "Actuate", "object": "door", "joints": {"hinge": 1.2}, "attachment": None}
    ]
    assert data["violations"] == []
    np.testing.assert_array_equal(data["trajectory"]["positions"], door_plan.trajectory.positions)
    assert data["trajectory"]["phases"][0] == {
        "name": "reach door.handle",
        "first": 0,
        "last": 40,
        "held": {},
        "by": {},
    }
    open_space = dataclasses.replace(door_plan.report, clearance=float("inf"))
    unbounded = dataclasses.replace(door_plan, report=open_space)
    assert (
        json.loads(json.dumps(unbounded.to_dict(), allow_nan=False))["metrics"]["clearance"] is None
    )


def test_repr(door_plan: vkc.Plan) -> None:
    m = door_plan.metrics
    lengths = f"base {m['base_path_length']:.2f} m, arm {m['arm_path_length']:.2f} rad"
    assert repr(door_plan) == f"<Plan success: {lengths}, {m['planning_time']:.2f} s>"
