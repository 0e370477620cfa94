"""Defines recipes of datasets and their terms; a recipe and a number determine an episode."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.options import Options
from vkc_pin.procedural.rooms.fixtures import list_openable_types
from vkc_pin.procedural.rooms.parts import CARRIED
from vkc_pin.procedural.rooms.random_room import RoomSettings
from vkc_pin.utils.arguments import check_choice, check_mapping
from vkc_pin.world.files.documents import Document, parse_document, read_yaml
from vkc_pin.world.files.fields import (
    Name,
    NonNegative,
    Number,
    Positive,
    Schema,
    Vector3,
    require,
    require_length,
    wrap_text,
)
from vkc_pin.world.files.resources import find_file, list_resources
from vkc_pin.world.models.camera import BASE, HAND, Camera, resolve_frame
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import find_robot
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.terms import (
    Constraint,
    State,
    Term,
    rename_term,
    term_from_dict,
    term_to_dict,
    trace_terms_without_scene,
)

OBJECT = "object"
"""Frame of the grasped link, and the grasped object in `holding`."""
TASKS = ("given-open", "drive-open", "fetch-place")
"""Tasks of episodes: open an object from a given grasp, drive there and open it, or move an object
to another table."""

# Conditions of fields.
_has_length = require(
    lambda value: math.hypot(*value) > 0.0, "no direction", "an axis of some length"
)
_is_increasing = require(
    lambda value: value[0] <= value[1], "the interval is empty", "[lowest, highest]"
)
_is_share = require(
    lambda value: value[0] > 0.0 and value[1] <= 1.0, "out of range", "shares above 0 and up to 1"
)
_is_given = require(lambda value: value, "there is nothing", "at least one")

Axis = Annotated[Vector3, _has_length]
Size = Annotated[tuple[Positive, Positive, Positive], require_length(3)]
Interval = Annotated[tuple[Number, Number], require_length(2), _is_increasing]
Share = Annotated[Interval, _is_share]
Distances = Annotated[tuple[NonNegative, NonNegative], require_length(2), _is_increasing]
Whole = Annotated[int, Field(strict=True, ge=1, le=10**9)]
# attempts of a process at a time
Several = Annotated[int, Field(strict=True, ge=1, le=1000)]
Pixels = Annotated[int, Field(strict=True, ge=8, le=2048)]
Names = Annotated[tuple[str, ...], _is_given]
CAMERAS = (
    {
        "name": "head",
        "frame": BASE,
        "position": [0.0, 0.0, 1.5],
        "target": [1.2, 0.0, 0.6],
        "fov": 90.0,
    },
    {
        "name": "wrist",
        "frame": HAND,
        "position": [0, -0.12, -0.12],
        "target": [0, 0, 0.1],
        "up": [0, -1, 0],
        "fov": 75.0,
    },
)
"""Default cameras: one above the base, one beside the fingers."""


class _Entry(Schema):
    """A term: its name, and the tasks in which it holds; all if there are none."""

    name: str | None = None
    tasks: tuple[str, ...] = ()

    def term(self) -> Term:
        """Return the term with frames `BASE`, `HAND`, `OBJECT`, or frames by name."""
        raise NotImplementedError


class _FrameEntry(_Entry):
    """A term of one frame."""

    type: str
    frame: str = HAND
    held: bool = False

    @property
    def called(self) -> str:
        """Name in reports."""
        return self.name or f"{self.type} {self.frame}"

    @property
    def holding(self) -> str | None:
        """Object that must be grasped for it."""
        return OBJECT if self.held else None


class UprightSchema(_FrameEntry):
    """Limits the angle of a frame's axis from the vertical [rad]."""

    type: Literal["upright"]
    axis: Axis = (0.0, 0.0, 1.0)
    angle: Annotated[Positive, Field(lt=math.pi)] = 0.2

    def term(self) -> Term:
        """Return the constraint on the vertical component of the axis.

        With the frame's rotation R and the unit axis a it is (R a)_z, the cosine of the angle.
        """
        unit = [value / math.hypot(*self.axis) for value in self.axis]

        def compute_rise(s: State) -> Any:
            return sum(value * s.rotation(self.frame)[2, k] for k, value in enumerate(unit))

        lower = math.cos(self.angle)
        return Constraint(self.called, compute_rise, lower=lower, holding=self.holding)


