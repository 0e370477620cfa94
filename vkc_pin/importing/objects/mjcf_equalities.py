"""Reads which joints and free bodies the equalities of a MuJoCo model hold."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

FREE = 0
"""Type of a free joint."""
_DEGREE = 5  # coefficients of the polynomial of a coupling


@dataclass(frozen=True)
class Equalities:
    """What the active equalities of a model mean for an object.

    Attributes:
        held: Joint → position relative to that in the file, [rad] or [m], at which it is held.
        attached: Free body → body to which it is fixed.
        followers: Leader, factor and offset of each joint that follows a moving one linearly, by
            numbers of joints; no joint leads itself.
        notes: What was made of each equality.
    """

    held: dict[int, float] = field(default_factory=dict)
    attached: dict[int, int] = field(default_factory=dict)
    followers: dict[int, tuple[int, float, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def list_joints(model: Any, body: int) -> list[int]:
    """Return the numbers of a body's joints."""
    first = int(model.body_jntadr[body])
    return list(range(first, first + int(model.body_jntnum[body])))


def read_equalities(mujoco: Any, model: Any) -> Equalities:
    """Return what the equalities that are active at first hold.

    - A joint at a constant position is held there, and so is one that follows a held joint.
    - A free body that is connected or welded to another body is fixed to it.
    - Other bodies that are connected or welded close a loop, whose joints are held where they are
      in the file.
    - Objects have no coupled joints: a follower of a joint that moves becomes independent, with a
      note. So do tendons.
    """
    found = Equalities()
    couplings = list[tuple[int, int, list[float]]]()
    kinds = mujoco.mjtEq
    for number in np.flatnonzero(model.eq_active0).tolist():
        kind = int(model.eq_type[number])
        if kind == kinds.mjEQ_JOINT:
            leader = int(model.eq_obj2id[number])
            coefficients = [float(value) for value in model.eq_data[number][:_DEGREE]]
            couplings.append((int(model.eq_obj1id[number]), leader, coefficients))
        elif kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            verb = "welded" if kind == kinds.mjEQ_WELD else "connected"
            _hold_loop(mujoco, model, number, verb, found)
        else:
            name = str(model.equality(number).name) or f"number {number}"
            found.notes.append(f"<equality> '{name}' of tendons or flexible parts: left out")
    _hold_couplings(model, couplings, found)
    return found


def _hold_loop(mujoco: Any, model: Any, number: int, verb: str, found: Equalities) -> None:
    """Attach a free body that an equality connects, or hold the joints of the loop that it closes.

    Joints between an attached free body and the equality are held, too.
    """
    first, second = _find_bodies(mujoco, model, number)
    first_path = list(_walk_up(model, found, first))
    second_path = list(_walk_up(model, found, second))
    first_side = [body for body in first_path if body not in second_path]
    second_side = [body for body in second_path if body not in first_path]
    loop = first_side + second_side
    fixed = list[str]()
    for side, other in ((first_side, second), (second_side, first)):
        free = [body for body in side if _is_free(model, body) and body not in found.attached]
        if free:
            found.attached[free[0]] = other
            fixed.append(f"free body '{_name_body(model, free[0])}'")
            loop = side
            break
    for body in loop:
        for joint in list_joints(model, body):
            if int(model.jnt_type[joint]) != FREE:
                found.held.setdefault(joint, 0.0)
                fixed.append(f"joint '{_name_joint(model, joint)}'")
    if fixed:
        names = f"'{_name_body(model, first)}' and '{_name_body(model, second)}'"
        found.notes.append(f"{names} are {verb} (<equality>), hence fixed: {', '.join(fixed)}")


def _is_free(model: Any, body: int) -> bool:
    return any(int(model.jnt_type[joint]) == FREE for joint in list_joints(model, body))


def _find_bodies(mujoco: Any, model: Any, number: int) -> tuple[int, int]:
    """Return the bodies of a connection or weld, which may name sites."""
    first, second = int(model.eq_obj1id[number]), int(model.eq_obj2id[number])
    if int(model.eq_objtype[number]) == mujoco.mjtObj.mjOBJ_SITE:
        return int(model.site_bodyid[first]), int(model.site_bodyid[second])
    return first, second


def _walk_up(model: Any, found: Equalities, body: int) -> Iterator[int]:
    """Yield a body and those that carry it, up to the world."""
    yield body
    while body:
        body = found.attached.get(body, int(model.body_parentid[body]))
        yield body


def _hold_couplings(
    model: Any, couplings: list[tuple[int, int, list[float]]], found: Equalities
) -> None:
    """Hold followers of nothing and of held joints, and note the others.

    With positions x of the leader and y of the follower relative to those in the file,
    y = a0 + a1 x + a2 x² + a3 x³ + a4 x⁴.
    """
    left = couplings
    while True:
        moving = list[tuple[int, int, list[float]]]()
        for follower, leader, coefficients in left:
            if leader >= 0 and any(coefficients[1:]) and leader not in found.held:
                moving.append((follower, leader, coefficients))
                continue
            position = found.held.get(leader, 0.0)
            value = float(np.polynomial.polynomial.polyval(position, coefficients))
            found.held.setdefault(follower, value)
            name = _name_joint(model, follower)
            found.notes.append(f"joint '{name}' is held at {value:.3g} by an <equality>: fixed")
        if len(moving) == len(left):
            break
        left = moving
    for follower, leader, (offset, factor, *higher) in left:
        # Couplings in a circle limit nothing.
        if not any(higher) and follower not in _walk_leaders(found, leader):
            found.followers.setdefault(follower, (leader, factor, offset))
        names = f"joint '{_name_joint(model, follower)}' follows '{_name_joint(model, leader)}'"
        found.notes.append(f"{names} (<equality>): made independent")


def _walk_leaders(found: Equalities, joint: int) -> Iterator[int]:
    """Yield a joint and those that it follows."""
    yield joint
    while joint in found.followers:
        joint = found.followers[joint][0]
        yield joint


def _name_body(model: Any, body: int) -> str:
    return str(model.body(body).name) or f"body_{body}"


def _name_joint(model: Any, joint: int) -> str:
    return str(model.joint(joint).name) or f"joint_{joint}"
