"""Defines Episode, and plans, validates, packs and unpacks episodes."""

from __future__ import annotations

import functools
import hashlib
import json
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.datasets.diversity import sample_coarse_trajectory
from vkc_pin.datasets.problems import NoProblemError, Problem, sample_problem
from vkc_pin.datasets.recipe import Recipe, load_recipe
from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner
from vkc_pin.planning.prepare import plan
from vkc_pin.simulation.cameras import Images, render_images
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.result import SimulationResult
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.system import identify_process, measure_peak_memory, measure_resident_memory
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.files.writing import check_name
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step
from vkc_pin.world.task.terms import Term
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import MOST_SAMPLES, Trajectory

_MAX_ENTRIES = 512  # of a planner's cache
_MAX_MEGABYTES = 96.0  # of a planner's cache
_DIGITS = 12  # digits of a scene's name
# [m], [rad], [m/s], ...: trajectories are rounded to 0.5e-9; smaller digits are noise, which does
# not compress.
_GRID = 2.0**-30
_PERTURBATION = 0.05  # [m], [rad] noise of initial guesses of further variants


@dataclass(frozen=True, eq=False)
class Episode:
    """An episode as read from a dataset, none of which is trusted.

    Attributes:
        number: Episode number, which with the recipe determines it.
        about: Sampled values and results: task, robot, room, object, kind, attachment, joint, goal,
            variant, metrics.
        document: Scene as plain data, without its start.
        start: Start, as part of the scene's description.
        where: Folder of relative paths in the scene; None for the package's scenes.
        robots: Folder of the dataset's robots, by name.
        load_images: Reads the camera images; None without cameras.
        steps: Steps of the task.
        options: Planning options.
        trajectory: The trajectory.
        claimed: Validation report of the file.
        terms: Additional terms of the recipe.
    """

    number: int
    about: Mapping[str, Any]
    document: Mapping[str, Any]
    start: Mapping[str, Any]
    where: str | None
    steps: tuple[Step, ...]
    options: Options
    trajectory: Trajectory
    claimed: Report
    terms: tuple[Term, ...] = ()
    robots: Path | None = None
    load_images: Callable[[], Images] | None = None

    def images(self) -> Images | None:
        """Read the camera images of every sample; None without cameras."""
        return None if self.load_images is None else self.load_images()

    def scene(self) -> Scene:
        """Build the scene from its description.

        Raises:
            InputError: The description is invalid.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they were shown during generation
            robot = dict(self.document["robot"])
            if self.robots is not None:
                file = self.robots / check_name(robot["name"], "robot.name") / "robot.yaml"
                if file.is_file():
                    # Relative paths of a scene begin at the folder of its description.
                    robot["name"] = str(file.resolve())
            document = {**self.document, "robot": robot, "start": self.start}
            return Scene.from_document(document, self.where or find_resource_folder("scenes"))

    def validate(self) -> Report:
        """Return the report of the independent validation in the rebuilt scene."""
        return validate(self.scene(), self.steps, self.trajectory, self.options, self.terms)


@functools.cache
def _get_planner() -> Planner:
    """Return this process's planner."""
    return Planner(entries=_MAX_ENTRIES, megabytes=_MAX_MEGABYTES)


@functools.lru_cache(maxsize=4)
def _load_recipe(recipe: str) -> Recipe:
    return load_recipe(json.loads(recipe))


Attempt = tuple[dict[str, Any], Episode | None]
"""The record of an attempt, as in the journal, and its episode, None after a failure."""


def run_attempt(document: Mapping[str, Any], number: int, robots: Mapping[str, str]) -> Attempt:
    """Plan one episode; exceptions become recorded failures.

    Args:
        document: Document of the recipe.
        number: Number of the attempt.
        robots: Name → file of the recipe's robots.
    """
    start_time = time.perf_counter()
    start_cpu_time = time.process_time()
    record: dict[str, Any] = {"number": number, "success": False}
    episode = None
    try:
        recipe = _load_recipe(json.dumps(document, sort_keys=True))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings about a robot would repeat in every episode
            problem = sample_problem(recipe, number, robots, _get_planner())
            record |= {**problem.about, "setup_time": round(time.perf_counter() - start_time, 4)}
            planned = _plan_problem(problem, recipe)
            record |= _record_plan(planned)
            images = None
            if planned.success and recipe.fields.simulate:
                executed = simulate(planned.scene, planned.steps, planned.trajectory)
                record |= _record_simulation(executed)
                if executed.ok and recipe.cameras:
                    times = sample_times(planned.trajectory, recipe.fields.rate)
                    images = render_images(executed, recipe.cameras, times)
            if record["success"]:
                about = {**problem.about, "metrics": _select_metrics(planned)}
                made = make_episode(number, about, planned, images)
                record |= _record_motion(made, planned)
                episode = made
    except NoProblemError as error:
        record |= {"status": "no problem", "reason": str(error)}
    except Exception as error:  # one episode must not end ten thousand
        reason = f"{type(error).__name__}: {error}"
        record |= {"success": False, "status": "error", "reason": reason}
    record |= {
        "seconds": round(time.perf_counter() - start_time, 4),
        "cpu_time": round(time.process_time() - start_cpu_time, 4),
        "memory_mb": round(measure_peak_memory(), 1),
        "resident_mb": round(measure_resident_memory(), 1),
        "process": identify_process(),
    }
    return record, episode


