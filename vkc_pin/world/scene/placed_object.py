"""Defines placed objects: articulated objects with a placement and joint values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from vkc_pin.errors import UnknownNameError
from vkc_pin.utils.arguments import check_choice, check_mapping, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.models.articulated_object import ArticulatedObject, Freedom
from vkc_pin.world.models.grafting import round_placement
from vkc_pin.world.models.measured_joint import MeasuredJoint, mount_joint
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
        measured: Joint → where it was measured, of joints that are elsewhere than described.
    """

    name: str
    object: ArticulatedObject
    placement: pin.SE3
    state: Floats
    reversed: tuple[str, ...] = ()
    measured: Mapping[str, MeasuredJoint] = field(default_factory=dict)

    def __repr__(self) -> str:
        parts = [self.object.name]
        for joint, value in zip(self.object.coordinates.names, self.state, strict=True):
            parts.append(f"{joint}={value:.4g}")
        return f"<PlacedObject {self.name}: {', '.join(parts)}>"

    def with_state(self, values: Mapping[str, float]) -> PlacedObject:
        """Return a copy with joints at `values`; the other joints keep theirs.

        Args:
            values: Joint name → value, [rad] or [m].

        Raises:
            UnknownNameError: It has no such joint.
            InputError: A value is not finite or outside the joint's limits.
        """
        coordinates = self.object.coordinates
        state = self.state.copy()
        stated = check_mapping(values, "values", "joints, each with its value")
        for joint, given in stated.items():
            field = f"{self.name}.{joint}"
            if joint not in coordinates.names:
                kind = f"joint of {self.name}"
                raise UnknownNameError(kind, joint, coordinates.names, field=field)
            index = coordinates.index(joint)
            value = check_number(given, field)
            lower = self.object.lower[index]
            upper = self.object.upper[index]
            state[index] = clamp_to_limits(value, lower, upper, field)
        return dataclasses.replace(self, state=state)

    def with_reversed(self, attachment: str) -> PlacedObject:
        """Return a copy with an attachment approached from the other side.

        The fingers close along the same line.

        Raises:
            UnknownNameError: It has no such attachment.
        """
        described = self.object.attachment(attachment)
        freedoms = list[Freedom]()
        for freedom in described.freedoms:
            axis = _OTHER_SIDE.rotation @ freedom.axis
            freedoms.append(dataclasses.replace(freedom, axis=axis))
        turned = dataclasses.replace(
            described, placement=described.placement * _OTHER_SIDE, freedoms=tuple(freedoms)
        )
        attachments = freeze({**self.object.attachments, attachment: turned})
        # An attachment that is reversed twice is as described.
        all_reversed = {*self.reversed} ^ {attachment}
        return dataclasses.replace(
            self,
            object=dataclasses.replace(self.object, attachments=attachments),
            reversed=tuple(sorted(all_reversed)),
        )

    def with_measured_joint(self, joint: str, measured: MeasuredJoint) -> PlacedObject:
        """Return a copy with a joint where it was measured; its value and limits stay.

        Raises:
            UnknownNameError: It has no such joint.
        """
        index = self.find_joint(joint)
        model = self.object.model
        parent_link = self.get_link_shift(int(model.parents[index]))
        own_link = self.get_link_shift(index)
        moved = mount_joint(
            self.object,
            index,
            round_placement(parent_link * measured.placement),
            round_placement(measured.link * own_link.inverse()),
        )
        all_measured = freeze({**self.measured, joint: measured})
        return dataclasses.replace(self, object=moved, measured=all_measured)

    def find_joint(self, joint: str) -> int:
        """Return the index of a joint in the object's model.

        Raises:
            UnknownNameError: It has no such joint.
        """
        coordinates = self.object.coordinates
        name = check_choice(joint, coordinates.names, f"joint of {self.name}", "joint")
        return coordinates.joints[coordinates.index(name)]

    def get_link_shift(self, joint: int) -> pin.SE3:
        """Return where a joint's own link is in its frame: identity, unless it was measured."""
        name = str(self.object.model.names[joint])
        return self.measured[name].link if name in self.measured else pin.SE3.Identity()

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
    geometry = item.visual if visual else item.collision
    data = item.model.createData()
    pin.forwardKinematics(item.model, data, item.coordinates.q(placed.state))
    joint_placements = [placed.placement * placement for placement in data.oMi]
    shapes = []
    for shape in geometry.geometryObjects:
        placement = joint_placements[shape.parentJoint] * shape.placement
        shapes.append(copy_shape(shape, shape.name, placement))
    return shapes


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
    model = placed.object.model
    data = model.createData()
    shapes = find_link_shapes(placed, link)
    boxes = [compute_bounding_box(shape) for shape in shapes]
    rows = np.empty((len(values), len(shapes), 12))
    lower = np.empty((len(values), len(shapes), 3))
    upper = np.empty((len(values), len(shapes), 3))
    state = placed.state.copy()
    for v, value in enumerate(values):
        state[index] = value
        pin.forwardKinematics(model, data, placed.object.coordinates.q(state))
        placements = [
            placed.placement * data.oMi[shape.parentJoint] * shape.placement for shape in shapes
        ]
        rows[v] = flatten_placements(placements)
        for k, (placement, (center, half_extents)) in enumerate(
            zip(placements, boxes, strict=True)
        ):
            world_center = placement.act(center)
            extent = np.abs(placement.rotation) @ half_extents
            lower[v, k] = world_center - extent
            upper[v, k] = world_center + extent
    return rows, lower, upper
