"""Samples keyframe configurations that satisfy pose constraints, and measures their shortfall."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.planning.base_paths.arcs import Curves, find_nearest_arc
from vkc_pin.planning.chain.inverse_kinematics import MAX_STEP, PoseSolver
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL

SIMILARITY_TOLERANCE = 0.1  # [m], [rad] within which configurations are treated as the same
SAMPLE_COUNT = 192  # random start configurations of inverse kinematics per keyframe
_PUSHING_STEPS = 10  # maximum number of steps out of collision
# least and largest standard deviations of configurations [m] and [rad]
_SCATTER = (0.1, 2.0)
_SHAKE = (0.05, 0.5)
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
    new_rows = [k for k, key in enumerate(keys) if key not in known]
    if new_rows:
        new_keys = [keys[k] for k in new_rows]
        known.update(zip(new_keys, compute(z[new_rows]), strict=True))
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
        problem: KinematicProblem,
        rng: np.random.Generator,
        cache: KeyframeCache | None = None,
    ) -> None:
        self.problem = problem
        self.chain = problem.chain
        self.rng = rng
        self.cache = KeyframeCache() if cache is None else cache
        self.robot_size = self.chain.robot.coordinates.size
        self.weights = self.chain.metric.copy()
        # Also where a grasp slides.
        self.weights[[column for column, _, _ in problem.choices]] = 1.0
        self.curves: Curves | None = None
        if not problem.rolling.is_omnidirectional:
            self.curves = Curves(problem.rolling.turning_radius, self.chain.robot.lever)
        self.object_columns = np.array([self.chain.index(name) for name in problem.task.state], int)
        self.object_motion = interpolate_object_joints(problem, problem.still)

    def find_pose(self, waypoint: int) -> int | None:
        """Return the index of the pose constraint at a waypoint; None: at most a level one."""
        for k, goal in enumerate(self.problem.pose_goals):
            if waypoint in goal.row.waypoints and goal.row.kind != "level":
                return k
        return None

    def get_pose_solver(self, pose: int) -> tuple[PoseSolver, pin.SE3]:
        """Return the inverse kinematics solver of a pose constraint, and its target."""
        return self.problem.pose_solvers[pose], self.problem.targets[pose]

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
        residual, _ = solver.evaluate(z, target)
        return np.asarray(np.abs(residual).max(axis=1))

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
        generator = self.rng.bit_generator
        known = self.cache.samples
        key = (str(generator.state), waypoint, before.tobytes())
        if key not in known:
            z, is_feasible = self._sample(before, waypoint, how)
            known[key] = (z, is_feasible, generator.state)
        z, is_feasible, state = known[key]
        generator.state = state
        return z.copy(), is_feasible.copy()

    def _sample(self, before: Floats, waypoint: int, how: str) -> tuple[Floats, Bools]:
        """Sample configurations for a waypoint, uncached; see `sample`."""
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
            for hold in phase.grasps:
                for name in self.chain.virtual[hold]:
                    column = self.chain.index(name)
                    low = self.chain.lower[column]
                    high = self.chain.upper[column]
                    z[:, column] = self.rng.uniform(low, high, len(z))
            z[::2, 3 : self.robot_size] = self.chain.robot.home
            z = self._perturb_arms(z, pose, _SCATTER)
        elif how == "shake":
            z = self._perturb_arms(z, pose, _SHAKE)
        z, is_feasible = self.solve_pose(z, pose, lower, upper)
        if how == "scatter":
            z = self._unwrap_angles(z, before, lower, upper)
        elif self.curves is not None and self.is_closed_at(waypoint):
            z, is_feasible = self._fit_base_to_arc(z, before, waypoint, pose)
        return z, is_feasible

    def _is_blocked(self, z: Floats, waypoint: int) -> bool:
        """Return whether all of some configurations, shape (B, n), are in collision."""
        return bool(self.compute_shortfall(np.unique(z, axis=0), waypoint).min() > 0.0)

    def _scatter_robots(self, z: Floats) -> Floats:
        """Perturb all coordinates of robots, by up to a few metres and radians, shape (B, n)."""
        deviations = self.rng.uniform(*_SCATTER, (len(z), 1))
        noise = self.rng.normal(size=(len(z), self.robot_size))
        z = z.copy()
        z[:, : self.robot_size] += deviations * noise
        return z

    def _fit_base_to_arc(
        self, z: Floats, before: Floats, waypoint: int, pose: int
    ) -> tuple[Floats, Bools]:
        """Move the bases to the nearest pose on an arc from `before`, if the arms still reach."""
        on_arc = z.copy()
        on_arc[:, :3] = find_nearest_arc(
            before[:, :3],
            z[:, :3],
            radius=self.problem.rolling.turning_radius,
            turning=self.chain.robot.lever,
        )
        lower, upper = self.compute_limits(before, waypoint)
        bases = np.clip(on_arc[:, :3], lower[:, :3], upper[:, :3])
        lower[:, :3] = bases
        upper[:, :3] = bases
        on_arc, is_reached = self.solve_pose(on_arc, pose, lower, upper)
        return np.where(is_reached[:, None], on_arc, z), is_reached

    def is_closed_at(self, waypoint: int) -> bool:
        """Return whether the chain is closed in the phase of a waypoint."""
        phase = self.problem.contacts.find_phase(waypoint)
        return self.problem.is_closed(self.problem.task.phases[phase])

    def push_clear(self, z: Floats, waypoint: int) -> Floats:
        """Push configurations, shape (B, n), out of collision, which may fail."""
        pose = self.find_pose(waypoint)
        if pose is None:
            return z

        def push(rows: Floats) -> Floats:
            return self._push_clear(rows, waypoint, pose)

        return _look_up_rows(self.cache.pushed, push, z, waypoint)

    def _push_clear(self, z: Floats, waypoint: int, pose: int) -> Floats:
        """Move configurations out of collision with a few damped Gauss-Newton steps.

        Each step drives the residuals of the pose to zero and violated contacts to their margins,
        both linearized: with the witness points fixed in their bodies, the gradient of a distance
        d = n·(b − a) is n·(∂b − ∂a). It aims at `Options.dist_safe` beyond the margins, considers
        the `Options.contact_slots` nearest contacts, and is limited to `MAX_STEP`. With the
        Jacobian A of residuals and distances, their required changes r and the inverse weights S,
        zero for fixed coordinates,

            δz = S Aᵀ (A S Aᵀ + λI)⁻¹ r
        """
        problem = self.problem
        options = problem.options
        lower, upper = self.compute_limits(z, waypoint)
        if self.curves is not None and self.is_closed_at(waypoint):
            # The base stays on its arc.
            lower[:, :3] = z[:, :3]
            upper[:, :3] = z[:, :3]
        solver, target = self.get_pose_solver(pose)
        z = z.copy()
        at = np.arange(len(z))  # configurations that are not done
        margin = options.dist_safe
        slots = options.contact_slots
        inverse_weights = (upper - lower > 1e-9) / self.weights
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
            is_clear = contacts.compute_shortfall(len(at)) <= 0.0
            is_reached = np.abs(residual).max(axis=1) < TOLERANCE
            is_done = is_clear & is_reached
            # Gradients of the nearest distances, and their required increase [m].
            distance_rows = np.zeros((len(at), slots, z.shape[1]))
            gradients = problem.contacts.compute_gradients(z[at], contacts)
            distance_rows[contacts.waypoint, contacts.slot] = gradients
            increase = np.zeros((len(at), slots))
            shortfall = np.maximum(contacts.margin + margin - contacts.distance, 0.0)
            increase[contacts.waypoint, contacts.slot] = shortfall
            jacobian = np.concatenate([pose_rows, distance_rows], axis=1)
            required = np.concatenate([-residual, increase], axis=1)
            scaled = jacobian * inverse_weights[at][:, None, :]
            system = scaled @ jacobian.transpose(0, 2, 1) + _DAMPING * np.eye(jacobian.shape[1])
            multipliers = np.linalg.solve(system, required[..., None])[..., 0]
            step = np.einsum("bij,bi->bj", scaled, multipliers)
            size = np.abs(step).max(axis=1, keepdims=True)
            step *= np.minimum(1.0, MAX_STEP / np.maximum(size, 1e-12))
            step[is_done] = 0.0
            z[at] = np.clip(z[at] + step, lower[at], upper[at])
            at = at[~is_done]
        z, _ = self.solve_pose(z, pose, lower, upper, iterations=3)
        return z

    def compute_limits(self, before: Floats, waypoint: int) -> tuple[Floats, Floats]:
        """Return limits at a waypoint after configurations `before`, shape (B, n) each."""
        row = waypoint - 1
        objects = self.object_columns
        grasp = self.find_grasp_columns(waypoint)
        lower = np.tile(self.problem.lower[row], (len(before), 1))
        upper = np.tile(self.problem.upper[row], (len(before), 1))
        for limits in (lower, upper):
            limits[:, objects] = self.object_motion[row, objects]
            limits[:, grasp] = before[:, grasp]
        return lower, upper

    def find_grasp_columns(self, waypoint: int) -> list[int]:
        """Return the columns of grasp coordinates that an earlier grasp fixes at a waypoint."""
        return [column for column, grasp, last in self.problem.choices if grasp < waypoint <= last]

    def _perturb_arms(self, z: Floats, pose: int, deviations: tuple[float, float]) -> Floats:
        """Perturb the arms by a random deviation, and align the bases with a pose constraint."""
        deviation = self.rng.uniform(*deviations, (len(z), 1))
        noise = self.rng.normal(0.0, 1.0, (len(z), self.robot_size - 3))
        z = z.copy()
        z[:, 3 : self.robot_size] += deviation * noise
        return self._align_bases(np.clip(z, self.chain.lower, self.chain.upper), pose)

    def _align_bases(self, z: Floats, pose: int) -> Floats:
        """Move the bases so that a pose constraint holds in position and heading.

        Height and tilt are left to the arm. A base motion multiplies the frame's placement from the
        left, so it equals the error T* T⁻¹, projected to the floor: of the rotation E = R*Rᵀ that
        is the turn by atan2(E_yx − E_xy, E_xx + E_yy). A base at p, with the frame at t, moves to
        t* + turn·(p − t).
        """
        goal = self.problem.pose_goals[pose]
        target = goal.target
        joint = goal.row.joint
        rotations, translations = self.chain.joint_placements(z)
        rotation = rotations[:, joint] @ goal.local.rotation
        translation = rotations[:, joint] @ goal.local.translation + translations[:, joint]
        error = np.einsum("ij,bkj->bik", target.rotation, rotation)
        if goal.row.kind == "pose":
            turn = np.arctan2(error[:, 1, 0] - error[:, 0, 1], error[:, 0, 0] + error[:, 1, 1])
        else:  # any heading will do
            turn = self.rng.uniform(-np.pi, np.pi, len(z))
        cos = np.cos(turn)
        sin = np.sin(turn)
        planar = np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)
        z = z.copy()
        base_from_frame = z[:, :2] - translation[:, :2]
        turned = np.einsum("bij,bj->bi", planar, base_from_frame)
        z[:, :2] = target.translation[:2] + turned
        z[:, 2] += turn
        return z

    def _unwrap_angles(self, z: Floats, before: Floats, lower: Floats, upper: Floats) -> Floats:
        """Replace each revolute robot joint's angle by the equivalent one nearest to `before`."""
        revolute = []
        for column in range(2, self.robot_size):
            if self.problem.unit(self.chain.names[column]) != "m":
                revolute.append(column)
        angle = z[:, revolute]
        start = before[:, revolute]
        nearest = start + (angle - start + np.pi) % (2 * np.pi) - np.pi
        is_inside = (nearest >= lower[:, revolute]) & (nearest <= upper[:, revolute])
        z = z.copy()
        z[:, revolute] = np.where(is_inside, nearest, angle)
        return z

    def compute_shortfall(self, z: Floats, waypoint: int) -> Floats:
        """Return the clearance shortfall of each configuration, shape (B,) [m]."""

        def compute(rows: Floats) -> Floats:
            return compute_shortfall(self.problem, rows, waypoint)

        return _look_up_rows(self.cache.shortfalls, compute, z, waypoint)

    def has_free_keyframe(self, waypoint: int) -> bool:
        """Return whether a search found a collision-free, feasible configuration for a waypoint."""
        rows = []
        for (at, row), shortfall in self.cache.shortfalls.items():
            if at == waypoint and shortfall <= ACCEPTED_SHORTFALL:
                rows.append(np.frombuffer(row))
        pose = self.find_pose(waypoint)
        if pose is None or not rows:
            return bool(rows)
        return bool((self.compute_residual(np.array(rows), pose) < TOLERANCE).any())


