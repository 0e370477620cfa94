"""Samples random problems, plans them and keeps the plans for `tests/oracle`.

Some of them are infeasible; claims of plans must be right in either case.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import distribution, trial
from vkc_pin.experiments.harness.runner import LIMITS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    format_decimal,
    format_table,
    join_sections,
    select,
)
from vkc_pin.options import Options
from vkc_pin.planning.prepare import plan
from vkc_pin.procedural.rooms.fixtures import OPENABLE
from vkc_pin.procedural.rooms.random_room import random_room
from vkc_pin.procedural.tasks import random_task
from vkc_pin.utils.arguments import check_choice
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.resources import list_resources
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Step, Touch

from .ablation import tabulate_trials
from .problem_set import Problem

_TRIES = 50  # rooms or obstacles in which something finds no place
_OBSTACLES = 6  # at most
_SECOND = 0.3  # share of problems of two steps
_AIR = 1e-3  # [m] below placed objects
_ROOMS = 100_000  # of one seed
# Many tasks are infeasible; the others take up to 60 000 evaluations.
_LIMITS = {**LIMITS, "max_evaluations": LIMITS["max_evaluations"] // 10}
OF = ("anything", "rooms")


def sample_problem(seed: int, number: int) -> Problem:
    """Return a problem: in a random room if its number is even, else in one of the scenes.

    Raises:
        InputError: No scene had a place for everything.
    """
    rng = np.random.default_rng([3, seed, number])
    names = sorted(list_resources("scenes", "*.yaml"))
    for _ in range(_TRIES):
        try:
            scene = (
                _room(rng)
                if number % 2 == 0
                else _make_crowded_scene(names[number // 2 % len(names)], rng)
            )
        except InputError:  # no place for something
            continue
        steps = _steps(scene, rng)
        kind = "room" if number % 2 == 0 else "scene"
        about = ", ".join(type(step).__name__ for step in steps)
        return Problem(number, f"{scene.name}: {about}", kind, scene, steps)
    raise InputError(
        "nothing found a place", field="problem", expected=f"one of {_TRIES} scenes", got=number
    )


def _room(rng: np.random.Generator) -> Scene:
    """Return a room with one or two articulated objects and something to carry."""
    count = int(rng.integers(1, 3))
    objects = tuple(str(kind) for kind in rng.choice(list(OPENABLE), count, replace=False))
    carried = tuple(str(kind) for kind in rng.choice(["cup", "ball"], int(rng.integers(1, 3))))
    # With much more, few rooms have a place for everything.
    clutter = round(float(rng.uniform(0.0, 0.6)), 2)
    return random_room(int(rng.integers(2**31)), clutter=clutter, objects=objects, carried=carried)


def _make_crowded_scene(name: str, rng: np.random.Generator) -> Scene:
    """Return a scene with up to six more obstacles, from a random start."""
    scene = load_scene(name)
    more = [_obstacle(scene, k, rng) for k in range(int(rng.integers(0, _OBSTACLES + 1)))]
    document = {**scene.document, "obstacles": [*scene.document["obstacles"], *more]}
    crowded = Scene.from_document(document, scene.folder)
    return crowded.sample_start(rng) if crowded.start_region is not None else crowded


def _obstacle(scene: Scene, number: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return a random obstacle in the arena, on the floor or up to 1.5 m above."""
    x, y = _spot(scene, rng)
    size = [round(float(value), 3) for value in rng.uniform((0.05, 0.05, 0.05), (0.5, 0.5, 1.2))]
    up = size[2] / 2 + (0.0 if rng.random() < 0.7 else float(rng.uniform(0.0, 1.5)))
    where: dict[str, Any] = {"name": f"random_{number}", "position": [x, y, round(up, 3)]}
    if (kind := int(rng.integers(3))) == 0:
        return {**where, "type": "sphere", "radius": size[0] / 2}
    if kind == 1:
        return {**where, "type": "cylinder", "radius": size[0] / 2, "length": size[2]}
    return {
        **where,
        "type": "box",
        "size": size,
        "yaw": round(float(rng.uniform(-np.pi, np.pi)), 3),
    }


def _spot(scene: Scene, rng: np.random.Generator) -> Floats:
    x_low, x_high, y_low, y_high = scene.arena
    return np.array(
        [round(float(value), 3) for value in rng.uniform((x_low, y_low), (x_high, y_high))]
    )


def _steps(scene: Scene, rng: np.random.Generator) -> tuple[Step, ...]:
    """Return one or two steps that can be compiled together."""
    while True:
        steps = tuple(_step(scene, rng) for _ in range(1 + (rng.random() < _SECOND)))
        with contextlib.suppress(InputError):  # such as two objects for one hand
            compile_task(scene, steps, Options())
            return steps


def _step(scene: Scene, rng: np.random.Generator) -> Step:
    """Return a random step; opening and carrying are most frequent."""
    free = [name for name, placed in scene.objects.items() if placed.object.free]
    fixed = [name for name in scene.objects if name not in free]
    kinds: list[Callable[[], Step]] = [lambda: _reach(scene, rng), lambda: _go(scene, rng)]
    if fixed:
        kinds += 4 * [lambda: _actuate(scene, str(rng.choice(fixed)), rng)]
    if free:
        kinds += 3 * [lambda: _place(scene, str(rng.choice(free)), rng)]
        kinds += [
            lambda: Grasp(str(rng.choice(free))),
            lambda: _touch(scene, str(rng.choice(free)), rng),
        ]
    return kinds[int(rng.integers(len(kinds)))]()


