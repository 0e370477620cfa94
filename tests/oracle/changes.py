"""Writes changed copies of saved plans, whose faults the oracle must find."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["write_changed"]

Content = dict[str, Any]


def write_changed(source: Path, target: Path, change: Callable[[Content], None]) -> Path:
    """Write a copy of a plan to `target` that `change` has changed.

    It gets a dictionary with `scene`, `steps`, `options`, `names`, `times`, `positions`, `phases`
    and `column`, which returns one of the positions' columns by name. Waypoints that it has moved,
    in place or time, have straight lines between them.
    """
    with np.load(source, allow_pickle=False) as archive:
        about = json.loads(str(archive["about"]))
        content: Content = {
            "times": archive["times"].copy(),
            "positions": archive["positions"].copy(),
        }
        before = {name: array.copy() for name, array in content.items()}
        knots = {name: archive[name] for name in archive if name.startswith("knot_")}
    motion = about["trajectory"]
    content |= {"scene": about["scene"], "steps": about["steps"], "options": about["options"]}
    content |= {"names": motion["names"], "phases": motion["phases"]}
    content["column"] = lambda name: content["positions"][:, motion["names"].index(name)]
    change(content)
    about |= {"scene": content["scene"], "steps": content["steps"]}
    about["trajectory"] = {**motion, "phases": content["phases"], "names": content["names"]}
    same = all(np.array_equal(before[name], content[name]) for name in before)
    arrays: dict[str, Any] = {
        "times": content["times"],
        "positions": content["positions"],
        **(knots if same else {}),
    }
    np.savez_compressed(target, about=np.array(json.dumps(about)), **arrays)
    return target
