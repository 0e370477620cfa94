"""Where a robot may start in a scene, and random starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vkc_pin.errors import InputError

if TYPE_CHECKING:
    from vkc_pin.robot import Robot
    from vkc_pin.scene import Scene

__all__ = ["START_CLEARANCE", "StartRegion", "sampled_start", "start_limits"]

START_CLEARANCE = 0.03
"""Random starts keep the robot at least this far from everything but the floor [m]."""
_TRIES = 2000


@dataclass(frozen=True)
class StartRegion:
    """Where random starts are drawn from: intervals of the base's x and y [m] and heading [rad] (None: any)."""

    x: tuple[float, float]
    y: tuple[float, float]
    yaw: tuple[float, float] | None = None


def start_limits(robot: Robot) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the limits of a start, shape (n,), [m] and [rad]: the robot's; a base that cannot move may stand anywhere."""
    lower, upper = robot.lower.copy(), robot.upper.copy()
    if robot.base == "fixed":
        lower[:3], upper[:3] = -np.inf, np.inf
    return lower, upper


def sampled_start(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return a scene with the base at a random place of its start region; see `Scene.sample_start`."""
    region = scene.start_region
    if region is None:
        raise InputError("the scene has no start region", file=scene.file, field="start_region", expected="x and y intervals")
    for name in scene.held:
        if not scene.objects[name].object.free:
            raise InputError("the robot cannot start elsewhere while it holds this", file=scene.file, field=f"start.held.{name}")
    low, high = region.yaw or (-np.pi, np.pi)
    for _ in range(_TRIES):
        base = rng.uniform([region.x[0], region.y[0], low], [region.x[1], region.y[1], high])
        there = scene.with_start(base=base)
        if there.start_clearance(reach=START_CLEARANCE) >= START_CLEARANCE:
            return there
    problem = f"no free place for the robot in {_TRIES} tries"
    raise InputError(problem, file=scene.file, field="start_region", expected=f"a clearance of {START_CLEARANCE} m somewhere")