class SpeedSchema(_FrameEntry):
    """Limits the speed of a frame's origin [m/s]."""

    type: Literal["speed"]
    most: Positive

    def term(self) -> Term:
        """Return the constraint on the speed."""

        def compute_speed(s: State) -> Any:
            velocity = s.velocity(self.frame)
            return (velocity.T @ velocity) ** 0.5

        return Constraint(self.called, compute_speed, upper=self.most, holding=self.holding)


class KeepOutSchema(_FrameEntry):
    """Keeps the origin of a frame out of a box in the world frame."""

    type: Literal["keep-out"]
    position: Vector3
    size: Size

    def term(self) -> Term:
        """Return the constraint on the largest distance outside along an axis of the box [m]."""

        def compute_distance(s: State) -> Any:
            point = s.position(self.frame)
            x, y, z = ((point[k] - self.position[k]).fabs() - self.size[k] / 2.0 for k in range(3))
            return x.fmax(y).fmax(z)

        return Constraint(self.called, compute_distance, lower=0.0, holding=self.holding)


class TracedSchema(_Entry):
    """A constraint or cost as recorded arithmetic operations."""

    type: Literal["traced"]
    traced: dict[str, Any]

    def term(self) -> Term:
        """Return the term."""
        return term_from_dict(self.traced)


TermSchema = Annotated[
    UprightSchema | SpeedSchema | KeepOutSchema | TracedSchema, Field(discriminator="type")
]
Entry = UprightSchema | SpeedSchema | KeepOutSchema | TracedSchema


def make_entries(terms: Sequence[Term]) -> list[dict[str, Any]]:
    """Return terms as plain entries of a recipe.

    Raises:
        InputError: They are no terms, or name phases, which are not known yet.
    """
    traced = trace_terms_without_scene(terms)
    for term in traced:
        if term.during is not None:
            expected = (
                f"holding={OBJECT!r}, or nothing: phases are called after objects that are drawn"
            )
            raise term.make_error("phases are not known yet", "during", expected, list(term.during))
    return [{"type": "traced", "traced": term_to_dict(term)} for term in traced]


def check_entries(document: Document, entries: Sequence[Entry], tasks: Sequence[str]) -> None:
    """Check the terms of a recipe.

    Raises:
        InputError: A term is wrong, or two have one name; the error names file, line and field.
    """
    names: list[str] = []
    for k, entry in enumerate(entries):
        for j, task in enumerate(entry.tasks):
            if task not in tasks:
                raise document.make_unknown_name_error(
                    ("terms", k, "tasks", j), "task", task, tasks
                )
        with document.annotate_errors(("terms", k)):
            (term,) = trace_terms_without_scene([entry.term()])
        if term.name in names:
            raise document.make_error(
                ("terms", k), "two terms of one name", expected="another `name`", got=term.name
            )
        names.append(term.name)


def check_robot(robot: Robot, terms: Sequence[Term]) -> None:
    """Check that a robot has the frames and coordinates of terms, except those of objects.

    Raises:
        UnknownNameError: It lacks one.
    """
    frames = sorted({BASE, HAND, OBJECT, *robot.frame_names})
    for term in terms:
        where = f"terms[{term.name!r}]"
        for frame in term.formula.frames:
            if "." not in frame:
                check_choice(frame, frames, f"frame of {robot.name}", where)
        for name in term.formula.coordinates:
            if "." not in name:
                check_choice(name, robot.coordinates.names, f"coordinate of {robot.name}", where)


