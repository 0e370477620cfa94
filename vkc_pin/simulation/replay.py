"""What happened in physics as a page: the motion, and beside it as a ghost what was planned."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.free_objects import FreeObjects
from vkc_pin.world.trajectory.placements import sample_motion
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Executed", "Replay", "page"]

_RATE = 20.0  # key frames a second in a page


class Executed(Protocol):
    """What happened; see `SimulationResult`."""

    @property
    def scene(self) -> Scene:
        """Where."""

    @property
    def planned(self) -> Trajectory:
        """What was planned."""

    @property
    def trajectory(self) -> Trajectory:
        """What came of it."""

    @property
    def rows(self) -> Floats:
        """The same of everything, shape (K, n)."""


class Replay(World):
    """A scene's tree along what happened, instead of along a plan.

    Args:
        scene: The scene.
        times: When it was looked at, shape (K,) [s].
        rows: Its coordinates then, shape (K, n).
    """

    def __init__(self, scene: Scene, times: Floats, rows: Floats) -> None:
        super().__init__(scene)
        self._times, self._rows = times, rows.copy()
        for name in (name for name, placed in scene.objects.items() if placed.object.free):
            turns = self._rows[:, self.placement_columns(name)][:, 3:]
            signs = np.cumprod(
                np.concatenate(
                    [[1.0], np.where(np.einsum("kc,kc->k", turns[1:], turns[:-1]) < 0.0, -1.0, 1.0)]
                )
            )
            self._rows[:, self.placement_columns(name)][:, 3:] *= signs[:, None]

    def positions(
        self, trajectory: Trajectory, times: Any = None, free: FreeObjects | None = None
    ) -> Floats:
        """Return where everything was at times [s], shape (K,); see `World.positions`."""
        moments = trajectory.times if times is None else np.asarray(times, float)
        return np.column_stack([np.interp(moments, self._times, column) for column in self._rows.T])


def page(
    executed: Executed, path: str | Path, *, headline: str, notes: Sequence[tuple[str, float]] = ()
) -> Path:
    """Write one self-contained web page: what happened, and what was planned as a translucent ghost; return its path.

    Args:
        executed: What happened.
        path: The file, written whole or not at all.
        headline: Of the page.
        notes: Texts to show at times [s].
    """
    import meshcat

    from vkc_pin.visualization.drawing import Drawing
    from vkc_pin.visualization.viewer import Recorder, render_page

    times, phases = executed.trajectory.times, executed.trajectory.phases
    moments = np.linspace(times[0], times[-1], max(2, int((times[-1] - times[0]) * _RATE) + 1))
    world, recorder = Replay(executed.scene, times, executed.rows), Recorder()
    beside = sample_motion(World(executed.scene), executed.planned, moments)
    viewer = meshcat.Visualizer(window=recorder)
    Drawing(
        viewer, executed.scene, executed.trajectory, world=world, times=moments, beside=beside
    ).draw(play=False)
    begin = float(times[0])
    film = {
        "duration": float(times[-1]) - begin,
        "phases": [
            {"name": phase.name, "last": float(times[phase.last]) - begin} for phase in phases
        ],
        "notes": [{"text": text, "time": time - begin} for text, time in notes],
        "headline": f"{headline} (translucent: as planned)",
        "ghosts": False,
    }
    return write_atomically(
        path, render_page(recorder, title=f"{headline} – vkc_pin", film=film).encode("utf-8")
    )
