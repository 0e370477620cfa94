"""Reads and writes shards: HDF5 files of many episodes in robomimic's layout.

Groups are `data/demo_<k>` with `actions`, `states`, `obs`, `rewards` and `dones`, attributes
`total`, `env_args` and `num_samples`, and `mask`. Samples are in single precision; the trajectory
itself is in double precision under `motion`.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vkc_pin.datasets.episode import Episode, compute_scene_name, run_attempt
from vkc_pin.datasets.formats.hdf5_reader import Group, open_hdf5, require_h5py
from vkc_pin.datasets.formats.samples import sample_episode
from vkc_pin.datasets.recipe import Recipe, load_recipe
from vkc_pin.errors import InputError, format_value
from vkc_pin.options import Options
from vkc_pin.simulation.cameras import Images
from vkc_pin.utils.arrays import Floats, Ints, replace_infinite
from vkc_pin.validation.report import Report
from vkc_pin.world.files.documents import Document, parse_document, parse_json, read_text
from vkc_pin.world.files.fields import Name, Schema
from vkc_pin.world.files.writing import check_name, write_atomically
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.task.steps import step_from_dict, step_to_dict
from vkc_pin.world.task.terms import term_from_dict, term_to_dict
from vkc_pin.world.trajectory.formats.archives import nest_knots
from vkc_pin.world.trajectory.trajectory import TrajectorySchema

if TYPE_CHECKING:
    import h5py


_OBSERVED = (
    "base_pose",
    "base_velocity",
    "arm_position",
    "arm_velocity",
    "hand_pose",
    "gripper",
    "holding",
    "object_position",
)
_ENVIRONMENT = "vkc_pin"
_HELD_OUT = 10  # every so many an episode is in mask/valid, the others are in mask/train
# Type and number of axes of an episode's samples, of the arrays of its motion, and of images by the
# end of their names.
_SAMPLED = {"actions": ("f4", 2), "states": ("f4", 2), "rewards": ("f4", 1), "dones": ("u1", 1)}
_MOTION = {
    "times": ("f8", 1),
    "positions": ("f8", 2),
    "waypoints": ("i4", 1),
    "knot_times": ("f8", 1),
    "knot_positions": ("f8", 2),
    "knot_rates": ("f8", 2),
}
_IMAGES = {"_image": ("u1", 4), "_depth": ("u2", 3), "_segmentation": ("u2", 3)}
_MAX_IMAGES = 4_000_000_000  # [bytes] of a camera in an episode
_MIN_COMPRESSED = 512  # [bytes] of an array, up to which it is not compressed
_TOLERANCE = 1e-5  # of single precision, and of other machines; relative, and [m] or [rad]
Made = tuple[dict[str, Any], bytes]
"""The record of an attempt, and its episode as packed by `make_part`, empty after a failure."""
_ROBOTS: dict[tuple[str, str, float | None], Robot] = {}
"""Robots of this process by recipe, name and height, since building every scene is slow."""


def write_shard(path: Path, parts: Sequence[tuple[Path, int]], scenes: Path) -> Path:
    """Write episodes of one robot to a file atomically and reproducibly; return the path.

    Episodes are copied, which is 20 times as fast as making a part.

    Args:
        path: File.
        parts: For each episode a file of `make_part` or a shard, and the episode's place in it.
        scenes: Folder of the dataset's scenes, to which missing ones are added.
    """
    h5py = require_h5py()
    buffer = io.BytesIO()
    numbers: list[int] = []
    total = 0
    with h5py.File(buffer, "w", libver="latest") as file:
        data = file.create_group("data")
        for k, (source, place) in enumerate(parts):
            name = f"demo_{k}"
            with open_hdf5(source) as found:
                demo = found.open_group("data").open_group(f"demo_{place}")
                _check_members(demo)
                _keep_scene(found, _read_scene_name(demo), scenes)
                found.handle.copy(f"data/demo_{place}", data, name=name)
                if k == 0:
                    # They follow from the recipe, and so are the same in all.
                    for attribute in ("options", "env_args"):
                        data.attrs[attribute] = found.open_group("data").read_text(attribute)
                total += demo.read_integer("num_samples")
                numbers.append(demo.read_integer("number"))
        data.attrs["total"] = total
        for mask, names in _make_masks(numbers).items():
            file.create_dataset(f"mask/{mask}", data=np.array(names, dtype="S"))
    return write_atomically(path, buffer.getvalue())


def make_part(episode: Episode, robot: Robot, rate: float, recipe: str) -> bytes:
    """Return an episode with its scene as a file for `write_shard`.

    Args:
        episode: Episode.
        robot: Its robot.
        rate: Sampling rate [Hz].
        recipe: Digest of the recipe.
    """
    h5py = require_h5py()
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", libver="latest") as file:
        data = file.create_group("data")
        _write_demo(data.create_group("demo_0"), episode, robot, rate)
        data.attrs["options"] = json.dumps(asdict(episode.options), sort_keys=True)
        data.attrs["env_args"] = json.dumps(_make_settings(robot.name, rate, recipe))
        scene = json.dumps(episode.document, sort_keys=True, separators=(",", ":")) + "\n"
        file.create_dataset("scene", data=np.frombuffer(scene.encode(), np.uint8))
    return buffer.getvalue()


def _make_settings(robot: str, rate: float, recipe: str) -> dict[str, Any]:
    """Return the settings of the environment, as robomimic calls them."""
    settings = {
        "robot": robot,
        "rate": rate,
        "recipe": recipe,
        "scenes": "../../scenes/<scene>.json",
    }
    return {"env_name": _ENVIRONMENT, "env_type": -1, "env_kwargs": settings}


def _make_masks(numbers: Sequence[int]) -> dict[str, list[str]]:
    """Return the demos for training and validation of a shard with these episodes."""
    masks: dict[str, list[str]] = {"train": [], "valid": []}
    for k, number in enumerate(numbers):
        is_held_out = number % _HELD_OUT == _HELD_OUT - 1
        masks["valid" if is_held_out else "train"].append(f"demo_{k}")
    return masks


def _keep_scene(found: Group, name: str, scenes: Path) -> None:
    """Write the scene of an episode unless it exists."""
    path = scenes / f"{name}.json"
    if "scene" in found.list_names() and not path.is_file():
        data = found.read_array("scene", "u1", (None,)).tobytes()
        _check_scene(parse_json(data.decode(errors="replace"), found.file), name, found.file)
        write_atomically(path, data)


def _make_arrays(episode: Episode, robot: Robot, rate: float) -> dict[str, NDArray[np.generic]]:
    """Return all that is sampled from a motion, by its place in a demo."""
    samples = sample_episode(episode, robot, rate)
    done = np.zeros(len(samples["time"]), np.uint8)
    done[-1] = 1
    arrays: dict[str, NDArray[np.generic]] = {}
    for name in _OBSERVED:
        arrays[f"obs/{name}"] = samples[name].astype(np.float32)
    for name in ("actions", "states"):
        arrays[name] = samples[name].astype(np.float32)
    arrays["dones"] = done
    arrays["rewards"] = done.astype(np.float32)
    return arrays


def _write_demo(group: h5py.Group, episode: Episode, robot: Robot, rate: float) -> None:
    """Write an episode: samples, images and motion as arrays, all else as attributes."""
    arrays = _make_arrays(episode, robot, rate)
    for name, values in arrays.items():
        _write_array(group, name, values, values.dtype)
    images = episode.images()
    if images is not None:
        for name, pixels in images.pictures.items():
            group.create_dataset(
                f"obs/{name}",
                data=pixels,
                chunks=(1, *pixels.shape[1:]),  # loaders read single moments
                compression="gzip",
                compression_opts=4,
                shuffle=True,
            )
    motion = episode.trajectory.to_dict()
    _write_motion(group, motion)
    group.attrs["num_samples"] = len(arrays["dones"])
    group.attrs["number"] = episode.number
    group.attrs["scene"] = compute_scene_name(episode.document)
    group.attrs["task"] = str(episode.about["task"])
    description: dict[str, Any] = {
        "about": dict(episode.about),
        "start": dict(episode.start),
        "where": episode.where,
        "steps": [step_to_dict(step) for step in episode.steps],
        "motion": motion,
        "validation": replace_infinite(episode.claimed.to_dict()),
    }
    if episode.terms:
        description["terms"] = [term_to_dict(term) for term in episode.terms]
    if images is not None:
        description["images"] = list(images.pictures)
        description["segments"] = images.segments
    group.attrs["episode"] = json.dumps(description, sort_keys=True)


def _write_motion(group: h5py.Group, motion: dict[str, Any]) -> None:
    """Write the arrays of a motion to the group `motion`, and remove them from the motion.

    Waypoints that all are knots of the curve are written as indices, which take fewer bytes.
    """
    curve = {name: np.array(values) for name, values in motion.pop("curve", {}).items()}
    waypoints = {name: np.array(motion.pop(name)) for name in ("times", "positions")}
    at = _find_among_knots(curve, waypoints)
    if at is None:
        for name, values in waypoints.items():
            _write_array(group, f"motion/{name}", values, np.float64)
    else:
        _write_array(group, "motion/waypoints", at, np.int32)
    for name, values in curve.items():
        _write_array(group, f"motion/knot_{name}", values, np.float64)


def _find_among_knots(curve: Mapping[str, Floats], waypoints: Mapping[str, Floats]) -> Ints | None:
    """Return the indices of waypoints among the knots of a curve, shape (T,), if all match."""
    if not curve:
        return None
    last = len(curve["times"]) - 1
    at = np.minimum(np.searchsorted(curve["times"], waypoints["times"]), last)
    for name in ("times", "positions"):
        if not np.array_equal(curve[name][at], waypoints[name]):
            return None
    return at


def _write_array(group: h5py.Group, name: str, values: Any, kind: Any) -> None:
    values = np.asarray(values, kind)
    if values.nbytes <= _MIN_COMPRESSED:
        group.create_dataset(name, data=values)
        return
    group.create_dataset(
        name,
        data=values,
        chunks=values.shape,
        compression="gzip",
        compression_opts=6,
        shuffle=True,
    )


class EpisodeSchema(Schema):
    """The attribute `episode` with the arrays of its motion.

    Scenes, steps and terms check their own parts.
    """

    about: dict[str, Any]
    start: dict[str, Any]
    where: str | None
    steps: list[dict[str, Any]]
    motion: TrajectorySchema
    validation: Report
    terms: list[dict[str, Any]] = Field(default_factory=list)
    images: list[Name] | None = None
    segments: list[str] = Field(default_factory=list)


class Shard:
    """An open shard, from this program or another; nothing in it is trusted.

    Args:
        root: Root of its file.
        scenes: Folder of the dataset's scenes.
    """

    def __init__(self, root: Group, scenes: Path) -> None:
        self.file = root.file
        self._root = root
        self._scenes = scenes
        self._data = root.open_group("data")
        self._documents: dict[str, Any] = {}

    def __len__(self) -> int:
        return len(self._data.list_names())

    def read_number(self, k: int) -> int:
        """Return the number of episode `k`."""
        return self._data.open_group(f"demo_{k}").read_integer("number")

    def check_members(self) -> None:
        """Check that all episodes have the arrays that they must have, and no others."""
        for k in range(len(self)):
            _check_members(self._data.open_group(f"demo_{k}"))
            self.read_number(k)

    def read(self, k: int) -> Episode:
        """Return episode `k`.

        Raises:
            InputError: Something in it is missing or invalid.
        """
        demo = self._data.open_group(f"demo_{k}")
        _check_members(demo)
        name = _read_scene_name(demo)
        if name not in self._documents:
            self._documents[name] = read_scene(self._scenes, name)
        options = parse_json(self._data.read_text("options"), self.file)
        stored = _read_description(demo)
        number = demo.read_integer("number")
        load_images = None
        if stored.images is not None:
            load_images = functools.partial(_read_images, self.file, k)
        with Document(None, self.file).annotate_errors((f"demo_{k}",)), _expect_episode():
            return Episode(
                number=number,
                about=stored.about,
                document=self._documents[name],
                start=stored.start,
                where=stored.where,
                steps=tuple(step_from_dict(step) for step in stored.steps),
                options=Options.from_dict(options),
                trajectory=stored.motion.make_trajectory(),
                claimed=stored.validation,
                terms=tuple(term_from_dict(term) for term in stored.terms),
                robots=self._scenes.parent / "robots",
                load_images=load_images,
            )

    def find_differences(self, k: int, episode: Episode, robot: Robot, rate: float) -> list[str]:
        """Return what a learner reads of an episode that does not follow from its motion.

        Args:
            k: Place of the episode.
            episode: The episode, as read.
            robot: Its robot.
            rate: Sampling rate of the recipe [Hz].

        Raises:
            InputError: An array is missing, or has another type or shape.
        """
        demo = self._data.open_group(f"demo_{k}")
        arrays = _make_arrays(episode, robot, rate)
        count = len(arrays["dones"])
        found = list[str]()
        for name, values in arrays.items():
            stored = demo.read_array(name, values.dtype.str[1:], values.shape)
            wrong = ~np.isclose(stored, values, rtol=_TOLERANCE, atol=_TOLERANCE)
            if wrong.any():
                place = np.argwhere(wrong)[0].tolist()
                claim = stored[tuple(place)]
                truth = values[tuple(place)]
                found.append(f"{name}{place} is {claim:.6g}, not {truth:.6g} as its motion")
        _check_images(demo, _read_description(demo).images or [], count)
        claims = {"num_samples": demo.read_integer("num_samples"), "task": demo.read_text("task")}
        expected = {"num_samples": count, "task": episode.about.get("task")}
        return found + _compare(claims, expected)

    def find_shard_differences(self, robot: str, recipe: Recipe) -> list[str]:
        """Return what a learner reads of the shard as a whole that does not follow from its demos.

        Args:
            robot: Name of the robot.
            recipe: Recipe of the dataset.
        """
        self._root.check_names(("data", "mask"))
        demos = [self._data.open_group(f"demo_{k}") for k in range(len(self))]
        numbers = [demo.read_integer("number") for demo in demos]
        masks = _make_masks(numbers)
        mask = self._root.open_group("mask")
        mask.check_names(tuple(masks))
        claims: dict[str, Any] = {
            "total": self._data.read_integer("total"),
            "env_args": parse_json(self._data.read_text("env_args"), self.file),
            "options": parse_json(self._data.read_text("options"), self.file),
        }
        truth: dict[str, Any] = {
            "total": sum(demo.read_integer("num_samples") for demo in demos),
            "env_args": _make_settings(robot, recipe.fields.rate, recipe.digest),
            "options": asdict(recipe.options),
        }
        for name, names in masks.items():
            stored = mask.read_array(name, "S", (None,)).tolist()
            claims[f"mask/{name}"] = [text.decode(errors="replace") for text in stored]
            truth[f"mask/{name}"] = names
        found = _compare(claims, truth)
        if numbers != sorted(numbers):
            found.append("its episodes are not in order of number")
        return found


def _compare(claims: Mapping[str, Any], truth: Mapping[str, Any]) -> list[str]:
    found = list[str]()
    for name, value in truth.items():
        if claims[name] != value:
            found.append(f"{name} is {format_value(claims[name])}, not {format_value(value)}")
    return found


@contextlib.contextmanager
def _expect_episode() -> Iterator[None]:
    """Convert other exceptions of damaged steps, terms and options to an `InputError`."""
    try:
        yield
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


@contextlib.contextmanager
def open_shard(path: Path, scenes: Path) -> Iterator[Shard]:
    """Open a shard.

    Args:
        path: Shard, or part of one.
        scenes: Folder of the dataset's scenes.

    Raises:
        InputError: The file is damaged or no shard.
    """
    with open_hdf5(path) as root:
        yield Shard(root, scenes)


def read_numbers(path: Path) -> list[int]:
    """Return the numbers of a shard's episodes, in order, whose members are checked.

    Raises:
        InputError: The file is damaged or no shard.
    """
    with open_shard(path, Path()) as shard:
        shard.check_members()
        return [shard.read_number(k) for k in range(len(shard))]


def read_episodes(path: Path, scenes: Path) -> Iterator[Episode]:
    """Yield the episodes of a shard, in order; see `open_shard`."""
    with open_shard(path, scenes) as shard:
        for k in range(len(shard)):
            yield shard.read(k)


def _check_members(demo: Group) -> None:
    """Check the names, types and sizes of an episode's arrays; nothing is read."""
    demo.check_names((*_SAMPLED, "obs", "motion"))
    for name, (dtype, axes) in _SAMPLED.items():
        demo.check_array(name, dtype, (None,) * axes)
    observed = demo.open_group("obs")
    images = [name for name in observed.list_names() if name.endswith(tuple(_IMAGES))]
    observed.check_names((*_OBSERVED, *images))
    for name in _OBSERVED:
        observed.check_array(name, "f4", (None, None))
    _check_images(demo, images, None)
    motion = demo.open_group("motion")
    motion.check_names(tuple(_MOTION))
    for name in motion.list_names():
        dtype, axes = _MOTION[name]
        motion.check_array(name, dtype, (None,) * axes)


