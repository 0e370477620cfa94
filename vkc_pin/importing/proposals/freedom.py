"""Simulates how far a hand can follow a joint, and slide along or rotate about the grasped bar."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.importing.proposals.candidates import Candidate
from vkc_pin.importing.proposals.fitting import HandClearance
from vkc_pin.importing.proposals.ranking import Opening
from vkc_pin.world.models.articulated_object import Freedom

__all__ = ["GraspMotion"]

Bools = NDArray[np.bool_]
_SLIDE, _TURN = 0.01, 0.2  # steps, [m] and [rad]
_LONGEST = 0.3  # [m] largest slide to either side
_MIN_SLIDE, _MIN_TURN = 0.02, 0.3  # smallest ranges of a degree of freedom, [m] and [rad]
_SAMPLES = 8  # positions of a joint at which the clearance is checked
_BAR = np.array([0.0, 1.0, 0.0])  # direction of the bar in the tool frame


class GraspMotion:
    """Motion of a hand that grasps an object.

    Args:
        fitting: Clearance of the hand, with the object's joints at their positions when grasped.
        grasp: The grasp.
        standoff: Distance of the tool from the grasp's centre [m].
    """

    def __init__(self, clearance: HandClearance, grasp: Candidate, standoff: float) -> None:
        self._clearance, self._grasp = clearance, grasp
        self._offset = pin.SE3(np.eye(3), np.array([0.0, 0.0, -standoff]))
        self._state = clearance.state.copy()
        self._joint = int(
            clearance.item.model.frames[clearance.item.link_frame(grasp.piece.link)].parentJoint
        )
        self._angles = _TURN * np.arange(-round(1.6 / _TURN), round(1.6 / _TURN) + 1)
        self._angles = self._angles[np.abs(self._angles) <= grasp.round + 1e-9]
        half = clearance.hand.width / 2.0
        self._low = 0.0 - _march(
            lambda way: self._is_free(-way, 0.0), min(_LONGEST, -grasp.span[0] - half)
        )
        self._high = _march(
            lambda way: self._is_free(way, 0.0), min(_LONGEST, grasp.span[1] - half)
        )
        self._turned = self._grow(self._find_free_angles(), self._angles == 0.0)

    @property
    def slack(self) -> float:
        """Smaller of the slides to either side [m]."""
        return min(-self._low, self._high)

    def follow(self, opening: Opening) -> float:
        """Return how far a joint opens, [rad] or [m], before the hand is obstructed."""
        reached, reachable = (
            opening.closed,
            self._grow(self._find_free_angles(), self._angles == 0.0),
        )
        start = float(self._state[opening.coordinate])
        for value in np.linspace(start, opening.opened, _SAMPLES + 1)[1:].tolist():
            state = self._state.copy()
            state[opening.coordinate] = value
            self._clearance.place(state)
            reachable = self._grow(self._find_free_angles(), reachable)
            if not reachable.any():
                break
            reached, self._turned = value, self._turned | reachable
        self._clearance.place(self._state)
        return float(reached)

    def freedoms(self) -> tuple[str, tuple[Freedom, ...]]:
        """Return the kind of the virtual joint and its degrees of freedom.

        Their ranges are those in which the hand has clearance at the start or while it follows a
        joint.
        """
        angles = self._angles[self._turned]
        slides, turns = self._high - self._low >= _MIN_SLIDE, np.ptp(angles) >= _MIN_TURN
        low, high = round(float(angles.min()), 6) + 0.0, round(float(angles.max()), 6) + 0.0
        if slides and turns:
            slide = Freedom("_slide", "prismatic", _BAR, self._low, self._high)
            return "cylindrical", (slide, Freedom("_turn", "revolute", _BAR, low, high))
        if slides:
            return "prismatic", (Freedom("", "prismatic", _BAR, self._low, self._high),)
        return ("revolute", (Freedom("", "revolute", _BAR, low, high),)) if turns else ("fixed", ())

    def _is_free(self, slide: float, turn: float) -> bool:
        tool = (
            self._clearance.joint(self._joint)
            * self._grasp.placement
            * pin.SE3(pin.exp3(_BAR * turn), _BAR * slide)
        )
        return self._clearance.find_obstruction(tool * self._offset, self._grasp.piece.link) is None

    def _find_free_angles(self) -> Bools:
        return np.array([self._is_free(0.0, angle) for angle in self._angles])

    def _grow(self, free: Bools, start: Bools) -> Bools:
        """Return the free angles connected to `start` through free angles, masks of shape (n,)."""
        reachable, before = free & start, np.zeros_like(start)
        while (reachable != before).any():
            before = reachable.copy()
            reachable[1:] |= before[:-1]
            reachable[:-1] |= before[1:]
            reachable &= free
        return reachable


def _march(free: Callable[[float], bool], furthest: float) -> float:
    """Return how far the hand slides in steps before it is obstructed [m]."""
    count = 0
    while (count + 1) * _SLIDE <= furthest + 1e-9 and free((count + 1) * _SLIDE):
        count += 1
    return round(count * _SLIDE, 6) + 0.0
