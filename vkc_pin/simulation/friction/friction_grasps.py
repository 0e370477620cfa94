"""Commands fingers that grasp by friction, and measures their load and slip."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.simulation.friction.fingers import Fingers
from vkc_pin.simulation.model import PhysicalWorld
from vkc_pin.simulation.physics import Physics, import_mujoco
from vkc_pin.simulation.welds import Grip
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.scene.contact_rules import find_grasped_link, find_touch_links
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["Span", "Squeezes", "find_grip_changes", "insert_pauses", "split_spans"]

Span = tuple[Hold, float, float]
"""A hold with its begin and end [s]."""
# Fingers are commanded this fraction of their travel beyond the closed position, so that thin
# objects are pressed too.
_OVERTRAVEL = 0.15
_LOST_TIME = 0.1  # [s] without contact after which the object counts as lost
_AVERAGED_SAMPLES = 2  # number of samples over which forces are averaged


def find_grip_changes(trajectory: Trajectory, spans: Sequence[Span]) -> list[int]:
    """Return the waypoints at which the hand closes or opens."""
    moments = {time for _, begin, end in spans for time in (begin, end) if np.isfinite(time)}
    return [
        phase.first
        for phase in trajectory.phases
        if float(trajectory.times[phase.first]) in moments
    ]


@dataclass(eq=False)
class _Squeeze:
    """One grasp by friction.

    Attributes:
        begin, end: Begin and end of the hold [s].
        hand, link: Masks of the geoms of hand and grasped link, shape (geoms,).
        pairs: Pairs of their labels, which may touch.
        grip: Measurements so far.
        forces: Latest forces and torques, shape (6,) each.
        place: Tool position in the link's frame when the fingers had closed [m]; None before.
        missing: Number of consecutive samples without contact.
    """

    begin: float
    end: float
    hand: Bools
    link: Bools
    pairs: frozenset[tuple[str, str]]
    grip: Grip
    forces: deque[Floats] = field(default_factory=lambda: deque(maxlen=_AVERAGED_SAMPLES))
    place: Floats | None = None
    missing: int = 0


class Squeezes:
    """Grasps by friction that follow a schedule."""

    def __init__(
        self,
        physical: PhysicalWorld,
        fingers: Fingers,
        spans: Sequence[Span],
        trajectory: Trajectory,
        physics: Physics,
        period: float,
    ) -> None:
        self._physical, self._fingers = physical, fingers
        self._physics, self._period = physics, period
        self._engine = import_mujoco()
        first, last = float(trajectory.times[0]), float(trajectory.times[-1])
        world, scene = physical.world, physical.world.scene
        labels = np.full(physical.model.ngeom, "", object)
        labels[physical.geoms] = world.collision_labels
        self._squeezes = []
        for hold, begin, end in spans:
            hands, link = frozenset(find_touch_links(scene, hold)), find_grasped_link(scene, hold)
            pairs = frozenset((min(hand, link), max(hand, link)) for hand in hands)
            own, held = np.isin(labels, list(hands)), np.asarray(labels == link)
            grip = Grip(str(hold), max(begin, first), min(end, last))
            self._squeezes.append(_Squeeze(begin, end, own, held, pairs, grip))
        tree = world.model
        self._tool = tree.frames[tree.getFrameId(scene.robot.tool_frame)]

    @property
    def grips(self) -> list[Grip]:
        """Grips so far."""
        return [squeeze.grip for squeeze in self._squeezes]

    def compute_commands(self, times: Floats, planned: Floats) -> Floats:
        """Return the finger commands at times [s], shape (K, k).

        Args:
            times: Times, shape (K,) [s].
            planned: Planned finger positions, shape (K, k).
        """
        shares, time = np.zeros(len(times)), self._physics.grip_time
        for squeeze in self._squeezes:
            begin = max(squeeze.begin, float(times[0]))
            end = max(squeeze.end, begin + time)
            corners = [begin, begin + time, end, end + time]
            shares = np.maximum(shares, np.interp(times, corners, [0.0, 1.0, 1.0, 0.0]))
        fingers = self._fingers
        closed = fingers.closed + _OVERTRAVEL * (fingers.closed - fingers.open)
        return np.asarray(planned + shares[:, None] * (closed - planned))

    def allowed_contacts(self, clock: float) -> set[tuple[str, str]]:
        """Return the label pairs that may touch at a time [s] because of a grasp."""
        time = self._physics.grip_time
        return {
            pair
            for one in self._squeezes
            if one.begin <= clock <= one.end + time
            for pair in one.pairs
        }

    def measure(self, data: Any, clock: float) -> None:
        """Record the load and slip of each grasp."""
        for squeeze in self._squeezes:
            begin = max(squeeze.begin + self._physics.grip_time, squeeze.grip.begin)
            if not begin <= clock < squeeze.end or squeeze.grip.broken is not None:
                continue
            tool, place = self._find_tool(data, squeeze)
            squeeze.place = place if squeeze.place is None else squeeze.place
            pull = self._compute_wrench(data, squeeze, tool)
            squeeze.missing = 0 if pull is not None else squeeze.missing + 1
            squeeze.forces.append(np.zeros(6) if pull is None else pull)
            mean = np.mean(squeeze.forces, axis=0)
            grip = squeeze.grip
            force = max(grip.force, float(np.linalg.norm(mean[:3])))
            torque = max(grip.torque, float(np.linalg.norm(mean[3:])))
            slip = max(grip.slip, float(np.linalg.norm(place - squeeze.place)))
            lost_time = clock if squeeze.missing * self._period >= _LOST_TIME else None
            squeeze.grip = replace(grip, force=force, torque=torque, slip=slip, broken=lost_time)

    def _find_tool(self, data: Any, squeeze: _Squeeze) -> tuple[Floats, Floats]:
        """Return the tool's position in the world and in the grasped body's frame [m]."""
        tool = int(self._physical.bodies[self._tool.parentJoint])
        where = (
            data.xpos[tool]
            + np.asarray(data.xmat[tool]).reshape(3, 3) @ self._tool.placement.translation
        )
        body = int(self._physical.model.geom_bodyid[np.flatnonzero(squeeze.link)[0]])
        turn = np.asarray(data.xmat[body]).reshape(3, 3)
        return np.asarray(where), np.asarray(turn.T @ (where - data.xpos[body]))

    def _compute_wrench(self, data: Any, squeeze: _Squeeze, tool: Floats) -> Floats | None:
        """Return the hand's wrench on the grasped link at the tool's origin, shape (6,)."""
        pairs = np.asarray(data.contact.geom).reshape(-1, 2)
        ahead = squeeze.hand[pairs[:, 0]] & squeeze.link[pairs[:, 1]]
        back = squeeze.link[pairs[:, 0]] & squeeze.hand[pairs[:, 1]]
        total, pushed, wrench = np.zeros(6), False, np.zeros(6)
        for i in np.flatnonzero(ahead | back).tolist():
            self._engine.mj_contactForce(self._physical.model, data, i, wrench)
            pushed |= bool(wrench[0] > 0.0)
            axes = np.asarray(data.contact.frame[i]).reshape(3, 3)
            force, torque = (1.0 if ahead[i] else -1.0) * (wrench.reshape(2, 3) @ axes)
            total[:3] += force
            total[3:] += torque + np.cross(np.asarray(data.contact.pos[i]) - tool, force)
        return total if pushed else None


def split_spans(spans: Sequence[Span], begin: float) -> tuple[list[Span], list[Span]]:
    """Divide holds into welds and grasps by friction.

    The robot's own hand grasps by friction. An object that it holds at the start is welded until
    the fingers have closed.

    Args:
        spans: All holds.
        begin: Begin of the trajectory [s].
    """
    own = [span for span in spans if span[0].by is None]
    others = [span for span in spans if span[0].by is not None]
    return [*((hold, first, begin) for hold, first, _ in own if first < begin), *others], own


_REST = 1e-6  # [m/s] or [rad/s] up to which the robot is at rest


def insert_pauses(trajectory: Trajectory, waypoints: Iterable[int], seconds: float) -> Trajectory:
    """Insert a pause at some waypoints.

    Each of these waypoints is duplicated; both copies belong to the phase that begins there.

    Args:
        trajectory: The trajectory.
        waypoints: Waypoints at which to pause, none of them the last one.
        seconds: Duration of each pause [s].
    """
    at = np.array(sorted(set(waypoints)), int)
    if not len(at):
        return trajectory
    curve = trajectory.curve
    if curve is not None:
        knots = np.searchsorted(curve.times, trajectory.times[at])
        moving = np.abs(curve.rates[knots]).max(axis=1) > _REST
        if moving.any():
            got = f"moving at {trajectory.times[at[moving]][0]:.2f} s"
            raise InputError(
                "the hand closes or opens while the robot moves",
                field="trajectory",
                expected="a trajectory at rest",
                got=got,
            )
        rates = np.insert(curve.rates, knots + 1, 0.0, axis=0)
        rates[knots + np.arange(len(knots))] = 0.0
        positions = np.insert(curve.positions, knots + 1, curve.positions[knots], axis=0)
        curve = Curve(_insert_delays(curve.times, knots, seconds), positions, rates)

    def shift_index(waypoint: int) -> int:
        return waypoint + int(np.searchsorted(at, waypoint))

    return replace(
        trajectory,
        times=_insert_delays(trajectory.times, at, seconds),
        positions=np.insert(trajectory.positions, at + 1, trajectory.positions[at], axis=0),
        phases=tuple(
            replace(phase, first=shift_index(phase.first), last=shift_index(phase.last))
            for phase in trajectory.phases
        ),
        curve=curve,
    )


def _insert_delays(times: Floats, at: Ints, seconds: float) -> Floats:
    """Return times with those at indices `at` doubled, `seconds` apart, and later ones delayed."""
    delays = seconds * np.searchsorted(at, np.arange(len(times)))
    return np.asarray(np.insert(times + delays, at + 1, (times + delays)[at] + seconds))
