"""Reads and writes shards: HDF5 files of many episodes in robomimic's layout.

Groups are `data/demo_<k>` with `actions`, `states`, `obs`, `rewards` and `dones`, attributes
`total`, `env_args` and `num_samples`, and `mask`. Samples are in single precision; the trajectory
itself is in double precision under `motion`.
"""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.datasets.episode import Episode, compute_scene_name, make_episode
from vkc_pin.datasets.formats.samples import sample_episode
from vkc_pin.errors import InputError
from vkc_pin.simulation.cameras.images import Images
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.world.files.documents import parse_json, read_text
from vkc_pin.world.files.writing import check_name, write_atomically
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.task.steps import step_to_dict
from vkc_pin.world.task.terms import term_to_dict

if TYPE_CHECKING:
    import h5py

__all__ = ["make_part", "read_episodes", "read_numbers", "require_h5py", "write_shard"]

_OBSERVED = (
    *("base_pose", "base_velocity", "arm_position", "arm_velocity"),
    *("hand_pose", "gripper", "holding", "object_position"),
)
_ENVIRONMENT = "vkc_pin"
_HELD_OUT = 10  # every so many an episode is in mask/valid, the others are in mask/train


def require_h5py() -> Any:
    """Return h5py.

    Raises:
        InputError: It is not installed.
    """
    return import_optional("h5py", "data", purpose="a dataset")


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
    masks: dict[str, list[str]] = {"train": [], "valid": []}
    total = 0
    with h5py.File(buffer, "w", libver="latest") as file:
        data = file.create_group("data")
        for k, (source, place) in enumerate(parts):
            name = f"demo_{k}"
            with _opened(source) as found:
                found.copy(f"data/demo_{place}", data, name=name)
                if k == 0:
                    for said in ("options", "env_args"):  # of the recipe, and so of all
                        data.attrs[said] = found["data"].attrs[said]
                scene = check_name(data[name].attrs["scene"], f"demo_{place}: scene", file=source)
                _keep_scene(found, scenes / f"{scene}.json")
            total += int(data[name].attrs["num_samples"])
            masks[
                "valid" if data[name].attrs["number"] % _HELD_OUT == _HELD_OUT - 1 else "train"
            ].append(name)
        data.attrs["total"] = total
        for mask, names in masks.items():
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
        _write(data.create_group("demo_0"), episode, robot, rate)
        data.attrs["options"] = json.dumps(asdict(episode.options), sort_keys=True)
        settings = {
            "robot": robot.name,
            "rate": rate,
            "recipe": recipe,
            "scenes": "../../scenes/<scene>.json",
        }
        data.attrs["env_args"] = json.dumps(
            {"env_name": _ENVIRONMENT, "env_type": -1, "env_kwargs": settings}
        )
        scene = json.dumps(episode.document, sort_keys=True, separators=(",", ":")) + "\n"
        file.create_dataset("scene", data=np.frombuffer(scene.encode(), np.uint8))
    return buffer.getvalue()


def _keep_scene(found: h5py.File, path: Path) -> None:
    """Write the scene of an episode unless it exists."""
    if "scene" in found and not path.is_file():
        write_atomically(path, found["scene"][:].tobytes())


def _write(group: h5py.Group, episode: Episode, robot: Robot, rate: float) -> None:
    found, motion = sample_episode(episode, robot, rate), episode.trajectory.to_dict()
    count = len(found["time"])
    for name in _OBSERVED:
        _array(group, f"obs/{name}", found[name], np.float32)
    _array(group, "actions", found["actions"], np.float32)
    _array(group, "states", found["states"], np.float32)
    images = episode.images()
    for name, pixels in (
        {} if images is None else images.pictures.items()
    ):  # a chunk each: loaders read single moments
        squeezed = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
        group.create_dataset(f"obs/{name}", data=pixels, chunks=(1, *pixels.shape[1:]), **squeezed)
    done = np.zeros(count, np.uint8)
    done[-1] = 1
    group.create_dataset("dones", data=done)
    group.create_dataset("rewards", data=done.astype(np.float32))
    curve = {name: np.array(values) for name, values in motion.pop("curve", {}).items()}
    waypoints = {name: np.array(motion.pop(name)) for name in ("times", "positions")}
    at = _among(curve, waypoints)
    if at is None:
        for name, values in waypoints.items():
            _array(group, f"motion/{name}", values, np.float64)
    else:
        _array(group, "motion/waypoints", at, np.int32)
    for name, values in curve.items():
        _array(group, f"motion/knot_{name}", values, np.float64)
    report = episode.claimed.to_dict()
    for name in ("clearance", "clearances"):
        report[name] = _finite(report[name])
    group.attrs["num_samples"] = count
    group.attrs["number"] = episode.number
    group.attrs["scene"] = compute_scene_name(episode.document)
    group.attrs["task"] = str(episode.about["task"])
    said: dict[str, Any] = {
        "about": dict(episode.about),
        "start": dict(episode.start),
        "where": episode.where,
        "steps": [step_to_dict(step) for step in episode.steps],
        "motion": motion,
        "validation": report,
    }
    if episode.terms:
        said["terms"] = [term_to_dict(term) for term in episode.terms]
    if images is not None:
        said["images"], said["segments"] = list(images.pictures), images.segments
    group.attrs["episode"] = json.dumps(said, sort_keys=True)


