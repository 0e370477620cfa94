"""Articulated objects: what can be grasped and moved (a door, a drawer, a stick).

An object is a URDF tree plus named attachments (where a tool takes hold of it, and what freedom
that leaves) and latches.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import known, number, numbers
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.dynamics.joint_resistance import Resistance
from vkc_pin.world.models.dynamics.mass import compute_mass

__all__ = [
    "DEFAULT_ACCELERATION",
    "DEFAULT_VELOCITY",
    "ArticulatedObject",
    "Attachment",
    "Freedom",
    "Latch",
]

DEFAULT_VELOCITY = 1.0
"""Velocity limit [rad/s] or [m/s] of an object's joint whose URDF states none (a continuous joint without limits)."""
DEFAULT_ACCELERATION = 2.0
"""Acceleration limit [rad/s²] or [m/s²] of an object's joint whose description states none: URDF has no such field."""


@dataclass(frozen=True, eq=False)
class Freedom:
    """One coordinate of a grasp: how the hand may turn or slide in it.

    Attributes:
        suffix: What follows the attachment's name in the coordinate's; empty if it is the only one.
        kind: "revolute" or "prismatic".
        axis: Unit axis in the tool frame (after the freedoms before this one), shape (3,).
        lower, upper: Limits, [rad] or [m].
        through: A point of the axis of one that turns, in the same frame, shape (3,) [m]: the
            middle of a rim, say.
    """

    suffix: str
    kind: str
    axis: Floats
    lower: float
    upper: float
    through: Floats = field(default_factory=lambda: np.zeros(3))

    @property
    def unit(self) -> str:
        """Its unit, "m" or "rad"."""
        return "m" if self.kind == "prismatic" else "rad"

    def motion(self, value: float) -> pin.SE3:
        """Return the motion at `value`, [rad] or [m]. Raises `InputError` if that is no finite number."""
        value = number(value, "value")
        if self.kind == "revolute":
            turn = pin.exp3(self.axis * value)
            return pin.SE3(turn, self.through - turn @ self.through)
        return pin.SE3(np.eye(3), self.axis * value)


@dataclass(frozen=True, eq=False, kw_only=True)
class Attachment:
    """A place where a tool can take hold of a link, and the freedom that this kind of grasp leaves.

    While grasped, the tool frame expressed in the frame of `link` is `placement · J(v) · offset`,
    with J(v) the motion of the virtual joint at the values v and offset a translation by
    `-standoff` along the tool's z axis. The tool's z axis points out of the palm (the direction of
    approach), its x axis along the direction in which the fingers close.

    Attributes:
        name: Its name in the object.
        link: The link that is held.
        placement: The tool frame in the link's frame at v = 0, were there no standoff: the virtual
            joint's centre.
        joint: "fixed" (no freedom), "revolute", "prismatic", "cylindrical" (slides along an axis
            and turns about it), "spherical" (turns about x, then y, then z) or "listed" (what its
            description lists).
        freedoms: The virtual joint's coordinates, J(v) being the product of their motions in this
            order.
        standoff: How far before the joint's centre the tool stops, along its approach [m].
        firm: Whether the hand clamps: v is chosen when grasping, and stays while the object is
            held.
        clearance: What the hand keeps from the object's links near the grasp [m]; None:
            `Options.grasp_clearance`.
        opening: How far the gripper is open on the way to it and while it holds on [m]; None: as
            the robot rests, fully open.
        contact: "grasp": the hand closes on it, and moves it any way. "push": the hand's foremost
            point is where the tool frame would be, against a face whose inward normal is
            `placement`'s z axis, and moves it that way only.
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

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names, in the object, of the virtual joint's coordinates, in the order of `freedoms`."""
        return tuple(self.name + freedom.suffix for freedom in self.freedoms)

    @property
    def offset(self) -> pin.SE3:
        """The tool frame in the frame of the virtual joint's moving side."""
        return pin.SE3(np.eye(3), np.array([0.0, 0.0, -self.standoff]))

    def motion(self, values: ArrayLike = ()) -> pin.SE3:
        """Return J(v) · offset at the values v, shape (k,), in the order of `freedoms`, [rad] or [m].

        Raises:
            InputError: There are not as many values as freedoms.
        """
        given = numbers(values, self.name)
        if given.shape != (len(self.freedoms),):
            expected = f"{len(self.freedoms)}, one a freedom"
            raise InputError(
                "wrong number of values", field=self.name, expected=expected, got=given
            )
        placement = pin.SE3.Identity()
        for freedom, value in zip(self.freedoms, given, strict=True):
            placement = placement * freedom.motion(float(value))
        return placement * self.offset

    def tool(self, values: ArrayLike = ()) -> pin.SE3:
        """Return the tool frame in the frame of `link`, placement · J(v) · offset, at the values v; see `motion`."""
        return self.placement * self.motion(values)


