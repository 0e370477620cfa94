"""Scenes: a robot, where it starts, and the obstacles and articulated objects around it."""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError, shown
from vkc_pin.utils.arguments import instance, is_number, known, mapping, numbers
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.notebook import show
from vkc_pin.world.files.resources import file_path, located
from vkc_pin.world.models.shapes import clamp_to_limits, compute_clearance, list_placed_shapes
from vkc_pin.world.scene.clearance_exemptions import warn_of_overlaps
from vkc_pin.world.scene.hold import (
    Hold,
    find_reversed_approaches,
    make_holds,
    place_held_objects,
    resolve_holds,
    warn_of_openings,
)
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.poses import as_placement

if TYPE_CHECKING:
    from vkc_pin.world.models.robot import Robot
    from vkc_pin.world.scene.scene_schema import RegionSchema, SceneSchema

__all__ = ["START_CLEARANCE", "Scene", "load_scene"]

START_CLEARANCE = 0.03
"""Random starts keep the robot at least this far from everything but the floor [m]."""
_TRIES = 2000  # random starts that may be in the way of something


@dataclass(frozen=True, eq=False)
class Scene:
    """A robot and the world around it; immutable, the `with_` methods return changed copies.

    Attributes:
        name: Its name.
        file: The file it came from, if any.
        folder: The folder that relative paths in `document` start from.
        robot: The robot.
        start: Where it starts: base x, y [m], yaw [rad], then the arm joints [rad], shape (n,).
        objects: Name → articulated object. One that is free and held stands where the robot's hand
            holds it.
        obstacles: What does not move, as convex shapes: parent joint 0, placement in the world
            frame, colour set. An obstacle of one shape has its name, one of several shapes
            `<name>_<number>`. The floor is among them.
        obstacle_labels: For each of these shapes, the name of its obstacle (`FLOOR` for the floor).
        obstacle_names: The obstacles' names in the order of the file, without the floor.
        obstacle_visual: What to draw of the obstacles, without the floor.
        floor: Whether there is a floor at z = 0.
        arena: The floor that belongs to the scene: (x_min, x_max, y_min, y_max) [m].
        start_region: Where `sample_start` draws from, if the scene says so.
        holds: What the robot holds at the start, each hold after the one it depends on.
        allowed: Pairs of links, by label, that may be close, and what they must keep: a margin [m],
            or -inf if nothing.
        opening: How far the gripper is open at the start, unless it holds something [m]; None: as
            the robot rests.
        described: What it was made of; `document` takes from it what cannot be told from the rest:
            robot, obstacles, files.
        memory: What was found out about it and serves what the `with_` methods return; makes no
            difference to anything but time.
    """

    name: str
    file: Path | None
    folder: Path
    robot: Robot
    start: Floats
    objects: Mapping[str, PlacedObject]
    obstacles: tuple[pin.GeometryObject, ...]
    obstacle_labels: tuple[str, ...]
    obstacle_names: tuple[str, ...]
    obstacle_visual: tuple[pin.GeometryObject, ...]
    floor: bool
    arena: tuple[float, float, float, float]
    start_region: RegionSchema | None
    holds: tuple[Hold, ...]
    allowed: Mapping[frozenset[str], float]
    described: SceneSchema
    opening: float | None = None
    memory: dict[Any, Any] = dataclasses.field(default_factory=dict, init=False, repr=False)

    def __repr__(self) -> str:
        return (
            f"<Scene {self.name}: {self.robot.name}, objects {', '.join(self.objects) or 'none'}, "
            f"{len(self.obstacle_names)} obstacles>"
        )

    def _repr_html_(self) -> str:
        return show(self)

    @property
    def held(self) -> dict[str, str]:
        """Object → attachment of what the robot holds at the start."""
        return {hold.object: hold.attachment for hold in self.holds}

    @property
    def document(self) -> dict[str, Any]:
        """The scene as plain data, from which `from_document` builds it again; made when asked for."""
        from vkc_pin.world.scene.scene_file import make_document

        return make_document(vars(self))

    @staticmethod
    def from_document(document: Mapping[str, Any], folder: str | Path = ".") -> Scene:
        """Build a scene from plain data (see `Scene.document` and the scene files).

        Args:
            document: Dictionaries, lists, text and numbers.
            folder: The folder that relative paths in it start from.

        Raises:
            InputError: It does not fit; `UnknownNameError` where a name does not exist.
        """
        from vkc_pin.world.files.documents import Document
        from vkc_pin.world.scene.scene_file import make_scene_fields

        fields = make_scene_fields(
            Document(mapping(document, "document")), file_path(folder, "folder")
        )
        return _checked(Scene(**fields)._with())

    def with_start(self, base: ArrayLike | None = None, arm: ArrayLike | None = None) -> Scene:
        """Return the scene with another start.

        Args:
            base: x, y [m] and yaw [rad] in the world frame, shape (3,); None keeps it.
            arm: Arm joints [rad], shape (n - 3,); None keeps them.

        Raises:
            InputError: Wrong size, a value that is not finite, outside a joint's limits or outside
                the arena.
        """
        start, names = self.start.copy(), self.robot.coordinates.names
        for part_name, values, part in (("base", base, slice(0, 3)), ("arm", arm, slice(3, None))):
            if values is None:
                continue
            given = numbers(values, part_name)
            if given.shape != start[part].shape:
                raise InputError(
                    "wrong number of values",
                    field=part_name,
                    expected=start[part].shape,
                    got=given.shape,
                )
            lower, upper = (limits[part] for limits in self.robot.start_limits)
            start[part] = [
                clamp_to_limits(value, low, high, f"{part_name}.{name}")
                for value, low, high, name in zip(given, lower, upper, names[part], strict=True)
            ]
        for value, low, high, name in zip(
            start[:2], self.arena[::2], self.arena[1::2], names[:2], strict=True
        ):
            if not low <= value <= high:
                raise InputError(
                    "outside the arena",
                    field=f"base.{name}",
                    expected=f"{low:g} to {high:g}",
                    got=f"{value:g}",
                )
        return self._with(start=start)

    def with_state(self, name: str, values: Mapping[str, float]) -> Scene:
        """Return the scene with joints of object `name` at `values`, by joint name, [rad] or [m].

        Raises:
            UnknownNameError: There is no such object, or it has no such joint.
            InputError: A value is not finite or outside the joint's limits.
        """
        return self._with(
            objects=MappingProxyType({**self.objects, name: self._placed(name).with_state(values)})
        )

    def with_placement(self, name: str, placement: pin.SE3) -> Scene:
        """Return the scene with object `name` at `placement` (of its base link, in the world frame); see `as_placement`.

        Raises:
            UnknownNameError: There is no such object.
            InputError: `placement` is no pose.
        """
        placed = dataclasses.replace(
            self._placed(name), placement=as_placement(placement, name="placement")
        )
        return self._with(objects=MappingProxyType({**self.objects, name: placed}))

    def with_held(
        self,
        held: Mapping[str, str] | Iterable[Hold],
        *,
        by: Mapping[str, str] | None = None,
        at: Mapping[str, Sequence[float]] | None = None,
    ) -> Scene:
        """Return the scene with the robot holding objects at the start.

        Args:
            held: Object → attachment; or holds, each after the one it depends on, which say all of
                it.
            by: Object → "<object>.<link>", for what is held through another object of `held`.
            at: Object → values of its attachment's freedoms, [m] and [rad]; zero where nothing is
                said.

        Raises:
            UnknownNameError: There is no such object, attachment or link.
            InputError: Values that do not fit the attachment's freedoms, or objects that hold each
                other.
        """
        holds = make_holds(held, by, at) if isinstance(held, Mapping) else held
        return self._with(holds=resolve_holds(self.objects, holds))

    def with_approaches(self, holds: Iterable[Hold], *, stacklevel: int = 2) -> Scene:
        """Return the scene with attachments reversed to which the hand would come out of the object or from below the floor.

        Each of them gives a warning. Those from whose other side it would be no better stay as they
        are.

        Args:
            holds: What is to be held, where and through what.
            stacklevel: Whose line the warnings name, as for `warnings.warn`.
        """
        floor = [
            shape
            for shape, label in zip(self.obstacles, self.obstacle_labels, strict=True)
            if label == FLOOR
        ]
        objects = dict(self.objects)
        for hold in find_reversed_approaches(
            self.objects, holds, self.robot, list_placed_shapes(floor)
        ):
            objects[hold.object] = objects[hold.object].with_reversed(hold.attachment)
            what = f"{hold.frame or 'the hand'} would come to {hold.object}.{hold.attachment}"
            text = f"{what} out of the object or from below the floor"
            hint = f"turn its approach, the frame, or say `reversed: [{hold.attachment}]` of the object"
            warnings.warn(
                f"{self.file or self.name}: {text}: it comes from the other side; {hint}",
                stacklevel=stacklevel,
            )
        return (
            self._with(objects=MappingProxyType(objects)) if objects != dict(self.objects) else self
        )

    def _placed(self, name: str) -> PlacedObject:
        return self.objects[known(name, self.objects, "object")]

    def _with(self, **fields: Any) -> Scene:
        """Return the scene with other attributes, and every free object that is held where the robot then holds it."""
        changed = dataclasses.replace(self, **fields)
        changed = dataclasses.replace(
            changed,
            objects=place_held_objects(changed.objects, changed.tool_placement, changed.holds),
        )
        object.__setattr__(
            changed, "memory", self.memory
        )  # other copies begin anew: their obstacles may be others
        return changed

    def tool_placement(self) -> pin.SE3:
        """Return the placement of the robot's tool frame in the world frame at the start."""
        model = self.robot.model
        data = model.createData()
        pin.framesForwardKinematics(model, data, self.robot.coordinates.q(self.start))
        return data.oMf[model.getFrameId(self.robot.tool_frame)].copy()

    def start_clearance(self, *, reach: float = np.inf) -> float:
        """Return the smallest distance [m] at the start between the robot, with what it carries, and the world.

        The floor does not count, nor do the robot's distances to itself and to what it holds.

        Args:
            reach: Distances above this do not matter [m]: the result is then some number ≥ `reach`.
        """
        if not is_number(reach) or reach != reach:
            raise InputError(
                "not a number", field="reach", expected="a distance [m]", got=shown(reach)
            )
        reach = float(min(reach, 1e300))
        model, geometry = (
            self.robot.model,
            self.robot.opened(self.robot.opening(self.opening)).collision,
        )
        data, shapes = model.createData(), geometry.createData()
        pin.updateGeometryPlacements(
            model, data, geometry, shapes, self.robot.coordinates.q(self.start)
        )
        moving = [
            (shape.geometry, where)
            for shape, where in zip(geometry.geometryObjects, shapes.oMg, strict=True)
        ]
        standing = [
            shape
            for shape, label in zip(self.obstacles, self.obstacle_labels, strict=True)
            if label != FLOOR
        ]
        for name, placed in self.objects.items():
            if name not in self.held:
                standing += make_world_shapes(placed)
            elif placed.object.free:
                moving += list_placed_shapes(make_world_shapes(placed))
        return compute_clearance(moving, list_placed_shapes(standing), reach=reach)

    def sample_start(self, rng: np.random.Generator) -> Scene:
        """Return the scene with the base at a random place of its start region, clear of everything.

        The base's x, y and heading are uniform in the region; places where `start_clearance` is
        below `START_CLEARANCE` are drawn again.

        Args:
            rng: Where the random numbers come from; the same state gives the same start.

        Raises:
            InputError: The scene has no start region, the robot holds something that stands fixed
                in the world, or no free place was found.
        """
        instance(rng, np.random.Generator, "rng")
        region, file = self.start_region, self.file
        if region is None:
            raise InputError(
                "the scene has no start region",
                file=file,
                field="start_region",
                expected="x and y intervals",
            )
        for name in self.held:
            if not self.objects[name].object.free:
                raise InputError(
                    "the robot cannot start elsewhere while it holds this",
                    file=file,
                    field=f"start.held.{name}",
                )
        for base in itertools.islice(region.draws(rng), _TRIES):
            there = self.with_start(base=base)
            if there.start_clearance(reach=START_CLEARANCE) >= START_CLEARANCE:
                return there
        problem = f"no free place for the robot in {_TRIES} tries"
        raise InputError(
            problem,
            file=file,
            field="start_region",
            expected=f"a clearance of {START_CLEARANCE} m somewhere",
        )


def load_scene(name_or_path: str | Path) -> Scene:
    """Load a scene: by the name of a file in `scenes`, or by the path of a scene file (.yaml).

    What can move and stands in something else gives a warning.

    Raises:
        UnknownNameError: There is no such scene, or it names something that does not exist.
        InputError: Something in the file is wrong; the error says what, in which file, line and
            field.
    """
    from vkc_pin.world.files.documents import read_yaml
    from vkc_pin.world.scene.scene_file import make_scene_fields

    file = located(name_or_path, "scenes", "*.yaml", what="scene")
    return _checked(Scene(**make_scene_fields(read_yaml(file), file.parent))._with())


def _checked(scene: Scene) -> Scene:
    """Return a scene that was made of a description; warn of what that may not have meant."""
    warn_of_overlaps(scene, str(scene.file or scene.name))
    warn_of_openings(scene.objects, scene.robot, scene.opening, str(scene.file or scene.name))
    unsaid = [
        item.name
        for item in scene.described.objects
        if item.reversed is None and item.name not in scene.held
    ]
    holds = (
        Hold(name, attachment)
        for name in unsaid
        for attachment in scene.objects[name].object.attachments
    )
    return scene.with_approaches(holds, stacklevel=4)
