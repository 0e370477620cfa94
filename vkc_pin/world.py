"""The scene as one plain tree, nothing inverted: robot and objects side by side, rooted in the world.

Validation, pictures and plots use it; being built without the chain, it can catch the chain's mistakes.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

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
        self._joints = {
            name: graft(self.model, placed.object.model, parent=0, placement=placed.placement, prefix=f"{name}.")
            for name, placed in scene.objects.items()
        }
        self.collision = self._geometry(
            robot.collision, {name: placed.object.collision for name, placed in scene.objects.items()}, scene.obstacles
        )
        self.collision_labels = [
            *(_link(shape) for shape in robot.collision.geometryObjects),
            *(f"{n}.{_link(shape)}" for n, placed in scene.objects.items() for shape in placed.object.collision.geometryObjects),
            *scene.obstacle_labels,
        ]
        self.coordinates = Coordinates(self.model)
        states = [np.asarray(placed.state) for placed in scene.objects.values()]
        self.start: NDArray[np.float64] = np.concatenate([np.asarray(scene.start), *states])

    @cached_property
    def visual(self) -> pin.GeometryModel:
        """What to draw; put together when first asked for, since meshes for display are large."""
        objects = {name: placed.object.visual for name, placed in self.scene.objects.items()}
        return self._geometry(self.scene.robot.visual, objects, self.scene.obstacle_visual)

    @cached_property
    def visual_labels(self) -> list[str]:
        """For each geometry of `visual`, the link or obstacle it belongs to."""
        links = {str(frame.name) for frame in self.model.frames if frame.type == pin.FrameType.BODY}
        shapes = list(self.visual.geometryObjects)
        moving = len(shapes) - len(self.scene.obstacle_visual.geometryObjects)
        labels = []
        for shape in shapes[:moving]:
            label = _link(shape)
            while label not in links and "_" in label:  # a mesh of several parts is `<link>_<number>_<part>`
                label = label.rpartition("_")[0]
            labels.append(label)
        return labels + [shape.name for shape in shapes[moving:]]

    def _geometry(
        self, robot: pin.GeometryModel, objects: Mapping[str, pin.GeometryModel], obstacles: pin.GeometryModel
    ) -> pin.GeometryModel:
        """Return the shapes of robot, objects and obstacles, in this order."""
        geometry, here = pin.GeometryModel(), pin.SE3.Identity()
        graft_geometry(geometry, robot.geometryObjects, joints=list(range(self.scene.robot.model.njoints)), placement=here)
        for name, source in objects.items():
            where = self.scene.objects[name].placement
            graft_geometry(geometry, source.geometryObjects, joints=self._joints[name], placement=where, prefix=f"{name}.")
        graft_geometry(geometry, obstacles.geometryObjects, joints=[0], placement=here)
        return geometry

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


def _link(shape: pin.GeometryObject) -> str:
    """Return the link's name: Pinocchio calls its geometries `<link>_<number>`."""
    return str(shape.name).rpartition("_")[0]
