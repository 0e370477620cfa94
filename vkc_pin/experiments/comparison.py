"""Compares planning base and arm together (VKC) with planning them apart (B1, B2).

All methods get the same tasks, random starts, limits and validation.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from tqdm import tqdm

from vkc_pin.experiments.baselines.attempt import FINER
from vkc_pin.experiments.baselines.following import import_solvers
from vkc_pin.experiments.baselines.separate import BASELINES, RETRIES, plan_separately
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.charts import motions_chart
from vkc_pin.experiments.harness.record import (
    Record,
    Solve,
    compute_peaks,
    distribution,
    trial,
    values,
)
from vkc_pin.experiments.harness.runner import LIMITS, MAX_EVALUATIONS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import (
    EFFORTS,
    compute_mean_and_deviation,
    compute_wilson_interval,
    count_lower,
    count_timeouts,
    describe_run,
    find_common_successes,
    format_decimal,
    format_medians,
    format_table,
    select,
)
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner
from vkc_pin.planning.prepare import plan
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.poses import as_placement
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Place, Step

WAYPOINTS = {"B1x1": ("B1", 1), "B2x1": ("B2", 1), "B1x3": ("B1", 3), "B2x3": ("B2", 3)}
"""Baselines with other numbers of waypoints: name → method, multiple of VKC's number."""
_OWN = "VKC"
COMPARED_PLANNERS = (*BASELINES, _OWN)
METHODS = (*BASELINES, *WAYPOINTS, _OWN)
"""All methods, in the order of the tables."""

CRITERIA = {
    **EFFORTS,
    "peak_velocity": "peak arm velocity [rad/s]",
    "peak_acceleration": "peak arm acceleration [rad/s²]",
    "duration": "duration [s]",
}
"""What motions are compared by: field → name."""
BUDGETS = {"1/10": 0.1, "1/3": 1 / 3, "2/3": 2 / 3, "whole budget": 1.0}
"""Name → fraction of the budget."""
COLD = 5
"""Number of trials of a task and method that are planned twice, cold and warm."""
Draw = Callable[[Sequence[Record], Path, Mapping[str, str], Sequence[str]], list[str]]
"""Draws the charts of records, in a folder, for tasks (name → description) and methods."""


def select_compared_methods(methods: Sequence[str]) -> Sequence[str]:
    """Return the methods whose motions are compared; other numbers of waypoints only if alone."""
    return [method for method in methods if method not in WAYPOINTS] or methods


def format_results(
    result: Mapping[str, Any],
    tasks: Mapping[str, str],
    *,
    title: str,
    saved: Mapping[str, str] | None = None,
    pictures: Sequence[str] = (),
) -> str:
    """Return the tables of a result in Markdown.

    Args:
        result: Result of `Comparison.run`.
        tasks: Task → description.
        title: Title.
        saved: Key → file, of failures whose plans are saved.
        pictures: Pictures in Markdown.
    """
    about = result["meta"]
    records = result["trials"]
    methods = about["methods"]
    compared = select_compared_methods(methods)
    *first, last = (f"`{task}`: {name}" for task, name in tasks.items())
    listed = f"{', '.join(first)} and {last}" if first else last
    starts = f"{about['starts']} random {'start' if about['starts'] == 1 else 'starts'}"
    common = _count_common_successes(records, tasks, compared)
    parts = [
        f"# {title}",
        f"{listed}. {starts} per task, the same for all methods; seed {about['seed']}. Per "
        f"trial {describe_limit(about)}, in which the baselines try up to {about['retries']} "
        "times. "
        "Success is the result of the independent validation. Standard deviations are those of "
        "samples (n − 1).",
        "## Success",
        _tabulate_success(records, tasks, methods),
        "## Planning time",
        "Without imports and symbolic build. The last column is the ratio of medians to VKC.",
        _tabulate_times(records, tasks, methods),
        *_describe_calls(records, tasks, methods),
        *_describe_budgets(about, records, tasks, methods),
        "## Path lengths, peaks and durations where all methods succeed",
        "Mean ± standard deviation; median. Trials in which all methods succeed: " + common + ".",
        _tabulate_criteria(records, tasks, compared, shared=True),
        *_compare_pairs(records, tasks, methods),
        "## Path lengths, peaks and durations over each method's own successes",
        "Mean ± standard deviation; median. The methods succeed in different trials, so that "
        "harder trials count for some methods only.",
        _tabulate_criteria(records, tasks, methods, shared=False),
        *pictures,
    ]
    if saved:
        parts += [
            "## Failures",
            "`vkc-pin view FILE` shows them, with violated clearances in red.",
            _list_failures(records, saved),
        ]
    return "\n\n".join([*parts, describe_run(about)]) + "\n"


