"""Models a scene as one plain kinematic tree of robot and objects, rooted in the world.

Validation and visualization use this model. It is independent of the virtual kinematic chain, so
that it reveals errors of the chain. Free objects have free joints, whose positions `FreeObjects`
computes. The fingers of a gripper are joints.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.utils.arguments import check_choice
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.grafting import graft, graft_geometry
from vkc_pin.world.models.gripper import Gripper
from vkc_pin.world.models.shapes import get_link_name
from vkc_pin.world.scene.clearance_exemptions import make_shape_keys
from vkc_pin.world.scene.contact_rules import compute_start_opening
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.free_objects import FreeObjects, to_free_joint_positions
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

FREE_JOINT = "placement"
"""Name of a free object's free joint: `<object>.placement`."""


class World:
    """A scene's robot, objects and obstacles in one `pinocchio.Model`.

    Attributes:
        model: Robot (joint 1 is the planar base, fingers come last), then the tree of every object,
            with joints `<object>.<joint>`, frames `<object>.<link>`, and a free joint
            `<object>.placement` for free objects.
        coordinates: Its n minimal coordinates: the robot's, then the objects'.
        bodies: Collision geometry of robot and objects.
        shapes: These shapes, then those of the obstacles (parent joint 0).
        collision, visual: Geometry of robot, objects and obstacles, built on first use.
        collision_labels, visual_labels: Link or obstacle of each shape, e.g. "forearm_link",
            "door.panel", "sofa".
        collision_keys: Key of each of `shapes`, see `make_shape_keys`.
        start: Start of the robot, then placements and states of the objects, shape (n,).
    """

    def __init__(self, scene: Scene) -> None:
        robot = scene.robot
        self.scene = scene
        self.model = pin.Model(robot.model if robot.gripper is None else robot.gripper.model)
        self._robot_joints = int(self.model.njoints)
        self._joints: dict[str, list[int]] = {}
        for name, placed in scene.objects.items():
            parent = 0
            placement = placed.placement
            if placed.object.free:
                joint_name = f"{name}.{FREE_JOINT}"
                parent = self.model.addJoint(
                    0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), joint_name
                )
                placement = pin.SE3.Identity()
            tree = placed.object.model
            self._joints[name] = graft(
                self.model, tree, parent=parent, placement=placement, prefix=f"{name}."
            )
        objects = {name: placed.object.collision for name, placed in scene.objects.items()}
        self.bodies = self._graft_all(robot.collision, objects)
        self._body_shapes = tuple(self.bodies.geometryObjects)
        self._set_obstacles(scene)
        self.coordinates = Coordinates(self.model)
        start = [np.asarray(scene.start)]
        if robot.gripper is not None:
            start.append(robot.gripper.compute_positions(compute_start_opening(scene)))
        for placed in scene.objects.values():
            if placed.object.free:
                start.append(to_free_joint_positions(placed.placement))
            start.append(placed.state)
        self.start: Floats = np.concatenate(start)

    def with_obstacles(self, scene: Scene) -> World:
        """Return the world of a scene that differs in obstacles alone; it shares all the rest."""
        other = copy.copy(self)
        for name in ("collision", "visual", "visual_labels"):
            vars(other).pop(name, None)
        other._set_obstacles(scene)
        return other

    def _set_obstacles(self, scene: Scene) -> None:
        """Set the attributes that depend on the obstacles of a scene."""
        self.scene = scene
        self.shapes = (*self._body_shapes, *scene.obstacles)
        links = [get_link_name(shape.name) for shape in self._body_shapes]
        self.collision_labels = [*links, *scene.obstacle_labels]
        shape_names = [shape.name for shape in self.shapes]
        self.collision_keys = make_shape_keys(self.collision_labels, shape_names)

    @cached_property
    def collision(self) -> pin.GeometryModel:
        """All collision geometry; its construction takes quadratic time in the obstacles."""
        geometry = self.bodies.copy()
        graft_geometry(geometry, self.scene.obstacles, joints=[0], placement=pin.SE3.Identity())
        return geometry

    @cached_property
    def visual(self) -> pin.GeometryModel:
        """All visual geometry."""
        objects = {name: placed.object.visual for name, placed in self.scene.objects.items()}
        geometry = self._graft_all(self.scene.robot.visual, objects)
        graft_geometry(
            geometry, self.scene.obstacle_visual, joints=[0], placement=pin.SE3.Identity()
        )
        return geometry

    @cached_property
    def visual_labels(self) -> list[str]:
        """Link or obstacle of each shape of `visual`."""
        links = {str(frame.name) for frame in self.model.frames if frame.type == pin.FrameType.BODY}
        shapes = list(self.visual.geometryObjects)
        moving = len(shapes) - len(self.scene.obstacle_visual)
        labels = []
        for shape in shapes[:moving]:
            # A part of a shape has the name `<link>_<number>_<part>`.
            label = get_link_name(shape.name)
            while label not in links and "_" in label:
                label, _, _ = label.rpartition("_")
            labels.append(label)
        return labels + [shape.name for shape in shapes[moving:]]

    def _graft_all(
        self, robot: pin.GeometryModel, objects: Mapping[str, pin.GeometryModel]
    ) -> pin.GeometryModel:
        """Return the shapes of robot and objects, in this order."""
        geometry = pin.GeometryModel()
        identity = pin.SE3.Identity()
        robot_shapes = list(robot.geometryObjects)
        gripper = self.scene.robot.gripper
        if gripper is not None:
            robot_shapes = gripper.attach_shapes(robot_shapes, self.scene.robot.model)
        robot_joints = list(range(self._robot_joints))
        graft_geometry(geometry, robot_shapes, joints=robot_joints, placement=identity)
        for name, source in objects.items():
            placed = self.scene.objects[name]
            graft_geometry(
                geometry,
                source.geometryObjects,
                joints=self._joints[name],
                placement=identity if placed.object.free else placed.placement,
                prefix=f"{name}.",
            )
        return geometry

    def compute_positions(
        self,
        trajectory: Trajectory,
        times: ArrayLike | None = None,
        free: FreeObjects | None = None,
    ) -> Floats:
        """Compute minimal coordinates of the world along a trajectory, shape (K, n)."""
        times = trajectory.times if times is None else np.asarray(times, float)
        values = trajectory.at(times)
        rows = np.tile(self.start, (len(values), 1))
        index: Mapping[str, int] = {name: i for i, name in enumerate(self.coordinates.names)}
        for column, name in enumerate(trajectory.names):
            if name in index:  # virtual joints of grasps belong to no body
                rows[:, index[name]] = values[:, column]
        free = FreeObjects(self.scene, trajectory) if free is None else free
        for name, placements in free.at(times).items():
            rows[:, self.get_placement_columns(name)] = placements
        gripper = self.scene.robot.gripper
        if gripper is not None:
            first = len(self.scene.start)
            rows[:, first : first + len(gripper.names)] = compute_finger_positions(
                gripper, compute_start_opening(self.scene), trajectory, times
            )
        return rows

    def get_joints(self, name: str) -> list[int]:
        """Return the joints of an object in the model, including its free joint."""
        return [joint for joint in self._joints[name] if joint]

    def get_placement(self, name: str, row: Floats) -> pin.SE3:
        """Return the placement of a free object's base link from world coordinates, shape (n,)."""
        numbers = row[self.get_placement_columns(name)].copy()
        numbers[3:] /= np.linalg.norm(numbers[3:])
        return pin.XYZQUATToSE3(numbers)

    def get_placement_columns(self, name: str) -> slice:
        """Return the columns of a free object's placement in the coordinates."""
        first = self.coordinates.index(f"{name}.{FREE_JOINT}_x")
        return slice(first, first + 7)


