"""Planning time against the number of obstacles: the same task in the same room, with more and more things along its walls."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from vkc_pin.benchmarks.charts import scale_chart
from vkc_pin.benchmarks.record import distribution, meta, peak_memory, trial
from vkc_pin.planner import plan
from vkc_pin.scene import Scene, load_scene
from vkc_pin.steps import Actuate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COUNTS", "crowded", "draw", "run", "table"]

COUNTS = (10, 30, 100, 300, 1000)
_GOAL = {"hinge": 1.2}
_WEST, _EAST, _SOUTH, _NORTH, _HALL, _CEILING = -2.5, 2.5, -2.0, 2.0, 5.1, 2.4  # [m]: faces of the walls
_PARTS = ("initialization", "coal", "casadi", "ipopt", "validation")


def crowded(count: int, *, seed: int = 0) -> Scene:
    """Return scenes/door.yaml with so many obstacles: its walls, then its furniture, then small boxes that are in nobody's way.

    These hang on walls and ceiling, stand along the walls or outside of the room. More of them come after the same ones.

    Args:
        count: Number of obstacles, without the floor.
        seed: Of where things are.
    """
    scene = load_scene("door")
    own = sorted(scene.document["obstacles"], key=lambda item: "wall" not in item["name"])  # keeps the order otherwise
    rng = np.random.default_rng(seed)
    things = [_thing(rng, number) for number in range(count - len(own))]
    return Scene.from_document({**scene.document, "name": f"door_{count}", "obstacles": [*own, *things][:count]}, scene.folder)


def _thing(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """Return a small box somewhere along the walls, under the ceiling or outside."""
    along, depth, height = rng.uniform((0.03, 0.01, 0.03), (0.15, 0.05, 0.15))
    x, y, z = rng.uniform((-2.3, -1.9, height / 2), (2.3, 1.9, _CEILING - height / 2))
    beside, sign = rng.uniform(0.8, 1.9), rng.choice([-1.0, 1.0])  # of the door
    outside = (rng.uniform(-6.0, 6.0), sign * rng.uniform(2.4, 4.0), z)
    in_x, in_y, flat = (depth, along, height), (along, depth, height), (along, along, depth)
    size, position = (
        (in_x, (_WEST + depth / 2, y, z)),
        (in_x, (_EAST - depth / 2, sign * beside, z)),
        (in_x, (_HALL - depth / 2, y, z)),
        (in_y, (x, _NORTH - depth / 2, z)),
        (in_y, (x, _SOUTH + depth / 2, z)),
        (flat, (x, y, _CEILING - depth / 2)),
        (in_y, outside),
    )[rng.integers(7)]
    return {"name": f"thing_{number}", "type": "box", "size": list(map(float, size)), "position": list(map(float, position))}


def run(*, counts: Sequence[int] = COUNTS, repeats: int = 5, seed: int = 0, progress: bool = True) -> dict[str, Any]:
    """Plan the whole task at the door (drive up, grasp, turn the knob, push) among different numbers of obstacles.

    Args:
        counts: Numbers of obstacles.
        repeats: How often each is planned; the numbers take turns, so that a busy moment does not hit one of them alone.
        seed: Of where things are, and of planning.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}, one object a plan, with the number of `obstacles`.
    """
    scenes = {count: crowded(count, seed=seed) for count in counts}
    plan(next(iter(scenes.values())), [Actuate("door", _GOAL)], seed=seed)  # pays for what is built once
    records = []
    for number in tqdm(range(repeats), desc="scale", unit="round", disable=not progress):
        for count, scene in scenes.items():
            result = plan(scene, [Actuate("door", _GOAL)], seed=seed)
            records.append(trial(result, method="VKC", seed=seed, obstacles=count, number=number))
    about = meta(benchmark="scale", seed=seed, repeats=repeats, counts=list(counts), peak_memory_mb=peak_memory())
    return {"meta": about, "trials": records}


def table(result: dict[str, Any]) -> str:
    """Return medians of planning time and its parts as text, a line for each number of obstacles."""
    lines = [f"{'obstacles':>9}{'success':>9}{'time [s]':>10}" + "".join(f"{part:>16}" for part in _PARTS)]
    for count in result["meta"]["counts"]:
        rows = [record for record in result["trials"] if record["obstacles"] == count]
        success = f"{sum(record['success'] for record in rows)}/{len(rows)}"
        medians = "".join(f"{distribution(rows, f'time_{part}')[0]:>16.3f}" for part in _PARTS)
        lines.append(f"{count:>9}{success:>9}{distribution(rows, 'planning_time')[0]:>10.3f}{medians}")
    return "\n".join(lines)


def draw(result: dict[str, Any], path: str | Path | None = None) -> Figure:
    """Draw what `run` returns; see `charts.scale_chart`."""
    return scale_chart(result["trials"], path, title="Opening the door among more and more obstacles")
