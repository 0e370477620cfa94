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
    if rolling.turning_radius > 0.0 and (
        direction_changes := _find_direction_changes(points, rolling)
    ):
        pieces = [
            points[first : last + 1]
            for first, last in itertools.pairwise([0, *direction_changes, len(points) - 1])
        ]
    else:
        path, infeasible = _fit_without_stops(points, scale, limits, rolling, refinement)
        if len(points) == 2 or not infeasible.any():
            return [(path, points)]
        stop = _choose_stop(points, infeasible, rolling)
        pieces = [points[: stop + 1], points[stop:]]
    return [
        path
        for piece in pieces
        for path in fit_rolling_paths(piece, scale, limits, rolling, refinement)
    ]


def compute_slip(curve: Curve) -> float:
    """Return the largest lateral velocity of the base [m/s]."""
    moments = sample_intervals(curve.times, np.arange(_SAMPLES_PER_CUBIC) / _SAMPLES_PER_CUBIC)
    (vx, vy), yaw = curve.velocity(moments)[:, :2].T, curve.at(moments)[:, 2]
    _, aside = rotate_into_base_frame(vx, vy, yaw)
    return float(np.abs(aside).max())


def _find_direction_changes(points: Floats, rolling: RollingLimits) -> list[int]:
    """Return the waypoints between driving forward and backward, where a steered base stops."""
    ahead = rolling.compute_steps(points)[0] > 0.0
    return (1 + np.flatnonzero(ahead[1:] != ahead[:-1])).tolist()


def _choose_stop(points: Floats, infeasible: Bools, rolling: RollingLimits) -> int:
    """Return the end of an infeasible step at which the driving direction changes most."""
    along, _, turn = rolling.compute_steps(points)
    directions = np.column_stack([along, max(rolling.turning_radius, rolling.track / 2) * turn])
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    changes = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    return 1 + int(np.argmax(np.where(infeasible[1:] | infeasible[:-1], changes, -1.0)))


def _fit_without_stops(
    points: Floats,
    scale: Floats,
    limits: tuple[Floats, Floats],
    rolling: RollingLimits,
    refinement: int,
) -> tuple[CubicPath, Bools]:
    """Return a path without stops, see `fit_rolling_paths`, and a mask of infeasible steps."""
    along, _, turn = rolling.compute_steps(points)
    distance = np.concatenate([[0.0], np.cumsum(along / np.sinc(turn / (2 * np.pi)))])
    # it reverses only where its driving direction changes
    bounds = np.append(limits[0], np.inf), np.append(limits[1], -np.inf)
    path = fit_path(np.column_stack([points, distance]), np.append(scale, 0.0), bounds)
    parts = refinement * max(_MIN_PIECES, int(np.ceil(np.abs(turn).max() / _MAX_TURN_PER_PIECE)))
    slopes = path(path.x, 1)[:, [2, -1]]
    if rolling.turning_radius > 0.0:
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
    base, slopes, wheels = steps.evaluate_knots(gaps)
    half = rolling.track / 2 * np.array([-1.0, 1.0])
    values = np.column_stack([base, path(at)[:, 3:-1], wheels[0][:, None] + half * base[:, 2:]])
    rates = np.column_stack(
        [slopes, path(at, 1)[:, 3:-1], wheels[1][:, None] + half * slopes[:, 2:]]
    )
    return CubicPath(at, values, rates), (np.abs(gaps) > _MAX_GAP) | tight


def _compute_curvatures(turns: Floats, distances: Floats, radius: float) -> Floats:
    """Return path curvatures at waypoints, shape (m,) [rad/m], that avoid tight turns between them.

    A step of mean curvature κ, with a and b at its ends, has 3/2·κ − (a + b)/4 half-way: at most
    1/r if both are at least 3κ − 2/r. Otherwise the curvature is the mean of the adjacent steps'.
    """
    curvatures = radius * turns / np.where(np.abs(distances) > _MIN_DISTANCE, distances, np.inf)
    lower, upper = np.minimum(3.0 * curvatures - 2.0, 1.0), np.maximum(3.0 * curvatures + 2.0, -1.0)
    lengths = np.maximum(np.abs(distances), _MIN_DISTANCE)
    mean = (curvatures[:-1] * lengths[1:] + curvatures[1:] * lengths[:-1]) / (
        lengths[1:] + lengths[:-1]
    )
    inner = np.clip(mean, np.maximum(lower[:-1], lower[1:]), np.minimum(upper[:-1], upper[1:]))
    return np.concatenate([curvatures[:1], inner, curvatures[-1:]]) / radius


