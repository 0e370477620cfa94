"""Tests that furniture closes through nothing that stands in its closed place.

An obstacle that an open leaf clears is no part of the furniture, wherever the leaf would be closed.
Planner, validation and oracle decide that independently.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from helpers.carrying import describe_box
from oracle.changes import write_changed
from oracle.judge import judge

import vkc_pin as vkc
from vkc_pin.world.scene.clearance_exemptions import MODEL_ERROR, find_clearance_exemptions

SHORT = vkc.Options(reach_waypoints=10, move_waypoints=8, turn_waypoints=12)
SAFE = SHORT.dist_safe
OPEN = {"refrigerator": 1.2, "cabinet": 1.2, "door": 1.2, "drawer": 0.35}
JOINTS = {"refrigerator": "hinge", "cabinet": "hinge", "door": "hinge", "drawer": "slide"}


def make_open_scene(kind: str, *obstacles: dict[str, Any], **fields: Any) -> vkc.Scene:
    """Return a room with open furniture at (2, 0)."""
    furniture = {
        "name": "it",
        "type": kind,
        "position": [2.0, 0.0, 0.0],
        "state": {JOINTS[kind]: OPEN[kind]},
    }
    document = {
        "name": "kitchen",
        "robot": "husky_ur5e",
        "start": {"base": [0.3, -0.4, 0.0]},
        "objects": [{**furniture, **fields}],
        "obstacles": list(obstacles),
    }
    return vkc.Scene.from_document(document, ".")


@cache
def plan_closing(kind: str) -> vkc.Plan:
    """Return the plan of closing furniture in an empty room."""
    steps = [vkc.Actuate("it", {JOINTS[kind]: 0.0})]
    plan = vkc.plan(make_open_scene(kind), steps, options=SHORT)
    assert plan.success, plan.summary()
    return plan


@pytest.fixture(scope="module")
def save_closing(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that saves the plan of closing furniture, on which the oracle agrees."""
    folder = tmp_path_factory.mktemp("closing")

    @cache
    def save(kind: str) -> Path:
        saved = plan_closing(kind).save(folder / f"{kind}.npz")
        assert judge(saved).agrees
        return saved

    return save


def describe_pole(at: tuple[float, float, float], radius: float = 0.01) -> dict[str, Any]:
    return {
        "name": "obstacle",
        "type": "cylinder",
        "radius": radius,
        "length": 0.4,
        "position": list(at),
    }


IN_THE_WAY = {
    "carton on a shelf": ("refrigerator", describe_box("obstacle", [0.3, 0.12, 0.2], [2, 0, 1.1])),
    "pole": ("refrigerator", describe_pole((1.975, -0.1, 1.1))),
    "crate in a doorway": ("door", describe_box("obstacle", [0.4, 0.4, 0.4], [2.0, -0.45, 0.2])),
    "chair's leg in a doorway": ("door", describe_pole((2.0, -0.6, 0.2), 0.02)),
    "box behind a drawer's front": (
        "drawer",
        describe_box("obstacle", [0.05, 0.3, 0.05], [1.95, 0.0, 0.755]),
    ),
    "plank in a cabinet": ("cabinet", describe_box("obstacle", [0.2, 0.3, 0.02], [2.0, 0.1, 1.0])),
}


@pytest.mark.parametrize("name", IN_THE_WAY)
def test_furniture_does_not_close_through_obstacles(
    name: str, tmp_path: Path, save_closing: Callable[[str], Path]
) -> None:
    kind, obstacle = IN_THE_WAY[name]
    closing = plan_closing(kind)
    scene = make_open_scene(kind, obstacle)
    assert all(one.margin >= 0.0 for one in find_clearance_exemptions(scene, SAFE))
    plan = vkc.plan(scene, closing.steps, options=SHORT)
    assert plan.status == "infeasible"
    (note,) = plan.report.notes
    assert "proven: between " in note
    assert " – obstacle overlap by " in note
    report = vkc.validate(scene, closing.steps, closing.trajectory, closing.options)
    hits = {one.subject for one in report.violations if one.constraint == "penetration"}
    assert any(subject.startswith("it.") and "obstacle" in subject for subject in hits)
    changed = write_changed(
        save_closing(kind),
        tmp_path / "changed.npz",
        lambda c: c["scene"]["obstacles"].append(obstacle),
    )
    found = judge(changed).found
    assert any(one.rule == "overlap" and "obstacle" in one.subject for one in found)