@dataclass(frozen=True)
class Latch:
    """Holds `joint` at a value until another joint is moved far enough, as a lever handle does with a door.

    The joint may leave `held_at` only while `released_by` ≥ `threshold`. The latch acts only while
    |joint - held_at| ≤ `engaged_within`; further out the joint moves freely.

    Attributes:
        joint: The joint that is held.
        held_at: The value it is held at, [rad] or [m].
        released_by: The joint that releases it.
        threshold: The value from which on it is released, [rad] or [m].
        engaged_within: The latch's reach, [rad] or [m].
    """

    joint: str
    held_at: float
    released_by: str
    threshold: float
    engaged_within: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ArticulatedObject:
    """An object with joints that can be grasped at its attachments. Its base link's frame is the model's universe frame.

    Attributes:
        name: Its name.
        urdf: The URDF it came from; None if that is part of its description.
        model: Its kinematics, without a root joint.
        collision: Its collision geometry, convex shapes only, no collision pairs.
        visual: What to draw.
        coordinates: Its minimal coordinates; their names are the joints' names.
        lower, upper: Position limits, shape (n,), [rad] or [m].
        velocity: Velocity limits, shape (n,), [rad/s] or [m/s].
        acceleration: Acceleration limits, shape (n,), [rad/s²] or [m/s²].
        attachments: By name; the first is the default.
        latches: Its latches.
        base_link: The name of its base link.
        free: Whether it can be carried away (a stick), instead of standing fixed in the world (a
            door).
        own_pairs: Pairs of its links that can meet; others are taken to be made so that they
            cannot.
        resistance: Joint → friction, damping and spring that it resists with; nothing, where its
            description says nothing.
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
        return (
            f"<ArticulatedObject {self.name}: joints {', '.join(self.coordinates.names) or 'none'}>"
        )

    @property
    def mass(self) -> float:
        """What all its links weigh together [kg]; 0 if nobody says so."""
        return compute_mass(self.model)

    @property
    def links(self) -> tuple[str, ...]:
        """The names of its links."""
        return tuple(
            str(frame.name) for frame in self.model.frames if frame.type == pin.FrameType.BODY
        )

    def links_moved_by(self, joints: Set[str]) -> set[str]:
        """Return the links that any of some joints move."""
        above = [{str(self.model.names[k]) for k in support} for support in self.model.supports]
        bodies = [frame for frame in self.model.frames if frame.type == pin.FrameType.BODY]
        return {
            str(frame.name) for frame in bodies if not joints.isdisjoint(above[frame.parentJoint])
        }

    def attachment(self, name: str | None = None) -> Attachment:
        """Return the attachment `name`, or the default one.

        Raises:
            UnknownNameError: There is none of that name.
            InputError: There is none at all.
        """
        if name is None:
            if not self.attachments:
                raise InputError(
                    f"object '{self.name}' has no attachment, so it cannot be grasped",
                    field="attachment",
                )
            return next(iter(self.attachments.values()))
        return self.attachments[known(name, self.attachments, f"attachment of {self.name}")]

    def link_frame(self, link: str) -> int:
        """Return the index in `model` of the frame of `link`. Raises `UnknownNameError` if there is none."""
        return int(
            self.model.getFrameId(
                known(link, self.links, f"link of {self.name}"), pin.FrameType.BODY
            )
        )

    def link_placement(self, link: str, state: ArrayLike) -> pin.SE3:
        """Return the placement of `link` in the base link's frame at the joint values `state`, shape (n,)."""
        frame = self.model.frames[self.link_frame(link)]
        data = self.model.createData()
        pin.forwardKinematics(self.model, data, self.coordinates.q(state))
        return data.oMi[frame.parentJoint] * frame.placement
