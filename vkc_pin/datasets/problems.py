"""What is asked for in an episode: a scene, a start and steps, drawn from what the recipe says."""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vkc_pin.datasets.grasping import find_grasping_start
from vkc_pin.datasets.recipes.recipe import Recipe, get_robot_name, load_recipe
from vkc_pin.datasets.recipes.terms import resolve_terms
from vkc_pin.errors import VkcError
from vkc_pin.options import Options
from vkc_pin.planning.planner import Planner
from vkc_pin.procedural.rooms.parts import CARRIED, Part
from vkc_pin.procedural.rooms.random_room import Layout, sample_layout
from vkc_pin.procedural.rooms.settings import RoomSettings
from vkc_pin.procedural.tasks import goals
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene, load_scene
from vkc_pin.world.task.steps import Actuate, Grasp, Place, Step
from vkc_pin.world.task.terms import Term

__all__ = ["NoProblemError", "Problem", "resolve_episode_terms", "sample_problem"]

_KEPT = 48  # rooms that a process keeps
_STARTS = 300  # places that are tried for the robot
_TABLES = 2
_ON = 0.001  # [m] of air below what is put on a table
_MARGIN = 0.12  # [m] from the ends of a table to the middle of what is put there


class NoProblemError(VkcError):
    """The recipe's ranges leave nothing to do: no place to start from, no grasp. The message says which."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What is asked for in one episode.

    Attributes:
        number: Of the episode.
        scene: Where, with the start.
        steps: What.
        options: How to plan.
        seed: Of planning.
        about: What was drawn, as plain data: task, robot, room, object, kind, attachment, goal.
        terms: What the motion must keep to beside that.
    """

    number: int
    scene: Scene
    steps: tuple[Step, ...]
    options: Options
    seed: int
    about: dict[str, Any] = field(default_factory=dict)
    terms: tuple[Term, ...] = ()


@dataclass(frozen=True, eq=False)
class _Place:
    """Where episodes happen: a scene, and the layout of a random room."""

    scene: Scene
    layout: Layout | None