def compute_finger_positions(
    gripper: Gripper, start: float | None, trajectory: Trajectory, times: Floats
) -> Floats:
    """Compute finger positions along a motion, shape (K, k), [m] or [rad].

    Fingers move to the opening of a phase between its first two waypoints. In the first phase they
    have that opening from the start, unless the robot rests there.

    Args:
        gripper: The gripper.
        start: Its opening before the motion [m]; None: as in the robot's rest configuration.
        trajectory: The motion.
        times: Times, shape (K,) [s].
    """
    robot = trajectory.positions[:, : trajectory.robot_size]
    is_resting_first = np.array_equal(robot[0], robot[1])
    knot_times = list[float]()
    knots = list[Floats]()
    before = gripper.compute_positions(start)
    for number, phase in enumerate(trajectory.phases):
        fingers = gripper.compute_positions(phase.opening)
        starts_before = number > 0 or is_resting_first
        for k in (phase.first, phase.first + 1, phase.last):
            knot_times.append(float(trajectory.times[k]))
        knots += [before if starts_before else fingers, fingers, fingers]
        before = fingers
    columns = np.array(knots).T
    return np.column_stack([np.interp(times, knot_times, column) for column in columns])


def compute_frame_placement(
    scene: Scene, trajectory: Trajectory, frame: str | None, time: float
) -> pin.SE3:
    """Return the placement of a frame in the world at a time of a motion [s].

    Args:
        scene: Scene of the motion.
        trajectory: The motion.
        frame: Frame of the robot, "<object>.<link>" or "<object>"; None: the tool frame.
        time: [s].

    Raises:
        UnknownNameError: There is no such frame.
    """
    frames = dict[str, str]()  # name → frame of the world's model
    for name, placed in scene.objects.items():
        for link in placed.object.links:
            frames[f"{name}.{link}"] = f"{name}.{link}"
    for name, placed in scene.objects.items():
        frames[name] = f"{name}.{placed.object.base_link}"
    for name in scene.robot.frame_names:
        frames[name] = name
    wanted = scene.robot.tool_frame if frame is None else frame
    check_choice(wanted, frames, "frame", "frame")
    world = World(scene)
    (row,) = world.compute_positions(trajectory, [time])
    data = world.model.createData()
    pin.framesForwardKinematics(world.model, data, world.coordinates.q(row))
    return data.oMf[world.model.getFrameId(frames[wanted])].copy()


