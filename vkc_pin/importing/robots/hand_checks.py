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
_HANDLE = (0.7, 0.8)  # [m] heights around handles of drawers
_LEVER = (1.0,)  # [m] heights of door levers
TASK_HEIGHTS = (*_HANDLE, *_LEVER)
"""Heights of the bars that common tasks need [m]."""
_TILT = 0.6  # [rad] largest slope of the approach
_TURNS = (0.2, 0.4, 0.6)  # [rad] by which a lever is turned
_LEVER_ARM = 0.07  # [m] distance of the hand from its axis
_SIDES = {"left": 1.0, "right": -1.0}  # of a lever's free end, and the sense in which it turns
_RAISED = 1.0  # [m] above the floor, from which arms reach below their base
_FEW = 1.15  # ratio of bars, of which a random search misses some
# Distance [m] from the centre of a bar to the front behind it, less the clearance of
_FACE = 0.05  # links
_TOUCH_FACE = 0.065  # touch links
_SAMPLES = 500  # random configurations
_STARTS = 10  # of these, from which inverse kinematics starts for a bar
_STEPS = 30  # of inverse kinematics
_STEP = 0.5  # largest step of a joint, [m] or [rad]
_PROGRESS = 0.9  # factor by which the error must decrease in three steps
_DAMPING = 1e-6  # of a step
_TOLERANCE = 1e-3  # of the errors, [m] and without unit


def find_envelopes(robot: Robot) -> dict[str, float]:
    """Map each link that merely encloses the hand to the enclosed fraction of the hand.

    Such links are fixed to the tool frame, have no visual shape although other links of the hand
    have one, and enclose most of the hand. They are safety boxes for programs that do not know the
    fingers.
    """
    joint = robot.model.frames[robot.model.getFrameId(robot.tool_frame)].parentJoint
    visible = {shape.link for shape in robot.file.read_shapes("visual")}
    corners = dict[str, list[Floats]]()
    meshes = dict[str, list[Floats]]()
    for k, shape in enumerate(robot.collision.geometryObjects):
        if shape.parentJoint == joint:
            vertices, faces = triangulate(shape.geometry)
            placed = np.asarray(
                vertices @ shape.placement.rotation.T + shape.placement.translation, float
            )
            link = robot.link_of(k)
            corners.setdefault(link, []).append(placed)
            meshes.setdefault(link, []).append(placed[faces])
    if not visible & meshes.keys():
        return {}
    points = {link: np.vstack(parts) for link, parts in corners.items()}
    hand = [link for link in points if link in (robot.touch_links or points)]
    envelopes = dict[str, float]()
    for link in sorted(meshes.keys() - visible):
        others = [points[other] for other in hand if other != link]
        if len(others) < _MIN_LINKS:
            continue
        for mesh in meshes[link]:
            fractions = [_are_inside(other, mesh).mean() for other in others]
            fraction = float(np.mean(fractions))
            if fraction >= _MIN_FRACTION:
                envelopes[link] = max(fraction, envelopes.get(link, 0.0))
    return envelopes


def remove_collision_shapes(root: ElementTree.Element, links: Collection[str]) -> None:
    """Remove the collision shapes of some links from a URDF."""
    for link in root.findall("link"):
        if link.get("name") in links:
            for shape in link.findall("collision"):
                link.remove(shape)


def _are_inside(points: Floats, triangles: Floats) -> Floats:
    """Return 1 for points inside a convex mesh, else 0, shape (n,).

    Args:
        points: Points, shape (n, 3) [m].
        triangles: Corners of the mesh's triangles, shape (m, 3, 3) [m].
    """
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    has_area = lengths > 0.0
    normals = normals[has_area] / lengths[has_area, None]
    corners = triangles[has_area, 0]
    # Normals point away from the middle of the mesh.
    outwards = corners - triangles.reshape(-1, 3).mean(axis=0)
    normals *= np.sign(np.einsum("ij,ij->i", normals, outwards))[:, None]
    offsets = np.einsum("ij,ij->i", normals, corners)
    # Outside of a convex mesh, a point is beyond the plane of some triangle.
    distances = (points @ normals.T - offsets).max(axis=1)
    return (distances <= _SLACK).astype(float)


