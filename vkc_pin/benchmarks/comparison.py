"""Base and arm planned together (VKC) compared with planners of base and arm apart (B1, B2), at tasks from random starts.

The same starts, scenes, limits and validation for all methods.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from vkc_pin.baselines.attempt import FINER
from vkc_pin.baselines.separate import BASELINES, RETRIES, plan_separately
from vkc_pin.benchmarks.comparison_report import WAYPOINTS, report
from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.charts import motions_chart
from vkc_pin.benchmarks.harness.limits import LIMITS, MAX_EVALUATIONS
from vkc_pin.benchmarks.harness.record import Record, Solve, peaks, trial
from vkc_pin.errors import InputError
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, plan
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.poses import as_placement
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Place, Step

__all__ = ["COLD", "COMPARED_PLANNERS", "METHODS", "Assignment", "Comparison"]

COMPARED_PLANNERS = (*BASELINES, "VKC")
METHODS = (*COMPARED_PLANNERS[:-1], *WAYPOINTS, "VKC")  # in the order of the tables
COLD = 5
"""Trials of a task and method that are planned twice, cold and warm."""

Draw = Callable[[Sequence[Record], Path, Mapping[str, str], Sequence[str]], list[str]]
"""What draws an experiment's charts: takes records, folder, task → what is done in it, methods; returns them in Markdown."""


@dataclass(frozen=True)
class Assignment:
    """What is to be done.

    Attributes:
        scene: The scene's name.
        steps: What should change in it.
        name: To show.
        scatter: Draws where objects stand, by name, (x, y, z, roll, pitch, yaw) [m, rad] each;
            None: all is as in the scene.
    """

    scene: str
    steps: tuple[Step, ...]
    name: str
    scatter: Callable[[Scene, np.random.Generator], dict[str, list[float]]] | None = None