def compute_shortfall(
    problem: KinematicProblem,
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


def find_free_configurations(problem: KinematicProblem, z: Floats, waypoint: int) -> Bools:
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
    problem: KinematicProblem, waypoint: int, rng: np.random.Generator
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
        z, is_feasible = sampler.sample(z, waypoint, "scatter")
        pushed = z.copy()
        pushed[is_feasible] = sampler.push_clear(z[is_feasible], waypoint)
        residual = sampler.compute_residual(z, pose)
        pushed_residual = sampler.compute_residual(pushed, pose)
        stays_feasible = pushed_residual < TOLERANCE
        z = np.where(stays_feasible[:, None], pushed, z)
        return z, np.where(stays_feasible, pushed_residual, residual)
    if (lower[:2] < upper[:2]).any():
        return None
    z[:, 2:] += rng.normal(0.0, 1.0, z[:, 2:].shape)
    return np.clip(z, lower, upper), np.zeros(len(z))


def sample_smoothstep(steps: int) -> Floats:
    """Return 3s² − 2s³, which starts and ends at rest, for s = 1/steps, ..., 1, shape (steps,)."""
    s = np.arange(1, steps + 1) / steps
    return s * s * (3.0 - 2.0 * s)


def interpolate_object_joints(problem: KinematicProblem, z: Floats) -> Floats:
    """Move the object joints in z, shape (N, n), to their goals phase by phase."""
    begin = 0
    current = problem.start.copy()
    for phase, end in zip(problem.task.phases, problem.ends, strict=True):
        for name in phase.initial_values:
            column = problem.chain.index(name)
            start = current[column]
            goal = problem.lower[end - 1, column] if name in phase.values else start
            z[begin:end, column] = start + (goal - start) * sample_smoothstep(end - begin)
            current[column] = goal
        begin = end
    return problem.clip(z)