FRONT = 0.295  # [m] half the width of the drawer's front
BACK_OF_FRONT = 1.973  # [m] x of its back where it is closed


@pytest.mark.parametrize(("depth", "closes"), [(0.004, True), (0.006, False)])
def test_small_overlap_of_closed_furniture_is_an_error_of_the_model(
    depth: float, closes: bool
) -> None:
    """A panel beside the closed drawer's front overlaps it, as in kitchens of other packages."""
    panel = describe_box("panel", [0.4, 0.1, 0.9], [2.1, FRONT - depth + 0.05, 0.45])
    scene = make_open_scene("drawer", panel)
    plan = vkc.plan(scene, [vkc.Actuate("it", {"slide": 0.0})], options=SHORT)
    assert plan.success == closes
    if closes:
        (used,) = plan.report.exemptions
        assert used.subject == "it.tray – panel"
        assert used.distance == pytest.approx(-depth, abs=1e-4)
        assert f"{1e3 * depth:.1f} mm inside each other as built" in used.reason
        assert depth < MODEL_ERROR
    else:
        assert "it.tray – panel overlap by 6.0 mm" in plan.report.notes[0]


def make_quietly(*arguments: Any, **fields: Any) -> vkc.Scene:
    """Return `make_open_scene` without its warning of overlaps."""
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        return make_open_scene(*arguments, **fields)


BEGINNING_INSIDE = {
    # The open drawer's front stands 3 mm inside a beam, which is 0.25 m long.
    "closing drawer": (
        "drawer",
        OPEN["drawer"],
        0.0,
        describe_box("obstacle", [0.25, 0.2, 0.03], [BACK_OF_FRONT - 0.35 + 0.122, 0.0, 0.755]),
    ),
    # The closed leaf, 40 mm thick, stands 1 mm inside what is in its way.
    "opening door": (
        "door",
        0.0,
        1.2,
        describe_box("obstacle", [0.3, 0.3, 0.6], [2.169, -0.4, 0.6]),
    ),
    "opening door at a thin post": (
        "door",
        0.0,
        1.2,
        describe_box("obstacle", [0.03, 0.03, 0.6], [2.034, -0.6, 0.6]),
    ),
    # The hinge is inside the block at every angle, but the leaf would get deeper by 0.2 m.
    "hinge in a block": (
        "door",
        0.0,
        1.2,
        describe_box("obstacle", [0.4, 0.6, 0.6], [2.219, -0.1, 0.6]),
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "closing drawer" else pytest.mark.long)
        for name in BEGINNING_INSIDE
    ],
)
def test_overlap_at_the_start_gets_no_deeper(name: str) -> None:
    kind, begin, goal, obstacle = BEGINNING_INSIDE[name]
    joint = JOINTS[kind]
    scene = make_quietly(kind, obstacle, state={joint: begin})
    plan = vkc.plan(scene, [vkc.Actuate("it", {joint: goal})], options=SHORT)
    assert plan.status == "infeasible"
    assert "proven: between " in plan.report.notes[0]
    assert " – obstacle overlap by " in plan.report.notes[0]
    free = make_open_scene(kind, state={joint: begin})
    through = vkc.plan(free, plan.steps, options=SHORT)
    assert through.success, through.summary()
    report = vkc.validate(scene, plan.steps, through.trajectory, plan.options)
    hits = {one.subject for one in report.violations if one.constraint == "penetration"}
    assert any(subject.startswith("it.") and "obstacle" in subject for subject in hits)