@dataclass(frozen=True)
class Comparison:
    """An experiment that compares `COMPARED_PLANNERS`.

    Attributes:
        benchmark: Its name on the command line.
        title: Of its tables.
        tasks: Name → task.
        draw: What draws its charts.
        load: Returns a scene by its name.
    """

    benchmark: str
    title: str
    tasks: Mapping[str, Assignment]
    draw: Draw
    load: Callable[[str], Scene] = load_scene

    def plan_trial(self, scene: Scene, spec: Mapping[str, Any]) -> Plan:
        """Plan the task of one trial: `scene` (the task's name), `method`, `seed`, `max_evaluations` and `planner` say how."""
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
        """Return the trials: every task, method and start, in this order, in which a process can keep what it has built.

        A task's starts, and where its objects stand, depend on the seed and the task alone; start i
        is planned from with the random seed `seed` + i.
        """
        specs = []
        for name in tasks:
            task = self.tasks[name]
            rng, scene = (
                np.random.default_rng([seed, list(self.tasks).index(name)]),
                _scene(self.load, task.scene),
            )
            starts: list[dict[str, Any]] = []
            for _ in range(trials):
                more = {"placed": task.scatter(scene, rng)} if task.scatter else {}
                starts.append(
                    {"base": placed(scene, more).sample_start(rng).start[:3].tolist(), **more}
                )
            for method in methods:
                for number, start in enumerate(starts):
                    key = f"{name}/{number:04d}/{method}"
                    spec = {
                        "key": key,
                        "scene": name,
                        "method": method,
                        "number": number,
                        **start,
                        "seed": seed + number,
                    }
                    specs.append({**spec, "max_evaluations": max_evaluations})
        return specs

    def run(
        self,
        *,
        trials: int,
        seed: int,
        out: str | Path,
        solve: Solve | None = None,
        jobs: int = 1,
        scheduler: str | None = None,
        tasks: Sequence[str] | None = None,
        methods: Sequence[str] = COMPARED_PLANNERS,
        max_evaluations: int = MAX_EVALUATIONS,
        save_failures: bool = False,
        progress: bool = True,
    ) -> dict[str, Any]:
        """Run the experiment, or what is left of it, and write its results, table and pictures to `out`.

        They are results.json, results.csv and table.md; the experiment's charts; for every task
        <task>_joints.png (the motions of one trial over time); the plans of that trial in shown/,
        and those of failures in failures/ if asked for.

        Args:
            trials: Number of random starts per task, at least 1.
            seed: Of the starts and of planning.
            out: The folder; if it has trials of the same settings already, they are not run again.
            solve: What plans a trial; None: `plan_trial`.
            jobs: Number of processes.
            scheduler: Address of a Dask scheduler whose workers run the trials instead, see
                `engine.results`.
            tasks: Some of the tasks; None: all.
            methods: Some of `METHODS`.
            max_evaluations: What each trial may take at most, in evaluations.
            save_failures: Save the plan of every failure; those that ran before without this are
                planned once more.
            progress: Whether to show progress bars.

        Returns:
            {"meta": ..., "trials": [...]}; see `runner.run`. A trial's `scene` is its task's name.

        Raises:
            UnknownNameError: There is no such task or method.
            InputError: No trials, tasks or methods, or `out` has trials of other settings.
            KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
        """
        tasks = runner.chosen("task", self.tasks if tasks is None else tasks, self.tasks)
        methods = runner.chosen("method", methods, METHODS)
        if trials < 1:
            raise InputError("out of range", field="trials", expected="at least 1", got=trials)
        specs, out = (
            self.specify(
                trials=trials,
                seed=seed,
                tasks=tasks,
                methods=methods,
                max_evaluations=max_evaluations,
            ),
            Path(out),
        )
        settings = {
            "benchmark": self.benchmark,
            "seed": seed,
            "starts": trials,
            "tasks": tasks,
            "methods": methods,
        }
        settings["scenes"] = {name: self.tasks[name].scene for name in tasks}
        settings["goals"] = {name: goals(self.tasks[name].steps) for name in tasks}
        settings |= {**LIMITS, "max_evaluations": max_evaluations, "retries": RETRIES}
        trials_of = _Trials(self, out, solve or self.plan_trial, timed=solve is None)
        record = functools.partial(trials_of.record, save_failures=save_failures)
        result = runner.run(
            specs, record, out, settings=settings, jobs=jobs, scheduler=scheduler, progress=progress
        )
        saved = trials_of.saved(result["trials"], specs, again=save_failures, progress=progress)
        names = {name: self.tasks[name].name for name in tasks}
        pictures = self.draw(result["trials"], out, names, methods) + trials_of.motions(
            result["trials"], specs
        )
        write_atomically(
            out / "table.md", self.report(result, saved=saved, pictures=pictures).encode()
        )
        return result

    def report(
        self,
        result: Mapping[str, Any],
        *,
        saved: Mapping[str, str] | None = None,
        pictures: Sequence[str] = (),
    ) -> str:
        """Return the tables of a result in Markdown; see `comparison_report.report`."""
        names = {name: self.tasks[name].name for name in result["meta"]["tasks"]}
        return report(result, names, title=self.title, saved=saved, pictures=pictures)


def placed(scene: Scene, spec: Mapping[str, Any]) -> Scene:
    """Return a scene with its objects where the specification of a trial has them."""
    for name, pose in spec.get("placed", {}).items():
        scene = scene.with_placement(name, as_placement(pose))
    return scene


