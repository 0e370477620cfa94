"""Draws a scene and its motion with meshcat commands.

Every joint is a node below its parent joint's node. The viewer's interpolation of joints then
follows the motion to 5 mm or 5 mrad, from few numbers per joint and key frame.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import meshcat
import meshcat.geometry as g
import numpy as np
import pinocchio as pin
from meshcat.animation import Animation, AnimationClip
from meshcat.animation import AnimationTrack as Track
from meshcat.commands import SetAnimation

from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.validation.report import Report
from vkc_pin.visualization.camera import FIELD_OF_VIEW, LANDSCAPE, PORTRAIT, choose_viewpoint
from vkc_pin.visualization.room import Part, Room, load_drawn_parts
from vkc_pin.visualization.threejs import (
    Ghost,
    Solid,
    Sun,
    Triangles,
    Unshadow,
    add_node,
    encode_colour,
    make_material,
    make_tube,
    merge_solids,
    simplify,
    to_solid,
)
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.placements import Motion, sample_motion
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# colours of the ghosts
_START = (0.22, 0.42, 0.78)
_END = (0.10, 0.60, 0.38)
# colours of the paths, and their radii [m]
_TOOL = (0.88, 0.20, 0.35)
_BASE = (0.16, 0.42, 0.72)
_TOOL_RADIUS = 0.008
_BASE_RADIUS = 0.014
# [m] height of the base's path, above the floor's grid
_BASE_HEIGHT = 0.006
# [rad], [m] between points of a path: chords of 1 m radius are 0.3 mm off
_PATH_STEP = 0.05
# colour of colliding links
_ALARM = (0.90, 0.05, 0.05)
# [s] for which they are red before and after
_ALARM_TIME = 0.4
# [s] in which their colour changes
_ALARM_FADE = 0.05
# [m] of meshes
_GHOST_DETAIL = 0.007
# colours of the axes of frames
_AXES = {"x": (0.86, 0.13, 0.13), "y": (0.13, 0.60, 0.16), "z": (0.11, 0.27, 0.90)}
# [m]
_AXIS_LENGTH = 0.16
_AXIS_RADIUS = 0.007
# path of the second motion in the tree
_BESIDE = "beside"
# what meshcat shows by itself
_HIDDEN = (
    "/Grid",
    "/Axes",
    "/Lights/PointLightNegativeX",
    "/Lights/PointLightPositiveX",
    "/Lights/FillLight",
)
# opacity of objects where they may hide the motion
_OBJECT_OPACITY = 0.3
# about the number of points of a part that are used to choose the viewpoint
_POINTS_PER_PART = 60
_meshes: weakref.WeakKeyDictionary[Robot, list[Solid]] = weakref.WeakKeyDictionary()


Displacements = Mapping[str, tuple[Floats, Sequence[pin.SE3]]]
"""Name of an obstacle → times, shape (K,) [s], and its displacement in the world at each."""


@dataclass(frozen=True, eq=False)
class Item:
    """A drawn shape: path in the viewer, joint, placement in its frame, mesh, colour, label."""

    path: str
    joint: int
    placement: pin.SE3
    solid: Solid
    _: KW_ONLY
    colour: tuple[float, ...]
    label: str


class Drawing:
    """A scene, and a motion in it, as meshcat commands.

    Args:
        viewer: A meshcat viewer, or anything that takes its commands.
        scene: Scene to draw, at its start.
        trajectory: Motion to animate. Its start and end appear as ghosts.
        report: Validation report. Links in collision turn red at that time.
        world: World of the scene. Default: built from the scene.
        times: Times of the key frames, shape (K,) [s]. Default: as many as necessary.
        beside: Second motion at these times, drawn as a ghost.
        moving: Obstacle that moves → times, shape (K,) [s], and its displacements from where the
            scene has it, in the world. Walls are drawn where they are.
    """

    def __init__(
        self,
        viewer: meshcat.Visualizer,
        scene: Scene,
        trajectory: Trajectory | None = None,
        report: Report | None = None,
        *,
        world: World | None = None,
        times: Floats | None = None,
        beside: Motion | None = None,
        moving: Displacements | None = None,
    ) -> None:
        self.viewer = viewer
        self.scene = scene
        self.trajectory = trajectory
        self.report = report
        self.beside = beside
        self.moving: Displacements = {} if moving is None else moving
        self.world = World(scene) if world is None else world
        self.motion: Motion = sample_motion(self.world, trajectory, times)
        self.room = Room(scene)
        self.taken: set[str] = set()  # paths in the tree
        self.nodes = self._find_nodes()
        self.movers = self._find_movers()
        self.items = [*self._make_robot_items(), *self._make_object_items()]
        self.light: list[Solid | None] = []  # coarse meshes of moving bodies, for ghosts

    def draw(self, *, play: bool = True, frames: Mapping[str, pin.SE3] | None = None) -> None:
        """Draw everything into the viewer, and replace its content.

        Args:
            play: Whether to start playback at once.
            frames: Name → placement in the world of static frames to draw.
        """
        self.viewer.delete()
        self._set_surroundings()
        for item in self.items:
            opacity = item.colour[3] if len(item.colour) > 3 else 1.0
            part = Part(item.path, item.solid, item.colour, opacity, shadow=opacity >= 1.0)
            self._draw_part(part)
            self.viewer[item.path].set_transform(item.placement.homogeneous)
        for joint in range(1, self.world.model.njoints):
            placement = self.motion.local[joint][0]
            self.viewer[self.nodes[joint]].set_transform(placement.homogeneous)
        self._draw_room()
        self._draw_frames(frames or {}, set())
        if self.trajectory is not None:
            self._draw_paths(self.trajectory)
            self.light = self._make_light_meshes()
            if self.beside is None:
                self._draw_ghosts("start", 0, _START)
                self._draw_ghosts("end", -1, _END)
            else:
                self._draw_second_motion(self.beside)
        self.viewer.window.send(SetAnimation(self._make_animation(), play=play, repetitions=1))

    def find_portrait_position(self) -> list[float]:
        """Choose the position of MeshCat's camera on an upright screen, as `_set_surroundings`."""
        target, position = self.find_viewpoint(PORTRAIT)
        return _convert_to_meshcat(position - target)

    def find_viewpoint(self, aspect: float = LANDSCAPE) -> tuple[Floats, Floats]:
        """Choose target and position of the camera so that motion and objects are visible."""
        motion = self.motion
        up = np.array([0.0, 0.0, 1.0])
        # The base on the floor with 0.6 m around it, 1 m above, and the tool.
        around = 0.6 * np.array(
            [[-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0]]
        )
        points = [
            (motion.base[:, None] * (1.0 - up) + around).reshape(-1, 3),
            motion.base + up,
            motion.tool,
        ]
        boxes = self.room.find_obstructions()
        rows = [0, len(motion.times) // 2, -1]
        for item in self.items:
            if not item.path.startswith("objects"):
                continue
            vertices = item.solid.transform(item.placement).vertices
            for placement in motion.world[rows, item.joint]:
                placed = vertices @ placement[:3, :3].T + placement[:3, 3]
                points.append(placed)
                boxes.append((placed.min(axis=0), placed.max(axis=0), _OBJECT_OPACITY))
        some = [part[:: max(1, len(part) // _POINTS_PER_PART)] for part in points]
        return choose_viewpoint(np.concatenate(some), boxes, aspect)

    def _find_nodes(self) -> list[str]:
        """Return the path of every joint in the tree."""
        model = self.world.model
        nodes = ["robot"]
        for j in range(1, model.njoints):
            joint = str(model.names[j])
            root = "robot"
            owner, _, rest = joint.partition(".")
            if rest and owner in self.scene.objects:
                root = f"objects/{owner}"
                joint = rest
            above = nodes[model.parents[j]] if model.parents[j] else root
            nodes.append(add_node(self.taken, above, joint))
        return nodes

    def _make_robot_items(self) -> list[Item]:
        """Return the shapes of the robot's links."""
        robot = self.scene.robot
        sources = robot.visual.geometryObjects
        if robot not in _meshes:
            _meshes[robot] = [to_solid(shape.geometry) for shape in sources]
        solids = _meshes[robot]
        # The robot's shapes are the first, on the joints of its fingers, too.
        placed = list(self.world.visual.geometryObjects)[: len(solids)]
        items: list[Item] = []
        for source, shape, solid in zip(sources, placed, solids, strict=True):
            link = str(robot.model.frames[source.parentFrame].name)
            path = add_node(self.taken, self.nodes[shape.parentJoint], link, shape.name)
            colour = tuple(float(value) for value in shape.meshColor)
            items.append(
                Item(path, shape.parentJoint, shape.placement, solid, colour=colour, label=link)
            )
        return items

    def _make_object_items(self) -> list[Item]:
        """Return the shapes of the objects' links."""
        shapes = list(self.world.visual.geometryObjects)
        labels = self.world.visual_labels
        first = len(self.scene.robot.visual.geometryObjects)
        end = len(shapes) - len(self.scene.obstacle_visual)
        items: list[Item] = []
        for shape, label in zip(shapes[first:end], labels[first:end], strict=True):
            joint = shape.parentJoint
            owner, _, link = label.partition(".")
            root = self.nodes[joint] if joint else f"objects/{owner}"
            own_name = shape.name.partition(".")[2]
            for k, (solid, colour) in enumerate(load_drawn_parts(shape)):
                name = f"{own_name}_{k}" if k else own_name
                path = add_node(self.taken, root, link, name)
                items.append(Item(path, joint, shape.placement, solid, colour=colour, label=label))
        return items

    def _make_light_meshes(self) -> list[Solid | None]:
        """Return coarse meshes of the moving items; None for the others."""
        is_moving = np.zeros(self.world.model.njoints, bool)
        for joints in self.movers.values():
            is_moving |= joints
        return [
            simplify(item.solid, _GHOST_DETAIL) if is_moving[item.joint] else None
            for item in self.items
        ]

    def _draw_room(self) -> None:
        """Draw obstacles, measured points, floor and edges of walls."""
        for part in self.room.make_parts():
            self._draw_part(replace(part, name=f"room/{part.name}"))
        for name, points, radius, colour in self.room.make_clouds():
            colours = np.tile(np.array(colour, np.float32)[:, None], len(points))
            cloud = g.PointCloud(points.astype(np.float32).T, colours, size=2.0 * radius)
            self._draw_without_shadow(f"room/{name}", cloud)
        for name, points, grey in self.room.make_lines():
            thin = g.LineBasicMaterial(color=encode_colour((grey, grey, grey)))
            geometry = g.PointsGeometry(points.astype(np.float32).T)
            self._draw_without_shadow(f"room/{name}", g.LineSegments(geometry, thin))

    def _draw_part(self, part: Part) -> None:
        """Draw a mesh."""
        paint = make_material(part.colour, part.opacity, one_sided=part.one_sided)
        if part.shadow:
            self.viewer[part.name].set_object(Triangles(part.solid), paint)
        else:
            self._draw_without_shadow(part.name, Triangles(part.solid), paint)

    def _draw_without_shadow(self, path: str, *what: Any) -> None:
        """Draw an object, or a geometry and its material, that casts no shadow."""
        self.viewer[path].set_object(*what)
        self.viewer.window.send(Unshadow(self.viewer[path].path))

    def _draw_frames(self, frames: Mapping[str, pin.SE3], taken: set[str]) -> None:
        """Draw the axes of frames in front of everything, since they may lie inside of bodies."""
        for name, placement in frames.items():
            where = add_node(taken, "frames", name)
            for (axis, colour), end in zip(_AXES.items(), np.eye(3), strict=True):
                solid = make_tube(np.stack([np.zeros(3), _AXIS_LENGTH * end]), _AXIS_RADIUS)
                assert solid is not None
                # Only what counts as translucent is drawn after the bodies.
                material = g.MeshBasicMaterial(
                    color=encode_colour(colour), transparent=True, depthTest=False
                )
                self._draw_without_shadow(f"{where}/{axis}", Triangles(solid), material)
            self.viewer[where].set_transform(placement.homogeneous)

    def _draw_paths(self, trajectory: Trajectory) -> None:
        """Draw the paths of tool and base as tubes."""
        motion = sample_motion(self.world, trajectory, step=_PATH_STEP)
        on_floor = motion.base * [1.0, 1.0, 0.0] + [0.0, 0.0, _BASE_HEIGHT]
        self._draw_tube("paths/tool", motion.tool, _TOOL_RADIUS, _TOOL)
        self._draw_tube("paths/base", on_floor, _BASE_RADIUS, _BASE)

    def _draw_tube(
        self, path: str, points: Floats, radius: float, colour: tuple[float, float, float]
    ) -> None:
        """Draw a tube along points, unless these are all in one place."""
        solid = make_tube(points, radius)
        if solid is not None:
            flat = g.MeshBasicMaterial(color=encode_colour(colour))
            self._draw_without_shadow(path, Triangles(solid), flat)

    def _draw_ghosts(self, name: str, row: int, colour: tuple[float, float, float]) -> None:
        """Draw moving bodies at `row` as ghosts, one each for the robot and every object."""
        for owner, joints in self.movers.items():
            solids: list[Solid] = []
            for item, light in zip(self.items, self.light, strict=True):
                if light is not None and joints[item.joint]:
                    joint = pin.SE3(self.motion.world[row, item.joint])
                    solids.append(light.transform(joint * item.placement))
            if solids:
                ghost = Ghost(merge_solids(solids), colour)
                self.viewer[f"ghosts/{name}/{owner}"].set_object(ghost)

    def _draw_second_motion(self, beside: Motion) -> None:
        """Draw the ghosts of the second motion."""
        for item, light in zip(self.items, self.light, strict=True):
            if light is not None:
                ghost = f"{_BESIDE}/{item.path}"
                self.viewer[ghost].set_object(Ghost(light, _START))
                self.viewer[ghost].set_transform(item.placement.homogeneous)
        for joint in range(1, self.world.model.njoints):
            node = self.viewer[f"{_BESIDE}/{self.nodes[joint]}"]
            node.set_transform(beside.local[joint][0].homogeneous)

    def _find_movers(self) -> dict[str, Bools]:
        """Return the masks of moving joints, shape (joints,), of the robot and of every object."""
        model = self.world.model
        is_moving = self.motion.moving.copy()
        movers: dict[str, Bools] = {}
        for j in range(1, model.njoints):
            is_moving[j] |= is_moving[model.parents[j]]
            if not is_moving[j]:
                continue
            owner = "robot"
            if self.nodes[j].startswith("objects/"):
                owner = self.nodes[j].split("/")[1]
            movers.setdefault(owner, np.zeros(model.njoints, bool))[j] = True
        return movers

    def _set_surroundings(self) -> None:
        """Set up camera, lights and background, and hide meshcat's own grid and axes."""
        viewer = self.viewer
        target, position = self.find_viewpoint()
        # meshcat's camera turns about the origin of its world, so the drawing moves there, not the
        # camera.
        viewer.set_transform(pin.SE3(np.eye(3), -target).homogeneous)
        lens = viewer["/Cameras/default/rotated/<object>"]
        lens.set_property("fov", FIELD_OF_VIEW)
        lens.set_property("position", _convert_to_meshcat(position - target))
        for name in _HIDDEN:
            viewer[name].set_property("visible", False)
        viewer["/Lights/AmbientLight/<object>"].set_property("intensity", 0.62)
        sun = Sun(self.room.centre - target, self.room.reach, position - target)
        viewer["/Lights/Sun"].set_object(sun)
        viewer["/Background"].set_property("top_color", [0.93, 0.95, 0.97])
        viewer["/Background"].set_property("bottom_color", [0.99, 0.99, 0.99])

    def _make_animation(self) -> Animation:
        """Make the animation, with key frames in seconds, since the frame rate is 1."""
        movie = Animation(default_framerate=1)
        if self.trajectory is None:
            return movie
        self._animate_joints(movie, self.motion, "")
        if self.beside is None:
            self._animate_ghosts(movie, "start", 0)
            self._animate_ghosts(movie, "end", -1)
        else:
            self._animate_joints(movie, self.beside, f"{_BESIDE}/")
        self._animate_collisions(movie)
        self._animate_obstacles(movie)
        return movie

    def _animate_joints(self, movie: Animation, motion: Motion, above: str) -> None:
        """Animate the moving joints, whose nodes are below `above`."""
        times = (self.motion.times - self.motion.times[0]).tolist()
        for j in np.flatnonzero(motion.moving):
            local = motion.local[j]
            rotations = [pin.Quaternion(placement.rotation) for placement in local]
            quaternions = [rotation.coeffs().tolist() for rotation in rotations]
            tracks = [Track("quaternion", "quaternion", times, quaternions)]
            positions = [placement.translation.tolist() for placement in local]
            if np.ptp(positions, axis=0).max() > 1e-9:
                tracks.append(Track("position", "vector3", times, positions))
            self._add_clip(movie, above + self.nodes[j], tracks)

    def _animate_ghosts(self, movie: Animation, name: str, row: int) -> None:
        """Show the ghosts of a row while the bodies are elsewhere."""
        times = (self.motion.times - self.motion.times[0]).tolist()
        for owner, joints in self.movers.items():
            away = self.motion.away(joints, row).tolist()
            track = Track("visible", "bool", times, away)
            self._add_clip(movie, f"ghosts/{name}/{owner}", [track])

    def _animate_collisions(self, movie: Animation) -> None:
        """Colour links in collision red."""
        violations = self.report.violations if self.report is not None else ()
        collisions = [v for v in violations if v.constraint in ("clearance", "penetration")]
        for item in self.items:
            moments = [v.time for v in collisions if item.label in v.subject.split(" – ")]
            if moments:
                self._add_clip(movie, f"{item.path}/<object>", [self._make_alarm(item, moments)])

    def _animate_obstacles(self, movie: Animation) -> None:
        """Move obstacles, whose meshes are drawn where the scene has them."""
        labels = self.scene.obstacle_visual_labels
        for shape, label in zip(self.scene.obstacle_visual, labels, strict=True):
            if label not in self.moving:
                continue
            times, displacements = self.moving[label]
            quaternions = []
            positions = []
            for displacement in displacements:
                quaternions.append(pin.Quaternion(displacement.rotation).coeffs().tolist())
                positions.append(displacement.translation.tolist())
            since = (times - self.motion.times[0]).tolist()
            turns = Track("quaternion", "quaternion", since, quaternions)
            shifts = Track("position", "vector3", since, positions)
            self._add_clip(movie, f"room/{shape.name}", [turns, shifts])

    def _make_alarm(self, item: Item, moments: list[float]) -> Track:
        """Make a track that colours an item red around `moments` [s]."""
        first = self.motion.times[0]
        last = self.motion.times[-1]
        edges = {first, last}
        for moment in moments:
            for distance in (_ALARM_TIME, _ALARM_TIME - _ALARM_FADE):
                edges.update((moment - distance, moment + distance))
        times = sorted(time for time in edges if first <= time <= last)
        colours: list[list[float]] = []
        for time in times:
            is_red = any(abs(time - moment) < _ALARM_TIME - 0.02 for moment in moments)
            colour = _ALARM if is_red else item.colour[:3]
            colours.append([float(value) for value in colour])
        return Track("material.color", "color", [float(t - first) for t in times], colours)

    def _add_clip(self, movie: Animation, path: str, tracks: list[Track]) -> None:
        where = self.viewer[path].path
        movie.clips[where] = AnimationClip({track.name: track for track in tracks}, fps=1)


def _convert_to_meshcat(vector: Floats) -> list[float]:
    """Return a vector in the frame of MeshCat's camera, whose y axis points upwards."""
    x, y, z = vector.tolist()
    return [x, z, -y]