def _check_images(demo: Group, names: Sequence[str], count: int | None) -> None:
    """Check types and shapes of images; `count` is the number of samples, if known."""
    for name in names:
        endings = [ending for ending in _IMAGES if name.endswith(ending)]
        if not endings:
            raise demo.make_error("no images", name, expected=" or ".join(_IMAGES), got=name)
        dtype, axes = _IMAGES[endings[0]]
        shape = (count, None, None, 3)[:axes]
        demo.check_array(f"obs/{name}", dtype, shape, _MAX_IMAGES)


def _read_scene_name(demo: Group) -> str:
    place = demo.name.rpartition("/")[2]
    return check_name(demo.read_attribute("scene"), f"{place}: scene", file=demo.file)


def _read_description(demo: Group) -> EpisodeSchema:
    data = parse_json(demo.read_text("episode"), demo.file)
    if isinstance(data, dict) and isinstance(data.get("motion"), dict):
        data["motion"] |= _read_motion(demo)
    try:
        return parse_document(Document(data), EpisodeSchema)
    except InputError as error:
        where = f"{demo.name.rpartition('/')[2]}: {error.field or 'episode'}"
        raise InputError(
            error.problem, file=demo.file, field=where, expected=error.expected, got=error.got
        ) from error


def _read_motion(demo: Group) -> dict[str, Any]:
    """Return the arrays of a motion, as `TrajectorySchema` has them."""
    group = demo.open_group("motion")
    arrays = {
        name: group.read_array(name, dtype, (None,) * axes)
        for name, (dtype, axes) in _MOTION.items()
        if name in group.list_names()
    }
    at = arrays.pop("waypoints", None)
    if at is not None:
        for name in ("times", "positions"):
            knots = arrays.get(f"knot_{name}")
            if knots is None:
                raise group.make_error("missing", f"knot_{name}", expected="an array")
            if at.min(initial=0) < 0 or at.max(initial=0) >= len(knots):
                expected = f"indices from 0 to {len(knots) - 1}"
                raise group.make_error("out of range", "waypoints", expected=expected)
            arrays[name] = knots[at]
    return nest_knots(arrays)


