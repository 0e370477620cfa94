"""Samples keyframe configurations that satisfy pose constraints, and measures their shortfall."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.planning.base_paths.arcs import Curves, find_nearest_arc
from vkc_pin.planning.chain.inverse_kinematics import MAX_STEP, PoseSolver
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL

SIMILARITY_TOLERANCE = 0.1  # [m], [rad] within which configurations are treated as the same
SAMPLE_COUNT = 192  # random start configurations of inverse kinematics per keyframe
_PUSHING_STEPS = 10  # maximum number of steps out of collision
_SCATTER = (0.1, 2.0)  # standard deviations of scattered configurations, [m] and [rad]
_DAMPING = 3e-4  # added to the diagonal of their normal equations
_RowCache = dict[tuple[int, bytes], Floats]  # by waypoint and configuration


class KeyframeCache:
    """Results that the searches of one problem share.

    Searches with the same random seed start with the same configurations.

    Attributes:
        samples: Sampled keyframes, keyed by generator state, waypoint and start configurations.
            Values: samples, mask of feasible samples, generator state afterwards.
        shortfalls: Clearance shortfall, keyed by waypoint and configuration [m].
        pushed: Configuration after `KeyframeSampler.push_clear`, keyed in the same way.
        unreached: Base pose at the end of a phase that no path reached from where the phase before
            had ended, keyed by that waypoint, shape (3,).
    """

    def __init__(self) -> None:
        self.samples: dict[tuple[str, int, bytes], tuple[Floats, Bools, Any]] = {}
        self.shortfalls: _RowCache = {}
        self.pushed: _RowCache = {}
        self.unreached: dict[int, Floats] = {}


def _look_up_rows(
    known: _RowCache, compute: Callable[[Floats], Floats], z: Floats, waypoint: int
) -> Floats:
    """Return `compute(z)`, one result per row of z, computing only uncached rows."""
    if not len(z):
        return compute(z)
    keys = [(waypoint, row.tobytes()) for row in z]
    new = [k for k, key in enumerate(keys) if key not in known]
    if new:
        known.update(zip((keys[k] for k in new), compute(z[new]), strict=True))
    return np.array([known[key] for key in keys])


class KeyframeSampler:
    """Samples configurations for waypoints of a problem.

    Args:
        problem: Problem.
        rng: Random number generator.
        cache: Results of other searches of the problem. Default: an empty cache.

    Attributes:
        object_motion: Motion of the object joints, shape (N, n); the other columns are the start's.
        object_columns: Columns of the object joints.
        weights: Weight of each coordinate in distances, shape (n,).
        robot_size: Number of robot coordinates.
        curves: Curves that the base drives; None for a holonomic or fixed base.
    """

    def __init__(
        self,
        problem: TrajectoryProblem,
        rng: np.random.Generator,
        cache: KeyframeCache | None = None,
    ) -> None:
        self.problem, self.chain, self.rng = problem, problem.chain, rng
        self.cache = KeyframeCache() if cache is None else cache
        self.robot_size = self.chain.robot.coordinates.size
        self.weights = self.chain.metric.copy()
        # Also where a grasp slides.
        self.weights[[column for column, _, _ in problem.choices]] = 1.0
        rolling, lever = problem.rolling, self.chain.robot.lever
        self.curves = None if rolling.is_omnidirectional else Curves(rolling.turning_radius, lever)
        self.object_columns = np.array([self.chain.index(name) for name in problem.task.state], int)
        self.object_motion = interpolate_object_joints(problem, problem.still)

    def find_pose(self, waypoint: int) -> int | None:
        """Return the index of the pose constraint at a waypoint; None: at most a level one."""
        for k, pose in enumerate(self.problem.transcription.structure.poses):
            if waypoint in pose.waypoints and pose.kind != "level":
                return k
        return None

    def get_pose_solver(self, pose: int) -> tuple[PoseSolver, pin.SE3]:
        """Return the inverse kinematics solver of a pose constraint, and its target."""
        return self.problem.transcription.pose_solvers[pose], self.problem.targets[pose]

    def solve_pose(
        self, z: Floats, pose: int, lower: Floats, upper: Floats, **how: Any
    ) -> tuple[Floats, Bools]:
        """Solve a pose constraint for configurations, shape (B, n); see `PoseSolver.solve`."""
        solver, target = self.get_pose_solver(pose)
        how = {"tolerance": TOLERANCE, **how}
        return solver.solve(z, target, lower=lower, upper=upper, weights=self.weights, **how)

    def compute_residual(self, z: Floats, pose: int) -> Floats:
        """Return the largest residual of a pose constraint, shape (B,) [m] or [rad]."""
        solver, target = self.get_pose_solver(pose)
        return np.asarray(np.abs(solver.evaluate(z, target)[0]).max(axis=1))

    def sample(self, before: Floats, waypoint: int, how: str) -> tuple[Floats, Bools]:
        """Sample configurations for a waypoint.

        Args:
            before: Preceding configurations, shape (B, n).
            waypoint: Waypoint of the samples.
            how: "scatter": random configurations. "track": the nearest feasible ones. "shake": near
                `before` with randomly perturbed arms, so that the search can leave a dead end.

        Returns:
            Samples, shape (B, n); mask of those that satisfy the pose constraint, shape (B,).
        """
        if how != "scatter":
            return self._sample(before, waypoint, how)
        generator, known = self.rng.bit_generator, self.cache.samples
        key = (str(generator.state), waypoint, before.tobytes())
        if key not in known:
            known[key] = (*self._sample(before, waypoint, how), generator.state)
        z, found, generator.state = known[key]
        return z.copy(), found.copy()

    def _sample(self, before: Floats, waypoint: int, how: str) -> tuple[Floats, Bools]:
        z = before.copy()
        z[:, self.object_columns] = self.object_motion[waypoint - 1, self.object_columns]
        lower, upper = self.compute_limits(before, waypoint)
        pose = self.find_pose(waypoint)
        if pose is None:
            if how == "scatter" and self._is_blocked(np.clip(z, lower, upper), waypoint):
                z[1:] = self._scatter_robots(z[1:])
            return np.clip(z, lower, upper), np.ones(len(z), bool)
        # Random grasps; half of the arms near home, the others near the preceding configuration.
        if how == "scatter":
            phase = self.problem.task.phases[int(np.searchsorted(self.problem.ends, waypoint))]
            for name in (name for hold in phase.grasps for name in self.chain.virtual[hold]):
                column = self.chain.index(name)
                low, high = self.chain.lower[column], self.chain.upper[column]
                z[:, column] = self.rng.uniform(low, high, len(z))
            z[::2, 3 : self.robot_size] = self.chain.robot.home
        if how != "track":
            z = self._perturb_arms(z, pose, _SCATTER if how == "scatter" else (0.05, 0.5))
        z, found = self.solve_pose(z, pose, lower, upper)
        if how == "scatter":
            z = self._unwrap_angles(z, before, lower, upper)
        elif self.curves is not None and self.is_closed_at(waypoint):
            z, found = self._fit_base_to_arc(z, before, waypoint, pose)
        return z, found

    def _is_blocked(self, z: Floats, waypoint: int) -> bool:
        """Return whether all of some configurations, shape (B, n), are in collision."""
        return bool(self.compute_shortfall(np.unique(z, axis=0), waypoint).min() > 0.0)

    def _scatter_robots(self, z: Floats) -> Floats:
        """Perturb all coordinates of robots, by up to a few metres and radians, shape (B, n)."""
        spread, z = self.rng.uniform(*_SCATTER, (len(z), 1)), z.copy()
        z[:, : self.robot_size] += spread * self.rng.normal(size=(len(z), self.robot_size))
        return z

    def _fit_base_to_arc(
        self, z: Floats, before: Floats, waypoint: int, pose: int
    ) -> tuple[Floats, Bools]:
        """Move the bases to the nearest pose on an arc from `before`, if the arms still reach."""
        radius, turning = self.problem.rolling.turning_radius, self.chain.robot.lever
        near = z.copy()
        near[:, :3] = find_nearest_arc(before[:, :3], z[:, :3], radius=radius, turning=turning)
        lower, upper = self.compute_limits(before, waypoint)
        lower[:, :3] = upper[:, :3] = np.clip(near[:, :3], lower[:, :3], upper[:, :3])
        near, reached = self.solve_pose(near, pose, lower, upper)
        return np.where(reached[:, None], near, z), reached

    def is_closed_at(self, waypoint: int) -> bool:
        """Return whether the chain is closed in the phase of a waypoint."""
        phase = self.problem.contacts.find_phase(waypoint)
        return self.problem.is_closed(self.problem.task.phases[phase])

    def push_clear(self, z: Floats, waypoint: int) -> Floats:
        """Push configurations, shape (B, n), out of collision, which may fail."""
        pose = self.find_pose(waypoint)
        if pose is None:
            return z
        return _look_up_rows(
            self.cache.pushed, lambda rows: self._push_clear(rows, waypoint, pose), z, waypoint
        )

    def _push_clear(self, z: Floats, waypoint: int, pose: int) -> Floats:
        """Move configurations out of collision with a few damped Gauss-Newton steps.

        Each step drives the residuals of the pose to zero and violated contacts to their margins,
        both linearized: with the witness points fixed in their bodies, the gradient of a distance
        d = n·(b − a) is n·(∂b − ∂a). It aims at `Options.dist_safe` beyond the margins, considers
        the `Options.contact_slots` nearest contacts, and is limited to `MAX_STEP`.
        """
        problem, options = self.problem, self.problem.options
        lower, upper = self.compute_limits(z, waypoint)
        if self.curves is not None and self.is_closed_at(waypoint):
            lower[:, :3] = upper[:, :3] = z[:, :3]  # the base stays on its arc
        solver, target = self.get_pose_solver(pose)
        z, at, margin = z.copy(), np.arange(len(z)), options.dist_safe
        free, slots = (upper - lower > 1e-9) / self.weights, options.contact_slots
        for _ in range(_PUSHING_STEPS):
            if not len(at):
                break
            contacts = problem.contacts.evaluate(
                z[at],
                np.full(len(at), waypoint),
                reach=options.largest_margin + margin,
                nearest=slots,
            )
            residual, pose_rows = solver.evaluate(z[at], target)
            is_done = (contacts.compute_shortfall(len(at)) <= 0.0) & (
                np.abs(residual).max(axis=1) < TOLERANCE
            )
            # Gradients of the nearest distances, and their required increase [m].
            rows, growth = np.zeros((len(at), slots, z.shape[1])), np.zeros((len(at), slots))
            gradients = problem.contacts.compute_gradients(z[at], contacts)
            rows[contacts.waypoint, contacts.slot] = gradients
            growth[contacts.waypoint, contacts.slot] = np.maximum(
                contacts.margin + margin - contacts.distance, 0.0
            )
            jacobian = np.concatenate([pose_rows, rows], axis=1)
            wanted = np.concatenate([-residual, growth], axis=1)
            scaled = jacobian * free[at][:, None, :]
            system = scaled @ jacobian.transpose(0, 2, 1) + _DAMPING * np.eye(jacobian.shape[1])
            multipliers = np.linalg.solve(system, wanted[..., None])[..., 0]
            step = np.einsum("bij,bi->bj", scaled, multipliers)
            size = np.abs(step).max(axis=1, keepdims=True)
            step *= np.minimum(1.0, MAX_STEP / np.maximum(size, 1e-12))
            step[is_done] = 0.0
            z[at] = np.clip(z[at] + step, lower[at], upper[at])
            at = at[~is_done]
        return self.solve_pose(z, pose, lower, upper, iterations=3)[0]

    def compute_limits(self, before: Floats, waypoint: int) -> tuple[Floats, Floats]:
        """Return limits at a waypoint after configurations `before`, shape (B, n) each."""
        row, objects = waypoint - 1, self.object_columns
        lower, upper = (
            np.tile(limits[row], (len(before), 1))
            for limits in (self.problem.lower, self.problem.upper)
        )
        lower[:, objects] = upper[:, objects] = self.object_motion[row, objects]
        grasp = self.find_grasp_columns(waypoint)
        lower[:, grasp] = upper[:, grasp] = before[:, grasp]
        return lower, upper

    def find_grasp_columns(self, waypoint: int) -> list[int]:
        """Return the columns of grasp coordinates that an earlier grasp fixes at a waypoint."""
        return [column for column, grasp, last in self.problem.choices if grasp < waypoint <= last]

    def _perturb_arms(self, z: Floats, pose: int, deviations: tuple[float, float]) -> Floats:
        """Perturb the arms by a random deviation, and align the bases with a pose constraint."""
        spread, z = self.rng.uniform(*deviations, (len(z), 1)), z.copy()
        noise = self.rng.normal(0.0, 1.0, (len(z), self.robot_size - 3))
        z[:, 3 : self.robot_size] += spread * noise
        return self._align_bases(np.clip(z, self.chain.lower, self.chain.upper), pose)

    def _align_bases(self, z: Floats, pose: int) -> Floats:
        """Move the bases so that a pose constraint holds in position and heading.

        Height and tilt are left to the arm. A base motion multiplies the frame's placement from the
        left, so it equals the error T* T⁻¹, projected to the floor.
        """
        row, target = self.problem.transcription.structure.poses[pose], self.problem.targets[pose]
        rotations, translations = self.chain.joint_placements(z)
        rotation = rotations[:, row.joint] @ row.local.rotation
        translation = rotations[:, row.joint] @ row.local.translation + translations[:, row.joint]
        error = np.einsum("ij,bkj->bik", target.rotation, rotation)
        if row.kind == "pose":
            turn = np.arctan2(error[:, 1, 0] - error[:, 0, 1], error[:, 0, 0] + error[:, 1, 1])
        else:  # any heading will do
            turn = self.rng.uniform(-np.pi, np.pi, len(z))
        cos, sin = np.cos(turn), np.sin(turn)
        planar = np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)
        z = z.copy()
        z[:, :2] = target.translation[:2] + np.einsum(
            "bij,bj->bi", planar, z[:, :2] - translation[:, :2]
        )
        z[:, 2] += turn
        return z

    def _unwrap_angles(self, z: Floats, before: Floats, lower: Floats, upper: Floats) -> Floats:
        """Replace each revolute robot joint's angle by the equivalent one nearest to `before`."""
        turns = [
            column
            for column in range(2, self.robot_size)
            if self.problem.unit(self.chain.names[column]) != "m"
        ]
        z, angle, start = z.copy(), z[:, turns], before[:, turns]
        nearest = start + (angle - start + np.pi) % (2 * np.pi) - np.pi
        is_inside = (nearest >= lower[:, turns]) & (nearest <= upper[:, turns])
        z[:, turns] = np.where(is_inside, nearest, angle)
        return z

    def compute_shortfall(self, z: Floats, waypoint: int) -> Floats:
        """Return the clearance shortfall of each configuration, shape (B,) [m]."""
        return _look_up_rows(
            self.cache.shortfalls,
            lambda rows: compute_shortfall(self.problem, rows, waypoint),
            z,
            waypoint,
        )

    def has_free_keyframe(self, waypoint: int) -> bool:
        """Return whether a search found a collision-free, feasible configuration for a waypoint."""
        rows = [
            np.frombuffer(row)
            for (at, row), shortfall in self.cache.shortfalls.items()
            if at == waypoint and shortfall <= ACCEPTED_SHORTFALL
        ]
        pose = self.find_pose(waypoint)
        if pose is None or not rows:
            return bool(rows)
        return bool((self.compute_residual(np.array(rows), pose) < TOLERANCE).any())


