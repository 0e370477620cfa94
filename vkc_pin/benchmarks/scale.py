"""Planning time against the number of obstacles: the same task in the same room, with more and more boxes along its walls."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.record import Record, distribution, trial
from vkc_pin.benchmarks.harness.tables import TIMES, decimal, foot, markdown, quartiles
from vkc_pin.errors import InputError
from vkc_pin.files.writing import write_atomically
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import plan
from vkc_pin.plotting.style import COLOURS, new_figure, save_figure, styled
from vkc_pin.scene.scene import Scene, load_scene
from vkc_pin.task.steps import Actuate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COUNTS", "crowded", "report", "run", "scale_chart", "specify"]

COUNTS = (10, 30, 100, 300, 1000)
FEW = 30
"""The number of obstacles to whose planning times the others are compared."""
TIME_LIMIT = 60.0  # [s] of planning
_GOAL = {"hinge": 1.2}
_WEST, _EAST, _SOUTH, _NORTH, _HALL, _CEILING = -2.5, 2.5, -2.0, 2.0, 5.1, 2.4  # [m]: faces of the walls


def crowded(count: int, *, seed: int = 0) -> Scene:
    """Return scenes/door.yaml with so many obstacles: its walls, then its furniture, then small boxes that obstruct nobody.

    These hang on walls and ceiling, stand along the walls or outside of the room. More of them come after the same ones.

    Args:
        count: Number of obstacles, without the floor.
        seed: Of where they are.
    """
    scene = load_scene("door")
    own = sorted(scene.document["obstacles"], key=lambda item: "wall" not in item["name"])  # keeps the order otherwise
    rng = np.random.default_rng(seed)
    boxes = [_box(rng, number) for number in range(count - len(own))]
    return Scene.from_document({**scene.document, "name": f"door_{count}", "obstacles": [*own, *boxes][:count]}, scene.folder)


def _box(rng: np.random.Generator, number: int) -> dict[str, Any]:
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
    return {"name": f"box_{number}", "type": "box", "size": list(map(float, size)), "position": list(map(float, position))}


def specify(*, starts: int, seed: int, counts: Sequence[int]) -> list[dict[str, Any]]:
    """Return the trials: from every start all numbers of obstacles, one after the other, so that they meet the same machine.

    A start is free among as many obstacles as there are in any trial.
    """
    rng, scene = np.random.default_rng(seed), _crowded(max(*COUNTS, *counts))
    bases = [scene.sample_start(rng).start[:3].tolist() for _ in range(starts)]
    return [
        {"key": f"{number:04d}/{count:06d}", "obstacles": count, "number": number, "base": base, "seed": seed}
        for number, base in enumerate(bases)
        for count in counts
    ]


def run(
    *, starts: int, seed: int, out: str | Path, jobs: int = 1, counts: Sequence[int] = COUNTS, progress: bool = True
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv, table.md and scale.png to `out`.

    It is the whole task at the door: drive up, grasp, turn the knob, push.

    Args:
        starts: Number of random starts, the same for every number of obstacles.
        seed: Of the starts and of planning.
        out: The folder; if it has trials of the same settings already, they are not run again.
        jobs: Number of processes. Several slow each other down, and times are what this is about.
        counts: Numbers of obstacles.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}, each trial with its number of `obstacles`; see `runner.run`.

    Raises:
        InputError: A number of obstacles is less than 1, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    counts = sorted(set(counts))
    if not counts or counts[0] < 1:
        raise InputError("out of range", field="counts", expected="numbers of at least 1", got=counts)
    trials = specify(starts=starts, seed=seed, counts=counts)
    settings = {"benchmark": "scale", "seed": seed, "starts": starts, "counts": counts, "time_limit": TIME_LIMIT}
    result = runner.run(trials, _record, out, settings=settings, jobs=jobs, progress=progress)
    write_atomically(Path(out) / "table.md", report(result).encode())
    scale_chart(result["trials"], Path(out) / "scale.png", title="Opening the door among more and more obstacles")
    return result


def report(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown, with versions and machine at the foot."""
    about = result["meta"]
    timed = [record for record in result["trials"] if record.get("planning_time") is not None]  # all but errors
    few = {record["number"]: record["planning_time"] for record in timed if record["obstacles"] == FEW}
    rows = []
    for count in about["counts"]:
        everyone, own = ([r for r in records if r["obstacles"] == count] for records in (result["trials"], timed))
        ratios = [record["planning_time"] / few[record["number"]] for record in own if record["number"] in few]
        numbers = (*distribution(own, "planning_time"), quartiles(ratios)[1], *(distribution(own, part)[0] for part in TIMES))
        success = f"{sum(record['success'] for record in everyone)} of {len(everyone)}"
        iterations = f"{distribution(own, 'iterations')[0]:.0f}" if own else "–"
        rows.append([str(count), success, *map(decimal, numbers), iterations])
    head = ["obstacles", "success", "time, median [s]", "95th percentile [s]", f"times that of {FEW}"]
    head += [f"{name} [s]" for name in TIMES.values()] + ["Ipopt iterations"]
    parts = [
        "# Planning time against the number of obstacles",
        f"{about['starts']} random starts, the same for every number of obstacles; seed {about['seed']}. Success is the word of "
        f"the independent validation. Times are those of all trials; “times that of {FEW}” is the median, over starts, of the "
        f"ratio to the time among {FEW} obstacles. What follows are medians of parts of the time; the rest is setting up the "
        "problem.",
        markdown(head, rows),
        "![Planning time](scale.png)",
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def scale_chart(records: Sequence[Record], path: str | Path | None, *, title: str = "") -> Figure:
    """Draw planning time against the number of obstacles, and what it is spent on: medians, and quartiles of the whole.

    Args:
        records: Records as `record.trial` makes them, with `obstacles`; those without a planning time are left out.
        path: The file to write, .png, .svg or .pdf; None writes nothing.
        title: Written above.

    Returns:
        The figure.
    """
    records = [record for record in records if record.get("planning_time") is not None]
    counts = sorted({int(record["obstacles"]) for record in records})
    rows = [[record for record in records if record["obstacles"] == count] for count in counts]

    def medians(*fields: str) -> list[float]:
        """Return, for each number of obstacles, the median of the first field less the others."""
        return [float(np.median([record[fields[0]] - sum(record[f] for f in fields[1:]) for record in own])) for own in rows]

    low, middle, high = np.array([quartiles([record["planning_time"] for record in own]) for own in rows]).reshape(-1, 3).T
    parts = {name: medians(field) for field, name in TIMES.items()} | {"setting up": medians("planning_time", *TIMES)}
    with styled():
        figure = new_figure(6.4, 4.0)
        axes = figure.subplots()
        colours = [*COLOURS[: len(TIMES)], "0.7"]
        axes.stackplot(counts, *parts.values(), labels=[*parts], colors=colours, alpha=0.55)
        error = [middle - low, high - middle]
        axes.errorbar(counts, middle, error, color="0.15", marker="o", markersize=4.0, capsize=2.5, label="planning time")
        for count, height, value in zip(counts, high, middle, strict=True):
            axes.annotate(f"{value:.2f}", (count, height), (0, 5), textcoords="offset points", ha="center", fontsize=8)
        axes.set_xscale("log")
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.minorticks_off()
        axes.set_ylim(0.0, 1.15 * float(high.max(initial=0.0)) or 1.0)
        axes.set_xlabel("obstacles")
        axes.set_ylabel("planning time, median and quartiles [s]")
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside right upper")
        return save_figure(figure, path)


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    _warm(spec["seed"])
    scene = _crowded(spec["obstacles"]).with_start(base=spec["base"])
    return trial(_solve(scene, spec["seed"]), method="VKC", seed=spec["seed"], obstacles=spec["obstacles"], number=spec["number"])


def _solve(scene: Scene, seed: int) -> Plan:
    return plan(scene, [Actuate("door", _GOAL)], time_limit=TIME_LIMIT, seed=seed)


@functools.cache
def _warm(seed: int) -> None:
    """Plan once in this process, which pays for what is loaded and built only once."""
    if _solve(_crowded(COUNTS[0]), seed).status == "interrupted":
        raise KeyboardInterrupt


_crowded = functools.cache(crowded)  # once per process
