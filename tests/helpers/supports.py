"""Makes scenes with cups on a sliding plate, or on a tray that the robot carries."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

TOP = 0.67  # height of the plate [m]
POST = (
    '<link name="post"><collision><origin xyz="0 0 0.3"/>'
    '<geometry><box size="0.3 0.3 0.6"/></geometry></collision></link>'
)
GRIP = (
    '<collision><origin xyz="-0.27 0 {z}" rpy="1.5707963267948966 0 0"/>'
    '<geometry><cylinder radius="0.01" length="0.2"/></geometry></collision>'
    '<collision><origin xyz="-0.23 0.09 {z}"/>'
    '<geometry><box size="0.07 0.01 0.01"/></geometry></collision>'
    '<collision><origin xyz="-0.23 -0.09 {z}"/>'
    '<geometry><box size="0.07 0.01 0.01"/></geometry></collision>'
)
BOARD = (
    '<collision><origin xyz="0 0 0.01"/><geometry><box size="0.4 0.4 0.02"/></geometry></collision>'
)
JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="post"/><child link="plate"/>'
    '<origin xyz="0 0 0.65"/><axis xyz="{axis}"/>'
    '<limit lower="0" upper="0.5" effort="10" velocity="1"/></joint>'
)
OBJECT = """urdf: {name}.urdf
free: {free}
attachments:
  - name: handle
    link: {link}
    position: [-0.27, 0, {z}]
    approach: [1, 0, 0]
    closing: [0, 0, 1]
"""
JOINTS = {
    "plate": ("slide", "prismatic", "-1 0 0"),
    "flap": ("tip", "revolute", "0 1 0"),
    "turntable": ("turn", "revolute", "0 0 1"),
}


@cache
def write_objects() -> Path:
    """Write the descriptions of the objects, and return their folder."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, (joint, kind, axis) in JOINTS.items():
        plate = f'<link name="plate">{BOARD}{GRIP.format(z=0.01)}</link>'
        moving = JOINT.format(name=joint, kind=kind, axis=axis)
        (folder / f"{name}.urdf").write_text(f'<robot name="{name}">{POST}{plate}{moving}</robot>')
        (folder / f"{name}.yaml").write_text(
            OBJECT.format(name=name, free="false", link="plate", z=0.01)
        )
    (folder / "tray.urdf").write_text(
        f'<robot name="tray"><link name="tray">{BOARD}{GRIP.format(z=0.03)}</link></robot>'
    )
    (folder / "tray.yaml").write_text(OBJECT.format(name="tray", free="true", link="tray", z=0.03))
    return folder


def make_scene(
    objects: Sequence[Mapping[str, Any]], obstacles: Sequence[Mapping[str, Any]] = ()
) -> Scene:
    """Return a hall with objects and obstacles."""
    document = {
        "robot": "husky_ur5e",
        "arena": {"x": [-3.0, 3.0], "y": [-3.0, 3.0]},
        "start": {"base": [-1.2, 0.2, 0.0]},
        "objects": list(objects),
        "obstacles": list(obstacles),
    }
    return Scene.from_document(document, write_objects())


def describe_cup(name: str = "cup", *, at: Sequence[float] = (0.8, 0.05, TOP)) -> dict[str, Any]:
    return {"name": name, "type": "cup", "position": list(at)}


def make_plate_scene(
    kind: str = "plate", *, cups: int = 1, gap: float = 0.0, wall: float | None = None
) -> Scene:
    """Return a plate, cups `gap` [m] above it, and optionally a wall `wall` [m] behind one."""
    objects = [{"name": "plate", "type": f"{kind}.yaml", "position": [0.8, 0.0, 0.0]}]
    objects += [
        describe_cup(f"cup_{k}" if k else "cup", at=(0.8, 0.05 - 0.12 * k, TOP + gap))
        for k in range(cups)
    ]
    behind = (
        []
        if wall is None
        else [
            {
                "name": "wall",
                "type": "box",
                "size": [0.02, 0.02, 0.05],
                "position": [0.8 + 0.035 + wall + 0.01, 0.05, TOP + 0.06],
            }
        ]
    )
    return make_scene(objects, behind)


def slide_plate(scene: Scene, value: float, *, steps: int = 30) -> Trajectory:
    """Return a motion of the plate's joint to `value`, while the robot rests."""
    joint = scene.objects["plate"].object.coordinates.names[0]
    rows = np.column_stack(
        [np.tile(scene.start, (steps + 1, 1)), np.linspace(0.0, value, steps + 1)]
    )
    phases = (PhaseSpan("move", 0, steps, (Hold("plate", "handle"),)),)
    return Trajectory(
        (*scene.robot.coordinates.names, f"plate.{joint}"),
        0.25 * np.arange(steps + 1),
        rows,
        phases,
        9,
    )


def make_tray_scene() -> Scene:
    """Return a scene of two tables, one with a tray and a cup on it."""
    objects = [
        {"name": "tray", "type": "tray.yaml", "position": [0.8, 0.0, 0.7]},
        describe_cup(at=(0.82, 0.05, 0.72)),
    ]
    tables = [
        {"name": name, "type": "box", "size": [0.36, 0.5, 0.1], "position": list(at)}
        for name, at in (("table", (0.8, 0.0, 0.65)), ("other", (-0.5, -1.5, 0.65)))
    ]
    return make_scene(objects, tables)
