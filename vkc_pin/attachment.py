"""Attachment: where a tool takes hold of a link, and what freedom that grasp leaves the hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from vkc_pin.errors import InputError

__all__ = ["Attachment", "Freedom"]


@dataclass(frozen=True, eq=False)
class Freedom:
    """One coordinate of a grasp: how the hand may turn or slide in it.

    Attributes:
        suffix: What follows the attachment's name in the coordinate's; empty if it is the only one.
        kind: "revolute" or "prismatic".
        axis: Unit axis in the tool frame (after the freedoms before this one), shape (3,).
        lower, upper: Limits, [rad] or [m].
    """

    suffix: str
    kind: str
    axis: NDArray[np.float64]
    lower: float
    upper: float

    def motion(self, value: float) -> pin.SE3:
        """Return the motion at `value`, [rad] or [m]."""
        if self.kind == "revolute":
            return pin.SE3(pin.exp3(self.axis * value), np.zeros(3))
        return pin.SE3(np.eye(3), self.axis * value)


@dataclass(frozen=True, eq=False)
class Attachment:
    """A place where a tool can take hold of a link, and the freedom that this kind of grasp leaves.

    While grasped, the tool frame expressed in the frame of `link` is `placement · J(v) · offset`, with J(v) the motion
    of the virtual joint at the values v and offset a translation by `-standoff` along the tool's z axis. The tool's z
    axis points out of the palm (the direction of approach), its x axis along the direction in which the fingers close.

    Attributes:
        name: Its name in the object.
        link: The link that is held.
        placement: The tool frame in the link's frame at v = 0, were there no standoff: the virtual joint's centre.
        joint: "fixed" (no freedom), "revolute", "prismatic", "cylindrical" (slides along an axis and turns about it)
            or "spherical" (turns about x, then y, then z).
        freedoms: The virtual joint's coordinates, J(v) being the product of their motions in this order.
        standoff: How far before the joint's centre the tool stops, along its approach [m].
        firm: Whether the hand clamps: v is chosen when grasping, and stays while the object is held.
    """

    name: str
    link: str
    placement: pin.SE3
    joint: str = "fixed"
    freedoms: tuple[Freedom, ...] = ()
    standoff: float = 0.0
    firm: bool = False

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
        given = np.asarray(values, float)
        if given.shape != (len(self.freedoms),):
            raise InputError(
                "wrong number of values", field=self.name, expected=f"{len(self.freedoms)}, one a freedom", got=given
            )
        placement = pin.SE3.Identity()
        for freedom, value in zip(self.freedoms, given, strict=True):
            placement = placement * freedom.motion(float(value))
        return placement * self.offset

    def tool(self, values: ArrayLike = ()) -> pin.SE3:
        """Return the tool frame in the frame of `link`, placement · J(v) · offset, at the values v; see `motion`."""
        return self.placement * self.motion(values)
