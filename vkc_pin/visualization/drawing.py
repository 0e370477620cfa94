"""Draws a scene and its motion with meshcat commands.

Every joint is a node below its parent joint's node. The viewer's interpolation of joints then
follows the motion to 5 mm or 5 mrad, from few numbers per joint and key frame.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
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

_START, _END = (0.22, 0.42, 0.78), (0.10, 0.60, 0.38)  # of the ghosts
_TOOL, _BASE = (0.88, 0.20, 0.35), (0.16, 0.42, 0.72)  # of the paths
_PATH_STEP = 0.05  # between points of a path [rad], [m]: chords of 1 m radius are 0.3 mm off
_ALARM = (0.90, 0.05, 0.05)
_ALARM_TIME = 0.4  # duration for which colliding links are red before and after [s]
_GHOST_DETAIL = 0.007  # [m]
_AXES = {"x": (0.86, 0.13, 0.13), "y": (0.13, 0.60, 0.16), "z": (0.11, 0.27, 0.90)}  # of frames
_AXIS_LENGTH, _AXIS_RADIUS = 0.16, 0.007  # [m]
_BESIDE = "beside"  # path of the second motion in the tree
_meshes: weakref.WeakKeyDictionary[Robot, list[Solid]] = weakref.WeakKeyDictionary()


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
    ) -> None:
        self.viewer, self.scene, self.trajectory = viewer, scene, trajectory
        self.report, self.beside = report, beside
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
            self._draw_part(
                Part(item.path, item.solid, item.colour, opacity, shadow=opacity >= 1.0)
            )
            self.viewer[item.path].set_transform(item.placement.homogeneous)
        for joint in range(1, self.world.model.njoints):
            self.viewer[self.nodes[joint]].set_transform(self.motion.local[joint][0].homogeneous)
        for part in self.room.make_parts():
            self._draw_part(replace(part, name=f"room/{part.name}"))
        for name, points, grey in self.room.make_lines():
            thin = g.LineBasicMaterial(color=encode_colour((grey, grey, grey)))
            self._draw_without_shadow(
                f"room/{name}", g.LineSegments(g.PointsGeometry(points.astype(np.float32).T), thin)
            )
        self._draw_frames(frames or {}, set())
        if self.trajectory is not None:
            self._draw_paths()
            moving = np.any(
                [*self.movers.values(), np.zeros(self.world.model.njoints, bool)], axis=0
            )
            self.light = [
                simplify(item.solid, _GHOST_DETAIL) if moving[item.joint] else None
                for item in self.items
            ]
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
        motion, high = self.motion, np.array([0.0, 0.0, 1.0])
        around = np.array([[x, y, 0.0] for x in (-0.6, 0.6) for y in (-0.6, 0.6)])
        points = [
            (motion.base[:, None] * (1.0 - high) + around).reshape(-1, 3),
            motion.base + high,
            motion.tool,
        ]
        boxes = self.room.find_obstructions()
        for item in self.items:
            if item.path.startswith("objects"):
                local = item.solid.transform(item.placement).vertices
                for placement in motion.world[[0, len(motion.times) // 2, -1], item.joint]:
                    points.append(local @ placement[:3, :3].T + placement[:3, 3])
                    boxes.append((points[-1].min(axis=0), points[-1].max(axis=0), 0.3))
        cloud = np.concatenate([p[:: max(1, len(p) // 60)] for p in points])
        return choose_viewpoint(cloud, boxes, aspect)

    def _find_nodes(self) -> list[str]:
        """Return the path of every joint in the tree."""
        model, nodes = self.world.model, ["robot"]
        for j in range(1, model.njoints):
            owner, _, rest = str(model.names[j]).partition(".")
            placed = rest and owner in self.scene.objects
            root = f"objects/{owner}" if placed else "robot"
            above = nodes[model.parents[j]] if model.parents[j] else root
            nodes.append(add_node(self.taken, above, rest if placed else str(model.names[j])))
        return nodes

    def _make_robot_items(self) -> list[Item]:
        robot = self.scene.robot
        if robot not in _meshes:
            _meshes[robot] = [to_solid(shape.geometry) for shape in robot.visual.geometryObjects]
        items = []
        # The robot's shapes are the first, on the joints of its fingers, too.
        placed = list(self.world.visual.geometryObjects)[: len(_meshes[robot])]
        for source, shape, solid in zip(
            robot.visual.geometryObjects, placed, _meshes[robot], strict=True
        ):
            link = str(robot.model.frames[source.parentFrame].name)
            path = add_node(self.taken, self.nodes[shape.parentJoint], link, shape.name)
            colour = tuple(map(float, shape.meshColor))
            items.append(
                Item(path, shape.parentJoint, shape.placement, solid, colour=colour, label=link)
            )
        return items

    def _make_object_items(self) -> list[Item]:
        items: list[Item] = []
        shapes, labels = list(self.world.visual.geometryObjects), self.world.visual_labels
        first = len(self.scene.robot.visual.geometryObjects)
        end = len(shapes) - len(self.scene.obstacle_visual)
        for shape, label in zip(shapes[first:end], labels[first:end], strict=True):
            owner, _, link = label.partition(".")
            root = self.nodes[shape.parentJoint] if shape.parentJoint else f"objects/{owner}"
            for k, (solid, colour) in enumerate(load_drawn_parts(shape)):
                name = shape.name.partition(".")[2] + (f"_{k}" if k else "")
                path = add_node(self.taken, root, link, name)
                items.append(
                    Item(
                        path, shape.parentJoint, shape.placement, solid, colour=colour, label=label
                    )
                )
        return items

    def _draw_part(self, part: Part) -> None:
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
                seen = g.MeshBasicMaterial(
                    color=encode_colour(colour), transparent=True, depthTest=False
                )
                self._draw_without_shadow(f"{where}/{axis}", Triangles(solid), seen)
            self.viewer[where].set_transform(placement.homogeneous)

    def _draw_paths(self) -> None:
        assert self.trajectory is not None
        motion = sample_motion(self.world, self.trajectory, step=_PATH_STEP)
        for name, points, radius, colour in (
            ("tool", motion.tool, 0.008, _TOOL),
            ("base", motion.base * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.006], 0.014, _BASE),
        ):
            solid = make_tube(points, radius)
            if solid is not None:
                flat = g.MeshBasicMaterial(color=encode_colour(colour))
                self._draw_without_shadow(f"paths/{name}", Triangles(solid), flat)

    def _draw_ghosts(self, name: str, row: int, colour: tuple[float, float, float]) -> None:
        """Draw moving bodies at `row` as ghosts, one each for the robot and every object."""
        for owner, joints in self.movers.items():
            solids = [
                light.transform(pin.SE3(self.motion.world[row, item.joint]) * item.placement)
                for item, light in zip(self.items, self.light, strict=True)
                if light is not None and joints[item.joint]
            ]
            if solids:
                self.viewer[f"ghosts/{name}/{owner}"].set_object(
                    Ghost(merge_solids(solids), colour)
                )

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
        model, moves = self.world.model, self.motion.moving.copy()
        owners: dict[str, Bools] = {}
        for j in range(1, model.njoints):
            moves[j] |= moves[model.parents[j]]
            if moves[j]:
                owner = (
                    self.nodes[j].split("/")[1] if self.nodes[j].startswith("objects/") else "robot"
                )
                owners.setdefault(owner, np.zeros(model.njoints, bool))[j] = True
        return owners

    def _set_surroundings(self) -> None:
        """Set up camera, lights and background, and hide meshcat's own grid and axes."""
        (target, position), place = self.find_viewpoint(), self.viewer
        # meshcat's camera turns about the origin of its world, so the drawing moves there, not the
        # camera.
        place.set_transform(pin.SE3(np.eye(3), -target).homogeneous)
        lens = place["/Cameras/default/rotated/<object>"]
        lens.set_property("fov", FIELD_OF_VIEW)
        lens.set_property("position", _convert_to_meshcat(position - target))
        lights = ("PointLightNegativeX", "PointLightPositiveX", "FillLight")
        for name in ("/Grid", "/Axes", *(f"/Lights/{light}" for light in lights)):
            place[name].set_property("visible", False)
        place["/Lights/AmbientLight/<object>"].set_property("intensity", 0.62)
        place["/Lights/Sun"].set_object(
            Sun(self.room.centre - target, self.room.reach, position - target)
        )
        place["/Background"].set_property("top_color", [0.93, 0.95, 0.97])
        place["/Background"].set_property("bottom_color", [0.99, 0.99, 0.99])

    def _make_animation(self) -> Animation:
        """Make the animation, with key frames in seconds, since the frame rate is 1."""
        movie = Animation(default_framerate=1)
        if self.trajectory is None:
            return movie
        times = (self.motion.times - self.motion.times[0]).tolist()
        for motion, above in (
            (self.motion, ""),
            *([] if self.beside is None else [(self.beside, f"{_BESIDE}/")]),
        ):
            for j in np.flatnonzero(motion.moving):
                local = motion.local[j]
                quaternions = [
                    pin.Quaternion(placement.rotation).coeffs().tolist() for placement in local
                ]
                tracks = [Track("quaternion", "quaternion", times, quaternions)]
                positions = [placement.translation.tolist() for placement in local]
                if np.ptp(positions, axis=0).max() > 1e-9:
                    tracks.append(Track("position", "vector3", times, positions))
                self._add_clip(movie, above + self.nodes[j], tracks)
        for name, row in (("start", 0), ("end", -1)) if self.beside is None else ():
            for owner, joints in self.movers.items():
                away = self.motion.away(joints, row).tolist()
                self._add_clip(
                    movie, f"ghosts/{name}/{owner}", [Track("visible", "bool", times, away)]
                )
        found = self.report.violations if self.report is not None else ()
        collisions = [v for v in found if v.constraint in ("clearance", "penetration")]
        for item in self.items:
            moments = [v.time for v in collisions if item.label in v.subject.split(" – ")]
            if moments:
                self._add_clip(movie, f"{item.path}/<object>", [self._make_alarm(item, moments)])
        return movie

    def _make_alarm(self, item: Item, moments: list[float]) -> Track:
        """Make a track that colours an item red around `moments` [s]."""
        first, last = self.motion.times[0], self.motion.times[-1]
        edges = (
            moment + d
            for moment in moments
            for a in (_ALARM_TIME, _ALARM_TIME - 0.05)
            for d in (-a, a)
        )
        times = sorted({first, last, *(t for t in edges if first < t < last)})
        red = [any(abs(t - moment) < _ALARM_TIME - 0.02 for moment in moments) for t in times]
        colours = [[float(c) for c in (_ALARM if alarm else item.colour[:3])] for alarm in red]
        return Track("material.color", "color", [float(t - first) for t in times], colours)

    def _add_clip(self, movie: Animation, path: str, tracks: list[Track]) -> None:
        where = self.viewer[path].path
        movie.clips[where] = AnimationClip({track.name: track for track in tracks}, fps=1)


def _convert_to_meshcat(vector: Floats) -> list[float]:
    """Return a vector in the frame of MeshCat's camera, whose y axis points upwards."""
    x, y, z = vector.tolist()
    return [x, z, -y]
