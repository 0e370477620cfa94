"""Puts a robot and an articulated object into a hall."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.importing.proposals.proposal import Proposals
from vkc_pin.importing.proposals.propose import propose_attachments
from vkc_pin.options import Options
from vkc_pin.planning.diagnosis.diagnosis import diagnose_goals
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.procedural.furniture.catalogue import KINDS, random_object
from vkc_pin.procedural.rooms import parts
from vkc_pin.procedural.rooms.fixtures import RANDOM, Counter, Fixture, make_fixture
from vkc_pin.procedural.rooms.footprints import Floor
from vkc_pin.procedural.tasks import goals
from vkc_pin.utils.cache import Cache
from vkc_pin.world.files.documents import read_yaml
from vkc_pin.world.files.resources import find_file, find_resource_folder, list_resources
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate

__all__ = [
    "OBJECTS",
    "ROBOTS",
    "SHARE",
    "Pair",
    "get_kind",
    "load_description",
    "make_hall",
    "make_pair",
]

ROBOTS = (
    "husky_ur5e",
    "panda",
    "tiago_pro",
    "pr2",
    "kinova",
    "ur5_gripper",
    "ur3_gripper",
    "tiago",
    "tiago_dual",
    "baxter",
)
"""Mobile manipulators, and arms on the virtual base, by names of `load_robot`."""
OBJECTS = (
    *(f"{kind}_{number}" for kind in KINDS for number in range(2)),
    *(
        "door",
        "narrow_door",
        "wide_door",
        "drawer",
        "low_drawer",
        "counter_drawer",
        "cabinet",
        "dishwasher",
        "refrigerator",
    ),
)
"""Two of every kind of `random_object`, as `<kind>_<seed>`, and those in scenes/objects."""
SHARE = 0.5
"""Of a joint's range by which it is opened: the middle of what `random_task` draws."""

_IT = "it"  # name of the object in its hall
_SIZE, _HEIGHT = 8.0, 2.4  # inner length of the walls, and their height [m]
_FRONT = 3.0  # depth of the floor before the object that stays free [m]
_BEYOND = 2.0  # of floor beyond a wall with a door [m]
_START: Mapping[str, Any] = {
    "x": [-2.0, 1.0],
    "y": [-2.0, 2.0],
}  # the object is at x = 4 m at most; any heading
_LOW, _COUNTER = (
    0.6,
    0.8,
)  # [m]: objects below the one stand on a counter of the other height
_DEPTH, _BESIDE, _MARGIN, _AIR = (
    0.5,
    0.2,
    0.03,
    0.001,
)  # [m] of the counter: depth, margins beside, before and behind the object, height
_OF_KIND = re.compile(r"(?P<kind>[a-z]+)_(?P<seed>\d+)")
_SAME = 1e-6  # [rad] or [m]


@dataclass(frozen=True, eq=False)
class Pair:
    """A robot, an object and the step to plan.

    Attributes:
        scene: Their hall; None if the robot has no hand.
        step: Step to plan; None if the object cannot be opened so far.
        because: Reason without a step.
    """

    scene: Scene | None
    step: Actuate | None
    because: str = ""


def get_kind(name: str) -> str:
    """Return the kind of an object: the last word of its name without number."""
    last = re.sub(r"_\d+$", "", Path(name).stem).rpartition("_")[2]
    return "drawers" if last == "drawer" else last


def load_description(name: str) -> dict[str, Any]:
    """Return the description of an object with absolute paths.

    Args:
        name: `<kind>_<seed>` of `random_object`, a name in scenes/objects, or a description file.

    Raises:
        InputError: There is no such object, or the description cannot be read.
    """
    match = _of_kind(name)
    if match:
        return random_object(*match)
    stored = list_resources("scenes", "objects/*.yaml")
    if name not in stored and not _is_path(name):
        raise UnknownNameError("object", name, [*OBJECTS, *stored], field="objects")
    file = find_file(name, "scenes", "objects/*.yaml", noun="object")
    data = read_yaml(file).data
    if not isinstance(data, dict) or not isinstance(data.get("urdf"), str):
        raise InputError(
            "not an object", file=file, field="urdf", expected="the path or text of a URDF"
        )
    plain = data["urdf"].lstrip().startswith("<")
    return data if plain else {**data, "urdf": str((file.parent / data["urdf"]).resolve())}