def _reach(scene: Scene, rng: np.random.Generator) -> Step:
    x, y = _spot(scene, rng)
    # The approach is level, or downwards.
    roll, pitch, yaw = rng.uniform((np.pi / 2, -np.pi / 4, -np.pi), (np.pi, np.pi / 4, np.pi))
    return Reach((x, y, float(rng.uniform(0.2, 1.4)), roll, pitch, yaw))


def _go(scene: Scene, rng: np.random.Generator) -> Step:
    x, y = _spot(scene, rng)
    return GoTo(
        float(x), float(y), float(rng.uniform(-np.pi, np.pi)) if rng.random() < 0.5 else None
    )


def _actuate(scene: Scene, name: str, rng: np.random.Generator) -> Step:
    """Move the joint between the base and an attachment's link to a random value."""
    item = scene.objects[name].object
    attachment = item.attachments[str(rng.choice(list(item.attachments)))]
    joint = item.model.frames[item.link_frame(attachment.link)].parentJoint
    while item.model.parents[joint]:
        joint = item.model.parents[joint]
    index = item.coordinates.joints.index(joint)
    value = float(rng.uniform(item.lower[index], item.upper[index]))
    return Actuate(name, {item.coordinates.names[index]: round(value, 3)}, attachment.name)


def _place(scene: Scene, name: str, rng: np.random.Generator) -> Step:
    """Put an object on the floor or on an obstacle."""
    placed = scene.objects[name]
    below = min(
        compute_world_box(shape.geometry, shape.placement)[0][2]
        for shape in make_world_shapes(placed)
    )
    shapes = zip(scene.obstacles, scene.obstacle_labels, strict=True)
    boxes = [
        compute_world_box(shape.geometry, shape.placement)
        for shape, label in shapes
        if label != FLOOR
    ]
    tops = [
        (low, high) for low, high in boxes if 0.3 < high[2] < 1.3 and min(high[:2] - low[:2]) > 0.2
    ]
    if tops and rng.random() < 0.8:
        low, high = tops[int(rng.integers(len(tops)))]
        x, y, height = *rng.uniform(low[:2], high[:2]), high[2]
    else:
        x, y, height = *_spot(scene, rng), 0.0
    z = height + placed.placement.translation[2] - below + _AIR
    # The tops of boxes around shapes need not hold anything.
    return Place(name, (float(x), float(y), float(z)), unsupported=True)


def _touch(scene: Scene, name: str, rng: np.random.Generator) -> Step:
    item = scene.objects[name].object
    links = [str(frame.name) for frame in item.model.frames if frame.type == pin.FrameType.BODY]
    x, y = _spot(scene, rng)
    return Touch(f"{name}.{links[-1]}", (float(x), float(y), float(rng.uniform(0.1, 1.2))))


def run(
    *,
    out: str | Path,
    problems: int = 100,
    seed: int = 0,
    of: str = "anything",
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        problems: Number of problems, at least 1.
        seed: Random seed of problems and planning.
        of: "anything" for random steps, feasible or not; "rooms" for `random_task`.
    """
    runner.check_positive(problems=problems)
    check_choice(of, OF, "set of problems", "of")
    settings = {
        "benchmark": "random" if of == OF[0] else of,
        "seed": seed,
        "problems": problems,
        **_LIMITS,
    }
    specs = [
        {"key": f"{number:05d}", "number": number, "seed": seed, "of": of}
        for number in range(problems)
    ]
    function = functools.partial(_record, folder=str(Path(out) / "plans"))
    return runner.run(
        specs, function, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    rows = []
    statuses = sorted({record["status"] for record in records} - {"success"})
    for kind in (*sorted({record["kind"] for record in records if "kind" in record}), "all"):
        own = records if kind == "all" else select(records, kind=kind)
        counts = [str(len(select(own, status=status))) for status in ("success", *statuses)]
        times = map(format_decimal, distribution(own, "planning_time"))
        rows.append([kind, str(len(own)), *counts, *times])
    rooms = about["benchmark"] == "rooms"
    head = ["kind", "problems", "success", *statuses, "time, median [s]", "95th percentile [s]"]
    return join_sections(
        about,
        "# Random rooms, one task each" if rooms else "# Random problems",
        f"{about['problems']} problems, seed {about['seed']}, {describe_limit(about)} each. "
        f"{'' if rooms else 'Some of them are infeasible. '}{JUDGED}",
        format_table(head, rows),
        "## Every trial",
        tabulate_trials(records),
    )


def _in_a_room(seed: int, number: int) -> Problem:
    """Return a task in a random room, whose kind is that of the moved object."""
    scene, steps = random_task(seed * _ROOMS + number)
    name = steps[0].object if isinstance(steps[0], Actuate | Grasp) else ""
    kind = scene.objects[name].object.name
    return Problem(number, f"{scene.name}: {type(steps[0]).__name__} {name}", kind, scene, steps)


def _record(spec: dict[str, Any], *, folder: str) -> dict[str, Any]:
    number = spec["number"]
    seed = spec["seed"]
    own = sample_problem(seed, number) if spec["of"] == OF[0] else _in_a_room(seed, number)
    found = plan(own.scene, own.steps, seed=seed, **_LIMITS)
    if found.status != "interrupted":
        Path(folder).mkdir(parents=True, exist_ok=True)
        found.save(Path(folder) / f"{spec['key']}.npz")
    return trial(found, method="VKC", seed=seed, number=number, problem=own.name, kind=own.kind)
