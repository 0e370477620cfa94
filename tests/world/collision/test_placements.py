"""Tests that shape placements equal Pinocchio's bit for bit."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.world.collision.solids import ShapePlacements, flatten_placements


def test_placements_are_flattened_by_columns() -> None:
    rotation = pin.exp3(np.array([0.1, 0.2, 0.3]))
    (numbers,) = flatten_placements([pin.SE3(rotation, np.array([4.0, 5.0, 6.0]))])
    np.testing.assert_array_equal(
        numbers, [*rotation[:, 0], *rotation[:, 1], *rotation[:, 2], 4.0, 5.0, 6.0]
    )
    assert flatten_placements([]).shape == (0, 12)


def check_placements(model: pin.Model, geometry: pin.GeometryModel, q: np.ndarray) -> None:
    shape_placements = ShapePlacements(model, geometry)
    found = shape_placements.compute_placements(q)
    assert found.shape == (len(q), len(geometry.geometryObjects), 12)
    data, placed = model.createData(), pin.GeometryData(geometry)
    for row, configuration in zip(found, q, strict=True):
        pin.updateGeometryPlacements(model, data, geometry, placed, configuration)
        for numbers, placement in zip(row, placed.oMg, strict=True):
            np.testing.assert_array_equal(numbers[:9].reshape(3, 3).T, placement.rotation)
            np.testing.assert_array_equal(numbers[9:], placement.translation)
    np.testing.assert_array_equal(
        shape_placements.compute_placements(q[:1]), found[:1]
    )  # earlier results must not change


JOINTS = [
    *(getattr(pin, f"JointModel{kind}{axis}") for kind in ("R", "P", "RUB") for axis in "XYZ"),
    lambda: pin.JointModelRevoluteUnaligned(np.array([0.6, 0.0, 0.8])),
    lambda: pin.JointModelPrismaticUnaligned(np.array([0.0, -0.6, 0.8])),
    pin.JointModelPlanar,
    pin.JointModelFreeFlyer,
    pin.JointModelSpherical,
]


def test_all_joint_types_are_supported() -> None:
    pin.seed(0)
    rng, model, geometry, parent = np.random.default_rng(3), pin.Model(), pin.GeometryModel(), 0
    for k, joint in enumerate(JOINTS):
        parent = model.addJoint(parent, joint(), pin.SE3.Random(), f"j{k}")
        shape = pin.GeometryObject(f"s{k}", parent, 0, pin.SE3.Random(), coal.Sphere(0.1))
        geometry.addGeometryObject(shape)
    geometry.addGeometryObject(
        pin.GeometryObject("stands", 0, 0, pin.SE3.Random(), coal.Sphere(0.1))
    )
    neutral = pin.neutral(model)
    check_placements(
        model,
        geometry,
        np.array([pin.integrate(model, neutral, rng.normal(size=model.nv)) for _ in range(4)]),
    )
