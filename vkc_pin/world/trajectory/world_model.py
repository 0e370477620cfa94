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

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.grafting import graft, graft_geometry
from vkc_pin.world.models.grippers.gripper import Gripper
from vkc_pin.world.models.shapes import get_link_name
from vkc_pin.world.scene.clearance_exemptions import make_shape_keys
from vkc_pin.world.scene.contact_rules import compute_start_opening
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.free_objects import FreeObjects, to_free_joint_positions
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["FREE_JOINT", "World", "compute_final_scene", "find_coordinate_units"]

FREE_JOINT = "placement"
"""Name of a free object's free joint: `<object>.placement`."""


class World:
    """A scene's robot, objects and obstacles in one `pinocchio.Model`.

    Attributes:
        model: Robot (joint 1 is the planar base, fingers come last), then every object's own tree;
            joints of objects are `<object>.<joint>`, the free joint of one that can be carried
            `<object>.placement`, frames `<object>.<link>`.
        coordinates: Its minimal coordinates, n of them: the robot's, then the objects'.
        bodies: Collision geometry of robot and objects.
        shapes: These shapes, then those of the obstacles, which stand in the world (parent joint
            0).
        collision, visual: All geometry in one, put together when first asked for; what stands still
            has parent joint 0.
        collision_labels, visual_labels: For each geometry, the link or obstacle it belongs to, e.g.
            "forearm_link", "door.panel", "sofa".
        collision_keys: For each of `shapes`, its key in every model of the scene, see
            `neighbours.shape_keys`.
        start: The scene's start and the objects' placements and states, shape (n,).
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
            self._joints[name] = graft(
                self.model,
                placed.object.model,
                parent=parent,
                placement=placement,
                prefix=f"{name}.",
            )
        objects = {name: placed.object.collision for name, placed in scene.objects.items()}
        self.bodies = self._geometry(robot.collision, objects)
        self.shapes = (*self.bodies.geometryObjects, *scene.obstacles)
        self.collision_labels = [
            *(get_link_name(shape.name) for shape in self.bodies.geometryObjects),
            *scene.obstacle_labels,
        ]
        self.collision_keys = make_shape_keys(
            self.collision_labels, [shape.name for shape in self.shapes]
        )
        self.coordinates = Coordinates(self.model)
        states = [
            np.concatenate(
                [
                    to_free_joint_positions(placed.placement) if placed.object.free else [],
                    placed.state,
                ]
            )
            for placed in scene.objects.values()
        ]
        fingers = (
            np.zeros(0)
            if robot.gripper is None
            else robot.gripper.compute_positions(compute_start_opening(scene))
        )
        self.start: Floats = np.concatenate([np.asarray(scene.start), fingers, *states])

    @cached_property
    def collision(self) -> pin.GeometryModel:
        """What collides, as one; with many obstacles that takes a while, as Pinocchio's models take quadratic time to grow."""
        geometry = self.bodies.copy()
        graft_geometry(geometry, self.scene.obstacles, joints=[0], placement=pin.SE3.Identity())
        return geometry

    @cached_property
    def visual(self) -> pin.GeometryModel:
        """What to draw; put together when first asked for, since meshes for display are large."""
        objects = {name: placed.object.visual for name, placed in self.scene.objects.items()}
        geometry = self._geometry(self.scene.robot.visual, objects)
        graft_geometry(
            geometry, self.scene.obstacle_visual, joints=[0], placement=pin.SE3.Identity()
        )
        return geometry

    @cached_property
    def visual_labels(self) -> list[str]:
        """For each geometry of `visual`, the link or obstacle it belongs to."""
        links = {str(frame.name) for frame in self.model.frames if frame.type == pin.FrameType.BODY}
        shapes = list(self.visual.geometryObjects)
        moving = len(shapes) - len(self.scene.obstacle_visual)
        labels = []
        for shape in shapes[:moving]:
            label = get_link_name(shape.name)
            while (
                label not in links and "_" in label
            ):  # a mesh of several parts is `<link>_<number>_<part>`
                label = label.rpartition("_")[0]
            labels.append(label)
        return labels + [shape.name for shape in shapes[moving:]]

    def _geometry(
        self, robot: pin.GeometryModel, objects: Mapping[str, pin.GeometryModel]
    ) -> pin.GeometryModel:
        """Return the shapes of robot and objects, in this order."""
        geometry, here, gripper = pin.GeometryModel(), pin.SE3.Identity(), self.scene.robot.gripper
        own = list(robot.geometryObjects)
        own = own if gripper is None else gripper.attach_shapes(own, self.scene.robot.model)
        graft_geometry(geometry, own, joints=list(range(self._robot_joints)), placement=here)
        for name, source in objects.items():
            placed = self.scene.objects[name]
            where = here if placed.object.free else placed.placement
            graft_geometry(
                geometry,
                source.geometryObjects,
                joints=self._joints[name],
                placement=where,
                prefix=f"{name}.",
            )
        return geometry

    def compute_positions(
        self,
        trajectory: Trajectory,
        times: ArrayLike | None = None,
        free: FreeObjects | None = None,
    ) -> Floats:
        """Compute minimal coordinates of the world along a trajectory, shape (K, n).

        Args:
            trajectory: Motion in this scene. Coordinates that it does not name keep their start
                values, except for free objects.
            times: Increasing times, shape (K,) [s]. Default: the waypoints.
            free: Free objects along the trajectory, if they exist already.
        """
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
            rows[:, first : first + len(gripper.names)] = _fingers(
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


def _fingers(
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


def compute_final_scene(scene: Scene, trajectory: Trajectory, holds: Sequence[Hold]) -> Scene:
    """Compute the scene at the end of a motion.

    Args:
        scene: Scene at the start.
        trajectory: Motion.
        holds: Holds at the end.
    """
    last = dict(zip(trajectory.names, trajectory.positions[-1].tolist(), strict=True))

    def end(coordinate: str, lower: float, upper: float) -> float:
        return float(np.clip(last[coordinate], lower, upper))

    robot = np.clip(
        trajectory.positions[-1, : trajectory.robot_size], scene.robot.lower, scene.robot.upper
    )
    robot[:2] = np.clip(robot[:2], scene.arena[::2], scene.arena[1::2])
    after = scene.with_held({}).with_start(base=robot[:3], arm=robot[3:])
    world = World(scene)
    (row,) = world.compute_positions(trajectory, trajectory.times[-1:])
    for name, placed in scene.objects.items():
        thing = placed.object
        if thing.free:
            after = after.with_placement(name, world.get_placement(name, row))
        joints = zip(thing.coordinates.names, thing.lower, thing.upper, strict=True)
        state = {
            joint: end(f"{name}.{joint}", low, high)
            for joint, low, high in joints
            if f"{name}.{joint}" in last
        }
        if state:
            after = after.with_state(name, state)
    held = []
    for hold in holds:
        attachment = scene.objects[hold.object].object.attachment(hold.attachment)
        freedoms = zip(attachment.coordinates, attachment.freedoms, strict=True)
        at = tuple(
            end(f"{hold.object}.{name}", freedom.lower, freedom.upper) for name, freedom in freedoms
        )
        held.append(dataclasses.replace(hold, at=at))
    return dataclasses.replace(after.with_held(held), opening=trajectory.phases[-1].opening)


def find_coordinate_units(scene: Scene) -> dict[str, str]:
    """Return coordinate → unit, "m" or "rad", of robot, objects and freedoms of grasps."""
    units = dict(zip(scene.robot.coordinates.names, scene.robot.coordinates.units, strict=True))
    for owner, placed in scene.objects.items():
        own = dict(
            zip(placed.object.coordinates.names, placed.object.coordinates.units, strict=True)
        )
        for attachment in placed.object.attachments.values():
            own |= {
                name: freedom.unit
                for name, freedom in zip(attachment.coordinates, attachment.freedoms, strict=True)
            }
        units |= {f"{owner}.{name}": unit for name, unit in own.items()}
    return units