def goals(steps: Sequence[Step]) -> dict[str, Any]:
    """Return what steps ask for as plain data: "<object>.<joint>" → value, object → place, "base" → place."""
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
    """Runs single trials, and keeps their plans in a folder.

    Attributes:
        experiment: Whose trials they are.
        out: The folder.
        solve: What plans a trial.
        timed: Whether calls are timed by the clock, the first ones cold, too.
    """

    experiment: Comparison
    out: Path
    solve: Solve
    timed: bool = False

    def record(self, spec: dict[str, Any], *, save_failures: bool) -> dict[str, Any]:
        """Run one trial and return its record; a failure's plan is saved if asked for."""
        import pink  # noqa: F401 - planners import it when they are first called, which is no part of planning

        found, times = self._timed(spec)
        if save_failures and not found.success and found.status != "interrupted":
            found.save(self._file(spec, "failures"))
        own = {"duration": found.metrics["duration"], **peaks(found.trajectory), **times}
        own |= {key: spec[key] for key in ("scene", "number", "placed") if key in spec}
        return trial(found, method=spec["method"], seed=spec["seed"], **own)

    def saved(
        self,
        records: Sequence[Record],
        specs: Sequence[Mapping[str, Any]],
        *,
        again: bool,
        progress: bool,
    ) -> dict[str, str]:
        """Return key → file of the failures whose plans are saved; with `again`, those that are not are planned again."""
        failed = {
            record["key"]
            for record in records
            if not record["success"] and record["status"] != "error"
        }
        files = {
            spec["key"]: self._file(spec, "failures") for spec in specs if spec["key"] in failed
        }
        lost = (
            [spec for spec in specs if spec["key"] in failed and not files[spec["key"]].is_file()]
            if again
            else []
        )
        for spec in tqdm(lost, desc="failures", unit="plan", disable=not (progress and lost)):
            found = self._uninterrupted(spec)
            if not found.success:
                found.save(files[spec["key"]])
        return {
            key: path.relative_to(self.out).as_posix()
            for key, path in files.items()
            if path.is_file()
        }

    def motions(self, records: Sequence[Record], specs: Sequence[Mapping[str, Any]]) -> list[str]:
        """Draw the motions of one trial of every task in which a method succeeds in any; return the pictures in Markdown."""
        methods, pictures = tuple(dict.fromkeys(spec["method"] for spec in specs)), []
        for task in dict.fromkeys(spec["scene"] for spec in specs):
            own, name = (
                [record for record in records if record["scene"] == task],
                self.experiment.tasks[task].name,
            )
            if (number := shown(own, methods)) is not None:
                plans = {
                    s["method"]: self._kept(s)
                    for s in specs
                    if (s["scene"], s["number"]) == (task, number)
                }
                motions_chart(
                    plans,
                    self.out / f"{task}_joints.png",
                    title=f"{name.capitalize()}, trial {number}",
                )
                pictures.append(f"![Motions of trial {number}: {name}]({task}_joints.png)")
        return pictures

    def _kept(self, spec: Mapping[str, Any]) -> Plan:
        """Return the plan of a trial that is shown: from its file, or else planned again and saved there."""
        path = self._file(spec, "shown")
        if path.is_file():
            return Plan.load(path)
        found = self._uninterrupted(spec)
        found.save(path)
        return found

    def _uninterrupted(self, spec: Mapping[str, Any]) -> Plan:
        if (found := self._plan(spec)).status == "interrupted":
            raise KeyboardInterrupt("all trials are done, but not all of their plans are saved")
        return found

    def _timed(self, spec: Mapping[str, Any]) -> tuple[Plan, dict[str, float]]:
        """Return a trial's plan and how long that took by the clock; the first ones are planned cold, and again."""
        if not self.timed:
            return self._plan(spec), {}
        times, new = dict[str, float](), {"planner": Planner()} if spec["number"] < COLD else {}
        for name in ("cold_time", "warm_time") if new else ("wall_time",):
            began, found = time.perf_counter(), self._plan({**spec, **new})
            times[name] = time.perf_counter() - began
            if found.status == "interrupted":
                break  # what the runner must see
        return found, {"wall_time": times.get("warm_time", 0.0), **times}

    def _plan(self, spec: Mapping[str, Any]) -> Plan:
        scene = placed(
            _scene(self.experiment.load, self.experiment.tasks[spec["scene"]].scene), spec
        )
        return self.solve(scene.with_start(base=spec["base"]), spec)

    def _file(self, spec: Mapping[str, Any], folder: str) -> Path:
        return self.out / folder / f"{spec['scene']}_{spec['number']:04d}_{spec['method']}.npz"


@functools.cache
def _scene(load: Callable[[str], Scene], name: str) -> Scene:
    return load(name)  # once per process


def shown(records: Sequence[Record], methods: Sequence[str]) -> int | None:
    """Return the first trial in which all methods succeed, or else VKC and most others, or else most; None: none ever does."""
    good: dict[int, set[str]] = {}
    for record in records:
        if record["success"]:
            good.setdefault(int(record["number"]), set()).add(str(record["method"]))
    return max(
        sorted(good),
        key=lambda k: (len(good[k]) == len(methods), "VKC" in good[k], len(good[k])),
        default=None,
    )
