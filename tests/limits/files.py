"""Reads exported motions, and the limits of their coordinates with the readers of the oracle."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.oracle.plan import Curve, SavedPlan, read_plan
from tests.oracle.stage import World

__all__ = ["Limits", "Motion", "read_csv", "read_npz"]


@dataclass(frozen=True)
class Motion:
    """A motion of cubics with its coordinate names."""

    names: list[str]
    curve: Curve


@dataclass(frozen=True)
class Limits:
    """Limits of a coordinate, in SI units."""

    low: float
    high: float
    velocity: float
    acceleration: float
    jerk: float = math.inf


def read_npz(path: Path) -> tuple[Motion, dict[str, Limits]]:
    """Return the motion of a saved plan, and the limits in the files of its scene."""
    plan = read_plan(path)
    assert plan.curve is not None
    return Motion(plan.names, plan.curve), _read_limits(plan)


def read_csv(path: Path) -> Motion:
    """Return the motion in an exported table with one line per knot."""
    with path.open(encoding="utf-8", newline="") as file:
        head, *lines = list(csv.reader(file))
    titles = [cell.rpartition(" [")[0] for cell in head]
    names = [title.removesuffix(" velocity") for title in titles if title.endswith(" velocity")]
    columns = [
        [titles.index(title) for title in group]
        for group in (["time"], names, [f"{name} velocity" for name in names])
    ]
    times, positions, velocities = (
        np.array([[float(line[k]) for k in group] for line in lines]) for group in columns
    )
    return Motion(names, Curve(times[:, 0], positions, velocities))


def _read_limits(plan: SavedPlan) -> dict[str, Limits]:
    world = World(plan)
    limits = dict(world.robot.limits)
    for owner, item in world.objects.items():
        limits |= {f"{owner}.{joint}": values for joint, values in item.limits.items()}
        for grasp in item.grasps.values():
            for name, *_, low, high in grasp.freedoms:
                limits[f"{owner}.{name}"] = (low, high, math.inf, math.inf)
    for name, (begin, end) in (("base_x", world.arena[:2]), ("base_y", world.arena[2:])):
        low, high, velocity, acceleration = limits[name]
        limits[name] = (max(low, begin), min(high, end), velocity, acceleration)
    jerk_time = plan.options.get("jerk_time", 0.0)
    return {
        name: Limits(*values, values[3] / jerk_time if jerk_time else math.inf)
        for name, values in limits.items()
    }