def sample_problem(
    recipe: Recipe, number: int, robots: Mapping[str, str], planner: Planner
) -> Problem:
    """Return what episode `number` of a recipe asks for; the same in every run.

    Args:
        recipe: The recipe.
        number: From 0. Numbers that share a quotient by `variants` share all but the seed of
            planning.
        robots: Name of a robot in the recipe → what to load, where that is something else; see
            `robots`.
        planner: Keeps what looking for grasps builds.

    Raises:
        NoProblemError: The ranges leave nothing: no room has a place for everything, no start is
            free, no grasp is.
    """
    fields = recipe.fields
    asked, variant = divmod(number, fields.variants)
    rng, block = recipe.rng("episode", asked), asked // fields.rooms.episodes
    task = str(rng.choice(fields.tasks))
    said = json.dumps(recipe.document, sort_keys=True)
    if fields.scenes:
        place = _Place(_scene(fields.scenes[block % len(fields.scenes)]), None)
        robot = place.scene.robot.name
    else:
        rooms = fields.rooms.count or block + 1
        entry = fields.robots[
            (block + block // rooms) % len(fields.robots)
        ]  # in turn, and another one every time round
        place = _place(
            said,
            fields.rooms.first + block % rooms,
            robots.get(entry.name, entry.name),
            entry.height,
        )
        robot = entry.name
    about: dict[str, Any] = {"task": task, "robot": get_robot_name(robot), "room": place.scene.name}
    scene, steps, more = (_fetch if task == "fetch-place" else _open)(
        recipe, place, rng, task == "given-open", planner
    )
    about |= {**more, "variant": variant}
    return Problem(
        number,
        scene,
        steps,
        recipe.options,
        variant,
        about,
        resolve_episode_terms(recipe, scene, about),
    )


def resolve_episode_terms(
    recipe: Recipe, scene: Scene, about: Mapping[str, Any]
) -> tuple[Term, ...]:
    """Return what the motion of an episode about something must keep to; see `Episode.about`."""
    return resolve_terms(
        recipe.select_terms(about["task"]), scene, about["object"], about["attachment"]
    )


_scene = functools.lru_cache(maxsize=_KEPT)(load_scene)


@functools.lru_cache(maxsize=_KEPT)
def _layout(said: str, room: int) -> Layout:
    """Return a random room, whatever robot it is for; processes keep the last ones."""
    recipe = load_recipe(json.loads(said))
    rng, fields = recipe.rng("room", room), recipe.fields
    kinds = rng.choice(
        fields.objects, min(fields.rooms.objects, len(fields.objects)), replace=False
    )
    fetched = "fetch-place" in fields.tasks
    settings = RoomSettings(
        clutter=round(float(rng.uniform(*fields.rooms.clutter)), 3),
        objects=tuple(map(str, kinds)),
        tables=_TABLES if fetched else 0,
        carried=(str(rng.choice(fields.carried)),) if fetched else (),
        width=fields.rooms.width,
        front=fields.rooms.front,
    )
    return sample_layout(room, settings)


@functools.lru_cache(maxsize=_KEPT)
def _place(said: str, room: int, robot: str, height: float | None) -> _Place:
    """Return a random room with a robot in it; processes keep the last ones."""
    try:
        layout = _layout(said, room)
        scene = layout.make_scene()
        document = scene.document
        if robot != scene.robot.name or height is not None:
            document["robot"] = {"name": robot}
            document["start"] = {
                "base": document["start"]["base"],
                **({} if height is None else {"z": height}),
            }
            scene = Scene.from_document(document, scene.folder)
        return _Place(scene, layout)
    except VkcError as error:
        raise NoProblemError(f"room {room} for {get_robot_name(robot)}: {error}") from error


def _open(
    recipe: Recipe, place: _Place, rng: np.random.Generator, given: bool, planner: Planner
) -> tuple[Scene, tuple[Step, ...], dict[str, Any]]:
    """Return scene, steps and what was drawn, to open or to close something."""
    scene, fields = place.scene, recipe.fields
    share = round(float(rng.uniform(*fields.goal.share)), 4)
    offered = [step for step in goals(scene, share=share) if isinstance(step, Actuate)]
    if not offered:
        raise NoProblemError(f"nothing can be opened in {scene.name}")
    names = sorted({step.object for step in offered})
    name = str(rng.choice(names))
    own = [step for step in offered if step.object == name]
    step = own[int(rng.integers(len(own)))]
    item = scene.objects[name].object
    attachment = str(step.attachment)
    if fields.grasps == "any":
        link = item.attachments[attachment].link
        same = [
            one.name
            for one in item.attachments.values()
            if one.link == link and one.contact == "grasp"
        ]
        attachment = str(rng.choice(sorted(same)))
    step = Actuate(name, step.joints, attachment)
    ((joint, goal),) = step.joints.items()
    if given:
        terms = resolve_terms(recipe.select_terms("given-open"), scene, name, attachment)
        found = find_grasping_start(scene, step, rng, recipe.options, planner, terms)
        if found is None:
            raise NoProblemError(f"no free grasp of {name}.{attachment} in {scene.name} was found")
        scene = found
    else:
        scene = _started(recipe, place, rng, scene.objects[name].placement.translation)
    kind = _kind(recipe, item.name)
    return (
        scene,
        (step,),
        {"object": name, "kind": kind, "attachment": attachment, "joint": joint, "goal": goal},
    )


def _fetch(
    recipe: Recipe, place: _Place, rng: np.random.Generator, given: bool, planner: Planner
) -> tuple[Scene, tuple[Step, ...], dict[str, Any]]:
    """Return scene, steps and what was drawn, to take something from its table to another."""
    scene, layout, fields = place.scene, place.layout, recipe.fields
    assert layout is not None  # recipes of scene files do not fetch
    free = [name for name, placed in scene.objects.items() if placed.object.free]
    name = str(rng.choice(sorted(free)))
    placed = scene.objects[name]
    attachments = sorted(placed.object.attachments)
    attachment = (
        str(rng.choice(attachments))
        if fields.grasps == "any"
        else next(iter(placed.object.attachments))
    )
    others = [
        part for part in layout.parts if part.name.startswith("table_") and part.name != "table_1"
    ]
    on = others[int(rng.integers(len(others)))]
    target = _on_table(on, placed.object.name, rng, fields.goal.edge)
    scene = _started(recipe, place, rng, placed.placement.translation)
    drawn = {
        "object": name,
        "kind": placed.object.name,
        "attachment": attachment,
        "joint": "",
        "goal": list(target),
    }
    return scene, (Grasp(name, attachment), Place(name, target)), drawn


def _on_table(
    on: Part, kind: str, rng: np.random.Generator, edge: tuple[float, float]
) -> tuple[float, float, float]:
    """Return a place on a table, near the side at which a robot can stand, in the world frame [m]."""
    depth, width, height = on.size
    x = -depth / 2.0 + min(float(rng.uniform(*edge)), depth - _MARGIN)
    y = float(rng.uniform(-1.0, 1.0)) * (width / 2.0 - _MARGIN)
    return *on.frame.transform_point(x, y), round(height + CARRIED[kind] + _ON, 4)


def _started(recipe: Recipe, place: _Place, rng: np.random.Generator, goal: Floats) -> Scene:
    """Return the scene with the robot at a random place from which it gets to everything, and its arm about home."""
    scene, start = place.scene, recipe.fields.start
    low, high = scene.robot.start_limits
    x, y = np.array(scene.arena).reshape(2, 2)
    anywhere = (rng.uniform([x[0], y[0], -np.pi], [x[1], y[1], np.pi]) for _ in range(_STARTS))
    for base in itertools.islice(
        scene.start_region.sample_poses(rng) if scene.start_region else anywhere, _STARTS
    ):
        base = np.round(base, 4)
        if not start.distance[0] <= np.linalg.norm(base[:2] - goal[:2]) <= start.distance[
            1
        ] or not _connected(place, base):
            continue
        arm = scene.robot.home + rng.uniform(-1.0, 1.0, len(scene.robot.home)) * start.arm
        there = scene.with_start(base=base, arm=np.clip(np.round(arm, 4), low[3:], high[3:]))
        if there.start_clearance(reach=START_CLEARANCE) >= START_CLEARANCE:
            return there
    raise NoProblemError(
        f"no free start in {scene.name} within {list(start.distance)} m of the goal"
    )


def _connected(place: _Place, base: Floats) -> bool:
    """Return whether the robot gets from a place in a random room to wherever it has to stand."""
    if place.layout is None:
        return True
    standing = [part.footprint for part in place.layout.parts if part.size != (0.0, 0.0, 0.0)]
    where = (float(base[0]), float(base[1]))
    if not place.layout.floor.find_free(standing, place.layout.radius, [where])[0]:
        return False
    spots = [part.standing_place for part in place.layout.parts if part.standing_place is not None]
    return place.layout.floor.is_connected(standing, place.layout.radius, [*spots, where])


def _kind(recipe: Recipe, called: str) -> str:
    """Return what kind of thing an object is, by the name in its description."""
    return called.rpartition("_")[0] if called.rpartition("_")[2].isdigit() else called
