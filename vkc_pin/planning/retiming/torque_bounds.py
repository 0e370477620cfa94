"""Bounds the speed along a path by torque limits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.planning.retiming.topp_ra import PathSamples
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.torques import Torques, sample_curve

# Maximum slowdown; if even this does not suffice, the limits are exceeded at rest.
_MAX_SLOWDOWN = 10.0
_SLOWDOWNS = (1.0, 2.0, 4.0)  # slowdowns at which torques are sampled
_BISECTIONS = 40


class PathTorques(NamedTuple):
    """Torques at K positions of a path, relative to their limits, shape (K, m) each.

    At path velocity w and acceleration u the torque is

        τ(w, u) = static + viscous · w + quadratic · w² + inertial · u
    """

    static: Floats
    viscous: Floats
    quadratic: Floats
    inertial: Floats

    def linearize(self, speeds: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the coefficients of u, w² and 1, with w linearised in w² around `speeds`.

        Around a speed v, w ≈ v/2 + w²/(2v). Joints that exceed their limit at rest may stay at that
        torque plus one per cent.

        Args:
            speeds: Path velocities v, shape (K,).
        """
        slowest = 1e-3 * max(float(speeds.max()), 1e-9)  # at rest, v = 0, there is no tangent
        v = np.maximum(speeds, slowest)[:, None]
        static = self.static + 0.5 * self.viscous * v
        quadratic = self.quadratic + 0.5 * self.viscous / v
        scale = 1.0 / np.maximum(1.0, np.abs(self.static) * 1.01)
        return self.inertial * scale, quadratic * scale, static * scale


class TorqueBounds:
    """The torques of the arm during a run from rest to rest.

    Args:
        torques: Torques of the whole trajectory.
        phases: Phase of each step of the run, shape (m − 1,). Paths and curves of the run have the
            same number of cubics in each step.
    """

    def __init__(self, torques: Torques, phases: Ints) -> None:
        self._torques = torques
        self._phases = phases
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
        """Return the torques relative to their limits, shape (K, m).

        `pieces` are the cubics, of `n_pieces` in all, that the K moments belong to.
        """
        pieces_per_step = n_pieces // len(self._phases)
        phases = self._phases[pieces // pieces_per_step]
        torques = self._torques.at(phases, positions, velocities, accelerations)
        return torques[:, self._limited] / self._torques.torque_limits.limits[self._limited]

    def evaluate_along_path(self, path: CubicPath, samples: PathSamples) -> PathTorques:
        """Return the torques at S samples of a path.

        The coefficients follow from τ(1, 0), τ(2, 0), τ(3, 0) and τ(1, 1). At w and u the
        velocities of the coordinates are q′ w and their accelerations q′ u + q″ w².
        """
        n_pieces = len(path.x) - 1
        size = len(self._torques.trajectory.names)
        pieces = samples.cubics
        points = path(samples.positions, 0, pieces)[:, :size]
        tangents = path(samples.positions, 1, pieces)[:, :size]
        curvatures = path(samples.positions, 2, pieces)[:, :size]

        def compute_at(w: float) -> Floats:
            return self._compute_ratios(pieces, n_pieces, points, w * tangents, w**2 * curvatures)

        at_1 = compute_at(1.0)
        at_2 = compute_at(2.0)
        at_3 = compute_at(3.0)
        accelerated = self._compute_ratios(
            pieces, n_pieces, points, tangents, curvatures + tangents
        )
        return PathTorques(
            static=3.0 * at_1 - 3.0 * at_2 + at_3,
            viscous=0.5 * (8.0 * at_2 - 5.0 * at_1 - 3.0 * at_3),
            quadratic=0.5 * (at_3 - 2.0 * at_2 + at_1),
            inertial=accelerated - at_1,
        )

    def evaluate(self, curve: Curve) -> Floats:
        """Return the torque ratios at the ends and in the middle of each cubic, shape (K, m)."""
        moments = sample_curve(curve)
        return self._compute_ratios(
            moments.pieces,
            len(curve.times) - 1,
            moments.positions,
            moments.velocities,
            moments.accelerations,
        )

    def decompose(self, curve: Curve) -> tuple[Floats, Floats, Floats]:
        """Return the static, viscous and quadratic torques of a curve.

        A curve slowed down by k has the torques static + viscous / k + quadratic / k². Three
        slowdowns determine the three unknowns.
        """
        torques = []
        matrix = []
        for k in _SLOWDOWNS:
            slower = Curve(curve.times * k, curve.positions, curve.rates / k)
            torques.append(self.evaluate(slower))
            matrix.append([1.0, 1.0 / k, 1.0 / k**2])
        inverse = np.linalg.inv(np.array(matrix))
        static, viscous, quadratic = np.tensordot(inverse, np.array(torques), axes=1)
        return static, viscous, quadratic

    def slow_down(self, curve: Curve) -> Curve:
        """Return a curve slowed down to keep the torque limits; unchanged if that is impossible."""
        static, viscous, quadratic = self.decompose(curve)

        def is_within_limits(factor: float) -> bool:
            torques = static + viscous / factor + quadratic / factor**2
            return bool((np.abs(torques) <= 1.0).all())

        low = 1.0
        high = _MAX_SLOWDOWN
        if is_within_limits(low) or not is_within_limits(high):
            return curve
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            if is_within_limits(middle):
                high = middle
            else:
                low = middle
        return Curve(curve.times * high, curve.positions, curve.rates / high)
