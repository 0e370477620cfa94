"""Describes small objects."""

from __future__ import annotations

import tempfile
from pathlib import Path

from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.object_file import load_object

SHAPES = (
    '<box size="0.1 0.2 0.3"/>',
    '<sphere radius="0.1"/>',
    '<cylinder radius="0.1" length="0.4"/>',
)


def format_joint(name: str, kind: str, parent: str, child: str, axis: str) -> str:
    limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
    links = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{links}<axis xyz="{axis}"/>{limit}</joint>'


def load_object_text(urdf: str, yaml: str) -> ArticulatedObject:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "thing.urdf").write_text(urdf)
        (Path(folder) / "thing.yaml").write_text(yaml)
        return load_object(Path(folder) / "thing.yaml")


URDF = (
    '<robot name="t"><link name="frame"/><link name="panel"/><link name="lever"/>'
    + format_joint("hinge", "revolute", "frame", "panel", "0 0 1")
    + '<joint name="knob" type="continuous"><parent link="panel"/><child link="lever"/>'
    '<axis xyz="1 0 0"/></joint></robot>'
)
