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
    format_table,
)
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, plan
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.poses import as_placement
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Place, Step

WAYPOINTS = {f"{method}x{finer}": (method, finer) for finer in (1, 3) for method in BASELINES}
"""Baselines with other numbers of waypoints: name → method, multiple of VKC's number."""

CRITERIA = {
    **EFFORTS,
    "peak_velocity": "peak arm velocity [rad/s]",
    "peak_acceleration": "peak arm acceleration [rad/s²]",
    "duration": "duration [s]",
}
"""What motions are compared by: field → name."""
BUDGETS = {"1/10": 0.1, "1/3": 1 / 3, "2/3": 2 / 3, "whole budget": 1.0}
"""Name → share of the budget."""
_OWN = "VKC"
COMPARED_PLANNERS = (*BASELINES, "VKC")
METHODS = (*COMPARED_PLANNERS[:-1], *WAYPOINTS, "VKC")  # in the order of the tables
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
    about, records = result["meta"], result["trials"]
    methods = about["methods"]
    compared = select_compared_methods(methods)
    *first, last = (f"`{task}`: {name}" for task, name in tasks.items())
    parts = [
        f"# {title}",
        f"{', '.join(first)}{' and ' * bool(first)}{last}. {about['starts']} random "
        f"start{'s' * (about['starts'] != 1)} per task, the same for all methods; seed "
        f"{about['seed']}. Per "
        f"trial {describe_limit(about)}, in which the baselines try up to {about['retries']} "
        "times. "
        "Success is the result of the independent validation. Standard deviations are those of "
        "samples (n − 1).",
        "## Success",
        _success(records, tasks, methods),
        "## Planning time",
        "Without imports and symbolic build. The last column is the ratio of medians to VKC.",
        _times(records, tasks, methods),
        *_calls(records, tasks, methods),
        *_budgets(about, records, tasks, methods),
        "## Path lengths, peaks and durations where all methods succeed",
        "Mean ± standard deviation; median. Trials in which all methods succeed: "
        + _numbers(records, tasks, compared)
        + ".",
        _criteria(records, tasks, compared, shared=True),
        *_pairwise(records, tasks, methods),
        "## Path lengths, peaks and durations over each method's own successes",
        "Mean ± standard deviation; median. The methods succeed in different trials, so that "
        "harder trials count for some methods only.",
        _criteria(records, tasks, methods, shared=False),
        *pictures,
    ]
    if saved:
        parts += [
            "## Failures",
            "`vkc-pin view FILE` shows them, with violated clearances in red.",
            _list_failures(records, saved),
        ]
    return "\n\n".join([*parts, describe_run(about)]) + "\n"


def _success(records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]) -> str:
    rows = []
    for task, method in product([*tasks, "all"] if len(tasks) > 1 else tasks, methods):
        own = [
            record
            for record in records
            if record["method"] == method and task in ("all", record["scene"])
        ]
        good = sum(bool(record["success"]) for record in own)
        low, high = (f"{100.0 * end:.0f}" for end in compute_wilson_interval(good, len(own)))
        rate = f"{100.0 * good / len(own):.0f}" if own else "–"
        rows.append(
            [task, method, f"{good} of {len(own)}", rate, f"{low}–{high}", *count_timeouts(own)]
        )
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


def _times(records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]) -> str:
    rows = []
    for name, good in (("all trials", False), ("successes", True)):
        for task, method in product(tasks, methods):
            own, reference = (
                _select_records(records, task, which, good=good) for which in (method, _OWN)
            )
            (median, late), times = distribution(own, "planning_time"), values(own, "planning_time")
            cells = (
                median,
                late,
                *compute_mean_and_deviation(times),
                median / distribution(reference, "planning_time")[0],
            )
            rows.append([name, task, method, str(len(times)), *map(format_decimal, cells)])
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


