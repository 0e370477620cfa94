"""Attempts whose episodes come as parts of shards: processes that work do all that takes time, and the client copies."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vkc_pin.datasets.episode import Episode, Made, run_attempts, unpack
from vkc_pin.datasets.formats.hdf5 import make_part
from vkc_pin.datasets.recipes.recipe import load_recipe
from vkc_pin.world.models.robot import Robot

__all__ = ["make_parts"]


def make_parts(task: tuple[Mapping[str, Any], Sequence[int], Mapping[str, str]]) -> list[Made]:
    """Make episodes as `run_attempts` does, each as the bytes of `make_part`; the time that this takes is the attempt's."""
    said, _, robots = task
    recipe, found = load_recipe(said), []
    for record, data in run_attempts(task):
        if data:
            began, worked = time.perf_counter(), time.process_time()
            episode = unpack(data, _folder(robots))
            data = make_part(
                episode, _robot(recipe.digest, episode), recipe.fields.rate, recipe.digest
            )
            for name, spent in (
                ("seconds", time.perf_counter() - began),
                ("cpu_time", time.process_time() - worked),
            ):
                record[name] = round(record[name] + spent, 4)
        found.append((record, data))
    return found


def _folder(robots: Mapping[str, str]) -> Path | None:
    """Return the dataset's folder of robots, in which each has one of its own; None if there are none."""
    return next((Path(file).parent.parent for file in robots.values()), None)


_ROBOTS: dict[tuple[str, str, float | None], Robot] = {}
"""By recipe, name and height, those that a process has loaded: building the scene of every episode would take far longer."""


def _robot(recipe: str, episode: Episode) -> Robot:
    key = (recipe, str(episode.about["robot"]), episode.start.get("z"))
    if key not in _ROBOTS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what generating it has said already
            _ROBOTS[key] = episode.scene().robot
    return _ROBOTS[key]