def make_hall(robot: str, name: str, description: Mapping[str, Any]) -> Scene:
    """Return a hall with a robot and an object, against a wall, in it, or on a counter."""
    match, floor = _of_kind(name), Floor(_SIZE, _SIZE)
    own = make_fixture(RANDOM + match[0], match[1]) if match else make_fixture(name)
    if _is_path(name) and own.high[2] - own.low[2] < _LOW:
        own = _on_a_counter(own)
    part = parts.make_openable(_IT, own, floor, 0, 0.0, _FRONT)
    (entry,) = part.objects
    half = _SIZE / 2.0
    document = {
        "name": f"{Path(name).stem.replace('.', '_')}_hall",
        "robot": robot,
        "start": {"base": [0.0, 0.0, 0.0]},
        "arena": {"x": [-half, half + (_BEYOND if own.in_wall else 0.0)], "y": [-half, half]},
        "start_region": dict(_START),
        "obstacles": [*parts.make_walls(floor, _HEIGHT, [part]), *part.obstacles],
        "objects": [{**entry, "type": dict(description)}],
    }
    return Scene.from_document(document, find_resource_folder("scenes"))


def make_pair(robot: Robot, called: str, name: str, *, seed: int = 0) -> Pair:
    """Return the step that opens an object by proposed attachments.

    The first attachment is the best one that the hand reaches, closed and open; planning may choose
    others of the same joint.

    Args:
        robot: Robot.
        called: Its name, or the path of its file.
        name: Object; see `load_description`.
        seed: Random seed of configurations.
    """
    try:
        make_hand(robot)
    except InputError as error:
        return Pair(None, None, str(error))
    description = load_description(name)
    proposals = propose_attachments(load_object(description), robot)
    taken = [proposal.description() for proposal in proposals.found]
    scene = make_hall(called, name, {**description, "attachments": taken})
    asked = _find_opening_steps(scene, proposals)
    if not asked:
        return Pair(scene, None, _why_not(proposals))
    cache, said = Cache(), list[str]()
    for step in asked:
        blocked = _explain_blocked(scene, step, seed, cache)
        if blocked is not None:
            said.append(f"{step.attachment}: {blocked}")
            continue
        first = str(step.attachment)
        others = [
            str(other.attachment)
            for other in asked
            if other.joints == step.joints and other.attachment != first
        ]
        entries = {entry["name"]: entry for entry in taken}
        left = [entries[attachment] for attachment in (first, *others)]
        return Pair(
            make_hall(called, name, {**description, "attachments": left}), Actuate(_IT, step.joints)
        )
    return Pair(scene, None, "; ".join(said))


def _explain_blocked(scene: Scene, step: Actuate, seed: int, cache: Cache) -> str | None:
    """Return why no free configuration exists at the end of a phase; None if there is one."""
    options = Options()
    problem = TrajectoryProblem(
        scene, compile_task(scene, [step], options), options, (), cache=cache
    )
    return next((goal.text for goal in diagnose_goals(problem, seed)), None)


def _find_opening_steps(scene: Scene, proposals: Proposals) -> list[Actuate]:
    """Return the steps that open a joint on the base, best attachment first."""
    placed = scene.objects[_IT]
    goal = {
        joint: value
        for step in goals(scene, share=SHARE)
        if isinstance(step, Actuate)
        for joint, value in step.joints.items()
    }
    steps = []
    for proposal in proposals.found:
        for joint in goal.keys() & proposal.opens.keys() if not proposal.when else ():
            now = placed.state[placed.object.coordinates.index(joint)]
            if np.sign(goal[joint] - now) * (proposal.opens[joint] - goal[joint]) >= -_SAME:
                steps.append(Actuate(_IT, {joint: goal[joint]}, proposal.attachment.name))
    return steps


def _why_not(proposals: Proposals) -> str:
    """Return what obstructs all hands, and how far the proposals open."""
    said = [f"{joint}: {reason}" for joint, reason in proposals.because.items()]
    for proposal in proposals.found:
        ends = [f"{joint} at {value:.3g}" for joint, value in proposal.opens.items()]
        ends += [f"{joint} must be at {value:.3g} before" for joint, value in proposal.when.items()]
        said.append(f"{proposal.attachment.name} ends with {', '.join(ends)}")
    return "; ".join(said) or "nothing of it is to be opened"


def _on_a_counter(own: Fixture) -> Fixture:
    """Return a low object on a counter that is deep enough for it."""
    setback = round(float(-own.low[0]) + _MARGIN, 3)
    depth, width = (
        max(_DEPTH, setback + float(own.high[0]) + _MARGIN),
        float(own.high[1] - own.low[1]) + 2.0 * _BESIDE,
    )
    counter = Counter((round(depth, 2), round(width, 2), _COUNTER), setback)
    return replace(own, counter=counter, lift=own.lift + _AIR)


def _of_kind(name: str) -> tuple[str, int] | None:
    """Return kind and seed of a random object, None for others."""
    match = _OF_KIND.fullmatch(name)
    return (match["kind"], int(match["seed"])) if match and match["kind"] in KINDS else None


def _is_path(name: str) -> bool:
    return name.endswith((".yaml", ".yml")) or "/" in name
