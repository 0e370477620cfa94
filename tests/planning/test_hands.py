"""Tests scenes with other robots, and what plans of robots say that cannot grasp."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.expected_errors import expect_error

import vkc_pin as vkc
from vkc_pin import Scene

NOTE = "no touch_links: the hand of "


@pytest.fixture(scope="module")
def handless() -> Scene:
    """Return a drawer before a Husky whose hand may touch nothing."""
    scene = vkc.load_scene("drawer")
    return dataclasses.replace(scene, robot=dataclasses.replace(scene.robot, touch_links=()))


@pytest.mark.long
def test_robot_that_cannot_grasp_is_named_in_the_report(handless: Scene) -> None:
    steps, options = [vkc.Actuate("drawer", {"slide": 0.2}, "handle")], vkc.Options(dist_safe=0.04)
    assert vkc.plan(vkc.load_scene("drawer"), steps, options=options).success
    plan = vkc.plan(handless, steps, options=options)
    assert plan.status == "infeasible"
    note = plan.report.notes[-1]
    assert note.startswith(f"{NOTE}'husky_ur5e' may not touch drawer")
    assert "vkc-pin import-robot" in note
    assert f"because {note}" in plan.summary()


def test_other_failures_and_successes_do_not_mention_the_hand(handless: Scene) -> None:
    far = vkc.plan(handless, [vkc.GoTo(100.0, 0.0)])
    near = vkc.plan(handless, [vkc.GoTo(*(handless.start[:2] + 0.1))])
    graspable = vkc.plan(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 9.0})])
    assert (far.success, near.success, graspable.success) == (False, True, False)
    for plan in (far, near, graspable):
        assert not any(note.startswith(NOTE) for note in plan.report.notes)


@pytest.mark.parametrize("base", ["omni", "differential", "fixed"])
def test_scene_with_another_robot_keeps_all_else(base: str) -> None:
    scene = vkc.load_scene("household").with_state("door", {"hinge": 0.5})
    other = scene.with_held({"cup": "side"}).with_robot("panda", base=base, height=0.4)
    assert (other.robot.name, other.robot.base, other.robot.height) == ("panda", base, 0.4)
    np.testing.assert_array_equal(other.start[:3], scene.start[:3])
    np.testing.assert_array_equal(other.start[3:], other.robot.home)
    assert other.holds == ()
    assert other.objects["door"].state.tolist() == scene.objects["door"].state.tolist()
    assert other.obstacle_names == scene.obstacle_names
    assert other.arena == scene.arena
    again = Scene.from_document(other.document, other.folder)
    np.testing.assert_array_equal(again.start, other.start)


def test_robot_may_come_from_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths are relative to the present folder, as for `load_robot`."""
    source = vkc.load_robot("husky_ur5e").urdf.parent
    shutil.copytree(source, tmp_path / "mine")
    text = (tmp_path / "mine/robot.yaml").read_text(encoding="utf-8")
    (tmp_path / "mine/robot.yaml").write_text(text.replace("4.075", "1.5"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    scene = vkc.load_scene("door")
    for name in ("mine/robot.yaml", "./mine", Path("mine"), tmp_path / "mine" / "robot.yaml"):
        other = scene.with_robot(name)
        assert (other.robot.name, other.robot.payload) == ("mine", 1.5)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("pandaa", {}, "did you mean 'panda'"),
        ("nowhere/robot.yaml", {}, "nowhere"),
        ("panda", {"base": "tracked"}, "base"),
        ("panda", {"tool_frame": "hand"}, "hand"),
        ("panda", {"base": "ackermann"}, "turning radius"),
        (3, {}, "name"),
    ],
)
def test_wrong_robots_are_refused(name: str, options: dict[str, str], message: str) -> None:
    with expect_error(message):
        vkc.load_scene("door").with_robot(name, **options)


def test_plan_with_another_robot() -> None:
    scene = vkc.load_scene("drawer").with_robot("ur5", height=0.4)
    plan = vkc.plan(scene, [vkc.GoTo(*(scene.start[:2] + 0.1))])
    assert plan.success, plan.summary()


def test_file_of_a_robot_is_shown_in_one_line() -> None:
    file = vkc.load_robot("husky_ur5e").file
    assert repr(file) == f"<UrdfFile {file.path}: 15 links, 14 joints>"
    assert len(repr(vkc.load_robot("panda").file).splitlines()) == 1
