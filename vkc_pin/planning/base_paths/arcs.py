"""Paths that a base on wheels can drive: corners joined by arcs, which is what straight drives and turns in place are, too.

From one corner to the next a pose (x, y, yaw) moves with a constant twist. Along such an arc the
chord between any two poses points where the base heads half-way between them, so that steps of any
size neither slip nor, by more than the arc itself, turn.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np

from vkc_pin.planning.base_paths.motion_primitives import wrapped
from vkc_pin.planning.base_paths.reeds_shepp import lengths_of, shortest_words
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["Curves", "between", "nearest_arc", "spread_along"]

_WIDER = 1.02  # of the least radius: the chords of a step of 0.7 rad are 2 % shorter than the arc
_TRIED = 81  # turns, from which the best is taken
_MOST = 0.8  # [rad] by which an arc may turn less or more than asked for
_SAME = 1e-9
_PLACES = 0.5  # [m] between places on a path, at most
_LOOK = 0.1  # [m] between poses of a curve that are looked at


class Curves:
    """The curves by which a base on wheels gets from one pose to another where nothing is in the way.

    Args:
        radius: The least radius of its turns [m]; 0: it turns in place, drives straight, and turns
            in place again. Otherwise curves are the shortest of Reeds and Shepp.
        turning: How many metres of driving a radian of turning is worth [m/rad].
    """

    def __init__(self, radius: float, turning: float) -> None:
        self.radius, self.turning = _WIDER * radius, turning

    def lengths(self, first: Floats, last: Floats) -> tuple[Floats, Floats]:
        """Return how far curves from poses to others, both (B, 3), lead [m] and turn [rad], shape (B,) each."""
        if self.radius > 0.0:
            return lengths_of(_seen(first, last, self.radius), self.radius)
        turns = [np.abs(one) + np.abs(two) for one, two in self._turns(first, last)]
        return np.hypot(*(last - first)[:, :2].T), np.minimum(*turns)

    def corners(self, first: Floats, last: Floats) -> Floats:
        """Return the corners of the curve from one pose to another, both (3,), shape (K, 3): at the last all but whole turns."""
        if self.radius <= 0.0:
            (turn, rest) = min(
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
            for length, angle in shortest_words(
                _seen(first[None], last[None], self.radius)[0], self.radius
            ):
                found.append(moved(found[-1], length, angle))
            if len(found) > 1:
                found[-1] = np.array([*last[:2], found[-1][2] + wrapped(last[2] - found[-1][2])])
        return np.array(
            [
                pose
                for k, pose in enumerate(found)
                if k == 0 or np.abs(pose - found[k - 1]).max() > _SAME
            ]
        )

    def through(self, path: Floats, free: Callable[[Floats], bool]) -> Floats:
        """Return the corners of curves along a path with turns in place, shape (K, 3), as few as are free, the first as it is.

        From where it has come to, a curve leads to the furthest place on the path to which one is
        free, or else to the next, free or not. Places are the middles of its straight parts, and
        others on them.

        Args:
            path: Its corners, shape (L, 3).
            free: Whether the base is, at a pose of shape (3,).
        """
        lengths = np.hypot(*np.diff(path[:, :2], axis=0).T)
        places = [between(a[None], b[None], np.array([s]))[0] for a, b, s in _on(path, lengths)]
        places.append(path[-1])
        corners, k = path[:1], 0
        while k < len(places):
            for last in range(len(places) - 1, k - 1, -1):
                curve = self.corners(corners[-1], places[last])
                if last == k or all(
                    map(free, spread_along(curve, _looks(curve), turning=self.turning)[:-1])
                ):
                    corners, k = np.vstack([corners, curve[1:]]), last + 1
                    break
        return corners

    def _turns(self, first: Floats, last: Floats) -> list[tuple[Floats, Floats]]:
        """Return the turns before and after driving straight ahead, and those before and after driving straight back."""
        dx, dy = (last - first)[:, :2].T
        near = np.hypot(dx, dy) < _SAME
        there = np.where(near, first[:, 2], np.arctan2(dy, dx))
        found = []
        for back in (0.0, np.pi):
            before = np.where(near, 0.0, wrapped(there + back - first[:, 2]))
            found.append((before, wrapped(last[:, 2] - first[:, 2] - before)))
        return found


def moved(pose: Floats, length: float, turn: float) -> Floats:
    """Return the pose, shape (3,), at the end of an arc of a length [m, back < 0] that turns by an angle [rad]."""
    chord, heading = length * np.sinc(turn / (2 * np.pi)), pose[2] + turn / 2
    return np.array(
        [pose[0] + chord * np.cos(heading), pose[1] + chord * np.sin(heading), pose[2] + turn]
    )


def between(first: Floats, last: Floats, share: Floats) -> Floats:
    """Return the poses at shares of the way between poses with a constant twist; all (B, 3), shares (B,)."""
    turn = (last - first)[:, 2]
    # Chords of shares s of an arc that turns by δ are sin(s·δ/2) / sin(δ/2) of its own, and turned
    # by (s − 1)·δ/2.
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


def nearest_arc(first: Floats, last: Floats, *, radius: float, turning: float) -> Floats:
    """Return the poses nearest to `last` to which an arc leads from `first`, both (B, 3).

    Args:
        first: Where arcs begin.
        last: Where they should end.
        radius: Their least radius [m].
        turning: How many metres an error of a radian counts [m/rad].
    """
    asked = (last - first)[:, 2:]
    off = np.linspace(-_MOST, _MOST, _TRIED)
    turn = np.concatenate([asked + off, 0.0 * asked], axis=1)
    dx, dy = (last - first)[:, 0:1], (last - first)[:, 1:2]
    heading = first[:, 2:] + turn / 2
    along, aside = (
        np.cos(heading) * dx + np.sin(heading) * dy,
        np.cos(heading) * dy - np.sin(heading) * dx,
    )
    error = (
        aside**2
        + (turning * (turn - asked)) ** 2
        + np.where(np.abs(along) + _SAME < radius * np.abs(turn), np.inf, 0.0)
    )
    at = np.arange(len(first)), np.argmin(error, axis=1)
    step = np.column_stack([(along * np.cos(heading))[at], (along * np.sin(heading))[at], turn[at]])
    return np.asarray(first + step)


def spread_along(corners: Floats, steps: int, *, turning: float) -> Floats:
    """Return `steps` poses along a path, shape (steps, 3), without its first: slow at both ends, and one at each corner.

    Args:
        corners: Of the path, shape (K, 3).
        steps: How many.
        turning: How many metres of driving take as long as turning by one radian [m/rad].
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
        when = _whole(np.interp(passed, profile, s) * steps, steps)
        legs = enumerate(itertools.pairwise(when.tolist()))
        at = np.concatenate(
            [np.interp(profile[a + 1 : b + 1], profile[[a, b]], [k, k + 1.0]) for k, (a, b) in legs]
        )
    piece = np.minimum(np.ceil(at - _SAME).astype(int), len(change)) - 1
    return between(corners[piece], corners[piece + 1], at - piece)


