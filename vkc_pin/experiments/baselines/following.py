"""Lets the arm follow base and object, waypoint by waypoint, without collisions.

It uses the differential inverse kinematics of Pink (https://github.com/stephane-caron/pink), with
joint limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.inverse_kinematics import MAX_STEP
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.world.trajectory.trajectory import Trajectory

QP = "daqp"
"""Solver of quadratic programs, by its name in `qpsolvers`."""
# iterations of inverse kinematics
_ITERATIONS = 30
_FRAME = "closure"
CLEAR = CLEARANCE_TOLERANCE
"""Accepted shortfall of clearances [m], as in the solver."""
# rounds of refinement
_ROUNDS = 12
# [m] distance beyond the clearance up to which contacts are considered
_REACH = 0.05
# [m] or [rad] largest step of a coordinate in one round
_MAX_ROUND_STEP = 0.2
# weight of the object's deviation from its time law; that of the arm is 1
_OBJECT_WEIGHT = 10.0
_SLACK_WEIGHT = 1e3
# makes the program strictly convex in the slack
_SLACK_CURVATURE = 1e-6
SEEDS = 16
"""Number of random arms for inverse kinematics where it fails from the waypoint before."""
# the best first
_CAUSES = ("", "collision", "no inverse kinematics")
# [rad] of half of the random arms around the waypoint before; others: anywhere
_SPREAD = 1.0


def import_solvers() -> None:
    """Import Pink and the solver of quadratic programs, which takes a while.

    Raises:
        InputError: The extra `experiments` is not installed.
    """
    for name in ("pink", "qpsolvers", QP):
        import_optional(name, "experiments", purpose="a baseline")


class ArmKinematics:
    """Closes the chain at waypoints at which a fixed object is grasped.

    Attributes:
        columns: Decided coordinates: the arm's joints, and the freedoms of its grasps.
    """

    def __init__(self, problem: KinematicProblem, sampler: KeyframeSampler) -> None:
        self.problem = problem
        self.sampler = sampler
        columns = list(range(3, sampler.robot_size))
        for names in problem.chain.virtual.values():
            columns += [problem.chain.index(name) for name in names]
        self.columns = np.array(columns, int)
        self._models: dict[int, pin.Model] = {}

    def solve(self, z: Floats, waypoint: int) -> tuple[Floats, bool]:
        """Iterate from `z`, shape (n,); return the result and whether the chain is closed."""
        import pink

        pose = self.sampler.find_pose(waypoint)
        if pose is None:
            return z, True
        chain = self.problem.chain
        model = self._get_model(pose)
        task = pink.tasks.FrameTask(
            _FRAME, position_cost=1.0, orientation_cost=1.0, lm_damping=1e-3
        )
        task.set_target(self.problem.targets[pose])
        box = _Box(self.columns, chain.lower, chain.upper, z.copy())
        configuration = pink.Configuration(model, model.createData(), chain.coordinates.q(box.z))
        for _ in range(_ITERATIONS):
            record_evaluations(1)
            if np.abs(task.compute_error(configuration)).max() < TOLERANCE:
                return box.z, True
            try:
                step = pink.solve_ik(
                    configuration, [task], 1.0, QP, damping=1e-9, limits=[box], safety_break=False
                )
            except pink.exceptions.NoSolutionFound:
                break
            box.take(step)
            configuration.update(chain.coordinates.q(box.z))
        return box.z, False

    def _get_model(self, pose: int) -> pin.Model:
        """Return the chain's model with a frame for a pose constraint."""
        if pose not in self._models:
            goal = self.problem.pose_goals[pose]
            model = pin.Model(self.problem.chain.model)
            frame = pin.Frame(_FRAME, goal.row.joint, goal.local, pin.FrameType.OP_FRAME)
            model.addFrame(frame)
            self._models[pose] = model
        return self._models[pose]


