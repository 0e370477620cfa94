from __future__ import annotations

import dataclasses
import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.validation.report import Report, Violation
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.trajectory.formats.archives import FORMAT

TETRAHEDRON = """v 0 0 0
v 0.4 0 0
v 0 0.4 0
v 0 0 0.4
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


def same(first: vkc.Plan, second: vkc.Plan) -> None:
    """Everything about two plans is equal, bit for bit."""
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


def contents(path: Path) -> dict[str, Any]:
    with np.load(path, allow_pickle=False) as archive:
        return {
            "about": json.loads(str(archive["about"])),
            **{k: archive[k] for k in archive.files if k != "about"},
        }


def rewritten(path: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    """Change the description inside a saved plan."""
    data = contents(path)
    change(data["about"])
    np.savez_compressed(path, **{**data, "about": np.array(json.dumps(data["about"]))})
    return path


@pytest.fixture
def saved(door_plan: vkc.Plan, tmp_path: Path) -> Path:
    return door_plan.save(tmp_path / "door.npz")


@pytest.fixture
def own_scene(tmp_path: Path) -> vkc.Scene:
    """A scene of a user, with a mesh beside it."""
    home = tmp_path / "work" / "scenes"
    home.mkdir(parents=True)
    (home / "heap.obj").write_text(TETRAHEDRON)
    (home / "yard.yaml").write_text(
        "robot: husky_ur5e\nstart: {base: [0, 0, 0]}\n"
        "obstacles: [{name: heap, type: mesh, file: heap.obj, position: [2.0, 1.0, 0.0]}]\n"
    )
    return vkc.load_scene(home / "yard.yaml")


def short_plan(scene: vkc.Scene) -> vkc.Plan:
    plan = vkc.plan(scene, [vkc.GoTo(0.3, 0.0)], options=vkc.Options(reach_waypoints=8))
    assert plan.success, plan.summary()
    return plan


def test_round_trip(door_plan: vkc.Plan, saved: Path) -> None:
    loaded = vkc.Plan.load(saved)
    same(door_plan, loaded)
    assert (
        vkc.validate(loaded.scene, loaded.steps, loaded.trajectory, loaded.options)
        == door_plan.report
    )
    same(door_plan, vkc.Plan.load(loaded.save(saved.parent / "again.npz")))


def test_round_trip_of_every_step(door_plan: vkc.Plan, tmp_path: Path) -> None:
    steps = (
        vkc.Grasp("door", "handle"),
        *door_plan.steps,
        vkc.Reach((1, 2, 3, 0.1, 0.2, 0.3), "tool"),
        vkc.GoTo(1.0, 2.0),
    )
    odd = dataclasses.replace(
        door_plan, steps=steps, options=vkc.Options(dt=0.1 + 0.2), seed=7, status="rejected"
    )
    odd = dataclasses.replace(
        odd, report=vkc.validate(odd.scene, steps, odd.trajectory, odd.options)
    )
    same(odd, vkc.Plan.load(odd.save(tmp_path / "odd.npz")))


def test_a_plan_of_the_package_loads_anywhere(
    door_plan: vkc.Plan, saved: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    elsewhere = tmp_path / "far" / "away"
    elsewhere.mkdir(parents=True)
    moved = shutil.move(saved, elsewhere / "moved.npz")
    monkeypatch.chdir(elsewhere)
    same(door_plan, vkc.Plan.load("moved.npz"))
    assert Path(moved).is_file()


def test_nothing_in_the_file_is_a_pickle_or_a_place_on_this_machine(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        for name in archive.namelist():
            array = np.load(io.BytesIO(archive.read(name)), allow_pickle=False)
            assert array.dtype != object
    about = json.dumps(contents(saved)["about"])
    assert contents(saved)["about"]["folder"] == {"package": "scenes"}
    for place in (
        str(Path.home()),
        str(Path(vkc.__file__).resolve().parent.parent),
        str(saved.parent),
    ):
        assert place == "/" or place not in about


def test_a_plan_moves_with_its_scene(own_scene: vkc.Scene, tmp_path: Path) -> None:
    plan = short_plan(own_scene)
    plan.save(tmp_path / "work" / "out" / "yard.npz")
    assert contents(tmp_path / "work" / "out" / "yard.npz")["about"]["folder"]["relative"] == str(
        Path("..", "scenes")
    )
    shutil.move(tmp_path / "work", tmp_path / "home")
    loaded = vkc.Plan.load(tmp_path / "home" / "out" / "yard.npz")
    same(plan, loaded)
    assert loaded.scene.folder.resolve() == (tmp_path / "home" / "scenes").resolve()
    assert vkc.validate(loaded.scene, loaded.steps, loaded.trajectory, loaded.options).ok


def test_a_plan_moves_without_its_scene(own_scene: vkc.Scene, tmp_path: Path) -> None:
    plan = short_plan(own_scene)
    path = plan.save(tmp_path / "work" / "out" / "yard.npz")
    alone = shutil.move(path, tmp_path / "yard.npz")
    same(plan, vkc.Plan.load(alone))
    shutil.rmtree(tmp_path / "work")
    with pytest.raises(vkc.InputError, match=r"there is no such file.*heap\.obj") as caught:
        vkc.Plan.load(alone)
    assert caught.value.file == tmp_path / "yard.npz"


def test_changed_scenes_are_kept(door_plan: vkc.Plan, saved: Path) -> None:
    """The start is not the one of the scene's file."""
    assert not np.array_equal(door_plan.scene.start, vkc.load_scene("door").start)
    np.testing.assert_array_equal(vkc.Plan.load(saved).scene.start, door_plan.scene.start)