def _tabulate_success(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]
) -> str:
    """Tabulate the success rates of every task and method."""
    groups = {task: select(records, scene=task) for task in tasks}
    if len(tasks) > 1:
        groups["all"] = list(records)
    rows: list[list[str]] = []
    for (task, group), method in product(groups.items(), methods):
        own = select(group, method=method)
        successes = sum(bool(record["success"]) for record in own)
        low, high = compute_wilson_interval(successes, len(own))
        rate = f"{100.0 * successes / len(own):.0f}" if own else "–"
        interval = f"{100.0 * low:.0f}–{100.0 * high:.0f}"
        number = f"{successes} of {len(own)}"
        rows.append([task, method, number, rate, interval, *count_timeouts(own)])
    head = [
        "task",
        "method",
        "success",
        "[%]",
        "95 % interval (Wilson)",
        "timed out",
        "failures: cause (violated first)",
    ]
    return format_table(head, rows, text=2)


def _tabulate_times(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]
) -> str:
    """Tabulate the planning times of every task and method."""
    rows: list[list[str]] = []
    for name, good in (("all trials", False), ("successes", True)):
        for task, method in product(tasks, methods):
            own = _select_records(records, task, method, good=good)
            reference = _select_records(records, task, _OWN, good=good)
            times = values(own, "planning_time")
            median, late = distribution(own, "planning_time")
            mean, deviation = compute_mean_and_deviation(times)
            reference_median, _ = distribution(reference, "planning_time")
            ratio = median / reference_median
            row = [name, task, method, str(len(times))]
            row += [format_decimal(cell) for cell in (median, late, mean, deviation, ratio)]
            rows.append(row)
    head = [
        "over",
        "task",
        "method",
        "n",
        "median [s]",
        "95th percentile [s]",
        "mean [s]",
        "deviation [s]",
        f"ratio to {_OWN}",
    ]
    return format_table(head, rows, text=3)


def _describe_calls(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]
) -> list[str]:
    """Return a section on the time of whole calls, if it is recorded."""
    rows: list[list[str]] = []
    for task, method in product(tasks, methods):
        own = _select_records(records, task, method)
        if values(own, "wall_time"):
            repeated = str(len(values(own, "cold_time")))
            first = format_medians(own, "cold_time", "warm_time")
            wall = [format_decimal(value) for value in distribution(own, "wall_time")]
            rows.append([task, method, repeated, *first, *wall])
    if not rows:
        return []
    head = [
        "task",
        "method",
        "repeated calls",
        "cold, median [s]",
        "warm, median [s]",
        "all, median [s]",
        "95th percentile [s]",
    ]
    text = (
        "Wall-clock time of whole calls. The first trials of a task are planned twice by a planner "
        "with empty caches: cold, including construction of the symbolic programs and loading or "
        "compiling them, and warm. All: every trial, in order."
    )
    return ["## Wall-clock time of calls", text, format_table(head, rows, text=2)]


