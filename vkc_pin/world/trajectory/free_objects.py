"""Computes the placements of free objects along a motion from grasps and supports."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import get_attachment
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import find_supported_objects
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

# [m], [rad] rounding of constant grasp coordinates between samples
_STILL = 1e-12


class FreeObjects:
    """The free objects of a scene along a motion.

    A grasped object moves rigidly with its holder, from its placement when it was grasped. An
    object on a moving or grasped link moves rigidly with that support (see `world.scene.support`).
    All others keep their placements.

    Attributes:
        names: Names of the free objects.
    """

    def __init__(self, scene: Scene, trajectory: Trajectory) -> None:
        self.scene, self.trajectory = scene, trajectory
        self.names = [name for name, placed in scene.objects.items() if placed.object.free]

    def at(self, times: Floats) -> dict[str, Floats]:
        """Compute name → placements as free-joint positions, shape (K, 7), at increasing times.

        Of the two quaternions of an orientation, the one nearer to its predecessor is chosen, so
        that rows can be interpolated.

        Args:
            times: Increasing times, shape (K,) [s].
        """
        trajectory, rows = self.trajectory, {name: np.empty((len(times), 7)) for name in self.names}
        for number, phase in enumerate(trajectory.phases):
            begin, end = float(trajectory.times[phase.first]), float(trajectory.times[phase.last])
            last = number == len(trajectory.phases) - 1
            now = np.flatnonzero(((times > begin) | (number == 0)) & ((times <= end) | last))
            if not (len(now) and rows):
                continue
            where, supports = self._begins[number]
            moving = self._place_moving(
                phase, np.clip(np.concatenate([[begin], times[now]]), begin, end), where, supports
            )
            for name, placement in where.items():
                rows[name][now] = (
                    [to_free_joint_positions(p) for p in moving[name][1:]]
                    if name in moving
                    else to_free_joint_positions(placement)
                )
        for row in rows.values():
            flips = np.concatenate(
                [[1.0], np.sign(np.einsum("kc,kc->k", row[1:, 3:], row[:-1, 3:]))]
            )
            row[:, 3:] *= np.cumprod(np.where(flips == 0.0, 1.0, flips))[:, None]
        return rows

    @cached_property
    def _ranges(self) -> tuple[Floats, Floats]:
        return self.trajectory.ranges()

    @cached_property
    def supports(self) -> list[dict[str, str]]:
        """For every phase, supported free object → supporting link, "<object>.<link>"."""
        return [supports for _, supports in self._begins]

    @cached_property
    def _begins(self) -> list[tuple[dict[str, pin.SE3], dict[str, str]]]:
        """Placements of free objects when each phase begins, and the supports in it."""
        where, found = {name: self.scene.objects[name].placement for name in self.names}, []
        for phase in self.trajectory.phases:
            supports = self._find_supports(phase, where) if where else {}
            found.append((where, supports))
            ends = (
                self._place_moving(
                    phase, self.trajectory.times[[phase.first, phase.last]], where, supports
                )
                if where
                else {}
            )
            where = {**where, **{name: placements[-1] for name, placements in ends.items()}}
        return found

    def _place_moving(
        self,
        phase: PhaseSpan,
        times: Floats,
        where: Mapping[str, pin.SE3],
        supports: Mapping[str, str],
    ) -> dict[str, list[pin.SE3]]:
        """Compute placements of moving objects at times, from those at the phase's begin."""
        held = self._place_held(phase, times, where)
        return {**held, **self._place_supported(supports, times, where, held)}

    def _place_held(
        self, phase: PhaseSpan, times: Floats, where: Mapping[str, pin.SE3]
    ) -> dict[str, list[pin.SE3]]:
        values, robot = self.trajectory.at(times), self.scene.robot
        data = robot.model.createData()
        tool = robot.model.getFrameId(robot.tool_frame)
        tools: list[pin.SE3] = []
        found: dict[str, list[pin.SE3]] = {}
        for hold in phase.holds:
            placed = self.scene.objects[hold.object]
            if not placed.object.free:
                continue
            if hold.by is None:
                if not tools:
                    for q in robot.coordinates.q(values[:, : self.trajectory.robot_size]):
                        pin.forwardKinematics(robot.model, data, q)
                        tools.append(pin.updateFramePlacement(robot.model, data, tool).copy())
                holders = tools
            else:
                carrier = self.scene.objects[hold.by.object]
                link = carrier.object.link_placement(str(hold.link), carrier.state)
                holders = [placement * link for placement in found[hold.by.object]]
            attachment = get_attachment(self.scene.objects, hold)
            grasped = placed.object.link_placement(attachment.link, placed.state)
            names = [f"{hold.object}.{name}" for name in attachment.coordinates]
            freedom = values[:, [self.trajectory.names.index(name) for name in names]]
            if np.all(np.ptp(freedom, axis=0) <= _STILL):
                grasps = [attachment.tool(freedom[0])] * len(freedom)
            else:
                grasps = [attachment.tool(row) for row in freedom]
            ideal = [
                holder * (grasped * grasp).inverse()
                for holder, grasp in zip(holders, grasps, strict=True)
            ]
            offset = ideal[0].inverse() * where[hold.object]  # the hand may close beside the grasp
            found[hold.object] = [placement * offset for placement in ideal]
        return found

    def _place_supported(
        self,
        supports: Mapping[str, str],
        times: Floats,
        where: Mapping[str, pin.SE3],
        held: Mapping[str, Sequence[pin.SE3]],
    ) -> dict[str, list[pin.SE3]]:
        if not supports:
            return {}
        values = dict(zip(self.trajectory.names, self.trajectory.at(times).T, strict=True))
        found: dict[str, list[pin.SE3]] = {}
        for name, label in supports.items():
            owner, _, link = label.partition(".")
            carrier = self.scene.objects[owner]
            states = np.tile(carrier.state, (len(times), 1))
            for column, joint in enumerate(carrier.object.coordinates.names):
                states[:, column] = values.get(f"{owner}.{joint}", states[:, column])
            bases = held.get(owner, [carrier.placement] * len(times))
            links = [
                base * carrier.object.link_placement(link, state)
                for base, state in zip(bases, states, strict=True)
            ]
            local = links[0].actInv(where[name])
            found[name] = [placement * local for placement in links]
        return found

    def _find_supports(self, phase: PhaseSpan, where: Mapping[str, pin.SE3]) -> dict[str, str]:
        """Find free object → supporting link of a phase, from placements at its begin."""
        names, (low, high) = self.trajectory.names, self._ranges
        own = slice(phase.first, phase.last)
        spreads = high[own].max(axis=0) - low[own].min(axis=0)
        moved = {name for name, spread in zip(names, spreads, strict=True) if spread > 0.0}
        begin = dict(zip(names, self.trajectory.positions[phase.first].tolist(), strict=True))
        moving, objects = dict[str, set[str]](), dict[str, PlacedObject]()
        for name, placed in self.scene.objects.items():
            joints = placed.object.coordinates.names
            values = zip(joints, placed.state, strict=True)
            state = np.array([begin.get(f"{name}.{j}", value) for j, value in values], float)
            there = where.get(name, placed.placement)
            objects[name] = dataclasses.replace(placed, placement=there, state=state)
            driven = {joint for joint in joints if f"{name}.{joint}" in moved}
            if placed.object.free:
                moving |= {name: set(placed.object.links)} if name in phase.held else {}
            elif driven:
                moving[name] = placed.object.links_moved_by(driven)
        free = where.keys() - phase.held.keys()
        return find_supported_objects(objects, moving, free) if moving else {}


def to_free_joint_positions(placement: pin.SE3) -> Floats:
    """Convert a placement to the seven positions of a free joint (translation, quaternion)."""
    return np.asarray(pin.SE3ToXYZQUAT(placement), float)