def make_scene_at(scene: Scene, world: World, row: Floats, values: Mapping[str, float]) -> Scene:
    """Return a scene in which robot and objects are elsewhere, at rest, and nothing is held.

    Args:
        scene: Scene.
        world: The scene as one tree.
        row: World coordinates with the placements of free objects, shape (n,).
        values: Coordinates of the robot, and of joints of objects; clipped to their limits.
    """
    robot = np.array([values[name] for name in scene.robot.coordinates.names])
    # A joint that starts outside its limits and does not move stays there.
    lower, upper = scene.robot.start_limits
    robot = np.clip(robot, np.minimum(lower, scene.start), np.maximum(upper, scene.start))
    robot[:2] = np.clip(robot[:2], scene.arena[::2], scene.arena[1::2])
    at_rest = np.zeros(len(robot))
    after = scene.with_held({}).with_start(base=robot[:3], arm=robot[3:], velocity=at_rest)
    for name, placed in scene.objects.items():
        item = placed.object
        if item.free:
            after = after.with_placement(name, world.get_placement(name, row))
        state = dict[str, float]()
        for joint, low, high in zip(item.coordinates.names, item.lower, item.upper, strict=True):
            coordinate = f"{name}.{joint}"
            if coordinate in values:
                state[joint] = float(np.clip(values[coordinate], low, high))
        if state:
            after = after.with_state(name, state)
    return after


def compute_final_scene(scene: Scene, trajectory: Trajectory, holds: Sequence[Hold]) -> Scene:
    """Compute the scene at the end of a motion, with the holds that remain."""
    end = float(trajectory.times[-1])
    return _compute_scene(scene, trajectory, end, holds, trajectory.phases[-1].opening)


def compute_scene_at(scene: Scene, trajectory: Trajectory, time: float) -> Scene:
    """Compute the scene at a time of a motion [s], with the objects grasped then.

    While the gripper closes or opens between two phases, it is the scene before it did.
    """
    phase = find_phase_at(trajectory, time)
    return _compute_scene(scene, trajectory, time, phase.holds, phase.opening)


def find_phase_at(trajectory: Trajectory, time: float) -> PhaseSpan:
    """Return the phase at a time of a motion [s]; of a pause for the gripper, the one before."""
    times = trajectory.times
    before = trajectory.phases[0]
    for phase in trajectory.phases:
        is_pause = np.array_equal(*trajectory.positions[[phase.first, phase.first + 1]])
        changes = phase.holds != before.holds or phase.opening != before.opening
        begin = times[phase.first + 1] if is_pause and changes else times[phase.first]
        if phase is not trajectory.phases[0] and time < begin:
            break
        before = phase
    return before


def _compute_scene(
    scene: Scene,
    trajectory: Trajectory,
    time: float,
    holds: Sequence[Hold],
    opening: float | None,
) -> Scene:
    """Compute the scene at a time of a motion with given holds and gripper opening [m]."""
    values = dict(zip(trajectory.names, trajectory.at(time).tolist(), strict=True))
    world = World(scene)
    (row,) = world.compute_positions(trajectory, [time])
    there = make_scene_at(scene, world, row, values)
    holds_there = list[Hold]()
    for hold in holds:
        attachment = scene.objects[hold.object].object.attachment(hold.attachment)
        at = list[float]()
        for name, freedom in zip(attachment.coordinates, attachment.freedoms, strict=True):
            value = values[f"{hold.object}.{name}"]
            at.append(float(np.clip(value, freedom.lower, freedom.upper)))
        holds_there.append(dataclasses.replace(hold, at=tuple(at)))
    return dataclasses.replace(there.with_held(holds_there), opening=opening)


def find_coordinate_units(scene: Scene) -> dict[str, str]:
    """Return coordinate → unit, "m" or "rad", of robot, objects and freedoms of grasps."""
    robot = scene.robot.coordinates
    units = dict(zip(robot.names, robot.units, strict=True))
    for owner, placed in scene.objects.items():
        coordinates = placed.object.coordinates
        for name, unit in zip(coordinates.names, coordinates.units, strict=True):
            units[f"{owner}.{name}"] = unit
        for grasp in placed.object.attachments.values():
            for name, freedom in zip(grasp.coordinates, grasp.freedoms, strict=True):
                units[f"{owner}.{name}"] = freedom.unit
    return units