def _on(path: Floats, lengths: Floats) -> Iterator[tuple[Floats, Floats, float]]:
    """Yield places on the straight parts of a path: between which corners, and at which share of the way."""
    for a, b, length in zip(path, path[1:], lengths, strict=False):
        count = int(np.ceil(length / _PLACES)) if length > _SAME else 0
        yield from ((a, b, (k + 0.5) / count) for k in range(count))


def _looks(curve: Floats) -> int:
    """Return at how many poses a curve is looked at."""
    return 1 + int(np.hypot(*np.diff(curve[:, :2], axis=0).T).sum() / _LOOK)


def _whole(when: Floats, steps: int) -> Ints:
    """Return ascending whole numbers near `when`, ascending itself, from 0 to `steps`, no two of them equal."""
    order = np.arange(len(when))
    found = np.maximum.accumulate(
        np.rint(when).astype(int) - order
    )  # each at least 1 after the one before
    found = np.minimum(found, steps - order[-1]) + order
    found[0] = 0
    return found


def _seen(first: Floats, last: Floats, radius: float) -> Floats:
    """Return poses as poses see them, both (B, 3), in units of a radius."""
    (dx, dy), yaw = (last - first)[:, :2].T, first[:, 2]
    x, y = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
    return np.column_stack([x / radius, y / radius, wrapped(last[:, 2] - yaw)])
