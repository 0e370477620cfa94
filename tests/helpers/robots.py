"""Writes small robots, and computes placements of their frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from vkc_pin.world.models.robot import Robot


def get_home_configuration(robot: Robot) -> np.ndarray:
    return np.concatenate([np.zeros(3), robot.home])


def compute_placement(robot: Robot, frame: str, z: np.ndarray) -> pin.SE3:
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
    return data.oMf[robot.model.getFrameId(frame)].copy()


def write_small_urdf(
    folder: Path, *, joints: str = "", links: str = "", name: str = "small"
) -> Path:
    shape = "<collision><geometry><box size='0.1 0.1 0.1'/></geometry></collision>"
    chain = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="0 0 0.5" rpy="1.5707963267948966 0 0"/>'
        f'<axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="1.5" effort="1"/></joint>'
        for k in range(3)
    )
    file = folder / f"{name}.urdf"
    bodies = "".join(f'<link name="l{k}">{shape}</link>' for k in range(4))
    file.write_text(f'<robot name="{name}">{bodies}{links}{chain}{joints}</robot>')
    return file