def _calls(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]
) -> list[str]:
    """Return a section on the time of whole calls, if it is recorded."""
    rows = []
    for task, method in product(tasks, methods):
        own = _select_records(records, task, method)
        if values(own, "wall_time"):
            first = [
                format_decimal(distribution(own, field)[0]) for field in ("cold_time", "warm_time")
            ]
            wall = [format_decimal(value) for value in distribution(own, "wall_time")]
            rows.append([task, method, str(len(values(own, "cold_time"))), *first, *wall])
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
    return ["## Wall-clock time of calls", text, format_table(head, rows, text=2)] if rows else []


def _budgets(
    about: Mapping[str, Any],
    records: Sequence[Record],
    tasks: Mapping[str, str],
    methods: Sequence[str],
) -> list[str]:
    """Return a section on successes with smaller budgets, if the budget was limited."""
    if "max_evaluations" not in about or not values(records, "evaluations"):
        return []
    shares = [(name, about["max_evaluations"] * share) for name, share in BUDGETS.items()]
    rows = []
    for task, method in product(tasks, methods):
        own = _select_records(records, task, method)
        good = values([record for record in own if record["success"]], "evaluations")
        within = [sum(count <= limit for count in good) for _, limit in shares]
        gain = 100.0 * (within[-1] - within[-2]) / max(len(own), 1)
        most = f"{max(good) / about['max_evaluations']:.3f}" if good else "–"
        rows.append(
            [task, method, *(f"{number} of {len(own)}" for number in within), f"{gain:.0f}", most]
        )
    head = [
        "task",
        "method",
        *(name for name, _ in shares),
        "gain from 2/3 [points]",
        "largest fraction used",
    ]
    text = (
        "Successes within fractions of the budget. The budget only ends planning, so that these "
        "are the successes with smaller budgets. The gain is that of half as much again, from 2/3 "
        "to the whole budget."
    )
    return ["## Success with smaller budgets", text, format_table(head, rows, text=2)]


def _numbers(records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]) -> str:
    """Return the number of trials of each task in which all methods succeed."""
    numbers = []
    for task in tasks:
        own = [record for record in records if record["scene"] == task]
        numbers.append(
            f"{len(find_common_successes(own, methods))} of "
            f"{len({record['number'] for record in own})} ({task})"
        )
    return ", ".join(numbers)


def _criteria(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str], *, shared: bool
) -> str:
    """Return all criteria over shared trials, or over each method's own successes."""
    rows = []
    for task in tasks:
        own = [record for record in records if record["scene"] == task]
        good = {method: _select_records(own, task, method, good=True) for method in methods}
        if shared:
            both = find_common_successes(own, methods)
            good = {method: [row[k] for row in both] for k, method in enumerate(methods)}
        if not shared:
            rows.append([task, "n", *(str(len(good[method])) for method in methods)])
        for field, name in CRITERIA.items():
            rows.append([task, name, *(_spread(good[method], field) for method in methods)])
    return format_table(["task", "criterion", *methods], rows, text=2)


def _pairwise(
    records: Sequence[Record], tasks: Mapping[str, str], methods: Sequence[str]
) -> list[str]:
    """Return a section that compares VKC with every other method."""
    others = [method for method in methods if method != _OWN]
    if _OWN not in methods or not others:
        return []
    rows = []
    for other in others:
        for task in tasks:
            both = find_common_successes(
                [record for record in records if record["scene"] == task], (_OWN, other)
            )
            for field, name in {**CRITERIA, "planning_time": "planning time [s]"}.items():
                medians = (
                    format_decimal(distribution([row[k] for row in both], field)[0]) for k in (0, 1)
                )
                rows.append(
                    [task, name, other, *medians, f"{count_lower(both, field)} of {len(both)}"]
                )
    head = ["task", "criterion", "other", f"{_OWN}, median", "other, median", f"lower with {_OWN}"]
    text = f"Over the trials in which {_OWN} and the other method succeed."
    return [f"## {_OWN} against each baseline", text, format_table(head, rows, text=3)]


