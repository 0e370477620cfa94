"""Compares kinds of bases at a door and a drawer, of the scenes' robot or of others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, distribution, trial
from vkc_pin.experiments.harness.runner import Execution
from vkc_pin.experiments.harness.tables import JUDGED, count, format_table, join_sections, select
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.prepare import plan
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate

TASKS = {"door": {"hinge": 1.2}, "drawer": {"slide": 0.35}}
"""Scene → goal of the object of the same name."""
TURNING_RADIUS = 0.8
"""Turning radius of steered bases [m], an own choice: a little less than the Husky's length."""
BASES: dict[str, dict[str, Any]] = {
    "omni": {},
    "differential": {},
    "ackermann": {"turning_radius": TURNING_RADIUS},
}
"""Kind of base → further fields of the scene's robot."""


def make_start(
    task: str, base: str, seed: int, number: int, robot_file: str | None = None
) -> Scene:
    """Return a scene with a random start, which is the same for every kind of base.

    Args:
        task: Scene.
        base: One of `BASES`.
        seed: Random seed.
        number: Number of the start.
        robot_file: Another robot; see `Scene.with_robot`.
    """
    scene = load_scene(task)
    if robot_file is not None:
        scene = scene.with_robot(robot_file)
    scene = scene.sample_start(np.random.default_rng([seed, number]))
    robot = {**scene.document["robot"], "base": base, **BASES[base]}
    return Scene.from_document({**scene.document, "robot": robot}, scene.folder)


def run(
    *,
    out: str | Path,
    trials: int = 50,
    seed: int = 0,
    tasks: Sequence[str] | None = None,
    bases: Sequence[str] | None = None,
    robots: Sequence[str] | None = None,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        trials: Number of random starts per task and base, at least 1.
        seed: Random seed of starts and planning.
        tasks: Some of `TASKS`. Default: all.
        bases: Some of `BASES`. Default: all.
        robots: Names or robot.yaml files of other robots; see `Scene.with_robot`. Default: that of
            the scenes.

    Raises:
        InputError: A robot is invalid, or two have the same name.
    """
    runner.check_positive(trials=trials)
    tasks = list(runner.select_names("task", TASKS if tasks is None else tasks, TASKS))
    bases = list(runner.select_names("base", BASES if bases is None else bases, BASES))
    files = _name_robots(robots)
    settings = {
        "benchmark": "bases",
        "seed": seed,
        "starts": trials,
        "tasks": tasks,
        "bases": bases,
        "robots": list(files),
        "radius": TURNING_RADIUS,
    }
    specs = [
        {
            "key": f"{name}-{task}-{base}-{number:04d}",
            "robot": name,
            "file": file,
            "task": task,
            "base": base,
            "number": number,
            "seed": seed,
        }
        for name, file in files.items()
        for task in tasks
        for base in bases
        for number in range(trials)
    ]
    return runner.run(
        specs, _record, out, settings=settings, format_results=format_results, **execution
    )


def _name_robots(robots: Sequence[str] | None) -> dict[str, str | None]:
    """Return name → name or file of each robot; None: that of the scenes."""
    if robots is None:
        return {load_scene(next(iter(TASKS))).robot.name: None}
    found = {load_scene(next(iter(TASKS))).with_robot(robot).robot.name: robot for robot in robots}
    if not found or len(found) < len(robots):
        raise InputError(
            "not a choice",
            field="robots",
            expected="robots of different names",
            got=" ".join(robots) or "none",
        )
    return dict(found)


def format_results(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    rows = [
        _row(robot, task, base, records)
        for robot in about["robots"]
        for task in about["tasks"]
        for base in about["bases"]
    ]
    lines = [
        f"- {r['robot']}, {r['task']}, {r['base']}, start {r['number']}: {r['status']}; "
        f"{'; '.join(r['violations']) or 'no violation'}"
        for r in records
        if not r["success"]
    ]
    head = ["robot", "task", "base", "success", "time, median [s]", "95th percentile [s]"]
    head += ["evaluations", "Ipopt iterations", "base [m]", "arm [rad]", "motion [s]"]
    return join_sections(
        about,
        "# Bases that drive",
        f"{about['starts']} random starts, seed {about['seed']}; steered bases turn with a radius "
        f"of at least {about['radius']:g} m. {JUDGED} Times are those of all trials, without "
        "building symbolic programs; path lengths are medians, too.",
        format_table(head, rows),
        *(["\n".join(["Failures:", "", *lines])] if lines else []),
    )


def _row(robot: str, task: str, base: str, records: Sequence[Record]) -> list[str]:
    own = select(records, robot=robot, task=task, base=base)
    times = [f"{value:.3f}" for value in distribution(own, "planning_time")]
    counts = [f"{distribution(own, field)[0]:.0f}" for field in ("evaluations", "iterations")]
    good = select(own, success=True)
    lengths = [
        f"{distribution(good, field)[0]:.2f}"
        for field in ("base_path_length", "arm_path_length", "duration")
    ]
    return [robot, task, base, count(own), *times, *counts, *lengths]


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    task, base, seed, number = (spec[field] for field in ("task", "base", "seed", "number"))
    found: Plan = plan(
        make_start(task, base, seed, number, spec["file"]), [Actuate(task, TASKS[task])], seed=seed
    )
    if found.status == "interrupted":
        raise KeyboardInterrupt
    about = {"robot": spec["robot"], "task": task, "base": base, "number": number}
    duration = found.metrics["duration"]
    return trial(found, method="VKC", seed=seed, duration=duration, **about)
