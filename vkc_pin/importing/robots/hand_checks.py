"""Checks whether a hand can grasp: shapes that enclose it, and heights of bars in its reach."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable, Mapping

import numpy as np
import pinocchio as pin

from vkc_pin.importing.robots.rest_configuration import Clearances, get_arm_bounds
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import get_link_name, triangulate

_MIN_LINKS = 3  # smallest number of links of the hand: palm and two fingers
_MIN_FRACTION = 0.5  # smallest enclosed fraction of the hand: fingertips may protrude
_SLACK = 1e-3  # [m] by which an enclosed vertex may lie outside
_HEIGHTS = np.arange(1, 20) / 10.0  # [m] of the bars
_HANDLE, _LEVER = (0.7, 0.8), (1.0,)  # [m] heights around handles of drawers, and of door levers
TASK_HEIGHTS = (*_HANDLE, *_LEVER)
"""Heights of the bars that common tasks need [m]."""
_TILT = 0.6  # [rad] largest slope of the approach
# [rad] by which a lever is turned, and distance [m] of the hand from its axis
_TURNS, _LEVER_ARM = (0.2, 0.4, 0.6), 0.07
_SIDES = {"left": 1.0, "right": -1.0}  # of a lever's free end, and the sense in which it turns
_RAISED = 1.0  # [m] above the floor, from which arms reach below their base
_FEW = 1.15  # ratio of bars, of which a random search misses some
# Distance [m] from the centre of a bar to the front behind it, less the clearance of links, and of
# touch links
_FACE, _TOUCH_FACE = 0.05, 0.065
_SAMPLES, _STARTS, _STEPS = 500, 10, 30
_STEP = 0.5  # largest step of a joint, [m] or [rad]
_PROGRESS = 0.9  # factor by which the error must decrease in three steps
_DAMPING, _TOLERANCE = 1e-6, 1e-3


def find_envelopes(robot: Robot) -> dict[str, float]:
    """Map each link that merely encloses the hand to the enclosed fraction of the hand.

    Such links are fixed to the tool frame, have no visual shape although other links of the hand
    have one, and enclose most of the hand. They are safety boxes for programs that do not know the
    fingers.
    """
    joint = robot.model.frames[robot.model.getFrameId(robot.tool_frame)].parentJoint
    visible = {shape.link for shape in robot.file.read_shapes("visual")}
    surfaces: dict[str, list[tuple[Floats, Floats]]] = {}
    for k, shape in enumerate(robot.collision.geometryObjects):
        if shape.parentJoint == joint:
            points, faces = triangulate(shape.geometry)
            placed = np.asarray(
                points @ shape.placement.rotation.T + shape.placement.translation, float
            )
            surfaces.setdefault(robot.link_of(k), []).append((placed, placed[faces]))
    corners = {link: np.vstack([points for points, _ in parts]) for link, parts in surfaces.items()}
    hand = [link for link in corners if link in (robot.touch_links or corners)]
    envelopes = dict[str, float]()
    for link in surfaces.keys() - visible if visible & surfaces.keys() else ():
        others = [corners[other] for other in hand if other != link]
        for _, sides in surfaces[link] if len(others) >= _MIN_LINKS else ():
            fraction = float(np.mean([_check_inside(sides, points).mean() for points in others]))
            if fraction >= _MIN_FRACTION:
                envelopes[link] = max(fraction, envelopes.get(link, 0.0))
    return dict(sorted(envelopes.items()))


def remove_collision_shapes(root: ElementTree.Element, links: Collection[str]) -> None:
    """Remove the collision shapes of some links from a URDF."""
    for link in (element for element in root.findall("link") if element.get("name") in links):
        for shape in link.findall("collision"):
            link.remove(shape)


def _check_inside(faces: Floats, points: Floats) -> Floats:
    """Return 1 for points, shape (n, 3), inside a convex mesh, shape (m, 3, 3), else 0: (n,)."""
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, base = normals[lengths > 0.0] / lengths[lengths > 0.0, None], faces[lengths > 0.0, 0]
    normals *= np.sign(np.einsum("ij,ij->i", normals, base - faces.reshape(-1, 3).mean(axis=0)))[
        :, None
    ]
    distances = (points @ normals.T - np.einsum("ij,ij->i", normals, base)).max(axis=1)
    return (distances <= _SLACK).astype(float)


def should_reverse_tool(robot: Robot, *, seed: int = 0) -> bool:
    """Return whether a hand with its tool frame turned by half a turn about z is more useful.

    It then does more common tasks; or as many, though not all, and grasps more bars far above the
    floor. The direction from one finger to the other is arbitrary, but not every wrist rolls by
    half a turn, or by more to turn a lever.
    """
    tasks, bars = [], []
    for is_turned in (False, True):
        found = find_grasp_heights(robot, is_turned=is_turned, heights=TASK_HEIGHTS, seed=seed)
        tasks.append(len(find_missing_tasks(found)))
        if not tasks[0]:
            return False
        found = find_grasp_heights(robot, is_turned=is_turned, lift=_RAISED, seed=seed)
        bars.append(sum(map(len, found.values())))
    return tasks[1] < tasks[0] or (tasks[1] == tasks[0] and bars[1] > _FEW * bars[0])


def find_grasp_heights(
    robot: Robot,
    *,
    is_turned: bool = False,
    lift: float = 0.0,
    heights: Iterable[float] = _HEIGHTS,
    seed: int = 0,
) -> dict[str, Floats]:
    """Return the heights at which a hand can grasp bars on a vertical face.

    The base is wherever it is needed. Configurations are found by inverse kinematics; their links
    keep the default margins to each other and the floor, and stay on the hand's side of the face.

    Args:
        robot: The robot.
        is_turned: Whether the tool frame is turned by half a turn about its z axis.
        lift: Height by which the robot is raised [m].
        heights: Heights to examine, in ascending order [m]; by default up to 1.9 m.
        seed: Random seed.

    Returns:
        "level" and "upright": heights of bars with this direction, shape (k,) [m]. "left" and
        "right": those of levers, level bars, that it can turn down by their left or right end.
    """
    rng = np.random.default_rng(seed)
    up = -1.0 if is_turned else 1.0
    found = dict[str, Floats]()
    for kind, axes in (("level", (1, 0)), ("upright", (0, 1))):
        found |= _GraspSearch(robot, *axes, up, lift, rng).run(kind, heights)
    return found


def find_missing_tasks(found: Mapping[str, Floats]) -> list[str]:
    """Return common tasks that a robot cannot do, such as "turn door levers, 1 m high".

    Args:
        found: Result of `find_grasp_heights` that includes `TASK_HEIGHTS`.
    """
    missing = []
    if not set(_HANDLE) <= set(found["level"]):
        missing.append("grasp handles of drawers, {} to {} m high".format(*_HANDLE))
    sides = [side for side in _SIDES if not set(_LEVER) <= set(found[side])]
    if sides:
        which = f" with the free end on the {sides[0]}" if len(sides) < len(_SIDES) else ""
        missing.append(f"turn door levers{which}, {_LEVER[0]:.0f} m high")
    return missing


class _GraspSearch:
    """Searches configurations that grasp bars of one direction.

    At level bars the tool's x axis, in which the fingers close, points upwards, and its y axis is
    level; at upright bars it is the other way round.

    Args:
        robot: The robot.
        level: Number of the tool's level axis.
        upright: Number of its upright axis.
        up: Height of this axis, 1 or -1.
        lift: Height by which the robot is raised [m].
        rng: Random number generator.
    """

    def __init__(
        self,
        robot: Robot,
        level: int,
        upright: int,
        up: float,
        lift: float,
        rng: np.random.Generator,
    ) -> None:
        self._robot, self._clearances = robot, Clearances(robot)
        self._data, self._frame = robot.model.createData(), robot.model.getFrameId(robot.tool_frame)
        self._low, self._high = get_arm_bounds(robot)
        self._level, self._upright, self._up, self._lift = level, upright, up, lift
        random = rng.uniform(self._low, self._high, (_SAMPLES, len(self._low)))
        self._samples = np.vstack([robot.home, random])
        self._errors = np.array([self._measure(arm, 0.0, 0.0) for arm in self._samples])
        corners = dict[tuple[int, float], list[Floats]]()
        for shape in robot.collision.geometryObjects:
            points = triangulate(shape.geometry)[0] @ shape.placement.rotation.T
            face = _TOUCH_FACE if get_link_name(shape.name) in robot.touch_links else _FACE
            corners.setdefault((shape.parentJoint, face), []).append(
                points + shape.placement.translation
            )
        self._corners = {key: np.vstack(points) for key, points in corners.items()}

    def run(self, kind: str, heights: Iterable[float]) -> dict[str, Floats]:
        """Return the heights of bars that can be grasped, and of levers that can be turned [m]."""
        kinds = [kind, *_SIDES] if kind == "level" else [kind]
        found: dict[str, list[float]] = {each: [] for each in kinds}
        before = list[Floats]()
        for height in heights:
            errors = np.linalg.norm(self._errors - [height - self._lift, 0.0, 0.0], axis=1)
            missing = list(kinds)
            for start in [*before, *self._samples[np.argsort(errors)[:_STARTS]]]:
                arm = self._grasp(start, height)
                if arm is None:
                    continue
                before = [arm] if kind in missing else before
                done = [each for each in missing if each == kind or self._turns(arm, height, each)]
                for each in done:
                    found[each].append(height)
                    missing.remove(each)
                if not missing:
                    break
        return {each: np.array(values) for each, values in found.items()}

    def _grasp(self, start: Floats, height: float, slope: float = 0.0) -> Floats | None:
        """Return a free configuration with the hand at a bar, near the given one, or None."""
        arm = self._solve(start, height - self._lift, slope)
        return arm if arm is not None and self._is_free(arm) else None

    def _turns(self, arm: Floats, height: float, side: str) -> bool:
        """Return whether the hand can turn a lever down from a grasp."""
        for angle in _TURNS:
            slope = self._up * _SIDES[side] * np.sin(angle)
            turned = self._grasp(arm, height - _LEVER_ARM * np.sin(angle), slope)
            if turned is None:
                return False
            arm = turned
        return True

    def _measure(self, arm: Floats, height: float, slope: float) -> Floats:
        """Return the errors of a hand at a bar, in height [m] and directions, shape (3,).

        Args:
            arm: Positions of the arm.
            height: Height of the bar above the root's floor [m].
            slope: Vertical part of the tool's level axis.
        """
        self._q = self._robot.coordinates.q(np.concatenate([np.zeros(3), arm]))
        pin.framesForwardKinematics(self._robot.model, self._data, self._q)
        self._pose = self._data.oMf[self._frame]
        vertical = self._pose.rotation[2]
        self._least = np.cos(_TILT) * np.sqrt(1.0 - slope**2)
        missing = min(0.0, self._up * vertical[self._upright] - self._least)
        return np.array(
            [self._pose.translation[2] - height, vertical[self._level] - slope, missing]
        )

    def _differentiate(self) -> Floats:
        """Return the derivatives of the errors by the arm's positions, shape (3, n)."""
        jacobian = pin.computeFrameJacobian(
            self._robot.model, self._data, self._q, self._frame, pin.LOCAL_WORLD_ALIGNED
        )[2:5, 3:]  # of the height, and of rotations about the world's x and y axes
        axes = self._pose.rotation
        level, upright = (
            axes[1, k] * jacobian[1] - axes[0, k] * jacobian[2]
            for k in (self._level, self._upright)
        )
        is_missing = self._up * axes[2, self._upright] < self._least
        return np.array([jacobian[0], level, self._up * upright * is_missing])

    def _solve(self, arm: Floats, height: float, slope: float) -> Floats | None:
        """Return a configuration with the hand at a bar, near the given one, or None."""
        history = list[float]()
        for _ in range(_STEPS):
            errors = self._measure(arm, height, slope)
            history.append(float(np.linalg.norm(errors)))
            if history[-1] < _TOLERANCE:
                return arm
            if len(history) > 3 and history[-1] > _PROGRESS * history[-4]:
                return None
            rows, step, free = self._differentiate(), np.zeros(len(arm)), np.ones(len(arm), bool)
            for _ in range(2):  # again without the joints that would leave their limits
                part = rows[:, free]
                square = part @ part.T + _DAMPING * np.eye(3)
                step[:], step[free] = 0.0, -part.T @ np.linalg.solve(square, errors)
                step *= min(1.0, _STEP / max(float(np.abs(step).max()), 1e-9))
                free &= (arm + step >= self._low) & (arm + step <= self._high)
            arm = np.clip(arm + step, self._low, self._high)
        return None

    def _is_free(self, arm: Floats) -> bool:
        """Return whether all links are free, and on the hand's side of the face."""
        self._clearances.place(arm)
        if not self._clearances.is_free(floor=-self._lift):
            return False
        self._measure(arm, 0.0, 0.0)
        normal = np.cross(self._pose.rotation[:, self._level], [0.0, 0.0, 1.0])  # of the face
        normal *= np.sign(normal @ self._pose.rotation[:, 2]) / np.linalg.norm(normal)
        bar = float(self._pose.translation @ normal)
        return all(
            float((points @ (place.rotation.T @ normal)).max() + place.translation @ normal)
            < bar + face
            for (joint, face), points in self._corners.items()
            for place in (self._data.oMi[joint],)
        )
