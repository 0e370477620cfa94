"""Compares static geometry near a box, and moved geometry, with coal."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.chain.collision_pairs import PhaseGeometry
from vkc_pin.world.models.shapes import compute_bounding_box, compute_shape_distance

JOINTS = 3
COAL = 1e-5  # [m]


def sample_placement(rng: np.random.Generator, size: float) -> pin.SE3:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-size, size, 3))


def make_random_geometry(
    rng: np.random.Generator, moving: int = 7, static: int = 9
) -> PhaseGeometry:
    """Return random shapes on joints and in a 3 m room, with two thirds of all pairs."""
    shapes = []
    for k in range(moving + static):
        size = rng.uniform(0.02, 0.4, 3)
        solid = [coal.Box(*size), coal.Sphere(size[0] / 2), coal.Cylinder(size[0] / 2, size[1])][
            int(rng.integers(3))
        ]
        joint = 1 + int(rng.integers(JOINTS)) if k < moving else 0
        shapes.append(
            pin.GeometryObject(
                f"s{k}", joint, 0, sample_placement(rng, 0.3 if joint else 1.5), solid
            )
        )
    candidates = [
        (a, b)
        for a in range(moving)
        for b in range(a + 1, len(shapes))
        if shapes[a].parentJoint != shapes[b].parentJoint
    ]
    pairs = np.array([pair for pair in candidates if rng.random() < 0.66]).reshape(-1, 2)
    boxes = [compute_bounding_box(shape) for shape in shapes]
    return PhaseGeometry(
        shapes=shapes,
        labels=tuple(shape.name for shape in shapes),
        pairs=pairs,
        margins=rng.uniform(0.01, 0.05, len(pairs)),
        joint=np.array([shape.parentJoint for shape in shapes]),
        center=np.array([center for center, _ in boxes]),
        half=np.array([half for _, half in boxes]),
        rotation=np.array([shape.placement.rotation for shape in shapes]),
        translation=np.array([shape.placement.translation for shape in shapes]),
    )


def sample_joints(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return universe and joint placements, shapes (count, J + 1, 3, 3) and (count, J + 1, 3)."""
    rotations = np.array(
        [[np.eye(3), *(pin.exp3(rng.normal(size=3)) for _ in range(JOINTS))] for _ in range(count)]
    )
    translations = rng.uniform(-1.5, 1.5, (count, JOINTS + 1, 3))
    translations[:, 0] = 0.0
    return rotations, translations


def compute_all_distances(
    part: PhaseGeometry, rotations: np.ndarray, translations: np.ndarray
) -> np.ndarray:
    """Return coal's distance of every pair at every configuration, shape (W, P)."""
    out = np.empty((len(rotations), len(part.pairs)))
    for w in range(len(rotations)):
        at = [
            pin.SE3(rotations[w, s.parentJoint], translations[w, s.parentJoint]) * s.placement
            for s in part.shapes
        ]
        for k, (a, b) in enumerate(part.pairs.tolist()):
            out[w, k] = compute_shape_distance(
                part.shapes[a].geometry, at[a], part.shapes[b].geometry, at[b]
            )
    return out


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_static_geometry_can_be_moved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    part, joints = make_random_geometry(rng), sample_joints(rng, 4)
    part.boxes.find_close_pairs(0.1, *joints)  # fills caches that the copy must not use
    where = {geometry: sample_placement(rng, 1.5) for geometry in (8, 11)}
    moved = part.with_placements(where)
    at, pairs, _ = moved.boxes.find_close_pairs(0.1, *joints)
    for geometry, placement in where.items():
        assert moved.shapes[geometry].placement.isApprox(placement)
        assert not part.shapes[geometry].placement.isApprox(placement)
    close = np.argwhere(compute_all_distances(moved, *joints) < 0.1 - COAL).tolist()
    assert {tuple(pair) for pair in close} <= set(zip(at.tolist(), pairs.tolist(), strict=True))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_static_geometry_near_a_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    part = make_random_geometry(rng)
    lower = rng.uniform(-1.5, 1.0, 3)
    size = rng.uniform(0.05, 0.6, 3)
    box, here = coal.Box(*size), pin.SE3(np.eye(3), lower + size / 2)
    near = part.find_static_near(0.1, lower, lower + size).tolist()
    for k in range(7, 16):
        shape = part.shapes[k]
        if compute_shape_distance(box, here, shape.geometry, shape.placement) < 0.1 - COAL:
            assert k in near
    assert min(near, default=7) >= 7
    listed = part.pairs.tolist()
    for first in range(7):
        numbers = part.find_pairs(first, np.arange(7, 16)).tolist()
        assert [listed[k] for k in numbers] == [
            [first, b] for b in range(7, 16) if [first, b] in listed
        ]