def _describe_budgets(
    about: Mapping[str, Any],
    records: Sequence[Record],
    tasks: Mapping[str, str],
    methods: Sequence[str],
) -> list[str]:
    """Return a section on successes with smaller budgets, if the budget was limited."""
    if "max_evaluations" not in about or not values(records, "evaluations"):
        return []
    budget = about["max_evaluations"]
    rows: list[list[str]] = []
    for task, method in product(tasks, methods):
        own = _select_records(records, task, method)
        successes = _select_records(records, task, method, good=True)
        evaluations = values(successes, "evaluations")
        within: list[int] = []  # successes within each fraction of the budget
        for fraction in BUDGETS.values():
            limit = budget * fraction
            within.append(sum(count <= limit for count in evaluations))
        gain = 100.0 * (within[-1] - within[-2]) / max(len(own), 1)
        most = f"{max(evaluations) / budget:.3f}" if evaluations else "–"
        row = [task, method]
        row += [f"{number} of {len(own)}" for number in within]
        row += [f"{gain:.0f}", most]
        rows.append(row)
    head = ["task", "method", *BUDGETS, "gain from 2/3 [points]", "largest fraction used"]
    text = (
        "Successes within fractions of the budget. The budget only ends planning, so that these "
        "are the successes with smaller budgets. The gain is that of half as much again, from 2/3 "
        "to the whole budget."
    )
    return ["## Success with smaller budgets", text, format_table(head, rows, text=2)]


def _count_common_successes(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]
) -> str:
    """Return the number of trials of each task in which all methods succeed."""
    counts: list[str] = []
    for task in tasks:
        own = select(records, scene=task)
        common = len(find_common_successes(own, methods))
        trials = len({record["number"] for record in own})
        counts.append(f"{common} of {trials} ({task})")
    return ", ".join(counts)


def _tabulate_criteria(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str], *, shared: bool
) -> str:
    """Tabulate all criteria over shared trials, or over each method's own successes."""
    rows: list[list[str]] = []
    for task in tasks:
        compared: list[list[Record]] = []  # by method
        if shared:
            common = find_common_successes(select(records, scene=task), methods)
            for k in range(len(methods)):
                compared.append([row[k] for row in common])
        else:
            compared = [_select_records(records, task, method, good=True) for method in methods]
            rows.append([task, "n", *(str(len(own)) for own in compared)])
        for field, name in CRITERIA.items():
            rows.append([task, name, *(_format_spread(own, field) for own in compared)])
    return format_table(["task", "criterion", *methods], rows, text=2)


def _compare_pairs(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]
) -> list[str]:
    """Return a section that compares VKC with every other method."""
    others = [method for method in methods if method != _OWN]
    if _OWN not in methods or not others:
        return []
    criteria = {**CRITERIA, "planning_time": "planning time [s]"}
    rows: list[list[str]] = []
    for other, task in product(others, tasks):
        both = find_common_successes(select(records, scene=task), (_OWN, other))
        for field, name in criteria.items():
            own_median, _ = distribution([pair[0] for pair in both], field)
            other_median, _ = distribution([pair[1] for pair in both], field)
            medians = [format_decimal(own_median), format_decimal(other_median)]
            lower = f"{count_lower(both, field)} of {len(both)}"
            rows.append([task, name, other, *medians, lower])
    head = ["task", "criterion", "other", f"{_OWN}, median", "other, median", f"lower with {_OWN}"]
    text = f"Over the trials in which {_OWN} and the other method succeed."
    return [f"## {_OWN} against each baseline", text, format_table(head, rows, text=3)]


def _list_failures(records: Sequence[Record], saved: Mapping[str, str]) -> str:
    """Tabulate the failures whose plans are saved."""
    rows: list[list[str]] = []
    for record in records:
        if record["key"] in saved:
            row = [str(record[field]) for field in ("scene", "number", "method", "status")]
            row.append(str(record["violations"][0]) if record["violations"] else "–")
            row.append(f"`{saved[record['key']]}`")
            rows.append(row)
    head = ["task", "trial", "method", "cause", "violated first", "file"]
    return format_table(head, rows, text=6)


def _select_records(
    records: Sequence[Record], task: str, method: str, *, good: bool = False
) -> list[Record]:
    """Return the records of a task and method, or its successes."""
    own = select(records, scene=task, method=method)
    return [record for record in own if record["success"] or not good]


def _format_spread(records: Sequence[Record], field: str) -> str:
    """Format mean, standard deviation and median of a field; a dash without values."""
    found = values(records, field)
    if not found:
        return "–"
    mean, deviation = compute_mean_and_deviation(found)
    median, _ = distribution(records, field)
    return f"{format_decimal(mean)} ± {format_decimal(deviation)}; {format_decimal(median)}"


