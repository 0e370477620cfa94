"""Planning time against the number of obstacles, more and more boxes along the walls, or of segments: the same task and room."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS
from vkc_pin.benchmarks.harness.record import Record, distribution, trial
from vkc_pin.benchmarks.harness.tables import TIMES, decimal, foot, markdown, quartiles
from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import plan
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["AXES", "Axis", "crowded", "refined", "report", "run", "scale_chart", "specify"]


@dataclass(frozen=True)
class Axis:
    """What there is more and more of.

    Attributes:
        counts: Numbers of it.
        usual: The number to whose planning times the others are compared.
        title: Of the chart.
    """

    counts: tuple[int, ...]
    usual: int
    title: str


AXES = {
    "obstacles": Axis(
        (10, 30, 100, 300, 1000), 30, "Opening the door among more and more obstacles"
    ),
    "segments": Axis((20, 40, 80, 160, 320), 80, "Opening the door in more and more segments"),
}
"""By the field of a trial's record."""
_OPENED = {
    "obstacles": 1.2,
    "segments": 0.6,
}  # [rad] of the hinge: in 20 segments a hand does not hold a handle on a longer way
_WEST, _EAST, _SOUTH, _NORTH, _HALL, _CEILING = (
    -2.5,
    2.5,
    -2.0,
    2.0,
    5.1,
    2.4,
)  # [m]: faces of the walls


def crowded(count: int, *, seed: int = 0) -> Scene:
    """Return scenes/door.yaml with so many obstacles: its walls, then its furniture, then small boxes that obstruct nobody.

    These hang on walls and ceiling, stand along the walls or outside of the room. More of them come
    after the same ones.

    Args:
        count: Number of obstacles, without the floor.
        seed: Of where they are.
    """
    scene = load_scene("door")
    own = sorted(
        scene.document["obstacles"], key=lambda item: "wall" not in item["name"]
    )  # keeps the order otherwise
    rng = np.random.default_rng(seed)
    boxes = [_box(rng, number) for number in range(count - len(own))]
    return Scene.from_document(
        {**scene.document, "name": f"door_{count}", "obstacles": [*own, *boxes][:count]},
        scene.folder,
    )


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
    return {
        "name": f"box_{number}",
        "type": "box",
        "size": list(map(float, size)),
        "position": list(map(float, position)),
    }


def refined(segments: int) -> Options:
    """Return options with which the task at the door has so many segments, 4 at least, and least times as the usual ones have."""
    usual = Options()
    whole = usual.reach_waypoints + usual.turn_waypoints + usual.move_waypoints
    turn, move = (
        max(1, round(part / whole * segments))
        for part in (usual.turn_waypoints, usual.move_waypoints)
    )
    return Options(
        reach_waypoints=segments - turn - move,
        turn_waypoints=turn,
        move_waypoints=move,
        dt=usual.dt * whole / segments,
    )


def specify(
    *, starts: int, seed: int, counts: Sequence[int], of: str = "obstacles"
) -> list[dict[str, Any]]:
    """Return the trials: from every start all numbers of one of `AXES` in turn, so that they meet the same machine.

    A start is free among as many obstacles as there are in any trial.
    """
    most = max(*AXES["obstacles"].counts, *(counts if of == "obstacles" else ()))
    rng, scene = np.random.default_rng(seed), _crowded(most)
    bases = [scene.sample_start(rng).start[:3].tolist() for _ in range(starts)]
    return [
        {
            "key": f"{number:04d}/{count:06d}",
            of: count,
            "number": number,
            "base": base,
            "seed": seed,
        }
        for number, base in enumerate(bases)
        for count in counts
    ]


def run(
    *,
    starts: int,
    seed: int,
    out: str | Path,
    jobs: int = 1,
    scheduler: str | None = None,
    of: str = "obstacles",
    counts: Sequence[int] | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv, table.md and scale.png to `out`.

    It is the whole task at the door: drive up, grasp, turn the knob, push, by 1.2 rad among
    obstacles and by 0.6 rad in segments.

    Args:
        starts: Number of random starts, the same for all numbers.
        seed: Of the starts and of planning.
        out: The folder; if it has trials of the same settings already, they are not run again.
        jobs: Number of processes. Several slow each other down, and times are what this is about.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        of: What there is more and more of, "obstacles" or "segments"; the latter among 30
            obstacles.
        counts: How many; None: those of `AXES`.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}, each trial with its number of `obstacles` or `segments`; see
        `runner.run`.

    Raises:
        InputError: `of` is unknown, a number is less than 1 (of segments: less than 4), or `out`
            has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    if of not in AXES:
        raise InputError("unknown", field="of", expected=" or ".join(AXES), got=of)
    counts = sorted(set(AXES[of].counts if counts is None else counts))
    least = 4 if of == "segments" else 1
    if not counts or counts[0] < least:
        raise InputError(
            "out of range", field="counts", expected=f"numbers of at least {least}", got=counts
        )
    trials = specify(starts=starts, seed=seed, counts=counts, of=of)
    settings = {
        "benchmark": "scale",
        "of": of,
        "seed": seed,
        "starts": starts,
        "counts": counts,
        **LIMITS,
    }
    result = runner.run(
        trials, _record, out, settings=settings, jobs=jobs, scheduler=scheduler, progress=progress
    )
    write_atomically(Path(out) / "table.md", report(result).encode())
    scale_chart(result["trials"], Path(out) / "scale.png", of=of, title=AXES[of].title)
    return result


