"""How far a joint opens with a hand on what it moves, and how far the hand slides along what it holds and turns about it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.importing.proposals.candidates import Candidate
from vkc_pin.importing.proposals.fitting import Fitting
from vkc_pin.importing.proposals.ranking import Opening
from vkc_pin.world.models.articulated_object import Freedom

__all__ = ["Grip"]

Bools = NDArray[np.bool_]
_SLIDE, _TURN = 0.01, 0.2  # steps, [m] and [rad]
_LONGEST = 0.3  # [m]: no hand slides further to either side
_WORTH_SLIDING, _WORTH_TURNING = 0.02, 0.3  # ranges below these, [m] and [rad], are no freedom
_MOMENTS = 8  # of a joint on its way
_BAR = np.array([0.0, 1.0, 0.0])  # the bar, in the tool's frame


class Grip:
    """A hand that has room where it takes hold, and what it does from there.

    Args:
        fitting: The object and the hand; joints are where they are when the hand takes hold.
        grasp: The grasp.
        standoff: How far the tool stops before the grasp's middle [m].
    """

    def __init__(self, fitting: Fitting, grasp: Candidate, standoff: float) -> None:
        self._fitting, self._grasp = fitting, grasp
        self._offset = pin.SE3(np.eye(3), np.array([0.0, 0.0, -standoff]))
        self._state = fitting.state.copy()
        self._joint = int(
            fitting.item.model.frames[fitting.item.link_frame(grasp.piece.link)].parentJoint
        )
        self._angles = _TURN * np.arange(-round(1.6 / _TURN), round(1.6 / _TURN) + 1)
        self._angles = self._angles[np.abs(self._angles) <= grasp.round + 1e-9]
        half = fitting.hand.width / 2.0
        self._low = 0.0 - _marched(
            lambda way: self._free(-way, 0.0), min(_LONGEST, -grasp.span[0] - half)
        )
        self._high = _marched(lambda way: self._free(way, 0.0), min(_LONGEST, grasp.span[1] - half))
        self._turned = self._connected(self._all_free(), self._angles == 0.0)

    @property
    def slack(self) -> float:
        """How far the hand can slide to either side at least [m]."""
        return min(-self._low, self._high)

    def follow(self, opening: Opening) -> float:
        """Return how far a joint opens, [rad] or [m], before the hand has no room at any angle about the bar."""
        reached, where = opening.closed, self._connected(self._all_free(), self._angles == 0.0)
        start = float(self._state[opening.coordinate])
        for value in np.linspace(start, opening.opened, _MOMENTS + 1)[1:].tolist():
            state = self._state.copy()
            state[opening.coordinate] = value
            self._fitting.place(state)
            where = self._connected(self._all_free(), where)
            if not where.any():
                break
            reached, self._turned = value, self._turned | where
        self._fitting.place(self._state)
        return float(reached)

    def freedoms(self) -> tuple[str, tuple[Freedom, ...]]:
        """Return the kind of the virtual joint and its freedoms: what was free when the hand took hold or followed a joint."""
        turned = self._angles[self._turned]
        slides, turns = self._high - self._low >= _WORTH_SLIDING, np.ptp(turned) >= _WORTH_TURNING
        low, high = round(float(turned.min()), 6) + 0.0, round(float(turned.max()), 6) + 0.0
        if slides and turns:
            slide = Freedom("_slide", "prismatic", _BAR, self._low, self._high)
            return "cylindrical", (slide, Freedom("_turn", "revolute", _BAR, low, high))
        if slides:
            return "prismatic", (Freedom("", "prismatic", _BAR, self._low, self._high),)
        return ("revolute", (Freedom("", "revolute", _BAR, low, high),)) if turns else ("fixed", ())

    def _free(self, slide: float, turn: float) -> bool:
        tool = (
            self._fitting.joint(self._joint)
            * self._grasp.placement
            * pin.SE3(pin.exp3(_BAR * turn), _BAR * slide)
        )
        return self._fitting.find_obstruction(tool * self._offset, self._grasp.piece.link) is None

    def _all_free(self) -> Bools:
        return np.array([self._free(0.0, angle) for angle in self._angles])

    def _connected(self, free: Bools, start: Bools) -> Bools:
        """Return which free angles are reached from others without passing one that is not, shape (n,) of bools."""
        where, before = free & start, np.zeros_like(start)
        while (where != before).any():
            before = where.copy()
            where[1:] |= before[:-1]
            where[:-1] |= before[1:]
            where &= free
        return where


def _marched(free: Callable[[float], bool], furthest: float) -> float:
    """Return how far one can slide in steps before it is not free [m]."""
    count = 0
    while (count + 1) * _SLIDE <= furthest + 1e-9 and free((count + 1) * _SLIDE):
        count += 1
    return round(count * _SLIDE, 6) + 0.0
