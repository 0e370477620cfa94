"""Times and validates the paths of other planners."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.plan import Plan, PlanningStatistics
from vkc_pin.planning.results import make_stationary_trajectory, retime_validated
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

from .tasks import PeerProblem

_BETWEEN = 10  # moments that are looked at between two waypoints
_NEAR = 0.1  # [m] up to which distances are measured


@dataclass
class PeerResult:
    """Result of a planner.

    Attributes:
        path: Waypoints from the start, shape (K, n); None if there are none.
        own: CPU time of the solver alone [s].
        first: CPU time from the call to the first motion [s].
        status: "found", "timed out" or the planner's own status.
        about: Further information.
    """

    path: Floats | None = None
    own: float = 0.0
    first: float | None = None
    status: str = "none"
    about: dict[str, Any] = field(default_factory=dict)


class Clock:
    """Measures CPU time and checks a wall-time limit.

    Attributes:
        elsewhere: CPU time of other processes [s].
    """

    def __init__(self, limit: float) -> None:
        self.limit = limit
        self.elsewhere = 0.0
        self._wall = time.perf_counter()
        self._cpu = time.process_time()

    @property
    def cpu_time(self) -> float:
        """CPU time since the beginning [s]."""
        return time.process_time() - self._cpu + self.elsewhere

    @property
    def wall(self) -> float:
        """Wall time since the beginning [s]."""
        return time.perf_counter() - self._wall

    @property
    def remaining(self) -> float:
        """Remaining wall time [s], at least 0."""
        return max(0.0, self.limit - self.wall)


Peer = Callable[[PeerProblem, TrajectoryProblem, int, Clock, Callable[[Floats], bool]], PeerResult]
"""Plans a problem, given its program, a random seed, a clock and a check of paths."""


def validate_path(
    own: PeerProblem,
    problem: TrajectoryProblem,
    path: Floats | None,
    status: str,
    *,
    name: str,
    seed: int,
) -> Plan:
    """Return a path as a retimed and validated plan.

    Args:
        own: Problem.
        problem: Its program.
        path: Waypoints, shape (K, n); None for a stationary robot.
        status: Status without a path.
        name: Name of the planner.
        seed: Random seed.
    """

    def check(motion: Trajectory) -> Report:
        return validate(own.scene, own.steps, motion, problem.options)

    if path is None:
        trajectory = make_stationary_trajectory(own.scene, problem.options)
        report = check(trajectory)
    else:
        (phase,) = problem.task.phases
        span = PhaseSpan(phase.name, 0, len(path) - 1, phase.held, phase.opening)
        times = np.linspace(0.0, problem.options.dt * (len(path) - 1), len(path))
        waypoints = Trajectory(
            problem.chain.names, times, path, (span,), problem.chain.robot.coordinates.size
        )
        trajectory, report = retime_validated(own.scene, waypoints, check)
    said = "success" if report.ok else "rejected" if path is not None else status
    return Plan(
        own.scene,
        own.steps,
        problem.options,
        trajectory,
        report,
        said,  # a failed peer's own word
        statistics=PlanningStatistics(),
        seed=seed,
        initialization=name,
    )


def compute_clearances(
    problem: TrajectoryProblem, trajectory: Trajectory
) -> Mapping[str, float | None]:
    """Return the least distance of pairs at and between waypoints [m]; None above 0.1 m."""
    share = np.arange(1, _BETWEEN) / _BETWEEN
    begins = trajectory.times[:-1, None]
    lasts = np.diff(trajectory.times)[:, None]
    found: dict[str, float | None] = {}
    for name, times in (("at", trajectory.times), ("between", (begins + share * lasts).ravel())):
        z = trajectory.at(times)
        contacts = problem.contacts.evaluate(z, np.ones(len(z), int), reach=_NEAR, nearest=1)
        least = contacts.compute_clearance()
        found[f"clearance_{name}"] = float(least) if np.isfinite(least) else None
    return found
