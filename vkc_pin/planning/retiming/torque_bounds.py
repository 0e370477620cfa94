"""How torques bound the speed along a path."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.dynamics.torques import Torques, sample_curve

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

__all__ = ["Load", "Rows"]

_SLOWEST = 10.0  # times as long: what takes more is too heavy but for rounding
_FACTORS = (1.0, 2.0, 4.0)  # times as long at which torques are looked at
_HALVINGS = 40


class Rows(NamedTuple):
    """Torques along a path at K places, as shares of their limits, shape (K, m) each.

    At a path velocity w and acceleration u they are still + drag · w + square · w² + push · u.
    """

    still: Floats
    drag: Floats
    square: Floats
    push: Floats

    def linear(self, speeds: Floats) -> tuple[Floats, Floats, Floats]:
        """Return factors of u, of w² and of 1 for the same, with w replaced by its tangent in w² at some speeds, shape (K,).

        Joints that are at their limit already, whatever the speed, have as much more as it takes to
        stay there.
        """
        around = np.maximum(speeds, 1e-3 * max(float(speeds.max()), 1e-9))[:, None]
        still = self.still + 0.5 * self.drag * around
        scale = 1.0 / np.maximum(1.0, np.abs(self.still) * 1.01)
        return self.push * scale, (self.square + 0.5 * self.drag / around) * scale, still * scale


class Load:
    """The torques of the arm on a run from rest to rest.

    Args:
        torques: Of the whole motion.
        phases: For each step of the run the phase that it is part of, shape (m − 1,). Its paths and
            curves have the same number of cubics in each step.
    """

    def __init__(self, torques: Torques, phases: Ints) -> None:
        self._torques, self._phases = torques, phases
        self._rows: dict[bytes, Rows] = {}
        self._limited = np.flatnonzero(np.isfinite(torques.torque_limits.limits))

    def part(self, first: int, count: int) -> Load:
        """Return those of some of its steps."""
        return Load(self._torques, self._phases[first : first + count])

    def _shares(
        self, pieces: Ints, of: int, positions: Floats, velocities: Floats, accelerations: Floats
    ) -> Floats:
        """Return shares of limits, shape (K, m), of the pieces, shape (K,), of a path or curve that has so many of them."""
        found = self._torques.at(
            self._phases[pieces // (of // len(self._phases))], positions, velocities, accelerations
        )
        return found[:, self._limited] / self._torques.torque_limits.limits[self._limited]

    def linear(
        self, path: CubicHermiteSpline, known: Floats, speeds: Floats, places: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return the torques at some places on the path as `Rows.linear` does.

        Args:
            path: The path.
            known: Where speeds are known, shape (J,).
            speeds: About what they will be there, shape (J,).
            places: Where the torques are asked for, shape (K,).
        """
        key = places.tobytes()
        if key not in self._rows:
            self._rows[key] = self._along_path(path, places)
        return self._rows[key].linear(np.sqrt(np.interp(places, known, speeds**2)))

    def _along_path(self, path: CubicHermiteSpline, places: Floats) -> Rows:
        of, size = len(path.x) - 1, len(self._torques.trajectory.names)
        pieces = np.clip(np.searchsorted(path.x, places, side="right") - 1, 0, of - 1)
        points, tangents, bends = (path(places, order)[:, :size] for order in range(3))
        at = [self._shares(pieces, of, points, w * tangents, w**2 * bends) for w in (1.0, 2.0, 3.0)]
        still, drag = (
            3.0 * at[0] - 3.0 * at[1] + at[2],
            0.5 * (8.0 * at[1] - 5.0 * at[0] - 3.0 * at[2]),
        )
        push = self._shares(pieces, of, points, tangents, bends + tangents) - at[0]
        return Rows(still, drag, 0.5 * (at[2] - 2.0 * at[1] + at[0]), push)

    def of(self, curve: Curve) -> Floats:
        """Return the torques at the ends and in the middle of every cubic of a curve, shape (K, m)."""
        moments = sample_curve(curve)
        motion = moments.positions, moments.velocities, moments.accelerations
        return self._shares(moments.pieces, len(curve.times) - 1, *motion)

    def split(self, curve: Curve) -> tuple[Floats, Floats, Floats]:
        """Return still, drag and square with torques still + drag / k + square / k² if a curve took k times as long."""
        at = np.array(
            [self.of(Curve(curve.times * k, curve.positions, curve.rates / k)) for k in _FACTORS]
        )
        matrix = np.array([[1.0, 1.0 / k, 1.0 / k**2] for k in _FACTORS])
        still, drag, square = np.tensordot(np.linalg.inv(matrix), at, axes=1)
        return still, drag, square

    def slowed(self, curve: Curve) -> Curve:
        """Return a curve slower by the factor that it takes to keep the torques; as it is, if no factor does."""
        still, drag, square = self.split(curve)

        def kept(factor: float) -> bool:
            return bool((np.abs(still + drag / factor + square / factor**2) <= 1.0).all())

        low, high = 1.0, _SLOWEST
        if kept(low) or not kept(high):
            return curve
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if kept(middle) else (middle, high)
        return Curve(curve.times * high, curve.positions, curve.rates / high)