class _Box:
    """A limit for Pink: joint limits, bounded steps, and fixed coordinates except `columns`."""

    def __init__(self, columns: Ints, lower: Floats, upper: Floats, z: Floats) -> None:
        self.columns = columns
        self.lower = lower
        self.upper = upper
        self.z = z
        self._rows = np.vstack([np.eye(len(z)), -np.eye(len(z))])

    def take(self, step: Floats) -> None:
        """Take a step, shape (n,), without rounding errors of the solver in fixed coordinates."""
        columns = self.columns
        z = self.z.copy()
        z[columns] = np.clip(z[columns] + step[columns], self.lower[columns], self.upper[columns])
        self.z = z

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> tuple[Floats, Floats]:
        """Return G and h of G·δz ≤ h, shapes (2n, n) and (2n,): δz ≤ most and −δz ≤ −least."""
        columns = self.columns
        most = np.zeros(len(self.z))
        least = np.zeros(len(self.z))
        most[columns] = np.clip(self.upper[columns] - self.z[columns], 0.0, MAX_STEP)
        least[columns] = np.clip(self.lower[columns] - self.z[columns], -MAX_STEP, 0.0)
        return self._rows, np.concatenate([most, -least])


def refine_configuration(
    problem: KinematicProblem,
    sampler: KeyframeSampler,
    z: Floats,
    *,
    wanted: Floats,
    waypoint: int,
    columns: Ints,
) -> tuple[Floats, bool]:
    """Return a configuration near `wanted`, found from `z`, and whether the chain is closed.

    Each round minimises Σ w (z − z*)² + slack over the arm, the freedoms of its grasps and the
    object's joints, so that the linearised closure holds and the linearised distances of close
    pairs keep their margins. z* is `wanted`: the arm at the waypoint before, and the object by its
    time law. `columns` are the coordinates of arm and grasps.
    """
    import qpsolvers

    pose = sampler.find_pose(waypoint)
    if pose is None:
        return z, True
    solver, target = sampler.get_pose_solver(pose)
    free = np.concatenate([columns, sampler.object_columns])
    lower = problem.lower[waypoint - 1][free]
    upper = problem.upper[waypoint - 1][free]
    weights = np.where(np.isin(free, columns), 1.0, _OBJECT_WEIGHT)
    reach = problem.options.largest_margin + _REACH
    for _ in range(_ROUNDS):
        residuals, jacobians = solver.evaluate(z[None], target)
        residual = residuals[0]
        jacobian = jacobians[0]
        contacts = problem.contacts.evaluate(
            z[None], np.array([waypoint]), reach=reach, nearest=None
        )
        if np.abs(residual).max() < TOLERANCE and contacts.compute_violation() <= CLEAR:
            return z, True
        gradients = problem.contacts.compute_gradients(z[None], contacts)[:, free]
        clearances = contacts.distance - contacts.margin
        least = np.clip(lower - z[free], -_MAX_ROUND_STEP, _MAX_ROUND_STEP)
        most = np.clip(upper - z[free], -_MAX_ROUND_STEP, _MAX_ROUND_STEP)
        # The step of the free coordinates, then one slack for all pairs.
        step = qpsolvers.solve_qp(
            P=np.diag([*weights, _SLACK_CURVATURE]),
            q=np.append(weights * (z - wanted)[free], _SLACK_WEIGHT),
            G=np.column_stack([-gradients, -np.ones(len(clearances))]),
            h=clearances,
            A=np.column_stack([jacobian[:, free], np.zeros(len(residual))]),
            b=-residual,
            lb=np.append(least, 0.0),
            ub=np.append(most, np.inf),
            solver=QP,
        )
        if step is None:
            break
        z = z.copy()
        z[free] += step[:-1]
    residual, _ = solver.evaluate(z[None], target)
    return z, bool(np.abs(residual).max() < TOLERANCE)


class FailedError(Exception):
    """A stage failed.

    Attributes:
        cause: Status of the plan.
        parts: Trajectories of completed stages and of a part of this one.
        share: Completed fraction of the stage.
    """

    def __init__(self, cause: str, last: Trajectory | None = None, share: float = 0.0) -> None:
        super().__init__(cause)
        self.cause = cause
        self.share = share
        self.parts = [] if last is None else [last]

    @property
    def progress(self) -> float:
        """Number of completed stages."""
        return len(self.parts) + self.share


