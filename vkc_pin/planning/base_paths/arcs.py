"""Computes paths that a base on wheels can drive: corners connected by arcs.

From one corner to the next a pose (x, y, yaw) moves with a constant twist. The chord between two
poses of an arc points along the heading half-way between them, so that steps of any size do not
slip.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

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
        self.radius, self.turning = _RADIUS_FACTOR * radius, turning

    def compute_lengths(self, first: Floats, last: Floats) -> tuple[Floats, Floats]:
        """Return lengths [m] and turns [rad] of curves between poses, both (B, 3); (B,) each."""
        if self.radius > 0.0:
            goals = _express_in_start_frame(first, last, self.radius)
            return reeds_shepp.compute_lengths(goals, self.radius)
        turns = [np.abs(one) + np.abs(two) for one, two in self._turns(first, last)]
        return np.hypot(*(last - first)[:, :2].T), np.minimum(*turns)

    def compute_corners(self, first: Floats, last: Floats) -> Floats:
        """Return the corners of the curve between two poses, (3,) each, shape (K, 3).

        The final heading equals that of `last` up to full turns.
        """
        if self.radius <= 0.0:
            turn, rest = min(
                self._turns(first[None], last[None]), key=lambda turns: float(np.abs(turns).sum())
            )
            ahead = float(first[2] + turn[0])
            found = [
                first,
                np.array([*first[:2], ahead]),
                np.array([*last[:2], ahead]),
                np.array([*last[:2], ahead + float(rest[0])]),
            ]
        else:
            found = [first]
            goal = _express_in_start_frame(first[None], last[None], self.radius)[0]
            for length, angle in reeds_shepp.find_shortest_path_pieces(goal, self.radius):
                found.append(advance(found[-1], length, angle))
            if len(found) > 1:
                found[-1] = np.array([*last[:2], found[-1][2] + wrap_angle(last[2] - found[-1][2])])
        return np.array(
            [
                pose
                for k, pose in enumerate(found)
                if k == 0 or np.abs(pose - found[k - 1]).max() > _SAME
            ]
        )

    def fit(self, path: Floats, free: Callable[[Floats], bool]) -> Floats:
        """Return the corners, (K, 3), of collision-free curves along a path with turns in place.

        Each curve leads to the furthest place on the path's straight parts to which all poses are
        `free`, or else to the next place.
        """
        lengths = np.hypot(*np.diff(path[:, :2], axis=0).T)
        places = [
            interpolate_arcs(a[None], b[None], np.array([s]))[0]
            for a, b, s in _sample_places(path, lengths)
        ]
        places.append(path[-1])
        corners, k = path[:1], 0
        while k < len(places):
            for last in range(len(places) - 1, k - 1, -1):
                curve = self.compute_corners(corners[-1], places[last])
                if last == k or all(
                    map(free, sample_path(curve, _count_checks(curve), turning=self.turning)[:-1])
                ):
                    corners, k = np.vstack([corners, curve[1:]]), last + 1
                    break
        return corners

    def _turns(self, first: Floats, last: Floats) -> list[tuple[Floats, Floats]]:
        """Return the turns before and after a straight drive, ahead and backwards."""
        dx, dy = (last - first)[:, :2].T
        near = np.hypot(dx, dy) < _SAME
        there = np.where(near, first[:, 2], np.arctan2(dy, dx))
        found = []
        for back in (0.0, np.pi):
            before = np.where(near, 0.0, wrap_angle(there + back - first[:, 2]))
            found.append((before, wrap_angle(last[:, 2] - first[:, 2] - before)))
        return found


def advance(pose: Floats, length: float, turn: float) -> Floats:
    """Return the pose, (3,), at the end of an arc of given length [m, back < 0] and turn [rad]."""
    chord, heading = length * np.sinc(turn / (2 * np.pi)), pose[2] + turn / 2
    return np.array(
        [pose[0] + chord * np.cos(heading), pose[1] + chord * np.sin(heading), pose[2] + turn]
    )


def interpolate_arcs(first: Floats, last: Floats, share: Floats) -> Floats:
    """Return poses on arcs between `first` and `last`, (B, 3) each, at shares from 0 to 1, (B,)."""
    turn = (last - first)[:, 2]
    # The chord of a share s of an arc that turns by δ is sin(s·δ/2) / sin(δ/2) times the arc's own,
    # turned by (s − 1)·δ/2.
    ratio = share * np.sinc(share * turn / (2 * np.pi)) / np.sinc(turn / (2 * np.pi))
    cos, sin = ratio * np.cos((share - 1.0) * turn / 2), ratio * np.sin((share - 1.0) * turn / 2)
    dx, dy = (last - first)[:, :2].T
    return np.column_stack(
        [
            first[:, 0] + cos * dx - sin * dy,
            first[:, 1] + sin * dx + cos * dy,
            first[:, 2] + share * turn,
        ]
    )


def find_nearest_arc(first: Floats, last: Floats, *, radius: float, turning: float) -> Floats:
    """Return the poses nearest to `last` that an arc from `first`, (B, 3) each, reaches.

    `radius` [m] is the smallest one, `turning` the weight of heading errors [m/rad].
    """
    asked = (last - first)[:, 2:]
    off = np.linspace(-_MAX_TURN_CHANGE, _MAX_TURN_CHANGE, _TURN_SAMPLES)
    turn = np.concatenate([asked + off, 0.0 * asked], axis=1)
    dx, dy = (last - first)[:, 0:1], (last - first)[:, 1:2]
    heading = first[:, 2:] + turn / 2
    along = np.cos(heading) * dx + np.sin(heading) * dy
    aside = np.cos(heading) * dy - np.sin(heading) * dx
    error = (
        aside**2
        + (turning * (turn - asked)) ** 2
        + np.where(np.abs(along) + _SAME < radius * np.abs(turn), np.inf, 0.0)
    )
    at = np.arange(len(first)), np.argmin(error, axis=1)
    step = np.column_stack([(along * np.cos(heading))[at], (along * np.sin(heading))[at], turn[at]])
    return np.asarray(first + step)


def sample_path(corners: Floats, steps: int, *, turning: float) -> Floats:
    """Return poses along a path of arcs without its start, slow at both ends, shape (steps, 3).

    One is at each of the corners, (K, 3), if possible. `turning` is relative to driving [m/rad].
    """
    change = np.diff(corners, axis=0)
    if not len(change):
        return np.tile(corners[-1], (steps, 1))
    cost = np.hypot(change[:, 0], change[:, 1]) / np.sinc(
        change[:, 2] / (2 * np.pi)
    ) + turning * np.abs(change[:, 2])
    passed = np.concatenate([[0.0], np.cumsum(cost)]) / max(cost.sum(), _SAME)
    s = np.arange(steps + 1) / steps
    profile = (3.0 - 2.0 * s) * s**2
    if steps < len(change):
        at = np.interp(profile[1:], passed, np.arange(len(passed)))
    else:
        when = _round_ascending(np.interp(passed, profile, s) * steps, steps)
        legs = enumerate(itertools.pairwise(when.tolist()))
        at = np.concatenate(
            [np.interp(profile[a + 1 : b + 1], profile[[a, b]], [k, k + 1.0]) for k, (a, b) in legs]
        )
    piece = np.minimum(np.ceil(at - _SAME).astype(int), len(change)) - 1
    return interpolate_arcs(corners[piece], corners[piece + 1], at - piece)


def _sample_places(path: Floats, lengths: Floats) -> Iterator[tuple[Floats, Floats, float]]:
    """Yield places on the straight parts of a path: two corners, and the share between them."""
    for a, b, length in zip(path, path[1:], lengths, strict=False):
        count = int(np.ceil(length / _PLACE_SPACING)) if length > _SAME else 0
        yield from ((a, b, (k + 0.5) / count) for k in range(count))


def _count_checks(curve: Floats) -> int:
    """Return the number of poses at which a curve is checked."""
    return 1 + int(np.hypot(*np.diff(curve[:, :2], axis=0).T).sum() / _CHECK_SPACING)


def _round_ascending(when: Floats, steps: int) -> Ints:
    """Round ascending numbers to distinct integers from 0 to `steps`."""
    order = np.arange(len(when))
    # Each is at least 1 above its predecessor.
    found = np.maximum.accumulate(np.rint(when).astype(int) - order)
    found = np.minimum(found, steps - order[-1]) + order
    found[0] = 0
    return found


def _express_in_start_frame(first: Floats, last: Floats, radius: float) -> Floats:
    """Return poses `last` relative to `first`, both (B, 3), in units of a radius."""
    (dx, dy), yaw = (last - first)[:, :2].T, first[:, 2]
    x, y = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
    return np.column_stack([x / radius, y / radius, wrap_angle(last[:, 2] - yaw)])
