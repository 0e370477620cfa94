"""Defines scenes: a robot, its start, and the obstacles and articulated objects around it."""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.arguments import (
    check_array,
    check_choice,
    check_instance,
    check_mapping,
    is_number,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.notebook import render_card
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.files.resources import check_path, find_file
from vkc_pin.world.models.shapes import (
    check_start_value,
    clamp_to_limits,
    compute_clearance,
    list_placed_shapes,
)
from vkc_pin.world.scene.clearance_exemptions import warn_of_overlaps
from vkc_pin.world.scene.hold import (
    Hold,
    check_hold_order,
    compute_tool_placement,
    find_reversed_approaches,
    make_holds,
    measure_grasp,
    place_held_objects,
    resolve_holds,
    warn_of_openings,
)
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.poses import as_placement

if TYPE_CHECKING:
    from vkc_pin.world.models.robot import Base, Robot
    from vkc_pin.world.scene.scene_schema import RegionSchema, SceneSchema


START_CLEARANCE = 0.03
"""Minimum distance of a random start from all shapes but the floor [m]."""
_MAX_TRIES = 2000  # random starts
_ROBOT_FILES = (".urdf", ".yaml", ".yml")


@dataclass(frozen=True, eq=False)
class Scene:
    """A robot and the world around it; immutable, the `with_` methods return changed copies.

    Attributes:
        name: Its name.
        file: File it was loaded from, if any.
        folder: Folder that relative paths in `document` refer to.
        robot: Robot.
        start: Initial configuration: base x, y [m], yaw [rad], then the arm joints [rad], shape
            (n,).
        objects: Name → articulated object. A free object that is held is placed in the robot's
            hand.
        obstacles: Fixed obstacles as convex shapes: parent joint 0, placement in the world frame,
            colour set. An obstacle of one shape has its name, one of several shapes
            `<name>_<number>`. The floor is among them.
        obstacle_labels: Name of the obstacle of each of these shapes (`FLOOR` for the floor).
        obstacle_names: Names of the obstacles in the order of the file, without the floor.
        obstacle_visual: Visual shapes of the obstacles, without the floor.
        floor: Whether there is a floor at z = 0.
        arena: Part of the floor that belongs to the scene: (x_min, x_max, y_min, y_max) [m].
        start_region: Region from which `sample_start` draws, if the scene has one.
        holds: Holds at the start, each after the one it depends on; `"cup" in scene.holds` is
            whether the cup is held.
        allowed: Pairs of link labels that may be close → margin that they keep [m]; -inf: none.
        opening: Gripper opening at the start if the gripper holds nothing [m]; None: as in the
            robot's rest configuration.
        described: Description it was built from; source of the robot, obstacles and files in
            `document`.
        memory: Cache of derived results, shared with the copies that the `with_` methods return;
            affects computation times only.
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
        return render_card(self)

    @property
    def held(self) -> dict[str, str]:
        """Object → attachment of the objects held at the start."""
        return {hold.object: hold.attachment for hold in self.holds}

    @property
    def document(self) -> dict[str, Any]:
        """The scene as plain data, from which `from_document` builds it again."""
        from vkc_pin.world.scene.scene_file import make_document

        return make_document(vars(self))

    @staticmethod
    def from_document(document: Mapping[str, Any], folder: str | Path = ".") -> Scene:
        """Build a scene from plain data (see `Scene.document` and the scene files).

        Args:
            document: Dictionaries, lists, strings and numbers.
            folder: Folder that relative paths in it refer to.

        Raises:
            InputError: The data are invalid; `UnknownNameError` where a name does not exist.
        """
        from vkc_pin.world.files.documents import Document
        from vkc_pin.world.scene.scene_file import make_scene_fields

        fields = make_scene_fields(
            Document(check_mapping(document, "document")), check_path(folder, "folder")
        )
        return _check_new_scene(Scene(**fields)._with())

    def with_robot(
        self,
        name: str | Path,
        *,
        base: Base = "omni",
        tool_frame: str | None = None,
        turning_radius: float | None = None,
        height: float | None = None,
    ) -> Scene:
        """Return the scene with another robot, which starts at the same place and holds nothing.

        Its arm is at home, and its gripper as in the rest configuration. For other arguments of
        `load_robot`, give the path of a robot.yaml.

        Args:
            name: Name of the robot, or path of its folder, robot.yaml or URDF; see `load_robot`.
            base: Type of the base.
            tool_frame: Frame of the hand; None: that of robot.yaml.
            turning_radius: Minimum turning radius of an "ackermann" base [m].
            height: Height of the root link above the floor [m]; None: that of robot.yaml.

        Raises:
            InputError: The robot is invalid, or its start is outside its limits.
            UnknownNameError: There is no such robot, or an entry of `allow` names a link that it
                does not have.
        """
        check_instance(name, (str, Path), "name")
        is_path = isinstance(name, Path) or "/" in name or Path(name).suffix in _ROBOT_FILES
        robot = {
            "name": str(Path(name).absolute()) if is_path else name,
            "base": base,
            "tool_frame": tool_frame,
            "turning_radius": turning_radius,
        }
        start = {"base": self.start[:3].tolist(), "z": height}
        document = {
            **self.document,
            "robot": {key: value for key, value in robot.items() if value is not None},
            "start": {key: value for key, value in start.items() if value is not None},
        }
        return Scene.from_document(document, self.folder)

    def with_start(
        self, base: ArrayLike | None = None, arm: ArrayLike | Mapping[str, float] | None = None
    ) -> Scene:
        """Return the scene with another start.

        Args:
            base: x, y [m] and yaw [rad] in the world frame, shape (3,); None keeps it.
            arm: Arm joints [rad], shape (n - 3,), or joint → value for some of them; None keeps
                them.

        Raises:
            UnknownNameError: The robot has no such arm joint.
            InputError: Wrong size, a value that is not finite, outside a joint's limits or outside
                the arena.
        """
        start, names = self.start.copy(), self.robot.coordinates.names
        if isinstance(arm, Mapping):
            arm = self._fill_arm(arm)
        for part_name, values, part in (("base", base, slice(0, 3)), ("arm", arm, slice(3, None))):
            if values is None:
                continue
            given = check_array(values, part_name)
            if given.shape != start[part].shape:
                problem, expected = "wrong number of values", start[part].shape
                raise InputError(problem, field=part_name, expected=expected, got=given.shape)
            lower, upper = (limits[part] for limits in self.robot.start_limits)
            start[part] = [
                check_start_value(value, low, high, f"{part_name}.{name}")
                for value, low, high, name in zip(given, lower, upper, names[part], strict=True)
            ]
        start[:2] = [
            clamp_to_limits(value, low, high, f"base.{name}", "outside the arena")
            for value, low, high, name in zip(
                start[:2], self.arena[::2], self.arena[1::2], names[:2], strict=True
            )
        ]
        return self._with(start=start)

    def _fill_arm(self, given: Mapping[str, float]) -> list[float]:
        """Return the values of all arm joints; those that are not named stay."""
        names = self.robot.coordinates.names[3:]
        values = check_mapping(given, "arm", "joint → value")
        for joint in values:
            check_choice(joint, names, f"arm joint of robot '{self.robot.name}'", "arm")
        stay = zip(names, self.start[3:].tolist(), strict=True)
        return [values.get(joint, value) for joint, value in stay]

    def with_state(self, name: str, values: Mapping[str, float]) -> Scene:
        """Return the scene with joints of object `name` at `values`.

        Args:
            name: Object.
            values: Joint name → value, [rad] or [m].

        Raises:
            UnknownNameError: There is no such object, or it has no such joint.
            InputError: A value is not finite or outside the joint's limits.
        """
        return self._with(
            objects=freeze({**self.objects, name: self._find_object(name).with_state(values)})
        )

    def with_placement(self, name: str, placement: pin.SE3) -> Scene:
        """Return the scene with object `name` at another placement.

        Args:
            name: Object.
            placement: Placement of its base link in the world frame; see `as_placement`.

        Raises:
            UnknownNameError: There is no such object.
            InputError: `placement` is not a pose.
        """
        placed = dataclasses.replace(
            self._find_object(name), placement=as_placement(placement, name="placement")
        )
        return self._with(objects=freeze({**self.objects, name: placed}))

    def with_held(
        self,
        held: Mapping[str, str] | Iterable[Hold],
        *,
        by: Mapping[str, str] | None = None,
        at: Mapping[str, Sequence[float]] | None = None,
        measured: Mapping[str, Any] | None = None,
    ) -> Scene:
        """Return the scene with the robot holding objects at the start.

        The virtual joint of a measured grasp is the measured transform; `with_measured_grasp`
        derives it from measured positions. After its release the nominal attachment applies.

        Args:
            held: Object → attachment; or complete holds, each after the one it depends on.
            by: Object → "<object>.<link>", for objects held through another object of `held`.
            at: Object → values of its attachment's freedoms, [m] and [rad]; default 0, or those
                nearest to the measured grasp.
            measured: Object → measured placement of the attachment's frame (that of its
                description) in the tool frame, or in the frame `by`; see `as_placement`.

        Raises:
            UnknownNameError: There is no such object, attachment or link.
            InputError: Values do not fit the attachment's freedoms, objects hold each other, or a
                measured grasp is more than 20 mm or 0.2 rad from its attachment.
        """
        holds = check_hold_order(make_holds(held, by, at) if isinstance(held, Mapping) else held)
        poses = check_mapping({} if measured is None else measured, "measured")
        for name in poses:
            names = [hold.object for hold in holds]
            check_choice(name, names, "held object", f"measured.{name}")
        poses = {name: as_placement(pose, name=f"measured.{name}") for name, pose in poses.items()}
        return self._with(holds=resolve_holds(self.objects, holds, poses))

    def with_measured_grasp(
        self,
        name: str,
        attachment: str | None = None,
        *,
        base: ArrayLike | None = None,
        arm: ArrayLike | None = None,
        state: Mapping[str, float] | None = None,
        placement: Any = None,
    ) -> Scene:
        """Return the scene as measured, with the robot holding an object where its hand is.

        Other objects stay held.

        Args:
            name: Object.
            attachment: Grasped attachment. Default: the one that is held, or else the first.
            base: Measured x, y [m] and yaw [rad] of the base, shape (3,); None keeps them.
            arm: Measured arm joints [rad], shape (n - 3,); None keeps them.
            state: Measured joints of the object, [rad] or [m]; the others keep their values.
            placement: Measured placement of the object's base link in the world, see
                `as_placement`; None keeps it.

        Raises:
            UnknownNameError: There is no such object, attachment or joint.
            InputError: A value is invalid, or the hand is more than 20 mm or 0.2 rad from the
                attachment.
        """
        placed = self._find_object(name)
        if placement is not None:
            pose = as_placement(placement, name="placement")
            placed = dataclasses.replace(placed, placement=pose)
        placed = placed.with_state({} if state is None else state)
        before = next((hold for hold in self.holds if hold.object == name), None)
        if attachment is None and before is not None:
            attachment = before.attachment
        grasp = placed.object.attachment(attachment)
        by, link = (None, None) if before is None else (before.by, before.link)
        hold = Hold(name, grasp.name, by, link)
        moved = self.with_start(base, arm)
        objects = freeze({**moved.objects, name: placed})
        measured = {name: measure_grasp(objects, hold, moved.tool_placement)}
        holds = [_replace_hold(one, before, hold) for one in self.holds]
        holds += [hold] if before is None else []
        return moved._with(objects=objects, holds=resolve_holds(objects, holds, measured))

    def with_approaches(self, holds: Iterable[Hold], *, stacklevel: int = 2) -> Scene:
        """Return the scene with those attachments reversed that cannot be approached otherwise.

        These are attachments whose approach would take the hand through the object or the floor.
        Each reversal raises a warning. Attachments whose other side is no better are unchanged.

        Args:
            holds: Holds whose approaches are checked.
            stacklevel: Stack level of the warnings, as for `warnings.warn`.
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
            what = f"{hold.frame or 'the hand'} would approach {hold.object}.{hold.attachment}"
            text = f"{what} through the object or the floor, so its approach is reversed"
            hint = f"turn its approach, or set `reversed: [{hold.attachment}]` for the object"
            warnings.warn(f"{self.file or self.name}: {text}; {hint}", stacklevel=stacklevel)
        changed = objects != dict(self.objects)
        return self._with(objects=freeze(objects)) if changed else self

    def _find_object(self, name: str) -> PlacedObject:
        return self.objects[check_choice(name, self.objects, "object")]

    def _with(self, **fields: Any) -> Scene:
        """Return the scene with other attributes, and with free held objects placed in the hand."""
        changed = dataclasses.replace(self, **fields)
        changed = dataclasses.replace(
            changed,
            objects=place_held_objects(changed.objects, changed.tool_placement, changed.holds),
        )
        # Only copies made here share the cache: `dataclasses.replace` may change obstacles.
        object.__setattr__(changed, "memory", self.memory)
        return changed

    def tool_placement(self) -> pin.SE3:
        """Return the placement of the robot's tool frame in the world frame at the start."""
        return compute_tool_placement(self.robot, self.start)

    def start_clearance(self, *, reach: float = np.inf) -> float:
        """Return the smallest distance between robot and world at the start [m].

        Objects in the hand count as part of the robot. Distances to the floor, of the robot to
        itself and to the objects it holds do not count.

        Args:
            reach: Largest distance of interest [m]: beyond it the result is some number ≥ `reach`.
        """
        if not is_number(reach) or reach != reach:
            raise InputError(
                "not a number", field="reach", expected="a distance [m]", got=format_value(reach)
            )
        reach = float(min(reach, 1e300))
        model = self.robot.model
        geometry = self.robot.opened(self.robot.opening(self.opening)).collision
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
        """Return the scene with the base at a random collision-free pose in its start region.

        The base's x, y and heading are uniform in the region; poses with a `start_clearance` below
        `START_CLEARANCE` are rejected.

        Args:
            rng: Random number generator; the same state gives the same start.

        Raises:
            InputError: The scene has no start region, the robot holds a fixed object, or no free
                pose was found.
        """
        check_instance(rng, np.random.Generator, "rng")
        region, file = self.start_region, self.file
        if region is None:
            problem, expected = "the scene has no start region", "x and y intervals"
            raise InputError(problem, file=file, field="start_region", expected=expected)
        for name in self.held:
            if not self.objects[name].object.free:
                raise InputError(
                    "the start cannot be sampled while the robot holds a fixed object",
                    file=file,
                    field=f"start.held.{name}",
                )
        for base in itertools.islice(region.sample_poses(rng), _MAX_TRIES):
            candidate = self.with_start(base=base)
            if candidate.start_clearance(reach=START_CLEARANCE) >= START_CLEARANCE:
                return candidate
        problem = f"no collision-free start of the robot in {_MAX_TRIES} attempts"
        expected = f"a clearance of {START_CLEARANCE} m somewhere"
        raise InputError(problem, file=file, field="start_region", expected=expected)


