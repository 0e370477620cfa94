"""Defines sixty problems by number: forty in random rooms, twenty in scenes of the package.

The numbers alone determine the problems, whether or not a planner can solve them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.experiments.tasks import TASKS, make_start
from vkc_pin.procedural.rooms.random_room import sample_layout
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Place, Reach, Step

from .poses import sample_pose_among, sample_pose_over

KINDS = ("reach", "door", "pull", "carry", "scene")
"""Kinds of problems: ten of each of the first four in random rooms, then twenty in scenes."""
NUMBER = 60
_EACH = 10
_STARTS = 60  # the random seed of the starts; the experiments' own figures are of other seeds

_DOORS = (("door", None), ("narrow_door", "handle_free"), ("wide_door", None))
_PULLED: tuple[tuple[str, str, tuple[float, float]], ...] = (
    ("drawer", "slide", (0.2, 0.35)),
    ("refrigerator", "hinge", (0.8, 1.5)),
    ("low_drawer", "slide", (0.15, 0.3)),
    ("cabinet", "hinge", (0.4, 1.4)),
)
_SWUNG = (0.8, 1.4)  # [rad] by which doors are pushed
_EDGE = 0.1  # [m] from where a cup is put to the edges of the table


@dataclass(frozen=True)
class Problem:
    """A problem.

    Attributes:
        number: Number, from 0.
        name: Room or task, and goal.
        kind: One of `KINDS`, or a task.
        scene: Initial scene.
        steps: Steps to plan.
    """

    number: int
    name: str
    kind: str
    scene: Scene
    steps: tuple[Step, ...]


def get_kind(number: int) -> str:
    """Return the kind of a problem.

    Raises:
        InputError: There is no such problem.
    """
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < NUMBER:
        raise InputError(
            "there is no such problem",
            field="problem",
            expected=f"0 to {NUMBER - 1}",
            got=repr(number),
        )
    return KINDS[min(number // _EACH, len(KINDS) - 1)]


def problem(number: int) -> Problem:
    """Return a problem by its number, below `NUMBER`.

    Raises:
        InputError: There is no such problem.
    """
    kind = get_kind(number)
    if kind == "scene":
        name, start = _FIXED[number - (len(KINDS) - 1) * _EACH]
        return dataclasses.replace(
            make_task_problem(name, _STARTS, start), number=number, kind=kind
        )
    scene, step, about = {"reach": _reach, "door": _door, "pull": _pull, "carry": _carry}[kind](
        number
    )
    return Problem(number, f"{scene.name} {about}", kind, scene, (step,))


def make_task_problem(task: str, seed: int, number: int) -> Problem:
    """Return a task from a random start as a problem; see `make_start`."""
    return Problem(
        number, f"{task} {number}", task, make_start(task, seed, number), TASKS[task].steps
    )


_FIXED = [
    (name, start) for name in TASKS for start in range(1 if name.startswith("household") else 2)
]


def _clutter(number: int) -> float:
    """Return the clutter of a problem's room, from none to much in each kind."""
    return number % _EACH / 10.0


def _reach(number: int) -> tuple[Scene, Step, str]:
    layout = sample_layout(number, clutter=_clutter(number))
    scene = layout.make_scene()
    rng = np.random.default_rng([2, number])
    over = number % 2 == 0
    pose: pin.SE3 = (
        sample_pose_over(layout, scene, layout.find_part("table_1"), rng)
        if over
        else sample_pose_among(layout, scene, rng)
    )
    return scene, Reach(pose), f"reach {'over a table' if over else 'among furniture'}"


def _door(number: int) -> tuple[Scene, Step, str]:
    name, attachment = _DOORS[number % len(_DOORS)]
    scene = sample_layout(number, clutter=_clutter(number), objects=(name,)).make_scene()
    angle = round(float(np.random.default_rng([2, number]).uniform(*_SWUNG)), 2)
    return scene, Actuate(name, {"hinge": angle}, attachment), f"push {name} by {angle:g} rad"


def _pull(number: int) -> tuple[Scene, Step, str]:
    name, joint, interval = _PULLED[number % len(_PULLED)]
    scene = sample_layout(number, clutter=_clutter(number), objects=(name,)).make_scene()
    value = round(float(np.random.default_rng([2, number]).uniform(*interval)), 2)
    return (
        scene,
        Actuate(name, {joint: value}),
        f"pull {name} by {value:g} {'m' if joint == 'slide' else 'rad'}",
    )


def _carry(number: int) -> tuple[Scene, Step, str]:
    layout = sample_layout(number, clutter=_clutter(number), tables=2, carried=("cup",))
    rng = np.random.default_rng([2, number])
    table = layout.find_part("table_2")
    depth, width, _ = table.size
    x = -depth / 2.0 + float(rng.uniform(_EDGE, 0.3))
    y = float(rng.uniform(_EDGE - width / 2.0, width / 2.0 - _EDGE))
    place = (*table.frame.transform_point(x, y), round(table.size[2] + 0.001, 3))
    return layout.make_scene(), Place("cup", place), "carry the cup to table_2"
