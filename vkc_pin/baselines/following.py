"""The arm follows: waypoint by waypoint, while the base runs along its path and the object's joints to their goals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vkc_pin.baselines.arm_kinematics import ArmKinematics
from vkc_pin.baselines.refining import CLEAR, refined
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["FailedError", "Followed", "follow"]

SEEDS = 16
"""From so many random arms inverse kinematics is tried where it leads to nothing from the waypoint before."""
_KINDS = (
    "",
    "collision",
    "no inverse kinematics",
)  # what may be wrong with a configuration, the best first
# [rad], of half of them about the waypoint before; the others are anywhere within the limits
_SPREAD = 1.0


class FailedError(Exception):
    """A stage failed.

    Attributes:
        cause: Why; what becomes the plan's status.
        parts: What was done before, and as much as there is of the stage.
        share: How much of the stage works.
    """

    def __init__(self, cause: str, last: Trajectory | None = None, share: float = 0.0) -> None:
        super().__init__(cause)
        self.cause, self.share = cause, share
        self.parts = [] if last is None else [last]

    @property
    def came(self) -> float:
        """How many stages it came through."""
        return len(self.parts) + self.share


@dataclass(frozen=True, eq=False)
class Followed:
    """Where following led.

    Attributes:
        z: z_1..z_N, shape (N, n); if it failed, all stands still from there on, in what was nearest
            to working.
        share: Share of the waypoints up to which it worked.
        cause: "", "no inverse kinematics", or "collision" if all there is is not free.
    """

    z: Floats
    share: float
    cause: str


def follow(
    problem: TrajectoryProblem, base: Floats, rng: np.random.Generator, *, refine: bool
) -> Followed:
    """Find the arm for every waypoint from the one before.

    Args:
        problem: Moves joints of what is held, and nothing else.
        base: x, y, yaw [m, rad] at its waypoints, shape (N, 3).
        rng: Draws seeds.
        refine: Move arm and object at each waypoint out of collision (B2), instead of taking the
            object where the time law has it and the arm as inverse kinematics finds it (B1).
    """
    knots = KeyframeSampler(problem, rng)
    z = knots.object_motion.copy()
    z[:, :3] = base
    arm = _Arm(problem, knots, refine=refine)
    before = problem.start
    for row in range(len(z)):
        z[row, arm.kinematics.columns] = before[arm.kinematics.columns]
        found, cause = arm.at(z[row], row + 1)
        z[row] = found
        if cause:
            z[row:] = found
            return Followed(z, row / len(z), cause)
        before = z[row]
    return Followed(z, 1.0, "")


class _Arm:
    """Looks for what the arm does at single waypoints."""

    def __init__(self, problem: TrajectoryProblem, knots: KeyframeSampler, *, refine: bool) -> None:
        self.problem, self.knots, self.refine = problem, knots, refine
        self.kinematics = ArmKinematics(problem, knots)

    def at(self, z: Floats, waypoint: int) -> tuple[Floats, str]:
        """Return the free configuration nearest to `z`, shape (n,), or the nearest that is not, and what is wrong with it."""
        first, cause = self._candidate(z, waypoint)
        if not cause:
            return first, ""
        found = [self._candidate(seed, waypoint) for seed in self._seeds(z)]
        found.append((first, cause))
        # The best kind, and of these the nearest.
        return min(found, key=lambda one: (_KINDS.index(one[1]), float(np.abs(one[0] - z).sum())))

    def _candidate(self, z: Floats, waypoint: int) -> tuple[Floats, str]:
        """Return what inverse kinematics, and refinement, lead to from `z`, and what is wrong with it."""
        found, closed = self.kinematics.solve(z, waypoint)
        if self.refine and not (closed and self._free(found, waypoint)):
            found, closed = refined(
                self.problem,
                self.knots,
                found,
                wanted=z,
                waypoint=waypoint,
                columns=self.kinematics.columns,
            )
        if not closed:
            return found, "no inverse kinematics"
        return found, "" if self._free(found, waypoint) else "collision"

    def _free(self, z: Floats, waypoint: int) -> bool:
        return bool(self.knots.compute_shortfall(z[None], waypoint)[0] <= CLEAR)

    def _seeds(self, z: Floats) -> Floats:
        """Return `z` with other arms, shape (SEEDS, n)."""
        columns, chain, rng = self.kinematics.columns, self.problem.chain, self.knots.rng
        lower, upper = (
            np.maximum(chain.lower[columns], -np.pi),
            np.minimum(chain.upper[columns], np.pi),
        )
        arms = rng.uniform(np.minimum(lower, upper), upper, (SEEDS, len(columns)))
        near = z[columns] + rng.normal(0.0, _SPREAD, (SEEDS // 2, len(columns)))
        arms[: SEEDS // 2] = np.clip(near, chain.lower[columns], chain.upper[columns])
        seeds = np.tile(z, (SEEDS, 1))
        seeds[:, columns] = arms
        return seeds