def _replace_hold(one: Hold, before: Hold | None, hold: Hold) -> Hold:
    """Return a hold with `before` replaced, be it the hold itself or one it depends on."""
    if one == before:
        return hold
    return (
        one if one.by is None else dataclasses.replace(one, by=_replace_hold(one.by, before, hold))
    )


def load_scene(name_or_path: str | Path) -> Scene:
    """Load a scene by the name of a file in `scenes`, or by the path of a scene file (.yaml).

    A folder with a `scene.yaml`, as imports write it, stands for that file, before any name.

    Movable links that overlap other shapes raise a warning.

    Raises:
        UnknownNameError: There is no such scene, or it names something that does not exist.
        InputError: The file is invalid; the error names the file, line and field.
    """
    from vkc_pin.world.files.documents import read_yaml
    from vkc_pin.world.scene.scene_file import make_scene_fields

    path = check_path(name_or_path, "scene", "the name of a scene, or a path")
    file = path / "scene.yaml" if path.is_dir() else path
    if file == path or not file.is_file():
        file = find_file(name_or_path, "scenes", "*.yaml", noun="scene")
    return _check_new_scene(Scene(**make_scene_fields(read_yaml(file), file.parent))._with())


def _check_new_scene(scene: Scene) -> Scene:
    """Return a new scene with corrected approaches; warn of probable mistakes."""
    warn_of_overlaps(scene, str(scene.file or scene.name))
    warn_of_openings(scene.objects, scene.robot, scene.opening, str(scene.file or scene.name))
    undecided = [
        item.name
        for item in scene.described.objects
        if item.reversed is None and item.name not in scene.held
    ]
    holds = (
        Hold(name, attachment)
        for name in undecided
        for attachment in scene.objects[name].object.attachments
    )
    return scene.with_approaches(holds, stacklevel=4)
