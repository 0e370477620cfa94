"""Finds the tool frame and the opening of a hand from the shapes of its fingers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.robots.arms import Arm, Body, sample_points
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.words import split_words
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.models.couplings import find_followers
from vkc_pin.world.models.gripper import (
    WIDEST_BAR,
    PlacedShape,
    find_thickest_rod,
    find_widest_bar,
)
from vkc_pin.world.models.robot_model import (
    compute_rest_positions,
    find_joint_limits,
    make_configuration,
)

Positions = Mapping[str, float]  # of joints by name, [m] or [rad]

_TIP = 0.025  # [m] length of a fingertip
# Distance of the grasped object behind the fingertips: [m], and at most this fraction of a finger
_PAD = 0.02
_SHARE = 0.3
_SNAP = np.cos(np.radians(12.0))  # closer directions snap to an axis of the hand
_ALIGNED = 0.7  # cosine between the axis of a wrist that rolls and the approach
_ROD = 0.036  # [m] thickness of a lever, with clearance on both sides
# Shifts of a tool frame without room for such a rod [m]
_AHEAD = (0.0, 0.005, 0.01, 0.015, 0.02, 0.03)  # along its z axis
_ASIDE = (0.0, -0.01, 0.01, -0.02, 0.02)  # along its x axis
_LITTLE_ROOM = 0.002  # [m] smallest gain for which it is shifted
_SHARES = (0.75, 0.5)  # of the opening, at which rotating jaws may have more room
_ENCLOSED = 0.005  # [m] by which fingers extend beyond the tool frame
_STUB = 0.3  # shorter fingers, relative to the longest, are parts of a drive
_GRIPPER = 3  # largest number of fingers of a gripper, all of which close together
_LITTLE = 1e-6  # [m] or [rad] smallest travel between open and closed
_MOVES = 0.01  # [m] smallest difference of gaps by which fingers open
_AT_JOINT = 0.01  # [m] from its joint, within which the frame of a last link is at the joint
_PASSES = 2  # passes over the fingers' joints
_MOST_DIVIDED = 8  # fingers whose groups are compared


@dataclass(frozen=True, eq=False)
class Hand:
    """Geometry of a hand.

    Attributes:
        link: Link of the palm in whose frame `tool` is given.
        tool: Tool frame: z is the direction of approach, x the closing direction, the origin lies
            between the fingertips.
        open: Maps each finger joint to its open position, [m] or [rad].
        closed: Maps each joint that closes the hand to its closed position; empty if this is
            unclear.
        opening: Distance between the fingertips when open [m]; 0 without fingers.
        touch_links: Palm and fingers.
        sure: "sure", "likely" or "guess".
        why: Evidence.
    """

    link: str
    tool: pin.SE3
    open: Mapping[str, float]
    closed: Mapping[str, float]
    opening: float
    touch_links: tuple[str, ...]
    sure: str
    why: str

    def settings(self) -> dict[str, Any]:
        """Return the fingers' settings for robot.yaml: the gripper's joints, and locked joints."""
        locked = {joint: round(value, 6) for joint, value in self.open.items()}
        gripper = dict[str, dict[str, float]]()
        for joint, value in self.closed.items():
            gripper[joint] = {"closed": round(value, 6), "open": locked.pop(joint)}
        settings = dict[str, Any]()
        if locked:
            settings["locked_joints"] = locked
        if gripper:
            settings["gripper"] = gripper
        return settings


def analyze_hand(
    file: UrdfFile, full: pin.Model, arm: Arm, linkages: Sequence[Sequence[Positions]] = ()
) -> Hand:
    """Find the tool frame and the fingers of an arm's hand.

    Args:
        file: The robot's URDF.
        full: Its model with all joints.
        arm: The arm.
        linkages: For each linkage of fingers that a tree of joints cannot express, configurations
            that close it; its joints take no others.
    """
    return _HandAnalysis(file, full, arm, linkages).run()


class _HandAnalysis:
    def __init__(
        self, file: UrdfFile, full: pin.Model, arm: Arm, linkages: Sequence[Sequence[Positions]]
    ) -> None:
        self._linkages = linkages
        self._file = file
        self._full = full
        self._arm = arm
        self._data = full.createData()
        links = list[str]()
        for body in arm.palm.subtree():
            links += body.links
        self._points = sample_points(file, links)
        self._touch_links = tuple(link for link in links if link in self._points)
        self._link = arm.palm.links[0]
        self._palm = full.getFrameId(self._link, pin.FrameType.BODY)

    def run(self) -> Hand:
        """Return the geometry of the hand."""
        reach = {finger: self._measure_reach(finger) for finger in self._arm.fingers}
        longest = max(reach.values(), default=0.0)
        fingers = [finger for finger in self._arm.fingers if reach[finger] > _STUB * longest]
        if not fingers:
            return self._use_flange()
        # One jaw needs a palm against which it closes.
        if len(fingers) == 1 and not len(self._find_points(self._arm.palm, {}, alone=True)):
            return self._use_flange()
        joints = self._find_finger_joints(fingers)
        # One motor with <mimic> joints moves a linkage of fingers and of bars beside them.
        is_driven = len(joints) == 1 and len(fingers) > _GRIPPER
        self._approach = self._find_approach(fingers)
        first, second = self._divide_fingers(fingers)
        if is_driven:
            first, second = self._divide_by_motion(fingers, joints[0]) or (first, second)
            first = self._leave_out_bars(first)
            second = self._leave_out_bars(second)
            fingers = [*first, *second]
        opened, closed, closed_gap = self._find_opening(first, second, joints)
        linked = set[str]()
        for linkage in self._linkages:
            linked.update(linkage[0])
        tool, opened = self._place_tool(first, second, opened, closed, linked)
        gap = self._measure_gap(first, second, opened)
        is_linkage = is_driven or (bool(linked) and linked.issuperset(joints))
        moves = gap - closed_gap > _MOVES
        sure = "guess"
        if moves:
            sure = "sure" if len(fingers) == 2 else "likely"
        closing_joints = dict[str, float]()
        if moves and (is_linkage or len(fingers) <= _GRIPPER):
            for joint, value in closed.items():
                if abs(value - opened[joint]) > _LITTLE:
                    closing_joints[joint] = value
        how = _describe_fingers(len(fingers), is_linkage=is_linkage)
        return Hand(
            link=self._link,
            tool=tool,
            open=opened,
            closed=closing_joints,
            opening=float(gap),
            touch_links=self._touch_links,
            sure=sure,
            why=f"between {how}, which open from {1e3 * closed_gap:.0f} to {1e3 * gap:.0f} mm",
        )

    def _find_finger_joints(self, fingers: Sequence[Body]) -> list[str]:
        """Return the joints of fingers, and those of the hand that these follow."""
        inside = list[Body]()
        for finger in fingers:
            inside += finger.subtree()
        joints = [body.name for body in inside if body.is_planned]
        of_hand = {body.name for body in self._arm.palm.subtree()[1:] if body.is_planned}
        followers = find_followers(self._file.root)
        leaders = [followers[body.name].leader for body in inside if body.name in followers]
        joints += [leader for leader in leaders if leader in of_hand]
        return list(dict.fromkeys(joints))

    def _divide_by_motion(
        self, fingers: Sequence[Body], driver: str
    ) -> tuple[list[Body], list[Body]] | None:
        """Return the fingers that one joint moves to either side, or None if all move alike."""
        low, high = find_joint_limits(self._full, driver)
        if not np.isfinite([low, high]).all():
            return None
        centres_at_low = self._find_centres(fingers, {driver: low})
        centres_at_high = self._find_centres(fingers, {driver: high})
        motions = centres_at_high - centres_at_low
        # Most of the motion is in one direction, after that of all fingers together is subtracted.
        apart = motions - motions.mean(axis=0)
        _, _, directions = np.linalg.svd(apart)
        direction = directions[0]
        first = list[Body]()
        second = list[Body]()
        for finger, motion in zip(fingers, apart, strict=True):
            side = first if motion @ direction > 0.0 else second
            side.append(finger)
        return (first, second) if first and second else None

    def _find_centres(self, fingers: Sequence[Body], positions: Positions) -> Floats:
        """Return the mean of each finger's points in the palm's frame, shape (n, 3) [m]."""
        return np.array([self._find_points(finger, positions).mean(axis=0) for finger in fingers])

    def _leave_out_bars(self, fingers: Sequence[Body]) -> list[Body]:
        """Return the fingers on one side whose tips are foremost: bars of a linkage end before."""
        tips = list[float]()
        for finger in fingers:
            tips.append(float((self._find_fingertip(finger, {}) @ self._approach).max()))
        foremost = max(tips, default=0.0)
        kept = zip(fingers, tips, strict=True)
        return [finger for finger, tip in kept if tip > foremost - _TIP]

    def _place(self, positions: Mapping[str, float]) -> pin.SE3:
        """Set joint positions, and return the palm's placement."""
        rest = compute_rest_positions(self._full, self._file, positions)
        pin.framesForwardKinematics(self._full, self._data, make_configuration(self._full, rest))
        return self._data.oMf[self._palm]

    def _find_points(
        self, body: Body, positions: Mapping[str, float], *, alone: bool = False
    ) -> Floats:
        """Return points of a body and its descendants in the palm's frame, shape (n, 3) [m]."""
        palm = self._place(positions)
        placed = [np.zeros((0, 3))]
        for part in [body] if alone else body.subtree():
            for link in part.links:
                if link in self._points:
                    place = palm.actInv(self._data.oMf[self._get_frame(link)])
                    placed.append(self._points[link] @ place.rotation.T + place.translation)
        return np.vstack(placed)

    def _get_frame(self, link: str) -> int:
        return int(self._full.getFrameId(link, pin.FrameType.BODY))

    def _divide_fingers(self, fingers: Sequence[Body]) -> tuple[list[Body], list[Body]]:
        """Return two groups of fingers that close against each other."""
        if len(fingers) == 1:
            return list(fingers), []
        thumbs = [finger for finger in fingers if _is_thumb(finger)]
        if thumbs and len(thumbs) < len(fingers):
            return thumbs, [finger for finger in fingers if finger not in thumbs]
        # The two groups whose fingers are closest to each other
        centres = self._find_centres(fingers[:_MOST_DIVIDED], {})
        numbers = range(len(centres))
        least_spread = np.inf
        chosen: tuple[int, ...] = (0,)
        for size in range(1, len(centres) // 2 + 1):
            for group in itertools.combinations(numbers, size):
                others = [k for k in numbers if k not in group]
                spread = _measure_spread(centres[list(group)]) + _measure_spread(centres[others])
                if spread < least_spread:
                    least_spread = spread
                    chosen = group
        first = [finger for k, finger in enumerate(fingers) if k in chosen]
        second = [finger for k, finger in enumerate(fingers) if k not in chosen]
        return first, second

    def _measure_reach(self, finger: Body) -> float:
        """Return the largest distance of a finger's points from its joint [m]; 0 without shapes."""
        points = self._find_points(finger, {})
        distances = np.linalg.norm(points - self._find_base(finger), axis=1)
        return float(distances.max(initial=0.0))

    def _find_base(self, finger: Body) -> Floats:
        """Return the current position of a finger's first joint in the palm's frame, shape (3,)."""
        palm = self._data.oMf[self._palm]
        joint = self._data.oMi[self._full.getJointId(finger.name)]
        return np.asarray(palm.actInv(joint).translation)

    def _find_fingertip(self, finger: Body, positions: Mapping[str, float]) -> Floats:
        """Return the points of a finger's last body that are furthest from its first joint."""
        points = self._find_points(_find_last_body(finger, self._points), positions, alone=True)
        far = np.linalg.norm(points - self._find_base(finger), axis=1)
        return points[far >= far.max() - max(_TIP, _SHARE * (far.max() - far.min()))]

    def _measure_gap(
        self, first: Sequence[Body], second: Sequence[Body], positions: Mapping[str, float]
    ) -> float:
        """Return the distance between the fingertips of two groups [m]."""
        from scipy.spatial import cKDTree

        own = np.vstack([self._find_fingertip(finger, positions) for finger in first])
        if second:
            others = np.vstack([self._find_fingertip(finger, positions) for finger in second])
        else:
            # One jaw closes against the end of the palm.
            others = self._find_points(self._arm.palm, positions, alone=True)
            along = others @ self._approach
            depth = min(2.0 * _TIP, _SHARE * float(np.ptp(along)))
            others = others[along >= along.max() - depth]
        distances, _ = cKDTree(own).query(others)
        return float(distances.min())

    def _find_opening(
        self, first: Sequence[Body], second: Sequence[Body], joints: Sequence[str]
    ) -> tuple[dict[str, float], dict[str, float], float]:
        """Return open and closed positions of the finger joints, and the smallest gap [m]."""
        rest = compute_rest_positions(self._full, self._file, {})
        opened = {joint: rest[joint] for joint in joints if joint in rest}
        choices = self._list_choices(opened)
        largest = self._measure_gap(first, second, opened)
        smallest = largest
        for _ in range(_PASSES if len(choices) > 1 else 1):
            for positions in choices:
                for choice in positions:
                    gap = self._measure_gap(first, second, {**opened, **choice})
                    smallest = min(smallest, gap)
                    if gap > largest + 1e-4:
                        largest = gap
                        opened.update(choice)

        # Closed are the positions furthest from the open ones.
        closed = dict[str, float]()
        for positions in choices:
            travels = [_measure_travel(opened, choice) for choice in positions]
            closed.update(positions[int(np.argmax(travels))])
        smallest = min(smallest, self._measure_gap(first, second, closed))
        return opened, closed, smallest

    def _list_choices(self, rest: Positions) -> list[list[dict[str, float]]]:
        """Return the positions to try for each finger joint, and those of each linkage."""
        choices = list[list[dict[str, float]]]()
        left = dict(rest)
        for linkage in self._linkages:
            names = [name for name in linkage[0] if name in left]
            if names:
                choices.append([{name: state[name] for name in names} for state in linkage])
                for name in names:
                    left.pop(name)
        for joint, position in left.items():
            choices.append([{joint: value} for value in self._sample_positions(joint, position)])
        return choices

    def _sample_positions(self, joint: str, rest: float) -> list[float]:
        moving = self._full.joints[self._full.getJointId(joint)]
        # A joint that turns without end has no limits.
        if moving.nq == 2:
            return [rest]
        low = self._full.lowerPositionLimit[moving.idx_q]
        high = self._full.upperPositionLimit[moving.idx_q]
        if not (np.isfinite([low, high]).all() and high - low < 2.0 * np.pi):
            return [rest]
        return [rest, float(low), float(0.5 * (low + high)), float(high)]

    def _find_approach(self, fingers: Sequence[Body]) -> Floats:
        """Return the direction from the arm's last joint to the fingertips, in the palm's frame.

        It is across the axis of a hinge, beside which a hand may be mounted.
        """
        tips = np.array([self._find_fingertip(finger, {}).mean(axis=0) for finger in fingers])
        base = np.mean([self._find_base(finger) for finger in fingers], axis=0)
        wrist, axis = self._find_wrist()
        place = wrist.translation
        start = base if np.linalg.norm(base - place) < _AT_JOINT else place
        towards = _normalize(tips.mean(axis=0) - start)
        joint = self._arm.palm.joint
        is_hinge = joint is not None and joint.get("type") != "prismatic"
        if is_hinge and abs(towards @ axis) <= _ALIGNED:
            towards = _normalize(towards - (towards @ axis) * axis)
        return _snap(towards)

    def _find_wrist(self) -> tuple[pin.SE3, Floats]:
        """Return the placement of the arm's last joint in the palm's frame, and its axis."""
        joint = self._full.getJointId(self._arm.joints[-1])
        wrist = self._data.oMf[self._palm].actInv(self._data.oMi[joint])
        element = self._arm.palm.joint
        axis = element.find("axis") if element is not None else None
        text = axis.get("xyz", "1 0 0") if axis is not None else "1 0 0"
        return wrist, _normalize(wrist.rotation @ np.array([float(v) for v in text.split()]))

    def _find_tips(
        self,
        first: Sequence[Body],
        second: Sequence[Body],
        positions: Mapping[str, float],
        approach: Floats,
    ) -> tuple[Floats, Floats]:
        """Return the points of the fingertips on both sides, in the palm's frame."""
        own = np.vstack([self._find_points(finger, positions) for finger in first])
        if second:
            others = np.vstack([self._find_points(finger, positions) for finger in second])
        else:
            others = self._find_points(self._arm.palm, positions, alone=True)
        return _cut_tip(own, approach), _cut_tip(others, approach)

    def _place_tool(
        self,
        first: Sequence[Body],
        second: Sequence[Body],
        opened: Positions,
        closed: Positions,
        linked: Set[str],
    ) -> tuple[pin.SE3, dict[str, float]]:
        """Return the tool frame, and the open positions, with room for a rod between the fingers.

        Jaws that turn far point aside when they are fully open, and have little room where they
        meet: they are opened less, then the frame is shifted.
        """
        states = [dict(opened)]
        if not linked & closed.keys():
            for share in _SHARES:
                state = dict(opened)
                for name in closed:
                    state[name] = share * opened[name] + (1.0 - share) * closed[name]
                states.append(state)
        all_closed = {**opened, **closed}
        best_tool = pin.SE3.Identity()
        best_state = states[0]
        most_room = -1.0
        for shifts in ([(0.0, 0.0)], list(itertools.product(_AHEAD, _ASIDE))):
            for state in states:
                tool = self._find_tool(first, second, state, all_closed)
                shapes = self._place_shapes(state)
                for ahead, aside in shifts:
                    shifted = tool * pin.SE3(np.eye(3), np.array([aside, 0.0, ahead]))
                    room = _measure_room(shapes, shifted)
                    if room > most_room + _LITTLE_ROOM:
                        best_tool = shifted
                        best_state = state
                        most_room = room
                    if most_room >= _ROD:
                        return best_tool, best_state
        return best_tool, best_state

    def _find_tool(
        self,
        first: Sequence[Body],
        second: Sequence[Body],
        opened: Positions,
        closed: Positions,
    ) -> pin.SE3:
        """Return the tool frame between the fingertips of an open hand, in the palm's frame.

        Its axes are the closing direction x, y = z × x, and the approach z. The origin is midway
        between the tips along x and y, and behind them along z. Fingers that swing draw back as
        they close, and still enclose the frame.
        """
        approach = self._approach
        tip, other_tip = self._find_tips(first, second, opened, approach)
        closing = other_tip.mean(axis=0) - tip.mean(axis=0)
        closing = _snap(_normalize(closing - (closing @ approach) * approach))
        side = np.cross(approach, closing)
        x = 0.5 * ((tip @ closing).max() + (other_tip @ closing).min())
        y = 0.5 * (float((tip @ side).mean()) + float((other_tip @ side).mean()))
        fingers = [*first, *(finger for finger in second if finger not in first)]
        along = np.vstack([self._find_points(finger, opened) for finger in fingers]) @ approach
        z = min(float((tip @ approach).max()), float((other_tip @ approach).max()))
        z -= min(_PAD, _SHARE * float(along.max() - along.min()))
        closed_tips = self._find_tips(first, second, closed, approach)
        closed_z = min(float((points @ approach).max()) for points in closed_tips)
        z = min(z, closed_z - _ENCLOSED)
        place = x * closing + y * side + z * approach
        return pin.SE3(np.column_stack([closing, side, approach]), place)

    def _place_shapes(self, positions: Positions) -> list[PlacedShape]:
        """Return the hand's collision shapes in the palm's frame.

        Invisible ones among visible ones, such as safety boxes, are left out.
        """
        palm = self._place(positions)
        links = set(self._points)
        visible = {shape.link for shape in self._file.read_shapes("visual")}
        links = links & visible or links
        shapes = list[PlacedShape]()
        for shape in self._file.read_shapes("collision"):
            if shape.link in links:
                link = palm.actInv(self._data.oMf[self._get_frame(shape.link)])
                shapes.append((shape.make_solid(), link * shape.placement))
        return shapes

    def _use_flange(self) -> Hand:
        """Return the tool frame at the end of an arm without fingers."""
        joint = self._full.getJointId(self._arm.joints[-1])
        palm = self._place({})
        wrist, axis = self._find_wrist()
        place = wrist.translation
        points = self._find_points(self._arm.palm, {}, alone=True)
        ends = list[Floats]()
        for link in self._arm.palm.links:
            frame = palm.actInv(self._data.oMf[self._get_frame(link)])
            ends.append(np.array(frame.translation))
        end = ends[int(np.linalg.norm(np.array(ends) - place, axis=1).argmax())]
        end_distance = np.linalg.norm(end - place)
        towards = end - place
        if not end_distance > _AT_JOINT:
            towards = (points.mean(axis=0) if len(points) else end) - place
        before = palm.actInv(self._data.oMi[self._full.parents[joint]]).translation
        if end_distance < _AT_JOINT and abs((place - before) @ axis) > _AT_JOINT:
            # The last link's frame is at its joint, and its shape may lie behind it.
            towards = place - before
        is_aligned = abs(axis @ _normalize(towards)) > _ALIGNED
        approach = axis * np.sign(axis @ towards) if is_aligned else _normalize(towards)
        approach = _snap(approach)
        depth = float(end @ approach)
        if len(points):
            depth = max(float((points @ approach).max()), depth)
        origin = place + (depth - place @ approach) * approach
        closing = _normalize(np.cross(np.eye(3)[np.abs(approach).argmin()], approach))
        axes = np.column_stack([closing, np.cross(approach, closing), approach])
        return Hand(
            link=self._link,
            tool=pin.SE3(axes, origin),
            open={},
            closed={},
            opening=0.0,
            touch_links=self._touch_links,
            sure="likely" if is_aligned else "guess",
            why="at the end of the arm: it has no fingers",
        )


def _describe_fingers(count: int, *, is_linkage: bool) -> str:
    if is_linkage:
        return "the fingers of a linkage"
    names = {1: "one jaw and the hand", 2: "two fingers"}
    return names.get(count, f"{count} fingers")


def _measure_travel(opened: Positions, choice: Positions) -> float:
    """Return the largest distance of a joint from its open position, [m] or [rad]."""
    return max(abs(value - opened[name]) for name, value in choice.items())


def _is_thumb(finger: Body) -> bool:
    for body in finger.subtree():
        if any("thumb" in split_words(link) for link in body.links):
            return True
    return False


def _measure_spread(points: Floats) -> float:
    """Return the sum of squared distances of points, shape (n, 3), from their mean [m²]."""
    return float(((points - points.mean(axis=0)) ** 2).sum())


def _cut_tip(points: Floats, approach: Floats) -> Floats:
    """Return the foremost of some points, shape (n, 3)."""
    along = points @ approach
    return points[along >= along.max() - _TIP]


def _measure_room(shapes: Sequence[PlacedShape], tool: pin.SE3) -> float:
    """Return the thickness of a rod that fits at a tool frame between fingers [m]; else 0."""
    ahead = tool * pin.SE3(np.eye(3), np.array([0.0, 0.0, _ENCLOSED]))
    if find_widest_bar([(solid, ahead.actInv(at)) for solid, at in shapes]) >= WIDEST_BAR:
        return 0.0
    return find_thickest_rod([(solid, tool.actInv(at)) for solid, at in shapes])


def _find_last_body(finger: Body, points: Mapping[str, Floats]) -> Body:
    """Return the last body with a shape in a finger's longest chain."""
    ends = [body for body in finger.subtree() if any(link in points for link in body.links)]
    return max(ends, key=lambda body: len(body.path()))


def _normalize(vector: Floats) -> Floats:
    length = float(np.linalg.norm(vector))
    return np.asarray(vector / length) if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def _snap(direction: Floats) -> Floats:
    """Return the axis that is close to a direction, or the direction."""
    k = int(np.abs(direction).argmax())
    axis = np.zeros(3)
    axis[k] = np.sign(direction[k])
    return axis if abs(direction[k]) > _SNAP else direction
