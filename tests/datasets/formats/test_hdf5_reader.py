"""Files of others give errors that name file and member, before anything large is read."""

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
def copy(made: Dataset, tmp_path: Path) -> Path:
    """Return a shard of a copy of a dataset."""
    shutil.copytree(made.folder, tmp_path / "copy")
    return Dataset.open(tmp_path / "copy").shards[0]


def put(place: str, make: Callable[[Any, str], object]) -> Callable[[Any], None]:
    """Return a change that replaces a member of the third episode."""

    def change(file: Any) -> None:
        *_, name = place.split("/")
        group = file[f"data/demo_2/{place}"].parent
        del group[name]
        make(group, name)

    return change


def put_external_array(group: Any, name: str) -> None:
    Path("raw").write_bytes(bytes(8000))
    group.create_dataset(name, (1000,), "f8", external=[("raw", 0, 8000)])


def put_virtual_array(group: Any, name: str) -> None:
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource("other.hdf5", "x", (10,))
    group.create_virtual_dataset(name, layout)


def put_array(*shape: int, dtype: str = "f8", **options: Any) -> Callable[[Any, str], object]:
    """Return a function that makes an array of zeros that takes no place in the file."""
    return lambda group, name: group.create_dataset(name, shape, dtype, **options)


def put_attribute(name: str, value: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        for group in (file["data"], file["data/demo_2"]):
            if name in group.attrs:
                del group.attrs[name]
                if value is not None:
                    group.attrs[name] = value

    return change


def put_description(name: str, value: Any) -> Callable[[Any], None]:
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
    (put_attribute("number", None), "number: missing"),
    (put_attribute("number", "two"), "number: wrong value"),
    (put_attribute("number", -1), "number: wrong value"),
    (put_attribute("number", [1, 2]), "number: wrong shape"),
    (put_attribute("number", np.nan), "number: wrong value"),
    (put_attribute("scene", None), "scene: missing"),
    (put_attribute("scene", "nothing"), "cannot read the scene"),
    (put_attribute("options", None), "options: missing"),
    (put_attribute("options", "{"), "not JSON"),
    (put_attribute("options", "[]"), "not an episode"),
    (put_attribute("options", '{"dt": 0.0}'), "Options.dt: out of range"),
    (put_attribute("options", '{"speed": 1}'), "not an episode"),
    *((put_attribute("episode", text), "demo_2") for text in ("[]", "null", "5", "{}")),
    (put_attribute("episode", 5), "episode: not text"),
    (put_attribute("episode", "[" * 100_000), "not JSON"),
    (put_attribute("episode", "1" * 5000), "not JSON"),
    (put_description("about", []), "demo_2: about"),
    (put_description("steps", [{"step": "Fly"}]), "there is no step 'Fly'"),
    (put_description("steps", 3), "demo_2: steps"),
    (put_description("motion", {"names": ["x"]}), "demo_2: motion.robot_size: missing"),
    (put_description("validation", {}), "demo_2: validation"),
    (put_description("where", 5), "demo_2: where"),
    (put_description("images", ["../../x"]), "demo_2: images[0]: not a name"),
    (put_description("terms", [{"term": "Cost"}]), "not a saved term"),
    (put_description("plot", 1), "there is no field 'plot'"),
    (put("motion", put_array(3)), "motion: wrong kind of member"),
    (put("motion", lambda group, name: group.create_group(name)), "not an episode"),
    (put(MOTION, put_array(10**9, **CHUNKS)), "knot_times: too large"),
    (put(MOTION, put_array(10, maxshape=(None,), chunks=(10**8,))), "knot_times: too large"),
    (put(MOTION, put_array(3, dtype="f4")), "knot_times: wrong type"),
    (put(MOTION, put_array(3, dtype="S8")), "knot_times: wrong type"),
    (put(MOTION, put_array(3, 3)), "knot_times: wrong shape"),
    (put(MOTION, lambda group, name: group.create_dataset(name, data=h5py.Empty("f8"))), "shape"),
    (put(MOTION, put_array(3)), "demo_2"),
    (
        put(
            "motion/waypoints",
            lambda group, name: group.create_dataset(name, data=-np.ones(3, "i4")),
        ),
        "waypoints: out of range",
    ),
    (
        put(MOTION, lambda group, name: group.create_dataset("evil", (10**9,), "f8", **CHUNKS)),
        "there is no member of data/demo_2/motion 'evil'",
    ),
    (put("actions", put_array(10**6, 10**6, dtype="f4", chunks=True)), "actions: too large"),
    (put("actions", lambda group, name: group.create_group(name)), "actions: wrong kind"),
    (put(MOTION, put_external_array), "stored in other files"),
    (put(MOTION, put_virtual_array), "stored in other files"),
    (put(MOTION, lambda group, name: group.__setitem__(name, h5py.SoftLink("/data"))), "a link"),
    (put(MOTION, lambda group, name: group.__setitem__(name, h5py.SoftLink("/x"))), "knot_times"),
    (
        put("obs", lambda group, name: group.__setitem__(name, h5py.ExternalLink("o", "/"))),
        "a link",
    ),
]


@pytest.mark.parametrize("place", range(len(DAMAGES)))
def test_damages_of_a_shard_are_named(
    copy: Path, place: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(copy.parent)
    change, expected = DAMAGES[place]
    with h5py.File(copy, "r+") as file:
        change(file)
    with pytest.raises(InputError) as caught:
        list(read_episodes(copy, copy.parents[2] / "scenes"))
    assert expected in str(caught.value)
    assert caught.value.file in (copy, copy.parents[2] / "scenes" / "nothing.json")


@pytest.mark.parametrize("size", [0, 1, 100, 5000, -1])
def test_incomplete_files_are_named(copy: Path, size: int) -> None:
    copy.write_bytes(copy.read_bytes()[:size])
    with pytest.raises(InputError, match="not an HDF5 file, or a damaged one") as caught:
        read_numbers(copy)
    assert caught.value.file == copy


def test_pipes_and_folders_are_no_shards(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for file in (tmp_path / "pipe", tmp_path, tmp_path / "nothing"):
        with pytest.raises(InputError, match="there is no such file"):
            read_numbers(file)


@pytest.mark.parametrize("seed", range(3))
def test_random_bytes_give_episodes_or_errors(copy: Path, seed: int) -> None:
    rng, data = np.random.default_rng(seed), bytearray(copy.read_bytes())
    for at in rng.integers(len(data), size=30).tolist():
        data[at] = int(rng.integers(256))
    copy.write_bytes(data)
    try:
        assert len(list(read_episodes(copy, copy.parents[2] / "scenes"))) == 4
    except InputError as error:
        assert error.file is not None  # noqa: PT017 - either outcome is right
