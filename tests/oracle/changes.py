"""Writes changed copies of saved plans, with faults that the oracle must find."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["write_changed"]

Content = dict[str, Any]


def write_changed(source: Path, target: Path, change: Callable[[Content], None]) -> Path:
    """Write a copy of a plan to `target`, modified by `change`.

    `change` receives a dictionary with `scene`, `steps`, `options`, `names`, `times`, `positions`,
    `phases` and `column`, which returns a column of the positions by name. If `change` modifies
    times or positions, straight lines connect the waypoints.
    """
    with np.load(source, allow_pickle=False) as archive:
        metadata = json.loads(str(archive["about"]))
        content: Content = {
            "times": archive["times"].copy(),
            "positions": archive["positions"].copy(),
        }
        original = {name: array.copy() for name, array in content.items()}
        knots = {name: archive[name] for name in archive if name.startswith("knot_")}
    motion = metadata["trajectory"]
    content |= {
        "scene": metadata["scene"],
        "steps": metadata["steps"],
        "options": metadata["options"],
    }
    content |= {"names": motion["names"], "phases": motion["phases"]}
    content["column"] = lambda name: content["positions"][:, motion["names"].index(name)]
    change(content)
    metadata |= {"scene": content["scene"], "steps": content["steps"]}
    metadata["trajectory"] = {**motion, "phases": content["phases"], "names": content["names"]}
    unchanged = all(np.array_equal(original[name], content[name]) for name in original)
    arrays: dict[str, Any] = {
        "times": content["times"],
        "positions": content["positions"],
        **(knots if unchanged else {}),
    }
    np.savez_compressed(target, about=np.array(json.dumps(metadata)), **arrays)
    return target
