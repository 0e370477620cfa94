"""Samples the problem of an episode from a recipe: scene, start, grasp and steps."""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vkc_pin.datasets.recipe import Recipe, get_robot_name, load_recipe, resolve_terms
from vkc_pin.errors import InputError, VkcError
from vkc_pin.options import Options
from vkc_pin.planning.initialization.keyframes import KeyframeSampler, compute_shortfall
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.planner import Planner
from vkc_pin.procedural.rooms.parts import CARRIED, Part
from vkc_pin.procedural.rooms.random_room import Layout, RoomSettings, sample_layout
from vkc_pin.procedural.tasks import goals
from vkc_pin.utils.arguments import check_choice
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene, load_scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate, Grasp, Place, Step
from vkc_pin.world.task.terms import Term, trace_terms
from vkc_pin.world.task.views import prefer_in_view

# random configurations that inverse kinematics brings to the grasp at once
_BATCH = 48
# batches before there is none
_DRAWS = 6
# [m], [rad] accepted distance of the hand from its grasp
_EXACT = 1e-2 * TOLERANCE
# rooms in a process's cache
_CACHED_ROOMS = 48
# sampled start poses
_STARTS = 300
_TABLES = 2
# [m] gap between a placed object and its table
_GAP = 0.001
# [m] from the ends of a table to the centre of a placed object
_MARGIN = 0.12
_load_scene = functools.lru_cache(maxsize=_CACHED_ROOMS)(load_scene)


def find_grasping_start(
    scene: Scene,
    step: Actuate,
    rng: np.random.Generator,
    options: Options,
    planner: Planner,
) -> Scene | None:
    """Return the scene with a random free configuration that grasps the object of a step.

    Args:
        scene: Scene.
        step: Step with its attachment.
        rng: Random generator.
        options: Options with clearances.
        planner: Planner whose caches are used.

    Returns:
        The scene, or None if no configuration was found.
    """
    name = step.object
    attachment = str(step.attachment)
    # Wherever the hand is: the chain does not depend on it.
    holding = scene.with_held({name: attachment})
    with planner.acquire() as cache:
        task = compile_task(holding, [step], options)
        problem = KinematicProblem(holding, task, options, cache=cache)
        chain = problem.chain
        coordinates = scene.objects[name].object.attachments[attachment].coordinates
        freedoms = [chain.index(f"{name}.{coordinate}") for coordinate in coordinates]
        row = _sample_grasping_configuration(problem, freedoms, rng)
        if row is None:
            return None
        start = scene.with_start(base=row[:3], arm=row[3 : scene.robot.coordinates.size])
        return start.with_held([Hold(name, attachment, at=tuple(row[freedoms].tolist()))])


def _sample_grasping_configuration(
    problem: KinematicProblem, freedoms: Sequence[int], rng: np.random.Generator
) -> Floats | None:
    """Sample a free configuration of a chain at the pose of its first phase, shape (n,).

    Random configurations are brought to the pose by inverse kinematics, with random values of the
    grasp's freedoms.

    Args:
        problem: The task.
        freedoms: Coordinates of the grasp's freedoms.
        rng: Random generator.

    Returns:
        The configuration, or None if none was found.
    """
    chain = problem.chain
    search = KeyframeSampler(problem, rng)
    pose = search.find_pose(1)
    if pose is None:
        return None
    solver, target = search.get_pose_solver(pose)
    limits = np.array([problem.limits(name) for name in chain.names])
    fixed = [*freedoms, *search.object_columns.tolist()]
    for _ in range(_DRAWS):
        z = np.tile(problem.start, (_BATCH, 1))
        z[:, freedoms] = rng.uniform(
            chain.lower[freedoms], chain.upper[freedoms], (_BATCH, len(freedoms))
        )
        z, _ = search.sample(z, 1, "scatter")
        # The object is as at the start, not a step later.
        z[:, search.object_columns] = problem.start[search.object_columns]
        lower = np.tile(limits[:, 0], (_BATCH, 1))
        upper = np.tile(limits[:, 1], (_BATCH, 1))
        lower[:, fixed] = z[:, fixed]
        upper[:, fixed] = z[:, fixed]
        z, is_solved = solver.solve(
            z, target, lower=lower, upper=upper, weights=search.weights, tolerance=_EXACT
        )
        z = z[is_solved]
        if len(z):
            z = z[compute_shortfall(problem, z, 0) <= 0.0]
        if len(z):
            return np.asarray(z[int(rng.integers(len(z)))])
    return None