def _list_failures(records: Sequence[Record], saved: Mapping[str, str]) -> str:
    rows = []
    for record in records:
        if record["key"] in saved:
            violated = record["violations"][0] if record["violations"] else "–"
            cells = [
                record["scene"],
                record["number"],
                record["method"],
                record["status"],
                violated,
                f"`{saved[record['key']]}`",
            ]
            rows.append([str(cell) for cell in cells])
    return format_table(
        ["task", "trial", "method", "cause", "violated first", "file"], rows, text=6
    )


def _select_records(
    records: Sequence[Record], task: str, method: str, *, good: bool = False
) -> list[Record]:
    """Return the records of a task and method, or its successes."""
    own = (record for record in records if (record["scene"], record["method"]) == (task, method))
    return [record for record in own if record["success"] or not good]


def _spread(records: Sequence[Record], field: str) -> str:
    found = values(records, field)
    mean, deviation = map(format_decimal, compute_mean_and_deviation(found))
    return (
        f"{mean} ± {deviation}; {format_decimal(distribution(records, field)[0])}" if found else "–"
    )


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
        how: dict[str, Any] = {
            **LIMITS,
            **{key: spec[key] for key in ("max_evaluations", "planner") if key in spec},
            "seed": spec["seed"],
        }
        if spec["method"] == "VKC":
            return plan(scene, steps, **how)
        method, finer = WAYPOINTS.get(spec["method"], (spec["method"], FINER))
        return plan_separately(scene, steps, method=method, finer=finer, **how)

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
        specs = []
        for name in tasks:
            task = self.tasks[name]
            rng = np.random.default_rng([seed, list(self.tasks).index(name)])
            scene = _load_scene_once(self.load, task.scene)
            starts: list[dict[str, Any]] = []
            for _ in range(trials):
                more = {"placed": task.scatter(scene, rng)} if task.scatter else {}
                base = place_objects(scene, more).sample_start(rng).start[:3].tolist()
                starts.append({"base": base, **more})
            for method in methods:
                for number, start in enumerate(starts):
                    own = {"scene": name, "method": method, "number": number, **start}
                    key = f"{name}/{number:04d}/{method}"
                    specs.append(
                        {
                            "key": key,
                            **own,
                            "seed": seed + number,
                            "max_evaluations": max_evaluations,
                        }
                    )
        return specs

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
        out, progress = Path(out), execution.get("progress", True)
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
            **{**LIMITS, "max_evaluations": max_evaluations, "retries": RETRIES},
        }
        trials_of = _Trials(self, out, solve or self.plan_trial, timed=solve is None)
        record = functools.partial(trials_of.record, save_failures=save_failures)
        result = runner.run(specs, record, out, settings=settings, **execution)
        saved = trials_of.list_saved_plans(
            result["trials"], specs, again=save_failures, show=progress
        )
        names = {name: self.tasks[name].name for name in tasks}
        pictures = self.draw(result["trials"], out, names, methods)
        pictures += trials_of.draw_motions(result["trials"], specs)
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
    found: dict[str, Any] = {}
    for step in steps:
        if isinstance(step, Actuate):
            found |= {f"{step.object}.{joint}": value for joint, value in step.joints.items()}
        elif isinstance(step, Place):
            found[step.object] = np.asarray(step.pose, float).tolist()
        elif isinstance(step, GoTo):
            found["base"] = [step.x, step.y] if step.yaw is None else [step.x, step.y, step.yaw]
    return found


