"""The scene as one plain tree, nothing inverted: robot and objects side by side, rooted in the world.

Validation, pictures and plots use it; being built without the chain, it can catch the chain's mistakes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from vkc_pin.assembly import graft, graft_geometry
from vkc_pin.coordinates import Coordinates
from vkc_pin.scene import Scene
from vkc_pin.trajectory import Trajectory

__all__ = ["World"]


class World:
    """A scene's robot, objects and obstacles in one `pinocchio.Model`.

    Attributes:
        model: Robot (joint 1 is the planar base), then every object's own tree; joints of objects are `<object>.<joint>`,
            frames `<object>.<link>`.
        coordinates: Its minimal coordinates, n of them: the robot's, then the objects'.
        collision, visual: Geometry; what stands still has parent joint 0.
        collision_labels, visual_labels: For each geometry, the link or obstacle it belongs to, e.g. "forearm_link",
            "door.panel", "sofa".
        start: The scene's start and the objects' states, shape (n,).
    """

    def __init__(self, scene: Scene) -> None:
        robot = scene.robot
        self.scene = scene
        self.model = pin.Model(robot.model)
        self.collision, self.visual = pin.GeometryModel(), pin.GeometryModel()
        same = list(range(self.model.njoints))
        graft_geometry(self.collision, robot.collision.geometryObjects, joints=same, placement=pin.SE3.Identity())
        graft_geometry(self.visual, robot.visual.geometryObjects, joints=same, placement=pin.SE3.Identity())
        self.collision_labels = [robot.link_of(i) for i in range(len(robot.collision.geometryObjects))]
        self.visual_labels = [shape.name.rpartition("_")[0] for shape in robot.visual.geometryObjects]
        start = [np.asarray(scene.start)]
        for name, placed in scene.objects.items():
            joints = graft(self.model, placed.object.model, parent=0, placement=placed.placement, prefix=f"{name}.")
            for geometry, labels, source in (
                (self.collision, self.collision_labels, placed.object.collision),
                (self.visual, self.visual_labels, placed.object.visual),
            ):
                graft_geometry(geometry, source.geometryObjects, joints=joints, placement=placed.placement, prefix=f"{name}.")
                labels += [f"{name}.{shape.name.rpartition('_')[0]}" for shape in source.geometryObjects]
            start.append(np.asarray(placed.state))
        graft_geometry(self.collision, scene.obstacles.geometryObjects, joints=[0], placement=pin.SE3.Identity())
        self.collision_labels += scene.obstacle_labels
        graft_geometry(self.visual, scene.obstacle_visual.geometryObjects, joints=[0], placement=pin.SE3.Identity())
        self.visual_labels += [shape.name for shape in scene.obstacle_visual.geometryObjects]
        self.coordinates = Coordinates(self.model)
        self.start: NDArray[np.float64] = np.concatenate(start)

    def positions(self, trajectory: Trajectory, times: ArrayLike | None = None) -> NDArray[np.float64]:
        """Return minimal coordinates, shape (K, n), of the world along `trajectory`.

        Args:
            trajectory: A motion in this scene; what it does not name stays as it is at the start.
            times: [s], shape (K,); None takes the waypoints.
        """
        values = trajectory.positions if times is None else trajectory.at(times)
        rows = np.tile(self.start, (len(values), 1))
        index: Mapping[str, int] = {name: i for i, name in enumerate(self.coordinates.names)}
        for column, name in enumerate(trajectory.names):
            if name in index:  # virtual joints of grasps belong to no body
                rows[:, index[name]] = values[:, column]
        return rows
