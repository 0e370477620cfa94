"""Defines Episode, and plans, validates, packs and unpacks episodes."""

from __future__ import annotations

import functools
import hashlib
import io
import json
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.datasets.diversity import sample_coarse_trajectory
from vkc_pin.datasets.problems import NoProblemError, sample_problem
from vkc_pin.datasets.recipe import Recipe, load_recipe
from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, plan
from vkc_pin.simulation.cameras import Images, render_images
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.result import SimulationResult
from vkc_pin.utils.arrays import Floats, replace_infinite
from vkc_pin.utils.system import identify_process, measure_peak_memory, measure_resident_memory
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.files.writing import check_name
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step, step_from_dict, step_to_dict
from vkc_pin.world.task.terms import Term, term_from_dict, term_to_dict
from vkc_pin.world.trajectory.trajectory import MOST_SAMPLES, Trajectory

_PLANNER = {"entries": 512, "megabytes": 96.0}
_DIGITS = 12  # digits of a scene's name
# [m], [rad], [m/s], ...: trajectories are rounded to 0.5e-9; smaller digits are noise, which does
# not compress.
_GRID = 2.0**-30


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
                # absolute: a scene's relative paths begin at the folder of its description
                robot["name"] = str(file.resolve()) if file.is_file() else robot["name"]
            document = {**self.document, "robot": robot, "start": self.start}
            return Scene.from_document(document, self.where or find_resource_folder("scenes"))

    def validate(self) -> Report:
        """Return the report of the independent validation in the rebuilt scene."""
        return validate(self.scene(), self.steps, self.trajectory, self.options, self.terms)


@functools.cache
def _get_planner() -> Planner:
    """Return this process's planner."""
    return Planner(entries=int(_PLANNER["entries"]), megabytes=_PLANNER["megabytes"])


@functools.lru_cache(maxsize=4)
def _load_recipe(recipe: str) -> Recipe:
    return load_recipe(json.loads(recipe))


Made = tuple[dict[str, Any], bytes]
"""The record of an attempt, as in the journal, and the packed episode, empty after a failure."""


def run_attempts(task: tuple[Mapping[str, Any], Sequence[int], Mapping[str, str]]) -> list[Made]:
    """Run attempts with a recipe's document, their numbers, and files of robots.

    See `run_attempt`.
    """
    recipe, numbers, robots = task
    return [run_attempt(recipe, number, robots) for number in numbers]


