"""Fixes and frees the joints of an object that its file couples: objects have no coupled joints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

from vkc_pin.importing.description import Coupling, Description, Joint, Limits, Loop


def dissolve_mechanisms(
    description: Description, positions: Mapping[str, float] | None = None
) -> Description:
    """Return an object whose joints are independent, with a note about each change.

    - A free link that is connected or welded to another link is fixed to it.
    - Other links that are connected or welded close a loop, whose joints are held.
    - A joint at a constant position is held there, and so is one that follows a held joint.
    - A joint that follows a moving one becomes independent, with the limits that its leader
      reaches.

    Args:
        description: The object.
        positions: Positions of joints by name at which links are fixed and loops held, [rad] or
            [m]. Default: those of the file, zero.
    """
    held = dict[str, float]()
    for loop in description.loops:
        description = _hold_loop(description, loop, held, positions or {})
    description, moving = _hold_followers(description, held)
    description = _limit_followers(description, moving)
    joints = dict(description.joints)
    for child, joint in description.joints.items():
        if joint.name in held:
            joints[child] = joint.fix(held[joint.name])
    return replace(description, joints=joints, loops=(), couplings=())


def _hold_loop(
    description: Description,
    loop: Loop,
    held: dict[str, float],
    positions: Mapping[str, float],
) -> Description:
    """Attach a free link that a loop connects, or hold the joints of the loop.

    Joints between an attached free link and the connection are held, too.

    Args:
        description: The object.
        loop: The loop.
        held: Positions of held joints by name, [rad] or [m], which are completed.
        positions: Positions of joints by name, [rad] or [m]; others are at zero.
    """
    first, second = loop.links
    first_path = list(description.walk_up(first))
    second_path = list(description.walk_up(second))
    first_side = [link for link in first_path if link not in second_path]
    second_side = [link for link in second_path if link not in first_path]
    around = first_side + second_side
    fixed = list[str]()
    for side, other in ((first_side, second), (second_side, first)):
        free = [link for link in side if description.joints[link].kind == "floating"]
        if free:
            description = _attach(description, free[0], other, positions)
            fixed.append(f"free body '{free[0]}'")
            around = side
            break
    for link in around:
        joint = description.joints[link]
        if joint.kind != "fixed":
            held.setdefault(joint.name, positions.get(joint.name, 0.0))
            fixed.append(f"joint '{joint.name}'")
    if not fixed:
        return description
    names = f"'{first}' and '{second}' are {loop.kind} ({loop.element})"
    return description.add_notes(f"{names}, hence fixed: {', '.join(fixed)}")


def _attach(
    description: Description, link: str, other: str, positions: Mapping[str, float]
) -> Description:
    """Return the object with a free link fixed to another link, where both are at `positions`."""
    placements = description.compute_placements(positions)
    fixed = replace(
        description.joints[link],
        name=f"{link}_fixed",
        kind="fixed",
        parent=other,
        placement=placements[other].inverse() * placements[link],
    )
    return replace(description, joints={**description.joints, link: fixed})


def _hold_followers(
    description: Description, held: dict[str, float]
) -> tuple[Description, list[Coupling]]:
    """Hold followers of nothing and of held joints; return the couplings of the others, too."""
    notes = list[str]()
    left = list(description.couplings)
    while True:
        moving = list[Coupling]()
        for coupling in left:
            is_constant = coupling.leader is None or not any(coupling.coefficients[1:])
            if not is_constant and coupling.leader not in held:
                moving.append(coupling)
                continue
            value = coupling.evaluate(held.get(coupling.leader or "", 0.0))
            held.setdefault(coupling.joint, value)
            where = f"held at {value:.3g} by an {coupling.element}"
            notes.append(f"joint '{coupling.joint}' is {where}: fixed")
        if len(moving) == len(left):
            return description.add_notes(*notes), moving
        left = moving


def _limit_followers(description: Description, couplings: list[Coupling]) -> Description:
    """Limit each follower to what its leader reaches, leaders first.

    Couplings in a circle, and those that are no straight line, limit nothing.
    """
    leaders = dict[str, Coupling]()
    for coupling in couplings:
        is_circular = coupling.joint in _walk_leaders(leaders, coupling.leader)
        if coupling.is_linear and not is_circular:
            leaders.setdefault(coupling.joint, coupling)
    by_name = {joint.name: joint for joint in description.joints.values()}
    limited = {joint.name: _find_limits(joint, by_name, leaders) for joint in by_name.values()}
    notes = list[str]()
    for coupling in couplings:
        joint = by_name[coupling.joint]
        limits = limited[coupling.joint]
        note = f"joint '{joint.name}' follows '{coupling.leader}' ({coupling.element})"
        note += ": made independent"
        if limits is not None and limits != joint.limits:
            note += f", from {limits[0]:g} to {limits[1]:g}, which its leader reaches"
        notes.append(note)
    joints = dict[str, Joint]()
    for child, joint in description.joints.items():
        joints[child] = replace(joint, limits=limited[joint.name])
    return replace(description.add_notes(*notes), joints=joints)


def _walk_leaders(leaders: Mapping[str, Coupling], joint: str | None) -> Iterator[str]:
    """Yield a joint and those that it follows."""
    while joint is not None:
        yield joint
        joint = leaders[joint].leader if joint in leaders else None


def _find_limits(
    joint: Joint, joints: Mapping[str, Joint], leaders: Mapping[str, Coupling]
) -> Limits | None:
    """Return the limits of a joint, as far as its leader reaches."""
    coupling = leaders.get(joint.name)
    if coupling is None or joint.kind not in ("revolute", "prismatic"):
        return joint.limits
    leader = joints.get(coupling.leader or "")
    if leader is None:
        return joint.limits
    leader_limits = _find_limits(leader, joints, leaders)
    return _limit_follower(joint.limits, leader_limits, coupling)


def _limit_follower(own: Limits | None, leader: Limits | None, coupling: Coupling) -> Limits | None:
    """Return the limits of a follower.

    Its own limits count where its leader reaches them: they may be a copy of the leader's, with
    which the follower of a negative factor could not move.
    """
    if leader is None or not _is_limited(leader):
        return own
    ends = [coupling.factor * end + coupling.offset for end in leader]
    reached = (min(ends), max(ends))
    if own is None:
        return reached
    common = (max(own[0], reached[0]), min(own[1], reached[1]))
    return common if common[0] < common[1] else reached


def _is_limited(limits: Limits) -> bool:
    return any(math.isfinite(end) for end in limits)