def _plan_problem(problem: Problem, recipe: Recipe) -> Plan:
    return plan(
        problem.scene,
        problem.steps,
        options=problem.options,
        seed=problem.seed,
        max_evaluations=recipe.fields.max_evaluations,
        time_limit=recipe.fields.time_limit,
        perturbation=0.0 if problem.seed == 0 else _PERTURBATION,
        terms=problem.terms,
        planner=_get_planner(),
    )


def _record_plan(planned: Plan) -> dict[str, Any]:
    """Return the fields of an attempt's record that describe planning."""
    reason = ""
    if not planned.success:
        reasons = [str(violation) for violation in planned.report.violations[:1]]
        reasons += planned.report.notes[:2]
        reason = "; ".join(reasons) or planned.status
    metrics = planned.metrics
    return {
        "success": planned.success,
        "status": planned.status,
        "reason": reason,
        "planning_time": round(metrics["planning_time"], 4),
        "build_time": round(metrics["build_time"], 4),
        "validation_time": round(metrics["time_validation"], 4),
        "evaluations": int(metrics["evaluations"]),
        "initialization": planned.initialization,
    }


def _record_simulation(executed: SimulationResult) -> dict[str, Any]:
    """Return the record's changes after a simulation; see `simulation.execution`."""
    if executed.ok:
        return {"simulated": True}
    return {
        "success": False,
        "status": "physics",
        "reason": "; ".join(executed.problems()),
        "simulated": True,
    }


def sample_times(motion: Trajectory, rate: float) -> Floats:
    """Return the sampling times of a trajectory at a rate [Hz], shape (N,) [s].

    Raises:
        InputError: There are too many.
    """
    first = motion.times[0]
    last = motion.times[-1]
    count = np.ceil((last - first) * rate) + 1.0
    if count > MOST_SAMPLES:
        expected = f"a motion of at most {MOST_SAMPLES} samples at {rate:g} Hz"
        raise InputError("too long a motion", field="motion", expected=expected, got=f"{count:g}")
    return np.minimum(first + np.arange(int(count)) / rate, last)


def _select_metrics(planned: Plan) -> dict[str, float]:
    """Return a plan's metrics that do not depend on the machine."""
    names = (
        "base_path_length",
        "base_path_length_l1",
        "arm_path_length",
        "clearance",
        "closure_error",
        "duration",
        "evaluations",
    )
    metrics = planned.metrics
    return {name: float(metrics[name]) for name in names if np.isfinite(metrics[name])}


def compute_scene_name(document: Mapping[str, Any]) -> str:
    """Return the name of a scene's description, a digest of its contents."""
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:_DIGITS]


def make_episode(
    number: int, about: Mapping[str, Any], planned: Plan, images: Images | None = None
) -> Episode:
    """Return the episode of a plan, with its trajectory rounded to multiples of `_GRID`.

    Args:
        number: Episode number.
        about: See `Episode`.
        planned: The plan.
        images: Camera images, if any.
    """
    document = json.loads(json.dumps(planned.scene.document))
    start = document.pop("start")
    document["robot"]["name"] = about["robot"]
    folder = planned.scene.folder.resolve()
    is_packaged = folder == find_resource_folder("scenes").resolve()
    return Episode(
        number=number,
        about=json.loads(json.dumps(about)),
        document=document,
        start=start,
        where=None if is_packaged else str(folder),
        steps=planned.steps,
        options=planned.options,
        trajectory=_round_trajectory(planned.trajectory),
        claimed=planned.report,
        terms=planned.terms,
        load_images=None if images is None else lambda: images,
    )


def _record_motion(episode: Episode, planned: Plan) -> dict[str, Any]:
    """Return the fields of an attempt's record that describe its motion."""
    metrics = _select_metrics(planned)
    del metrics["evaluations"]
    return {
        "scene": compute_scene_name(episode.document),
        "start": np.asarray(planned.scene.start).round(4).tolist(),
        "end": planned.trajectory.positions[-1][:2].round(4).tolist(),
        "waypoints": len(planned.trajectory.times),
        **{name: round(value, 5) for name, value in metrics.items()},
        "way": sample_coarse_trajectory(planned.trajectory),
    }


def _round_trajectory(motion: Trajectory) -> Trajectory:
    curve = motion.curve
    if curve is not None:
        curve = Curve(curve.times, _round_to_grid(curve.positions), _round_to_grid(curve.rates))
    return replace(motion, positions=_round_to_grid(motion.positions), curve=curve)


def _round_to_grid(values: Any) -> Floats:
    """Return numbers rounded to multiples of `_GRID`."""
    return np.round(np.array(values, float) / _GRID) * _GRID


def get_work_file(out: Path, number: int) -> Path:
    """Return the file of an episode that is not yet in a shard."""
    return out / "work" / f"{number:08d}.hdf5"
