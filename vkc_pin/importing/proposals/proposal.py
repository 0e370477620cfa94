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
from vkc_pin.world.models.articulated_object import ArticulatedObject, Attachment

_MAX_LISTED = 3  # other joints in a line


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
            data["freedoms"] = [
                {
                    "name": freedom.suffix.removeprefix("_"),
                    "slide" if freedom.kind == "prismatic" else "turn": freedom.axis.tolist(),
                    "limits": round_values([freedom.lower, freedom.upper]),
                }
                for freedom in item.freedoms
            ]
        elif item.freedoms:
            data |= {"joint": item.joint, "axis": round_values(item.freedoms[0].axis, 12)}
            data["limits"] = [item.freedoms[0].lower, item.freedoms[0].upper]
        if item.joint == "cylindrical":
            data["turn"] = [item.freedoms[1].lower, item.freedoms[1].upper]
        if item.standoff:
            data["standoff"] = round(item.standoff, 5)
        if item.opening is not None:
            data["opening"] = round(item.opening, 5)
        return data


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
        ways = [way for way in self.opening(joint) if not (alone and way.when)]
        reached = [way.opens[joint] for way in ways]
        return max(reached, key=lambda value: abs(value - closed), default=None)

    def _format_reached(self, index: int) -> str:
        """Format how far a hand can open a joint, if this is less than its range."""
        joint, unit = self.object.coordinates.names[index], self.object.coordinates.units[index]
        low, high = float(self.object.lower[index]), float(self.object.upper[index])
        goal = self.find_goal(joint)
        closed = float(np.clip(0.0, low, high))
        travel = max(high - closed, closed - low)
        if goal is None or not np.isfinite(travel) or abs(goal - closed) >= (1.0 - 1e-3) * travel:
            return ""
        share = abs(goal - closed) / travel
        return f": a hand opens it to {goal:.3g} {unit}, {share:.0%} of its range"

    def summary(self) -> str:
        """Return a line for each attachment by joint, or the reason why it has none."""
        lines = []
        for index, joint in enumerate(self.object.coordinates.names):
            low, high = self.object.lower[index], self.object.upper[index]
            unit = self.object.coordinates.units[index]
            lines.append(f"{joint}, {low:.3g} to {high:.3g} {unit}{self._format_reached(index)}")
            for proposal in self.opening(joint):
                handle = ", named as a handle" if proposal.named else ""
                name = f"{proposal.attachment.name} ({proposal.kind}{handle})"
                slide = next(
                    (
                        freedom
                        for freedom in proposal.attachment.freedoms
                        if freedom.kind == "prismatic"
                    ),
                    None,
                )
                free = (
                    f", {1e3 * (slide.upper - slide.lower):.0f} mm to slide along" if slide else ""
                )
                when = _format_conditions(
                    [f"{other} is at {value:.3g}" for other, value in proposal.when.items()]
                )
                wide = proposal.attachment.opening
                narrow = "" if wide is None else f", fingers {1e3 * wide:.0f} mm apart"
                thick = f"{1e3 * proposal.thickness:.0f} mm thick"
                how = f"{thick}{narrow}, {proposal.attachment.joint}{free}"
                if proposal.kind == "push":
                    how = f"a face to push{free}"
                lines.append(
                    f"  {proposal.score:.2f}  {name}: {how}, "
                    f"opens to {proposal.opens[joint]:.3g} {unit}{when}"
                )
            if joint in self.because:
                lines.append(f"  no hand can open it: {self.because[joint]}")
        return "\n".join(lines)


def _format_conditions(conditions: list[str]) -> str:
    """Format the required positions of other joints as the end of a line."""
    if not conditions:
        return ""
    more = (
        f" and {len(conditions) - _MAX_LISTED} more joints are open"
        if len(conditions) > _MAX_LISTED
        else ""
    )
    return f", while {', '.join(conditions[:_MAX_LISTED])}{more}"
