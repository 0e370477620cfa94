"""Measures planning time against the number of obstacles or segments."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, distribution, trial
from vkc_pin.experiments.harness.runner import LIMITS, Execution
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    TIMES,
    compute_quartiles,
    count,
    format_decimal,
    format_medians,
    format_table,
    join_sections,
    select,
)
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.prepare import plan
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Axis:
    """A quantity that is varied.

    Attributes:
        counts: Default values.
        usual: Value to whose planning times the others are compared.
        title: Title of the chart.
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
# [rad] of the hinge: 20 segments are too few for a larger motion
_OPENED = {"obstacles": 1.2, "segments": 0.6}
# Faces of the walls [m]
_WEST = -2.5
_EAST = 2.5
_SOUTH = -2.0
_NORTH = 2.0
_HALL = 5.1
_CEILING = 2.4


def make_crowded_scene(count: int, *, seed: int = 0) -> Scene:
    """Return scenes/door.yaml with `count` obstacles: walls, furniture, then small boxes.

    The boxes are on walls and ceiling or outside the room. Larger counts contain the smaller ones.
    """
    scene = load_scene("door")
    # The order stays otherwise.
    own = sorted(scene.document["obstacles"], key=lambda item: "wall" not in item["name"])
    rng = np.random.default_rng(seed)
    boxes = [_box(rng, number) for number in range(count - len(own))]
    return Scene.from_document(
        {**scene.document, "name": f"door_{count}", "obstacles": [*own, *boxes][:count]},
        scene.folder,
    )


def _box(rng: np.random.Generator, number: int) -> dict[str, Any]:
    """Return a small box on a wall, under the ceiling or outside."""
    along, depth, height = rng.uniform((0.03, 0.01, 0.03), (0.15, 0.05, 0.15))
    x, y, z = rng.uniform((-2.3, -1.9, height / 2), (2.3, 1.9, _CEILING - height / 2))
    # Of the door
    beside = rng.uniform(0.8, 1.9)
    sign = rng.choice([-1.0, 1.0])
    outside = (rng.uniform(-6.0, 6.0), sign * rng.uniform(2.4, 4.0), z)
    in_x = (depth, along, height)
    in_y = (along, depth, height)
    flat = (along, along, depth)
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


def make_refined_options(segments: int) -> Options:
    """Return options with which the task at the door has `segments` segments, at least 4."""
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
    """Return the trials: all counts from each start in turn, to meet the same machine load.

    Starts are free among the largest number of obstacles.
    """
    most = max(*AXES["obstacles"].counts, *(counts if of == "obstacles" else ()))
    rng = np.random.default_rng(seed)
    scene = _crowded(most)
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
    of: str = "obstacles",
    counts: Sequence[int] | None = None,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    The task is to open the door by 1.2 rad among obstacles, or by 0.6 rad in segments.

    Args:
        out: Folder.
        starts: Number of random starts.
        seed: Random seed of starts and planning.
        of: "obstacles", or "segments" among 30 obstacles.
        counts: Numbers of them. Default: those of `AXES`.
        **execution: See `Execution`; several jobs slow each other down.
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
    result = runner.run(trials, _record, out, settings=settings, **execution)
    write_atomically(Path(out) / "table.md", format_results(result).encode())
    scale_chart(result["trials"], Path(out) / "scale.png", of=of, title=AXES[of].title)
    return result


def format_results(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    rows = []
    of = about["of"]
    usual = AXES[of].usual
    timed = [record for record in records if record.get("planning_time") is not None]
    few = {r["number"]: r["planning_time"] for r in select(timed, **{of: usual})}
    for number in about["counts"]:
        own = select(timed, **{of: number})
        ratios = [r["planning_time"] / few[r["number"]] for r in own if r["number"] in few]
        times = map(
            format_decimal, (*distribution(own, "planning_time"), compute_quartiles(ratios)[1])
        )
        iterations = f"{distribution(own, 'iterations')[0]:.0f}" if own else "–"
        success = count(select(records, **{of: number}))
        rows.append([str(number), success, *times, *format_medians(own, *TIMES), iterations])
    head = [of, "success", "time, median [s]", "95th percentile [s]", f"ratio to {usual}"]
    head += [f"{name} [s]" for name in TIMES.values()] + ["Ipopt iterations"]
    return join_sections(
        about,
        f"# Planning time against the number of {of}",
        f"{about['starts']} random starts, the same for every number of {of}; seed "
        f"{about['seed']}. {JUDGED} Times are those of all trials; “ratio to {usual}” is the "
        f"median, over starts, of the ratio to the time with {usual} {of}. The other columns are "
        "medians of parts of the time; the rest is problem setup and retiming.",
        format_table(head, rows),
        "![Planning time](scale.png)",
    )


def scale_chart(
    records: Sequence[Record], path: str | Path | None, *, of: str = "obstacles", title: str = ""
) -> Figure:
    """Draw planning time and its parts against a count: medians, and quartiles of the whole.

    Args:
        path: File to write; None writes nothing.
        records: Records of `record.trial` with the field `of`.
        of: One of `AXES`.
        title: Title.
    """
    records = [record for record in records if record.get("planning_time") is not None]
    counts = sorted({int(record[of]) for record in records})
    rows = [[record for record in records if record[of] == count] for count in counts]

    def medians(*fields: str) -> list[float]:
        return [
            float(
                np.median(
                    [record[fields[0]] - sum(record[f] for f in fields[1:]) for record in own]
                )
            )
            for own in rows
        ]

    low, middle, high = (
        np.array([compute_quartiles([record["planning_time"] for record in own]) for own in rows])
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
    options = make_refined_options(spec["segments"]) if of == "segments" else Options()
    found = _solve(scene, spec["seed"], _OPENED[of], options)
    return trial(found, method="VKC", seed=spec["seed"], number=spec["number"], **{of: spec[of]})


def _solve(scene: Scene, seed: int, hinge: float, options: Options) -> Plan:
    return plan(scene, [Actuate("door", {"hinge": hinge})], options=options, seed=seed, **LIMITS)


@functools.cache
def _warm(seed: int) -> None:
    """Plan once in this process, to exclude one-time costs from times."""
    if (
        _solve(_crowded(AXES["obstacles"].counts[0]), seed, _OPENED["obstacles"], Options()).status
        == "interrupted"
    ):
        raise KeyboardInterrupt


_crowded = functools.cache(make_crowded_scene)  # once per process
