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
        self.scene = scene
        self.trajectory = trajectory
        self.names = [name for name, placed in scene.objects.items() if placed.object.free]

    def at(self, times: Floats) -> dict[str, Floats]:
        """Compute name → placements as free-joint positions, shape (K, 7), at increasing times.

        Of the two quaternions of an orientation, the one nearer to its predecessor is chosen, so
        that rows can be interpolated.

        Args:
            times: Increasing times, shape (K,) [s].
        """
        trajectory = self.trajectory
        rows = {name: np.empty((len(times), 7)) for name in self.names}
        for number, phase in enumerate(trajectory.phases):
            begin = float(trajectory.times[phase.first])
            end = float(trajectory.times[phase.last])
            # The first phase also has the times before it, the last one those after it.
            is_last = number == len(trajectory.phases) - 1
            is_after_begin = (times > begin) | (number == 0)
            is_before_end = (times <= end) | is_last
            own = np.flatnonzero(is_after_begin & is_before_end)
            if not len(own) or not rows:
                continue
            placements, supports = self._begins[number]
            # Moving objects are placed relative to their placements at the begin, the first time.
            own_times = np.clip(np.concatenate([[begin], times[own]]), begin, end)
            moving = self._place_moving(phase, own_times, placements, supports)
            for name, placement in placements.items():
                if name in moving:
                    path = moving[name][1:]
                    rows[name][own] = [to_free_joint_positions(one) for one in path]
                else:
                    rows[name][own] = to_free_joint_positions(placement)
        for name_rows in rows.values():
            _align_quaternions(name_rows)
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
        placements = {name: self.scene.objects[name].placement for name in self.names}
        found = []
        for phase in self.trajectory.phases:
            supports = dict[str, str]()
            moving = dict[str, list[pin.SE3]]()
            if placements:
                supports = self._find_supports(phase, placements)
                ends = self.trajectory.times[[phase.first, phase.last]]
                moving = self._place_moving(phase, ends, placements, supports)
            found.append((placements, supports))
            placements = {**placements, **{name: path[-1] for name, path in moving.items()}}
        return found

    def _place_moving(
        self,
        phase: PhaseSpan,
        times: Floats,
        placements: Mapping[str, pin.SE3],
        supports: Mapping[str, str],
    ) -> dict[str, list[pin.SE3]]:
        """Compute placements of moving objects at times, from those at the phase's begin."""
        held = self._place_held(phase, times, placements)
        return {**held, **self._place_supported(supports, times, placements, held)}

    def _place_held(
        self, phase: PhaseSpan, times: Floats, placements: Mapping[str, pin.SE3]
    ) -> dict[str, list[pin.SE3]]:
        """Compute the placements of grasped objects at times.

        The link placement L and the grasp G of the hand on it give the object's base link
        T (L G)⁻¹ in the world, with T the placement of the grasping frame. The hand may close
        beside the grasp: the object's offset from that placement at the begin is constant.
        """
        values = self.trajectory.at(times)
        tools: list[pin.SE3] = []
        found: dict[str, list[pin.SE3]] = {}
        for hold in phase.holds:
            placed = self.scene.objects[hold.object]
            if not placed.object.free:
                continue
            if hold.by is None:
                if not tools:
                    tools = self._place_tool(values)
                holders = tools
            else:
                carrier = self.scene.objects[hold.by.object]
                link = carrier.object.link_placement(str(hold.link), carrier.state)
                holders = [placement * link for placement in found[hold.by.object]]
            attachment = get_attachment(self.scene.objects, hold)
            grasped_link = placed.object.link_placement(attachment.link, placed.state)
            names = [f"{hold.object}.{name}" for name in attachment.coordinates]
            freedoms = values[:, [self.trajectory.names.index(name) for name in names]]
            if np.all(np.ptp(freedoms, axis=0) <= _STILL):
                grasps = [attachment.tool(freedoms[0])] * len(freedoms)
            else:
                grasps = [attachment.tool(row) for row in freedoms]
            ideal = list[pin.SE3]()
            for holder, grasp in zip(holders, grasps, strict=True):
                ideal.append(holder * (grasped_link * grasp).inverse())
            offset = ideal[0].inverse() * placements[hold.object]
            found[hold.object] = [placement * offset for placement in ideal]
        return found

    def _place_tool(self, values: Floats) -> list[pin.SE3]:
        """Compute the placements of the tool frame for values of all coordinates, shape (K, n)."""
        robot = self.scene.robot
        data = robot.model.createData()
        frame = robot.model.getFrameId(robot.tool_frame)
        found = []
        for q in robot.coordinates.q(values[:, : self.trajectory.robot_size]):
            pin.forwardKinematics(robot.model, data, q)
            found.append(pin.updateFramePlacement(robot.model, data, frame).copy())
        return found

    def _place_supported(
        self,
        supports: Mapping[str, str],
        times: Floats,
        placements: Mapping[str, pin.SE3],
        held: Mapping[str, Sequence[pin.SE3]],
    ) -> dict[str, list[pin.SE3]]:
        """Compute the placements of supported objects at times, from those at the phase's begin."""
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
            links = list[pin.SE3]()
            for base, state in zip(bases, states, strict=True):
                links.append(base * carrier.object.link_placement(link, state))
            placement_in_link = links[0].actInv(placements[name])
            found[name] = [placement * placement_in_link for placement in links]
        return found

    def _find_supports(self, phase: PhaseSpan, placements: Mapping[str, pin.SE3]) -> dict[str, str]:
        """Find free object → supporting link of a phase, from placements at its begin."""
        names = self.trajectory.names
        low, high = self._ranges
        segments = slice(phase.first, phase.last)
        spreads = high[segments].max(axis=0) - low[segments].min(axis=0)
        moved = {name for name, spread in zip(names, spreads, strict=True) if spread > 0.0}
        begin = dict(zip(names, self.trajectory.positions[phase.first].tolist(), strict=True))
        objects = dict[str, PlacedObject]()
        moving_links = dict[str, set[str]]()
        for name, placed in self.scene.objects.items():
            state = placed.state.astype(float)
            driven = set[str]()
            for column, joint in enumerate(placed.object.coordinates.names):
                coordinate = f"{name}.{joint}"
                state[column] = begin.get(coordinate, state[column])
                if coordinate in moved:
                    driven.add(joint)
            placement = placements.get(name, placed.placement)
            objects[name] = dataclasses.replace(placed, placement=placement, state=state)
            if placed.object.free:
                if name in phase.held:
                    moving_links[name] = set(placed.object.links)
            elif driven:
                moving_links[name] = placed.object.links_moved_by(driven)
        if not moving_links:
            return {}
        free = placements.keys() - phase.held.keys()
        return find_supported_objects(objects, moving_links, free)


def _align_quaternions(rows: Floats) -> None:
    """Choose of q and −q, which are the same rotation, that nearer to the row before; in place.

    Args:
        rows: Positions of a free joint (translation, quaternion), shape (K, 7).
    """
    products = np.einsum("kc,kc->k", rows[1:, 3:], rows[:-1, 3:])
    flips = np.concatenate([[1.0], np.sign(products)])
    flips[flips == 0.0] = 1.0
    rows[:, 3:] *= np.cumprod(flips)[:, None]


def to_free_joint_positions(placement: pin.SE3) -> Floats:
    """Convert a placement to the seven positions of a free joint (translation, quaternion)."""
    return np.asarray(pin.SE3ToXYZQUAT(placement), float)
