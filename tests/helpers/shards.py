"""Modifies episodes in the shards of a dataset."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

Change = Callable[[Any], object]


def change_demo(shard: Path, change: Change, k: int = 0) -> int:
    """Modify the group of an episode, and return the episode's number."""
    import h5py

    with h5py.File(shard, "r+") as file:
        demo = file[f"data/demo_{k}"]
        change(demo)
        return int(demo.attrs["number"])


def bend_motion(demo: Any) -> None:
    """Move a joint of the arm in the middle of the motion."""
    positions = demo["motion/knot_positions"]
    positions[len(positions) // 2, 4] += 0.4


def set_array(name: str, value: Any, at: Any = ...) -> Change:
    """Return a function that modifies an array of a demo."""

    def change(demo: Any) -> None:
        demo[name][at] = value

    return change


def replace_array(name: str, make: Callable[[Any], Any]) -> Change:
    """Return a function that replaces an array by the result of `make` for its values."""

    def change(demo: Any) -> None:
        values = make(demo[name][:])
        del demo[name]
        demo[name] = values

    return change


def set_attribute(name: str, value: Any) -> Change:
    """Return a function that sets an attribute of a group, or removes it if the value is None."""

    def change(group: Any) -> None:
        if value is None:
            del group.attrs[name]
        else:
            group.attrs[name] = value

    return change


def set_description(*path: Any, value: Any) -> Change:
    """Return a function that sets a field in the description of a demo."""

    def change(demo: Any) -> None:
        data = inner = json.loads(demo.attrs["episode"])
        for name in path[:-1]:
            inner = inner[name]
        inner[path[-1]] = value
        demo.attrs["episode"] = json.dumps(data)

    return change
