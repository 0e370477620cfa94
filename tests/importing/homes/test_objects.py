from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

import vkc_pin as vkc
from vkc_pin.importing.homes.objects import write_object
from vkc_pin.importing.homes.splitting import HomeObject
from vkc_pin.importing.objects.description import Description, Link, Part

SETTINGS = {"stem": "can", "most": 2, "dist_safe": 0.02, "grasp_clearance": 0.005}


def _can(radius: float) -> HomeObject:
    part = Part(
        name="",
        placement=pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.06])),
        kind="cylinder",
        size=(radius, 0.12),
    )
    return HomeObject(
        "can",
        Description(Path("home.urdf"), {"can": Link("can", (part,), (part,))}, {}),
        (1.0, 2.0, 0.7),
        free=True,
    )


def test_free_object_has_no_joint(tmp_path: Path) -> None:
    done = write_object(_can(0.03), vkc.load_robot("husky_ur5e"), tmp_path, {}, **SETTINGS)
    item = vkc.load_object(tmp_path / "objects" / "can" / "can.yaml")
    assert item.free
    assert item.coordinates.size == 0
    assert item.base_link == "can"
    assert (
        list(item.attachments)
        == [proposal.attachment.name for proposal in done.proposals.found]
        != []
    )
    for attachment in item.attachments.values():
        assert attachment.placement.translation[2] > 0.0
        assert attachment.firm
    assert done.entry == {
        "name": "can",
        "type": "objects/can/can.yaml",
        "position": [1.0, 2.0, 0.7],
    }
    assert done.summary().startswith("can: carried by can_")


def test_thick_object_is_reported(tmp_path: Path) -> None:
    done = write_object(_can(0.3), vkc.load_robot("husky_ur5e"), tmp_path, {}, **SETTINGS)
    assert not vkc.load_object(tmp_path / "objects" / "can" / "can.yaml").attachments
    assert "carried by no hand: nothing of it fits" in done.summary()
