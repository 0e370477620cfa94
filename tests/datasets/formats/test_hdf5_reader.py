"""Tests that errors of invalid files name file and member, before large data is read."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.formats.hdf5 import read_episodes, read_numbers
from vkc_pin.errors import InputError

h5py = pytest.importorskip("h5py")


@pytest.fixture
def shard(dataset: Dataset, tmp_path: Path) -> Path:
    """Return a shard of a copy of a dataset."""
    shutil.copytree(dataset.folder, tmp_path / "copy")
    return Dataset.open(tmp_path / "copy").shards[0]


def replace_member(member: str, make: Callable[[Any, str], object]) -> Callable[[Any], None]:
    """Return a function that replaces a member of the third episode."""

    def change(file: Any) -> None:
        *_, name = member.split("/")
        group = file[f"data/demo_2/{member}"].parent
        del group[name]
        make(group, name)

    return change


def create_external_array(group: Any, name: str) -> None:
    Path("raw").write_bytes(bytes(8000))
    group.create_dataset(name, (1000,), "f8", external=[("raw", 0, 8000)])


def create_virtual_array(group: Any, name: str) -> None:
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource("other.hdf5", "x", (10,))
    group.create_virtual_dataset(name, layout)


def create_array(*shape: int, dtype: str = "f8", **options: Any) -> Callable[[Any, str], object]:
    """Return a function that creates an array without data in the file."""
    return lambda group, name: group.create_dataset(name, shape, dtype, **options)


def set_attribute(name: str, value: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        for group in (file["data"], file["data/demo_2"]):
            if name in group.attrs:
                del group.attrs[name]
                if value is not None:
                    group.attrs[name] = value

    return change


def set_description(name: str, value: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        attributes = file["data/demo_2"].attrs
        attributes["episode"] = json.dumps({**json.loads(attributes["episode"]), name: value})

    return change


CHUNKS = {"chunks": (100_000,), "compression": "gzip"}
MOTION = "motion/knot_times"
DAMAGES: list[tuple[Callable[[Any], Any], str]] = [
    (lambda file: file.pop("data"), "data: missing"),
    (lambda file: (file.pop("data"), file.create_dataset("data", data=1)), "data: wrong kind"),
    (lambda file: file.pop("data/demo_0"), "demo_0: missing"),
    (lambda file: file.move("data/demo_1", "data/demo_7"), "demo_1: missing"),
    (set_attribute("number", None), "number: missing"),
    (set_attribute("number", "two"), "number: wrong value"),
    (set_attribute("number", -1), "number: wrong value"),
    (set_attribute("number", [1, 2]), "number: wrong shape"),
    (set_attribute("number", np.nan), "number: wrong value"),
    (set_attribute("scene", None), "scene: missing"),
    (set_attribute("scene", "nothing"), "cannot read the scene"),
    (set_attribute("options", None), "options: missing"),
    (set_attribute("options", "{"), "not JSON"),
    (set_attribute("options", "[]"), "not an episode"),
    (set_attribute("options", '{"dt": 0.0}'), "Options.dt: out of range"),
    (set_attribute("options", '{"speed": 1}'), "not an episode"),
    *((set_attribute("episode", text), "demo_2") for text in ("[]", "null", "5", "{}")),
    (set_attribute("episode", 5), "episode: not text"),
    (set_attribute("episode", "[" * 100_000), "not JSON"),
    (set_attribute("episode", "1" * 5000), "not JSON"),
    (set_description("about", []), "demo_2: about"),
    (set_description("steps", [{"step": "Fly"}]), "there is no step 'Fly'"),
    (set_description("steps", 3), "demo_2: steps"),
    (set_description("motion", {"names": ["x"]}), "demo_2: motion.robot_size: missing"),
    (set_description("validation", {}), "demo_2: validation"),
    (set_description("where", 5), "demo_2: where"),
    (set_description("images", ["../../x"]), "demo_2: images[0]: not a name"),
    (set_description("terms", [{"term": "Cost"}]), "not a saved term"),
    (set_description("plot", 1), "there is no field 'plot'"),
    (replace_member("motion", create_array(3)), "motion: wrong kind of member"),
    (replace_member("motion", lambda group, name: group.create_group(name)), "not an episode"),
    (replace_member(MOTION, create_array(10**9, **CHUNKS)), "knot_times: too large"),
    (
        replace_member(MOTION, create_array(10, maxshape=(None,), chunks=(10**8,))),
        "knot_times: too large",
    ),
    (replace_member(MOTION, create_array(3, dtype="f4")), "knot_times: wrong type"),
    (replace_member(MOTION, create_array(3, dtype="S8")), "knot_times: wrong type"),
    (replace_member(MOTION, create_array(3, 3)), "knot_times: wrong shape"),
    (
        replace_member(
            MOTION, lambda group, name: group.create_dataset(name, data=h5py.Empty("f8"))
        ),
        "shape",
    ),
    (replace_member(MOTION, create_array(3)), "demo_2"),
    (
        replace_member(
            "motion/waypoints",
            lambda group, name: group.create_dataset(name, data=-np.ones(3, "i4")),
        ),
        "waypoints: out of range",
    ),
    (
        replace_member(
            MOTION, lambda group, name: group.create_dataset("evil", (10**9,), "f8", **CHUNKS)
        ),
        "there is no member of data/demo_2/motion 'evil'",
    ),
    (
        replace_member("actions", create_array(10**6, 10**6, dtype="f4", chunks=True)),
        "actions: too large",
    ),
    (
        replace_member("actions", lambda group, name: group.create_group(name)),
        "actions: wrong kind",
    ),
    (replace_member(MOTION, create_external_array), "stored in other files"),
    (replace_member(MOTION, create_virtual_array), "stored in other files"),
    (
        replace_member(MOTION, lambda group, name: group.__setitem__(name, h5py.SoftLink("/data"))),
        "a link",
    ),
    (
        replace_member(MOTION, lambda group, name: group.__setitem__(name, h5py.SoftLink("/x"))),
        "knot_times",
    ),
    (
        replace_member(
            "obs", lambda group, name: group.__setitem__(name, h5py.ExternalLink("o", "/"))
        ),
        "a link",
    ),
]


@pytest.mark.parametrize("index", range(len(DAMAGES)))
def test_error_names_the_damage_of_a_shard(
    shard: Path, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shard.parent)
    change, expected = DAMAGES[index]
    with h5py.File(shard, "r+") as file:
        change(file)
    with pytest.raises(InputError) as caught:
        list(read_episodes(shard, shard.parents[2] / "scenes"))
    assert expected in str(caught.value)
    assert caught.value.file in (shard, shard.parents[2] / "scenes" / "nothing.json")


@pytest.mark.parametrize("size", [0, 1, 100, 5000, -1])
def test_error_names_an_incomplete_file(shard: Path, size: int) -> None:
    shard.write_bytes(shard.read_bytes()[:size])
    with pytest.raises(InputError, match="not an HDF5 file, or a damaged one") as caught:
        read_numbers(shard)
    assert caught.value.file == shard


def test_pipes_and_folders_are_rejected(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for file in (tmp_path / "pipe", tmp_path, tmp_path / "nothing"):
        with pytest.raises(InputError, match="there is no such file"):
            read_numbers(file)


@pytest.mark.parametrize("seed", range(3))
def test_random_bytes_give_episodes_or_errors(shard: Path, seed: int) -> None:
    rng, data = np.random.default_rng(seed), bytearray(shard.read_bytes())
    for at in rng.integers(len(data), size=30).tolist():
        data[at] = int(rng.integers(256))
    shard.write_bytes(data)
    try:
        assert len(list(read_episodes(shard, shard.parents[2] / "scenes"))) == 4
    except InputError as error:
        assert error.file is not None  # noqa: PT017 - both outcomes are valid
