"""Defines articulated objects that can be grasped and moved: a door, a drawer, a stick.

An object is a URDF tree with named attachments (grasps, and the freedom they leave) and latches.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_array, check_choice, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.dynamics import Resistance, compute_mass

DEFAULT_VELOCITY = 1.0
"""Velocity limit of object joints whose URDF has none [rad/s] or [m/s]."""
DEFAULT_ACCELERATION = 2.0
"""Acceleration limit of object joints whose description has none [rad/s²] or [m/s²]."""


@dataclass(frozen=True, eq=False)
class Freedom:
    """One degree of freedom of the hand in a grasp.

    Attributes:
        suffix: Suffix of the coordinate's name, after the attachment's name; empty if the grasp has
            one degree of freedom only.
        kind: "revolute" or "prismatic".
        axis: Unit axis in the tool frame moved by the preceding freedoms, shape (3,).
        lower, upper: Limits, [rad] or [m].
        through: A point on the axis of a revolute freedom in the same frame, shape (3,) [m], such
            as the centre of a rim.
    """

    suffix: str
    kind: str
    axis: Floats
    lower: float
    upper: float
    through: Floats = field(default_factory=lambda: np.zeros(3))

    @property
    def unit(self) -> str:
        """Unit of the coordinate, "m" or "rad"."""
        return "m" if self.kind == "prismatic" else "rad"

    def motion(self, value: float) -> pin.SE3:
        """Return the displacement at `value`, [rad] or [m].

        Raises:
            InputError: The value is not a finite number.
        """
        value = check_number(value, "value")
        if self.kind == "revolute":
            turn = pin.exp3(self.axis * value)
            return pin.SE3(turn, self.through - turn @ self.through)
        return pin.SE3(np.eye(3), self.axis * value)


@dataclass(frozen=True, eq=False, kw_only=True)
class Attachment:
    """A grasp of a link, with the degrees of freedom that it leaves.

    While the link is grasped, the tool frame in the frame of `link` is `placement · J(v) · offset`,
    with J(v) the displacement of the virtual joint at the values v, and offset a translation by
    `-standoff` along the tool's z axis. The tool's z axis points out of the palm (direction of
    approach), its x axis along the direction in which the fingers close.

    A hand that really grasped elsewhere is at `placement · J(v) · offset · deviation`.

    Attributes:
        name: Name of the attachment in the object.
        link: Grasped link.
        placement: Centre of the virtual joint: the tool frame in the link's frame at v = 0 without
            standoff.
        joint: Type of the virtual joint: "fixed", "revolute", "prismatic", "cylindrical"
            (translation along an axis and rotation about it), "spherical" (rotations about x, then
            y, then z) or "listed" (freedoms listed in the description).
        freedoms: Coordinates of the virtual joint; J(v) is the product of their displacements in
            this order.
        standoff: Distance of the tool from the joint's centre, against the direction of approach
            [m].
        firm: Whether the hand clamps the link: v is chosen at grasping and constant afterwards.
        clearance: Clearance between the hand and the object's links near the grasp [m]. Default:
            `Options.grasp_clearance`.
        opening: Gripper opening during approach and grasp [m]. Default: the rest opening.
        contact: "grasp": the hand closes on the link and moves it in any direction. "push": the
            hand's foremost point takes the place of the tool frame, against a face whose inward
            normal is the z axis of `placement`, and moves the link in that direction only.
            "touch": a tool's tip touches the link and moves it in any direction, where no hand can
            close.
        deviation: Measured pose of the hand in its nominal placement; None: as described.
    """

    name: str
    link: str
    placement: pin.SE3
    joint: str = "fixed"
    freedoms: tuple[Freedom, ...] = ()
    standoff: float = 0.0
    firm: bool = False
    clearance: float | None = None
    opening: float | None = None
    contact: str = "grasp"
    deviation: pin.SE3 | None = None

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the virtual joint's coordinates in the object, in the order of `freedoms`."""
        return tuple(self.name + freedom.suffix for freedom in self.freedoms)

    @property
    def offset(self) -> pin.SE3:
        """Tool frame in the moving frame of the virtual joint, including `deviation`."""
        nominal = pin.SE3(np.eye(3), np.array([0.0, 0.0, -self.standoff]))
        return nominal if self.deviation is None else nominal * self.deviation

    def motion(self, values: ArrayLike = ()) -> pin.SE3:
        """Return J(v) · offset at the values v of the k freedoms, shape (k,), [rad] or [m].

        Raises:
            InputError: The number of values differs from that of freedoms.
        """
        given = check_array(values, self.name)
        if given.shape != (len(self.freedoms),):
            expected = f"{len(self.freedoms)}, one per freedom"
            raise InputError(
                "wrong number of values", field=self.name, expected=expected, got=given
            )
        placement = pin.SE3.Identity()
        for freedom, value in zip(self.freedoms, given, strict=True):
            placement = placement * freedom.motion(float(value))
        return placement * self.offset

    def tool(self, values: ArrayLike = ()) -> pin.SE3:
        """Return the tool frame in the frame of `link`: placement · J(v) · offset; see `motion`."""
        return self.placement * self.motion(values)


