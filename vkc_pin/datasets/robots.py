"""Robots of a recipe: those whose hand nobody has described yet are imported into the dataset's folder first, once."""

from __future__ import annotations

import warnings
from pathlib import Path

from vkc_pin.datasets.problems import robot_name
from vkc_pin.datasets.recipe import Recipe
from vkc_pin.importing.robots.robot_import import import_robot
from vkc_pin.models.robot_file import find_robot, load_robot

__all__ = ["ready_robots"]

_SAMPLES = 1000  # configurations for pairs that need no check, as of robots that are loaded without an SRDF


def ready_robots(recipe: Recipe, folder: Path) -> dict[str, str]:
    """Return name in the recipe → path of what to load, for the robots that are imported or given by path.

    Args:
        recipe: The recipe.
        folder: Where folders are made; what is there is not made again. On a cluster, all workers must see it.

    Raises:
        InputError: A robot cannot be imported.
    """
    found = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is guessed is in the robot's folder
        for entry in () if recipe.fields.scenes else recipe.fields.robots:
            made = folder / robot_name(entry.name)
            if not (made / "robot.yaml").is_file():
                if load_robot(entry.name).touch_links:
                    continue
                import_robot(find_robot(entry.name), made, samples=_SAMPLES)
            found[entry.name] = str((made / "robot.yaml").resolve())
    return found
