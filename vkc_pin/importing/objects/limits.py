"""Chooses the limits of joints for which a file states none."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.importing.convex import ERROR
from vkc_pin.importing.description import SOLIDS, Description, Joint, Limits
from vkc_pin.importing.objects.clean_up import compute_bounds, load_surfaces, place_vertices
from vkc_pin.world.files.meshes import make_convex_hull
from vkc_pin.world.models.shapes import compute_shape_distance, compute_world_box

_OPEN = np.pi / 2.0  # [rad] opening angle of hinges without limits
_PULLED = 0.8  # travel of drawers without limits, relative to their depth
_TINY_RANGE = 0.05  # [rad] hinge ranges below this suggest a wrong unit
_STEPS = 18  # checked positions of the travel: every 5° of a right angle
# [m] by which parts may overlap more than when they are closed: convex pieces protrude as much
_TOUCH = ERROR
_LEAST = 0.1  # of the travel: if parts meet before it in all directions, they do not tell where to


def add_missing_limits(description: Description) -> Description:
    """Return an object of convex parts with limits for joints that state none, each noted.

    A hinge opens by a right angle, a drawer by most of its depth, in the direction that moves the
    part away from the centre of the object. Where it would pass through another part of the object,
    it opens in the other direction, or up to there. A joint with one limit other than 0 opens from
    0 to it.
    """
    joints = dict(description.joints)
    notes = list(description.notes)
    notes += _note_tiny_ranges(description)
    chooser = None
    for child, joint in description.joints.items():
        stated = joint.limits or (-np.inf, np.inf)
        if joint.kind not in ("revolute", "prismatic") or np.isfinite(stated).all():
            continue
        if chooser is None:
            chooser = _Chooser(description)
        limits, reason = chooser.choose(child, stated)
        joints[child] = dataclasses.replace(joint, limits=limits)
        low, high = limits
        unit = "rad" if joint.kind == "revolute" else "m"
        chosen = f"{low:.3g} to {high:.3g} {unit}"
        missing = _describe_missing(stated)
        notes.append(f"joint '{joint.name}' states {missing}: {chosen} assumed{reason}")
    return dataclasses.replace(description, joints=joints, notes=tuple(notes))


def _describe_missing(stated: Limits) -> str:
    """Return in words which of the limits of a joint are infinite."""
    lower, upper = np.isinf(stated)
    if lower and upper:
        return "no limits"
    return "no lower limit" if lower else "no upper limit"


def _note_tiny_ranges(description: Description) -> Iterator[str]:
    for joint in description.joints.values():
        if joint.kind != "revolute" or joint.limits is None:
            continue
        angle = float(np.ptp(joint.limits))
        if angle < _TINY_RANGE:
            unit = "are its limits in another unit (MJCF: `angle` of <compiler>)?"
            degrees = float(np.degrees(angle))
            yield f"joint '{joint.name}' has a range of only {degrees:.1g}°: {unit}"


class _Chooser:
    """Chooses limits from the shapes of an object with all joints at zero."""

    def __init__(self, description: Description) -> None:
        self.description = description
        self._surfaces = load_surfaces(description)
        self._placements = description.compute_placements()
        low, high = compute_bounds(description, self._surfaces)
        self._centre = (low + high) / 2.0
        self._shapes = list(self._make_shapes())

    def _make_shapes(self) -> Iterator[tuple[str, coal.CollisionGeometry, pin.SE3]]:
        """Yield link, shape, and its placement in the root's frame."""
        for name, link in self.description.links.items():
            for part in link.solid:
                if part.kind == "mesh":
                    vertices = self._surfaces[id(part)].vertices
                    yield name, make_convex_hull(vertices, about=name), self._placements[name]
                else:
                    solid = SOLIDS[part.kind](*part.size)
                    yield name, solid, self._placements[name] * part.placement

    def choose(self, child: str, stated: Limits) -> tuple[Limits, str]:
        """Return the limits of a joint, and the reason for a note.

        Args:
            child: Link that the joint carries.
            stated: Its stated limits, of which one or both are infinite.
        """
        joint = self.description.joints[child]
        away, travel = self._measure(child, joint)
        low, high = stated
        if np.isfinite(low) and low < 0.0:
            return (low, 0.0), ""
        if np.isfinite(high) and high > 0.0:
            return (0.0, high), ""
        if np.isfinite(low):
            return self._choose_other_limit(child, low, travel)
        if np.isfinite(high):
            return self._choose_other_limit(child, high, -travel)
        return self._choose_both_limits(child, away, travel)

    def _choose_other_limit(self, child: str, start: float, travel: float) -> tuple[Limits, str]:
        """Return limits from one, `start`, to the end of a travel with its sign, and a reason."""
        reached, blocker = self._follow(child, start, travel)
        if reached < _LEAST:
            reached = 1.0
            blocker = None
        end = start + reached * travel
        limits = (min(start, end), max(start, end))
        return limits, "" if blocker is None else f", up to '{blocker}'"

    def _choose_both_limits(self, child: str, away: float, travel: float) -> tuple[Limits, str]:
        """Return limits from 0 in the direction that is freer, and a reason.

        Args:
            child: Link that the joint carries.
            away: Sign of the direction away from the centre, which is preferred.
            travel: Travel of the joint, [rad] or [m].
        """
        reached, blocker = self._follow(child, 0.0, away * travel)
        reason = ", away from centre"
        if blocker is not None:
            other_reached, other_blocker = self._follow(child, 0.0, -away * travel)
            if max(reached, other_reached) < _LEAST:
                reached = 1.0
            elif other_reached > reached:
                reason = f", towards the centre, since '{blocker}' is in the other direction"
                away = -away
                reached = other_reached
                blocker = other_blocker
            if reached < 1.0:
                reason = f"{reason}, up to '{blocker}'"
        end = away * reached * travel
        return (min(0.0, end), max(0.0, end)), reason

    def _measure(self, child: str, joint: Joint) -> tuple[float, float]:
        """Return the sign of the direction away from the centre, and the travel, [rad] or [m]."""
        below = self.description.subtree(child)
        points = np.vstack(
            place_vertices(self.description, self._surfaces, self._placements, below)
        )
        middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
        axis = self._placements[child].rotation @ joint.axis
        if joint.kind == "revolute":
            direction = np.cross(axis, middle - self._placements[child].translation)
            travel = _OPEN
        else:
            direction = axis
            travel = _PULLED * float(np.ptp(points @ axis))
        sign = 1.0 if direction @ (middle - self._centre) >= 0.0 else -1.0
        return sign, travel

    def _follow(self, child: str, start: float, travel: float) -> tuple[float, str | None]:
        """Return the part of a travel before shapes meet, and the link that is met, if any.

        Shapes meet where they overlap more than at the start by `_TOUCH`.
        """
        below = self.description.subtree(child)
        moving = [shape for shape in self._shapes if shape[0] in below]
        others = [shape for shape in self._shapes if shape[0] not in below]
        boxes = [compute_world_box(solid, place) for _, solid, place in others]
        low = np.array([box[0] for box in boxes]).reshape(-1, 3)
        high = np.array([box[1] for box in boxes]).reshape(-1, 3)
        motion_at_start = self._compute_motion(child, start)
        start_depths = dict[tuple[int, int], float]()  # of pairs that have come near
        for step in range(1, _STEPS + 1):
            motion = self._compute_motion(child, start + travel * step / _STEPS)
            for m, (_, solid, place) in enumerate(moving):
                here = motion * place
                box_low, box_high = compute_world_box(solid, here)
                is_near = (low < box_high).all(axis=1) & (high > box_low).all(axis=1)
                for k in np.flatnonzero(is_near).tolist():
                    link, other, other_place = others[k]
                    depth = -compute_shape_distance(solid, here, other, other_place)
                    if depth <= _TOUCH:
                        continue
                    if (m, k) not in start_depths:
                        there = motion_at_start * place
                        distance = compute_shape_distance(solid, there, other, other_place)
                        start_depths[m, k] = max(0.0, -distance)
                    if depth > start_depths[m, k] + _TOUCH:
                        return (step - 1) / _STEPS, link
        return 1.0, None

    def _compute_motion(self, child: str, value: float) -> pin.SE3:
        """Return the displacement of the links that a joint carries, in the root's frame."""
        at_zero = self._placements[child]
        joint = self.description.joints[child]
        return at_zero * joint.compute_motion(value) * at_zero.inverse()
