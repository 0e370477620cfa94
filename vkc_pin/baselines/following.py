"""Lets the arm follow base and object, waypoint by waypoint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vkc_pin.baselines.arm_kinematics import ArmKinematics
from vkc_pin.baselines.refining import CLEAR, refine_configuration
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["FailedError", "FollowResult", "follow"]

SEEDS = 16
"""Number of random arms for inverse kinematics where it fails from the waypoint before."""
_CAUSES = ("", "collision", "no inverse kinematics")  # the best first
_SPREAD = 1.0  # of half of the random arms around the waypoint before [rad]; others: anywhere


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
