"""What a planner hands in, and what is made of it: a motion, judged like all others."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from vkc_pin.benchmarks.peers.tasks import Given
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.results import build_plan, make_stationary_trajectory
from vkc_pin.planning.retime_validated import retime_validated
from vkc_pin.planning.statistics import PlanningStatistics
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.trajectory.formats.archives import PlanStatus
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["Clock", "Found", "Peer", "clearances", "judged"]

_BETWEEN = 10  # moments that are looked at between two waypoints
_NEAR = 0.1  # [m] up to which distances are measured


@dataclass
class Found:
    """What a planner came to.

    Attributes:
        path: Its waypoints from the start on, straight lines between them, shape (K, n); None: it
            has none.
        own: CPU time of its solver alone [s].
        first: CPU time from the call to its first motion, everything included [s]; None: it has
            none.
        status: "found", or why not: "timed out", or its own word.
        about: What else is kept.
    """

    path: Floats | None = None
    own: float = 0.0
    first: float | None = None
    status: str = "none"
    about: dict[str, Any] = field(default_factory=dict)


class Clock:
    """CPU time of this process and of what works for it, and when the time is up by the clock on the wall.

    Attributes:
        elsewhere: CPU time that other processes have spent for this one [s].
    """

    def __init__(self, limit: float) -> None:
        self.limit, self.elsewhere = limit, 0.0
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    @property
    def spent(self) -> float:
        """CPU time since the beginning [s]."""
        return time.process_time() - self._cpu + self.elsewhere

    @property
    def wall(self) -> float:
        """Time since the beginning [s]."""
        return time.perf_counter() - self._wall

    @property
    def left(self) -> float:
        """Time that is left by the clock [s], at least 0."""
        return max(0.0, self.limit - self.wall)


Peer = Callable[[Given, TrajectoryProblem, int, Clock, Callable[[Floats], bool]], Found]
"""What plans: takes a problem, the same as a program, a random seed, the clock, and what tells whether a path is accepted."""


def judged(
    own: Given,
    problem: TrajectoryProblem,
    path: Floats | None,
    status: str,
    *,
    name: str,
    seed: int,
) -> Plan:
    """Return a path as a plan: timed as those of this package are, and checked by the independent validation.

    Args:
        own: The problem.
        problem: The same as a program.
        path: Waypoints, shape (K, n); None: there are none, and the robot stands still.
        status: The planner's word, which a motion that is accepted overrules.
        name: The planner's.
        seed: Its random seed.
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
    return build_plan(
        own.scene,
        own.steps,
        problem.options,
        trajectory,
        report,
        cast("PlanStatus", said),  # a failed peer's own word
        statistics=PlanningStatistics(),
        random_seed=seed,
        initialization=name,
    )


def clearances(problem: TrajectoryProblem, trajectory: Trajectory) -> Mapping[str, float | None]:
    """Return the least distance of any pair [m] at waypoints and between them; None: more than 0.1 m.

    Pairs that have no margin, such as neighbouring links, do not count.
    """
    share = np.arange(1, _BETWEEN) / _BETWEEN
    begins, lasts = trajectory.times[:-1, None], np.diff(trajectory.times)[:, None]
    found: dict[str, float | None] = {}
    for name, times in (("at", trajectory.times), ("between", (begins + share * lasts).ravel())):
        z = trajectory.at(times)
        contacts = problem.contacts.evaluate(z, np.ones(len(z), int), reach=_NEAR, nearest=1)
        least = contacts.compute_clearance()
        found[f"clearance_{name}"] = float(least) if np.isfinite(least) else None
    return found
