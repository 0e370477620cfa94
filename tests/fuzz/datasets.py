"""Changes datasets at random: members and attributes of shards, lines of journals, and bytes."""

from __future__ import annotations

import atexit
import contextlib
import functools
import json
import random
import shutil
import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.formats.hdf5 import open_shard
from vkc_pin.datasets.generation import generate

from .mutate import apply_changes, choose_changes, corrupt

__all__ = ["make_case", "make_journal_case", "run", "run_journal"]

RECIPE: dict[str, Any] = {
    "name": "small",
    "tasks": ["given-open"],
    "objects": ["random_oven"],
    "rooms": {"count": 1, "objects": 1, "clutter": [0.0, 0.0]},
}
EPISODES = 2
ACTIONS = ("delete", "fill", "array", "text", "group", "soft", "external", "move", "huge", "grow")


@functools.cache
def _make_base() -> Dataset:
    folder = Path(tempfile.mkdtemp(prefix="vkc_fuzz_datasets_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return generate(RECIPE, EPISODES, folder / "base")


@functools.cache
def _list_members() -> tuple[str, ...]:
    names: list[str] = []
    with h5py.File(_make_base().shards[0]) as file:
        file.visit(names.append)
    return tuple(names)


@functools.cache
def _list_attributes() -> tuple[tuple[str, str], ...]:
    with h5py.File(_make_base().shards[0]) as file:
        return tuple((name, key) for name in _list_members() for key in file[name].attrs)


def make_case(rng: random.Random) -> dict[str, Any]:
    """Return a case: changes of members, of attributes, of the description, or of bytes."""
    match rng.randrange(4):
        case 0:
            pairs = [(rng.choice(_list_members()), rng.choice(ACTIONS)) for _ in range(2)]
            return {"members": pairs[: rng.choice((1, 1, 2))], "value": rng.choice(_NUMBERS)}
        case 1:
            member, name = rng.choice(_list_attributes())
            return {"attribute": [member, name], "value": rng.choice((*_NUMBERS, "", "[]", None))}
        case 2:
            with h5py.File(_make_base().shards[0]) as file:
                metadata = json.loads(file["data/demo_0"].attrs["episode"])
            return {"changes": choose_changes(rng, metadata)}
        case _:
            data = _make_base().shards[0].read_bytes()
            return {"content": corrupt(rng, data).decode("latin-1")}


_NUMBERS = (0, 1, -1, 0.5, 1e9, 1e300, "nan", 2**62)


def run(case: dict[str, Any]) -> str:
    """Read and check the episodes of a changed shard."""
    base = _make_base()
    file = base.folder.parent / "changed.hdf5"
    if "content" in case:
        file.write_bytes(case["content"].encode("latin-1"))
    else:
        shutil.copy(base.shards[0], file)
        with h5py.File(file, "r+") as archive:
            _change_archive(archive, case)
    with open_shard(file, base.folder / "scenes") as shard:
        for k in range(len(shard)):
            episode = shard.read(k)
            episode.validate()
            shard.find_differences(k, episode, episode.scene().robot, 10.0)
        shard.find_shard_differences("husky_ur5e", base.recipe)
    return "done"


def _change_archive(file: Any, case: dict[str, Any]) -> None:
    if "changes" in case:
        attributes = file["data/demo_0"].attrs
        metadata = apply_changes(json.loads(attributes["episode"]), case["changes"])
        attributes["episode"] = json.dumps(metadata)
        return
    value = float("nan") if case["value"] == "nan" else case["value"]
    if "attribute" in case:
        member, name = case["attribute"]
        del file[member].attrs[name]
        if value is not None:
            file[member].attrs[name] = value
        return
    for name, action in case["members"]:
        with contextlib.suppress(RuntimeError):  # behind a link to itself
            if name in file:
                _change_member(file, name, action, value)


def _change_member(file: Any, name: str, action: str, value: Any) -> None:
    if action == "fill":
        if isinstance(file[name], h5py.Dataset) and file[name].dtype.kind not in "SO":
            with np.errstate(all="ignore"):
                file[name][...] = np.full(file[name].shape, value, float).astype(file[name].dtype)
        return
    if action == "grow":
        size = {"shape": (10,), "maxshape": (None,), "chunks": (2**26,)}
        file.create_dataset(f"{name}_x" if name in file else name, dtype="f8", **size)
        return
    if action == "move":
        file.move(name, f"{name}_x")
        return
    del file[name]
    if action == "array":
        file[name] = np.full((3,), value)
    elif action == "text":
        file[name] = "text"
    elif action == "group":
        file.create_group(name)
    elif action == "soft":
        file[name] = h5py.SoftLink("/data")
    elif action == "external":
        file[name] = h5py.ExternalLink("base/shards/husky_ur5e/shard-00000.hdf5", "/data")
    elif action == "huge":
        file.create_dataset(name, (10**10,), "f8", chunks=(1000,), compression="gzip")


def make_journal_case(rng: random.Random) -> dict[str, Any]:
    """Return a case: a line of a journal with changes, or changed bytes."""
    lines = (_make_base().folder / "journal.jsonl").read_text(encoding="utf-8").splitlines()
    number = rng.randrange(len(lines))
    if rng.random() < 0.6:
        return {"line": number, "changes": choose_changes(rng, json.loads(lines[number]))}
    data = corrupt(rng, lines[number].encode())
    return {"line": number, "content": data.decode("latin-1"), "plan": True}


def run_journal(case: dict[str, Any]) -> str:
    """Resume generation with a changed journal."""
    base = _make_base()
    folder = base.folder.parent / "copy"
    shutil.copytree(base.folder, folder)
    try:
        lines = (folder / "journal.jsonl").read_bytes().splitlines()
        if "content" in case:
            lines[case["line"]] = case["content"].encode("latin-1")
        else:
            changed = apply_changes(json.loads(lines[case["line"]]), case["changes"])
            lines[case["line"]] = json.dumps(changed).encode()
        (folder / "journal.jsonl").write_bytes(b"\n".join(lines) + b"\n")
        assert len(generate(RECIPE, EPISODES, folder).numbers()) == EPISODES
    finally:
        shutil.rmtree(folder)
    return "done"