@dataclass(frozen=True)
class Latch:
    """A latch, which holds `joint` until another joint is moved, like the handle of a door.

    The joint may leave `held_at` only while `released_by` ≥ `threshold`. The latch acts only while
    |joint − held_at| ≤ `engaged_within`; beyond, the joint moves freely.

    Attributes:
        joint: Latched joint.
        held_at: Position at which the joint is latched, [rad] or [m].
        released_by: Joint that releases the latch.
        threshold: Position of `released_by` at which the latch is released, [rad] or [m].
        engaged_within: Range around `held_at` in which the latch acts, [rad] or [m].
    """

    joint: str
    held_at: float
    released_by: str
    threshold: float
    engaged_within: float

    def is_engaged(self, position: float) -> bool:
        """Return whether the latch acts at a position of its joint, [rad] or [m]."""
        return abs(position - self.held_at) <= self.engaged_within


@dataclass(frozen=True, eq=False, kw_only=True)
class ArticulatedObject:
    """An articulated object that can be grasped at its attachments.

    The frame of its base link is the universe frame of `model`.

    Attributes:
        name: Name of the object.
        urdf: Path of its URDF, or None if the URDF is part of the description.
        model: Kinematic model without a root joint.
        collision: Convex collision shapes, without collision pairs.
        visual: Visual geometry.
        coordinates: Minimal coordinates, named after the joints.
        lower, upper: Position limits, shape (n,), [rad] or [m].
        velocity: Velocity limits, shape (n,), [rad/s] or [m/s].
        acceleration: Acceleration limits, shape (n,), [rad/s²] or [m/s²].
        attachments: Name → attachment; the first one is the default.
        latches: Latches of joints.
        base_link: Name of the base link.
        free: Whether the object can be carried (a stick), rather than being fixed in the world (a
            door).
        own_pairs: Pairs of links to check for self-collision.
        resistance: Joint → friction, damping and spring.
    """

    name: str
    urdf: Path | None
    model: pin.Model
    collision: pin.GeometryModel
    visual: pin.GeometryModel
    coordinates: Coordinates
    lower: Floats
    upper: Floats
    velocity: Floats
    acceleration: Floats
    attachments: Mapping[str, Attachment]
    latches: tuple[Latch, ...]
    base_link: str
    free: bool = False
    own_pairs: Set[frozenset[str]] = frozenset()
    resistance: Mapping[str, Resistance] = field(default_factory=dict)

    def __repr__(self) -> str:
        joints = ", ".join(self.coordinates.names) or "none"
        return f"<ArticulatedObject {self.name}: joints {joints}>"

    @property
    def mass(self) -> float:
        """Total mass of the links [kg]; 0 if the description states none."""
        return compute_mass(self.model)

    @cached_property
    def links(self) -> tuple[str, ...]:
        """Names of the links."""
        return tuple(str(frame.name) for frame in self._link_frames())

    def _link_frames(self) -> list[pin.Frame]:
        return [frame for frame in self.model.frames if frame.type == pin.FrameType.BODY]

    def links_moved_by(self, joints: Set[str]) -> set[str]:
        """Return the names of the links that are moved by any of `joints`."""
        moved = set[str]()
        for frame in self._link_frames():
            # Joints from the base to the link, including the link's own.
            support = self.model.supports[frame.parentJoint]
            names = [str(self.model.names[joint]) for joint in support]
            if not joints.isdisjoint(names):
                moved.add(str(frame.name))
        return moved

    def attachment(self, name: str | None = None) -> Attachment:
        """Return the attachment `name`, or the default one.

        Raises:
            UnknownNameError: There is no attachment of that name.
            InputError: The object has no attachments.
        """
        if name is None:
            if not self.attachments:
                raise InputError(
                    f"object '{self.name}' has no attachment, so it cannot be grasped",
                    field="attachment",
                )
            return next(iter(self.attachments.values()))
        chosen = check_choice(name, self.attachments, f"attachment of {self.name}")
        return self.attachments[chosen]

    def link_frame(self, link: str) -> int:
        """Return the index of the frame of `link` in `model`.

        Raises:
            UnknownNameError: There is no link of that name.
        """
        name = check_choice(link, self.links, f"link of {self.name}")
        return int(self.model.getFrameId(name, pin.FrameType.BODY))

    def link_placement(self, link: str, state: ArrayLike) -> pin.SE3:
        """Return the placement of `link` in the base link's frame.

        Args:
            link: Name of the link.
            state: Joint positions, shape (n,), [rad] or [m].
        """
        frame = self.model.frames[self.link_frame(link)]
        data = self.model.createData()
        pin.forwardKinematics(self.model, data, self.coordinates.q(state))
        return data.oMi[frame.parentJoint] * frame.placement