@dataclass(frozen=True)
class _Trials:
    """Runs the trials of an experiment and keeps their plans in a folder."""

    experiment: Comparison
    out: Path
    solve: Solve
    timed: bool = False

    def record(self, spec: dict[str, Any], *, save_failures: bool) -> dict[str, Any]:
        """Run a trial and return its record."""
        if spec["method"] != "VKC":
            import_solvers()  # before time is measured

        found, times = self._plan_timed(spec)
        if save_failures and not found.success and found.status != "interrupted":
            found.save(self._file(spec, "failures"))
        own = {"duration": found.metrics["duration"], **compute_peaks(found.trajectory), **times}
        own |= {key: spec[key] for key in ("scene", "number", "placed") if key in spec}
        return trial(found, method=spec["method"], seed=spec["seed"], **own)

    def list_saved_plans(
        self,
        records: Sequence[Record],
        specs: Sequence[Mapping[str, Any]],
        *,
        again: bool,
        show: bool,
    ) -> dict[str, str]:
        """Return key → file of saved failures; with `again`, plan those that are not saved."""
        failed = {r["key"] for r in records if not r["success"] and r["status"] != "error"}
        specs = [spec for spec in specs if spec["key"] in failed]
        files = {spec["key"]: self._file(spec, "failures") for spec in specs}
        lost = [spec for spec in specs if again and not files[spec["key"]].is_file()]
        for spec in tqdm(lost, desc="failures", unit="plan", disable=not (show and lost)):
            found = self._plan_uninterrupted(spec)
            if not found.success:
                found.save(files[spec["key"]])
        return {
            key: path.relative_to(self.out).as_posix()
            for key, path in files.items()
            if path.is_file()
        }

    def draw_motions(
        self, records: Sequence[Record], specs: Sequence[Mapping[str, Any]]
    ) -> list[str]:
        """Draw the motions of one trial of each task that any method solves."""
        methods, pictures = tuple(dict.fromkeys(spec["method"] for spec in specs)), []
        for task in dict.fromkeys(spec["scene"] for spec in specs):
            name = self.experiment.tasks[task].name
            number = choose_shown_trial(
                [record for record in records if record["scene"] == task], methods
            )
            if number is None:
                continue
            chosen = [s for s in specs if (s["scene"], s["number"]) == (task, number)]
            plans = {spec["method"]: self._plan_shown(spec) for spec in chosen}
            title = f"{name.capitalize()}, trial {number}"
            motions_chart(plans, self.out / f"{task}_joints.png", title=title)
            pictures.append(f"![Motions of trial {number}: {name}]({task}_joints.png)")
        return pictures

    def _plan_shown(self, spec: Mapping[str, Any]) -> Plan:
        """Load the plan of a trial from the folder, or plan it again and save it there."""
        path = self._file(spec, "shown")
        if path.is_file():
            return Plan.load(path)
        found = self._plan_uninterrupted(spec)
        found.save(path)
        return found

    def _plan_uninterrupted(self, spec: Mapping[str, Any]) -> Plan:
        if (found := self._plan(spec)).status == "interrupted":
            raise KeyboardInterrupt("all trials are done, but not all of their plans are saved")
        return found

    def _plan_timed(self, spec: Mapping[str, Any]) -> tuple[Plan, dict[str, float]]:
        """Return a plan and wall times; the first trials are planned cold, then warm."""
        if not self.timed:
            return self._plan(spec), {}
        times, new = dict[str, float](), {"planner": Planner()} if spec["number"] < COLD else {}
        for name in ("cold_time", "warm_time") if new else ("wall_time",):
            began, found = time.perf_counter(), self._plan({**spec, **new})
            times[name] = time.perf_counter() - began
            if found.status == "interrupted":
                break
        return found, {"wall_time": times.get("warm_time", 0.0), **times}

    def _plan(self, spec: Mapping[str, Any]) -> Plan:
        name = self.experiment.tasks[spec["scene"]].scene
        scene = place_objects(_load_scene_once(self.experiment.load, name), spec)
        return self.solve(scene.with_start(base=spec["base"]), spec)

    def _file(self, spec: Mapping[str, Any], folder: str) -> Path:
        return self.out / folder / f"{spec['scene']}_{spec['number']:04d}_{spec['method']}.npz"


@functools.cache
def _load_scene_once(load: Callable[[str], Scene], name: str) -> Scene:
    return load(name)


def choose_shown_trial(records: Sequence[Record], methods: Sequence[str]) -> int | None:
    """Return the trial with most successes, if possible one of VKC; None without any success."""
    good: dict[int, set[str]] = {}
    for record in records:
        if record["success"]:
            good.setdefault(int(record["number"]), set()).add(str(record["method"]))
    return max(
        sorted(good),
        key=lambda k: (len(good[k]) == len(methods), "VKC" in good[k], len(good[k])),
        default=None,
    )
