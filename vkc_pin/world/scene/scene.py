"""Defines scenes: a robot, its start, and the obstacles and articulated objects around it."""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.arguments import (
    check_array,
    check_choice,
    check_instance,
    check_mapping,
    check_number,
    is_number,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.notebook import render_card
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.files.fields import is_name
from vkc_pin.world.files.resources import check_path, find_file
from vkc_pin.world.models.shapes import (
    check_start_value,
    clamp_to_limits,
    compute_clearance,
    list_placed_shapes,
)
from vkc_pin.world.scene.clearance_exemptions import warn_of_overlaps
from vkc_pin.world.scene.estimated_joints import place_on_estimate
from vkc_pin.world.scene.hold import (
    Hold,
    check_hold_order,
    compute_frame_placement,
    compute_tool_placement,
    find_reversed_approaches,
    make_holds,
    measure_grasp,
    place_held_objects,
    resolve_holds,
    warn_of_openings,
)
from vkc_pin.world.scene.joint_estimation import JointEstimate
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.poses import as_placement
from vkc_pin.world.scene.robot_velocity import make_robot_velocity

if TYPE_CHECKING:
    from vkc_pin.world.models.robot import Base, Robot
    from vkc_pin.world.scene.measured_points import PointCounts
    from vkc_pin.world.scene.scene_schema import RegionSchema, SceneSchema


START_CLEARANCE = 0.03
"""Minimum distance of a random start from all shapes but the floor [m]."""
_MAX_TRIES = 2000  # random starts
_LARGEST_RADIUS = 1.0  # [m] of measured points
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
        start_velocity: Velocity of these coordinates at the start, shape (n,), [m/s] and [rad/s];
            zero by default.
        objects: Name → articulated object. A free object that is held is placed in the robot's
            hand.
        obstacles: Fixed obstacles as convex shapes: parent joint 0, placement in the world frame,
            colour set. An obstacle of one shape has its name, one of several shapes
            `<name>_<number>`. The floor and the boxes of the map are among them.
        obstacle_labels: Name of the obstacle of each of these shapes (`FLOOR` for the floor, `MAP`
            for the map).
        obstacle_names: Names of the obstacles in the order of the file, without floor and map.
        obstacle_visual: Visual shapes of the obstacles, without the floor.
        obstacle_visual_labels: Name of the obstacle of each of these shapes.
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
        memory: Cache of derived results, shared with the copies that the `with_` methods return,
            except those with other obstacles; affects computation times only.
    """

    name: str
    file: Path | None
    folder: Path
    robot: Robot
    start: Floats
    start_velocity: Floats
    objects: Mapping[str, PlacedObject]
    obstacles: tuple[pin.GeometryObject, ...]
    obstacle_labels: tuple[str, ...]
    obstacle_names: tuple[str, ...]
    obstacle_visual: tuple[pin.GeometryObject, ...]
    obstacle_visual_labels: tuple[str, ...]
    floor: bool
    arena: tuple[float, float, float, float]
    start_region: RegionSchema | None
    holds: tuple[Hold, ...]
    allowed: Mapping[frozenset[str], float]
    described: SceneSchema
    opening: float | None = None
    memory: dict[Any, Any] = dataclasses.field(default_factory=dict, init=False, repr=False)

    def __repr__(self) -> str:
        objects = ", ".join(self.objects) or "none"
        return (
            f"<Scene {self.name}: {self.robot.name}, objects {objects}, "
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

        data = Document(check_mapping(document, "document"))
        fields = make_scene_fields(data, check_path(folder, "folder"))
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

        It starts at rest. Its arm is at home, and its gripper as in the rest configuration. For
        other arguments of `load_robot`, give the path of a robot.yaml.

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
        robot: dict[str, Any] = {"name": str(Path(name).absolute()) if is_path else name}
        if base is not None:
            robot["base"] = base
        if tool_frame is not None:
            robot["tool_frame"] = tool_frame
        if turning_radius is not None:
            robot["turning_radius"] = turning_radius
        start: dict[str, Any] = {"base": self.start[:3].tolist()}
        if height is not None:
            start["z"] = height
        document = self.document
        document.update(robot=robot, start=start)
        return Scene.from_document(document, self.folder)

    def with_start(
        self,
        base: ArrayLike | None = None,
        arm: ArrayLike | Mapping[str, float] | None = None,
        *,
        velocity: ArrayLike | Mapping[str, float] | None = None,
    ) -> Scene:
        """Return the scene with another start.

        Args:
            base: x, y [m] and yaw [rad] in the world frame, shape (3,); None keeps it.
            arm: Arm joints [rad], shape (n - 3,), or joint → value for some of them; None keeps
                them.
            velocity: Velocity of all coordinates, shape (n,), [m/s] and [rad/s], or coordinate →
                velocity, where those that are not named are at rest; None keeps it.

        Raises:
            UnknownNameError: The robot has no such arm joint or coordinate.
            InputError: Wrong size, a value that is not finite, outside a joint's limits or outside
                the arena; a velocity beyond its limit, or with which a base on wheels would slip.
        """
        names = self.robot.coordinates.names
        start = self.start.copy()
        if isinstance(arm, Mapping):
            arm = self._fill_arm(arm)
        if base is not None:
            start[:3] = self._check_start_values(base, "base", slice(0, 3))
        if arm is not None:
            start[3:] = self._check_start_values(arm, "arm", slice(3, None))
        x_min, x_max, y_min, y_max = self.arena
        problem = "outside the arena"
        start[0] = clamp_to_limits(start[0], x_min, x_max, f"base.{names[0]}", problem)
        start[1] = clamp_to_limits(start[1], y_min, y_max, f"base.{names[1]}", problem)
        wanted = self.start_velocity if velocity is None else velocity
        start_velocity = make_robot_velocity(self.robot, start, wanted)
        return self._with(start=start, start_velocity=start_velocity)

    def with_joint_state(self, message: Mapping[str, Any]) -> Scene:
        """Return the scene with the start that a message of ROS or MoveIt states.

        Names may have any order. Joints that the message lacks keep their start, others that are
        not planned (wheels, fingers, followers) are named in a warning. Velocities and efforts are
        not used; see `with_start` for velocities.

        Args:
            message: Mapping with the fields of `sensor_msgs/JointState` (`name`, `position`) or of
                `moveit_msgs/RobotState`, whose `multi_dof_joint_state` with one joint is the base
                in the frame of the scene. `rosidl_runtime_py.message_to_ordereddict` makes it of a
                message.

        Raises:
            InputError: A field is missing or invalid, the base is tilted, or a value is outside its
                limits or the arena.
        """
        from vkc_pin.world.scene.joint_state import note_other_joints, parse_joint_state

        state = parse_joint_state(message)
        names = self.robot.coordinates.names[3:]
        arm = {name: state.positions[name] for name in names if name in state.positions}
        for note in (*state.notes, *note_other_joints(state.positions, names)):
            warnings.warn(f"{self.name}: {note}", stacklevel=2)
        return self.with_start(state.base, arm)

    def _check_start_values(self, values: ArrayLike, field: str, part: slice) -> list[float]:
        """Return the values of a `part` of the coordinates at the start."""
        given = check_array(values, field)
        if given.shape != self.start[part].shape:
            raise InputError(
                "wrong number of values",
                field=field,
                expected=self.start[part].shape,
                got=given.shape,
            )
        lower, upper = self.robot.start_limits
        names = self.robot.coordinates.names[part]
        checked = list[float]()
        for value, low, high, name in zip(given, lower[part], upper[part], names, strict=True):
            checked.append(check_start_value(value, low, high, f"{field}.{name}"))
        return checked

    def _fill_arm(self, given: Mapping[str, float]) -> list[float]:
        """Return the values of all arm joints; those that are not named stay."""
        names = self.robot.coordinates.names[3:]
        values = check_mapping(given, "arm", "joint → value")
        for joint in values:
            check_choice(joint, names, f"arm joint of robot '{self.robot.name}'", "arm")
        current = dict(zip(names, self.start[3:].tolist(), strict=True))
        return [values.get(joint, current[joint]) for joint in names]

    def with_state(self, name: str, values: Mapping[str, float]) -> Scene:
        """Return the scene with joints of object `name` at `values`.

        Args:
            name: Object.
            values: Joint name → value, [rad] or [m].

        Raises:
            UnknownNameError: There is no such object, or it has no such joint.
            InputError: A value is not finite or outside the joint's limits.
        """
        placed = self._find_object(name).with_state(values)
        return self._with(objects=freeze({**self.objects, name: placed}))

    def with_placement(self, name: str, placement: pin.SE3) -> Scene:
        """Return the scene with object `name` at another placement.

        Args:
            name: Object.
            placement: Placement of its base link in the world frame; see `as_placement`.

        Raises:
            UnknownNameError: There is no such object.
            InputError: `placement` is not a pose.
        """
        placed = self._find_object(name)
        pose = as_placement(placement, name="placement")
        moved = dataclasses.replace(placed, placement=pose)
        return self._with(objects=freeze({**self.objects, name: moved}))

    def with_measured_joint(
        self,
        name: str,
        joint: str,
        estimate: JointEstimate,
        *,
        link: str | None = None,
        value: float | None = None,
    ) -> Scene:
        """Return the scene with a joint of an object on an estimated axis.

        At the value of the first pose, the link is where the estimate has it; from there it moves
        on the estimated axis. The joint keeps its present value, its limits, and the sense in which
        it is positive, and all that it carries moves with it.

        Args:
            name: Object, which is fixed in the world.
            joint: Joint.
            estimate: Its estimate from poses in the world frame; see `estimate_joint`.
            link: Link whose poses were measured, while the other joints were as in this scene.
                Default: the joint's own link, which it moves itself.
            value: Value of the joint at position 0 of the estimate, which is its first pose, [rad]
                or [m]. Default: the present one.

        Raises:
            UnknownNameError: There is no such object, joint or link.
            InputError: The object is free, the joint does not move the link, or the estimate is of
                another kind than the joint.
        """
        check_instance(estimate, JointEstimate, "estimate")
        placed = place_on_estimate(self._find_object(name), joint, estimate, link, value)
        return self._with(objects=freeze({**self.objects, name: placed}))

    def with_obstacle(self, name: str, placement: Any) -> Scene:
        """Return the scene with obstacle `name` at another placement.

        All its shapes move together. Shapes, objects and robot are shared with this scene, so that
        an obstacle may follow a measured person at every measurement. Overlaps are not checked.

        Args:
            name: Obstacle, by its name in the scene file.
            placement: Placement of its frame in the world frame, see `as_placement`: of the centre
                of a shape, of the origin of a mesh or URDF.

        Raises:
            UnknownNameError: There is no such obstacle. The floor is none of them.
            InputError: `placement` is not a pose.
        """
        from vkc_pin.world.scene.scene_file import move_obstacle

        check_choice(name, self.obstacle_names, "obstacle", "name")
        pose = as_placement(placement, name="placement")
        # Results in `memory` depend on the obstacles: the copy begins with none.
        return dataclasses.replace(self, **move_obstacle(vars(self), name, pose))

    def with_allowed(self, first: str, second: str, margin: float) -> Scene:
        """Return the scene in which two links keep a margin of their own from each other.

        Robot, objects and obstacles are shared with this scene. Of several margins for one pair the
        smallest counts.

        Args:
            first: A link of the robot, "<object>.<link>", or an obstacle.
            second: Another one.
            margin: Distance that they keep instead of `dist_safe` [m]; negative: how deep they may
                overlap.

        Raises:
            UnknownNameError: There is no such link or obstacle.
            InputError: `margin` is not a number.
        """
        from vkc_pin.world.scene.scene_file import allow_pair

        margin = check_number(margin, "margin", "a distance [m]")
        return dataclasses.replace(self, **allow_pair(vars(self), (first, second), margin))

    def with_map(
        self,
        file: str | Path,
        *,
        height: float = 2.0,
        unknown: Literal["blocked", "free"] = "blocked",
    ) -> Scene:
        """Return the scene on an occupancy map of ROS, whose occupied cells become obstacles.

        The map replaces an earlier one. The arena remains if it was stated and is within the
        bounding box of the map, which it becomes otherwise. The start must be in it.

        Args:
            file: A `map.yaml` of map_server or Nav2.
            height: Height of the obstacles above the floor [m].
            unknown: Whether cells that are neither occupied nor free are "blocked" as well, or
                "free". Parts of the arena beyond the image are unknown.

        Raises:
            InputError: A file cannot be read, an argument is invalid, or the start is outside.
        """
        path = check_path(file, "file", "the path of a map.yaml")
        document = self.document
        entry = {"file": str(path.absolute()), "height": height, "unknown": unknown}
        document["map"] = entry
        arena = document.pop("arena")
        on_map = Scene.from_document(document, self.folder)
        x_min, x_max, y_min, y_max = on_map.arena
        is_stated = self.described.arena is not None
        is_within = (
            x_min <= self.arena[0] <= self.arena[1] <= x_max
            and y_min <= self.arena[2] <= self.arena[3] <= y_max
        )
        if not (is_stated and is_within):
            return on_map
        return Scene.from_document({**document, "arena": arena}, self.folder)

    def with_points(
        self,
        points: ArrayLike,
        radius: float = 0.01,
        frame: str | None = None,
        *,
        name: str = "points",
    ) -> Scene:
        """Return the scene with measured points as an obstacle, each a ball of a radius.

        Points of the robot at its start and of objects as they are (within 3 cm), and of the floor
        (below 5 cm), are removed; `point_counts` has their numbers. Coordinates are kept in single
        precision.

        Args:
            points: Points, shape (n, 3) [m].
            radius: Radius of each [m]: at least half of the distance between neighbours, so that
                nothing fits between.
            frame: Link or frame of the robot in which they were measured at the start of this
                scene. Default: the world.
            name: Name of the obstacle. Measured points of this name are replaced.

        Raises:
            UnknownNameError: The robot has no such frame.
            InputError: `points` is no such array, has no or more than 2 000 000 points, or one that
                is not finite; no point remains; the radius is not positive; another obstacle or
                object has the name.
        """
        from vkc_pin.world.scene.measured_points import (
            check_points,
            remove_known_points,
        )
        from vkc_pin.world.scene.scene_file import add_points, find_surroundings

        measured = check_points(points)
        is_valid_radius = is_number(radius) and 0.0 < radius <= _LARGEST_RADIUS
        if not is_valid_radius:
            raise InputError(
                "invalid radius",
                field="radius",
                expected=f"a positive number up to {_LARGEST_RADIUS:g} m",
                got=format_value(radius),
            )
        self._check_points_name(name)
        if frame is not None:
            kind = f"frame of robot '{self.robot.name}'"
            known = check_choice(frame, self.robot.frame_names, kind, "frame")
            pose = compute_frame_placement(self.robot, self.start, known)
            measured = measured @ pose.rotation.T + pose.translation
        around = find_surroundings(
            robot=self.robot,
            start=self.start,
            opening=self.opening,
            objects=self.objects,
            holds=self.holds,
            floor=self.floor,
        )
        kept, counts = remove_known_points(measured, float(radius), around)
        # Results in `memory` depend on the obstacles: the copy begins with none.
        changed = add_points(vars(self), name, kept, float(radius), counts)
        return dataclasses.replace(self, **changed)

    def _check_points_name(self, name: str) -> None:
        """Check that measured points can have a name."""
        others = [*self.objects, FLOOR, "robot"]
        others += [one.name for one in self.described.obstacles if one.type != "points"]
        if not isinstance(name, str) or not is_name(name) or name in others:
            raise InputError(
                "this name cannot be used",
                field="name",
                expected="a name that no object and no other kind of obstacle has, without . and /",
                got=format_value(name),
            )

    @property
    def point_counts(self) -> dict[str, PointCounts]:
        """Obstacle of measured points → numbers of its points that were kept and removed."""
        from vkc_pin.world.scene.measured_points import get_counts

        clouds = [item for item in self.described.obstacles if item.type == "points"]
        return {item.name: get_counts(item) for item in clouds}

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
        names = [hold.object for hold in holds]
        stated = check_mapping({} if measured is None else measured, "measured")
        for name in stated:
            check_choice(name, names, "held object", f"measured.{name}")
        poses = {name: as_placement(pose, name=f"measured.{name}") for name, pose in stated.items()}
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
        before = None
        for one in self.holds:
            if one.object == name:
                before = one
                break
        if before is None:
            grasp = placed.object.attachment(attachment)
            hold = Hold(name, grasp.name)
            holds = [*self.holds, hold]
        else:
            grasp = placed.object.attachment(
                before.attachment if attachment is None else attachment
            )
            hold = Hold(name, grasp.name, before.by, before.link)
            holds = [_replace_hold(one, before, hold) for one in self.holds]
        moved = self.with_start(base, arm)
        objects = freeze({**moved.objects, name: placed})
        measured = {name: measure_grasp(objects, hold, moved.tool_placement)}
        return moved._with(objects=objects, holds=resolve_holds(objects, holds, measured))

    def with_approaches(self, holds: Iterable[Hold], *, stacklevel: int = 2) -> Scene:
        """Return the scene with those attachments reversed that cannot be approached otherwise.

        These are attachments whose approach would take the hand through the object or the floor.
        Each reversal raises a warning. Attachments whose other side is no better are unchanged.

        Args:
            holds: Holds whose approaches are checked.
            stacklevel: Stack level of the warnings, as for `warnings.warn`.
        """
        floor, _ = self._divide_obstacles()
        objects = dict(self.objects)
        blocked = find_reversed_approaches(
            self.objects, holds, self.robot, list_placed_shapes(floor)
        )
        for hold in blocked:
            objects[hold.object] = objects[hold.object].with_reversed(hold.attachment)
            warnings.warn(
                f"{self.file or self.name}: {hold.frame or 'the hand'} would approach "
                f"{hold.object}.{hold.attachment} through the object or the floor, so its approach "
                f"is reversed; turn its approach, or set `reversed: [{hold.attachment}]` for the "
                "object",
                stacklevel=stacklevel,
            )
        if objects == dict(self.objects):
            return self
        return self._with(objects=freeze(objects))

    def _divide_obstacles(self) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
        """Return the shapes of the floor, and those of the other obstacles."""
        floor = list[pin.GeometryObject]()
        others = list[pin.GeometryObject]()
        for shape, label in zip(self.obstacles, self.obstacle_labels, strict=True):
            group = floor if label == FLOOR else others
            group.append(shape)
        return floor, others

    def _find_object(self, name: str) -> PlacedObject:
        return self.objects[check_choice(name, self.objects, "object")]

    def _with(self, **fields: Any) -> Scene:
        """Return the scene with other attributes, and with free held objects placed in the hand."""
        changed = dataclasses.replace(self, **fields)
        objects = place_held_objects(changed.objects, changed.tool_placement, changed.holds)
        changed = dataclasses.replace(changed, objects=objects)
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
        model_data = model.createData()
        geometry_data = geometry.createData()
        q = self.robot.coordinates.q(self.start)
        pin.updateGeometryPlacements(model, model_data, geometry, geometry_data, q)
        moving = [
            (shape.geometry, placement)
            for shape, placement in zip(geometry.geometryObjects, geometry_data.oMg, strict=True)
        ]
        _, others = self._divide_obstacles()
        for name, placed in self.objects.items():
            if name not in self.held:
                others += make_world_shapes(placed)
            elif placed.object.free:
                moving += list_placed_shapes(make_world_shapes(placed))
        return compute_clearance(moving, list_placed_shapes(others), reach=reach)

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
        if self.start_region is None:
            raise InputError(
                "the scene has no start region",
                file=self.file,
                field="start_region",
                expected="x and y intervals",
            )
        for name in self.held:
            if not self.objects[name].object.free:
                raise InputError(
                    "the start cannot be sampled while the robot holds a fixed object",
                    file=self.file,
                    field=f"start.held.{name}",
                )
        poses = self.start_region.sample_poses(rng)
        for base in itertools.islice(poses, _MAX_TRIES):
            candidate = self.with_start(base=base)
            if candidate.start_clearance(reach=START_CLEARANCE) >= START_CLEARANCE:
                return candidate
        raise InputError(
            f"no collision-free start of the robot in {_MAX_TRIES} attempts",
            file=self.file,
            field="start_region",
            expected=f"a clearance of {START_CLEARANCE} m somewhere",
        )


def _replace_hold(one: Hold, before: Hold, hold: Hold) -> Hold:
    """Return a hold with `before` replaced, be it the hold itself or one it depends on."""
    if one == before:
        return hold
    if one.by is None:
        return one
    return dataclasses.replace(one, by=_replace_hold(one.by, before, hold))


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
    fields = make_scene_fields(read_yaml(file), file.parent)
    return _check_new_scene(Scene(**fields)._with())


def _check_new_scene(scene: Scene) -> Scene:
    """Return a new scene with corrected approaches; warn of probable mistakes."""
    source = str(scene.file or scene.name)
    warn_of_overlaps(scene, source)
    warn_of_openings(scene.objects, scene.robot, scene.opening, source)
    holds = list[Hold]()
    for item in scene.described.objects:
        if item.reversed is None and item.name not in scene.held:
            attachments = scene.objects[item.name].object.attachments
            holds += [Hold(item.name, attachment) for attachment in attachments]
    return scene.with_approaches(holds, stacklevel=4)