def report(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown, with versions and machine at the foot."""
    about = result["meta"]
    of = about["of"]
    usual = AXES[of].usual
    timed = [
        record for record in result["trials"] if record.get("planning_time") is not None
    ]  # all but errors
    few = {record["number"]: record["planning_time"] for record in timed if record[of] == usual}
    rows = []
    for count in about["counts"]:
        everyone, own = (
            [r for r in records if r[of] == count] for records in (result["trials"], timed)
        )
        ratios = [
            record["planning_time"] / few[record["number"]]
            for record in own
            if record["number"] in few
        ]
        numbers = (
            *distribution(own, "planning_time"),
            quartiles(ratios)[1],
            *(distribution(own, part)[0] for part in TIMES),
        )
        success = f"{sum(record['success'] for record in everyone)} of {len(everyone)}"
        iterations = f"{distribution(own, 'iterations')[0]:.0f}" if own else "–"
        rows.append([str(count), success, *map(decimal, numbers), iterations])
    head = [of, "success", "time, median [s]", "95th percentile [s]", f"times that of {usual}"]
    head += [f"{name} [s]" for name in TIMES.values()] + ["Ipopt iterations"]
    parts = [
        f"# Planning time against the number of {of}",
        f"{about['starts']} random starts, the same for every number of {of}; seed {about['seed']}. Success is the word of "
        f"the independent validation. Times are those of all trials; “times that of {usual}” is the median, over starts, of the "
        f"ratio to the time with {usual} {of}. What follows are medians of parts of the time; the rest is setting up the "
        "problem.",
        markdown(head, rows),
        "![Planning time](scale.png)",
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def scale_chart(
    records: Sequence[Record], path: str | Path | None, *, of: str = "obstacles", title: str = ""
) -> Figure:
    """Draw planning time against the number of something, and what it is spent on: medians, and quartiles of the whole.

    Args:
        records: Records as `record.trial` makes them, with the field `of`; those without a planning
            time are left out.
        path: The file to write, .png, .svg or .pdf; None writes nothing.
        of: What there is more and more of, one of `AXES`.
        title: Written above.

    Returns:
        The figure.
    """
    records = [record for record in records if record.get("planning_time") is not None]
    counts = sorted({int(record[of]) for record in records})
    rows = [[record for record in records if record[of] == count] for count in counts]

    def medians(*fields: str) -> list[float]:
        """Return, for each number of obstacles, the median of the first field less the others."""
        return [
            float(
                np.median(
                    [record[fields[0]] - sum(record[f] for f in fields[1:]) for record in own]
                )
            )
            for own in rows
        ]

    low, middle, high = (
        np.array([quartiles([record["planning_time"] for record in own]) for own in rows])
        .reshape(-1, 3)
        .T
    )
    parts = {name: medians(field) for field, name in TIMES.items()} | {
        "setting up": medians("planning_time", *TIMES)
    }
    with use_style():
        figure = new_figure(6.4, 4.0)
        axes = figure.subplots()
        colours = [*COLOURS[: len(TIMES)], "0.7"]
        axes.stackplot(counts, *parts.values(), labels=[*parts], colors=colours, alpha=0.55)
        error = [middle - low, high - middle]
        axes.errorbar(
            counts,
            middle,
            error,
            color="0.15",
            marker="o",
            markersize=4.0,
            capsize=2.5,
            label="planning time",
        )
        for count, height, value in zip(counts, high, middle, strict=True):
            axes.annotate(
                f"{value:.2f}",
                (count, height),
                (0, 5),
                textcoords="offset points",
                ha="center",
                fontsize=8,
            )
        axes.set_xscale("log")
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.minorticks_off()
        axes.set_ylim(0.0, 1.15 * float(high.max(initial=0.0)) or 1.0)
        axes.set_xlabel(of)
        axes.set_ylabel("planning time, median and quartiles [s]")
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside right upper")
        return save_figure(figure, path)


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    _warm(spec["seed"])
    of = next(name for name in AXES if name in spec)
    scene = _crowded(spec.get("obstacles", AXES["obstacles"].usual)).with_start(base=spec["base"])
    options = refined(spec["segments"]) if of == "segments" else Options()
    found = _solve(scene, spec["seed"], _OPENED[of], options)
    return trial(found, method="VKC", seed=spec["seed"], number=spec["number"], **{of: spec[of]})


def _solve(scene: Scene, seed: int, hinge: float, options: Options) -> Plan:
    return plan(scene, [Actuate("door", {"hinge": hinge})], options=options, seed=seed, **LIMITS)


@functools.cache
def _warm(seed: int) -> None:
    """Plan once in this process, which pays for what is loaded and built only once."""
    if (
        _solve(_crowded(AXES["obstacles"].counts[0]), seed, _OPENED["obstacles"], Options()).status
        == "interrupted"
    ):
        raise KeyboardInterrupt


_crowded = functools.cache(crowded)  # once per process
