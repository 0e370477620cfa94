"""Bounds the speed along a path by torque limits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.torques import Torques, sample_curve

# Maximum slowdown; if even this does not suffice, the limits are exceeded at rest.
_MAX_SLOWDOWN = 10.0
_SLOWDOWNS = (1.0, 2.0, 4.0)  # slowdowns at which torques are sampled
_BISECTIONS = 40


class PathTorques(NamedTuple):
    """Torques at K positions of a path, relative to their limits, shape (K, m) each.

    At path velocity w and acceleration u the torque is static + viscous · w + quadratic · w² +
    inertial · u.
    """

    static: Floats
    viscous: Floats
    quadratic: Floats
    inertial: Floats

    def linearize(self, speeds: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the coefficients of u, w² and 1, with w linearised in w² around `speeds`.

        Joints that exceed their limit at rest may stay at that torque plus one per cent.

        Args:
            speeds: Path velocities, shape (K,).
        """
        around = np.maximum(speeds, 1e-3 * max(float(speeds.max()), 1e-9))[:, None]
        static = self.static + 0.5 * self.viscous * around
        scale = 1.0 / np.maximum(1.0, np.abs(self.static) * 1.01)
        quadratic = self.quadratic + 0.5 * self.viscous / around
        return self.inertial * scale, quadratic * scale, static * scale


class TorqueBounds:
    """The torques of the arm during a run from rest to rest.

    Args:
        torques: Torques of the whole trajectory.
        phases: Phase of each step of the run, shape (m − 1,). Paths and curves of the run have the
            same number of cubics in each step.
    """

    def __init__(self, torques: Torques, phases: Ints) -> None:
        self._torques, self._phases = torques, phases
        self._rows: dict[bytes, PathTorques] = {}
        self._limited = np.flatnonzero(np.isfinite(torques.torque_limits.limits))

    def select_steps(self, first: int, count: int) -> TorqueBounds:
        """Return the torque bounds of some of the steps."""
        return TorqueBounds(self._torques, self._phases[first : first + count])

    def _compute_ratios(
        self,
        pieces: Ints,
        n_pieces: int,
        positions: Floats,
        velocities: Floats,
        accelerations: Floats,
    ) -> Floats:
        """Return the torques relative to their limits, shape (K, m)."""
        phases = self._phases[pieces // (n_pieces // len(self._phases))]
        torques = self._torques.at(phases, positions, velocities, accelerations)
        return torques[:, self._limited] / self._torques.torque_limits.limits[self._limited]

    def linearize(
        self, path: CubicPath, speed_positions: Floats, speeds: Floats, positions: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return the coefficients of `PathTorques.linearize` at positions of a path, shape (K,).

        `speeds` are those at `speed_positions`, shape (J,) each.
        """
        key = positions.tobytes()
        if key not in self._rows:
            self._rows[key] = self._evaluate_along_path(path, positions)
        return self._rows[key].linearize(np.sqrt(np.interp(positions, speed_positions, speeds**2)))

    def _evaluate_along_path(self, path: CubicPath, positions: Floats) -> PathTorques:
        n_pieces, size = len(path.x) - 1, len(self._torques.trajectory.names)
        pieces = np.clip(np.searchsorted(path.x, positions, side="right") - 1, 0, n_pieces - 1)
        points, tangents, curvatures = (path(positions, order)[:, :size] for order in range(3))
        at = [
            self._compute_ratios(pieces, n_pieces, points, w * tangents, w**2 * curvatures)
            for w in (1.0, 2.0, 3.0)
        ]
        pushed = self._compute_ratios(pieces, n_pieces, points, tangents, curvatures + tangents)
        return PathTorques(
            static=3.0 * at[0] - 3.0 * at[1] + at[2],
            viscous=0.5 * (8.0 * at[1] - 5.0 * at[0] - 3.0 * at[2]),
            quadratic=0.5 * (at[2] - 2.0 * at[1] + at[0]),
            inertial=pushed - at[0],
        )

    def evaluate(self, curve: Curve) -> Floats:
        """Return the torque ratios at the ends and in the middle of each cubic, shape (K, m)."""
        moments = sample_curve(curve)
        motion = moments.positions, moments.velocities, moments.accelerations
        return self._compute_ratios(moments.pieces, len(curve.times) - 1, *motion)

    def decompose(self, curve: Curve) -> tuple[Floats, Floats, Floats]:
        """Return the static, viscous and quadratic torques of a curve.

        A curve slowed down by k has the torques static + viscous / k + quadratic / k².
        """
        slowed = (Curve(curve.times * k, curve.positions, curve.rates / k) for k in _SLOWDOWNS)
        at = np.array([self.evaluate(curve) for curve in slowed])
        matrix = np.array([[1.0, 1.0 / k, 1.0 / k**2] for k in _SLOWDOWNS])
        static, viscous, quadratic = np.tensordot(np.linalg.inv(matrix), at, axes=1)
        return static, viscous, quadratic

    def slow_down(self, curve: Curve) -> Curve:
        """Return a curve slowed down to keep the torque limits; unchanged if that is impossible."""
        static, viscous, quadratic = self.decompose(curve)

        def is_within_limits(factor: float) -> bool:
            return bool((np.abs(static + viscous / factor + quadratic / factor**2) <= 1.0).all())

        low, high = 1.0, _MAX_SLOWDOWN
        if is_within_limits(low) or not is_within_limits(high):
            return curve
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if is_within_limits(middle) else (middle, high)
        return Curve(curve.times * high, curve.positions, curve.rates / high)
