"""One episode: planned, checked and told as plain data; and as it is read back."""

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
from vkc_pin.datasets.recipes.recipe import Recipe, load_recipe
from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner, plan
from vkc_pin.simulation.cameras.images import Images, render_images
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.result import SimulationResult
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.parallel.machine import peak_memory, process_name, resident_memory
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.files.resources import folder
from vkc_pin.world.files.writing import check_name
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step, step_from_dict, step_to_dict
from vkc_pin.world.task.terms import Term, term_from_dict, term_to_dict
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = [
    "Episode",
    "Made",
    "compute_scene_name",
    "get_work_file",
    "make_episode",
    "pack",
    "run_attempt",
    "run_attempts",
    "sample_times",
    "unpack",
]

_PLANNER = {"entries": 512, "megabytes": 96.0}
_DIGITS = 12  # of a scene's name
_GRID = (
    2.0**-30
    # [m], [rad], [m/s], ...: motions are kept to 0.5e-9; what is below is noise, which does not
    # compress
)


@dataclass(frozen=True, eq=False)
class Episode:
    """An episode as it is in a dataset, nothing of which is relied on.

    Attributes:
        number: With the recipe, this determines it.
        about: What was drawn and what came out: task, robot, room, object, kind, attachment, joint,
            goal, variant, metrics.
        document: The scene as plain data, without its start.
        start: The start, as part of the scene's description.
        where: The folder that relative paths in the scene start from; None: the package's scenes.
        robots: The folder in which the dataset has robots, by name.
        load_images: Reads what cameras saw; None where there were no cameras.
        steps: What was asked for.
        options: How it was planned.
        trajectory: The motion.
        claimed: What the validation said of it.
        terms: What the motion had to keep to beside that, of the recipe.
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
        """Return what cameras saw at every sample, read when it is asked for; None where there were no cameras."""
        return None if self.load_images is None else self.load_images()

    def scene(self) -> Scene:
        """Return the scene, built anew from its description. Raises InputError if it is wrong."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what generating it has said already
            robot = dict(self.document["robot"])
            if self.robots is not None:
                file = self.robots / check_name(robot["name"], "robot.name") / "robot.yaml"
                robot["name"] = str(file) if file.is_file() else robot["name"]
            document = {**self.document, "robot": robot, "start": self.start}
            return Scene.from_document(document, self.where or folder("scenes"))

    def validate(self) -> Report:
        """Return what the independent check says of the motion, in the scene built anew."""
        return validate(self.scene(), self.steps, self.trajectory, self.options, self.terms)


@functools.cache
def _planner() -> Planner:
    """Return what this process keeps of planning."""
    return Planner(entries=int(_PLANNER["entries"]), megabytes=_PLANNER["megabytes"])


@functools.lru_cache(maxsize=4)
def _recipe(said: str) -> Recipe:
    return load_recipe(json.loads(said))


Made = tuple[dict[str, Any], bytes]
"""The record of an attempt, as in the journal, and the episode packed, empty if it became none."""


def run_attempts(task: tuple[Mapping[str, Any], Sequence[int], Mapping[str, str]]) -> list[Made]:
    """Make episodes of a recipe, as plain data, by their numbers; with what to load for which robot. See `run_attempt`."""
    said, numbers, robots = task
    return [run_attempt(said, number, robots) for number in numbers]


def run_attempt(said: Mapping[str, Any], number: int, robots: Mapping[str, str]) -> Made:
    """Make one episode; an exception becomes a failure on record."""
    began, worked = time.perf_counter(), time.process_time()
    record: dict[str, Any] = {"number": number, "success": False}
    data = images = b""
    try:
        recipe = _recipe(json.dumps(said, sort_keys=True))
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # what is said of a robot would be said again of every episode
            asked = sample_problem(recipe, number, robots, _planner())
            record |= {**asked.about, "setup_time": round(time.perf_counter() - began, 4)}
            found = plan(
                asked.scene,
                asked.steps,
                options=asked.options,
                seed=asked.seed,
                effort=recipe.fields.effort,
                time_limit=recipe.fields.time_limit,
                perturbation=0.0 if asked.seed == 0 else _PERTURBED,
                terms=asked.terms,
                planner=_planner(),
            )
            record |= _outcome(found)
            if found.success and recipe.fields.simulate:
                executed = simulate(found.scene, found.steps, found.trajectory)
                record |= _physics(executed)
                if executed.ok and recipe.cameras:
                    images = render_images(
                        executed, recipe.cameras, sample_times(found.trajectory, recipe.fields.rate)
                    ).to_bytes()
            if record["success"]:
                about = asked.about | {"metrics": _metrics(found)}
                data, more = pack(number, about, found, images)
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
        "seconds": round(time.perf_counter() - began, 4),
        "cpu_time": round(time.process_time() - worked, 4),
    }
    record |= {
        "memory_mb": round(peak_memory(), 1),
        "resident_mb": round(resident_memory(), 1),
        "process": process_name(),
    }
    return record, data if record["success"] else b""


_PERTURBED = 0.05  # [m], [rad] of noise on the seeds of further variants


