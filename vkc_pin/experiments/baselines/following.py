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
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.trust_region import CLEARANCE_TOLERANCE
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.world.trajectory.trajectory import Trajectory

QP = "daqp"
"""Solver of quadratic programs, by its name in `qpsolvers`."""
_ITERATIONS = 30
_FRAME = "closure"
CLEAR = CLEARANCE_TOLERANCE
"""Accepted shortfall of clearances [m], as in the solver."""
_ROUNDS = 12
_REACH = 0.05  # distance beyond the clearance up to which contacts are considered [m]
_LONGEST = 0.2  # largest step of a coordinate in one round [m] or [rad]
_OBJECT = 10.0  # weight of the object's deviation from its time law; that of the arm is 1
_SLACK = 1e3  # weight of the slack
_REGULAR = 1e-6  # makes the program strictly convex in the slack
SEEDS = 16
"""Number of random arms for inverse kinematics where it fails from the waypoint before."""
_CAUSES = ("", "collision", "no inverse kinematics")  # the best first
_SPREAD = 1.0  # of half of the random arms around the waypoint before [rad]; others: anywhere


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

    def __init__(self, problem: TrajectoryProblem, sampler: KeyframeSampler) -> None:
        self.problem, self.sampler = problem, sampler
        chain = problem.chain
        virtual = [chain.index(name) for names in chain.virtual.values() for name in names]
        self.columns = np.array([*range(3, sampler.robot_size), *virtual], int)
        self._models: dict[int, pin.Model] = {}

    def solve(self, z: Floats, waypoint: int) -> tuple[Floats, bool]:
        """Iterate from `z`, shape (n,); return the result and whether the chain is closed."""
        import pink

        pose = self.sampler.find_pose(waypoint)
        if pose is None:
            return z, True
        model, chain = self._model(pose), self.problem.chain
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

    def _model(self, pose: int) -> pin.Model:
        """Return the chain's model with a frame for a pose constraint."""
        if pose not in self._models:
            row = self.problem.transcription.structure.poses[pose]
            model = pin.Model(self.problem.chain.model)
            model.addFrame(pin.Frame(_FRAME, row.joint, row.local, pin.FrameType.OP_FRAME))
            self._models[pose] = model
        return self._models[pose]


class _Box:
    """A limit for Pink: joint limits, bounded steps, and fixed coordinates except `columns`."""

    def __init__(self, columns: Ints, lower: Floats, upper: Floats, z: Floats) -> None:
        self.columns, self.lower, self.upper, self.z = columns, lower, upper, z
        self._rows = np.vstack([np.eye(len(z)), -np.eye(len(z))])

    def take(self, step: Floats) -> None:
        """Take a step, shape (n,), without rounding errors of the solver in fixed coordinates."""
        at, z = self.columns, self.z.copy()
        z[at] = np.clip(z[at] + step[at], self.lower[at], self.upper[at])
        self.z = z

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> tuple[Floats, Floats]:
        """Return G and h of G·δz ≤ h, shapes (2n, n) and (2n,)."""
        most, least = np.zeros(len(self.z)), np.zeros(len(self.z))
        at = self.columns
        most[at] = np.clip(self.upper[at] - self.z[at], 0.0, MAX_STEP)
        least[at] = np.clip(self.lower[at] - self.z[at], -MAX_STEP, 0.0)
        return self._rows, np.concatenate([most, -least])


def refine_configuration(
    problem: TrajectoryProblem,
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
    lower, upper = problem.lower[waypoint - 1], problem.upper[waypoint - 1]
    free = np.concatenate([columns, sampler.object_columns])
    weights = np.where(np.isin(free, columns), 1.0, _OBJECT)
    for _ in range(_ROUNDS):
        residual, jacobian = (part[0] for part in solver.evaluate(z[None], target))
        reach = problem.options.largest_margin + _REACH
        contacts = problem.contacts.evaluate(
            z[None], np.array([waypoint]), reach=reach, nearest=None
        )
        if np.abs(residual).max() < TOLERANCE and contacts.compute_violation() <= CLEAR:
            return z, True
        gradients = problem.contacts.compute_gradients(z[None], contacts)[:, free]
        room = contacts.distance - contacts.margin
        bounds = [np.clip(limit[free] - z[free], -_LONGEST, _LONGEST) for limit in (lower, upper)]
        # The step of the free coordinates, then one slack for all pairs.
        step = qpsolvers.solve_qp(
            np.diag([*weights, _REGULAR]),
            np.append(weights * (z - wanted)[free], _SLACK),
            np.column_stack([-gradients, -np.ones(len(room))]),
            room,
            np.column_stack([jacobian[:, free], np.zeros(len(residual))]),
            -residual,
            np.append(bounds[0], 0.0),
            np.append(bounds[1], np.inf),
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
        self.cause, self.share = cause, share
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
    problem: TrajectoryProblem, base: Floats, rng: np.random.Generator, *, refine: bool
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
        self, problem: TrajectoryProblem, sampler: KeyframeSampler, *, refine: bool
    ) -> None:
        self.problem, self.sampler, self.refine = problem, sampler, refine
        self.kinematics = ArmKinematics(problem, sampler)

    def find(self, z: Floats, waypoint: int) -> tuple[Floats, str]:
        """Return the nearest free configuration to `z`, else the best one, and its failure."""
        first, cause = self._candidate(z, waypoint)
        if not cause:
            return first, ""
        found = [self._candidate(seed, waypoint) for seed in self._seeds(z)]
        found.append((first, cause))
        return min(found, key=lambda one: (_CAUSES.index(one[1]), float(np.abs(one[0] - z).sum())))

    def _candidate(self, z: Floats, waypoint: int) -> tuple[Floats, str]:
        """Return the result of inverse kinematics, and of refinement, from `z`, and its failure."""
        found, closed = self.kinematics.solve(z, waypoint)
        if self.refine and not (closed and self._free(found, waypoint)):
            found, closed = refine_configuration(
                self.problem,
                self.sampler,
                found,
                wanted=z,
                waypoint=waypoint,
                columns=self.kinematics.columns,
            )
        if not closed:
            return found, "no inverse kinematics"
        return found, "" if self._free(found, waypoint) else "collision"

    def _free(self, z: Floats, waypoint: int) -> bool:
        return bool(self.sampler.compute_shortfall(z[None], waypoint)[0] <= CLEAR)

    def _seeds(self, z: Floats) -> Floats:
        """Return `z` with random arms, shape (SEEDS, n)."""
        columns, chain, rng = self.kinematics.columns, self.problem.chain, self.sampler.rng
        lower = np.maximum(chain.lower[columns], -np.pi)
        upper = np.minimum(chain.upper[columns], np.pi)
        arms = rng.uniform(np.minimum(lower, upper), upper, (SEEDS, len(columns)))
        near = z[columns] + rng.normal(0.0, _SPREAD, (SEEDS // 2, len(columns)))
        arms[: SEEDS // 2] = np.clip(near, chain.lower[columns], chain.upper[columns])
        seeds = np.tile(z, (SEEDS, 1))
        seeds[:, columns] = arms
        return seeds
