"""Finds out how a free object stands where the robot releases it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.hulls import compute_hull
from vkc_pin.world.models.dynamics import compute_inertia, compute_solid_inertia
from vkc_pin.world.models.shapes import compute_world_box, triangulate
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.support import RESTING_DISTANCE, find_supporting_pairs

LabelledShape = tuple[str, pin.GeometryObject]
"""Label of a link or obstacle, and one of its shapes with its placement in the world frame."""

_ROUNDING = 1e-6  # [m] of the linear programs


@dataclass(frozen=True)
class Footing:
    """How a free object stands.

    Attributes:
        supports: Labels of its supports, sorted; empty in mid-air.
        height: Height of the free fall onto the shape below it [m]; 0 if it rests or touches; inf
            without any.
        below: Label of the shape below it; empty without any.
        overhang: How far its centre of mass is beyond the convex hull of its contacts with its
            supports, the larger one of x and y [m].
    """

    supports: tuple[str, ...]
    height: float = 0.0
    below: str = ""
    overhang: float = 0.0

    @property
    def is_blocked(self) -> bool:
        """Whether it rests on nothing, but touches or overlaps something."""
        return not self.supports and self.height <= _ROUNDING

    def is_stable(self, tolerance: float = 0.0) -> bool:
        """Return whether it stands, with its centre of mass at most `tolerance` [m] beyond."""
        return bool(self.supports) and self.overhang <= tolerance + _ROUNDING

    def __str__(self) -> str:
        on = " and ".join(f"'{label}'" for label in self.supports)
        if self.is_stable():
            return f"it rests on {on}"
        if self.supports:
            if np.isinf(self.overhang):
                return f"it only touches the edge of {on}"
            beyond = f"{1e3 * self.overhang:.0f} mm beyond its contact with {on}"
            return f"it tips over, with its centre of mass {beyond}"
        if self.is_blocked:
            return f"it touches '{self.below}', but does not rest on it"
        if np.isinf(self.height):
            return "it is in mid-air, with nothing below"
        return f"it is in mid-air, {1e3 * self.height:.0f} mm above '{self.below}'"


def find_footing(
    placed: PlacedObject,
    others: Iterable[LabelledShape],
    load: Sequence[PlacedObject] = (),
) -> Footing:
    """Return how a free object stands where it is.

    It stands if the vertical through its centre of mass, together with that of its load, meets the
    convex hull of its contacts. Contacts are where the object, lowered by `RESTING_DISTANCE`,
    overlaps its supports.

    Args:
        placed: The object at its placement.
        others: All that does not move with it.
        load: Objects that rest on it.
    """
    shapes = list(others)
    pairs = find_supporting_pairs(placed, shapes)
    if not pairs:
        return _measure_fall(placed, shapes)
    supports = {label for label, _, _ in pairs}
    centre = _compute_centre([placed, *load])
    overhang = _compute_overhang(centre, [(one, shape) for _, one, shape in pairs])
    return Footing(tuple(sorted(supports)), overhang=overhang)


def _compute_centre(objects: Sequence[PlacedObject]) -> Floats:
    """Return the common centre of mass, in the world frame, shape (3,) [m].

    Objects without any mass count as solids of water's density.
    """
    total = pin.Inertia.Zero()
    for placed in objects:
        item = placed.object
        if item.mass > 0.0:
            inertia = compute_inertia(item.model, item.coordinates.q(placed.state))
            total += placed.placement.act(inertia)
        else:
            total += _fill_with_water(placed)
    return np.asarray(total.lever)


def _fill_with_water(placed: PlacedObject) -> pin.Inertia:
    """Return the inertia of an object's shapes as solids of 1000 kg/m³, in the world frame."""
    total = pin.Inertia.Zero()
    for shape in make_world_shapes(placed):
        total = total + shape.placement.act(compute_solid_inertia(shape, 1000.0))
    return total


