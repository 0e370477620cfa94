"""Finds where a hand grasps and how far it opens, from the shapes of its fingers in several positions."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.robots.arms import Arm, Body
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.models.robot_model import compute_rest_positions, make_configuration

__all__ = ["Hand", "analyze_hand"]

_POINTS = 120  # of a finger
_TIP = 0.025  # [m] of a finger, from its end, that is its tip
_PAD = 0.02  # [m] behind the fingertips is where things are held,
_SHARE = 0.3  # but no more than this share of a finger's length
_SNAP = np.cos(
    np.radians(12.0)
)  # directions closer than this to an axis of the hand are meant to be that axis
_STUB = 0.3  # of the longest finger: what is shorter is a part of a drive, not a finger
_GRIPPER = 3  # fingers at most of a gripper, all of which close together
_LITTLE = 1e-6  # [m] or [rad]: less is no way between open and closed
_PASSES = 2  # over the fingers' joints


@dataclass(frozen=True, eq=False)
class Hand:
    """How a hand grasps.

    Attributes:
        link: The link of the palm that `tool` is placed on.
        tool: z is the direction of approach, x the one in which the fingers close, the origin
            between the fingertips.
        open: Finger joint → where it is open, [m] or [rad].
        closed: Of these joints, those that close the hand → where it is closed; none if it is not
            clear how it closes.
        opening: Between the fingertips there, [m]; 0 without fingers.
        touch_links: Palm and fingers.
        sure: "sure", "likely" or "guess".
        why: What speaks for it.
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
        """Return what a robot.yaml says of the fingers: how they open, and where those are locked that do not."""
        opened = {joint: round(value, 6) for joint, value in self.open.items()}
        gripper = {
            joint: {"closed": round(value, 6), "open": opened.pop(joint)}
            for joint, value in self.closed.items()
        }
        return {
            key: said for key, said in (("locked_joints", opened), ("gripper", gripper)) if said
        }


def analyze_hand(file: UrdfFile, full: pin.Model, arm: Arm) -> Hand:
    """Return how an arm's hand grasps.

    Args:
        file: The robot.
        full: Its model with all joints.
        arm: Its arm.
    """
    return _Looker(file, full, arm).hand()