def should_reverse_tool(robot: Robot, *, seed: int = 0) -> bool:
    """Return whether a hand with its tool frame turned by half a turn about z is more useful.

    It then does more common tasks; or as many, though not all, and grasps more bars far above the
    floor. The direction from one finger to the other is arbitrary, but not every wrist rolls by
    half a turn, or by more to turn a lever.
    """
    missing_tasks = _count_missing_tasks(robot, is_turned=False, seed=seed)
    if not missing_tasks:
        return False
    missing_if_turned = _count_missing_tasks(robot, is_turned=True, seed=seed)
    if missing_if_turned != missing_tasks:
        return missing_if_turned < missing_tasks
    bars = _count_bars(robot, is_turned=False, seed=seed)
    bars_if_turned = _count_bars(robot, is_turned=True, seed=seed)
    return bars_if_turned > _FEW * bars


def _count_missing_tasks(robot: Robot, *, is_turned: bool, seed: int) -> int:
    found = find_grasp_heights(robot, is_turned=is_turned, heights=TASK_HEIGHTS, seed=seed)
    return len(find_missing_tasks(found))


def _count_bars(robot: Robot, *, is_turned: bool, seed: int) -> int:
    """Return the number of bars that a hand grasps far above the floor."""
    found = find_grasp_heights(robot, is_turned=is_turned, lift=_RAISED, seed=seed)
    return sum(map(len, found.values()))


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
    for kind, level, upright in (("level", 1, 0), ("upright", 0, 1)):
        search = _GraspSearch(robot, level, upright, up, lift, rng)
        found |= search.run(kind, heights)
    return found


def find_missing_tasks(found: Mapping[str, Floats]) -> list[str]:
    """Return common tasks that a robot cannot do, such as "turn door levers, 1 m high".

    Args:
        found: Result of `find_grasp_heights` that includes `TASK_HEIGHTS`.
    """
    missing = list[str]()
    if not set(_HANDLE) <= set(found["level"]):
        low, high = _HANDLE
        missing.append(f"grasp handles of drawers, {low} to {high} m high")
    sides = [side for side in _SIDES if not set(_LEVER) <= set(found[side])]
    if sides:
        which = f" with the free end on the {sides[0]}" if len(sides) < len(_SIDES) else ""
        missing.append(f"turn door levers{which}, {_LEVER[0]:.0f} m high")
    return missing


