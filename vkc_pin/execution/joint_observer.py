"""Estimates the joint that a hand moves, while it moves it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.planning.plan import Plan
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.estimated_joints import find_axis
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.joint_estimation import (
    DECISIVE,
    FEWEST_POSES,
    JointEstimate,
    JointFit,
    JointKind,
    estimate_joint,
    fit_joint,
)
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.poses import as_placement
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.world_model import find_phase_at

ObserveLink = Callable[[str, str], object]
"""Returns the measured pose of a link of an object in the world now, or None: (object, link)."""

# Poses in a comparison, evenly chosen from all: 100 are 5 s of cycles, and take 15 ms.
_MOST_POSES = 100


@dataclass(frozen=True, eq=False)
class _Pose:
    """A measured pose of the link.

    Attributes:
        placement: Where it is in the world.
        state: Planned joint values of the object then, shape (n,), [rad] or [m].
    """

    placement: pin.SE3
    state: Floats


@dataclass(frozen=True, eq=False)
class JointFinding:
    """A joint that is elsewhere than a plan has it.

    Attributes:
        object, joint, link: Names of the object, its joint, and the link that was measured.
        estimate: The estimate; positive in the sense of the joint.
        state: Planned joint values at the last pose, shape (n,), [rad] or [m].
        value: Value of the joint at position 0 of the estimate.
        reason: How the joint differs from the plan.
        is_other_kind: Whether it is of another kind, with which no plan can go on.
    """

    object: str
    joint: str
    link: str
    estimate: JointEstimate
    state: Floats
    value: float
    reason: str
    is_other_kind: bool

    def update(self, scene: Scene) -> Scene:
        """Return a scene with the joint as measured.

        From the last pose on, the joint moves by as much as the scene has it moved since.
        """
        placed = scene.objects[self.object]
        names = placed.object.coordinates.names
        there = scene.with_state(self.object, dict(zip(names, self.state.tolist(), strict=True)))
        there = there.with_measured_joint(
            self.object, self.joint, self.estimate, link=self.link, value=self.value
        )
        index = names.index(self.joint)
        state = placed.state.copy()
        state[index] += self.value + self.estimate.positions[-1] - self.state[index]
        state = np.clip(state, placed.object.lower, placed.object.upper)
        return there.with_state(self.object, dict(zip(names, state.tolist(), strict=True)))


class JointObserver:
    """Collects poses of a link, and compares the joint that a hand moves it with to a plan's.

    Poses count from when the link is seen, before it is grasped: where it rests is where it starts.

    Args:
        observe: Measures poses.
        position_noise: Standard deviation of a measured position, per axis [m].
        rotation_noise: Standard deviation of a measured rotation, per axis [rad].
    """

    def __init__(self, observe: ObserveLink, position_noise: float, rotation_noise: float) -> None:
        self._observe = observe
        self._position_noise = position_noise
        self._rotation_noise = rotation_noise
        self._moved: tuple[Hold, str] | None = None  # hold and joint that are moved, or were last
        self._link: tuple[str, str] | None = None  # object and link of all poses
        self._poses: list[_Pose] = []

    def observe(self, plan: Plan, time: float) -> JointFinding | None:
        """Measure the link that a plan moves at a time of its motion [s], or will move next.

        Returns:
            The joint, if the poses so far decisively contradict the plan.
        """
        phase = find_phase_at(plan.trajectory, time)
        self._moved = _find_moved_joint(plan, phase) or self._moved
        if self._moved is None:
            return None
        hold, joint = self._moved
        link = plan.scene.objects[hold.object].object.attachment(hold.attachment).link
        if (hold.object, link) != self._link:
            self._link = (hold.object, link)
            self._poses = []
        measured = self._observe(hold.object, link)
        if measured is None:
            return None
        state = _get_planned_state(plan, hold.object, time)
        self._poses.append(_Pose(as_placement(measured, name="observe_link"), state))
        if hold not in {each.nominal for each in phase.holds}:
            return None
        return self._compare(plan.scene.objects[hold.object], joint, link)

    def _compare(self, placed: PlacedObject, joint: str, link: str) -> JointFinding | None:
        """Return the estimate of a joint if it is decisively better than that of an object."""
        last = self._poses[-1].state
        names = placed.object.coordinates.names
        there = placed.with_state(dict(zip(names, last.tolist(), strict=True)))
        poses = self._select_poses(there, joint, link)
        if len(poses) < FEWEST_POSES:
            return None
        placements = [pose.placement for pose in poses]
        kind, axis, point = find_axis(there, joint)
        described = self._fit(placements, kind, (axis, point)).information
        free = self._fit(placements, kind)
        # An estimate fits the other kind, too, for which most cycles have no time.
        if described - free.information < DECISIVE and free.is_plausible:
            return None
        try:
            estimate = estimate_joint(
                placements,
                position_noise=self._position_noise,
                rotation_noise=self._rotation_noise,
            )
        except InputError:  # the link has moved too little
            return None
        if described - estimate.information[estimate.kind] < DECISIVE:
            return None
        name = f"{placed.name}.{joint}"
        is_other_kind = estimate.kind != kind
        if is_other_kind:
            reason = f"{name} is {estimate.kind}, and described as {kind}"
        else:
            estimate = estimate.align(axis)
            reason = f"{name} is {_describe_difference(estimate, axis, point)} elsewhere"
        value = float(poses[0].state[names.index(joint)])
        return JointFinding(placed.name, joint, link, estimate, last, value, reason, is_other_kind)

    def _fit(
        self,
        placements: list[pin.SE3],
        kind: JointKind,
        known: tuple[Floats, Floats] | None = None,
    ) -> JointFit:
        return fit_joint(
            placements,
            kind,
            known,
            position_noise=self._position_noise,
            rotation_noise=self._rotation_noise,
        )

    def _select_poses(self, there: PlacedObject, joint: str, link: str) -> list[_Pose]:
        """Return poses that tell a joint of an object.

        They are those in which the object's other joints displace the link by less than the noise,
        compared with the object as it is now, and this displacement is taken from them.
        """
        parent_now, link_now = _compute_neighbour_placements(there, joint, link, there.state)
        index = there.object.coordinates.index(joint)
        known: dict[bytes, tuple[pin.SE3, pin.SE3]] = {}  # by the values of the other joints
        found = list[_Pose]()
        for pose in self._poses:
            others = np.delete(pose.state, index).tobytes()
            if others not in known:
                known[others] = _compute_neighbour_placements(there, joint, link, pose.state)
            parent, local = known[others]
            behind = local.actInv(link_now)
            before = parent_now.actInv(parent)
            if self._is_small(before) and self._is_small(behind):
                placement = parent_now * parent.actInv(pose.placement) * behind
                found.append(_Pose(placement, pose.state))
        count = min(len(found), _MOST_POSES)
        chosen = np.linspace(0, len(found) - 1, count).round().astype(int)
        return [found[number] for number in chosen.tolist()]

    def _is_small(self, displacement: pin.SE3) -> bool:
        """Return whether a displacement is less than the noise of a pose."""
        distance = float(np.linalg.norm(displacement.translation))
        angle = float(np.linalg.norm(pin.log3(displacement.rotation)))
        return distance <= self._position_noise and angle <= self._rotation_noise


def _compute_neighbour_placements(
    placed: PlacedObject, joint: str, link: str, state: Floats
) -> tuple[pin.SE3, pin.SE3]:
    """Return the placements of a joint's parent in the world, and of a link in the joint's body.

    Neither depends on the joint itself.
    """
    item = placed.object
    index = placed.find_joint(joint)
    frame = item.model.frames[item.link_frame(link)]
    data = item.model.createData()
    pin.forwardKinematics(item.model, data, item.coordinates.q(state))
    parent = placed.placement * data.oMi[item.model.parents[index]]
    local = data.oMi[index].actInv(data.oMi[frame.parentJoint] * frame.placement)
    return parent, local


def _find_moved_joint(plan: Plan, phase: PhaseSpan) -> tuple[Hold, str] | None:
    """Return hold and joint of the fixed object that a plan moves first, from a phase on.

    A phase may move several joints. It is the one that moves the grasped place most.
    """
    phases = plan.trajectory.phases
    for each in phases[phases.index(phase) :]:
        farthest = 0.0
        found: tuple[Hold, str] | None = None
        for hold in each.holds:
            if hold.by is not None or plan.scene.objects[hold.object].object.free:
                continue
            for joint, distance in _measure_travels(plan, each, hold).items():
                if distance > farthest:
                    farthest = distance
                    found = hold.nominal, joint
        if found is not None:
            return found
    return None


def _measure_travels(plan: Plan, phase: PhaseSpan, hold: Hold) -> dict[str, float]:
    """Return joint → distance by which it moves a grasped place from begin to end of a phase [m].

    Joints that the motion does not have rest.
    """
    motion = plan.trajectory
    placed = plan.scene.objects[hold.object]
    attachment = placed.object.attachment(hold.attachment)
    start = _get_planned_state(plan, hold.object, float(motion.times[phase.first]))
    end = _get_planned_state(plan, hold.object, float(motion.times[phase.last]))
    there = placed.object.link_placement(attachment.link, start) * attachment.placement
    travels = dict[str, float]()
    for index, joint in enumerate(placed.object.coordinates.names):
        state = start.copy()
        state[index] = end[index]
        moved = placed.object.link_placement(attachment.link, state) * attachment.placement
        travels[joint] = float(np.linalg.norm(moved.translation - there.translation))
    return travels


def _get_planned_state(plan: Plan, name: str, time: float) -> Floats:
    """Return the joint values of an object at a time of a plan [s], shape (n,)."""
    placed = plan.scene.objects[name]
    state = placed.state.copy()
    values = plan.trajectory.at(time)
    for index, joint in enumerate(placed.object.coordinates.names):
        if f"{name}.{joint}" in plan.trajectory.names:
            state[index] = values[plan.trajectory.names.index(f"{name}.{joint}")]
    return np.clip(state, placed.object.lower, placed.object.upper)


def _describe_difference(estimate: JointEstimate, axis: Floats, point: Floats) -> str:
    """Return by how much an axis is elsewhere, as distance near the link and angle."""
    angle = np.degrees(np.arccos(np.clip(estimate.axis @ axis, -1.0, 1.0)))
    if estimate.kind == "prismatic":
        return f"{angle:.1f}°"
    offset = estimate.point - point
    distance = 1e3 * float(np.linalg.norm(offset - axis * (axis @ offset)))
    return f"{distance:.0f} mm and {angle:.1f}°"
