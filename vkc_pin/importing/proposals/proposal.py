"""Defines proposed attachments and the reasons why joints have none."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.hand import Hand
from vkc_pin.importing.targets import round_values
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.models.articulated_object import ArticulatedObject, Attachment, Freedom

_MAX_LISTED = 3  # other joints in a line
_WHOLE = 1.0 - 1e-3  # part of a range from which it counts as the whole


@dataclass(frozen=True, eq=False)
class Proposal:
    """A proposed attachment.

    Attributes:
        attachment: The attachment.
        kind: "bar", "knob", "edge" or "push".
        named: Whether a name identifies it as a handle.
        thickness: Thickness between the fingers [m]; 0 for a push.
        score: Quality, from 0 to 1.
        opens: Maps each joint to the position, [rad] or [m], to which it can be opened before the
            hand collides with the object.
        when: Maps other joints to positions at which they must be open for the hand to fit, in the
            order in which hands can open them.
    """

    attachment: Attachment
    kind: str
    named: bool
    thickness: float
    score: float
    opens: Mapping[str, float]
    when: Mapping[str, float] = field(default_factory=dict)

    def description(self) -> dict[str, Any]:
        """Return the attachment as in an object's description file."""
        item = self.attachment
        data: dict[str, Any] = {
            "name": item.name,
            "link": item.link,
            "position": round_values(item.placement.translation, 5),
            "approach": round_values(item.placement.rotation[:, 2], 12),
            "closing": round_values(item.placement.rotation[:, 0], 12),
        }
        if item.contact == "push":
            data["contact"] = "push"
            data["freedoms"] = [_describe_freedom(freedom) for freedom in item.freedoms]
        elif item.freedoms:
            first = item.freedoms[0]
            data["joint"] = item.joint
            data["axis"] = round_values(first.axis, 12)
            data["limits"] = [first.lower, first.upper]
        if item.joint == "cylindrical":
            _, turn = item.freedoms
            data["turn"] = [turn.lower, turn.upper]
        if item.standoff:
            data["standoff"] = round(item.standoff, 5)
        if item.opening is not None:
            data["opening"] = round(item.opening, 5)
        return data


def _describe_freedom(freedom: Freedom) -> dict[str, Any]:
    """Return a degree of freedom as in an object's description file."""
    motion = "slide" if freedom.kind == "prismatic" else "turn"
    return {
        "name": freedom.suffix.removeprefix("_"),
        motion: freedom.axis.tolist(),
        "limits": round_values([freedom.lower, freedom.upper]),
    }


@dataclass(frozen=True, eq=False)
class Proposals:
    """Result of `propose_attachments`.

    Attributes:
        object: The object.
        hand: The hand.
        found: Proposed attachments, best first.
        because: Maps joints to the reason why no hand can open them.
        rejected: Maps these joints to the tool frames that were tried, in the object's base frame.
    """

    object: ArticulatedObject
    hand: Hand
    found: tuple[Proposal, ...]
    because: Mapping[str, str]
    rejected: Mapping[str, tuple[pin.SE3, ...]] = field(default_factory=dict)

    def __repr__(self) -> str:
        names = ", ".join(proposal.attachment.name for proposal in self.found) or "none"
        return f"<Proposals for {self.object.name}: {names}>"

    def opening(self, joint: str) -> tuple[Proposal, ...]:
        """Return the attachments with which a joint can be opened, best first."""
        return tuple(proposal for proposal in self.found if joint in proposal.opens)

    def make_object(self) -> ArticulatedObject:
        """Return the object with these attachments instead of its own, best first."""
        attachments = {proposal.attachment.name: proposal.attachment for proposal in self.found}
        return dataclasses.replace(self.object, attachments=freeze(attachments))

    def find_goal(self, joint: str, *, alone: bool = False) -> float | None:
        """Return the position, [rad] or [m], up to which a hand can open a joint; None: not.

        Args:
            joint: The joint.
            alone: Whether all other joints stay closed.
        """
        index = self.object.coordinates.index(joint)
        closed = float(np.clip(0.0, self.object.lower[index], self.object.upper[index]))
        reached = list[float]()
        for proposal in self.opening(joint):
            if not (alone and proposal.when):
                reached.append(proposal.opens[joint])
        return max(reached, key=lambda value: abs(value - closed), default=None)

    def _format_reached(self, index: int) -> str:
        """Format how far a hand can open a joint, if this is less than its range."""
        joint = self.object.coordinates.names[index]
        unit = self.object.coordinates.units[index]
        low = float(self.object.lower[index])
        high = float(self.object.upper[index])
        goal = self.find_goal(joint)
        closed = float(np.clip(0.0, low, high))
        travel = max(high - closed, closed - low)
        if goal is None or not np.isfinite(travel):
            return ""
        opened = abs(goal - closed)
        if opened >= _WHOLE * travel:
            return ""
        return f": a hand opens it to {goal:.3g} {unit}, {opened / travel:.0%} of its range"

    def summary(self) -> str:
        """Return a line for each attachment by joint, or the reason why it has none."""
        lines = list[str]()
        for index, joint in enumerate(self.object.coordinates.names):
            low = self.object.lower[index]
            high = self.object.upper[index]
            unit = self.object.coordinates.units[index]
            lines.append(f"{joint}, {low:.3g} to {high:.3g} {unit}{self._format_reached(index)}")
            lines += [
                f"  {_format_proposal(proposal, joint, unit)}" for proposal in self.opening(joint)
            ]
            if joint in self.because:
                lines.append(f"  no hand can open it: {self.because[joint]}")
        return "\n".join(lines)


def _format_conditions(conditions: list[str]) -> str:
    """Format the required positions of other joints as the end of a line."""
    if not conditions:
        return ""
    listed = ", ".join(conditions[:_MAX_LISTED])
    if len(conditions) > _MAX_LISTED:
        listed += f" and {len(conditions) - _MAX_LISTED} more joints are open"
    return f", while {listed}"


def _format_proposal(proposal: Proposal, joint: str, unit: str) -> str:
    """Return a line about an attachment and how far it opens a joint.

    Args:
        proposal: The proposed attachment.
        joint: The joint, one of `opens`.
        unit: Unit of its position.
    """
    attachment = proposal.attachment
    handle = ", named as a handle" if proposal.named else ""
    slides = ""
    for freedom in attachment.freedoms:
        if freedom.kind == "prismatic":
            slides = f", {1e3 * (freedom.upper - freedom.lower):.0f} mm to slide along"
            break
    if proposal.kind == "push":
        how = f"a face to push{slides}"
    else:
        how = f"{1e3 * proposal.thickness:.0f} mm thick"
        if attachment.opening is not None:
            how += f", fingers {1e3 * attachment.opening:.0f} mm apart"
        how += f", {attachment.joint}{slides}"
    conditions = [f"{other} is at {value:.3g}" for other, value in proposal.when.items()]
    when = _format_conditions(conditions)
    name = f"{attachment.name} ({proposal.kind}{handle})"
    opens = f"opens to {proposal.opens[joint]:.3g} {unit}"
    return f"{proposal.score:.2f}  {name}: {how}, {opens}{when}"
