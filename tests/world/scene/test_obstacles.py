"""Tests the shapes of obstacles: placement, size and visual shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pydantic
import pytest
from helpers.meshes import write_wedge

from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.obstacles import FLOOR, make_floor_shape, make_obstacle_shapes
from vkc_pin.world.scene.scene_schema import ObstacleSchema

POSE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 1.0), np.array([1.0, -2.0, 0.5]))
URDF = """<robot name="r"><link name="a"><collision><origin xyz="0 0 1"/><geometry>
<sphere radius="0.1"/></geometry></collision></link><link name="b">
<collision><geometry><box size="1 2 3"/></geometry></collision></link>
<joint name="j" type="continuous"><parent link="a"/><child link="b"/>
<origin xyz="0.5 0 0" rpy="0 0 0.4"/><axis xyz="0 0 1"/></joint></robot>"""


def make_shapes(
    folder: Path, **fields: Any
) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
    item = pydantic.TypeAdapter(ObstacleSchema).validate_python(
        {"name": "item", "position": [0, 0, 0], **fields}
    )
    return make_obstacle_shapes(item, POSE, folder)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"type": "box", "size": [0.2, 0.3, 0.4]}, coal.Box(0.2, 0.3, 0.4)),
        ({"type": "sphere", "radius": 0.2}, coal.Sphere(0.2)),
        ({"type": "cylinder", "radius": 0.2, "length": 0.5}, coal.Cylinder(0.2, 0.5)),
        ({"type": "capsule", "radius": 0.2, "length": 0.5}, coal.Capsule(0.2, 0.5)),
        ({"type": "mesh", "file": "wedge.obj", "scale": [2.0, 1.0, 3.0]}, None),
    ],
)
def test_every_type_has_its_shape_and_placement(
    fields: dict[str, Any], expected: coal.CollisionGeometry | None, tmp_path: Path
) -> None:
    write_wedge(tmp_path / "wedge.obj")
    (visual,), (solid,) = make_shapes(tmp_path, colour=[0.1, 0.2, 0.3, 0.4], **fields)
    if expected is None:
        assert solid.geometry.computeVolume() == pytest.approx(1.0)
    else:
        assert solid.geometry == expected
    for shape in (visual, solid):
        assert (shape.name, shape.parentJoint) == ("item", 0)
        assert shape.placement.isApprox(POSE)
        np.testing.assert_allclose(shape.meshColor, [0.1, 0.2, 0.3, 0.4])
    assert visual.meshPath == ("" if expected else str(tmp_path / "wedge.obj"))
    assert solid.meshPath == ""


def test_urdf_obstacles_have_their_joints_at_zero(tmp_path: Path) -> None:
    (tmp_path / "r.urdf").write_text(URDF)
    _, solid = make_shapes(tmp_path, type="urdf", file="r.urdf", colour=[1, 0, 0, 1])
    placements = [
        pin.SE3(np.eye(3), np.array([0, 0, 1.0])),
        pin.SE3(pin.utils.rotate("z", 0.4), np.array([0.5, 0, 0])),
    ]
    for k, (shape, local) in enumerate(zip(solid, placements, strict=True)):
        assert (shape.name, shape.parentJoint) == (f"item_{k}", 0)
        assert shape.placement.isApprox(POSE * local, 1e-12)
        np.testing.assert_array_equal(shape.meshColor, [1, 0, 0, 1])


def test_floor_covers_the_arena_and_a_border() -> None:
    floor = make_floor_shape((-1.0, 4.0, 0.0, 2.5))
    low, high = compute_world_box(floor.geometry, floor.placement)
    np.testing.assert_allclose(low, [-3.0, -2.0, -0.1])
    np.testing.assert_allclose(high, [6.0, 4.5, 0.0], atol=1e-12)
    assert floor.name == FLOOR
