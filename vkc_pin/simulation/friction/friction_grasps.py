"""What a hand holds by friction: when its fingers close and open, how hard they pull, and how far they slip."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from vkc_pin.simulation.friction.fingers import Fingers
from vkc_pin.simulation.model import PhysicalWorld
from vkc_pin.simulation.physics import Physics, engine
from vkc_pin.simulation.welds import Grip
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.scene.contact_rules import grasped, touching
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["Span", "Squeezes", "grip_changes", "split"]

Span = tuple[Hold, float, float]
"""What is held, from when to when [s]."""
# of their way that fingers are told to go on beyond where they are closed, so that thin things are
# pressed as well
_BITE = 0.15
_LOST = 0.1  # [s] without touching, after which what was held is lost
_AVERAGED = 2  # looks over which forces are averaged


def grip_changes(trajectory: Trajectory, spans: Sequence[Span]) -> list[int]:
    """Return the waypoints at which the hand closes or opens."""
    moments = {time for _, begin, end in spans for time in (begin, end) if np.isfinite(time)}
    return [
        phase.first
        for phase in trajectory.phases
        if float(trajectory.times[phase.first]) in moments
    ]


@dataclass(eq=False)
class _Squeeze:
    """One hold.

    Attributes:
        hold, begin, end: What is held, from when to when [s].
        hand, link: Which of MuJoCo's geoms hold, and are held, shape (geoms,).
        pairs: The names of these, which may touch.
        grip: What is known of it.
        forces: The last ones, and torques, shape (6,) each.
        place: The tool in the link's frame when the fingers had closed [m]; None: they have not
            yet.
        missing: For how many looks nothing has touched.
    """

    hold: Hold
    begin: float
    end: float
    hand: Bools
    link: Bools
    pairs: frozenset[tuple[str, str]]
    grip: Grip
    forces: deque[Floats] = field(default_factory=lambda: deque(maxlen=_AVERAGED))
    place: Floats | None = None
    missing: int = 0


class Squeezes:
    """Holds by friction that follow a schedule.

    Args:
        physical: The model.
        fingers: What closes.
        spans: When; all by the robot's own hand.
        trajectory: The motion.
        physics: How long fingers take.
        period: From look to look [s].
    """

    def __init__(
        self,
        physical: PhysicalWorld,
        fingers: Fingers,
        spans: Sequence[Span],
        trajectory: Trajectory,
        physics: Physics,
        period: float,
    ) -> None:
        self._physical, self._fingers, self._physics, self._period = (
            physical,
            fingers,
            physics,
            period,
        )
        self._engine = engine()
        first, last = float(trajectory.times[0]), float(trajectory.times[-1])
        world, scene = physical.world, physical.world.scene
        labels = np.full(physical.model.ngeom, "", object)
        labels[physical.geoms] = world.collision_labels
        self._squeezes = []
        for hold, begin, end in spans:
            hands, link = frozenset(touching(scene, hold)), grasped(scene, hold)
            pairs = frozenset((min(hand, link), max(hand, link)) for hand in hands)
            own, grip = (
                np.isin(labels, list(hands)),
                Grip(str(hold), max(begin, first), min(end, last)),
            )
            self._squeezes.append(
                _Squeeze(hold, begin, end, own, np.asarray(labels == link), pairs, grip)
            )
        tree = world.model
        self._tool = tree.frames[tree.getFrameId(scene.robot.tool_frame)]

    @property
    def grips(self) -> list[Grip]:
        """What has been held."""
        return [squeeze.grip for squeeze in self._squeezes]

    def commands(self, times: Floats, planned: Floats) -> Floats:
        """Return what fingers are told at times [s], shape (K, k), of where the plan has them, shape (K, k)."""
        shares, time = np.zeros(len(times)), self._physics.grip_time
        for squeeze in self._squeezes:
            begin = max(squeeze.begin, float(times[0]))
            corners = [
                begin,
                begin + time,
                max(squeeze.end, begin + time),
                max(squeeze.end, begin + time) + time,
            ]
            shares = np.maximum(shares, np.interp(times, corners, [0.0, 1.0, 1.0, 0.0]))
        fingers = self._fingers
        closed = fingers.closed + _BITE * (fingers.closed - fingers.open)
        return np.asarray(planned + shares[:, None] * (closed - planned))

    def may_touch(self, clock: float) -> set[tuple[str, str]]:
        """Return the names of what may touch at a time [s], because it is held, taken or let go."""
        time = self._physics.grip_time
        return {
            pair
            for one in self._squeezes
            if one.begin <= clock <= one.end + time
            for pair in one.pairs
        }

    def measure(self, data: Any, clock: float) -> None:
        """Note how hard hands pull, and how far they have slipped."""
        for squeeze in self._squeezes:
            begin = max(squeeze.begin + self._physics.grip_time, squeeze.grip.begin)
            if not begin <= clock < squeeze.end or squeeze.grip.broken is not None:
                continue
            tool, place = self._places(data, squeeze)
            squeeze.place = place if squeeze.place is None else squeeze.place
            pull = self._pull(data, squeeze, tool)
            squeeze.missing = 0 if pull is not None else squeeze.missing + 1
            squeeze.forces.append(np.zeros(6) if pull is None else pull)
            mean = np.mean(squeeze.forces, axis=0)
            grip = squeeze.grip
            force, torque = (
                max(grip.force, float(np.linalg.norm(mean[:3]))),
                max(grip.torque, float(np.linalg.norm(mean[3:]))),
            )
            slip = max(grip.slip, float(np.linalg.norm(place - squeeze.place)))
            lost = clock if squeeze.missing * self._period >= _LOST else None
            squeeze.grip = replace(grip, force=force, torque=torque, slip=slip, broken=lost)

    def _places(self, data: Any, squeeze: _Squeeze) -> tuple[Floats, Floats]:
        """Return where the tool is in the world, and in the frame of the body that is held [m]."""
        tool = int(self._physical.bodies[self._tool.parentJoint])
        where = (
            data.xpos[tool]
            + np.asarray(data.xmat[tool]).reshape(3, 3) @ self._tool.placement.translation
        )
        body = int(self._physical.model.geom_bodyid[np.flatnonzero(squeeze.link)[0]])
        turn = np.asarray(data.xmat[body]).reshape(3, 3)
        return np.asarray(where), np.asarray(turn.T @ (where - data.xpos[body]))

    def _pull(self, data: Any, squeeze: _Squeeze, tool: Floats) -> Floats | None:
        """Return force and torque of the hand on what it holds, at the tool frame's origin, shape (6,); None: nothing touches."""
        pairs = np.asarray(data.contact.geom).reshape(-1, 2)
        ahead = squeeze.hand[pairs[:, 0]] & squeeze.link[pairs[:, 1]]
        back = squeeze.link[pairs[:, 0]] & squeeze.hand[pairs[:, 1]]
        found, pushed, wrench = np.zeros(6), False, np.zeros(6)
        for i in np.flatnonzero(ahead | back).tolist():
            self._engine.mj_contactForce(self._physical.model, data, i, wrench)
            pushed |= bool(wrench[0] > 0.0)
            axes = np.asarray(data.contact.frame[i]).reshape(3, 3)
            force, torque = (1.0 if ahead[i] else -1.0) * (wrench.reshape(2, 3) @ axes)
            found[:3] += force
            found[3:] += torque + np.cross(np.asarray(data.contact.pos[i]) - tool, force)
        return found if pushed else None


def split(spans: Sequence[Span], begin: float) -> tuple[list[Span], list[Span]]:
    """Return holds that are welds, and those by friction: the hand's own; what it has at the start is welded until it has closed.

    Args:
        spans: All.
        begin: When the motion begins [s].
    """
    own = [span for span in spans if span[0].by is None]
    others = [span for span in spans if span[0].by is not None]
    return [*((hold, first, begin) for hold, first, _ in own if first < begin), *others], own