class _Looker:
    def __init__(self, file: UrdfFile, full: pin.Model, arm: Arm) -> None:
        self._file, self._full, self._arm, self._data = file, full, arm, full.createData()
        self._points = _points_of(
            file, [link for body in arm.palm.subtree() for link in body.links]
        )
        self._link = arm.palm.links[0]
        self._palm = full.getFrameId(self._link, pin.FrameType.BODY)

    def hand(self) -> Hand:
        """Return what was found."""
        reach = {finger: self._reach(finger) for finger in self._arm.fingers}
        fingers = [
            finger for finger in self._arm.fingers if reach[finger] > _STUB * max(reach.values())
        ]
        touch = tuple(
            link for body in self._arm.palm.subtree() for link in body.links if link in self._points
        )
        if not fingers or (len(fingers) == 1 and not len(self._of(self._arm.palm, {}, alone=True))):
            return self._flange(touch)
        first, second = self._sides(fingers)
        self._ahead = approach = self._approach(fingers)
        joints = [body.name for finger in fingers for body in finger.subtree() if body.is_planned]
        opened, shut, gap, closed = self._opened(first, second, joints)
        a, b = self._tips(first, second, opened, approach)
        closing = b.mean(axis=0) - a.mean(axis=0)
        closing = _snapped(_unit(closing - (closing @ approach) * approach))
        inner = 0.5 * ((a @ closing).max() + (b @ closing).min())
        everything = np.vstack([self._of(finger, opened) for finger in fingers])
        along = everything @ approach
        depth = min(float((a @ approach).max()), float((b @ approach).max()))
        depth -= min(_PAD, _SHARE * float(along.max() - along.min()))
        side = np.cross(approach, closing)
        across = 0.5 * (float((a @ side).mean()) + float((b @ side).mean()))
        place = inner * closing + across * side + depth * approach
        tool = pin.SE3(np.column_stack([closing, side, approach]), place)
        moves = gap - closed
        sure = (
            "sure" if len(fingers) == 2 and moves > 0.01 else "likely" if moves > 0.01 else "guess"
        )
        how = (
            "two fingers"
            if len(fingers) == 2
            else "one jaw and the hand"
            if len(fingers) == 1
            else f"{len(fingers)} fingers"
        )
        why = f"between {how}, which open from {1e3 * closed:.0f} to {1e3 * gap:.0f} mm"
        closing_ones = {
            joint: value for joint, value in shut.items() if abs(value - opened[joint]) > _LITTLE
        }
        known = moves > 0.01 and len(fingers) <= _GRIPPER
        return Hand(
            self._link, tool, opened, closing_ones if known else {}, float(gap), touch, sure, why
        )

    def _place(self, positions: Mapping[str, float]) -> pin.SE3:
        rest = compute_rest_positions(self._full, self._file, positions)
        pin.framesForwardKinematics(self._full, self._data, make_configuration(self._full, rest))
        return self._data.oMf[self._palm]

    def _of(self, body: Body, positions: Mapping[str, float], *, alone: bool = False) -> Floats:
        """Return points of a body and all below it in the palm's frame, shape (n, 3) [m], with joints at `positions`."""
        palm = self._place(positions)
        found = [np.zeros((0, 3))]
        for part in [body] if alone else body.subtree():
            for link in part.links:
                if link in self._points:
                    place = palm.actInv(
                        self._data.oMf[self._full.getFrameId(link, pin.FrameType.BODY)]
                    )
                    found.append(self._points[link] @ place.rotation.T + place.translation)
        return np.vstack(found)

    def _sides(self, fingers: Sequence[Body]) -> tuple[list[Body], list[Body]]:
        """Return two groups of fingers that close against each other; the second is empty if the palm is the other side."""
        if len(fingers) == 1:
            return list(fingers), []
        thumbs = [
            finger
            for finger in fingers
            if any("thumb" in link.lower() for body in finger.subtree() for link in body.links)
        ]
        if thumbs and len(thumbs) < len(fingers):
            return thumbs, [finger for finger in fingers if finger not in thumbs]
        centres = np.array([self._of(finger, {}).mean(axis=0) for finger in fingers[:8]])
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

    def _reach(self, finger: Body) -> float:
        """Return how far a finger reaches from its joint [m]; 0 without a shape."""
        points = self._of(finger, {})
        return (
            float(np.linalg.norm(points - self._base(finger), axis=1).max()) if len(points) else 0.0
        )

    def _base(self, finger: Body) -> Floats:
        """Return where the first joint of a finger is, in the palm's frame, shape (3,); joints are where they were put last."""
        palm = self._data.oMf[self._palm]
        return np.asarray(
            palm.actInv(self._data.oMi[self._full.getJointId(finger.name)]).translation
        )

    def _end(self, finger: Body, positions: Mapping[str, float]) -> Floats:
        """Return the points of a finger's last body that are furthest from its first joint, in the palm's frame."""
        points = self._of(_last(finger, self._points), positions, alone=True)
        far = np.linalg.norm(points - self._base(finger), axis=1)
        return points[far >= far.max() - max(_TIP, _SHARE * (far.max() - far.min()))]

    def _gap(
        self, first: Sequence[Body], second: Sequence[Body], positions: Mapping[str, float]
    ) -> float:
        """Return the distance between the ends of the fingers of two groups [m]."""
        from scipy.spatial import cKDTree

        a = np.vstack([self._end(finger, positions) for finger in first])
        if second:
            b = np.vstack([self._end(finger, positions) for finger in second])
        else:
            b = self._of(self._arm.palm, positions, alone=True)
            b = b[b @ self._ahead >= (b @ self._ahead).max() - 2.0 * _TIP]
        return float(cKDTree(a).query(b)[0].min())

    def _opened(
        self, first: Sequence[Body], second: Sequence[Body], joints: Sequence[str]
    ) -> tuple[dict[str, float], dict[str, float], float, float]:
        """Return where the fingers' joints are open, where they are shut, and the gaps there [m]."""
        rest = compute_rest_positions(self._full, self._file, {})
        chosen = {joint: rest[joint] for joint in joints if joint in rest}
        choices = {joint: self._choices(joint, rest[joint]) for joint in chosen}
        best = smallest = self._gap(first, second, chosen)
        for _ in range(_PASSES if len(chosen) > 1 else 1):
            for joint, values in choices.items():
                for value in values:
                    gap = self._gap(first, second, {**chosen, joint: value})
                    smallest = min(smallest, gap)
                    if gap > best + 1e-4:
                        best, chosen[joint] = gap, value
        shut = {
            joint: max(values, key=lambda value: abs(value - chosen[joint]))
            for joint, values in choices.items()
        }
        return chosen, shut, best, min(smallest, self._gap(first, second, shut))

    def _choices(self, joint: str, rest: float) -> list[float]:
        moving = self._full.joints[self._full.getJointId(joint)]
        if moving.nq == 2:
            return [rest]
        low, high = (
            self._full.lowerPositionLimit[moving.idx_q],
            self._full.upperPositionLimit[moving.idx_q],
        )
        if not (np.isfinite([low, high]).all() and high - low < 2.0 * np.pi):
            return [rest]
        return [rest, float(low), float(0.5 * (low + high)), float(high)]

    def _approach(self, fingers: Sequence[Body]) -> Floats:
        """Return the direction from the last joint of the arm to the fingertips, in the palm's frame, shape (3,)."""
        tips = np.array([self._end(finger, {}).mean(axis=0) for finger in fingers])
        base = np.mean([self._base(finger) for finger in fingers], axis=0)
        wrist = (
            self._data.oMf[self._palm]
            .actInv(self._data.oMi[self._full.getJointId(self._arm.joints[-1])])
            .translation
        )
        towards = tips.mean(axis=0) - (base if np.linalg.norm(base - wrist) < 0.01 else wrist)
        return _snapped(_unit(towards))

    def _tips(
        self,
        first: Sequence[Body],
        second: Sequence[Body],
        positions: Mapping[str, float],
        approach: Floats,
    ) -> tuple[Floats, Floats]:
        """Return the points of the tips of both sides, in the palm's frame."""
        a = np.vstack([self._of(finger, positions) for finger in first])
        b = (
            np.vstack([self._of(finger, positions) for finger in second])
            if second
            else self._of(self._arm.palm, positions, alone=True)
        )
        return tuple(side[side @ approach >= (side @ approach).max() - _TIP] for side in (a, b))

    def _flange(self, touch: tuple[str, ...]) -> Hand:
        """Return the frame at the end of an arm without fingers: z along its last axis, or away from its last joint."""
        joint = self._full.getJointId(self._arm.joints[-1])
        palm = self._place({})
        wrist = palm.actInv(self._data.oMi[joint])
        element = self._arm.palm.joint
        points = self._of(self._arm.palm, {}, alone=True)
        frames = [self._full.getFrameId(link, pin.FrameType.BODY) for link in self._arm.palm.links]
        ends = np.array([palm.actInv(self._data.oMf[frame]).translation for frame in frames])
        end = ends[np.linalg.norm(ends - wrist.translation, axis=1).argmax()]
        axis = element.find("axis") if element is not None else None
        along = np.array(
            [float(v) for v in (axis.get("xyz", "1 0 0") if axis is not None else "1 0 0").split()]
        )
        turn = _unit(wrist.rotation @ along)
        reach = (points.mean(axis=0) if len(points) else end) - wrist.translation
        towards = (
            end - wrist.translation if np.linalg.norm(end - wrist.translation) > 0.01 else reach
        )
        before = palm.actInv(self._data.oMi[self._full.parents[joint]]).translation
        if (
            np.linalg.norm(end - wrist.translation) < 0.01
            and abs((wrist.translation - before) @ turn) > 0.01
        ):
            towards = (
                wrist.translation - before
            )  # the frame of the last link is at its joint, and its shape may lie behind
        lined = abs(turn @ _unit(towards)) > 0.7
        approach = _snapped(turn * np.sign(turn @ towards) if lined else _unit(towards))
        depth = max(
            float((points @ approach).max()) if len(points) else -np.inf, float(end @ approach)
        )
        place = wrist.translation + (depth - wrist.translation @ approach) * approach
        closing = _unit(np.cross(np.eye(3)[np.abs(approach).argmin()], approach))
        tool = pin.SE3(np.column_stack([closing, np.cross(approach, closing), approach]), place)
        sure, why = "likely" if lined else "guess", "at the end of the arm: it has no fingers"
        return Hand(self._link, tool, {}, {}, 0.0, touch, sure, why)


