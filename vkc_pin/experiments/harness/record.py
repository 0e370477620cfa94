"""Records trials, versions and machine."""

from __future__ import annotations

import functools
import subprocess
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from vkc_pin.planning.plan import Plan
from vkc_pin.utils.system import describe_machine, find_versions
from vkc_pin.world.files.resources import find_package_folder
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

Record = Mapping[str, Any]
"""Fields of a trial's record; see `trial`."""
Solve = Callable[[Scene, Mapping[str, Any]], Plan]
"""What plans a trial: takes its scene and its specification."""


def describe_environment(**settings: Any) -> dict[str, Any]:
    """Return commit, versions, machine and `settings`."""
    return {
        "commit": find_commit(),
        "versions": find_versions(),
        "machine": describe_machine(),
        **settings,
    }


@functools.cache
def find_commit() -> str | None:
    """Return the commit of the sources, with "-dirty" if they are changed; None without git."""
    folder = str(find_package_folder())
    command = ["git", "-C", folder, "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def trial(plan: Plan, *, method: str, seed: int, **more: Any) -> dict[str, Any]:
    """Return the record of a plan."""
    metrics = plan.metrics
    violations = plan.report.violations
    times = {name: value for name, value in metrics.items() if name.startswith("time_")}
    failed: str | None = None
    if not plan.success:
        failed = plan.status
        if violations:
            failed = f"{violations[0].constraint} {violations[0].subject}"
    return {
        "scene": plan.scene.name,
        "method": method,
        "start": np.asarray(plan.scene.start).round(9).tolist(),
        "seed": seed,
        "success": plan.success,
        "status": plan.status,
        "planning_time": metrics["planning_time"],
        "base_path_length": metrics["base_path_length"],
        "base_path_length_l1": metrics["base_path_length_l1"],
        "arm_path_length": metrics["arm_path_length"],
        "clearance": metrics["clearance"] if np.isfinite(metrics["clearance"]) else None,
        "closure_error": metrics["closure_error"],
        "iterations": int(metrics["iterations"]),
        "rounds": int(metrics["rounds"]),
        "evaluations": int(metrics.get("evaluations", 0)),
        "waypoints": len(plan.trajectory.times),
        "initialization": plan.initialization,
        "build_time": metrics["build_time"],
        **times,
        "failed_constraint": failed,
        "violations": [str(violation) for violation in violations],
        "commit": find_commit(),
        **more,
    }


def compute_peaks(trajectory: Trajectory) -> dict[str, float]:
    """Return the largest velocity [rad/s] and acceleration [rad/s²] of any arm joint."""
    arm = slice(3, trajectory.robot_size)
    if trajectory.curve is None:
        velocities = trajectory.velocities()
        accelerations = trajectory.accelerations()
    else:
        velocities, accelerations = trajectory.curve.compute_max_rates()
    return {
        "peak_velocity": float(np.abs(velocities[:, arm]).max(initial=0.0)),
        "peak_acceleration": float(np.abs(accelerations[:, arm]).max(initial=0.0)),
    }


def values(trials: Iterable[Record], field: str) -> list[float]:
    """Return the values of a field; errors have none."""
    return [float(t[field]) for t in trials if t.get(field) is not None]


def distribution(trials: Iterable[Record], field: str) -> tuple[float, float]:
    """Return median and 95th percentile of a field; NaN without values."""
    found = values(trials, field)
    if not found:
        return float("nan"), float("nan")
    return float(np.median(found)), float(np.percentile(found, 95))
