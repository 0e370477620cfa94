"""Statistics of planning: times and counts."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["STAGES", "PlanningStatistics"]

STAGES = ("initialization", "coal", "casadi", "ipopt", "retiming", "validation")
"""Stages of planning whose times are measured."""


@dataclass(frozen=True)
class PlanningStatistics:
    """Times and counts of planning.

    Attributes:
        planning_time: Total time without building symbolic programs [s].
        build_time: Time for building symbolic programs [s].
        iterations: Iterations of Ipopt.
        rounds: Rounds of the solver.
        evaluations: Evaluated configurations, see `Budget`.
        initialization_time: Time for initial guesses [s].
        coal_time: Time for distances [s].
        casadi_time: Time for evaluating symbolic functions [s].
        ipopt_time: Time inside Ipopt [s].
        retiming_time: Time for retiming [s].
        validation_time: Time for validation [s].
        following_time: Time in which the arm of a baseline follows the base [s].
    """

    planning_time: float = 0.0
    build_time: float = 0.0
    iterations: int = 0
    rounds: int = 0
    evaluations: int = 0
    initialization_time: float = 0.0
    coal_time: float = 0.0
    casadi_time: float = 0.0
    ipopt_time: float = 0.0
    retiming_time: float = 0.0
    validation_time: float = 0.0
    following_time: float = 0.0

    def __add__(self, other: PlanningStatistics) -> PlanningStatistics:
        mine, theirs = vars(self), vars(other)
        return PlanningStatistics(**{name: mine[name] + theirs[name] for name in mine})

    def with_times(self, times: Mapping[str, float]) -> PlanningStatistics:
        """Return the statistics with the times of some of `STAGES` [s]."""
        fields: dict[str, Any] = {f"{name}_time": value for name, value in times.items()}
        return dataclasses.replace(self, **fields)

    def to_metrics(self) -> dict[str, float]:
        """Return the statistics by the names in records of benchmarks."""
        times = {f"time_{stage}": float(getattr(self, f"{stage}_time")) for stage in STAGES}
        if self.following_time:
            times["time_following"] = self.following_time
        counts = {
            "iterations": float(self.iterations),
            "rounds": float(self.rounds),
            "evaluations": float(self.evaluations),
        }
        return {
            "planning_time": self.planning_time,
            "build_time": self.build_time,
            **counts,
            **times,
        }

    @classmethod
    def from_metrics(cls, metrics: Mapping[str, float]) -> PlanningStatistics:
        """Return the statistics that `to_metrics` returned; missing names count as 0."""
        stages = (*STAGES, "following")
        times = {f"{stage}_time": float(metrics.get(f"time_{stage}", 0.0)) for stage in stages}
        return cls(
            planning_time=float(metrics.get("planning_time", 0.0)),
            build_time=float(metrics.get("build_time", 0.0)),
            iterations=int(metrics.get("iterations", 0)),
            rounds=int(metrics.get("rounds", 0)),
            evaluations=int(metrics.get("evaluations", 0)),
            **times,
        )