def _outcome(found: Plan) -> dict[str, Any]:
    worst = [str(one) for one in found.validation.violations[:1]]
    reason = (
        "" if found.success else "; ".join([*worst, *found.validation.notes[:2]]) or found.status
    )
    return {
        "success": found.success,
        "status": found.status,
        "reason": reason,
        "planning_time": round(found.metrics["planning_time"], 4),
        "build_time": round(found.metrics["build_time"], 4),
        "validation_time": round(found.metrics["time_validation"], 4),
        "effort": int(found.metrics["effort"]),
        "initialization": found.initialization,
    }


def _physics(executed: SimulationResult) -> dict[str, Any]:
    """Return what physics says otherwise; see `simulation.execution`."""
    if executed.ok:
        return {"simulated": True}
    return {
        "success": False,
        "status": "physics",
        "reason": "; ".join(executed.problems()),
        "simulated": True,
    }


def sample_times(motion: Trajectory, rate: float) -> Floats:
    """Return when a motion is sampled at a rate [Hz], from its start to its end, shape (N,) [s]."""
    count = int(np.ceil((motion.times[-1] - motion.times[0]) * rate)) + 1
    return np.minimum(motion.times[0] + np.arange(count) / rate, motion.times[-1])


def _metrics(found: Plan) -> dict[str, float]:
    """Return what does not depend on the machine of a plan's metrics."""
    names = (
        "base_effort",
        "base_effort_l1",
        "arm_effort",
        "clearance",
        "closure_error",
        "duration",
        "effort",
    )
    return {name: float(found.metrics[name]) for name in names if np.isfinite(found.metrics[name])}


def compute_scene_name(document: Mapping[str, Any]) -> str:
    """Return the name of a scene's description, which depends on what it says alone."""
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:_DIGITS]


def pack(
    number: int, about: Mapping[str, Any], found: Plan, images: bytes = b""
) -> tuple[bytes, dict[str, Any]]:
    """Return a plan as bytes that `unpack` reads, and what the journal says of it: scene, start, way and metrics.

    Args:
        number: Of the episode.
        about: See `Episode`.
        found: The plan.
        images: What cameras saw, of `Images.to_bytes`, if there were any.
    """
    document = json.loads(json.dumps(found.scene.document))
    start = document.pop("start")
    document["robot"]["name"] = about["robot"]
    motion = found.trajectory.to_dict()
    arrays = {name: _coarse(motion.pop(name)) for name in ("positions",)} | {
        "times": np.array(motion.pop("times"), float)
    }
    for name, values in motion.pop("curve", {}).items():
        arrays[f"knot_{name}"] = np.array(values, float) if name == "times" else _coarse(values)
    outside = found.scene.folder.resolve() != folder("scenes").resolve()
    data = {
        "number": number,
        "about": dict(about),
        "scene": document,
        "start": start,
        "where": str(found.scene.folder.resolve()) if outside else None,
        "steps": [step_to_dict(step) for step in found.steps],
        "terms": [term_to_dict(term) for term in found.terms],
        "options": asdict(found.options),
        "motion": motion,
        "validation": {
            **found.validation.to_dict(),
            "clearance": _finite(found.validation.clearance),
        },
    }
    data["validation"]["clearances"] = [_finite(value) for value in found.validation.clearances]
    buffer = io.BytesIO()
    seen: Any = {"images": np.frombuffer(images, np.uint8)} if images else {}
    np.savez_compressed(
        buffer, allow_pickle=False, about=np.array(json.dumps(data)), **arrays, **seen
    )
    more = {
        "scene": compute_scene_name(document),
        "start": np.asarray(found.scene.start).round(4).tolist(),
        "end": found.trajectory.positions[-1][:2].round(4).tolist(),
        "waypoints": len(found.trajectory.times),
        **{name: round(value, 5) for name, value in _metrics(found).items() if name != "effort"},
        "way": sample_coarse_trajectory(found.trajectory),
    }
    return buffer.getvalue(), more


def _coarse(values: Any) -> Floats:
    """Return numbers rounded to `_GRID`."""
    return np.round(np.array(values, float) / _GRID) * _GRID


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def unpack(data: bytes, robots: Path | None = None) -> Episode:
    """Return the episode that `pack` made bytes of; `robots` is the folder of the dataset's robots."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    about, seen = json.loads(str(arrays.pop("about"))), arrays.pop("images", None)
    found = make_episode(
        about, {name: np.asarray(values, float) for name, values in arrays.items()}, robots
    )
    return (
        found
        if seen is None
        else replace(found, load_images=functools.partial(Images.from_bytes, seen.tobytes()))
    )


def make_episode(
    data: Mapping[str, Any], arrays: Mapping[str, Floats], robots: Path | None = None
) -> Episode:
    """Return an episode of its description and its arrays; see `pack`.

    Raises:
        InputError: Something is missing from them or does not fit.
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
    except (LookupError, TypeError, AttributeError) as error:
        raise InputError(
            "not an episode",
            expected="what generating has written",
            got=f"{type(error).__name__}: {error}",
        ) from error


def get_work_file(out: Path, number: int) -> Path:
    """Return where an episode is kept until it is in a shard."""
    return out / "work" / f"{number:08d}.hdf5"