class NoProblemError(VkcError):
    """The recipe's ranges admit no problem, e.g. no free start or no free grasp."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Problem of one episode.

    Attributes:
        number: Episode number.
        scene: Scene with its start.
        steps: Steps of the task.
        options: Planning options.
        seed: Random seed of planning.
        about: Sampled values as plain data: task, robot, room, object, kind, attachment, goal.
        terms: Additional terms of the recipe.
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
    """A scene, and the layout if it is a random room."""

    scene: Scene
    layout: Layout | None


def sample_problem(
    recipe: Recipe, number: int, robots: Mapping[str, str], planner: Planner
) -> Problem:
    """Return the problem of episode `number` of a recipe, which is the same in every run.

    Args:
        recipe: The recipe.
        number: Episode number, from 0. Numbers with the same quotient by `variants` differ only in
            the random seed of planning.
        robots: Maps robot names in the recipe to files that replace them; see `robots`.
        planner: Planner whose caches are used in the search for grasps.

    Raises:
        NoProblemError: The ranges admit no problem: no room fits all objects, no start is free, or
            no grasp is.
    """
    fields = recipe.fields
    group, variant = divmod(number, fields.variants)
    block = group // fields.rooms.episodes
    rng = recipe.rng("episode", group)
    task = str(rng.choice(fields.tasks))
    if fields.scenes:
        place = _Place(_load_scene(fields.scenes[block % len(fields.scenes)]), None)
        robot = place.scene.robot.name
    else:
        rooms = fields.rooms.count or block + 1
        # Robots alternate, with an offset after each pass over the rooms.
        turn = block + block // rooms
        entry = fields.robots[turn % len(fields.robots)]
        place = _make_place(
            json.dumps(recipe.document, sort_keys=True),
            fields.rooms.first + block % rooms,
            robots.get(entry.name, entry.name),
            entry.height,
        )
        robot = entry.name
    if task == "fetch-place":
        scene, steps = _sample_fetch_task(recipe, place, rng)
    else:
        scene, steps = _sample_open_task(recipe, place, rng, task == "given-open", planner)
    about: dict[str, Any] = {"task": task, "robot": get_robot_name(robot)}
    about.update(describe_problem(scene, steps))
    about["variant"] = variant
    terms = resolve_episode_terms(recipe, scene, about)
    return Problem(number, scene, steps, recipe.options, variant, about, terms)


def describe_problem(scene: Scene, steps: Sequence[Step]) -> dict[str, Any]:
    """Return the sampled values that follow from scene and steps, as plain data.

    Raises:
        InputError: The steps are of no task.
    """
    goal: float | list[float]
    match steps:
        case [Actuate(joints={**joints}) as step] if len(joints) == 1:
            ((joint, goal),) = joints.items()
            task = "given-open" if step.object in scene.held else "drive-open"
        case [Grasp() as step, Place(object=name, pose=tuple() as point)] if name == step.object:
            joint = ""
            goal = list(point)
            task = "fetch-place"
        case _:
            expected = "one Actuate of one joint, or Grasp and Place of one object"
            raise InputError("steps of no task", field="steps", expected=expected, got=steps)
    check_choice(step.object, scene.objects, "object", "steps")
    item = scene.objects[step.object].object
    stem, _, number = item.name.rpartition("_")
    kind = stem if joint and number.isdigit() else item.name
    return {
        "task": task,
        "room": scene.name,
        "object": step.object,
        "kind": kind,
        "attachment": step.attachment,
        "joint": joint,
        "goal": goal,
    }


def resolve_episode_terms(
    recipe: Recipe, scene: Scene, about: Mapping[str, Any]
) -> tuple[Term, ...]:
    """Return the recipe's terms for an episode; see `Episode.about`.

    With `look`, each camera prefers to look at the attachment until it is grasped.
    """
    name = about["object"]
    attachment = about["attachment"]
    terms = resolve_terms(recipe.select_terms(about["task"]), scene, name, attachment)
    weight = recipe.fields.look
    if not weight or name in scene.held:
        return terms
    target = f"{name}.{attachment}"
    views = list[Term]()
    for camera in recipe.cameras:
        term = prefer_in_view(scene, camera, target, weight=weight, during=f"reach {target}")
        views.append(term)
    return terms + trace_terms(scene, views)


@functools.lru_cache(maxsize=_CACHED_ROOMS)
def _sample_layout(recipe_json: str, room: int) -> Layout:
    """Return the layout of a random room, independent of the robot; cached."""
    recipe = load_recipe(json.loads(recipe_json))
    fields = recipe.fields
    rng = recipe.rng("room", room)
    count = min(fields.rooms.objects, len(fields.objects))
    kinds = rng.choice(fields.objects, count, replace=False)
    clutter = round(float(rng.uniform(*fields.rooms.clutter)), 3)
    tables = 0
    carried: tuple[str, ...] = ()
    if "fetch-place" in fields.tasks:
        tables = _TABLES
        carried = (str(rng.choice(fields.carried)),)
    settings = RoomSettings(
        clutter=clutter,
        objects=tuple(str(kind) for kind in kinds),
        tables=tables,
        carried=carried,
        width=fields.rooms.width,
        front=fields.rooms.front,
    )
    return sample_layout(room, settings)


@functools.lru_cache(maxsize=_CACHED_ROOMS)
def _make_place(recipe_json: str, room: int, robot: str, height: float | None) -> _Place:
    """Return a random room with a robot; cached."""
    try:
        layout = _sample_layout(recipe_json, room)
        scene = layout.make_scene()
        document = scene.document
        if robot != scene.robot.name or height is not None:
            document["robot"] = {"name": robot}
            document["start"] = {"base": document["start"]["base"]}
            if height is not None:
                document["start"]["z"] = height
            scene = Scene.from_document(document, scene.folder)
        return _Place(scene, layout)
    except VkcError as error:
        raise NoProblemError(f"room {room} for {get_robot_name(robot)}: {error}") from error


def _sample_open_task(
    recipe: Recipe, place: _Place, rng: np.random.Generator, given: bool, planner: Planner
) -> tuple[Scene, tuple[Step, ...]]:
    """Return scene and steps of a task that opens or closes something."""
    scene = place.scene
    fields = recipe.fields
    share = round(float(rng.uniform(*fields.goal.share)), 4)
    offered = [step for step in goals(scene, share=share) if isinstance(step, Actuate)]
    if not offered:
        raise NoProblemError(f"{scene.name} has nothing to open")
    names = sorted({step.object for step in offered})
    name = str(rng.choice(names))
    object_steps = [step for step in offered if step.object == name]
    step = object_steps[int(rng.integers(len(object_steps)))]
    item = scene.objects[name].object
    attachment = str(step.attachment)
    if fields.grasps == "any":
        link = item.attachments[attachment].link
        on_link = [one for one in item.attachments.values() if one.link == link]
        graspable = [one.name for one in on_link if one.contact == "grasp"]
        attachment = str(rng.choice(sorted(graspable)))
    step = Actuate(name, step.joints, attachment)
    if not given:
        start = _sample_start(recipe, place, rng, scene.objects[name].placement.translation)
        return start, (step,)
    grasping = find_grasping_start(scene, step, rng, recipe.options, planner)
    if grasping is None:
        raise NoProblemError(f"no free grasp of {name}.{attachment} in {scene.name} was found")
    return grasping, (step,)


def _sample_fetch_task(
    recipe: Recipe, place: _Place, rng: np.random.Generator
) -> tuple[Scene, tuple[Step, ...]]:
    """Return scene and steps of a task that moves an object to another table."""
    scene = place.scene
    layout = place.layout
    fields = recipe.fields
    assert layout is not None  # recipes of scene files do not fetch
    free = [name for name, placed in scene.objects.items() if placed.object.free]
    name = str(rng.choice(sorted(free)))
    placed = scene.objects[name]
    attachments = placed.object.attachments
    if fields.grasps == "any":
        names = sorted(one.name for one in attachments.values() if one.contact == "grasp")
        attachment = str(rng.choice(names))
    else:
        attachment = next(iter(attachments))
    tables = [part for part in layout.parts if part.name.startswith("table_")]
    others = [part for part in tables if part.name != "table_1"]
    table = others[int(rng.integers(len(others)))]
    target = _sample_position_on_table(table, placed.object.name, rng, fields.goal.edge)
    scene = _sample_start(recipe, place, rng, placed.placement.translation)
    return scene, (Grasp(name, attachment), Place(name, target))


def _sample_position_on_table(
    table: Part, kind: str, rng: np.random.Generator, edge: tuple[float, float]
) -> tuple[float, float, float]:
    """Return a position on a table near the side where robots can stand, in the world [m]."""
    depth, width, height = table.size
    # In the table's frame: x from the side where robots stand, y along it.
    x = -depth / 2.0 + min(float(rng.uniform(*edge)), depth - _MARGIN)
    y = float(rng.uniform(-1.0, 1.0)) * (width / 2.0 - _MARGIN)
    world_x, world_y = table.frame.transform_point(x, y)
    return world_x, world_y, round(height + CARRIED[kind] + _GAP, 4)


def _sample_start(recipe: Recipe, place: _Place, rng: np.random.Generator, goal: Floats) -> Scene:
    """Return the scene with a random start pose connected to all goals, and the arm near home."""
    scene = place.scene
    home = scene.robot.home
    start = recipe.fields.start
    nearest, farthest = start.distance
    low, high = scene.robot.start_limits
    for pose in itertools.islice(_sample_poses(scene, rng), _STARTS):
        base = np.round(pose, 4)
        distance = np.linalg.norm(base[:2] - goal[:2])
        if not nearest <= distance <= farthest or not _is_connected(place, base):
            continue
        arm = home + rng.uniform(-1.0, 1.0, len(home)) * start.arm
        candidate = scene.with_start(base=base, arm=np.clip(np.round(arm, 4), low[3:], high[3:]))
        if candidate.start_clearance(reach=START_CLEARANCE) >= START_CLEARANCE:
            return candidate
    raise NoProblemError(
        f"no free start in {scene.name} within {list(start.distance)} m of the goal"
    )


def _sample_poses(scene: Scene, rng: np.random.Generator) -> Iterator[Floats]:
    """Yield random poses of the base in the scene's region of starts, or anywhere in its arena."""
    if scene.start_region:
        yield from scene.start_region.sample_poses(rng)
        return
    x_min, x_max, y_min, y_max = scene.arena
    while True:
        yield rng.uniform([x_min, y_min, -np.pi], [x_max, y_max, np.pi])


def _is_connected(place: _Place, base: Floats) -> bool:
    """Return whether the robot can drive from a pose to all places where it has to stand."""
    layout = place.layout
    if layout is None:
        return True
    footprints = [part.footprint for part in layout.parts if part.size != (0.0, 0.0, 0.0)]
    position = (float(base[0]), float(base[1]))
    if not layout.floor.find_free(footprints, layout.radius, [position])[0]:
        return False
    places = [part.standing_place for part in layout.parts if part.standing_place is not None]
    return layout.floor.is_connected(footprints, layout.radius, [*places, position])
