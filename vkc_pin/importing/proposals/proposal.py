"""Proposed attachments: what was found, how good it is, and which joints no hand can open."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from vkc_pin.importing.proposals.hand import Hand
from vkc_pin.world.models.articulated_object import ArticulatedObject, Attachment

__all__ = ["Proposal", "Proposals"]

_MOST = 3  # other joints that a line names


@dataclass(frozen=True, eq=False)
class Proposal:
    """A proposed attachment.

    Attributes:
        attachment: The attachment.
        kind: "bar", "knob" or "edge".
        named: Whether a name says that it is a handle.
        thickness: Of what is between the fingers [m].
        score: How good it is, from 0 to 1.
        opens: Joint → how far it can be opened so, [rad] or [m], before the hand meets the rest of
            the object.
        when: Joint → value of others that must be open for the hand to get there.
    """

    attachment: Attachment
    kind: str
    named: bool
    thickness: float
    score: float
    opens: Mapping[str, float]
    when: Mapping[str, float] = field(default_factory=dict)

    def description(self) -> dict[str, Any]:
        """Return it as a description file of an object has it."""
        item = self.attachment
        data: dict[str, Any] = {
            "name": item.name,
            "link": item.link,
            "position": _plain(item.placement.translation, 5),
            "approach": _plain(item.placement.rotation[:, 2], 12),
            "closing": _plain(item.placement.rotation[:, 0], 12),
        }
        if item.freedoms:
            data |= {"joint": item.joint, "axis": _plain(item.freedoms[0].axis, 12)}
            data["limits"] = [item.freedoms[0].lower, item.freedoms[0].upper]
        if len(item.freedoms) == 2:
            data["turn"] = [item.freedoms[1].lower, item.freedoms[1].upper]
        if item.standoff:
            data["standoff"] = round(item.standoff, 5)
        if item.opening is not None:
            data["opening"] = round(item.opening, 5)
        return data


@dataclass(frozen=True, eq=False)
class Proposals:
    """What `propose_attachments` found.

    Attributes:
        object: The object.
        hand: The hand that was tried.
        found: The proposed attachments, best first.
        because: Joint → why no hand can open it.
    """

    object: ArticulatedObject
    hand: Hand
    found: tuple[Proposal, ...]
    because: Mapping[str, str]

    def __repr__(self) -> str:
        names = ", ".join(proposal.attachment.name for proposal in self.found) or "none"
        return f"<Proposals for {self.object.name}: {names}>"

    def opening(self, joint: str) -> tuple[Proposal, ...]:
        """Return the attachments that a joint can be opened by, best first."""
        return tuple(proposal for proposal in self.found if joint in proposal.opens)

    def applied(self) -> ArticulatedObject:
        """Return the object with these attachments instead of its own, the best one first."""
        attachments = {proposal.attachment.name: proposal.attachment for proposal in self.found}
        return dataclasses.replace(self.object, attachments=MappingProxyType(attachments))

    def report(self) -> str:
        """Return, for every joint, what it can be opened by, or why it cannot be."""
        lines = []
        for index, joint in enumerate(self.object.coordinates.names):
            low, high = self.object.lower[index], self.object.upper[index]
            unit = self.object.coordinates.units[index]
            lines.append(f"{joint}, {low:.3g} to {high:.3g} {unit}")
            for proposal in self.opening(joint):
                name = f"{proposal.attachment.name} ({proposal.kind}{', called a handle' if proposal.named else ''})"
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
                freedom = proposal.attachment.joint
                when = _listed(
                    [f"{other} is at {value:.3g}" for other, value in proposal.when.items()]
                )
                wide = proposal.attachment.opening
                narrow = "" if wide is None else f", fingers {1e3 * wide:.0f} mm apart"
                lines.append(
                    f"  {proposal.score:.2f}  {name}: {1e3 * proposal.thickness:.0f} mm thick{narrow}, {freedom}{free}, "
                    f"opens to {proposal.opens[joint]:.3g} {unit}{when}"
                )
            if joint in self.because:
                lines.append(f"  no hand can open it: {self.because[joint]}")
        return "\n".join(lines)


def _listed(conditions: list[str]) -> str:
    """Return what else must hold, as the end of a line."""
    if not conditions:
        return ""
    more = f" and {len(conditions) - _MOST} more joints are open" if len(conditions) > _MOST else ""
    return f", while {', '.join(conditions[:_MOST])}{more}"


def _plain(vector: Any, digits: int) -> list[float]:
    """Return numbers for a file: rounded, whole ones as such, no negative zero."""
    return [float(value) + 0.0 for value in np.round(np.asarray(vector, float), digits) + 0.0]