def _points_of(file: UrdfFile, links: Sequence[str]) -> dict[str, Floats]:
    """Return points on the shapes of links, shape (n, 3) in the link's frame [m], of what collides or else of what is seen."""
    found: dict[str, Floats] = {}
    for kind in ("collision", "visual"):
        new: dict[str, list[Floats]] = {}
        for shape in file.shapes(kind):
            if shape.link in links and shape.link not in found:
                try:
                    mesh = shape.mesh()
                except InputError:
                    continue
                corners, sampled = (
                    np.asarray(mesh.vertices),
                    np.asarray(mesh.sample(_POINTS, seed=0)),
                )
                step = max(1, len(corners) // _POINTS)
                new.setdefault(shape.link, []).append(np.vstack([corners[::step], sampled]))
        found.update({link: np.vstack(points) for link, points in new.items()})
    return found


def _last(finger: Body, points: Mapping[str, Floats]) -> Body:
    """Return the body at the end of a finger's longest chain that has a shape."""
    ends = [body for body in finger.subtree() if any(link in points for link in body.links)]
    return max(ends, key=lambda body: len(body.path()))


def _unit(vector: Floats) -> Floats:
    length = float(np.linalg.norm(vector))
    return np.asarray(vector / length) if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def _snapped(direction: Floats) -> Floats:
    """Return the axis that a direction is meant to be, or the direction."""
    k = int(np.abs(direction).argmax())
    axis = np.zeros(3)
    axis[k] = np.sign(direction[k])
    return axis if abs(direction[k]) > _SNAP else direction
