"""Plans the rest of motions again, towards objects that have been displaced."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np

import vkc_pin as vkc
from vkc_pin.experiments.closed_loop import displace_object
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, trial
from vkc_pin.experiments.harness.runner import LIMITS, Execution
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    count,
    format_decimal,
    format_table,
    join_sections,
    select,
)
from vkc_pin.experiments.tasks import TASKS as ALL
from vkc_pin.experiments.tasks import make_start
from vkc_pin.planning.plan import Plan

TASKS = ("door", "corridor_door", "drawer", "household_refrigerator")
"""Tasks whose motions are planned again."""

_SHIFT = 0.05  # [m], largest
_TURN = float(np.radians(5.0))  # largest
_MOMENTS = (0.1, 0.6)  # shares of the time until the grasp at which the new motion begins
_REPEATS = 2  # of which the faster one counts


def run(
    *,
    out: str | Path,
    starts: int = 15,
    seed: int = 0,
    tasks: Sequence[str] | None = None,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        starts: Number of random starts and displacements per task.
        seed: Random seed of starts, displacements and planning.
        tasks: Some of `TASKS`. Default: all.
    """
    runner.check_positive(starts=starts)
    names = runner.select_names("task", TASKS if tasks is None else tasks, TASKS)
    settings = {
        "benchmark": "replans",
        "seed": seed,
        "starts": starts,
        "tasks": names,
        **LIMITS,
    }
    specs = []
    for name in names:
        for number in range(starts):
            key = f"{TASKS.index(name)}/{number:04d}"
            specs.append({"key": key, "task": name, "number": number, "seed": seed})
    return runner.run(
        specs, _record, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown."""
    about = result["meta"]
    rows = []
    for name in about["tasks"]:
        own = select(result["trials"], task=name)
        replanned = [record for record in own if "replan" in record]
        possible = [record for record in replanned if record["possible"]]
        row = [name, f"{len(possible)} of {len(own)}", count(possible)]
        for field in ("whole", "moving", "replan"):
            times = [1e3 * record[field] for record in possible]
            row.append(f"{np.median(times):.0f}" if times else "–")
        for field in ("whole", "moving"):
            ratios = [record["replan"] / record[field] for record in possible]
            row += _summarize(ratios)
        longer = [record["longer"] for record in possible if record["longer"] is not None]
        row += _summarize(longer)
        rows.append(row)
    head = ["task", "possible", "success", "whole [ms]", "moving [ms]", "replan [ms]"]
    for ratio in ("to whole", "to moving", "duration"):
        head += [ratio, "95th percentile"]
    return join_sections(
        about,
        "# Motions that are planned again",
        f"{about['starts']} random starts per task, seed {about['seed']}. Objects are displaced by "
        f"up to {1e3 * _SHIFT:.0f} mm and {np.degrees(_TURN):.0f}° while the robot moves. {JUDGED} "
        "It counts where a whole plan to the displaced object exists: a door may be in its wall. "
        "Medians of CPU times: of a plan from the start, to the displaced object; of a plan from "
        "the moving state; and of `replan` there. Then medians and 95th percentiles of ratios: of "
        "the times, and of the duration to the rest of the plan before.",
        format_table(head, rows),
    )


def _summarize(ratios: Sequence[float]) -> list[str]:
    """Return the median and the 95th percentile."""
    if not ratios:
        return ["–", "–"]
    return [format_decimal(float(np.quantile(ratios, share))) for share in (0.5, 0.95)]


def _record(spec: dict[str, Any]) -> Record:
    """Plan from one start, displace the object, and plan the rest again."""
    name, number, seed = spec["task"], spec["number"], spec["seed"]
    _warm(name, seed)
    rng = np.random.default_rng([seed, TASKS.index(name), number])
    start = make_start(name, seed, number)
    steps = ALL[name].steps
    before = vkc.plan(start, steps, seed=seed, **LIMITS)
    fields: dict[str, Any] = {"method": "VKC", "seed": seed, "task": name, "number": number}
    if not before.success:
        return trial(before, **fields)
    motion = before.trajectory
    (step,) = steps
    assert isinstance(step, vkc.Actuate)
    at = start.objects[step.object].placement.translation
    displaced = displace_object(start, step.object, _SHIFT, _TURN, at, rng)
    closing = float(motion.times[motion.phases[0].last])
    moment = closing * rng.uniform(*_MOMENTS)
    placement = displaced.objects[step.object].placement
    now = before.scene_at(moment).with_placement(step.object, placement)

    found, replan = _measure(lambda: vkc.replan(before, moment, scene=now))
    from_start, whole = _measure(lambda: vkc.plan(displaced, steps, seed=seed, **LIMITS))
    _, moving = _measure(lambda: vkc.plan(now, steps, seed=seed, **LIMITS))
    longer = None
    if found.success:
        left = float(motion.times[-1]) - moment
        longer = float(found.trajectory.times[-1]) / left
    fields |= {"moment": moment, "longer": longer, "possible": from_start.success}
    fields |= {"whole": whole, "moving": moving, "replan": replan}
    return trial(found, **fields)


def _measure(make: Callable[[], Plan]) -> tuple[Plan, float]:
    """Return a plan, and the CPU time that it takes [s]."""
    fastest = np.inf
    for _ in range(_REPEATS):
        began = time.process_time()
        found = make()
        fastest = min(fastest, time.process_time() - began)
    return found, fastest


@functools.cache
def _warm(name: str, seed: int) -> None:
    """Plan again once in this process, to exclude one-time costs from times."""
    found = vkc.plan(make_start(name, seed, 0), ALL[name].steps, seed=seed, **LIMITS)
    if found.success:
        vkc.replan(found, 0.1 * float(found.trajectory.times[-1]))
