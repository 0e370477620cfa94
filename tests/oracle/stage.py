"""Samples the phases of a motion densely, with the poses of all shapes."""

from __future__ import annotations

import base64
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import coal
import numpy as np

from .gripper import Fingers, get_required_opening
from .plan import Hold, Phase, SavedPlan
from .poses import IDENTITY, Poses, make_pose, read_orientation
from .scene_objects import Grasp, SceneObject, Tree, load_object, load_robot
from .supports import compute_distance, find_supports
from .urdf import Points, Shape, load_mesh_hull, make_solid, read_urdf

__all__ = ["FLOOR", "Solid", "Stage", "World"]

LENGTH, ANGLE = 2e-3, 5e-3  # [m], [rad]: largest change from sample to sample
BLOCK = 0.5  # [m], edge of a cube of measured points
FLOOR = "floor"
_PARTS = 16  # of a step between waypoints, to bound its changes


@dataclass(frozen=True)
class Solid:
    """A shape of a link and its poses; the owner is "robot", an object or an obstacle."""

    owner: str
    link: str
    shape: Shape
    poses: Poses

    @property
    def label(self) -> str:
        return (
            self.link
            if self.owner == "robot"
            else f"{self.owner}.{self.link}"
            if self.link
            else self.owner
        )


@dataclass(frozen=True)
class Stage:
    """A sampled phase.

    `rows` are the samples at waypoints. `links` are the poses of all links, by (owner, link), and
    `tool` those of the robot's tool frame. `moving` are the moving links of objects. `supports`
    maps supported objects to their moving supports (owner, link). `verticals` are the vertical axes
    in the frames of ungrasped free objects, when they were last put down.
    """

    number: int
    phase: Phase
    times: np.ndarray
    columns: np.ndarray
    rows: np.ndarray
    tool: Poses
    links: dict[tuple[str, str], Poses]
    solids: list[Solid]
    moving: set[tuple[str, str]]
    supports: dict[str, tuple[str, str]]
    verticals: dict[str, np.ndarray]


def _divide_points(item: dict[str, Any]) -> list[Points]:
    """Return measured points in cubes, each of which is a shape of its own."""
    numbers = np.frombuffer(base64.b64decode(item["data"]), "<f4").astype(float).reshape(-1, 3)
    blocks: dict[tuple[float, ...], list[np.ndarray]] = {}
    for point in numbers:
        blocks.setdefault(tuple(np.floor(point / BLOCK)), []).append(point)
    return [Points(np.array(block), float(item["radius"])) for block in blocks.values()]