def _compute_overhang(
    centre: Floats, pairs: Sequence[tuple[pin.GeometryObject, pin.GeometryObject]]
) -> float:
    """Return how far a centre of mass is beyond the convex hull of contacts [m].

    A contact region k is {x: N_k x ≤ d_k}, the faces of both convex shapes. A point of the convex
    hull of all regions is Σ y_k with N_k y_k ≤ λ_k d_k, λ_k ≥ 0 and Σ λ_k = 1. Of these points, the
    one below or above the centre c is found by a linear program over (y, λ, t):

        min t   with   |c − Σ y_k| ≤ t in x and y.
    """
    from scipy.optimize import linprog

    count = len(pairs)
    size = 4 * count + 1
    # The unknowns are y (3 for each region), λ (1 for each region) and t. The centre of mass is
    # the origin; seen from a higher origin, the object is lower.
    higher = centre + np.array([0.0, 0.0, RESTING_DISTANCE])
    rows = list[Floats]()
    for k, (one, shape) in enumerate(pairs):
        normals, offsets = _list_faces(one, higher)
        other_normals, other_offsets = _list_faces(shape, centre)
        # N_k y_k − λ_k d_k ≤ 0
        row = np.zeros((len(normals) + len(other_normals), size))
        row[:, 3 * k : 3 * k + 3] = np.vstack([normals, other_normals])
        row[:, 3 * count + k] = -np.concatenate([offsets, other_offsets])
        rows.append(row)
    for axis in (0, 1):
        for sign in (1.0, -1.0):
            # ± Σ y_k − t ≤ 0
            row = np.zeros((1, size))
            row[0, axis : 3 * count : 3] = sign
            row[0, -1] = -1.0
            rows.append(row)
    matrix = np.vstack(rows)
    cost = np.zeros(size)
    cost[-1] = 1.0
    sum_of_weights = np.zeros((1, size))
    sum_of_weights[0, 3 * count : 4 * count] = 1.0
    unbounded = (None, None)
    not_negative = (0.0, None)
    found = linprog(
        cost,
        A_ub=matrix,
        b_ub=np.zeros(len(matrix)),
        A_eq=sum_of_weights,
        b_eq=[1.0],
        bounds=[unbounded] * (3 * count) + [not_negative] * (count + 1),
    )
    return float(found.fun) if found.success else np.inf


def _measure_fall(placed: PlacedObject, others: Iterable[LabelledShape]) -> Footing:
    """Return the footing of an object in mid-air, with the height of its fall."""
    nearest = Footing(())
    height = np.inf
    for one in make_world_shapes(placed):
        low, high = compute_world_box(one.geometry, one.placement)
        for label, shape in others:
            lower, upper = compute_world_box(shape.geometry, shape.placement)
            is_below = (low[:2] < upper[:2]).all() and (high[:2] > lower[:2]).all()
            if is_below and lower[2] < high[2] and low[2] - upper[2] < height:
                fall = _compute_fall(one, shape)
                if fall < height:
                    height = fall
                    nearest = Footing((), height=fall, below=label)
    return nearest if nearest.below else Footing((), height=np.inf)


def _compute_fall(one: pin.GeometryObject, shape: pin.GeometryObject) -> float:
    """Return how far a shape falls until it touches another [m]; inf if it passes.

    A linear program over (x, h): min h ≥ 0 with x in the first shape and x − h e_z in the other.
    """
    from scipy.optimize import linprog

    origin = one.placement.translation
    normals, offsets = _list_faces(one, origin)
    other_normals, other_offsets = _list_faces(shape, origin)
    # n · x ≤ d of the first shape, and n · x − h n_z ≤ d of the other.
    first = np.hstack([normals, np.zeros((len(normals), 1))])
    second = np.hstack([other_normals, -other_normals[:, 2:]])
    unbounded = (None, None)
    found = linprog(
        [0.0, 0.0, 0.0, 1.0],
        A_ub=np.vstack([first, second]),
        b_ub=np.concatenate([offsets, other_offsets]),
        bounds=[unbounded, unbounded, unbounded, (0.0, None)],
    )
    return float(found.fun) if found.success else np.inf


def _list_faces(shape: pin.GeometryObject, origin: Floats) -> tuple[Floats, Floats]:
    """Return outer normals n, shape (F, 3), and offsets d, shape (F,) [m], of a convex shape.

    The shape is {x: n · x ≤ d}, with x from an origin in the world frame.
    """
    vertices, _ = triangulate(shape.geometry)
    points = vertices @ shape.placement.rotation.T + shape.placement.translation - origin
    hull = compute_hull(points)
    normals = np.asarray(hull.face_normals, float)
    first_corners = np.asarray(hull.triangles[:, 0], float)
    offsets = np.einsum("fi,fi->f", normals, first_corners)
    # Triangles of one face have one plane.
    planes = np.column_stack([normals, offsets])
    faces = np.unique(np.round(planes, 9), axis=0)
    return faces[:, :3], faces[:, 3]
