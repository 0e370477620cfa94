"""Compares other planners, the baselines and this package at the same problems."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Unpack

from vkc_pin.experiments.baselines.separate import BASELINES, plan_separately
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, distribution, trial, values
from vkc_pin.experiments.harness.runner import Execution
from vkc_pin.experiments.harness.tables import (
    JUDGED,
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
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_optional

from .constraint_graph import plan_by_constraint_graph
from .found import (
    Clock,
    Peer,
    PeerResult,
    compute_clearances,
    validate_path,
)
from .optimized import plan_by_trajopt
from .projected import plan_by_projection
from .sampled import plan_by_sampling
from .tasks import TASKS, PeerProblem, build_program, make_problem

PEERS: Mapping[str, tuple[Peer, str, str]] = {
    "trajopt": (plan_by_trajopt, "tesseract_robotics", "tesseract-robotics-nanobind"),
    "OMPL": (plan_by_sampling, "ompl", "ompl"),
    "roboplan": (plan_by_projection, "roboplan", "roboplan"),
    "HPP": (plan_by_constraint_graph, "pyhpp", "hpp-python"),
}
"""Name → what plans with it, its module, and its package."""
METHODS = (*PEERS, *BASELINES, "VKC")
TIME_LIMIT = 60.0
"""[s] By the clock, for a trial."""
_HEAD = [
    "task",
    "method",
    "success",
    "timed out",
    "first [s]",
    "final [s]",
    "95th percentile [s]",
    "solver alone [s]",
    "base [m]",
    "arm [rad]",
    "at waypoints [mm]",
    "between [mm]",
]


def run(
    *,
    out: str | Path,
    trials: int = 20,
    seed: int = 0,
    tasks: Sequence[str] = tuple(TASKS),
    methods: Sequence[str] = METHODS,
    time_limit: float = TIME_LIMIT,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        trials: Number of problems per task, at least 1.
        seed: Random seed of problems and planning.
        tasks: Some of `TASKS`.
        methods: Some of `METHODS`.
        time_limit: Wall-time limit of a trial [s].
    """
    runner.check_positive(trials=trials)
    names = runner.select_names("task", tasks, TASKS)
    chosen = runner.select_names("method", methods, METHODS)
    settings = {
        "benchmark": "peers",
        "seed": seed,
        "starts": trials,
        "tasks": names,
        "methods": chosen,
    }
    settings |= {"time_limit": time_limit, "peers": find_versions(chosen)}
    specs = [
        {
            "key": f"{task}/{number:04d}/{method}",
            "task": task,
            "number": number,
            "method": method,
            "seed": seed,
        }
        | {"time_limit": time_limit}
        for task in names
        for number in range(trials)
        for method in chosen
    ]
    function = functools.partial(_record, folder=str(Path(out) / "plans"))
    return runner.run(
        specs, function, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    rows = [
        _row(task, method, own)
        for task in about["tasks"]
        for method in about["methods"]
        if (own := select(records, task=task, method=method))
    ]
    listed = ", ".join(f"{name} {number}" for name, number in about["peers"].items())
    return join_sections(
        about,
        "# Beside other planners",
        f"{about['starts']} problems per task, seed {about['seed']}, the same for all; at most "
        f"{about['time_limit']:g} s by the clock. Peers: {listed or 'none'}. {JUDGED} Times are "
        "CPU time from the call, everything included, to the first and to the final motion; "
        "medians of all trials that have one, the percentile of the final one. Path lengths are "
        "medians of successes; clearances are the least of all successes.",
        format_table(_HEAD, rows, text=2),
    )


def _row(task: str, method: str, records: Sequence[Record]) -> list[str]:
    good = select(records, success=True)
    late = sum(record["status"] in ("timed out", "time limit") for record in records)
    percentile = format_decimal(distribution(records, "time_final")[1])
    times = [*format_medians(records, "time_first", "time_final"), percentile]
    compute_clearances = [values(good, f"clearance_{where}") for where in ("at", "between")]
    least = [f"{1e3 * min(found):.1f}" if found else "–" for found in compute_clearances]
    lengths = format_medians(good, "base_path_length", "arm_path_length")
    own = format_medians(records, "time_own")
    return [task, method, count(records), str(late), *times, *own, *lengths, *least]


def find_versions(methods: Sequence[str]) -> dict[str, str]:
    """Return the versions of the packages of the peers among some methods."""
    found = {}
    for _, module, package in (PEERS[method] for method in methods if method in PEERS):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            import_optional(module, "peers", purpose="comparing planners")
            raise
    return found


def _record(spec: dict[str, Any], *, folder: str) -> dict[str, Any]:
    task, number, method, seed = (spec[name] for name in ("task", "number", "method", "seed"))
    own = make_problem(task, seed, number)
    clock = Clock(spec["time_limit"])
    found = PeerResult()
    if method in PEERS:
        plan_of, found = plan_by_peer(own, method, number, clock)
    else:
        plan_of = _by_us(own, method, number, spec["time_limit"])
        took = plan_of.metrics  # by the clock: their share of the CPU time counts
        share = (took["time_casadi"] + took["time_ipopt"]) / (
            took["planning_time"] + took["build_time"]
        )
        found.own = share * clock.cpu_time
        found.first = clock.cpu_time if plan_of.success else None
    spent = clock.cpu_time
    wall = clock.wall
    if plan_of.status != "interrupted":
        Path(folder).mkdir(parents=True, exist_ok=True)
        plan_of.save(Path(folder) / f"{spec['key'].replace('/', '_')}.npz")
    more: dict[str, Any] = {"task": task, "number": number, "duration": plan_of.metrics["duration"]}
    more |= {
        "time_own": found.own,
        "time_first": found.first,
        "time_final": spent,
        "wall": wall,
        "about": found.about,
    }
    more |= compute_clearances(build_program(own), plan_of.trajectory) if plan_of.success else {}
    return trial(plan_of, method=method, seed=seed, **more)


def plan_by_peer(
    own: PeerProblem, method: str, seed: int, clock: Clock, options: Options | None = None
) -> tuple[Plan, PeerResult]:
    """Return a peer's plan and result."""
    problem = build_program(own, options)
    judgements: dict[int, Plan] = {}

    def accept(path: Floats) -> bool:
        judgements[0] = validate_path(own, problem, path, "rejected", name=method, seed=seed)
        return judgements[0].success

    found = PEERS[method][0](own, problem, seed, clock, accept)
    if found.path is None:
        return validate_path(own, problem, None, found.status, name=method, seed=seed), found
    if not judgements:
        accept(found.path)
    said = judgements[0]
    late = not said.success and found.status == "timed out"  # its path may not be a motion
    status = found.status
    return dataclasses.replace(said, status=status) if late else said, found


def _by_us(own: PeerProblem, method: str, seed: int, time_limit: float) -> Plan:
    """Plan with a baseline or this package, without caches of earlier trials."""
    if method == "VKC":
        return plan(own.scene, own.steps, seed=seed, time_limit=time_limit)
    return plan_separately(own.scene, own.steps, method=method, seed=seed, time_limit=time_limit)
