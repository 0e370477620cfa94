"""Replays an executed motion on a web page, with the plan as a translucent ghost."""

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

# [Hz] key frames of a page
_RATE = 20.0


class Execution(Protocol):
    """An executed motion; see `SimulationResult`."""

    @property
    def scene(self) -> Scene:
        """Scene of the execution."""

    @property
    def planned(self) -> Trajectory:
        """The plan."""

    @property
    def trajectory(self) -> Trajectory:
        """The executed trajectory."""

    @property
    def rows(self) -> Floats:
        """World coordinates of the execution, shape (K, n)."""


class Replay(World):
    """A scene's tree along an executed motion instead of a plan.

    Args:
        scene: The scene.
        times: Sampling times, shape (K,) [s].
        rows: World coordinates at these times, shape (K, n).
    """

    def __init__(self, scene: Scene, times: Floats, rows: Floats) -> None:
        super().__init__(scene)
        self._times = times
        self._rows = rows.copy()
        for name, placed in scene.objects.items():
            if placed.object.free:
                self._align_quaternions(name)

    def _align_quaternions(self, name: str) -> None:
        """Choose signs of a free object's quaternions such that none jumps.

        q and −q are the same rotation, but interpolation passes all rotations between them.
        """
        placements = self._rows[:, self.get_placement_columns(name)]
        quaternions = placements[:, 3:]
        is_opposite = np.einsum("kc,kc->k", quaternions[1:], quaternions[:-1]) < 0.0
        signs = np.cumprod([1.0, *np.where(is_opposite, -1.0, 1.0)])
        quaternions *= signs[:, None]

    def compute_positions(
        self, trajectory: Trajectory, times: Any = None, free: FreeObjects | None = None
    ) -> Floats:
        """Return the world coordinates at times [s], shape (K,); see `World.compute_positions`."""
        moments = trajectory.times if times is None else np.asarray(times, float)
        return np.column_stack([np.interp(moments, self._times, column) for column in self._rows.T])


def write_page(
    executed: Execution, path: str | Path, *, headline: str, notes: Sequence[tuple[str, float]] = ()
) -> Path:
    """Write a self-contained web page with the executed motion and the plan as a ghost.

    Returns:
        The path.
    """
    import meshcat

    from vkc_pin.visualization.drawing import Drawing
    from vkc_pin.visualization.viewer import Recorder, render_page

    times = executed.trajectory.times
    begin = float(times[0])
    end = float(times[-1])
    frame_count = max(2, int((end - begin) * _RATE) + 1)
    frame_times = np.linspace(begin, end, frame_count)
    recorder = Recorder()
    drawing = Drawing(
        meshcat.Visualizer(window=recorder),
        executed.scene,
        executed.trajectory,
        world=Replay(executed.scene, times, executed.rows),
        times=frame_times,
        beside=sample_motion(World(executed.scene), executed.planned, frame_times),
    )
    drawing.draw(play=False)
    phases = [
        {"name": phase.name, "last": float(times[phase.last]) - begin}
        for phase in executed.trajectory.phases
    ]
    film = {
        "duration": end - begin,
        "phases": phases,
        "notes": [{"text": text, "time": time - begin} for text, time in notes],
        "because": [],
        "headline": f"{headline} (translucent: as planned)",
        "ghosts": False,
        "portrait": drawing.find_portrait_position(),
    }
    page = render_page(recorder, title=f"{headline} – vkc_pin", film=film)
    return write_atomically(path, page.encode("utf-8"))