def resolve_terms(
    terms: Sequence[Term], scene: Scene, name: str, attachment: str
) -> tuple[Term, ...]:
    """Return terms with the frames of a scene.

    Args:
        terms: Terms with `BASE`, `HAND` and `OBJECT`.
        scene: Scene.
        name: Object of the episode.
        attachment: Attachment that is grasped.
    """
    link = scene.objects[name].object.attachments[attachment].link
    frames = {
        BASE: resolve_frame(scene.robot, BASE),
        HAND: resolve_frame(scene.robot, HAND),
        OBJECT: f"{name}.{link}",
    }
    return tuple(rename_term(term, frames, {OBJECT: name}) for term in terms)


class RobotEntry(Schema):
    """A robot by name or path, and the height of its root link [m]; None for its default."""

    name: str
    height: Number | None = None


class RoomsSchema(Schema):
    """Random rooms: `count` numbers from `first`, or ever new ones, and ranges of their properties.

    `episodes` consecutive episodes share a room and a robot, to save time.
    """

    count: Whole | None = 50
    first: Annotated[int, Field(strict=True, ge=0, le=10**9)] = 0
    episodes: Several = 4
    objects: Annotated[int, Field(strict=True, ge=1, le=3)] = 2
    clutter: Interval = (0.0, 0.4)
    width: Interval = (5.5, 8.0)
    front: Number = 1.8


class StartSchema(Schema):
    """Ranges of the distance of the base from its goal and of arm joints from home [m, rad]."""

    distance: Distances = (0.0, 10.0)
    arm: NonNegative = 0.0


class GoalSchema(Schema):
    """Ranges of the share of a joint's range, and of the distance from a table's edge [m]."""

    share: Share = (0.35, 0.65)
    edge: Distances = (0.1, 0.3)


class CameraSchema(Schema):
    """A camera on the robot; see `Camera`."""

    name: Name
    frame: str = BASE
    position: Vector3
    target: Vector3
    up: Vector3 = (0.0, 0.0, 1.0)
    width: Pixels = 128
    height: Pixels = 128
    fov: Annotated[Positive, Field(lt=180.0)] = 60.0


Robots = Annotated[tuple[Annotated[RobotEntry, wrap_text("name")], ...], _is_given]


class RecipeSchema(Schema):
    """A recipe."""

    name: Name
    license: str = "CC-BY-4.0"
    robots: Robots = (RobotEntry(name="husky_ur5e"),)
    tasks: Annotated[tuple[Literal[TASKS], ...], _is_given] = TASKS  # type: ignore[valid-type]
    objects: Names = (
        "random_cabinet",
        "random_drawers",
        "random_dishwasher",
        "random_oven",
        "random_refrigerator",
        "random_door",
    )
    carried: Names = ("ball",)
    rooms: RoomsSchema = RoomsSchema()
    scenes: tuple[str, ...] = ()
    start: StartSchema = StartSchema()
    goal: GoalSchema = GoalSchema()
    grasps: Literal["freest", "any"] = "freest"
    options: dict[str, Any] = Field(default_factory=dict)
    max_evaluations: Whole = 100_000
    time_limit: Positive = 60.0
    variants: Several = 1
    rate: Annotated[Positive, Field(ge=0.01, le=1000.0)] = 10.0
    simulate: bool = False
    cameras: Annotated[tuple[CameraSchema, ...], Field(max_length=16)] = ()
    look: NonNegative = 0.0
    terms: tuple[TermSchema, ...] = ()