def compute_shortfall(
    problem: TrajectoryProblem,
    z: Floats,
    waypoint: int,
    *,
    static: bool = True,
    reach: float | None = None,
) -> Floats:
    """Return the clearance shortfall of configurations at a waypoint, shape (B,) [m].

    Args:
        problem: Problem.
        z: Configurations, shape (B, n).
        waypoint: Waypoint of the configurations.
        static: Whether fixed obstacles count; otherwise only the robot itself and attached objects.
        reach: Largest distance of pairs that count [m]. Default: the largest margin.
    """
    reach = problem.options.largest_margin if reach is None else reach
    waypoints = np.full(len(z), waypoint)
    contacts = problem.contacts.evaluate(z, waypoints, reach=reach, nearest=1, static=static)
    return contacts.compute_shortfall(len(z))


def find_free_configurations(problem: TrajectoryProblem, z: Floats, waypoint: int) -> Bools:
    """Return which configurations keep the clearance that validation demands, shape (B,).

    Args:
        problem: Problem.
        z: Configurations, shape (B, n).
        waypoint: Waypoint of the configurations.
    """
    if not len(z):
        return np.zeros(0, bool)
    return np.asarray(compute_shortfall(problem, z, waypoint) <= ACCEPTED_SHORTFALL)


def sample_goal_configurations(
    problem: TrajectoryProblem, waypoint: int, rng: np.random.Generator
) -> tuple[Floats, Floats] | None:
    """Sample random configurations at the goal of a waypoint.

    Args:
        problem: Problem.
        waypoint: Waypoint of the goal.
        rng: Random number generator.

    Returns:
        Configurations, shape (B, n), and their residuals, shape (B,) [m] or [rad]; None if the
        waypoint has neither a pose constraint nor a fixed base position.
    """
    sampler = KeyframeSampler(problem, rng)
    pose = sampler.find_pose(waypoint)
    lower = problem.lower[waypoint - 1]
    upper = problem.upper[waypoint - 1]
    z = np.tile(problem.start, (SAMPLE_COUNT, 1))
    for column in sampler.find_grasp_columns(waypoint):  # the earlier grasp is free here
        low, high = np.clip([lower[column], upper[column]], -np.pi, np.pi)
        z[:, column] = rng.uniform(low, high, SAMPLE_COUNT)
    if pose is not None:
        z, found = sampler.sample(z, waypoint, "scatter")
        pushed = z.copy()
        pushed[found] = sampler.push_clear(z[found], waypoint)
        before, after = (sampler.compute_residual(rows, pose) for rows in (z, pushed))
        kept = after < TOLERANCE  # where the pushed configuration is still feasible
        return np.where(kept[:, None], pushed, z), np.where(kept, after, before)
    if (lower[:2] < upper[:2]).any():
        return None
    z[:, 2:] += rng.normal(0.0, 1.0, z[:, 2:].shape)
    return np.clip(z, lower, upper), np.zeros(len(z))


def sample_smoothstep(steps: int) -> Floats:
    """Return 3s² − 2s³, which starts and ends at rest, for s = 1/steps, ..., 1, shape (steps,)."""
    s = np.arange(1, steps + 1) / steps
    return s * s * (3.0 - 2.0 * s)


def interpolate_object_joints(problem: TrajectoryProblem, z: Floats) -> Floats:
    """Move the object joints in z, shape (N, n), to their goals phase by phase."""
    begin, current = 0, problem.start.copy()
    for phase, end in zip(problem.task.phases, problem.ends, strict=True):
        for name in phase.initial_values:
            column = problem.chain.index(name)
            goal = problem.lower[end - 1, column] if name in phase.values else current[column]
            z[begin:end, column] = current[column] + (goal - current[column]) * sample_smoothstep(
                end - begin
            )
            current[column] = goal
        begin = end
    return problem.clip(z)
