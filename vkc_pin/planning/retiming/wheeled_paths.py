"""Fits smooth paths through waypoints on which a wheeled base rolls everywhere."""

from __future__ import annotations

import itertools

import numpy as np

from vkc_pin.planning.retiming.cubic_path import CubicPath
from vkc_pin.planning.retiming.spline_path import fit_path
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.trajectory.curve import Curve, sample_intervals
from vkc_pin.world.trajectory.wheels import RollingLimits, rotate_into_base_frame

_MIN_PIECES = 3  # per step
_MAX_TURN_PER_PIECE = 0.05  # [rad]
_NEWTON_ITERATIONS = 12
# Position error that costs as much as a unit bump of the distance; it keeps rounding errors from
# causing bumps where the base stands still.
_CLOSURE_SCALE = 1e-3
_HEADING_LEVER = 0.5  # [m/rad], ratio of the costs of heading and distance bumps
_SAMPLES_PER_CUBIC = 8
_MIN_DISTANCE = 1e-9  # [m], shorter distances count as standing still
_MAX_GAP = 1e-5  # [m], allowed position error; it is distributed over the step
# [m], position error that does not justify a bump that makes a turn too tight
_MAX_GAP_OF_ARC = 2e-6
_RADIUS_TOLERANCE = 3e-4  # relative tolerance of the minimum turning radius, for rounding


def fit_rolling_paths(
    points: Floats,
    scale: Floats,
    limits: tuple[Floats, Floats],
    rolling: RollingLimits,
    refinement: int = 1,
) -> list[tuple[CubicPath, Floats]]:
    """Return paths through waypoints on which a base rolls, one from each stop to the next.

    The distance driven ℓ, the heading θ and all other coordinates are cubic between waypoints; the
    position is the integral of (cos θ, sin θ) dℓ. To reach the next waypoint, Newton's method
    adjusts the step length and bumps of ℓ and θ, multiples of 16s²(1 − s)². The knots are so close
    that cubics through them roll, too. A steered base stops where passing from arc to arc would
    exceed its curvature limit. A path of a single step is the arc itself.

    Args:
        points: (x, y, yaw) of the base, and other coordinates, shape (m, n), m ≥ 2; the base can
            drive along the arcs between them.
        scale: Weight of each coordinate in the length, shape (n,).
        limits: Lower and upper limits, shape (n,) each.
        rolling: Limits of the base.
        refinement: Factor for the number of knots.

    Returns:
        Paths with their waypoints; the travel of left and right wheels [m] follows the n
        coordinates.
    """
    stops = list[int]()
    if rolling.turning_radius > 0.0:
        stops = _find_direction_changes(points, rolling)
    if not stops:
        path, infeasible = _fit_without_stops(points, scale, limits, rolling, refinement)
        if len(points) == 2 or not infeasible.any():
            return [(path, points)]
        stops = [_choose_stop(points, infeasible, rolling)]
    paths = []
    for first, last in itertools.pairwise([0, *stops, len(points) - 1]):
        piece = points[first : last + 1]
        paths += fit_rolling_paths(piece, scale, limits, rolling, refinement)
    return paths


def compute_slip(curve: Curve) -> float:
    """Return the largest lateral velocity of the base [m/s]."""
    moments = sample_intervals(curve.times, np.arange(_SAMPLES_PER_CUBIC) / _SAMPLES_PER_CUBIC)
    vx, vy = curve.velocity(moments)[:, :2].T
    yaw = curve.at(moments)[:, 2]
    _, aside = rotate_into_base_frame(vx, vy, yaw)
    return float(np.abs(aside).max())


def _find_direction_changes(points: Floats, rolling: RollingLimits) -> list[int]:
    """Return the waypoints between driving forward and backward, where a steered base stops."""
    along, _, _ = rolling.compute_steps(points)
    is_forward = along > 0.0
    return (1 + np.flatnonzero(is_forward[1:] != is_forward[:-1])).tolist()


def _choose_stop(points: Floats, infeasible: Bools, rolling: RollingLimits) -> int:
    """Return the end of an infeasible step at which the driving direction changes most.

    The direction is the unit vector of the displacements ahead and by turning, as travel of wheels.
    """
    along, _, turn = rolling.compute_steps(points)
    lever = max(rolling.turning_radius, rolling.track / 2)
    directions = np.column_stack([along, lever * turn])
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    changes = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    is_end_of_infeasible = infeasible[1:] | infeasible[:-1]
    return 1 + int(np.argmax(np.where(is_end_of_infeasible, changes, -1.0)))