def _among(curve: Mapping[str, Floats], waypoints: Mapping[str, Floats]) -> Ints | None:
    """Return the indices of waypoints among the knots of a curve, shape (T,), if all match."""
    if not curve:
        return None
    at = np.minimum(np.searchsorted(curve["times"], waypoints["times"]), len(curve["times"]) - 1)
    same = all(np.array_equal(curve[name][at], waypoints[name]) for name in ("times", "positions"))
    return at if same else None


def _array(group: h5py.Group, name: str, values: Any, kind: Any) -> None:
    values = np.asarray(values, kind)
    squeezed = (
        {"compression": "gzip", "compression_opts": 6, "shuffle": True}
        if values.nbytes > 512
        else {}
    )
    group.create_dataset(name, data=values, chunks=values.shape if squeezed else None, **squeezed)


def _finite(values: Any) -> Any:
    if isinstance(values, Sequence):
        return [_finite(value) for value in values]
    return float(values) if np.isfinite(values) else None


def read_numbers(path: Path) -> list[int]:
    """Return the numbers of a shard's episodes, in order.

    Raises:
        InputError: The file is no shard.
    """
    with _opened(path) as file:
        return [int(file["data"][f"demo_{k}"].attrs["number"]) for k in range(len(file["data"]))]


def read_episodes(path: Path, scenes: Path) -> Iterator[Episode]:
    """Yield the episodes of a shard, in order.

    Args:
        path: Shard.
        scenes: Folder of the dataset's scenes.

    Raises:
        InputError: The file is damaged or no shard.
    """
    documents: dict[str, Any] = {}
    with _opened(path) as file:
        for k in range(len(file["data"])):
            try:
                options = parse_json(str(file["data"].attrs["options"]), path)
                group = file["data"][f"demo_{k}"]
                name = check_name(group.attrs["scene"], f"demo_{k}: scene", file=path)
                if name not in documents:
                    documents[name] = _document(scenes, name)
                said = parse_json(str(group.attrs["episode"]), path)
                arrays = {key: np.array(values) for key, values in group["motion"].items()}
                if (at := arrays.pop("waypoints", None)) is not None:
                    arrays |= {key: arrays[f"knot_{key}"][at] for key in ("times", "positions")}
                number = int(group.attrs["number"])
            except (LookupError, TypeError, OSError, ValueError) as error:
                if isinstance(error, InputError):
                    raise
                raise InputError(
                    "not a shard of episodes", file=path, field=f"demo_{k}", got=str(error)
                ) from error
            episode = make_episode(
                {**said, "options": options, "number": number, "scene": documents[name]},
                arrays,
                scenes.parent / "robots",
            )
            yield (
                replace(episode, load_images=functools.partial(_images, path, k))
                if "images" in said
                else episode
            )


def _images(path: Path, k: int) -> Images:
    """Read the camera images of an episode."""
    with _opened(path) as file:
        try:
            group = file["data"][f"demo_{k}"]
            said = parse_json(str(group.attrs["episode"]), path)
            return Images(
                {name: group["obs"][name][:] for name in said["images"]}, tuple(said["segments"])
            )
        except (LookupError, TypeError, OSError) as error:
            raise InputError(
                "images are missing or damaged", file=path, field=f"demo_{k}", got=str(error)
            ) from error


def _document(scenes: Path, name: str) -> Any:
    file = scenes / f"{name}.json"
    document = parse_json(read_text(file, "scene"), file)
    if compute_scene_name(document) != name:
        raise InputError(
            "this scene is not what its name says",
            file=file,
            expected=name,
            got=compute_scene_name(document),
        )
    return document


def _opened(path: Path) -> Any:
    h5py = require_h5py()
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise InputError(
            "not an HDF5 file", file=path, expected="a shard of a dataset", got=str(error)
        ) from error
