from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.texts import format_box, format_fixed_link

import vkc_pin as vkc
from vkc_pin.importing.proposals.propose import propose_attachments
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot_file import load_robot

# A case of 1.6 m x 0.3 m x 1 m with a jointed panel in front of it, towards -y.
CASE = f'<link name="case">{format_box("1.6 0.3 1.0", "0 0 0.5")}</link>'
JOINT = """<joint name="slide" type="{}"><origin xyz="{}"/><parent link="case"/>
  <child link="panel"/><axis xyz="{}"/>
  <limit lower="{}" upper="{}" effort="1" velocity="1"/></joint>"""
FRAME = format_fixed_link("frame", "case", "-0.785 -0.22 0.5", format_box("0.05 0.14 1.0"))


def write_panel(
    folder: Path,
    kind: str = "prismatic",
    axis: str = "1 0 0",
    *,
    size: str = "0.7 0.1 0.9",
    middle: str = "0 0 0",
    at: str = "-0.4 -0.2 0.5",
    limits: tuple[float, float] = (0.0, 0.6),
    frame: str = "",
) -> Path:
    joint = JOINT.format(kind, at, axis, *limits)
    text = f'{CASE}<link name="panel">{format_box(size, middle)}</link>{joint}{frame}'
    (folder / "p.urdf").write_text(f'<robot name="p">{text}</robot>')
    return folder / "p.urdf"


LEAF = {"size": "0.7 0.1 0.9", "middle": "0.35 0 0", "at": "-0.75 -0.6 0.5"}


@pytest.mark.parametrize(
    ("settings", "approach", "opened"),
    [
        ({}, (1, 0, 0), 0.6),
        ({"axis": "-1 0 0", "at": "0.4 -0.2 0.5"}, (-1, 0, 0), 0.6),
        ({"axis": "0 0 1", "size": "0.7 0.1 0.3", "at": "0 -0.2 0.8"}, (0, 0, 1), 0.6),  # pushed up
        ({"limits": (-0.6, 0.0), "at": "0.4 -0.2 0.5"}, (-1, 0, 0), -0.6),
        ({"axis": "0 1 0", "at": "0 -0.6 0.5", "limits": (0.0, 0.2)}, (0, 1, 0), 0.2),  # a button
        # An open leaf that turns towards the case.
        (LEAF | {"kind": "revolute", "axis": "0 0 1", "limits": (0.0, 0.4)}, (0, 1, 0), 0.4),
    ],
)
def test_joints_without_handle_are_pushed(
    tmp_path: Path, settings: dict[str, str], approach: tuple[int, int, int], opened: float
) -> None:
    imported = vkc.importing.import_object(write_panel(tmp_path, **settings), tmp_path / "out")  # type: ignore[arg-type]
    best = imported.proposals.found[0]
    assert best.kind == "push"
    assert best.opens == {"slide": pytest.approx(opened)}
    attachment = imported.object.attachments[best.attachment.name]
    assert attachment.contact == "push"
    np.testing.assert_allclose(attachment.placement.rotation[:, 2], approach, atol=1e-9)
    assert "a face to push" in imported.summary()
    assert imported.scene is not None


@pytest.mark.parametrize(
    "settings",
    [
        {"axis": "0 -1 0"},  # a drawer: the hand cannot reach behind its front
        {"frame": FRAME},  # a frame covers the edge
        {"size": "0.7 0.001 0.9"},  # an edge of 1 mm
        LEAF | {"kind": "revolute", "axis": "0 0 -1", "at": "-0.75 -0.2 0.5", "limits": (0.0, 1.5)},
        {"limits": (0.0, 0.0)},
    ],
)
def test_joints_that_no_hand_can_push_get_no_push(tmp_path: Path, settings: dict[str, str]) -> None:
    imported = vkc.importing.import_object(write_panel(tmp_path, **settings), tmp_path / "out")  # type: ignore[arg-type]
    assert [proposal.kind for proposal in imported.proposals.found if proposal.kind == "push"] == []


@pytest.mark.parametrize("name", ["door", "narrow_door"])
def test_latched_panels_are_not_pushed(name: str) -> None:
    """Only the lever turns the knob that releases the latch."""
    item = load_object(name)
    assert item.latches
    found = propose_attachments(item, load_robot("husky_ur5e")).found
    assert {proposal.attachment.link for proposal in found} == {"lever"}


def test_sliding_door_is_opened_by_a_push(tmp_path: Path) -> None:
    imported = vkc.importing.import_object(write_panel(tmp_path), tmp_path / "out")
    assert imported.scene is not None
    plan = vkc.plan(vkc.load_scene(imported.scene), [vkc.Actuate("p", {"slide": 0.4})])
    assert plan.success, plan.summary()
