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
_PAD = 0.02  # [m] distance of the grasped object behind the fingertips,
_SHARE = 0.3  # at most this fraction of a finger's length
_SNAP = np.cos(np.radians(12.0))  # closer directions snap to an axis of the hand
_ALIGNED = 0.7  # cosine between the axis of a wrist that rolls and the approach
_ROD = 0.036  # [m] thickness of a lever, with clearance on both sides
# Shifts of a tool frame without room for such a rod [m], along its z and x axes
_AHEAD, _ASIDE = (0.0, 0.005, 0.01, 0.015, 0.02, 0.03), (0.0, -0.01, 0.01, -0.02, 0.02)
_LITTLE_ROOM = 0.002  # [m] smallest gain for which it is shifted
_SHARES = (0.75, 0.5)  # of the opening, at which rotating jaws may have more room
_ENCLOSED = 0.005  # [m] by which fingers extend beyond the tool frame
_STUB = 0.3  # shorter fingers, relative to the longest, are parts of a drive
_GRIPPER = 3  # largest number of fingers of a gripper, all of which close together
_LITTLE = 1e-6  # [m] or [rad] smallest travel between open and closed
_PASSES = 2  # passes over the fingers' joints


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
        opened = {joint: round(value, 6) for joint, value in self.open.items()}
        gripper = {
            joint: {"closed": round(value, 6), "open": opened.pop(joint)}
            for joint, value in self.closed.items()
        }
        return {
            key: setting
            for key, setting in (("locked_joints", opened), ("gripper", gripper))
            if setting
        }


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
        self._file, self._full, self._arm, self._data = file, full, arm, full.createData()
        self._points = sample_points(
            file, [link for body in arm.palm.subtree() for link in body.links]
        )
        self._link = arm.palm.links[0]
        self._palm = full.getFrameId(self._link, pin.FrameType.BODY)

    def run(self) -> Hand:
        """Return the geometry of the hand."""
        reach = {finger: self._measure_reach(finger) for finger in self._arm.fingers}
        fingers = [
            finger for finger in self._arm.fingers if reach[finger] > _STUB * max(reach.values())
        ]
        touch = tuple(
            link for body in self._arm.palm.subtree() for link in body.links if link in self._points
        )
        if not fingers or (
            len(fingers) == 1 and not len(self._find_points(self._arm.palm, {}, alone=True))
        ):
            return self._use_flange(touch)
        joints = self._find_finger_joints(fingers)
        # One motor with <mimic> joints moves a linkage of fingers and of bars beside them.
        is_driven = len(joints) == 1 and len(fingers) > _GRIPPER
        self._approach = self._find_approach(fingers)
        first, second = self._divide_fingers(fingers)
        if is_driven:
            first, second = self._divide_by_motion(fingers, joints[0]) or (first, second)
            first, second = self._leave_out_bars(first), self._leave_out_bars(second)
            fingers = [*first, *second]
        opened, closed_positions, gap, closed = self._find_opening(first, second, joints)
        linked = {name for linkage in self._linkages for name in linkage[0]}
        tool, opened = self._place_tool(first, second, opened, closed_positions, linked)
        gap = self._measure_gap(first, second, opened)
        moves = gap - closed
        is_linkage = is_driven or (bool(linked) and linked.issuperset(joints))
        sure = (
            "sure" if len(fingers) == 2 and moves > 0.01 else "likely" if moves > 0.01 else "guess"
        )
        how = (
            "the fingers of a linkage"
            if is_linkage
            else "two fingers"
            if len(fingers) == 2
            else "one jaw and the hand"
            if len(fingers) == 1
            else f"{len(fingers)} fingers"
        )
        why = f"between {how}, which open from {1e3 * closed:.0f} to {1e3 * gap:.0f} mm"
        closing_joints = {
            joint: value
            for joint, value in closed_positions.items()
            if abs(value - opened[joint]) > _LITTLE
        }
        known = moves > 0.01 and (is_linkage or len(fingers) <= _GRIPPER)
        return Hand(
            self._link, tool, opened, closing_joints if known else {}, float(gap), touch, sure, why
        )

    def _find_finger_joints(self, fingers: Sequence[Body]) -> list[str]:
        """Return the joints of fingers, and those of the hand that these follow."""
        inside = [body for finger in fingers for body in finger.subtree()]
        joints = [body.name for body in inside if body.is_planned]
        of_hand = {body.name for body in self._arm.palm.subtree()[1:] if body.is_planned}
        followers = find_followers(self._file.root)
        leaders = [followers[body.name].leader for body in inside if body.name in followers]
        joints += [leader for leader in leaders if leader in of_hand]
        return list(dict.fromkeys(joints))

    def _divide_by_motion(
        self, fingers: Sequence[Body], driver: str
    ) -> tuple[list[Body], list[Body]] | None:
        """Return the fingers that one joint moves to either side, or None if all go one way."""
        ends = [
            [self._find_points(finger, {driver: limit}).mean(axis=0) for finger in fingers]
            for limit in find_joint_limits(self._full, driver)
            if np.isfinite(limit)
        ]
        if len(ends) < 2:
            return None
        motions = np.array(ends[1]) - np.array(ends[0])
        # Most of the motion is in one direction, after that of all fingers together is subtracted.
        apart = motions - motions.mean(axis=0)
        direction = np.linalg.svd(apart)[2][0]
        first = [
            finger
            for finger, motion in zip(fingers, apart, strict=True)
            if motion @ direction > 0.0
        ]
        second = [finger for finger in fingers if finger not in first]
        return (first, second) if first and second else None

    def _leave_out_bars(self, fingers: Sequence[Body]) -> list[Body]:
        """Return the fingers on one side whose tips are foremost: bars of a linkage end before."""
        tips = [float((self._find_fingertip(one, {}) @ self._approach).max()) for one in fingers]
        return [one for one, tip in zip(fingers, tips, strict=True) if tip > max(tips) - _TIP]

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
        points_by_link = [np.zeros((0, 3))]
        for part in [body] if alone else body.subtree():
            for link in part.links:
                if link in self._points:
                    place = palm.actInv(
                        self._data.oMf[self._full.getFrameId(link, pin.FrameType.BODY)]
                    )
                    points_by_link.append(self._points[link] @ place.rotation.T + place.translation)
        return np.vstack(points_by_link)

    def _divide_fingers(self, fingers: Sequence[Body]) -> tuple[list[Body], list[Body]]:
        """Return two groups of fingers that close against each other."""
        if len(fingers) == 1:
            return list(fingers), []
        thumbs = [
            finger
            for finger in fingers
            if any("thumb" in split_words(link) for body in finger.subtree() for link in body.links)
        ]
        if thumbs and len(thumbs) < len(fingers):
            return thumbs, [finger for finger in fingers if finger not in thumbs]
        centres = np.array([self._find_points(finger, {}).mean(axis=0) for finger in fingers[:8]])
        best, chosen = np.inf, tuple[int, ...]((0,))
        for size in range(1, len(centres) // 2 + 1):
            for group in itertools.combinations(range(len(centres)), size):
                others = [k for k in range(len(centres)) if k not in group]
                spread = sum(
                    ((centres[part] - centres[part].mean(axis=0)) ** 2).sum()
                    for part in (list(group), others)
                )
                if spread < best:
                    best, chosen = float(spread), group
        first = [finger for k, finger in enumerate(fingers) if k in chosen]
        return first, [finger for k, finger in enumerate(fingers) if k not in chosen]

    def _measure_reach(self, finger: Body) -> float:
        """Return the largest distance of a finger's points from its joint [m]; 0 without shapes."""
        points = self._find_points(finger, {})
        return (
            float(np.linalg.norm(points - self._find_base(finger), axis=1).max())
            if len(points)
            else 0.0
        )

    def _find_base(self, finger: Body) -> Floats:
        """Return the current position of a finger's first joint in the palm's frame, shape (3,)."""
        palm = self._data.oMf[self._palm]
        return np.asarray(
            palm.actInv(self._data.oMi[self._full.getJointId(finger.name)]).translation
        )

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

        a = np.vstack([self._find_fingertip(finger, positions) for finger in first])
        if second:
            b = np.vstack([self._find_fingertip(finger, positions) for finger in second])
        else:
            b = self._find_points(self._arm.palm, positions, alone=True)
            along = b @ self._approach
            b = b[along >= along.max() - min(2.0 * _TIP, _SHARE * float(np.ptp(along)))]
        return float(cKDTree(a).query(b)[0].min())

    def _find_opening(
        self, first: Sequence[Body], second: Sequence[Body], joints: Sequence[str]
    ) -> tuple[dict[str, float], dict[str, float], float, float]:
        """Return open and closed positions of the finger joints, and the gaps there [m]."""
        rest = compute_rest_positions(self._full, self._file, {})
        chosen = {joint: rest[joint] for joint in joints if joint in rest}
        choices = self._list_choices(chosen)
        best = smallest = self._measure_gap(first, second, chosen)
        for _ in range(_PASSES if len(choices) > 1 else 1):
            for positions in choices:
                for choice in positions:
                    gap = self._measure_gap(first, second, {**chosen, **choice})
                    smallest = min(smallest, gap)
                    if gap > best + 1e-4:
                        best = gap
                        chosen.update(choice)
        closed_positions = dict[str, float]()
        for positions in choices:
            furthest: Positions = max(
                positions,
                key=lambda choice: max(abs(choice[name] - chosen[name]) for name in choice),
            )
            closed_positions.update(furthest)
        return (
            chosen,
            closed_positions,
            best,
            min(smallest, self._measure_gap(first, second, closed_positions)),
        )

    def _list_choices(self, rest: Positions) -> list[list[dict[str, float]]]:
        """Return the positions to try for each finger joint, and those of each linkage."""
        choices, left = list[list[dict[str, float]]](), dict(rest)
        for linkage in self._linkages:
            names = [name for name in linkage[0] if name in left]
            if names:
                choices.append([{name: state[name] for name in names} for state in linkage])
                for name in names:
                    left.pop(name)
        return choices + [
            [{joint: value} for value in self._sample_positions(joint, position)]
            for joint, position in left.items()
        ]

    def _sample_positions(self, joint: str, rest: float) -> list[float]:
        moving = self._full.joints[self._full.getJointId(joint)]
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
        towards = _normalize(
            tips.mean(axis=0) - (base if np.linalg.norm(base - place) < 0.01 else place)
        )
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
        a = np.vstack([self._find_points(finger, positions) for finger in first])
        b = (
            np.vstack([self._find_points(finger, positions) for finger in second])
            if second
            else self._find_points(self._arm.palm, positions, alone=True)
        )
        return tuple(side[side @ approach >= (side @ approach).max() - _TIP] for side in (a, b))

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
                part = {
                    name: share * opened[name] + (1.0 - share) * closed[name] for name in closed
                }
                states.append({**opened, **part})
        best, room, chosen = pin.SE3.Identity(), -1.0, states[0]
        for shifts in ([(0.0, 0.0)], list(itertools.product(_AHEAD, _ASIDE))):
            for state in states:
                tool = self._find_tool(first, second, state, {**opened, **closed})
                shapes = self._place_shapes(state)
                for ahead, aside in shifts:
                    moved = tool * pin.SE3(np.eye(3), np.array([aside, 0.0, ahead]))
                    wider = _measure_room(shapes, moved)
                    if wider > room + _LITTLE_ROOM:
                        best, room, chosen = moved, wider, state
                    if room >= _ROD:
                        return best, chosen
        return best, chosen

    def _find_tool(
        self,
        first: Sequence[Body],
        second: Sequence[Body],
        opened: Positions,
        closed: Positions,
    ) -> pin.SE3:
        """Return the tool frame between the fingertips of an open hand, in the palm's frame.

        Fingers that swing draw back as they close, and still enclose the frame.
        """
        approach = self._approach
        a, b = self._find_tips(first, second, opened, approach)
        closing = b.mean(axis=0) - a.mean(axis=0)
        closing = _snap(_normalize(closing - (closing @ approach) * approach))
        inner = 0.5 * ((a @ closing).max() + (b @ closing).min())
        fingers = [*first, *(finger for finger in second if finger not in first)]
        along = np.vstack([self._find_points(finger, opened) for finger in fingers]) @ approach
        depth = min(float((a @ approach).max()), float((b @ approach).max()))
        depth -= min(_PAD, _SHARE * float(along.max() - along.min()))
        closed_tips = self._find_tips(first, second, closed, approach)
        closed_depth = min(float((tips @ approach).max()) for tips in closed_tips)
        depth = min(depth, closed_depth - _ENCLOSED)
        side = np.cross(approach, closing)
        across = 0.5 * (float((a @ side).mean()) + float((b @ side).mean()))
        place = inner * closing + across * side + depth * approach
        return pin.SE3(np.column_stack([closing, side, approach]), place)

    def _place_shapes(self, positions: Positions) -> list[PlacedShape]:
        """Return the hand's collision shapes in the palm's frame.

        Invisible ones among visible ones, such as safety boxes, are left out.
        """
        palm, links = self._place(positions), set(self._points)
        visible = {shape.link for shape in self._file.read_shapes("visual")}
        links = links & visible or links
        return [
            (shape.make_solid(), palm.actInv(self._data.oMf[frame]) * shape.placement)
            for shape in self._file.read_shapes("collision")
            if shape.link in links
            for frame in (self._full.getFrameId(shape.link, pin.FrameType.BODY),)
        ]

    def _use_flange(self, touch: tuple[str, ...]) -> Hand:
        """Return the tool frame at the end of an arm without fingers."""
        joint = self._full.getJointId(self._arm.joints[-1])
        palm = self._place({})
        wrist, turn = self._find_wrist()
        points = self._find_points(self._arm.palm, {}, alone=True)
        frames = [self._full.getFrameId(link, pin.FrameType.BODY) for link in self._arm.palm.links]
        ends = np.array([palm.actInv(self._data.oMf[frame]).translation for frame in frames])
        end = ends[np.linalg.norm(ends - wrist.translation, axis=1).argmax()]
        reach = (points.mean(axis=0) if len(points) else end) - wrist.translation
        towards = (
            end - wrist.translation if np.linalg.norm(end - wrist.translation) > 0.01 else reach
        )
        before = palm.actInv(self._data.oMi[self._full.parents[joint]]).translation
        if (
            np.linalg.norm(end - wrist.translation) < 0.01
            and abs((wrist.translation - before) @ turn) > 0.01
        ):
            # The last link's frame is at its joint, and its shape may lie behind it.
            towards = wrist.translation - before
        is_aligned = abs(turn @ _normalize(towards)) > _ALIGNED
        approach = _snap(turn * np.sign(turn @ towards) if is_aligned else _normalize(towards))
        depth = max(
            float((points @ approach).max()) if len(points) else -np.inf, float(end @ approach)
        )
        place = wrist.translation + (depth - wrist.translation @ approach) * approach
        closing = _normalize(np.cross(np.eye(3)[np.abs(approach).argmin()], approach))
        tool = pin.SE3(np.column_stack([closing, np.cross(approach, closing), approach]), place)
        sure, why = "likely" if is_aligned else "guess", "at the end of the arm: it has no fingers"
        return Hand(self._link, tool, {}, {}, 0.0, touch, sure, why)


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