def _read_images(path: Path, k: int) -> Images:
    """Read the camera images of an episode."""
    with open_hdf5(path) as root:
        demo = root.open_group("data").open_group(f"demo_{k}")
        stored = _read_description(demo)
        names = stored.images or []
        _check_images(demo, names, demo.read_integer("num_samples"))
        arrays = {name: demo.open_group("obs").handle[name][:] for name in names}
        return Images(arrays, tuple(stored.segments))


def read_scene(scenes: Path, name: str) -> Any:
    """Return the description of a scene from its file.

    Raises:
        InputError: The file is missing, damaged, or not what its name says.
    """
    file = scenes / f"{name}.json"
    return _check_scene(parse_json(read_text(file, "scene"), file), name, file)


def _check_scene(document: Any, name: str, file: Path) -> Any:
    """Return the description of a scene if its digest is `name`."""
    if not isinstance(document, dict) or compute_scene_name(document) != name:
        problem = "this scene is not what its name says"
        raise InputError(problem, file=file, expected=name, got=compute_scene_name(document))
    return document


def make_parts(task: tuple[Mapping[str, Any], Sequence[int], Mapping[str, str]]) -> list[Made]:
    """Run attempts, and pack their episodes by `make_part`, whose time is added.

    Args:
        task: Document of a recipe, numbers of attempts, and files of the robots; see `run_attempt`.
    """
    document, numbers, robots = task
    recipe = load_recipe(document)
    found = list[Made]()
    folder = next((Path(file).parent.parent for file in robots.values()), None)
    for number in numbers:
        record, made = run_attempt(document, number, robots)
        data = b""
        if made is not None:
            start_time = time.perf_counter()
            start_cpu_time = time.process_time()
            episode = replace(made, robots=folder)
            robot = _load_robot(recipe.digest, episode)
            data = make_part(episode, robot, recipe.fields.rate, recipe.digest)
            seconds = time.perf_counter() - start_time
            cpu_time = time.process_time() - start_cpu_time
            record["seconds"] = round(record["seconds"] + seconds, 4)
            record["cpu_time"] = round(record["cpu_time"] + cpu_time, 4)
        found.append((record, data))
    return found


def _load_robot(recipe: str, episode: Episode) -> Robot:
    key = (recipe, str(episode.about["robot"]), episode.start.get("z"))
    if key not in _ROBOTS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they were shown during generation
            _ROBOTS[key] = episode.scene().robot
    return _ROBOTS[key]