@dataclass(frozen=True)
class Recipe:
    """A recipe that was read and checked.

    Attributes:
        fields: Its fields, with defaults.
        options: How to plan.
    """

    fields: RecipeSchema
    options: Options

    @property
    def document(self) -> dict[str, Any]:
        """The recipe as plain data, which `load_recipe` accepts."""
        return self.fields.model_dump(mode="json")

    @property
    def digest(self) -> str:
        """Digest of all that determines the episodes."""
        content = self.document
        del content["name"]
        del content["license"]
        # Datasets of older versions, which did not know these fields, can be continued.
        for name in ("cameras", "look", "terms"):
            if not content[name]:
                del content[name]
        text = json.dumps(content, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Cameras that take images."""
        return tuple(Camera(**entry.model_dump()) for entry in self.fields.cameras)

    @functools.cached_property
    def terms(self) -> tuple[Term, ...]:
        """Additional constraints and costs."""
        return trace_terms_without_scene([entry.term() for entry in self.fields.terms])

    def select_terms(self, task: str) -> tuple[Term, ...]:
        """Return the terms of a task."""
        entries = zip(self.terms, self.fields.terms, strict=True)
        return tuple(term for term, entry in entries if not entry.tasks or task in entry.tasks)

    def rng(self, *words: object) -> np.random.Generator:
        """Return a random generator determined by the recipe and some words, such as a number."""
        text = "/".join([self.digest, *(str(word) for word in words)])
        digest = hashlib.sha256(text.encode()).digest()
        return np.random.default_rng(int.from_bytes(digest[:16], "little"))


def load_recipe(
    recipe: str | Path | Mapping[str, Any] | Recipe, *, find_files: bool = True, **changes: Any
) -> Recipe:
    """Load and check a recipe.

    Args:
        recipe: Name of a recipe of the package, path of a YAML file, or its contents.
        find_files: Whether files of robots, objects and scenes must exist. A dataset has copies,
            and needs them no more.
        changes: Fields to replace; None keeps them.

    Raises:
        UnknownNameError: It, or something that it names, does not exist.
        InputError: A field is wrong; the error names file, line and field.
    """
    changes = {name: value for name, value in changes.items() if value is not None}
    if isinstance(recipe, Recipe):
        document = Document(recipe.document)
    elif isinstance(recipe, Mapping):
        document = Document(check_mapping(recipe, "recipe", "fields of a recipe"))
    else:
        document = read_yaml(find_file(recipe, "scenes", "recipes/*.yaml", noun="recipe"))
    if isinstance(document.data, dict):
        document = Document({**document.data, **changes}, document.file, document.lines)
    fields = parse_document(document, RecipeSchema)
    found = _find_files(document, fields) if find_files else {}
    _check_fields(document, fields)
    options = _make_options(document, fields.options)
    return Recipe(fields.model_copy(update=found), options)


def _find_files(document: Document, fields: RecipeSchema) -> dict[str, Any]:
    """Return the fields with names of robots, objects and scenes, those of files as full paths."""
    folder = document.file.parent if document.file else Path()
    robots = _find_robots(document, fields.robots, folder)
    objects = [_find_object(document, k, name, folder) for k, name in enumerate(fields.objects)]
    scenes = [_find_scene(document, k, name, folder) for k, name in enumerate(fields.scenes)]
    return {"robots": robots, "objects": tuple(objects), "scenes": tuple(scenes)}


def _check_fields(document: Document, fields: RecipeSchema) -> None:
    """Check conditions that a schema cannot express."""
    for k, kind in enumerate(fields.carried):
        if kind not in CARRIED:
            raise document.make_unknown_name_error(
                ("carried", k), "object that is carried", kind, CARRIED
            )
    if fields.scenes and "fetch-place" in fields.tasks:
        expected = "random rooms, whose tables are known, or only given-open and drive-open"
        raise document.make_error(
            ("tasks",),
            "nothing says where to put things in scene files",
            expected=expected,
            got="fetch-place",
        )
    for k, camera in enumerate(fields.cameras):
        with document.annotate_errors(("cameras", k)):
            Camera(**camera.model_dump())
        if camera.name in [other.name for other in fields.cameras[:k]]:
            raise document.make_error(
                ("cameras", k, "name"),
                "two cameras of one name",
                expected="another name",
                got=camera.name,
            )
    check_entries(document, fields.terms, TASKS)
    if fields.cameras and not fields.simulate:
        expected = "`simulate: true` as well, or --simulate: images are of what happens in physics"
        raise document.make_error(
            ("cameras",), "nothing is simulated", expected=expected, got="cameras"
        )
    if fields.look and not fields.cameras:
        expected = "`cameras` as well, which look at the attachment"
        raise document.make_error(("look",), "nothing looks", expected=expected, got=fields.look)
    with document.annotate_errors(("rooms",)):
        least, most = fields.rooms.clutter
        RoomSettings(clutter=least, width=fields.rooms.width, front=fields.rooms.front)
        RoomSettings(clutter=most)


def _make_options(document: Document, given: Mapping[str, Any]) -> Options:
    """Make the options of planning; errors name the file."""
    for name in given:
        if name not in Options.__dataclass_fields__:
            raise document.make_unknown_name_error(
                ("options", name), "option", name, Options.__dataclass_fields__
            )
    try:
        return Options(**given)
    except InputError as error:
        name = (error.field or "").removeprefix("Options.")
        raise document.make_error(
            ("options", name), error.problem, expected=error.expected, got=error.got
        ) from error


def get_robot_name(name: str) -> str:
    """Return the name of a robot in a dataset: its name, or that of its file or folder."""
    path = Path(name)
    if len(path.parts) == 1:
        return name
    return path.parent.name if path.name == "robot.yaml" else path.stem


def is_path(name: str) -> bool:
    """Return whether a robot, object or scene is given by the path of its file."""
    return name.endswith((".yaml", ".yml", ".urdf")) or "/" in name


def _find_robots(
    document: Document, entries: Sequence[RobotEntry], folder: Path
) -> tuple[RobotEntry, ...]:
    """Return the entries, with the files of robots that are given by path."""
    sources: dict[str, str] = {}  # by the robots' names in the dataset
    robots: list[RobotEntry] = []
    for k, entry in enumerate(entries):
        path = folder / entry.name
        if is_path(entry.name) and not path.exists():
            raise document.make_error(
                ("robots", k),
                "there is no such file",
                expected="a URDF file, a robot.yaml, or a robot's name",
                got=path.resolve(),
            )
        robot = entry
        with document.annotate_errors(("robots", k)):
            if is_path(entry.name):
                file = find_robot(str(path.resolve()))
                robot = entry.model_copy(update={"name": str(file)})
            else:
                find_robot(entry.name)
        robots.append(robot)
        if sources.setdefault(get_robot_name(robot.name), robot.name) != robot.name:
            raise document.make_error(
                ("robots", k),
                "two robots of one name",
                expected="folders of different names",
                got=robot.name,
            )
    return tuple(robots)


def _find_object(document: Document, place: int, name: str, folder: Path) -> str:
    """Return the full path of an object's file, or the name of a generator."""
    if is_path(name):
        return _find_file(document, ("objects", place), folder / name)
    known = list_openable_types()
    if name not in known:
        raise document.make_unknown_name_error(("objects", place), "object that opens", name, known)
    return name


def _find_scene(document: Document, place: int, name: str, folder: Path) -> str:
    """Return the full path of a scene's file, or the name of a scene of the package."""
    if is_path(name):
        return _find_file(document, ("scenes", place), folder / name)
    known = list_resources("scenes", "*.yaml")
    if name not in known:
        raise UnknownNameError(
            "scene",
            name,
            known,
            file=document.file,
            line=document.find_line(("scenes", place)),
            field="scenes",
        )
    return name


def _find_file(document: Document, path: tuple[str | int, ...], file: Path) -> str:
    if not file.is_file():
        raise document.make_error(
            path, "there is no such file", expected="an existing file", got=file
        )
    return str(file.resolve())