@dataclass(frozen=True)
class Assignment:
    """A task of an experiment.

    Attributes:
        scene: Name of the scene.
        steps: Steps to plan.
        name: Description.
        scatter: Samples poses of objects, by name, (x, y, z, roll, pitch, yaw) [m, rad] each.
            Default: all objects stay as in the scene.
    """

    scene: str
    steps: tuple[Step, ...]
    name: str
    scatter: Callable[[Scene, np.random.Generator], dict[str, list[float]]] | None = None


@dataclass(frozen=True)
class Comparison:
    """An experiment that compares `COMPARED_PLANNERS`.

    Attributes:
        benchmark: Name on the command line.
        title: Title of the tables.
        tasks: Name → task.
        draw: Draws the charts.
        load: Loads a scene by name.
    """

    benchmark: str
    title: str
    tasks: Mapping[str, Assignment]
    draw: Draw
    load: Callable[[str], Scene] = load_scene

    def plan_trial(self, scene: Scene, spec: Mapping[str, Any]) -> Plan:
        """Plan a trial with its task (`scene`), `method`, `seed` and other settings."""
        steps = self.tasks[spec["scene"]].steps
        settings: dict[str, Any] = {**LIMITS, "seed": spec["seed"]}
        for key in ("max_evaluations", "planner"):
            if key in spec:
                settings[key] = spec[key]
        if spec["method"] == _OWN:
            return plan(scene, steps, **settings)
        method, finer = WAYPOINTS.get(spec["method"], (spec["method"], FINER))
        return plan_separately(scene, steps, method=method, finer=finer, **settings)

    def specify(
        self,
        *,
        trials: int,
        seed: int,
        tasks: Sequence[str],
        methods: Sequence[str],
        max_evaluations: int = MAX_EVALUATIONS,
    ) -> list[dict[str, Any]]:
        """Return the trials, ordered by task, method and start.

        Starts and poses of objects depend on seed and task alone. Start i is planned with the
        random seed `seed` + i.
        """
        specs: list[dict[str, Any]] = []
        for name in tasks:
            starts = self._sample_starts(name, trials, seed)
            for method, (number, start) in product(methods, enumerate(starts)):
                specs.append(
                    {
                        "key": f"{name}/{number:04d}/{method}",
                        "scene": name,
                        "method": method,
                        "number": number,
                        **start,
                        "seed": seed + number,
                        "max_evaluations": max_evaluations,
                    }
                )
        return specs

    def _sample_starts(self, name: str, trials: int, seed: int) -> list[dict[str, Any]]:
        """Return random poses of the base for a task, and of objects if these are scattered."""
        task = self.tasks[name]
        rng = np.random.default_rng([seed, list(self.tasks).index(name)])
        scene = _load_scene_once(self.load, task.scene)
        starts: list[dict[str, Any]] = []
        for _ in range(trials):
            placed = {"placed": task.scatter(scene, rng)} if task.scatter else {}
            start = place_objects(scene, placed).sample_start(rng)
            starts.append({"base": start.start[:3].tolist(), **placed})
        return starts

    def run(
        self,
        *,
        trials: int,
        seed: int,
        out: str | Path,
        solve: Solve | None = None,
        tasks: Sequence[str] | None = None,
        methods: Sequence[str] = COMPARED_PLANNERS,
        max_evaluations: int = MAX_EVALUATIONS,
        save_failures: bool = False,
        **execution: Unpack[Execution],
    ) -> dict[str, Any]:
        """Run the experiment in the folder `out`; see `runner.run`.

        Args:
            out: Folder.
            trials: Number of random starts per task, at least 1.
            seed: Random seed of starts and planning.
            solve: Plans a trial. Default: `plan_trial`.
            tasks: Names of tasks. Default: all.
            methods: Some of `METHODS`.
            max_evaluations: Limit of evaluations of each trial.
            save_failures: Whether to save the plan of every failure; failures that were run
                without it are planned again.

        Returns:
            See `runner.run`; the `scene` of a trial is the name of its task.
        """
        tasks = runner.select_names("task", self.tasks if tasks is None else tasks, self.tasks)
        methods = runner.select_names("method", methods, METHODS)
        runner.check_positive(trials=trials)
        out = Path(out)
        specs = self.specify(
            trials=trials, seed=seed, tasks=tasks, methods=methods, max_evaluations=max_evaluations
        )
        settings = {
            "benchmark": self.benchmark,
            "seed": seed,
            "starts": trials,
            "tasks": tasks,
            "methods": methods,
            "scenes": {name: self.tasks[name].scene for name in tasks},
            "goals": {name: list_goals(self.tasks[name].steps) for name in tasks},
            **LIMITS,
            "retries": RETRIES,
        }
        settings["max_evaluations"] = max_evaluations
        folder = _Trials(self, out, solve or self.plan_trial, timed=solve is None)
        record = functools.partial(folder.record, save_failures=save_failures)
        result = runner.run(specs, record, out, settings=settings, **execution)
        records = result["trials"]
        show = execution.get("progress", True)
        saved = folder.list_saved_plans(records, specs, again=save_failures, show=show)
        names = {name: self.tasks[name].name for name in tasks}
        pictures = self.draw(records, out, names, methods)
        pictures += folder.draw_motions(records, specs)
        text = self.format_results(result, saved=saved, pictures=pictures)
        write_atomically(out / "table.md", text.encode())
        return result

    def format_results(
        self,
        result: Mapping[str, Any],
        *,
        saved: Mapping[str, str] | None = None,
        pictures: Sequence[str] = (),
    ) -> str:
        """Return the tables of a result in Markdown; see the function `format_results`."""
        names = {name: self.tasks[name].name for name in result["meta"]["tasks"]}
        return format_results(result, names, title=self.title, saved=saved, pictures=pictures)


