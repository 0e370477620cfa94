"""Defines placed objects: articulated objects with a placement and joint values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.errors import UnknownNameError
from vkc_pin.utils.arguments import check_mapping, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.shapes import (
    clamp_to_limits,
    compute_bounding_box,
    copy_shape,
    get_link_name,
)

# Half a turn about the line along which the fingers close.
_OTHER_SIDE = pin.SE3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """An articulated object with a placement in the world and joint values.

    Attributes:
        name: Its name in the scene.
        object: Articulated object.
        placement: Placement of its base link in the world frame.
        state: Its joint values, shape (n,), [rad] or [m], in the order of
            `object.coordinates.names`.
        reversed: Attachments that are approached from the side opposite to their description.
    """

    name: str
    object: ArticulatedObject
    placement: pin.SE3
    state: Floats
    reversed: tuple[str, ...] = ()

    def __repr__(self) -> str:
        state = ", ".join(
            f"{n}={v:.4g}" for n, v in zip(self.object.coordinates.names, self.state, strict=True)
        )
        return f"<PlacedObject {self.name}: {self.object.name}{f', {state}' if state else ''}>"

    def with_state(self, values: Mapping[str, float]) -> PlacedObject:
        """Return a copy with joints at `values`; the other joints keep theirs.

        Args:
            values: Joint name → value, [rad] or [m].

        Raises:
            UnknownNameError: It has no such joint.
            InputError: A value is not finite or outside the joint's limits.
        """
        state, coordinates = self.state.copy(), self.object.coordinates
        for joint, given in check_mapping(values, "values", "joints, each with its value").items():
            if joint not in coordinates.names:
                raise UnknownNameError(
                    f"joint of {self.name}", joint, coordinates.names, field=f"{self.name}.{joint}"
                )
            index, value = coordinates.index(joint), check_number(given, f"{self.name}.{joint}")
            state[index] = clamp_to_limits(
                value, self.object.lower[index], self.object.upper[index], f"{self.name}.{joint}"
            )
        return dataclasses.replace(self, state=state)

    def with_reversed(self, attachment: str) -> PlacedObject:
        """Return a copy with an attachment approached from the other side.

        The fingers close along the same line.

        Raises:
            UnknownNameError: It has no such attachment.
        """
        given = self.object.attachment(attachment)
        turned = [
            dataclasses.replace(freedom, axis=_OTHER_SIDE.rotation @ freedom.axis)
            for freedom in given.freedoms
        ]
        changed = dataclasses.replace(
            given, placement=given.placement * _OTHER_SIDE, freedoms=tuple(turned)
        )
        attachments = freeze({**self.object.attachments, attachment: changed})
        listed = tuple(sorted({*self.reversed} ^ {attachment}))
        return dataclasses.replace(
            self, object=dataclasses.replace(self.object, attachments=attachments), reversed=listed
        )

    def link_placement(self, link: str) -> pin.SE3:
        """Return the placement of `link` in the world frame.

        Raises:
            UnknownNameError: It has no such link.
        """
        return self.placement * self.object.link_placement(link, self.state)


def make_world_shapes(placed: PlacedObject, *, visual: bool = False) -> list[pin.GeometryObject]:
    """Return copies of an object's shapes with parent joint 0 and placements in the world frame.

    Returns:
        Shapes in the object's own order, with their names in the object (`<link>_<number>`).
    """
    item = placed.object
    model, geometry = item.model, item.visual if visual else item.collision
    data = model.createData()
    pin.forwardKinematics(model, data, item.coordinates.q(placed.state))
    places = [placed.placement * placement for placement in data.oMi]
    return [
        copy_shape(shape, shape.name, places[shape.parentJoint] * shape.placement)
        for shape in geometry.geometryObjects
    ]


def find_link_shapes(placed: PlacedObject, link: str) -> list[pin.GeometryObject]:
    """Return the convex collision shapes of a link, in the frames of their joints."""
    return [
        shape
        for shape in placed.object.collision.geometryObjects
        if get_link_name(shape.name) == link
    ]


def sweep_link_shapes(
    placed: PlacedObject, link: str, index: int, values: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return a link's shapes in the world while one coordinate of its object takes several values.

    Args:
        placed: Object; its other coordinates are fixed.
        link: Link, with K shapes.
        index: Index of the coordinate.
        values: Values of the coordinate, shape (V,), [rad] or [m].

    Returns:
        Placements, shape (V, K, 12), see `solids.flatten_placements`, and lower and upper corners
            of the axis-aligned bounding boxes, both (V, K, 3) [m].
    """
    model, own, state = placed.object.model, find_link_shapes(placed, link), placed.state.copy()
    data, size = model.createData(), (len(values), len(own))
    boxes = [compute_bounding_box(shape) for shape in own]
    where, lower, upper = np.empty((*size, 12)), np.empty((*size, 3)), np.empty((*size, 3))
    for row, value in enumerate(values):
        state[index] = value
        pin.forwardKinematics(model, data, placed.object.coordinates.q(state))
        placements = [
            placed.placement * data.oMi[shape.parentJoint] * shape.placement for shape in own
        ]
        where[row] = flatten_placements(placements)
        for k, (placement, (center, half)) in enumerate(zip(placements, boxes, strict=True)):
            middle, extent = placement.act(center), np.abs(placement.rotation) @ half
            lower[row, k], upper[row, k] = middle - extent, middle + extent
    return where, lower, upper