class World:
    """The robot, objects and obstacles of a plan's scene."""

    def __init__(self, plan: SavedPlan) -> None:
        self.plan = plan
        scene = plan.scene
        self.robot = load_robot(
            scene["robot"], plan.folder, plan.names[3 : plan.robot_size], scene["start"].get("z")
        )
        self.objects = {
            item["name"]: load_object(item, plan.folder) for item in scene.get("objects") or ()
        }
        arena = scene.get("arena") or {}
        self.arena = (*arena.get("x", (-5.0, 5.0)), *arena.get("y", (-5.0, 5.0)))
        self.obstacles = [
            solid for item in scene.get("obstacles") or () for solid in self._make_obstacle(item)
        ]
        if scene.get("floor", True):
            half_space = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
            centre, half = np.array([0.0, 0.0, -50.0]), np.array([1e3, 1e3, 50.0])
            ground = Shape(FLOOR, half_space, IDENTITY, centre, half, 1e3)
            self.obstacles.append(Solid(FLOOR, "", ground, IDENTITY))
        start = scene["start"]
        arm = start.get("arm", "home")
        self.start: dict[str, float] = dict(
            zip(("base_x", "base_y", "base_yaw"), start["base"], strict=True)
        )
        angles = [self.robot.home[joint] for joint in self.robot.arm] if arm == "home" else arm
        self.start |= dict(zip(self.robot.arm, angles, strict=True))
        self.start |= {
            f"{name}.{joint}": value
            for name, obj in self.objects.items()
            for joint, value in obj.state.items()
        }
        names = plan.names[: plan.robot_size]
        self.start_velocity = dict.fromkeys(names, 0.0) | (start.get("velocity") or {})
        self.held: list[Hold] = []
        self.measured: dict[str, Grasp] = {}
        for name, start_grasp in (start.get("held") or {}).items():
            description = (
                {"attachment": start_grasp} if isinstance(start_grasp, str) else start_grasp
            )
            measured = description.get("measured")
            self.held.append(
                Hold(name, description["attachment"], description.get("by"), bool(measured))
            )
            grasp = self.objects[name].grasps[description["attachment"]]
            values = description.get("at")
            freedoms = {
                name: values[k] if values else 0.0 for k, (name, *_) in enumerate(grasp.freedoms)
            }
            self.start |= {f"{name}.{freedom}": value for freedom, value in freedoms.items()}
            if measured:
                measured_pose = make_pose(measured["position"], read_orientation(measured))
                hand = grasp.placement @ measured_pose.inverse()
                tool = grasp.compute_tool(
                    {freedom: np.array([value]) for freedom, value in freedoms.items()}
                )
                self.measured[name] = replace(grasp, deviation=tool.inverse() @ hand)
        self.held.sort(
            key=lambda hold: (
                hold.by is not None and hold.by.partition(".")[0] in {h.object for h in self.held}
            )
        )

    def _make_obstacle(self, item: dict[str, Any]) -> list[Solid]:
        placement, name = make_pose(item["position"], read_orientation(item)), item["name"]
        if item["type"] == "urdf":
            urdf = read_urdf(self.plan.folder / item["file"])
            links = Tree(urdf, is_mobile=False).compute_links(
                {}, None, sorted({shape.link for shape in urdf.shapes})
            )
            return [
                Solid(name, "", shape, placement @ links[shape.link] @ shape.placement)
                for shape in urdf.shapes
            ]
        if item["type"] == "points":
            return [
                Solid(name, "", Shape.make("", block, IDENTITY), placement)
                for block in _divide_points(item)
            ]
        if item["type"] == "mesh":
            scale = np.broadcast_to(np.array(item.get("scale", 1.0), float), (3,))
            return [
                Solid(
                    name,
                    "",
                    Shape.make(
                        "", load_mesh_hull(self.plan.folder / item["file"], scale), IDENTITY
                    ),
                    placement,
                )
            ]
        return [
            Solid(name, "", Shape.make("", make_solid(item["type"], item), IDENTITY), placement)
        ]

    def is_length(self, name: str) -> bool:
        """Return whether a coordinate is a length."""
        if name in ("base_x", "base_y"):
            return True
        owner, _, coordinate = name.partition(".")
        if not coordinate:
            return name != "base_yaw" and self.robot.tree.urdf.get_joint_type(name) == "prismatic"
        obj = self.objects[owner]
        if coordinate in obj.limits:
            return obj.is_prismatic(coordinate)
        return next(
            f[1] for grasp in obj.grasps.values() for f in grasp.freedoms if f[0] == coordinate
        )

    def compute_front(self, opening: float | None) -> Poses:
        """Return the foremost point of the hand in the tool's frame, at an opening [m]."""
        robot = self.robot
        # All points at least a metre ahead
        wall = coal.Halfspace(np.array([0.0, 0.0, -1.0]), -1.0)
        fingers = self.fingers.find_joints(self.fingers.clip_opening(opening))
        frames = robot.tree.compute_links(
            {**robot.locked, **fingers}, None, sorted({robot.tool, *robot.touch_links})
        )
        tool = frames[robot.tool].inverse()
        hand = [shape for shape in robot.tree.urdf.shapes if shape.link in robot.touch_links]
        distances = [
            compute_distance(
                shape.solid, tool @ frames[shape.link] @ shape.placement, wall, IDENTITY
            )
            for shape in hand
        ]
        return make_pose((0.0, 0.0, 1.0 - min(distances)))

    @cached_property
    def is_resting(self) -> np.ndarray:
        """Whether robot and objects are at rest, for every step between waypoints."""
        joints = {f"{name}.{joint}" for name, obj in self.objects.items() for joint in obj.limits}
        columns = [
            k < self.plan.robot_size or name in joints for k, name in enumerate(self.plan.names)
        ]
        plan = self.plan
        steps = [
            plan.evaluate(a + (b - a) * np.linspace(0.0, 1.0, _PARTS + 1))[:, columns]
            for a, b in itertools.pairwise(plan.times)
        ]
        return np.array([np.ptp(rows, axis=0).max() < 1e-9 for rows in steps])

    @cached_property
    def fingers(self) -> Fingers:
        """The gripper."""
        return Fingers(self.robot)

    @cached_property
    def start_opening(self) -> float | None:
        """Opening of the gripper at the start [m]; None: at rest."""
        hold = next((hold for hold in self.held if hold.by is None), None)
        return (
            self.fingers.clip_opening(self.plan.scene["start"].get("opening"))
            if hold is None
            else get_required_opening(self, hold)
        )

    def compute_finger_joints(self, number: int) -> np.ndarray:
        """Return the finger joints at a phase's waypoints, (T, k); they move in the first step."""
        phases, fingers = self.plan.phases, self.fingers
        phase = phases[number]
        opened = fingers.find_joints(phase.opening)
        rows = np.tile(
            [opened[joint] for joint in fingers.joints], (phase.last - phase.first + 1, 1)
        )
        moves = (
            bool(number)
            or not np.ptp(self.plan.positions[:2, : self.plan.robot_size], axis=0).any()
        )
        if moves:
            initial = fingers.find_joints(
                phases[number - 1].opening if number else self.start_opening
            )
            rows[0] = [initial[joint] for joint in fingers.joints]
        return rows

    def sample_phase(
        self, number: int, length: float = LENGTH, angle: float = ANGLE
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], np.ndarray]:
        """Return times, coordinates and finger joints at a phase's samples, and rows of waypoints.

        From one sample to the next no coordinate changes by more than `length` [m] or `angle`
        [rad].
        """
        plan = self.plan
        phase = self.plan.phases[number]
        fingers = self.compute_finger_joints(number)
        positions = plan.positions[phase.first : phase.last + 1]
        times = plan.times[phase.first : phase.last + 1]
        if plan.curve is None:
            steps = np.abs(np.diff(positions, axis=0))
        else:  # the fastest part of a step determines its samples
            parts = np.stack(
                [
                    plan.evaluate(a + (b - a) * np.linspace(0.0, 1.0, _PARTS + 1))
                    for a, b in itertools.pairwise(times)
                ]
            )
            steps = _PARTS * np.abs(np.diff(parts, axis=1)).max(axis=1)
        units = np.array([length if self.is_length(name) else angle for name in plan.names])
        for joint, (by, factor, _) in self.robot.coupled.items():
            k = 3 + self.robot.arm.index(by)
            unit = length if self.robot.tree.urdf.get_joint_type(joint) == "prismatic" else angle
            units[k] = min(units[k], unit / abs(factor))
        ratio = np.maximum(
            (steps / units).max(axis=1), np.linalg.norm(steps[:, :2], axis=1) / length
        )
        if self.fingers.joints:
            finger_units = np.array(
                [length if self.is_length(joint) else angle for joint in self.fingers.joints]
            )
            ratio = np.maximum(ratio, (np.abs(np.diff(fingers, axis=0)) / finger_units).max(axis=1))
        counts = np.maximum(1, np.ceil(ratio - 1e-9)).astype(int)
        share = np.concatenate(
            [k + np.arange(n) / n for k, n in enumerate(counts)] + [[len(counts)]]
        )
        waypoints = np.arange(len(times))
        columns = plan.evaluate(np.interp(share, waypoints, times))
        hand = {
            name: np.interp(share, waypoints, column)
            for name, column in zip(self.fingers.joints, fingers.T, strict=True)
        }
        return (
            np.interp(share, waypoints, times),
            columns,
            hand,
            np.concatenate([[0], np.cumsum(counts)]),
        )

    def iterate_stages(self) -> Iterator[Stage]:
        """Yield the phases in order; free objects start from their last poses."""
        free_poses = {name: obj.placement for name, obj in self.objects.items() if obj.free}
        verticals: dict[str, np.ndarray] = {}
        robot, plan = self.robot, self.plan
        wanted = sorted(
            {shape.link for shape in robot.tree.urdf.shapes}
            | {robot.tool, robot.tree.urdf.base}
            | self._find_step_frames()
        )
        for number, phase in enumerate(plan.phases):
            times, columns, finger_joints, rows = self.sample_phase(number)
            arm = {name: columns[:, 3 + k] for k, name in enumerate(robot.arm)}
            frames = robot.tree.compute_links(
                {**robot.locked, **finger_joints, **robot.compute_joint_values(arm)},
                columns[:, :3],
                wanted,
            )
            if number == 0:
                first_frames = {name: frame.get_sample(0) for name, frame in frames.items()}
                free_poses |= self._compute_grasped_poses(first_frames[robot.tool], free_poses)
            links = {("robot", name): frame for name, frame in frames.items()}
            for name, obj in self.objects.items():
                object_links = self.compute_object_links(obj, columns)
                links |= {
                    (name, link): (free_poses[name] if obj.free else obj.placement) @ place
                    for link, place in object_links.items()
                }
            moving = {
                key for key, place in links.items() if key[0] != "robot" and not place.is_constant
            }
            attached = self._move_attached_objects(phase, columns, links, free_poses)
            moving |= {
                (name, link) for name in attached for link in self.objects[name].tree.urdf.links
            }
            ungrasped = [name for name in free_poses if name not in attached]
            verticals = {
                name: verticals.get(name, free_poses[name].rotation[0, 2]) for name in ungrasped
            }
            supports = find_supports(self, links, moving, ungrasped)
            for name, support in supports.items():  # supports precede the objects on them
                support_poses = links[support]
                self._place_object(
                    name,
                    support_poses @ (support_poses.get_sample(0).inverse() @ free_poses[name]),
                    links,
                )
            moving |= {
                (name, link) for name in supports for link in self.objects[name].tree.urdf.links
            }
            free_poses = {
                name: links[name, self.objects[name].tree.urdf.base].get_sample(len(times) - 1)
                for name in free_poses
            }
            solids = [
                Solid(owner, shape.link, shape, links[owner, shape.link] @ shape.placement)
                for owner, tree in [
                    ("robot", robot.tree),
                    *((name, obj.tree) for name, obj in self.objects.items()),
                ]
                for shape in tree.urdf.shapes
            ]
            tool = frames[robot.tool]
            solids += self.obstacles
            yield Stage(
                number,
                phase,
                times,
                columns,
                rows,
                tool,
                links,
                solids,
                moving,
                supports,
                verticals,
            )

    def _find_step_frames(self) -> set[str]:
        """Return the robot's frames that steps refer to."""
        names = {
            step.get("frame") for step in self.plan.steps if step["step"] in ("Reach", "Touch")
        }
        return {name for name in names if name and name.partition(".")[0] not in self.objects}

    def compute_object_links(self, obj: SceneObject, columns: np.ndarray) -> dict[str, Poses]:
        """Return the poses of an object's links relative to its base link, at samples."""
        values: dict[str, np.ndarray | float] = {}
        for joint, value in obj.state.items():
            index = self.plan.find_index(f"{obj.name}.{joint}")
            column = None if index is None else columns[:, index]
            values[joint] = (
                value if column is None else column if np.ptp(column) > 0.0 else float(column[0])
            )
        return obj.tree.compute_links(values, None, obj.tree.urdf.links)

    def get_grasp(self, hold: Hold) -> Grasp:
        """Return the measured or described grasp of a hold."""
        described = self.objects[hold.object].grasps[hold.attachment]
        return self.measured[hold.object] if hold.measured else described

    def get_freedoms(self, hold: Hold, columns: np.ndarray) -> dict[str, np.ndarray]:
        """Return the values of a grasp's freedoms at samples."""
        values = {}
        for name, *_ in self.get_grasp(hold).freedoms:
            index = self.plan.find_index(f"{hold.object}.{name}")
            values[name] = np.zeros(len(columns)) if index is None else columns[:, index]
        return values

    def compute_tool_in_object(
        self, hold: Hold, columns: np.ndarray, links: dict[str, Poses]
    ) -> Poses:
        """Return the tool's poses in a grasp, relative to the object's base link."""
        grasp = self.get_grasp(hold)
        return links[grasp.link] @ grasp.compute_tool(self.get_freedoms(hold, columns))

    def _compute_grasped_poses(self, tool: Poses, free_poses: dict[str, Poses]) -> dict[str, Poses]:
        """Return the poses of free objects grasped at the start."""
        poses: dict[str, Poses] = {}
        columns = np.array([[self.start.get(name, 0.0) for name in self.plan.names]])
        for hold in self.held:
            obj = self.objects[hold.object]
            if obj.free:
                links = self.compute_object_links(obj, columns)
                holder = tool
                if hold.by is not None:
                    owner, _, link = hold.by.partition(".")
                    holder = (
                        poses[owner] @ self.compute_object_links(self.objects[owner], columns)[link]
                    )
                values = {name: np.array([self.start[f"{hold.object}.{name}"]]) for name, *_ in
                          obj.grasps[hold.attachment].freedoms}  # fmt: skip
                grasp = self.get_grasp(hold)
                poses[hold.object] = (
                    holder @ (links[grasp.link] @ grasp.compute_tool(values)).inverse()
                )
        return poses

    def _move_attached_objects(
        self,
        phase: Phase,
        columns: np.ndarray,
        links: dict[tuple[str, str], Poses],
        free_poses: dict[str, Poses],
    ) -> list[str]:
        """Move attached objects with the links that carry them; return the objects' names."""
        attached = []
        for hold in phase.holds:
            if not self.objects[hold.object].free:
                continue
            owner, _, link = (hold.by or "").partition(".")
            holder = links[owner, link] if hold.by else links["robot", self.robot.tool]
            computed = (
                holder
                @ self.compute_tool_in_object(
                    hold, columns, self.compute_object_links(self.objects[hold.object], columns)
                ).inverse()
            )
            self._place_object(
                hold.object,
                computed @ (computed.get_sample(0).inverse() @ free_poses[hold.object]),
                links,
            )
            attached.append(hold.object)
        return attached

    def _place_object(self, name: str, base: Poses, links: dict[tuple[str, str], Poses]) -> None:
        """Set the poses of a free object's base link."""
        tree = self.objects[name].tree
        for link, place in tree.compute_links(
            self.objects[name].state, None, tree.urdf.links
        ).items():
            links[name, link] = base @ place
