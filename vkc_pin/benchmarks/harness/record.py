"""What every benchmark writes: versions, machine and seed, then one object a trial."""

from __future__ import annotations

import functools
import subprocess
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from vkc_pin.planning.plan import Plan
from vkc_pin.utils.parallel.machine import describe_machine, find_versions, measure_peak_memory
from vkc_pin.world.files.resources import find_package_folder
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = [
    "Record",
    "Solve",
    "commit",
    "distribution",
    "find_versions",
    "measure_peak_memory",
    "meta",
    "peaks",
    "trial",
    "values",
]

Record = Mapping[str, Any]
"""What is kept of a trial, by field; see `trial`."""
Solve = Callable[[Scene, Mapping[str, Any]], Plan]
"""What plans a trial: takes its scene and its specification."""


def meta(**settings: Any) -> dict[str, Any]:
    """Return commit, versions, machine and `settings` (seed, trials, ...)."""
    return {
        "commit": commit(),
        "versions": find_versions(),
        "machine": describe_machine(),
        **settings,
    }


@functools.cache
def commit() -> str | None:
    """Return which commit the package's sources are of, `-dirty` if they are changed; None where git does not know."""
    command = [
        "git",
        "-C",
        str(find_package_folder()),
        "describe",
        "--always",
        "--dirty",
        "--abbrev=12",
    ]
    try:
        return (
            subprocess.run(
                command, capture_output=True, text=True, timeout=10, check=True
            ).stdout.strip()
            or None
        )
    except (OSError, subprocess.SubprocessError):
        return None


def trial(plan: Plan, *, method: str, seed: int, **more: Any) -> dict[str, Any]:
    """Return the record of one plan; success is validation's word."""
    m = plan.metrics
    first = plan.report.violations[0] if plan.report.violations else None
    failed = (
        None if plan.success else (f"{first.constraint} {first.subject}" if first else plan.status)
    )
    return {
        "scene": plan.scene.name,
        "method": method,
        "start": np.asarray(plan.scene.start).round(9).tolist(),
        "seed": seed,
        "success": plan.success,
        "status": plan.status,
        **{
            field: m[field]
            for field in (
                "planning_time",
                "base_path_length",
                "base_path_length_l1",
                "arm_path_length",
            )
        },
        "clearance": m["clearance"]
        if np.isfinite(m["clearance"])
        else None,  # JSON knows no infinity
        "closure_error": m["closure_error"],
        "iterations": int(m["iterations"]),
        "rounds": int(m["rounds"]),
        "evaluations": int(m.get("evaluations", 0)),
        "waypoints": len(plan.trajectory.times),
        "initialization": plan.initialization,
        "build_time": m["build_time"],
        **{key: value for key, value in m.items() if key.startswith("time_")},
        "failed_constraint": failed,
        "violations": [str(v) for v in plan.report.violations],
        "commit": commit(),
        **more,
    }


def peaks(trajectory: Trajectory) -> dict[str, float]:
    """Return the largest velocity [rad/s] and acceleration [rad/s²] of an arm joint: peak_velocity, peak_acceleration."""
    arm, curve = slice(3, trajectory.robot_size), trajectory.curve
    rates = (
        (trajectory.velocities(), trajectory.accelerations())
        if curve is None
        else curve.compute_max_rates()
    )
    largest = [float(np.abs(rate[:, arm]).max(initial=0.0)) for rate in rates]
    return dict(zip(("peak_velocity", "peak_acceleration"), largest, strict=True))


def values(trials: Iterable[Record], field: str) -> list[float]:
    """Return the values of a field; trials that ended with an error have none."""
    return [float(t[field]) for t in trials if t.get(field) is not None]


def distribution(trials: Iterable[Record], field: str) -> tuple[float, float]:
    """Return median and 95th percentile of a field; NaN for no values."""
    found = values(trials, field)
    return (
        (float(np.median(found)), float(np.percentile(found, 95)))
        if found
        else (float("nan"), float("nan"))
    )
