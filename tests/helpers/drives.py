"""Makes an empty hall, and unplanned motions through it."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

DT = 0.25  # [s]


def make_hall(
    *, base: str = "omni", obstacles: Sequence[Mapping[str, Any]] = (), **robot: Any
) -> Scene:
    """Return a hall of 12 m x 12 m with the Husky at its centre; `robot` adds fields of it."""
    return make_scene(
        {
            "robot": {"name": "husky_ur5e", "base": base, **robot},
            "start": {"base": [0.0, 0.0, 0.0], "arm": "home"},
            "arena": {"x": [-6.0, 6.0], "y": [-6.0, 6.0]},
            "obstacles": list(obstacles),
        }
    )


def make_scene(document: Mapping[str, Any]) -> Scene:
    """Return the scene of a document, cached."""
    return _build_scene(json.dumps(document))


@cache
def _build_scene(text: str) -> Scene:
    return Scene.from_document(json.loads(text))


def drive_through(scene: Scene, *stops: np.ndarray, steps: int = 40, dt: float = DT) -> Trajectory:
    """Return a motion through `stops`, shape (n,) each, at rest at each."""
    fraction = np.linspace(0.0, 1.0, steps + 1)[1:, None]
    smooth = fraction**2 * (3.0 - 2.0 * fraction)
    rows = [stops[0][None]]
    for before, after in itertools.pairwise(stops):
        rows.append(before + smooth * (after - before))
    phases = tuple(
        PhaseSpan(f"drive {k + 1}", k * steps, (k + 1) * steps) for k in range(len(stops) - 1)
    )
    return make_trajectory(scene, np.vstack(rows), dt=dt, phases=phases)


def make_trajectory(
    scene: Scene, rows: np.ndarray, *, dt: float = DT, phases: tuple[PhaseSpan, ...] = ()
) -> Trajectory:
    """Return a motion of the robot alone through `rows`, shape (T, n), with time step `dt`."""
    names = scene.robot.coordinates.names
    phases = phases or (PhaseSpan("drive", 0, len(rows) - 1),)
    return Trajectory(names, dt * np.arange(len(rows)), rows, phases, len(names))


def move_start(start: np.ndarray, **values: float) -> np.ndarray:
    """Return `start` with other values of the base's x, y and yaw."""
    out = np.array(start)
    for name, value in values.items():
        out[("x", "y", "yaw").index(name)] = value
    return out


def replace_positions(trajectory: Trajectory, positions: np.ndarray) -> Trajectory:
    """Return the motion with other waypoints."""
    return dataclasses.replace(trajectory, positions=positions)