class _StepFitter:
    """Fits the steps of a base between poses (N + 1, 3), each parametrised by s from 0 to 1.

    `slopes`, shape (N + 1, 2), are derivatives of yaw and distance along the path.
    """

    def __init__(
        self, poses: Floats, slopes: Floats, spans: Floats, distances: Floats, parts: int
    ) -> None:
        self.poses, self.spans, self.parts = poses, spans[:, None], parts
        self.yaw_slopes, self.distance_slopes = (
            [column[:-1, None] * self.spans, column[1:, None] * self.spans] for column in slopes.T
        )
        self.distances = self._initial_distances = distances[:, None]
        self.distance_bumps, self.heading_bumps = np.zeros((2, len(distances), 1))
        nodes, weights = np.polynomial.legendre.leggauss(5)
        self._nodes = ((np.arange(parts)[:, None] + (nodes + 1) / 2) / parts).ravel()
        self._weights = np.tile(weights / (2 * parts), parts)

    def compute_heading(self, s: Floats) -> tuple[Floats, Floats]:
        """Return the yaw and its derivative at s, shape (K,): shape (N, K) each."""
        before, change = self.poses[:-1, 2:], np.diff(self.poses[:, 2:], axis=0)
        value, slope = _evaluate_hermite(s, change, *self.yaw_slopes)
        bump, bump_slope = _evaluate_bump(s)
        yaw = before + value + self.heading_bumps * bump
        return yaw, slope + self.heading_bumps * bump_slope

    def compute_distance(self, s: Floats) -> tuple[Floats, Floats]:
        """Return the distance driven in each step and its derivative at s, shape (N, K) each."""
        value, slope = _evaluate_hermite(s, self.distances, *self.distance_slopes)
        bump, bump_slope = _evaluate_bump(s)
        return value + self.distance_bumps * bump, slope + self.distance_bumps * bump_slope

    def fit(self) -> Floats:
        """Fit the steps to reach the next pose; return the remaining gaps, see `compute_gap`."""
        s, w = self._nodes, self._weights
        cost = np.array([0.0, _CLOSURE_SCALE**2, (_CLOSURE_SCALE * _HEADING_LEVER) ** 2])
        for _ in range(_NEWTON_ITERATIONS):
            direction, gap = np.exp(1j * self.compute_heading(s)[0]), self.compute_gap()
            bump, bump_slope = _evaluate_bump(s)
            columns = [
                direction @ (w * 6.0 * (s - s**2)),
                direction @ (w * bump_slope),
                1j * (self.compute_distance(s)[1] * direction) @ (w * bump),
            ]
            effects = np.stack(columns, axis=1)
            slopes = np.stack([effects.real, effects.imag], axis=1)
            bumps = [0.0 * self.distances, self.distance_bumps, self.heading_bumps]
            transposed, gap = np.swapaxes(slopes, 1, 2), np.stack([gap.real, gap.imag], axis=1)
            residual = (transposed @ gap[..., None])[..., 0] - cost * np.stack(bumps, axis=1)[
                ..., 0
            ]
            change = np.linalg.solve(transposed @ slopes + np.diag(cost), residual[..., None])
            self.distances = self.distances + change[:, 0]
            self.distance_bumps = self.distance_bumps + change[:, 1]
            self.heading_bumps = self.heading_bumps + change[:, 2]
            if np.abs(change).max() < 1e-12:
                break
        return self.compute_gap()

    def restore_arcs(self, which: Bools) -> Floats:
        """Undo `fit` for a mask of steps, (N,), whose arcs are accurate enough; return the gaps."""
        fitted = self.distances, self.distance_bumps, self.heading_bumps
        arcs = self._initial_distances, 0.0 * self.distance_bumps, 0.0 * self.heading_bumps
        self.distances, self.distance_bumps, self.heading_bumps = arcs
        restored = (which & (np.abs(self.compute_gap()) < _MAX_GAP_OF_ARC))[:, None]
        self.distances, self.distance_bumps, self.heading_bumps = (
            np.where(restored, new, old) for new, old in zip(arcs, fitted, strict=True)
        )
        return self.compute_gap()

    def compute_gap(self) -> Floats:
        """Return the gap between each step's end and the next pose, x + iy, shape (N,) [m]."""
        dx, dy = np.diff(self.poses[:, :2], axis=0).T
        return np.asarray(dx + 1j * dy - self._compute_velocity() @ self._weights)

    def _compute_velocity(self) -> Floats:
        direction = np.exp(1j * self.compute_heading(self._nodes)[0])
        return np.asarray(self.compute_distance(self._nodes)[1] * direction)

    def evaluate_knots(self, gaps: Floats) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
        """Return poses and distances at the knots, with their derivatives, gaps distributed."""
        s = np.arange(self.parts + 1) / self.parts
        pieces = (self._compute_velocity() * self._weights).reshape(len(gaps), self.parts, -1)
        travelled = np.cumsum(pieces.sum(axis=2), axis=1)
        travelled = np.concatenate([np.zeros((len(gaps), 1)), travelled], axis=1)
        begin = self.poses[:-1, :1] + 1j * self.poses[:-1, 1:2]
        place = begin + travelled + gaps[:, None] * (3.0 - 2.0 * s) * s**2
        (yaw, yaw_rate), (distance, speed) = self.compute_heading(s), self.compute_distance(s)
        start_distance = np.concatenate([[[0.0]], np.cumsum(self.distances, axis=0)[:-1]])
        velocity = speed * np.exp(1j * yaw)
        parts = (place.real, place.imag, yaw, start_distance + distance)
        values = [_concatenate_steps(part) for part in parts]
        rates = (velocity.real, velocity.imag, yaw_rate, speed)
        slopes = [_concatenate_steps(part / self.spans) for part in rates]
        return np.column_stack(values[:3]), np.column_stack(slopes[:3]), (values[3], slopes[3])

    def find_tight_steps(self, radius: float) -> Bools:
        """Return a mask of steps with a turning radius below `radius` [m], shape (N,)."""
        s = np.linspace(0.0, 1.0, 8 * self.parts + 1)
        (_, yaw_rate), (_, speed) = self.compute_heading(s), self.compute_distance(s)
        allowed = (1.0 + _RADIUS_TOLERANCE) * np.abs(speed) + 1e-9
        return np.asarray((radius * np.abs(yaw_rate) > allowed).any(axis=1))


def _evaluate_hermite(
    s: Floats, change: Floats, before: Floats, after: Floats
) -> tuple[Floats, Floats]:
    """Return cubics from 0 to `change` with given end slopes, and their derivatives, at s."""
    value = change * (3.0 - 2.0 * s) * s**2 + before * s * (1.0 - s) ** 2 - after * s**2 * (1.0 - s)
    slope = (
        change * 6.0 * (s - s**2)
        + before * (1.0 - 4.0 * s + 3.0 * s**2)
        + after * (3.0 * s**2 - 2.0 * s)
    )
    return value, slope


def _evaluate_bump(s: Floats) -> tuple[Floats, Floats]:
    """Return 16s²(1 − s)², which is flat at both ends and 1 half-way, and its derivative."""
    return 16.0 * (s * (1.0 - s)) ** 2, 32.0 * s * (1.0 - s) * (1.0 - 2.0 * s)


def _concatenate_steps(parts: Floats) -> Floats:
    """Return values at the knots of all steps, shape (N, parts + 1), without duplicates."""
    return np.append(parts[:, :-1].ravel(), parts[-1, -1])
