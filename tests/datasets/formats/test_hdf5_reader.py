"""Tests that errors of invalid files name file and member, before large data is read."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.shards import Change, set_attribute, set_description

from vkc_pin.datasets.formats.hdf5 import read_episodes, read_numbers
from vkc_pin.errors import InputError

h5py = pytest.importorskip("h5py")


def replace_member(member: str, value: Any) -> Change:
    """Return a function that replaces a member of an episode; `value` may be a function, too."""

    def change(demo: Any) -> None:
        group, name = demo[member].parent, member.rpartition("/")[2]
        del group[name]
        if callable(value):
            value(group, name)
        else:
            group[name] = value

    return change


def set_options(text: str) -> Change:
    return lambda demo: set_attribute("options", text)(demo.parent)


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


CHUNKS = {"chunks": (100_000,), "compression": "gzip"}
MOTION = "motion/knot_times"
DAMAGES: list[tuple[Change, str]] = [
    (lambda demo: demo.file.pop("data"), "data: missing"),
    (lambda demo: demo.parent.pop("demo_0"), "demo_0: missing"),
    (lambda demo: demo.parent.move("demo_1", "demo_7"), "demo_1: missing"),
    (set_attribute("number", None), "number: missing"),
    (set_attribute("number", -1), "number: wrong value"),
    (set_attribute("number", [1, 2]), "number: wrong shape"),
    (set_attribute("scene", "nothing"), "cannot read the scene"),
    (set_options("{"), "not JSON"),
    (set_options('{"dt": 0.0}'), "Options.dt: out of range"),
    *((set_attribute("episode", text), "demo_2") for text in ("[]", "{}")),
    (set_attribute("episode", 5), "episode: not text"),
    (set_attribute("episode", "[" * 100_000), "not JSON"),
    (set_attribute("episode", "1" * 5000), "not JSON"),
    (set_description("about", value=[]), "demo_2: about"),
    (set_description("steps", value=[{"step": "Fly"}]), "there is no step 'Fly'"),
    (set_description("motion", value={"names": ["x"]}), "demo_2: motion.robot_size: missing"),
    (set_description("validation", value={}), "demo_2: validation"),
    (set_description("where", value=5), "demo_2: where"),
    (set_description("images", value=["../../x"]), "demo_2: images[0]: not a name"),
    (set_description("terms", value=[{"term": "Cost"}]), "not a saved term"),
    (set_description("plot", value=1), "there is no field 'plot'"),
    (replace_member("motion", np.zeros(3)), "motion: wrong kind of member"),
    (replace_member("motion", h5py.Group.create_group), "motion.times: missing"),
    (lambda demo: demo["motion"].pop("knot_rates"), "motion.curve.rates: missing"),
    (replace_member(MOTION, create_array(10**9, **CHUNKS)), "knot_times: too large"),
    (
        replace_member(MOTION, create_array(10, maxshape=(None,), chunks=(10**8,))),
        "knot_times: too large",
    ),
    (replace_member(MOTION, np.zeros(3, "f4")), "knot_times: wrong type"),
    (replace_member(MOTION, np.zeros((3, 3))), "knot_times: wrong shape"),
    (replace_member(MOTION, h5py.Empty("f8")), "shape"),
    (replace_member(MOTION, np.zeros(3)), "demo_2"),
    (replace_member("motion/waypoints", -np.ones(3, "i4")), "waypoints: out of range"),
    (
        lambda demo: create_array(10**9, **CHUNKS)(demo["motion"], "evil"),
        "there is no member of data/demo_2/motion 'evil'",
    ),
    (
        replace_member("actions", create_array(10**6, 10**6, dtype="f4", chunks=True)),
        "actions: too large",
    ),
    (replace_member(MOTION, create_external_array), "stored in other files"),
    (replace_member(MOTION, create_virtual_array), "stored in other files"),
    (replace_member(MOTION, h5py.SoftLink("/data")), "a link"),
    (replace_member("obs", h5py.ExternalLink("o", "/")), "a link"),
]


@pytest.mark.parametrize("index", range(len(DAMAGES)))
def test_error_names_the_damage_of_a_shard(
    shard: Path, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shard.parent)
    change, expected = DAMAGES[index]
    with h5py.File(shard, "r+") as file:
        change(file["data/demo_2"])
    with pytest.raises(InputError) as caught:
        list(read_episodes(shard, shard.parents[2] / "scenes"))
    assert expected in str(caught.value)
    assert caught.value.file in (shard, shard.parents[2] / "scenes" / "nothing.json")


@pytest.mark.parametrize("size", [0, 5000, -1])
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