def _fit_without_stops(
    points: Floats,
    scale: Floats,
    limits: tuple[Floats, Floats],
    rolling: RollingLimits,
    refinement: int,
) -> tuple[CubicPath, Bools]:
    """Return a path without stops, see `fit_rolling_paths`, and a mask of infeasible steps."""
    along, _, turn = rolling.compute_steps(points)
    # An arc that turns by δθ is longer than its chord by the factor δθ/2 / sin(δθ/2), and sinc(x)
    # is sin(πx)/(πx).
    arcs = along / np.sinc(turn / (2 * np.pi))
    distance = np.concatenate([[0.0], np.cumsum(arcs)])
    # The bounds of the distance are empty: to exceed its values at the waypoints is to exceed them,
    # so that it reverses only where its driving direction changes.
    bounds = (np.append(limits[0], np.inf), np.append(limits[1], -np.inf))
    path = fit_path(np.column_stack([points, distance]), np.append(scale, 0.0), bounds)
    pieces_by_turn = int(np.ceil(np.abs(turn).max() / _MAX_TURN_PER_PIECE))
    parts = refinement * max(_MIN_PIECES, pieces_by_turn)
    slopes = path(path.x, 1)[:, [2, -1]]
    if rolling.turning_radius > 0.0:
        # dθ/ds = dθ/dℓ · dℓ/ds, with the curvature dθ/dℓ
        curvatures = _compute_curvatures(turn, np.diff(distance), rolling.turning_radius)
        slopes[:, 0] = curvatures * slopes[:, 1]
    steps = _StepFitter(points[:, :3], slopes, np.diff(path.x), np.diff(distance), parts)
    # A single arc reaches its end up to rounding; bumps that correct this would make short steps
    # turn too tightly.
    gaps = steps.compute_gap() if len(points) == 2 else steps.fit()
    tight = steps.find_tight_steps(rolling.turning_radius)
    if rolling.turning_radius > 0.0 and tight.any():
        gaps = steps.restore_arcs(tight)
        tight = steps.find_tight_steps(rolling.turning_radius)
    at = sample_intervals(path.x, np.arange(parts) / parts, last=True)
    base, base_slopes, (travel, travel_slopes) = steps.evaluate_knots(gaps)
    # The left and right wheel, a track b apart, travel ℓ ∓ b/2 θ.
    levers = rolling.track / 2 * np.array([-1.0, 1.0])
    wheels = travel[:, None] + levers * base[:, 2:]
    wheel_slopes = travel_slopes[:, None] + levers * base_slopes[:, 2:]
    values = np.column_stack([base, path(at)[:, 3:-1], wheels])
    rates = np.column_stack([base_slopes, path(at, 1)[:, 3:-1], wheel_slopes])
    infeasible = (np.abs(gaps) > _MAX_GAP) | tight
    return CubicPath(at, values, rates), infeasible


def _compute_curvatures(turns: Floats, distances: Floats, radius: float) -> Floats:
    """Return path curvatures at waypoints, shape (m,) [rad/m], that avoid tight turns between them.

    A step of mean curvature κ, with a and b at its ends, has 3/2·κ − (a + b)/4 half-way: at most
    1/r if both are at least 3κ − 2/r. Otherwise the curvature is the mean of the adjacent steps'.

    Args:
        turns: Change of the heading in each step, shape (m − 1,) [rad].
        distances: Distance driven in each step, shape (m − 1,) [m], negative backward.
        radius: Minimum turning radius r [m].
    """
    relative = radius * turns / np.where(np.abs(distances) > _MIN_DISTANCE, distances, np.inf)  # κr
    lower = np.minimum(3.0 * relative - 2.0, 1.0)
    upper = np.maximum(3.0 * relative + 2.0, -1.0)
    lengths = np.maximum(np.abs(distances), _MIN_DISTANCE)
    # At the common end of two steps, their curvatures interpolated between the steps' middles.
    weighted = relative[:-1] * lengths[1:] + relative[1:] * lengths[:-1]
    mean = weighted / (lengths[1:] + lengths[:-1])
    inner_lower = np.maximum(lower[:-1], lower[1:])
    inner_upper = np.minimum(upper[:-1], upper[1:])
    inner = np.clip(mean, inner_lower, inner_upper)
    return np.concatenate([relative[:1], inner, relative[-1:]]) / radius