class _GraspSearch:
    """Searches configurations that grasp bars of one direction.

    At level bars the tool's x axis, in which the fingers close, points upwards, and its y axis is
    level; at upright bars it is the reverse.

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
        self._robot = robot
        self._clearances = Clearances(robot)
        self._data = robot.model.createData()
        self._frame = robot.model.getFrameId(robot.tool_frame)
        self._low, self._high = get_arm_bounds(robot)
        self._level = level
        self._upright = upright
        self._up = up
        self._lift = lift
        random = rng.uniform(self._low, self._high, (_SAMPLES, len(self._low)))
        self._samples = np.vstack([robot.home, random])
        self._errors = np.array([self._measure(arm, 0.0, 0.0) for arm in self._samples])
        # Points of the links in the frames of their joints, by the joint and the distance from a
        # bar up to which they may extend
        corners = dict[tuple[int, float], list[Floats]]()
        for shape in robot.collision.geometryObjects:
            vertices, _ = triangulate(shape.geometry)
            points = vertices @ shape.placement.rotation.T + shape.placement.translation
            face = _TOUCH_FACE if get_link_name(shape.name) in robot.touch_links else _FACE
            corners.setdefault((shape.parentJoint, face), []).append(points)
        self._corners = {key: np.vstack(points) for key, points in corners.items()}

    def run(self, kind: str, heights: Iterable[float]) -> dict[str, Floats]:
        """Return the heights of bars that can be grasped, and of levers that can be turned [m]."""
        goals = [kind, *_SIDES] if kind == "level" else [kind]
        found: dict[str, list[float]] = {goal: [] for goal in goals}
        before = list[Floats]()  # the grasp at the last height
        for height in heights:
            errors = np.linalg.norm(self._errors - [height - self._lift, 0.0, 0.0], axis=1)
            nearest = self._samples[np.argsort(errors)[:_STARTS]]
            missing = list(goals)
            for start in [*before, *nearest]:
                arm = self._grasp(start, height)
                if arm is None:
                    continue
                if kind in missing:
                    before = [arm]
                for goal in list(missing):
                    if goal == kind or self._turns(arm, height, goal):
                        found[goal].append(height)
                        missing.remove(goal)
                if not missing:
                    break
        return {goal: np.array(values) for goal, values in found.items()}

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

        With the tool's position p, its level axis l and its upright axis u, the errors are

            p_z - height, l_z - slope, min(0, ±u_z - cos(tilt) √(1 - slope²))

        The last one is zero where the approach slopes by less than the tilt.

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
        height_error = self._pose.translation[2] - height
        slope_error = vertical[self._level] - slope
        tilt_error = min(0.0, self._up * vertical[self._upright] - self._least)
        return np.array([height_error, slope_error, tilt_error])

    def _differentiate(self) -> Floats:
        """Return the derivatives of the errors by the arm's positions, shape (3, n).

        An axis a that turns with angular velocity ω moves by ω × a, whose vertical part is
        ω_x a_y - ω_y a_x.
        """
        jacobian = pin.computeFrameJacobian(
            self._robot.model, self._data, self._q, self._frame, pin.LOCAL_WORLD_ALIGNED
        )
        # The rows of v_z, ω_x and ω_y, without the columns of the base
        height, turn_x, turn_y = jacobian[2:5, 3:]
        axes = self._pose.rotation
        x, y = axes[:2, self._level]
        level = y * turn_x - x * turn_y
        x, y = axes[:2, self._upright]
        upright = y * turn_x - x * turn_y
        is_missing = self._up * axes[2, self._upright] < self._least
        return np.array([height, level, self._up * upright * is_missing])

    def _solve(self, arm: Floats, height: float, slope: float) -> Floats | None:
        """Return a configuration with the hand at a bar, near the given one, or None.

        Each step is the damped least-squares one, -Jᵀ (J Jᵀ + λ I)⁻¹ e, with the errors e.
        """
        history = list[float]()
        for _ in range(_STEPS):
            errors = self._measure(arm, height, slope)
            history.append(float(np.linalg.norm(errors)))
            if history[-1] < _TOLERANCE:
                return arm
            if len(history) > 3 and history[-1] > _PROGRESS * history[-4]:
                return None
            jacobian = self._differentiate()
            step = np.zeros(len(arm))
            is_used = np.ones(len(arm), bool)
            # Again without the joints that would leave their limits
            for _ in range(2):
                part = jacobian[:, is_used]
                square = part @ part.T + _DAMPING * np.eye(3)
                step[:] = 0.0
                step[is_used] = -part.T @ np.linalg.solve(square, errors)
                step *= min(1.0, _STEP / max(float(np.abs(step).max()), 1e-9))
                is_used &= (arm + step >= self._low) & (arm + step <= self._high)
            arm = np.clip(arm + step, self._low, self._high)
        return None

    def _is_free(self, arm: Floats) -> bool:
        """Return whether all links are free, and on the hand's side of the face."""
        self._clearances.place(arm)
        if not self._clearances.is_free(floor=-self._lift):
            return False
        self._measure(arm, 0.0, 0.0)
        # The face is upright and along the bar; its normal points away from the hand.
        normal = np.cross(self._pose.rotation[:, self._level], [0.0, 0.0, 1.0])
        normal *= np.sign(normal @ self._pose.rotation[:, 2]) / np.linalg.norm(normal)
        bar = float(self._pose.translation @ normal)
        for (joint, face), points in self._corners.items():
            place = self._data.oMi[joint]
            furthest = (points @ (place.rotation.T @ normal)).max() + place.translation @ normal
            if not float(furthest) < bar + face:
                return False
        return True
