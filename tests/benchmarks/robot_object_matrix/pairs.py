"""Prepares robots and articulated objects, and puts one of each into a hall."""

from __future__ import annotations

import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.objects.object_import import ImportedObject, import_object
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.importing.proposals.proposal import Proposals
from vkc_pin.importing.proposals.propose import propose_attachments
from vkc_pin.importing.robots.robot_import import import_robot
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
from vkc_pin.world.files.writing import check_name, write_atomically, write_folder_atomically
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import find_robot, list_robots, load_robot
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate

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
_SIZE = 8.0  # [m] inner length of the walls
_HEIGHT = 2.4  # [m] of the walls
_FRONT = 3.0  # depth of the floor before the object that stays free [m]
_BEYOND = 2.0  # of floor beyond a wall with a door [m]
# [m]; the object is at x = 4 m at most, and any heading is allowed.
_START: Mapping[str, Any] = {"x": [-2.0, 1.0], "y": [-2.0, 2.0]}
_LOW = 0.6  # [m] height below which objects stand on a counter
_COUNTER = 0.8  # [m] height of the counter
_DEPTH = 0.5  # [m] of the counter
_BESIDE = 0.2  # [m] of the counter beside the object
_MARGIN = 0.03  # [m] of the counter before and behind the object
_AIR = 0.001  # [m] between counter and object
_OF_KIND = re.compile(r"(?P<kind>[a-z]+)_(?P<seed>\d+)")
_SAME = 1e-6  # [rad] or [m]
DEFAULT = "default"
"""The word that stands for all names that are there by default."""
_GIVEN = re.compile(r"(?:(?P<called>[A-Za-z]\w*)=)?(?P<path>[^#]+)(?:#(?P<link>.+))?")
_FILES = (".urdf", ".xml", ".mjcf", ".sdf")
_SAMPLES = 1000  # for pairs that need no check, as of robots that are loaded without an SRDF
_LEVEL = 0.5  # cosine of how steep an approach may be that tells where the front is


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
    match = _of_kind(name)
    floor = Floor(_SIZE, _SIZE)
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
    cache = Cache()
    said = list[str]()
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
    depth = max(_DEPTH, setback + float(own.high[0]) + _MARGIN)
    width = float(own.high[1] - own.low[1]) + 2.0 * _BESIDE
    counter = Counter((round(depth, 2), round(width, 2), _COUNTER), setback)
    return replace(own, counter=counter, lift=own.lift + _AIR)


def _of_kind(name: str) -> tuple[str, int] | None:
    """Return kind and seed of a random object, None for others."""
    match = _OF_KIND.fullmatch(name)
    return (match["kind"], int(match["seed"])) if match and match["kind"] in KINDS else None


def _is_path(name: str) -> bool:
    return name.endswith((".yaml", ".yml")) or "/" in name


@dataclass(frozen=True)
class Request:
    """A requested robot or object.

    Attributes:
        called: Displayed name.
        path: Name, or path of a file or folder.
        link: Link of an object's file that is imported alone; None for all of it.
    """

    called: str
    path: str
    link: str | None = None

    @property
    def is_imported(self) -> bool:
        """Whether it is a file to import."""
        return self.path.lower().endswith(_FILES)


def parse_requests(texts: Sequence[str], field: str, default: Sequence[str]) -> list[Request]:
    """Parse requests: names and paths, each plain or as "name=...", with "#link" for one link.

    Args:
        texts: Requests.
        field: Name of the argument, for errors.
        default: Names that "default" stands for.

    Raises:
        InputError: A request is malformed, or there are none or two of one name.
    """
    found = list[Request]()
    for text in (one for given in texts for one in (default if given == DEFAULT else [str(given)])):
        match = _GIVEN.fullmatch(text)
        if match is None:
            raise InputError(
                "not a choice",
                field=field,
                expected="a name, a path, name=path or name=path#link",
                got=text,
            )
        called = match["called"]
        path = match["path"]
        link = match["link"]
        found.append(Request(called or link or _name(path), path, link))
    names = [one.called for one in found]
    if not names or len(set(names)) < len(names):
        raise InputError(
            "not a choice",
            field=field,
            expected="names, each once",
            got=" ".join(map(str, texts)) or "none",
        )
    return found


def prepare_robot(one: Request, folder: Path) -> str:
    """Return name or absolute path of a robot, imported into `folder` if its hand is unknown.

    Raises:
        InputError: There is no such robot, it cannot be imported, or its name is no file name.
    """
    mjcf = one.path.lower().endswith((".xml", ".mjcf"))
    made = folder / check_name(one.called, "robots")
    file = Path(one.path) if mjcf else find_robot(one.path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the doctor's report has them
        if not (made / "robot.yaml").is_file():
            if not mjcf and load_robot(one.path).touch_links:
                return one.path if one.path in list_robots() else str(file.resolve())
            import_robot(file, made, samples=_SAMPLES)
    return str(made.resolve())


def prepare_object(one: Request, folder: Path) -> str:
    """Return name or description file of an object; files are imported, their fronts towards -x.

    Raises:
        InputError: There is no such object, it cannot be imported, or its name is no file name.
    """
    if not one.is_imported:
        if one.link is not None:
            raise InputError(
                "only a link of a file can be imported",
                field="objects",
                expected=" ".join(_FILES),
                got=one.path,
            )
        load_description(one.path)
        return one.path
    name = check_name(one.called, "objects")
    made = folder / name / f"{name}.yaml"
    if not made.is_file():
        with write_folder_atomically(made.parent, force=True) as staging, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the report lists omissions
            imported = import_object(one.path, staging / "as_it_was", link=one.link)
            _face(imported)
            for file in (staging / "as_it_was").iterdir():
                file.rename(staging / (made.name if file == imported.file else file.name))
            (staging / "as_it_was").rmdir()
    return str(made)


def _name(path: str) -> str:
    """Return the default name: that of the file, or of its folder for robot.yaml."""
    file = Path(path) / "robot.yaml" if Path(path).is_dir() else Path(path)
    return (
        file.resolve().parent.name
        if file.name == "robot.yaml"
        else file.stem
        if len(file.parts) > 1 or file.suffix
        else path
    )


def _face(imported: ImportedObject) -> None:
    """Turn an object by quarter turns so that the best proposed hand approaches along x."""
    if not imported.proposals.found:
        return
    item = imported.proposals.object
    best = imported.proposals.found[0].attachment
    closed = np.clip(0.0, item.lower, item.upper)
    x, y, _ = (item.link_placement(best.link, closed) * best.placement).rotation[:, 2].tolist()
    quarters = round(-float(np.arctan2(y, x)) / (np.pi / 2.0)) % 4
    if np.hypot(x, y) < _LEVEL or not quarters:
        return
    file = imported.file.with_suffix(".urdf")
    root = ElementTree.parse(file).getroot()
    front = "front"
    while root.find(f"link[@name='{front}']") is not None:
        front += "_"
    link = ElementTree.Element("link", name=front)
    joint = ElementTree.Element("joint", name=front, type="fixed")
    ElementTree.SubElement(joint, "parent", link=front)
    ElementTree.SubElement(joint, "child", link=item.base_link)
    ElementTree.SubElement(joint, "origin", xyz="0 0 0", rpy=f"0 0 {quarters * np.pi / 2.0:.12g}")
    root.insert(0, link)
    root.append(joint)
    write_atomically(file, ElementTree.tostring(root, encoding="utf-8"))
