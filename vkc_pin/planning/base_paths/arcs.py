"""Computes paths that a base on wheels can drive: corners connected by arcs.

From one corner to the next a pose (x, y, yaw) moves with a constant twist. The chord between two
poses of an arc points along the heading half-way between them, so that steps of any size do not
slip.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from vkc_pin.planning.base_paths import reeds_shepp
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.models.coordinates import wrap_angle

_RADIUS_FACTOR = 1.02  # chords of steps of 0.7 rad are 2 % shorter than their arcs
_TURN_SAMPLES = 81  # turns that are compared
_MAX_TURN_CHANGE = 0.8  # [rad] largest deviation from the requested turn
_SAME = 1e-9
_PLACE_SPACING = 0.5  # [m] largest spacing of places on a path
_CHECK_SPACING = 0.1  # [m] spacing of collision checks along a curve


class Curves:
    """Shortest curves of a base on wheels between poses, without obstacles.

    Args:
        radius: Smallest turning radius [m]. 0: turn in place, drive straight, turn in place.
            Otherwise: Reeds-Shepp curves.
        turning: Cost of turning, relative to driving [m/rad].
    """

    def __init__(self, radius: float, turning: float) -> None:
        self.radius = _RADIUS_FACTOR * radius
        self.turning = turning

    def compute_lengths(self, first: Floats, last: Floats) -> tuple[Floats, Floats]:
        """Return lengths [m] and turns [rad] of curves between poses, both (B, 3); (B,) each."""
        if self.radius > 0.0:
            goals = _express_in_start_frame(first, last, self.radius)
            return reeds_shepp.compute_lengths(goals, self.radius)
        ahead, backwards = self._list_turns(first, last)
        turns_ahead = np.abs(ahead[0]) + np.abs(ahead[1])
        turns_backwards = np.abs(backwards[0]) + np.abs(backwards[1])
        dx, dy = (last - first)[:, :2].T
        return np.hypot(dx, dy), np.minimum(turns_ahead, turns_backwards)

    def compute_corners(self, first: Floats, last: Floats) -> Floats:
        """Return the corners of the curve between two poses, (3,) each, shape (K, 3).

        The final heading equals that of `last` up to full turns.
        """
        if self.radius > 0.0:
            poses = self._list_reeds_shepp_poses(first, last)
        else:
            poses = self._list_poses_with_turns_in_place(first, last)
        corners = [first]
        for before, pose in itertools.pairwise(poses):
            if np.abs(pose - before).max() > _SAME:
                corners.append(pose)
        return np.array(corners)

    def _list_poses_with_turns_in_place(self, first: Floats, last: Floats) -> list[Floats]:
        """Return poses before and after each turn and drive; consecutive ones may be equal."""
        turns = self._list_turns(first[None], last[None])
        before, after = min(turns, key=lambda pair: float(np.abs(pair).sum()))
        yaw = float(first[2] + before[0])
        return [
            first,
            np.array([*first[:2], yaw]),
            np.array([*last[:2], yaw]),
            np.array([*last[:2], yaw + float(after[0])]),
        ]

    def _list_reeds_shepp_poses(self, first: Floats, last: Floats) -> list[Floats]:
        """Return poses at the ends of all pieces; the last one is exact."""
        poses = [first]
        goal = _express_in_start_frame(first[None], last[None], self.radius)[0]
        for length, angle in reeds_shepp.find_shortest_path_pieces(goal, self.radius):
            poses.append(advance(poses[-1], length, angle))
        if len(poses) > 1:
            yaw = poses[-1][2]
            poses[-1] = np.array([*last[:2], yaw + wrap_angle(last[2] - yaw)])
        return poses

    def fit(self, path: Floats, free: Callable[[Floats], bool]) -> Floats:
        """Return the corners, (K, 3), of collision-free curves along a path with turns in place.

        Each curve leads to the furthest place on the path's straight parts to which all poses are
        `free`, or else to the next place.
        """
        places = _sample_places(path)
        corners = path[:1]
        k = 0  # next place
        while k < len(places):
            for last in range(len(places) - 1, k - 1, -1):
                curve = self.compute_corners(corners[-1], places[last])
                if last == k or self._is_curve_free(curve, free):
                    corners = np.vstack([corners, curve[1:]])
                    k = last + 1
                    break
        return corners

    def _is_curve_free(self, curve: Floats, free: Callable[[Floats], bool]) -> bool:
        """Return whether all poses on a curve, but its last one, are free."""
        poses = sample_path(curve, _count_checks(curve), turning=self.turning)
        return all(free(pose) for pose in poses[:-1])

    def _list_turns(self, first: Floats, last: Floats) -> list[tuple[Floats, Floats]]:
        """Return the turns before and after a straight drive, ahead and backwards."""
        dx, dy = (last - first)[:, :2].T
        is_same_place = np.hypot(dx, dy) < _SAME
        direction = np.where(is_same_place, first[:, 2], np.arctan2(dy, dx))
        turns = []
        for reversal in (0.0, np.pi):
            turn = wrap_angle(direction + reversal - first[:, 2])
            before = np.where(is_same_place, 0.0, turn)
            after = wrap_angle(last[:, 2] - first[:, 2] - before)
            turns.append((before, after))
        return turns


def advance(pose: Floats, length: float, turn: float) -> Floats:
    """Return the pose, (3,), at the end of an arc of given length [m, back < 0] and turn [rad].

    The chord of an arc of length ℓ that turns by δ is ℓ sin(δ/2) / (δ/2) long, along the heading
    half-way.
    """
    chord = length * np.sinc(turn / (2 * np.pi))
    heading = pose[2] + turn / 2
    x = pose[0] + chord * np.cos(heading)
    y = pose[1] + chord * np.sin(heading)
    return np.array([x, y, pose[2] + turn])


def interpolate_arcs(first: Floats, last: Floats, s: Floats) -> Floats:
    """Return poses on arcs between `first` and `last`, (B, 3) each, at s from 0 to 1, (B,).

    The chord of a fraction s of an arc that turns by δ is sin(s·δ/2) / sin(δ/2) times the arc's
    own, turned by (s − 1)·δ/2.
    """
    turn = (last - first)[:, 2]
    ratio = s * np.sinc(s * turn / (2 * np.pi)) / np.sinc(turn / (2 * np.pi))
    cos = ratio * np.cos((s - 1.0) * turn / 2)
    sin = ratio * np.sin((s - 1.0) * turn / 2)
    dx, dy = (last - first)[:, :2].T
    x = first[:, 0] + cos * dx - sin * dy
    y = first[:, 1] + sin * dx + cos * dy
    return np.column_stack([x, y, first[:, 2] + s * turn])


def find_nearest_arc(first: Floats, last: Floats, *, radius: float, turning: float) -> Floats:
    """Return the poses nearest to `last` that an arc from `first`, (B, 3) each, reaches.

    `radius` [m] is the smallest one, `turning` the weight of heading errors [m/rad]. For each of
    some turns δ, the nearest arc has the chord that is the projection of the displacement onto the
    heading half-way.
    """
    requested = (last - first)[:, 2:]
    changes = np.linspace(-_MAX_TURN_CHANGE, _MAX_TURN_CHANGE, _TURN_SAMPLES)
    straight = 0.0 * requested
    turn = np.concatenate([requested + changes, straight], axis=1)
    dx = (last - first)[:, 0:1]
    dy = (last - first)[:, 1:2]
    heading = first[:, 2:] + turn / 2
    along = np.cos(heading) * dx + np.sin(heading) * dy
    aside = np.cos(heading) * dy - np.sin(heading) * dx
    is_too_tight = np.abs(along) + _SAME < radius * np.abs(turn)
    error = aside**2 + (turning * (turn - requested)) ** 2 + np.where(is_too_tight, np.inf, 0.0)
    best = (np.arange(len(first)), np.argmin(error, axis=1))
    step_x = (along * np.cos(heading))[best]
    step_y = (along * np.sin(heading))[best]
    return np.asarray(first + np.column_stack([step_x, step_y, turn[best]]))


def sample_path(corners: Floats, steps: int, *, turning: float) -> Floats:
    """Return poses along a path of arcs without its start, slow at both ends, shape (steps, 3).

    One is at each of the corners, (K, 3), if possible. `turning` is relative to driving [m/rad].
    """
    change = np.diff(corners, axis=0)
    if not len(change):
        return np.tile(corners[-1], (steps, 1))
    arc_lengths = np.hypot(change[:, 0], change[:, 1]) / np.sinc(change[:, 2] / (2 * np.pi))
    cost = arc_lengths + turning * np.abs(change[:, 2])
    passed = np.concatenate([[0.0], np.cumsum(cost)]) / max(cost.sum(), _SAME)
    s = np.arange(steps + 1) / steps
    profile = (3.0 - 2.0 * s) * s**2
    if steps < len(change):
        at = np.interp(profile[1:], passed, np.arange(len(passed)))
    else:
        # The steps at which the corners are passed, and in between the profile of each piece.
        corner_steps = _round_ascending(np.interp(passed, profile, s) * steps, steps)
        parts = []
        for k, (a, b) in enumerate(itertools.pairwise(corner_steps.tolist())):
            parts.append(np.interp(profile[a + 1 : b + 1], profile[[a, b]], [k, k + 1.0]))
        at = np.concatenate(parts)
    piece = np.minimum(np.ceil(at - _SAME).astype(int), len(change)) - 1
    return interpolate_arcs(corners[piece], corners[piece + 1], at - piece)


def _sample_places(path: Floats) -> list[Floats]:
    """Return poses on the straight parts of a path, and its end."""
    places = []
    for a, b in itertools.pairwise(path):
        length = np.hypot(*(b - a)[:2])
        if length <= _SAME:
            continue
        count = int(np.ceil(length / _PLACE_SPACING))
        for k in range(count):
            s = np.array([(k + 0.5) / count])
            places.append(interpolate_arcs(a[None], b[None], s)[0])
    places.append(path[-1])
    return places


def _count_checks(curve: Floats) -> int:
    """Return the number of poses at which a curve is checked."""
    dx, dy = np.diff(curve[:, :2], axis=0).T
    return 1 + int(np.hypot(dx, dy).sum() / _CHECK_SPACING)


def _round_ascending(numbers: Floats, steps: int) -> Ints:
    """Round ascending numbers to distinct integers from 0 to `steps`."""
    order = np.arange(len(numbers))
    # Each is at least 1 above its predecessor.
    rounded = np.maximum.accumulate(np.rint(numbers).astype(int) - order)
    rounded = np.minimum(rounded, steps - order[-1]) + order
    rounded[0] = 0
    return rounded


def _express_in_start_frame(first: Floats, last: Floats, radius: float) -> Floats:
    """Return poses `last` relative to `first`, both (B, 3), in units of a radius."""
    dx, dy = (last - first)[:, :2].T
    yaw = first[:, 2]
    x = np.cos(yaw) * dx + np.sin(yaw) * dy
    y = np.cos(yaw) * dy - np.sin(yaw) * dx
    return np.column_stack([x / radius, y / radius, wrap_angle(last[:, 2] - yaw)])
