from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc

LINK = """<link name="{name}"><pose>0 0 {height} 0 0 0</pose><inertial><mass>2</mass></inertial>
<collision name="c"><pose>0 0 0.1 0 0 0</pose><geometry><box><size>0.1 0.1 0.19</size></box>
</geometry></collision></link>"""
JOINT = """<joint name="j{number}" type="revolute"><parent>{parent}</parent><child>{child}</child>
<axis><xyz>{axis}</xyz><limit><lower>-2.5</lower><upper>2.4</upper><velocity>2</velocity>
<effort>30</effort></limit></axis></joint>"""
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "1 0 0", "0 1 0")


def write_arm(folder: Path) -> Path:
    """Write an arm of six joints, each 0.2 m above the one before."""
    content = LINK.format(name="link_0", height=0.0)
    for k, axis in enumerate(AXES, 1):
        content += LINK.format(name=f"link_{k}", height=0.2 * k)
        content += JOINT.format(number=k, parent=f"link_{k - 1}", child=f"link_{k}", axis=axis)
    file = folder / "arm.sdf"
    file.write_text(f'<sdf version="1.9"><model name="arm">{content}</model></sdf>')
    return file


def test_arm_is_imported(tmp_path: Path) -> None:
    imported = vkc.importing.import_robot(
        write_arm(tmp_path), tmp_path / "arm", tool_frame="link_6", samples=50
    )
    robot = imported.robot
    assert robot.coordinates.names[3:] == tuple(f"j{k}" for k in range(1, 7))
    assert robot.lower[3:] == pytest.approx(np.full(6, -2.5))
    assert robot.upper[3:] == pytest.approx(np.full(6, 2.4))
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, pin.neutral(robot.model))
    place = data.oMf[robot.model.getFrameId("link_6")]
    base = data.oMf[robot.model.getFrameId("link_0")]
    np.testing.assert_allclose(base.actInv(place.translation), [0.0, 0.0, 1.2], atol=1e-9)
    assert sum(inertia.mass for inertia in robot.model.inertias) == pytest.approx(14.0)
