"""Opens every object with every robot, and tabulates the results."""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, distribution, trial
from vkc_pin.experiments.harness.runner import LIMITS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    format_decimal,
    format_medians,
    format_table,
    join_sections,
)
from vkc_pin.planning.prepare import plan
from vkc_pin.visualization.plots.style import new_figure, save_figure, use_style
from vkc_pin.world.models.robot_file import load_robot

from .pairs import (
    OBJECTS,
    ROBOTS,
    SHARE,
    get_kind,
    make_pair,
    parse_requests,
    prepare_object,
    prepare_robot,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_SUMMARY = (
    "robot",
    "base",
    "combinations",
    "reachable",
    "open from all starts",
    "from any",
    "time, median [s]",
    "95th percentile [s]",
    "load again [s]",
)
_ALL = "all"
_UNREACHED = ("unreachable", "no hand")


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    groups = _groups(records)
    robots, objects = (list(dict.fromkeys(key[k] for key in groups)) for k in (0, 1))
    rows = [[name, *(_cell(groups.get((robot, name), ())) for robot in robots)] for name in objects]
    return join_sections(
        about,
        "# Robots × objects",
        f"{len(robots)} robots, {len(objects)} objects of {len(set(map(get_kind, objects)))} "
        "kinds, "
        f"{about['starts']} random starts each, seed {about['seed']}, {describe_limit(about)} "
        "each. A "
        f"joint is opened by {about['share']:.0%} of its range, by any proposed attachment; an "
        "object is within reach if the hand gets to it both closed and open by so much. "
        f"{JUDGED} Times are those of all plans; loading again is the median over all "
        "combinations of a robot.",
        format_table(_SUMMARY, [_summary(robot, groups) for robot in (*robots, _ALL)], text=2),
        "## Every combination",
        "How many starts succeed; – is out of reach, ! could not be tried.",
        format_table(["object", *robots], rows),
        *_list_failures("What failed", [r for r in records if not r["success"] and _is_reached(r)]),
        *_list_failures("Out of reach", [r for r in records if not _is_reached(r)]),
    )


def chart(records: Sequence[Record], path: str | Path | None) -> Figure:
    """Draw the share of successful starts by object and robot; unreachable combinations are grey.

    Args:
        path: File to write; None writes nothing.
        records: Records of `run`.
    """
    groups = _groups(records)
    robots, objects = (list(dict.fromkeys(key[k] for key in groups)) for k in (0, 1))
    share = np.full((len(objects), len(robots)), np.nan)
    with use_style():
        figure = new_figure(4.5 + 0.6 * len(robots), 2.4 + 0.24 * len(objects))
        axes = figure.subplots()
        for i, name in enumerate(objects):
            for j, robot in enumerate(robots):
                own = groups.get((robot, name), ())
                if any(map(_is_reached, own)):
                    share[i, j] = 100.0 * float(np.mean([bool(r["success"]) for r in own]))
                axes.text(j, i, _cell(own), ha="center", va="center", fontsize=7.5)
        axes.set_facecolor("0.85")
        image = axes.imshow(share, cmap="RdYlGn", vmin=0.0, vmax=100.0, aspect="auto", alpha=0.75)
        axes.set_xticks(range(len(robots)), robots, rotation=45, ha="right")
        axes.set_yticks(range(len(objects)), objects)
        axes.grid(visible=False)
        figure.colorbar(image, ax=axes, label="successful starts [%]", shrink=0.6)
        axes.set_title("Opening by proposed attachments; grey is out of reach", fontsize=10)
        return save_figure(figure, path)


def _groups(records: Sequence[Record]) -> dict[tuple[str, str], list[Record]]:
    """Return (robot, object) → records."""
    groups: dict[tuple[str, str], list[Record]] = {}
    for record in records:
        groups.setdefault((record["robot"], record["object"]), []).append(record)
    return groups


def _is_reached(record: Record) -> bool:
    return record["status"] not in _UNREACHED


def _cell(own: Sequence[Record]) -> str:
    if any(record["status"] == "error" for record in own):
        return "!"
    good = sum(bool(record["success"]) for record in own)
    return f"{good}/{len(own)}" if own and all(map(_is_reached, own)) else "–"


def _summary(robot: str, groups: Mapping[tuple[str, str], Sequence[Record]]) -> list[str]:
    """Return the row of a robot, or of all."""
    chosen = [own for key, own in groups.items() if robot in (key[0], _ALL)]
    reached = [own for own in chosen if all(map(_is_reached, own))]
    flat = [record for own in chosen for record in own]
    bases = dict.fromkeys(str(r["base"]) for r in flat if "base" in r)
    cells = [robot, ", ".join(bases) or "–", str(len(chosen)), str(len(reached))]
    for judge in (all, any):
        good = sum(judge(record["success"] for record in own) for own in reached)
        cells.append(f"{good} ({good / max(len(reached), 1):.0%})")
    times = map(format_decimal, distribution(flat, "planning_time"))
    return [*cells, *times, *format_medians(flat, "load_time")]


def _list_failures(title: str, records: Sequence[Record]) -> list[str]:
    """Return a section of failures with their reasons and counts."""
    rows = Counter[tuple[str, ...]]()
    for r in records:
        why = r.get("because") or "; ".join(r.get("violations", ())[:1])
        name = "every object" if r["status"] == "no hand" else r["object"]
        rows[r["robot"], name, str(r["status"]), why] += 1
    body = [[*place, str(number), why] for (*place, why), number in rows.items()]
    head = ["robot", "object", "status", "trials", "because"]
    return [f"## {title}", format_table(head, body, text=5)] if records else []


def run(
    *,
    out: str | Path,
    starts: int = 5,
    seed: int = 0,
    robots: Sequence[str] = ROBOTS,
    objects: Sequence[str] = OBJECTS,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder; see `runner.run`. Robots and objects are imported into its subfolders.
        starts: Number of random starts per combination, at least 1.
        seed: Random seed of starts and planning.
        robots: Names and files for `load_robot`, or MJCF files; "default" stands for `ROBOTS`.
            See `pairs.parse_requests`.
        objects: `<kind>_<seed>` of `random_object`, names in scenes/objects, descriptions, or URDF,
            MJCF and SDF files; "default" stands for `OBJECTS`.

    Returns:
        See `runner.run`. An unreachable combination has one record of status "unreachable" or
        "no hand", with the reason in `because`.
    """
    runner.check_positive(starts=starts)
    runner.check_folder(out)
    chosen = [parse_requests(robots, "robots", ROBOTS), parse_requests(objects, "objects", OBJECTS)]
    object_files = {one.called: prepare_object(one, Path(out) / "objects") for one in chosen[1]}
    ready = {one.called: prepare_robot(one, Path(out) / "robots") for one in chosen[0]}
    settings = {
        "benchmark": "anything",
        "seed": seed,
        "starts": starts,
        "share": SHARE,
        "robots": list(ready),
        **LIMITS,
    }
    specs = [
        {
            "key": f"{robot}/{name}",
            "robot": robot,
            "object": name,
            "files": [file, path],
            "starts": starts,
            "seed": seed,
        }
        for robot, file in ready.items()
        for name, path in object_files.items()
    ]
    result = runner.run(
        specs, _records, out, settings=settings, format_results=format_results, **execution
    )
    chart(result["trials"], Path(out) / "success.png")
    return result


def _records(spec: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a record of every start, or one if the object is unreachable."""
    seed = spec["seed"]
    file, object_file = spec["files"]
    about: dict[str, Any] = {
        "robot": spec["robot"],
        "object": spec["object"],
        "kind": get_kind(spec["object"]),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings about a robot would repeat for every object
        began = time.perf_counter()
        robot = load_robot(file)
        about |= {"load_time": time.perf_counter() - began, "base": robot.base}
        began = time.perf_counter()
        found = make_pair(robot, file, object_file, seed=seed)
        about["look_time"] = time.perf_counter() - began
        if found.scene is None or found.step is None:
            status = "no hand" if found.scene is None else "unreachable"
            out_of_reach = {
                "success": False,
                "status": status,
                "seed": seed,
                "because": found.because,
            }
            return [{**about, **out_of_reach}]
        ((joint, goal),) = found.step.joints.items()
        about |= {"joint": joint, "goal": goal}
        records = []
        for number in range(spec["starts"]):
            scene = found.scene.sample_start(np.random.default_rng([7, seed, number]))
            one = plan(scene, [found.step], seed=seed, **LIMITS)
            because = "; ".join(one.report.notes)
            taken = one.trajectory.phases[-1].held.get(found.step.object, "")
            records.append(
                trial(
                    one,
                    method="VKC",
                    seed=seed,
                    number=number,
                    **about,
                    attachment=taken,
                    because=because,
                )
            )
    return records