def place_objects(scene: Scene, spec: Mapping[str, Any]) -> Scene:
    """Return a scene with its objects at the poses of a trial."""
    for name, pose in spec.get("placed", {}).items():
        scene = scene.with_placement(name, as_placement(pose))
    return scene


def list_goals(steps: Sequence[Step]) -> dict[str, Any]:
    """Return the goals of steps: "<object>.<joint>" → value, object or "base" → pose."""
    goals: dict[str, Any] = {}
    for step in steps:
        if isinstance(step, Actuate):
            for joint, value in step.joints.items():
                goals[f"{step.object}.{joint}"] = value
        elif isinstance(step, Place):
            goals[step.object] = np.asarray(step.pose, float).tolist()
        elif isinstance(step, GoTo):
            goals["base"] = [step.x, step.y] if step.yaw is None else [step.x, step.y, step.yaw]
    return goals


@dataclass(frozen=True)
class _Trials:
    """Runs the trials of an experiment and keeps their plans in a folder."""

    experiment: Comparison
    out: Path
    solve: Solve
    timed: bool = False

    def record(self, spec: dict[str, Any], *, save_failures: bool) -> dict[str, Any]:
        """Run a trial and return its record."""
        if spec["method"] != _OWN:
            import_solvers()  # before time is measured
        found, times = self._plan_timed(spec)
        if save_failures and not found.success and found.status != "interrupted":
            found.save(self._locate_file(spec, "failures"))
        peaks = compute_peaks(found.trajectory)
        fields: dict[str, Any] = {"duration": found.metrics["duration"], **peaks, **times}
        for key in ("scene", "number", "placed"):
            if key in spec:
                fields[key] = spec[key]
        return trial(found, method=spec["method"], seed=spec["seed"], **fields)

    def list_saved_plans(
        self,
        records: Sequence[Record],
        specs: Sequence[Mapping[str, Any]],
        *,
        again: bool,
        show: bool,
    ) -> dict[str, str]:
        """Return key → file of saved failures; with `again`, plan those that are not saved."""
        failures = [record for record in records if not record["success"]]
        failed = {record["key"] for record in failures if record["status"] != "error"}
        specs = [spec for spec in specs if spec["key"] in failed]
        files = {spec["key"]: self._locate_file(spec, "failures") for spec in specs}
        lost: list[Mapping[str, Any]] = []
        if again:
            lost = [spec for spec in specs if not files[spec["key"]].is_file()]
        for spec in tqdm(lost, desc="failures", unit="plan", disable=not (show and lost)):
            found = self._plan_uninterrupted(spec)
            if not found.success:
                found.save(files[spec["key"]])
        saved = {key: path for key, path in files.items() if path.is_file()}
        return {key: path.relative_to(self.out).as_posix() for key, path in saved.items()}

    def draw_motions(
        self, records: Sequence[Record], specs: Sequence[Mapping[str, Any]]
    ) -> list[str]:
        """Draw the motions of one trial of each task that any method solves."""
        methods = tuple(dict.fromkeys(spec["method"] for spec in specs))
        pictures: list[str] = []
        for task in dict.fromkeys(spec["scene"] for spec in specs):
            name = self.experiment.tasks[task].name
            number = choose_shown_trial(select(records, scene=task), methods)
            if number is None:
                continue
            chosen = select(specs, scene=task, number=number)
            plans = {spec["method"]: self._plan_shown(spec) for spec in chosen}
            title = f"{name.capitalize()}, trial {number}"
            motions_chart(plans, self.out / f"{task}_joints.png", title=title)
            pictures.append(f"![Motions of trial {number}: {name}]({task}_joints.png)")
        return pictures

    def _plan_shown(self, spec: Mapping[str, Any]) -> Plan:
        """Load the plan of a trial from the folder, or plan it again and save it there."""
        path = self._locate_file(spec, "shown")
        if path.is_file():
            return Plan.load(path)
        found = self._plan_uninterrupted(spec)
        found.save(path)
        return found

    def _plan_uninterrupted(self, spec: Mapping[str, Any]) -> Plan:
        """Plan a trial; an interruption ends the experiment."""
        found = self._plan(spec)
        if found.status == "interrupted":
            raise KeyboardInterrupt("all trials are done, but not all of their plans are saved")
        return found

    def _plan_timed(self, spec: Mapping[str, Any]) -> tuple[Plan, dict[str, float]]:
        """Return a plan and wall times; the first trials are planned cold, then warm."""
        if not self.timed:
            return self._plan(spec), {}
        if spec["number"] >= COLD:
            found, wall_time = self._measure_call(spec)
            return found, {"wall_time": wall_time}
        own_planner = {**spec, "planner": Planner()}
        found, cold_time = self._measure_call(own_planner)
        if found.status == "interrupted":
            return found, {"wall_time": 0.0, "cold_time": cold_time}
        found, warm_time = self._measure_call(own_planner)
        return found, {"wall_time": warm_time, "cold_time": cold_time, "warm_time": warm_time}

    def _measure_call(self, spec: Mapping[str, Any]) -> tuple[Plan, float]:
        """Return a plan and the wall time of the call [s]."""
        began = time.perf_counter()
        found = self._plan(spec)
        return found, time.perf_counter() - began

    def _plan(self, spec: Mapping[str, Any]) -> Plan:
        """Plan a trial from its start."""
        name = self.experiment.tasks[spec["scene"]].scene
        scene = place_objects(_load_scene_once(self.experiment.load, name), spec)
        return self.solve(scene.with_start(base=spec["base"]), spec)

    def _locate_file(self, spec: Mapping[str, Any], folder: str) -> Path:
        """Return the file of a trial's plan."""
        return self.out / folder / f"{spec['scene']}_{spec['number']:04d}_{spec['method']}.npz"


@functools.cache
def _load_scene_once(load: Callable[[str], Scene], name: str) -> Scene:
    return load(name)


def choose_shown_trial(records: Sequence[Record], methods: Sequence[str]) -> int | None:
    """Return the trial with most successes, if possible one of VKC; None without any success."""
    successful: dict[int, set[str]] = {}  # methods by trial
    for record in records:
        if record["success"]:
            successful.setdefault(int(record["number"]), set()).add(str(record["method"]))

    def rank(number: int) -> tuple[bool, bool, int]:
        own = successful[number]
        return len(own) == len(methods), _OWN in own, len(own)

    return max(sorted(successful), key=rank, default=None)
