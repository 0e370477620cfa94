"""Models a scene as one plain kinematic tree of robot and objects, rooted in the world.

Validation and visualization use this model. It is independent of the virtual kinematic chain, so
that it reveals errors of the chain. Free objects have free joints, whose positions `FreeObjects`
computes. The fingers of a gripper are joints.
"""

from __future__ import annotations

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
            parent, placement = 0, placed.placement
            if placed.object.free:
                parent = self.model.addJoint(
                    0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), f"{name}.{FREE_JOINT}"
                )
                placement = pin.SE3.Identity()
            own, prefix = placed.object.model, f"{name}."
            self._joints[name] = graft(
                self.model, own, parent=parent, placement=placement, prefix=prefix
            )
        objects = {name: placed.object.collision for name, placed in scene.objects.items()}
        self.bodies = self._graft_all(robot.collision, objects)
        self.shapes = (*self.bodies.geometryObjects, *scene.obstacles)
        self.collision_labels = [
            *(get_link_name(shape.name) for shape in self.bodies.geometryObjects),
            *scene.obstacle_labels,
        ]
        self.collision_keys = make_shape_keys(
            self.collision_labels, [shape.name for shape in self.shapes]
        )
        self.coordinates = Coordinates(self.model)
        start = [np.asarray(scene.start)]
        if robot.gripper is not None:
            start.append(robot.gripper.compute_positions(compute_start_opening(scene)))
        for placed in scene.objects.values():
            if placed.object.free:
                start.append(to_free_joint_positions(placed.placement))
            start.append(placed.state)
        self.start: Floats = np.concatenate(start)

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
            label = get_link_name(shape.name)
            while label not in links and "_" in label:  # a part is `<link>_<number>_<part>`
                label = label.rpartition("_")[0]
            labels.append(label)
        return labels + [shape.name for shape in shapes[moving:]]

    def _graft_all(
        self, robot: pin.GeometryModel, objects: Mapping[str, pin.GeometryModel]
    ) -> pin.GeometryModel:
        """Return the shapes of robot and objects, in this order."""
        geometry, here, gripper = pin.GeometryModel(), pin.SE3.Identity(), self.scene.robot.gripper
        own = list(robot.geometryObjects)
        own = own if gripper is None else gripper.attach_shapes(own, self.scene.robot.model)
        graft_geometry(geometry, own, joints=list(range(self._robot_joints)), placement=here)
        for name, source in objects.items():
            placed = self.scene.objects[name]
            where, joints = here if placed.object.free else placed.placement, self._joints[name]
            shapes, prefix = source.geometryObjects, f"{name}."
            graft_geometry(geometry, shapes, joints=joints, placement=where, prefix=prefix)
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
            rows[:, first : first + len(gripper.names)] = _compute_finger_positions(
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


def _compute_finger_positions(
    gripper: Gripper, start: float | None, trajectory: Trajectory, times: Floats
) -> Floats:
    """Compute finger positions along a motion, shape (K, k), [m] or [rad].

    Fingers move to the opening of a phase between its first two waypoints. In the first phase they
    have that opening from the start, unless the robot rests there.
    """
    before, moments, values = gripper.compute_positions(start), list[float](), list[Floats]()
    robot = trajectory.positions[:, : trajectory.robot_size]
    for number, phase in enumerate(trajectory.phases):
        here = gripper.compute_positions(phase.opening)
        begin, then, end = (
            float(trajectory.times[k]) for k in (phase.first, phase.first + 1, phase.last)
        )
        still = number > 0 or np.array_equal(robot[0], robot[1])
        moments += [begin, then, end]
        values += [before if still else here, here, here]
        before = here
    return np.column_stack([np.interp(times, moments, column) for column in np.array(values).T])


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
    links = {
        f"{name}.{link}": f"{name}.{link}"
        for name, placed in scene.objects.items()
        for link in placed.object.links
    }
    bases = {name: f"{name}.{placed.object.base_link}" for name, placed in scene.objects.items()}
    robot = {name: name for name in scene.robot.frame_names}
    known = {**links, **bases, **robot}
    wanted = scene.robot.tool_frame if frame is None else frame
    check_choice(wanted, known, "frame", "frame")
    world = World(scene)
    (row,) = world.compute_positions(trajectory, [time])
    data = world.model.createData()
    pin.framesForwardKinematics(world.model, data, world.coordinates.q(row))
    return data.oMf[world.model.getFrameId(known[wanted])].copy()


def make_scene_at(scene: Scene, world: World, row: Floats, values: Mapping[str, float]) -> Scene:
    """Return a scene in which robot and objects are elsewhere, and nothing is held.

    Args:
        scene: Scene.
        world: The scene as one tree.
        row: World coordinates with the placements of free objects, shape (n,).
        values: Coordinates of the robot, and of joints of objects; clipped to their limits.
    """
    robot = np.array([values[name] for name in scene.robot.coordinates.names])
    # A joint that stands still where it starts outside its limits stays there.
    lower, upper = scene.robot.start_limits
    robot = np.clip(robot, np.minimum(lower, scene.start), np.maximum(upper, scene.start))
    robot[:2] = np.clip(robot[:2], scene.arena[::2], scene.arena[1::2])
    after = scene.with_held({}).with_start(base=robot[:3], arm=robot[3:])
    for name, placed in scene.objects.items():
        item = placed.object
        if item.free:
            after = after.with_placement(name, world.get_placement(name, row))
        joints = zip(item.coordinates.names, item.lower, item.upper, strict=True)
        state = {
            joint: float(np.clip(values[f"{name}.{joint}"], low, high))
            for joint, low, high in joints
            if f"{name}.{joint}" in values
        }
        if state:
            after = after.with_state(name, state)
    return after


def compute_final_scene(scene: Scene, trajectory: Trajectory, holds: Sequence[Hold]) -> Scene:
    """Compute the scene at the end of a motion."""
    last = dict(zip(trajectory.names, trajectory.positions[-1].tolist(), strict=True))
    world = World(scene)
    (row,) = world.compute_positions(trajectory, trajectory.times[-1:])
    after, held = make_scene_at(scene, world, row, last), []
    for hold in holds:
        attachment = scene.objects[hold.object].object.attachment(hold.attachment)
        freedoms = zip(attachment.coordinates, attachment.freedoms, strict=True)
        at = tuple(
            float(np.clip(last[f"{hold.object}.{name}"], freedom.lower, freedom.upper))
            for name, freedom in freedoms
        )
        held.append(dataclasses.replace(hold, at=at))
    return dataclasses.replace(after.with_held(held), opening=trajectory.phases[-1].opening)


def find_coordinate_units(scene: Scene) -> dict[str, str]:
    """Return coordinate → unit, "m" or "rad", of robot, objects and freedoms of grasps."""
    own = scene.robot.coordinates
    units = dict(zip(own.names, own.units, strict=True))
    for owner, placed in scene.objects.items():
        own = placed.object.coordinates
        pairs = [*zip(own.names, own.units, strict=True)]
        for grasp in placed.object.attachments.values():
            pairs += zip(grasp.coordinates, (one.unit for one in grasp.freedoms), strict=True)
        units |= {f"{owner}.{name}": unit for name, unit in pairs}
    return units