@dataclass(frozen=True, eq=False)
class FollowResult:
    """Result of following.

    Attributes:
        z: z_1..z_N, shape (N, n); constant after a failure.
        share: Fraction of the waypoints before the failure.
        cause: "", "no inverse kinematics" or "collision".
    """

    z: Floats
    share: float
    cause: str


def follow(
    problem: KinematicProblem, base: Floats, rng: np.random.Generator, *, refine: bool
) -> FollowResult:
    """Find the arm for every waypoint from the one before.

    Args:
        problem: Problem that only moves joints of the grasped object.
        base: x, y, yaw [m, rad] at its waypoints, shape (N, 3).
        rng: Random generator.
        refine: Move arm and object at each waypoint out of collision (B2), instead of keeping the
            object's time law and the result of inverse kinematics (B1).
    """
    sampler = KeyframeSampler(problem, rng)
    z = sampler.object_motion.copy()
    z[:, :3] = base
    arm = _Arm(problem, sampler, refine=refine)
    before = problem.start
    for row in range(len(z)):
        z[row, arm.kinematics.columns] = before[arm.kinematics.columns]
        found, cause = arm.find(z[row], row + 1)
        z[row] = found
        if cause:
            z[row:] = found
            return FollowResult(z, row / len(z), cause)
        before = z[row]
    return FollowResult(z, 1.0, "")


class _Arm:
    """Finds the arm at single waypoints."""

    def __init__(
        self, problem: KinematicProblem, sampler: KeyframeSampler, *, refine: bool
    ) -> None:
        self.problem = problem
        self.sampler = sampler
        self.refine = refine
        self.kinematics = ArmKinematics(problem, sampler)

    def find(self, z: Floats, waypoint: int) -> tuple[Floats, str]:
        """Return the nearest free configuration to `z`, else the best one, and its failure."""

        def rank(candidate: tuple[Floats, str]) -> tuple[int, float]:
            configuration, cause = candidate
            return _CAUSES.index(cause), float(np.abs(configuration - z).sum())

        first, cause = self._find_from(z, waypoint)
        if not cause:
            return first, ""
        candidates = [self._find_from(guess, waypoint) for guess in self._sample_arms(z)]
        candidates.append((first, cause))
        return min(candidates, key=rank)

    def _find_from(self, z: Floats, waypoint: int) -> tuple[Floats, str]:
        """Return the result of inverse kinematics, and of refinement, from `z`, and its failure."""
        found, is_closed = self.kinematics.solve(z, waypoint)
        if self.refine and not (is_closed and self._is_free(found, waypoint)):
            found, is_closed = refine_configuration(
                self.problem,
                self.sampler,
                found,
                wanted=z,
                waypoint=waypoint,
                columns=self.kinematics.columns,
            )
        if not is_closed:
            return found, "no inverse kinematics"
        return found, "" if self._is_free(found, waypoint) else "collision"

    def _is_free(self, z: Floats, waypoint: int) -> bool:
        """Return whether a configuration keeps the clearances at a waypoint."""
        return bool(self.sampler.compute_shortfall(z[None], waypoint)[0] <= CLEAR)

    def _sample_arms(self, z: Floats) -> Floats:
        """Return `z` with random arms, shape (SEEDS, n)."""
        columns = self.kinematics.columns
        rng = self.sampler.rng
        chain_lower = self.problem.chain.lower[columns]
        chain_upper = self.problem.chain.upper[columns]
        lower = np.maximum(chain_lower, -np.pi)
        upper = np.minimum(chain_upper, np.pi)
        arms = rng.uniform(np.minimum(lower, upper), upper, (SEEDS, len(columns)))
        near = z[columns] + rng.normal(0.0, _SPREAD, (SEEDS // 2, len(columns)))
        arms[: SEEDS // 2] = np.clip(near, chain_lower, chain_upper)
        configurations = np.tile(z, (SEEDS, 1))
        configurations[:, columns] = arms
        return configurations
