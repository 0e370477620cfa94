"""Makes episodes as parts of shards in worker processes, which the client copies."""

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
    """Make episodes as `run_attempts` does, packed by `make_part`, whose time is added."""
    document, _, robots = task
    recipe, found = load_recipe(document), []
    folder = next((Path(file).parent.parent for file in robots.values()), None)
    for record, data in run_attempts(task):
        if data:
            began, worked = time.perf_counter(), time.process_time()
            episode = unpack(data, folder)
            robot = _load_robot(recipe.digest, episode)
            data = make_part(episode, robot, recipe.fields.rate, recipe.digest)
            seconds, cpu_time = time.perf_counter() - began, time.process_time() - worked
            record["seconds"] = round(record["seconds"] + seconds, 4)
            record["cpu_time"] = round(record["cpu_time"] + cpu_time, 4)
        found.append((record, data))
    return found


_ROBOTS: dict[tuple[str, str, float | None], Robot] = {}
"""Robots of this process by recipe, name and height, since building every scene is slow."""


def _load_robot(recipe: str, episode: Episode) -> Robot:
    key = (recipe, str(episode.about["robot"]), episode.start.get("z"))
    if key not in _ROBOTS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they were shown during generation
            _ROBOTS[key] = episode.scene().robot
    return _ROBOTS[key]
