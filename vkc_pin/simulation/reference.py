"""Joins the motions that a robot is sent, one taking over from another, to its reference."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from vkc_pin.simulation.welds import Span, find_nominal_spans, splice_spans
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.contact_rules import compute_start_opening
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World, compute_finger_positions

# [s] of a motion at rest, which lasts longer, since motions hold their last configuration
_REST_TIME = 1.0


@dataclass(frozen=True, eq=False)
class Segment:
    """A motion in a reference.

    Attributes:
        begin: When it takes over [s].
        motion: The motion, whose times are those of the robot's clock.
        opening: Gripper opening before it [m]; None: as in the robot's rest configuration.
    """

    begin: float
    motion: Trajectory
    opening: float | None


class Reference:
    """The motions that a robot is sent, from its rest in the start of a scene on.

    Holds are the same, whatever their deviations: these are measurements of a grasp.

    Attributes:
        segments: Motions, each of which takes over from the one before.
        spans: Holds that are not pushes with begin and end [s], ordered by begin.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        opening = compute_start_opening(scene)
        names = list(scene.robot.coordinates.names)
        values = scene.start.tolist()
        for hold in scene.holds:
            attachment = scene.objects[hold.object].object.attachment(hold.attachment)
            names += [f"{hold.object}.{name}" for name in attachment.coordinates]
            values += list(hold.at)
        phase = PhaseSpan("rest", 0, 1, scene.holds, opening)
        rest = _make_rest(tuple(names), np.array(values), len(scene.start), 0.0, phase)
        self.segments = [Segment(-np.inf, rest, opening)]
        self.spans: list[Span] = []
        for hold, _, end in find_nominal_spans(scene, rest):
            self.spans.append((hold, -np.inf, end))

    def find_segment(self, clock: float) -> int:
        """Return the number of the motion at a time [s]."""
        begins = [segment.begin for segment in self.segments]
        return int(np.searchsorted(begins, clock, side="right")) - 1

    def find_phase(self, clock: float) -> PhaseSpan:
        """Return the phase at a time [s]; the hand closes when a phase that holds begins."""
        motion = self.segments[self.find_segment(clock)].motion
        begins = motion.times[[phase.first for phase in motion.phases]]
        number = int(np.searchsorted(begins, clock, side="right")) - 1
        return motion.phases[max(number, 0)]

    def send(self, motion: Trajectory, begin: float) -> None:
        """Let a motion take over; what begins later is discarded.

        Args:
            motion: The motion.
            begin: Time at which its first waypoint is due [s].
        """
        shifted = _shift(motion, begin)
        begin = float(shifted.times[0])
        spans = find_nominal_spans(self._scene, shifted)
        self.spans = splice_spans(self.spans, spans, begin)
        self.segments = [segment for segment in self.segments if segment.begin < begin]
        opening = self.find_phase(begin).opening
        self.segments.append(Segment(begin, shifted, opening))

    def rest(self, positions: Floats, clock: float) -> None:
        """Let the robot rest from a time on, in the present phase.

        Args:
            positions: Coordinates of base and arm, shape (n,), [m] and [rad].
            clock: The time [s].
        """
        phase = self.find_phase(clock)
        names = self._scene.robot.coordinates.names
        resting = PhaseSpan("rest", 0, 1, phase.holds, phase.opening)
        self.send(_make_rest(names, positions, len(positions), clock, resting), clock)

    def divide(self, clocks: Floats) -> Iterator[tuple[Segment, Floats]]:
        """Yield each motion with those of the increasing times that belong to it, [s]."""
        begins = np.array([segment.begin for segment in self.segments])
        numbers = np.searchsorted(begins, clocks, side="right") - 1
        for number in np.unique(numbers).tolist():
            yield self.segments[number], clocks[numbers == number]

    def sample_fingers(self, segment: Segment, clocks: Floats) -> Floats:
        """Return positions of the fingers in a motion, shape (K, fingers), [m] and [rad]."""
        gripper = self._scene.robot.gripper
        if gripper is None:
            return np.zeros((len(clocks), 0))
        return compute_finger_positions(gripper, segment.opening, segment.motion, clocks)

    def make_trajectory(self, world: World, clocks: Floats) -> Trajectory:
        """Return the reference as one motion.

        Coordinates that a motion does not have stay where the motions before leave them.

        Args:
            world: The scene as one tree.
            clocks: Times of its waypoints, shape (K,) [s].
        """
        size = len(self._scene.start)
        names: dict[str, None] = {}
        for segment in self.segments:
            names |= dict.fromkeys(segment.motion.names)
        start = dict(zip(world.coordinates.names, world.start.tolist(), strict=True))
        columns = {name: column for column, name in enumerate(names)}
        positions = np.tile([start.get(name, 0.0) for name in names], (len(clocks), 1))
        ends = [segment.begin for segment in self.segments[1:]] + [np.inf]
        for segment, end in zip(self.segments, ends, strict=True):
            later = np.flatnonzero(clocks >= segment.begin)
            own = [columns[name] for name in segment.motion.names]
            times = np.minimum(clocks[later], end)
            positions[later[:, None], own] = segment.motion.at(times)
        phases = self._make_phases(clocks)
        return Trajectory(tuple(names), clocks, positions, phases, size)

    def _make_phases(self, clocks: Floats) -> tuple[PhaseSpan, ...]:
        """Return the phases between times, shape (K,) [s]."""
        found: list[tuple[int, PhaseSpan]] = []  # first time of each
        before: PhaseSpan | None = None
        for k, clock in enumerate(clocks[:-1].tolist()):
            phase = self.find_phase(clock)
            if phase is not before:
                found.append((k, phase))
            before = phase
        firsts = [first for first, _ in found]
        lasts = [*firsts[1:], len(clocks) - 1]
        phases: list[PhaseSpan] = []
        for (first, phase), last in zip(found, lasts, strict=True):
            phases.append(replace(phase, first=first, last=last))
        return tuple(phases)


def _make_rest(
    names: tuple[str, ...], values: Floats, size: int, begin: float, phase: PhaseSpan
) -> Trajectory:
    """Return a motion at rest from a time [s] on."""
    times = np.array([begin, begin + _REST_TIME])
    return Trajectory(names, times, np.array([values, values]), (phase,), size)


def _shift(motion: Trajectory, begin: float) -> Trajectory:
    """Return a motion whose first waypoint is due at a time [s]."""
    delay = begin - float(motion.times[0])
    curve = motion.curve
    if curve is not None:
        curve = replace(curve, times=curve.times + delay)
    return replace(motion, times=motion.times + delay, curve=curve)