def _garbage(path: Path) -> None:
    path.write_bytes(b"this is not a plan at all" * 20)


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _truncated(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def _flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    for at in range(200, len(data) - 400, 97):
        data[at] ^= 0xFF
    path.write_bytes(bytes(data))


def _foreign(path: Path) -> None:
    np.savez(path, weights=np.zeros(3))


def _array(path: Path) -> None:
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))


def _pickled(path: Path) -> None:
    np.savez(
        path,
        about=np.array({"format": FORMAT}, dtype=object),
        times=np.zeros(2),
        positions=np.zeros((2, 9)),
    )


def _listed(path: Path) -> None:
    np.savez(path, about=np.array("[1, 2]"), times=np.zeros(2), positions=np.zeros((2, 9)))


def _no_json(path: Path) -> None:
    np.savez(path, about=np.array("{"), times=np.zeros(2), positions=np.zeros((2, 9)))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        *(
            (damage, "not a saved plan")
            for damage in (_garbage, _empty, _truncated, _flipped, _foreign, _array, _pickled)
        ),
        (_listed, r"wrong value .expected fields"),
        (_no_json, "not JSON"),
    ],
)
def test_a_file_that_is_no_plan(saved: Path, damage: Callable[[Path], None], said: str) -> None:
    damage(saved)
    with pytest.raises(vkc.InputError, match=said) as caught:
        vkc.Plan.load(saved)
    assert caught.value.file == saved
    assert str(saved) in str(caught.value)


def test_a_newer_format(saved: Path) -> None:
    """What else a newer format holds does not matter."""
    rewritten(saved, lambda about: (about.update(format=FORMAT + 1), about.pop("trajectory")))
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
def test_a_plan_with_something_wrong_in_it(
    saved: Path, change: Callable[[dict[str, Any]], Any], text: str
) -> None:
    rewritten(saved, change)
    with pytest.raises(vkc.InputError, match=text) as caught:
        vkc.Plan.load(saved)
    assert caught.value.file == saved


def test_a_plan_from_before_links_of_the_robot_had_a_clearance_of_their_own(saved: Path) -> None:
    rewritten(
        saved,
        lambda about: (
            about["options"].pop("self_distance"),
            about["options"].update(dist_safe=0.013),
        ),
    )
    options = vkc.Plan.load(saved).options
    assert (options.dist_safe, options.self_distance) == (0.013, 0.013)


def test_no_file(tmp_path: Path) -> None:
    for path in (tmp_path / "none.npz", tmp_path):
        with pytest.raises(vkc.InputError, match="cannot read the plan") as caught:
            vkc.Plan.load(path)
        assert caught.value.file == path


def test_writing_is_all_or_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_atomically(tmp_path / "new" / "file.npz", b"old")
    assert path.read_bytes() == b"old"

    def fail(self: Path, target: Path) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr(Path, "replace", fail)
    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(vkc.InputError, match="the disk is full"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]  # nothing is left behind


def test_writing_replaces_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old, and longer")
    write_atomically(str(path), b"new")
    assert path.read_bytes() == b"new"
    assert os.access(path, os.R_OK | os.W_OK)


def test_the_report_of_a_success(door_plan: vkc.Plan) -> None:
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
        "seeds ",
        "coal ",
        "CasADi ",
        "Ipopt ",
        f"{int(m['iterations'])} Ipopt iterations",
        "every constraint holds",
    ):
        assert text in report


def test_the_report_of_a_failure(door_plan: vkc.Plan) -> None:
    blame = Violation(
        "penetration",
        "forearm_link – sofa",
        waypoint=9,
        time=4.0,
        amount=0.03,
        unit="m",
        detail="overlap by 30 mm",
    )
    failed = dataclasses.replace(
        door_plan, status="rejected", report=Report((blame,), -0.03, states=100)
    )
    report = failed.summary()
    assert report.startswith("door: FAILED, rejected — reach")
    assert "penetration forearm_link – sofa: overlap by 30 mm (waypoint 9, 4.00 s)" in report


def test_success_needs_both_words(door_plan: vkc.Plan) -> None:
    assert door_plan.success
    assert not dataclasses.replace(door_plan, status="not converged").success
    blame = Violation(
        "goal", "base", waypoint=9, time=4.0, amount=0.03, unit="m", detail="elsewhere"
    )
    assert not dataclasses.replace(door_plan, report=Report((blame,))).success


def test_plain_data(door_plan: vkc.Plan) -> None:
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
    endless = dataclasses.replace(door_plan, report=open_space)
    assert (
        json.loads(json.dumps(endless.to_dict(), allow_nan=False))["metrics"]["clearance"] is None
    )


def test_repr(door_plan: vkc.Plan) -> None:
    m = door_plan.metrics
    expected = (
        f"<Plan success: base {m['base_path_length']:.2f} m, "
        f"arm {m['arm_path_length']:.2f} rad, {m['planning_time']:.2f} s>"
    )
    assert repr(door_plan) == expected


def test_a_plan_cannot_be_changed(door_plan: vkc.Plan) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        door_plan.status = "success"  # type: ignore[misc]