class _StepFitter:
    """Fits the steps of a base between poses (N + 1, 3), each parametrised by s from 0 to 1.

    In each step heading and distance are θ(s) and ℓ(s), and the position is the complex number

        x + iy = x₀ + iy₀ + ∫ e^{iθ(s)} ℓ′(s) ds

    integrated by Gauss-Legendre quadrature in each of `parts` equal parts.

    Args:
        poses: (x, y, yaw) at the ends of the steps, shape (N + 1, 3).
        slopes: Derivatives of yaw and distance along the path, shape (N + 1, 2).
        spans: Length of each step along the path, dpath/ds, shape (N,).
        distances: Distance driven in each step, shape (N,) [m].
        parts: Number of cubics of each step.
    """

    def __init__(
        self, poses: Floats, slopes: Floats, spans: Floats, distances: Floats, parts: int
    ) -> None:
        self.poses = poses
        self.spans = spans[:, None]
        self.parts = parts
        # Derivatives by s at the begin and at the end of each step.
        self._begin_slopes = slopes[:-1, None] * self.spans[..., None]
        self._end_slopes = slopes[1:, None] * self.spans[..., None]
        self._initial_distances = distances[:, None]
        self.distances = self._initial_distances
        self.distance_bumps = np.zeros((len(distances), 1))
        self.heading_bumps = np.zeros((len(distances), 1))
        nodes, weights = np.polynomial.legendre.leggauss(5)  # on [-1, 1]
        self._nodes = ((np.arange(parts)[:, None] + (nodes + 1) / 2) / parts).ravel()
        self._weights = np.tile(weights / (2 * parts), parts)

    def compute_heading(self, s: Floats) -> tuple[Floats, Floats]:
        """Return the yaw and its derivative at s, shape (K,): shape (N, K) each."""
        before = self.poses[:-1, 2:]
        change = np.diff(self.poses[:, 2:], axis=0)
        begin = self._begin_slopes[..., 0]
        end = self._end_slopes[..., 0]
        value, slope = _evaluate_hermite(s, change, begin, end)
        bump, bump_slope = _evaluate_bump(s)
        yaw = before + value + self.heading_bumps * bump
        return yaw, slope + self.heading_bumps * bump_slope

    def compute_distance(self, s: Floats) -> tuple[Floats, Floats]:
        """Return the distance driven in each step and its derivative at s, shape (N, K) each."""
        begin = self._begin_slopes[..., 1]
        end = self._end_slopes[..., 1]
        value, slope = _evaluate_hermite(s, self.distances, begin, end)
        bump, bump_slope = _evaluate_bump(s)
        distance = value + self.distance_bumps * bump
        return distance, slope + self.distance_bumps * bump_slope

    def fit(self) -> Floats:
        """Fit the steps to reach the next pose; return the remaining gaps, see `compute_gap`.

        The parameters p of a step are its distance and the bumps of ℓ and θ. With the gap g(p) to
        the next pose and the costs c of the bumps (none of the distance), Gauss-Newton steps

            (JᵀJ + diag(c)) δp = Jᵀg − diag(c) p,   J = −∂g/∂p

        lead to the minimum of |g|² + Σ c p². The columns of J, as complex numbers, are the
        integrals of e^{iθ} ∂ℓ′/∂p and of i ℓ′ e^{iθ} ∂θ/∂p.
        """
        s = self._nodes
        w = self._weights
        cost = np.array([0.0, _CLOSURE_SCALE**2, (_CLOSURE_SCALE * _HEADING_LEVER) ** 2])
        bump, bump_slope = _evaluate_bump(s)
        for _ in range(_NEWTON_ITERATIONS):
            heading, _ = self.compute_heading(s)
            _, speed = self.compute_distance(s)
            direction = np.exp(1j * heading)
            by_distance = direction @ (w * 6.0 * (s - s**2))
            by_distance_bump = direction @ (w * bump_slope)
            by_heading_bump = 1j * (speed * direction) @ (w * bump)
            effects = np.stack([by_distance, by_distance_bump, by_heading_bump], axis=1)
            jacobian = np.stack([effects.real, effects.imag], axis=1)
            transposed = np.swapaxes(jacobian, 1, 2)
            complex_gap = self.compute_gap()
            gap = np.stack([complex_gap.real, complex_gap.imag], axis=1)[..., None]
            no_cost = 0.0 * self.distances
            bumps = np.stack([no_cost, self.distance_bumps, self.heading_bumps], axis=1)
            residual = (transposed @ gap)[..., 0] - cost * bumps[..., 0]
            matrix = transposed @ jacobian + np.diag(cost)
            change = np.linalg.solve(matrix, residual[..., None])
            self.distances = self.distances + change[:, 0]
            self.distance_bumps = self.distance_bumps + change[:, 1]
            self.heading_bumps = self.heading_bumps + change[:, 2]
            if np.abs(change).max() < 1e-12:
                break
        return self.compute_gap()

    def restore_arcs(self, which: Bools) -> Floats:
        """Undo `fit` for a mask of steps, (N,), whose arcs are accurate enough; return the gaps."""
        fitted_distances = self.distances
        fitted_distance_bumps = self.distance_bumps
        fitted_heading_bumps = self.heading_bumps
        # without bumps the steps are arcs
        self.distances = self._initial_distances
        self.distance_bumps = 0.0 * fitted_distance_bumps
        self.heading_bumps = 0.0 * fitted_heading_bumps
        is_accurate = np.abs(self.compute_gap()) < _MAX_GAP_OF_ARC
        restored = (which & is_accurate)[:, None]
        self.distances = np.where(restored, self.distances, fitted_distances)
        self.distance_bumps = np.where(restored, self.distance_bumps, fitted_distance_bumps)
        self.heading_bumps = np.where(restored, self.heading_bumps, fitted_heading_bumps)
        return self.compute_gap()

    def compute_gap(self) -> Floats:
        """Return the gap between each step's end and the next pose, x + iy, shape (N,) [m]."""
        dx, dy = np.diff(self.poses[:, :2], axis=0).T
        return np.asarray(dx + 1j * dy - self._compute_velocity() @ self._weights)

    def _compute_velocity(self) -> Floats:
        """Return e^{iθ} ℓ′ at the nodes of the quadrature, shape (N, K), complex."""
        heading, _ = self.compute_heading(self._nodes)
        _, speed = self.compute_distance(self._nodes)
        return np.asarray(speed * np.exp(1j * heading))

    def evaluate_knots(self, gaps: Floats) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
        """Evaluate the steps at their knots, with the gaps distributed over them.

        Returns:
            Poses and their derivatives along the path, shape (K, 3) each, and the distances driven
            and their derivatives, shape (K,) each.
        """
        s = np.arange(self.parts + 1) / self.parts
        displacements = (self._compute_velocity() * self._weights).reshape(
            len(gaps), self.parts, -1
        )
        travelled = np.cumsum(displacements.sum(axis=2), axis=1)
        travelled = np.concatenate([np.zeros((len(gaps), 1)), travelled], axis=1)
        begin = self.poses[:-1, :1] + 1j * self.poses[:-1, 1:2]
        place = begin + travelled + gaps[:, None] * (3.0 - 2.0 * s) * s**2
        yaw, yaw_rate = self.compute_heading(s)
        distance, speed = self.compute_distance(s)
        velocity = speed * np.exp(1j * yaw)
        start_distance = np.concatenate([[[0.0]], np.cumsum(self.distances, axis=0)[:-1]])
        poses = np.column_stack(
            [_concatenate_steps(part) for part in (place.real, place.imag, yaw)]
        )
        slopes = np.column_stack(
            [
                _concatenate_steps(rate / self.spans)
                for rate in (velocity.real, velocity.imag, yaw_rate)
            ]
        )
        distances = _concatenate_steps(start_distance + distance)
        distance_slopes = _concatenate_steps(speed / self.spans)
        return poses, slopes, (distances, distance_slopes)

    def find_tight_steps(self, radius: float) -> Bools:
        """Return a mask of steps with a turning radius below `radius` [m], shape (N,)."""
        s = np.linspace(0.0, 1.0, _SAMPLES_PER_CUBIC * self.parts + 1)
        _, yaw_rate = self.compute_heading(s)
        _, speed = self.compute_distance(s)
        # r |dθ/ds| ≤ |dℓ/ds|
        allowed = (1.0 + _RADIUS_TOLERANCE) * np.abs(speed) + _MIN_DISTANCE
        return np.asarray((radius * np.abs(yaw_rate) > allowed).any(axis=1))


def _evaluate_hermite(
    s: Floats, change: Floats, before: Floats, after: Floats
) -> tuple[Floats, Floats]:
    """Return cubics from 0 to `change` with given end slopes, and their derivatives, at s."""
    value = change * (3.0 - 2.0 * s) * s**2 + before * s * (1.0 - s) ** 2 - after * s**2 * (1.0 - s)
    # of 3s² − 2s³, s − 2s² + s³ and s³ − s²
    slope = (
        change * 6.0 * (s - s**2)
        + before * (1.0 - 4.0 * s + 3.0 * s**2)
        + after * (3.0 * s**2 - 2.0 * s)
    )
    return value, slope


def _evaluate_bump(s: Floats) -> tuple[Floats, Floats]:
    """Return 16s²(1 − s)², which is flat at both ends and 1 half-way, and its derivative."""
    bump = 16.0 * (s * (1.0 - s)) ** 2
    slope = 32.0 * s * (1.0 - s) * (1.0 - 2.0 * s)
    return bump, slope


def _concatenate_steps(parts: Floats) -> Floats:
    """Return values at the knots of all steps, shape (N, parts + 1), without duplicates."""
    return np.append(parts[:, :-1].ravel(), parts[-1, -1])
