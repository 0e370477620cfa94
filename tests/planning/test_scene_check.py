"""Tests the scene check: close pairs, reachable attachments and frame directions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.drawers import add_boxes, load_drawer_scene, replace_scene_fields

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.planning.scene_check import SceneCheck, check_scene
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene


@pytest.fixture(scope="module")
def drawer_check() -> SceneCheck:
    return check_scene(load_drawer_scene())


def test_free_scene_has_no_problems(drawer_check: SceneCheck) -> None:
    assert drawer_check.ok
    assert (
        drawer_check.robot,
        drawer_check.close,
        drawer_check.allowed,
        drawer_check.problems,
    ) == ((), (), (), ())
    assert drawer_check.warnings == ()
    assert [one.attachment for one in drawer_check.attachments] == list(
        load_drawer_scene().objects["drawer"].object.attachments
    )
    for one in drawer_check.attachments:
        np.testing.assert_allclose(one.approach, [1.0, 0.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(one.closing, [0.0, 0.0, 1.0], atol=1e-9)


def test_reachable_configurations_are_valid(drawer_check: SceneCheck) -> None:
    scene = load_drawer_scene()
    grasps = {
        name
        for name, one in scene.objects["drawer"].object.attachments.items()
        if one.contact == "grasp"
    }
    for one in (one for one in drawer_check.attachments if one.attachment in grasps):
        assert one.configuration is not None
        there = scene.with_start(base=one.configuration[:3], arm=one.configuration[3:])
        still = vkc.Trajectory(
            tuple(scene.robot.coordinates.names)
            + ("drawer.slide", f"drawer.{one.attachment}")[: 1 + (one.attachment != "handle")],
            np.array([0.0, 1.0]),
            np.tile(
                [*one.configuration, *([0.0] if one.attachment == "handle" else [0.0, 0.0])], (2, 1)
            ),
            (vkc.PhaseSpan("stand", 0, 1, ()),),
            len(one.configuration),
        )
        report = validate(there, [vkc.Reach(there.tool_placement())], still)
        assert report.ok, report.lines()
        assert report.clearance >= 0.005 - 1e-6  # between the hand and the drawer
        assert one.clearance >= 0.02


def test_blocked_attachments_name_the_obstacle() -> None:
    blocked = check_scene(add_boxes(load_drawer_scene(), box=((0.2, 1.6, 1.2), (1.66, 0.0, 0.6))))
    assert not blocked.ok
    assert all(one.configuration is None and "box" in one.because for one in blocked.attachments)
    assert any("not reached" in line for line in blocked.lines())


def test_unreachable_attachments_are_reported() -> None:
    (drawer,) = load_drawer_scene().document["objects"]
    high = check_scene(
        replace_scene_fields(
            load_drawer_scene(), objects=[{**drawer, "position": [1.93, 0.0, 2.0]}]
        )
    )
    assert not high.ok
    assert [one.configuration for one in high.attachments] == [None] * len(
        load_drawer_scene().objects["drawer"].object.attachments
    )


def test_grasped_objects_are_not_checked() -> None:
    cup = {"name": "cup", "type": "cup", "position": [0.0, 0.0, 1.5]}
    scene = replace_scene_fields(
        load_drawer_scene(), objects=[*load_drawer_scene().document["objects"], cup]
    )
    held = check_scene(
        scene.with_held({"cup": next(iter(scene.objects["cup"].object.attachments))})
    )
    assert {one.object for one in held.attachments} == {"drawer"}
    assert any(one.configuration is not None for one in held.attachments)


def test_overlaps_and_close_pairs_are_reported(tmp_path: Path) -> None:
    scene = add_boxes(
        load_drawer_scene(), side=((0.6, 0.1, 0.9), (2.0, 0.295 + 0.05 + 0.004, 0.45))
    )
    x, y, _ = scene.start[:3]
    post = {"name": "post", "type": "box", "size": [0.1, 0.1, 1.0], "position": [x, y, 0.5]}
    found = check_scene(replace_scene_fields(scene, obstacles=[*scene.document["obstacles"], post]))
    assert not found.ok
    assert found.problems
    assert all("post" in line and "overlap" in line for line in found.problems)
    assert {pair.second for pair in found.robot if pair.distance < 0.0} == {"post"}
    assert [pair[:2] for pair in found.close] == [("drawer.tray", "side")]
    assert [(one.first, one.second) for one in found.allowed] == [("drawer.tray", "side")]
    text = str(found)
    assert "drawer.tray – side are 4.0 mm apart" in text
    assert "nothing can be planned, because" in text
    found.plot(tmp_path / "scene.png")
    assert (tmp_path / "scene.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(InputError, match="not the name of a picture"):
        found.plot(tmp_path / "scene.txt")


@pytest.mark.parametrize(
    ("arena", "boxes", "area"),
    [
        ({"x": [-1.2, -0.4], "y": [0.1, 0.9]}, {}, "0.6"),
        (
            None,
            {
                f"wall_{k}": (size, (-0.8 + x, 0.5 + y, 0.5))
                for k, (size, x, y) in enumerate(
                    [((0.1, 2.2, 1.0), s, 0.0) for s in (-0.8, 0.8)]
                    + [((2.2, 0.1, 1.0), 0.0, s) for s in (-0.8, 0.8)]
                )
            },
            "0.6",
        ),
    ],
    ids=["small arena", "cell"],
)
def test_small_reachable_floor_area_is_reported(
    arena: dict[str, list[float]] | None,
    boxes: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]],
    area: str,
) -> None:
    scene = add_boxes(load_drawer_scene(), **boxes)
    if arena is not None:
        scene = replace_scene_fields(scene, arena=arena, start_region=arena)
    (warning,) = check_scene(scene).warnings
    assert f"the base reaches at most {area} m² of floor" in warning


def test_invalid_arguments() -> None:
    with pytest.raises(InputError, match="scene"):
        check_scene("drawer")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="seed"):
        check_scene(load_drawer_scene(), seed=-1)


def test_planning_continues_from_the_end_scene() -> None:
    scene: Scene = load_drawer_scene()
    grasp = vkc.plan(scene, [vkc.Grasp("drawer")])
    held = grasp.end_scene()
    assert held.held == {"drawer": "handle"}
    np.testing.assert_allclose(
        held.start, grasp.trajectory.positions[-1, : len(held.start)], atol=1e-9
    )
    pulled = vkc.plan(held, [vkc.Actuate("drawer", {"slide": 0.3})])
    assert pulled.success, pulled.summary()
    after = pulled.end_scene()
    assert after.objects["drawer"].state[0] == pytest.approx(0.3, abs=1e-3)
    driven = vkc.plan(after, [vkc.Release(), vkc.GoTo(0.0, 0.0)])
    assert driven.success, driven.summary()
    assert driven.end_scene().held == {}
    failed = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 9.0})])
    with pytest.raises(InputError, match="no success"):
        failed.end_scene()
