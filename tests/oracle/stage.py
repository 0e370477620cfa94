"""Samples the phases of a motion densely, with the poses of all shapes."""

from __future__ import annotations

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
from .riding import compute_distance, find_riders
from .scene_objects import Grasp, SceneObject, Tree, load_object, load_robot
from .urdf import Shape, load_mesh_hull, make_solid, read_urdf

__all__ = ["FLOOR", "Solid", "Stage", "World"]

LENGTH, ANGLE = 2e-3, 5e-3  # [m], [rad] from sample to sample, at most
FLOOR = "floor"
_PARTS = 16  # of a step between two waypoints, to see how far it goes


@dataclass(frozen=True)
class Solid:
    """A shape of an owner's link, and its poses; owners: "robot", an object or an obstacle."""

    owner: str
    link: str
    shape: Shape
    at: Poses

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
    """A phase.

    `rows` are the samples that are waypoints; `links` are the poses of all links, by (owner, link);
    `tool` are those of the robot's tool frame; `moving` are the moving links of objects; `riding`
    maps supported objects to their moving supports (owner, link); `upright` is the vertical
    direction, in the object's own frame, when it was last put down.
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
    riding: dict[str, tuple[str, str]]
    upright: dict[str, np.ndarray]


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
            part for item in scene.get("obstacles") or () for part in self._obstacle(item)
        ]
        if scene.get("floor", True):
            half_space = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
            middle, half = np.array([0.0, 0.0, -50.0]), np.array([1e3, 1e3, 50.0])
            ground = Shape(FLOOR, half_space, IDENTITY, middle, half, 1e3)
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
        self.held: list[Hold] = []
        self.measured: dict[str, Grasp] = {}
        for name, said in (start.get("held") or {}).items():
            about = {"attachment": said} if isinstance(said, str) else said
            measured = about.get("measured")
            self.held.append(Hold(name, about["attachment"], about.get("by"), bool(measured)))
            grasp, values = self.objects[name].grasps[about["attachment"]], about.get("at")
            own = {
                name: values[k] if values else 0.0 for k, (name, *_) in enumerate(grasp.freedoms)
            }
            self.start |= {f"{name}.{freedom}": value for freedom, value in own.items()}
            if measured:
                there = make_pose(measured["position"], read_orientation(measured))
                hand = grasp.place @ there.inverse()
                right = grasp.tool({freedom: np.array([value]) for freedom, value in own.items()})
                self.measured[name] = replace(grasp, off=right.inverse() @ hand)
        self.held.sort(
            key=lambda hold: (
                hold.by is not None and hold.by.partition(".")[0] in {h.object for h in self.held}
            )
        )

    def _obstacle(self, item: dict[str, Any]) -> list[Solid]:
        here, name = make_pose(item["position"], read_orientation(item)), item["name"]
        if item["type"] == "urdf":
            urdf = read_urdf(self.plan.folder / item["file"])
            links = Tree(urdf, drives=False).links(
                {}, None, sorted({shape.link for shape in urdf.shapes})
            )
            return [
                Solid(name, "", shape, here @ links[shape.link] @ shape.place)
                for shape in urdf.shapes
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
                    here,
                )
            ]
        return [Solid(name, "", Shape.make("", make_solid(item["type"], item), IDENTITY), here)]

    def slides(self, name: str) -> bool:
        """Return whether a coordinate is a length."""
        if name in ("base_x", "base_y"):
            return True
        owner, _, own = name.partition(".")
        if not own:
            return name != "base_yaw" and self.robot.tree.urdf.kind(name) == "prismatic"
        obj = self.objects[owner]
        if own in obj.limits:
            return obj.slides(own)
        return next(f[1] for grasp in obj.grasps.values() for f in grasp.freedoms if f[0] == own)

    def front(self, opening: float | None) -> Poses:
        """Return the foremost point of the touch links in the tool's frame, at an opening [m]."""
        robot, wall = (
            self.robot,
            coal.Halfspace(np.array([0.0, 0.0, -1.0]), -1.0),
        )  # all that is a metre ahead, and beyond
        fingers = self.fingers.find_joints(self.fingers.near(opening))
        frames = robot.tree.links(
            {**robot.locked, **fingers}, None, sorted({robot.tool, *robot.touch})
        )
        tool = frames[robot.tool].inverse()
        hand = [shape for shape in robot.tree.urdf.shapes if shape.link in robot.touch]
        gaps = [
            compute_distance(shape.solid, tool @ frames[shape.link] @ shape.place, wall, IDENTITY)
            for shape in hand
        ]
        return make_pose((0.0, 0.0, 1.0 - min(gaps)))

    @cached_property
    def is_resting(self) -> np.ndarray:
        """Return for every step between waypoints whether robot and objects stand still."""
        joints = {f"{name}.{joint}" for name, obj in self.objects.items() for joint in obj.limits}
        bodies = [
            k < self.plan.robot_size or name in joints for k, name in enumerate(self.plan.names)
        ]
        plan = self.plan
        along = [
            plan.evaluate(a + (b - a) * np.linspace(0.0, 1.0, _PARTS + 1))[:, bodies]
            for a, b in itertools.pairwise(plan.times)
        ]
        return np.array([np.ptp(rows, axis=0).max() < 1e-9 for rows in along])

    @cached_property
    def fingers(self) -> Fingers:
        """The gripper."""
        return Fingers(self.robot)

    @cached_property
    def start_opening(self) -> float | None:
        """Opening of the gripper at the start [m]; None: at rest."""
        hold = next((hold for hold in self.held if hold.by is None), None)
        return (
            self.fingers.near(self.plan.scene["start"].get("opening"))
            if hold is None
            else get_required_opening(self, hold)
        )

    def opened(self, number: int) -> np.ndarray:
        """Return the fingers' joints at a phase's waypoints, (T, k); only the first step moves."""
        phases, fingers = self.plan.phases, self.fingers
        phase = phases[number]
        here = fingers.find_joints(phase.opening)
        rows = np.tile([here[joint] for joint in fingers.joints], (phase.last - phase.first + 1, 1))
        moves = (
            bool(number)
            or not np.ptp(self.plan.positions[:2, : self.plan.robot_size], axis=0).any()
        )
        if moves:
            before = fingers.find_joints(
                phases[number - 1].opening if number else self.start_opening
            )
            rows[0] = [before[joint] for joint in fingers.joints]
        return rows

    def samples(
        self, number: int, length: float = LENGTH, angle: float = ANGLE
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], np.ndarray]:
        """Return times, coordinates, finger joints and a mask of waypoints of a phase's samples.

        From one sample to the next no coordinate changes by more than `length` [m] or `angle`
        [rad].
        """
        plan, phase, fingers = self.plan, self.plan.phases[number], self.opened(number)
        z, t = (
            plan.positions[phase.first : phase.last + 1],
            plan.times[phase.first : phase.last + 1],
        )
        if plan.curve is None:
            steps = np.abs(np.diff(z, axis=0))
        else:  # as often as the fastest stretch of it asks for
            parts = np.stack(
                [
                    plan.evaluate(a + (b - a) * np.linspace(0.0, 1.0, _PARTS + 1))
                    for a, b in itertools.pairwise(t)
                ]
            )
            steps = _PARTS * np.abs(np.diff(parts, axis=1)).max(axis=1)
        units = np.array([length if self.slides(name) else angle for name in plan.names])
        for joint, (by, factor, _) in self.robot.coupled.items():
            k, unit = (
                3 + self.robot.arm.index(by),
                length if self.robot.tree.urdf.kind(joint) == "prismatic" else angle,
            )
            units[k] = min(units[k], unit / abs(factor))
        ratio = np.maximum(
            (steps / units).max(axis=1), np.linalg.norm(steps[:, :2], axis=1) / length
        )
        if self.fingers.joints:
            own = np.array(
                [length if self.slides(joint) else angle for joint in self.fingers.joints]
            )
            ratio = np.maximum(ratio, (np.abs(np.diff(fingers, axis=0)) / own).max(axis=1))
        counts = np.maximum(1, np.ceil(ratio - 1e-9)).astype(int)
        share = np.concatenate(
            [k + np.arange(n) / n for k, n in enumerate(counts)] + [[len(counts)]]
        )
        waypoints = np.arange(len(t))
        columns = plan.evaluate(np.interp(share, waypoints, t))
        hand = {
            name: np.interp(share, waypoints, column)
            for name, column in zip(self.fingers.joints, fingers.T, strict=True)
        }
        return (
            np.interp(share, waypoints, t),
            columns,
            hand,
            np.concatenate([[0], np.cumsum(counts)]),
        )

    def stages(self) -> Iterator[Stage]:
        """Yield the phases in order; free objects keep the poses of the phase before."""
        free = {name: obj.at for name, obj in self.objects.items() if obj.free}
        upright: dict[str, np.ndarray] = {}
        robot, plan = self.robot, self.plan
        wanted = sorted(
            {shape.link for shape in robot.tree.urdf.shapes}
            | {robot.tool, robot.tree.urdf.base}
            | self._asked()
        )
        for number, phase in enumerate(plan.phases):
            times, columns, hand, rows = self.samples(number)
            arm = {name: columns[:, 3 + k] for k, name in enumerate(robot.arm)}
            frames = robot.tree.links(
                {**robot.locked, **hand, **robot.moved(arm)}, columns[:, :3], wanted
            )
            if number == 0:
                first = {name: frame.row(0) for name, frame in frames.items()}
                free |= self._in_hand(first[robot.tool], free)
            links = {("robot", name): frame for name, frame in frames.items()}
            for name, obj in self.objects.items():
                own = self.links_of(obj, columns)
                links |= {
                    (name, link): (free[name] if obj.free else obj.at) @ place
                    for link, place in own.items()
                }
            moving = {
                key for key, place in links.items() if key[0] != "robot" and not place.is_constant
            }
            carried = self._carry(phase, columns, links, free)
            moving |= {
                (name, link) for name in carried for link in self.objects[name].tree.urdf.links
            }
            waiting = [name for name in free if name not in carried]
            upright = {name: upright.get(name, free[name].turn[0, 2]) for name in waiting}
            riding = find_riders(self, links, moving, waiting)
            for name, support in riding.items():  # in the order in which they stand on each other
                there = links[support]
                self._set_down(name, there @ (there.row(0).inverse() @ free[name]), links)
            moving |= {
                (name, link) for name in riding for link in self.objects[name].tree.urdf.links
            }
            free = {
                name: links[name, self.objects[name].tree.urdf.base].row(len(times) - 1)
                for name in free
            }
            solids = [
                Solid(owner, shape.link, shape, links[owner, shape.link] @ shape.place)
                for owner, tree in [
                    ("robot", robot.tree),
                    *((name, obj.tree) for name, obj in self.objects.items()),
                ]
                for shape in tree.urdf.shapes
            ]
            tool = frames[robot.tool]
            solids += self.obstacles
            yield Stage(
                number, phase, times, columns, rows, tool, links, solids, moving, riding, upright
            )

    def _asked(self) -> set[str]:
        """Return frames of the robot that steps name."""
        named = {
            step.get("frame") for step in self.plan.steps if step["step"] in ("Reach", "Touch")
        }
        return {name for name in named if name and name.partition(".")[0] not in self.objects}

    def links_of(self, obj: SceneObject, columns: np.ndarray) -> dict[str, Poses]:
        """Return an object's links in the frame of its base link, along samples of the motion."""
        values: dict[str, np.ndarray | float] = {}
        for joint, value in obj.state.items():
            index = self.plan.index(f"{obj.name}.{joint}")
            column = None if index is None else columns[:, index]
            values[joint] = (
                value if column is None else column if np.ptp(column) > 0.0 else float(column[0])
            )
        return obj.tree.links(values, None, obj.tree.urdf.links)

    def grasp(self, hold: Hold) -> Grasp:
        """Return the grasp of a hold, as measured or as described."""
        own = self.objects[hold.object].grasps[hold.attachment]
        return self.measured[hold.object] if hold.measured else own

    def freedoms(self, hold: Hold, columns: np.ndarray) -> dict[str, np.ndarray]:
        """Return the values of a grasp's freedoms along samples."""
        found = {}
        for name, *_ in self.grasp(hold).freedoms:
            index = self.plan.index(f"{hold.object}.{name}")
            found[name] = np.zeros(len(columns)) if index is None else columns[:, index]
        return found

    def in_object(self, hold: Hold, columns: np.ndarray, links: dict[str, Poses]) -> Poses:
        """Return the tool's poses in a grasp, in the frame of the object's base link."""
        grasp = self.grasp(hold)
        return links[grasp.link] @ grasp.tool(self.freedoms(hold, columns))

    def _in_hand(self, tool: Poses, free: dict[str, Poses]) -> dict[str, Poses]:
        """Return the poses of free objects grasped at the start."""
        found: dict[str, Poses] = {}
        columns = np.array([[self.start.get(name, 0.0) for name in self.plan.names]])
        for hold in self.held:
            obj = self.objects[hold.object]
            if obj.free:
                links = self.links_of(obj, columns)
                holder = tool
                if hold.by is not None:
                    owner, _, link = hold.by.partition(".")
                    holder = found[owner] @ self.links_of(self.objects[owner], columns)[link]
                values = {name: np.array([self.start[f"{hold.object}.{name}"]]) for name, *_ in
                          obj.grasps[hold.attachment].freedoms}  # fmt: skip
                grasp = self.grasp(hold)
                found[hold.object] = holder @ (links[grasp.link] @ grasp.tool(values)).inverse()
        return found

    def _carry(
        self,
        phase: Phase,
        columns: np.ndarray,
        links: dict[tuple[str, str], Poses],
        free: dict[str, Poses],
    ) -> list[str]:
        """Move attached objects with the links that carry them; return the objects' names."""
        carried = []
        for hold in phase.holds:
            if not self.objects[hold.object].free:
                continue
            owner, _, link = (hold.by or "").partition(".")
            holder = links[owner, link] if hold.by else links["robot", self.robot.tool]
            ideal = (
                holder
                @ self.in_object(
                    hold, columns, self.links_of(self.objects[hold.object], columns)
                ).inverse()
            )
            self._set_down(hold.object, ideal @ (ideal.row(0).inverse() @ free[hold.object]), links)
            carried.append(hold.object)
        return carried

    def _set_down(self, name: str, where: Poses, links: dict[tuple[str, str], Poses]) -> None:
        """Set the poses of a free object's base link."""
        tree = self.objects[name].tree
        for link, place in tree.links(self.objects[name].state, None, tree.urdf.links).items():
            links[name, link] = where @ place