def run_attempt(document: Mapping[str, Any], number: int, robots: Mapping[str, str]) -> Made:
    """Plan one episode; exceptions become recorded failures."""
    start_time, start_cpu_time = time.perf_counter(), time.process_time()
    record: dict[str, Any] = {"number": number, "success": False}
    data = images = b""
    try:
        recipe = _load_recipe(json.dumps(document, sort_keys=True))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings about a robot would repeat in every episode
            problem = sample_problem(recipe, number, robots, _get_planner())
            record |= {**problem.about, "setup_time": round(time.perf_counter() - start_time, 4)}
            plan_result = plan(
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
            record |= _record_plan(plan_result)
            if plan_result.success and recipe.fields.simulate:
                executed = simulate(plan_result.scene, plan_result.steps, plan_result.trajectory)
                record |= _record_simulation(executed)
                if executed.ok and recipe.cameras:
                    images = render_images(
                        executed,
                        recipe.cameras,
                        sample_times(plan_result.trajectory, recipe.fields.rate),
                    ).to_bytes()
            if record["success"]:
                about = problem.about | {"metrics": _select_metrics(plan_result)}
                data, more = pack(number, about, plan_result, images)
                record |= more
    except NoProblemError as error:
        record |= {"status": "no problem", "reason": str(error)}
    except Exception as error:  # one episode must not end ten thousand
        record |= {
            "success": False,
            "status": "error",
            "reason": f"{type(error).__name__}: {error}",
        }
    record |= {
        "seconds": round(time.perf_counter() - start_time, 4),
        "cpu_time": round(time.process_time() - start_cpu_time, 4),
    }
    record |= {
        "memory_mb": round(measure_peak_memory(), 1),
        "resident_mb": round(measure_resident_memory(), 1),
        "process": identify_process(),
    }
    return record, data if record["success"] else b""


_PERTURBATION = 0.05  # [m], [rad] noise of initial guesses of further variants


def _record_plan(plan_result: Plan) -> dict[str, Any]:
    worst = [str(one) for one in plan_result.report.violations[:1]]
    reason = (
        ""
        if plan_result.success
        else "; ".join([*worst, *plan_result.report.notes[:2]]) or plan_result.status
    )
    return {
        "success": plan_result.success,
        "status": plan_result.status,
        "reason": reason,
        "planning_time": round(plan_result.metrics["planning_time"], 4),
        "build_time": round(plan_result.metrics["build_time"], 4),
        "validation_time": round(plan_result.metrics["time_validation"], 4),
        "evaluations": int(plan_result.metrics["evaluations"]),
        "initialization": plan_result.initialization,
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
    count = np.ceil((motion.times[-1] - motion.times[0]) * rate) + 1.0
    if count > MOST_SAMPLES:
        expected = f"a motion of at most {MOST_SAMPLES} samples at {rate:g} Hz"
        raise InputError("too long a motion", field="motion", expected=expected, got=f"{count:g}")
    count = int(count)
    return np.minimum(motion.times[0] + np.arange(count) / rate, motion.times[-1])


def _select_metrics(plan_result: Plan) -> dict[str, float]:
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
    return {
        name: float(plan_result.metrics[name])
        for name in names
        if np.isfinite(plan_result.metrics[name])
    }


def compute_scene_name(document: Mapping[str, Any]) -> str:
    """Return the name of a scene's description, a digest of its contents."""
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:_DIGITS]


def pack(
    number: int, about: Mapping[str, Any], plan_result: Plan, images: bytes = b""
) -> tuple[bytes, dict[str, Any]]:
    """Return a plan as bytes for `unpack`, and additional fields of its journal record.

    Args:
        number: Episode number.
        about: See `Episode`.
        plan_result: The plan.
        images: Camera images as bytes (`Images.to_bytes`), if any.
    """
    document = json.loads(json.dumps(plan_result.scene.document))
    start = document.pop("start")
    document["robot"]["name"] = about["robot"]
    motion = plan_result.trajectory.to_dict()
    arrays = {name: _round_to_grid(motion.pop(name)) for name in ("positions",)} | {
        "times": np.array(motion.pop("times"), float)
    }
    for name, values in motion.pop("curve", {}).items():
        arrays[f"knot_{name}"] = (
            np.array(values, float) if name == "times" else _round_to_grid(values)
        )
    outside = plan_result.scene.folder.resolve() != find_resource_folder("scenes").resolve()
    data = {
        "number": number,
        "about": dict(about),
        "scene": document,
        "start": start,
        "where": str(plan_result.scene.folder.resolve()) if outside else None,
        "steps": [step_to_dict(step) for step in plan_result.steps],
        "terms": [term_to_dict(term) for term in plan_result.terms],
        "options": asdict(plan_result.options),
        "motion": motion,
        "validation": replace_infinite(plan_result.report.to_dict()),
    }
    buffer = io.BytesIO()
    seen: Any = {"images": np.frombuffer(images, np.uint8)} if images else {}
    np.savez_compressed(
        buffer, allow_pickle=False, about=np.array(json.dumps(data)), **arrays, **seen
    )
    more = {
        "scene": compute_scene_name(document),
        "start": np.asarray(plan_result.scene.start).round(4).tolist(),
        "end": plan_result.trajectory.positions[-1][:2].round(4).tolist(),
        "waypoints": len(plan_result.trajectory.times),
        **{
            name: round(value, 5)
            for name, value in _select_metrics(plan_result).items()
            if name != "evaluations"
        },
        "way": sample_coarse_trajectory(plan_result.trajectory),
    }
    return buffer.getvalue(), more


def _round_to_grid(values: Any) -> Floats:
    """Return numbers rounded to multiples of `_GRID`."""
    return np.round(np.array(values, float) / _GRID) * _GRID


def unpack(data: bytes, robots: Path | None = None) -> Episode:
    """Return the episode from bytes of `pack`; `robots` is the folder of the dataset's robots."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    about, seen = json.loads(str(arrays.pop("about"))), arrays.pop("images", None)
    plan_result = make_episode(
        about, {name: np.asarray(values, float) for name, values in arrays.items()}, robots
    )
    return (
        plan_result
        if seen is None
        else replace(plan_result, load_images=functools.partial(Images.from_bytes, seen.tobytes()))
    )


def make_episode(
    data: Mapping[str, Any], arrays: Mapping[str, Floats], robots: Path | None = None
) -> Episode:
    """Return an episode from its description and its arrays; see `pack`.

    Raises:
        InputError: Fields are missing or invalid.
    """
    try:
        motion = {**data["motion"], "times": arrays["times"], "positions": arrays["positions"]}
        if "knot_times" in arrays:
            motion["curve"] = {
                name: arrays[f"knot_{name}"] for name in ("times", "positions", "rates")
            }
        report = dict(data["validation"])
        report["clearance"] = np.inf if report["clearance"] is None else report["clearance"]
        report["clearances"] = [
            np.inf if value is None else value for value in report["clearances"]
        ]
        return Episode(
            number=int(data["number"]),
            about=data["about"],
            document=data["scene"],
            start=data["start"],
            where=data["where"],
            steps=tuple(step_from_dict(step) for step in data["steps"]),
            options=Options(**data["options"]),
            trajectory=Trajectory.from_dict(motion),
            claimed=Report.from_dict(report),
            terms=tuple(term_from_dict(term) for term in data.get("terms", ())),
            robots=robots,
        )
    except InputError:
        raise
    except (
        *(LookupError, TypeError, AttributeError, ValueError),
        *(OverflowError, RecursionError, MemoryError),
    ) as error:
        raise InputError(
            "the data are not an episode",
            expected="an episode written by `generate`",
            got=f"{type(error).__name__}: {error}",
        ) from error


def get_work_file(out: Path, number: int) -> Path:
    """Return the file of an episode that is not yet in a shard."""
    return out / "work" / f"{number:08d}.hdf5"
