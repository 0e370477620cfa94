"""Tests datasets with changed members, attributes, journals and bytes."""

from __future__ import annotations

import contextlib
import functools
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fuzz.bounds import PLANNING_SECONDS, expect_result_or_error, take_share
from fuzz.changes import change_bytes, change_data
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.formats.hdf5 import open_shard
from vkc_pin.datasets.generation import generate

RECIPE: dict[str, Any] = {
    "name": "small",
    "tasks": ["given-open"],
    "objects": ["random_oven"],
    "rooms": {"count": 1, "objects": 1, "clutter": [0.0, 0.0]},
}
EPISODES = 2
NUMBERS = (0, 1, -1, 0.5, 1e9, 1e300, float("nan"), 2**62)
SHARD = "shards/husky_ur5e/shard-00000.hdf5"


@functools.cache
def make_base() -> Dataset:
    """Generate a small dataset."""
    return generate(RECIPE, EPISODES, Path(tempfile.mkdtemp()) / "base")


@functools.cache
def list_members() -> dict[str, list[str]]:
    """Return member of the shard → its attributes."""
    names: list[str] = []
    with h5py.File(make_base().shards[0]) as file:
        file.visit(names.append)
        return {name: list(file[name].attrs) for name in names}


def fill(file: Any, name: str, value: float) -> None:
    """Set all numbers of an array."""
    array = file[name]
    if isinstance(array, h5py.Dataset) and array.dtype.kind not in "SO":
        with np.errstate(all="ignore"):
            array[...] = np.full(array.shape, value, float).astype(array.dtype)


def replace_member(file: Any, name: str, value: float, kind: str) -> None:
    """Replace a member by one of another kind, or remove it."""
    del file[name]
    if kind == "array":
        file[name] = np.full((3,), value)
    elif kind == "text":
        file[name] = "text"
    elif kind == "group":
        file.create_group(name)
    elif kind == "link":
        file[name] = h5py.SoftLink("/data")
    elif kind == "external":
        file[name] = h5py.ExternalLink(f"base/{SHARD}", "/data")
    elif kind == "huge":
        file.create_dataset(name, (10**10,), "f8", chunks=(1000,), compression="gzip")
    elif kind == "growing":
        file.create_dataset(name, (10,), "f8", maxshape=(None,), chunks=(2**26,))


KINDS = ("nothing", "array", "text", "group", "link", "external", "huge", "growing")


@st.composite
def changed_shards(draw: st.DrawFn) -> bytes:
    """Return a shard with changed members, a changed attribute, or changed metadata."""
    file = make_base().folder.parent / "drawn.hdf5"
    shutil.copy(make_base().shards[0], file)
    value = draw(st.sampled_from(NUMBERS))
    name = draw(st.sampled_from(list(list_members())))
    with h5py.File(file, "r+") as archive:
        match draw(st.sampled_from(("metadata", "attribute", "fill", "replace", "move"))):
            case "metadata":
                attributes = archive["data/demo_0"].attrs
                metadata = draw(change_data(json.loads(attributes["episode"])))
                attributes["episode"] = json.dumps(metadata)
            case "attribute":
                having = [each for each, attributes in list_members().items() if attributes]
                name = draw(st.sampled_from(having))
                attribute = draw(st.sampled_from(list_members()[name]))
                del archive[name].attrs[attribute]
                other = draw(st.sampled_from((value, value, "", "[]", None)))
                if other is not None:
                    archive[name].attrs[attribute] = other
            case "fill":
                fill(archive, name, value)
            case "replace":
                with contextlib.suppress(RuntimeError):  # behind a link to itself
                    replace_member(archive, name, value, draw(st.sampled_from(KINDS)))
            case _:
                archive.move(name, f"{name}_x")
    return file.read_bytes()


@st.composite
def changed_journals(draw: st.DrawFn) -> bytes:
    """Return a journal with a changed line."""
    lines = (make_base().folder / "journal.jsonl").read_bytes().splitlines()
    number = draw(st.integers(0, len(lines) - 1))
    line = lines[number]
    changed_data = change_data(json.loads(line)).map(lambda data: json.dumps(data).encode())
    lines[number] = draw(changed_data | change_bytes(line))
    return b"\n".join(lines) + b"\n"


def check_shard(content: bytes) -> None:
    """Read and check the episodes of a shard."""
    base = make_base()
    file = base.folder.parent / "changed.hdf5"
    file.write_bytes(content)
    with open_shard(file, base.folder / "scenes") as shard:
        for k in range(len(shard)):
            episode = shard.read(k)
            episode.validate()
            shard.find_differences(k, episode, episode.scene().robot, 10.0)
        shard.find_shard_differences("husky_ur5e", base.recipe)


def resume(journal: bytes) -> None:
    """Resume generation with a journal."""
    base = make_base()
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root, "copy")
        shutil.copytree(base.folder, folder)
        (folder / "journal.jsonl").write_bytes(journal)
        assert len(generate(RECIPE, EPISODES, folder).numbers()) == EPISODES


@take_share(0.1)
@given(changed_shards() | st.deferred(lambda: change_bytes(make_base().shards[0].read_bytes())))
def test_changed_shards_yield_episodes_or_an_error(content: bytes) -> None:
    with expect_result_or_error():
        check_shard(content)


@take_share(0.05)
@given(changed_journals())
def test_changed_journals_yield_a_dataset_or_an_error(journal: bytes) -> None:
    with expect_result_or_error(PLANNING_SECONDS):
        resume(journal)


def test_positions_of_1e9_are_refused_quickly() -> None:
    file = make_base().folder.parent / "filled.hdf5"
    shutil.copy(make_base().shards[0], file)
    with h5py.File(file, "r+") as archive:
        fill(archive, "data/demo_0/motion/knot_positions", 1e9)
    with expect_result_or_error():
        check_shard(file.read_bytes())


@pytest.mark.long
def test_unchanged_dataset_is_read_and_resumed() -> None:
    check_shard(make_base().shards[0].read_bytes())
    resume((make_base().folder / "journal.jsonl").read_bytes())
