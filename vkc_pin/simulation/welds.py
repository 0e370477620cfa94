"""Models grasps as welds that follow the plan's holds and break under load, and models latches.

A hand that closes beside the attachment, farther off than a measured grasp may be, holds nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.simulation.contacts import Pairs
from vkc_pin.simulation.model import TORQUE_SCALE, PhysicalWorld, to_mujoco_quaternion
from vkc_pin.simulation.physics import Physics, import_mujoco
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import (
    Hold,
    compute_distances,
    is_within_grasp,
    measure_deviation,
)
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

# [s] of the moving average of forces: rubber yields, a weld does not
_AVERAGING_TIME = 0.02
# [rad] or [m] from the latched position within which a latch engages
_LATCH_TOLERANCE = 2e-3
Span = tuple[Hold, float, float]
"""A hold with its begin and end [s]."""


@dataclass(frozen=True)
class Grip:
    """One hold of a plan, from begin to end.

    Attributes:
        what: Grasped attachment, e.g. "door.handle".
        begin, end: Begin and end of the hold according to the plan [s].
        force, torque: Largest 20 ms average at the grasping frame [N], [N·m].
        broken: Time at which the hand lost its hold [s]; None if it did not.
        slip: Largest displacement between holder and object, for grasps by friction [m].
        distance, angle: Distance [m] and angle [rad] of the hand from the attachment when it
            closes.
    """

    what: str
    begin: float
    end: float
    force: float = 0.0
    torque: float = 0.0
    broken: float | None = None
    slip: float = 0.0
    distance: float = 0.0
    angle: float = 0.0

    @property
    def missed(self) -> bool:
        """Whether the hand closes more than 20 mm or 0.2 rad from the attachment."""
        return not is_within_grasp(self.distance, self.angle)

    @property
    def problem(self) -> str | None:
        """What went wrong, in a line; None: nothing."""
        if self.missed:
            off = f"{1e3 * self.distance:.0f} mm and {self.angle:.2f} rad"
            return f"the hand misses {self.what} by {off} when it closes at {self.begin:.2f} s"
        if self.broken is not None:
            return f"{self.what} was pulled out of the hand at {self.broken:.2f} s"
        return None

    def to_dict(self) -> dict[str, Any]:
        """Return the grip as plain data."""
        return {**asdict(self), "missed": self.missed}


def find_hold_spans(scene: Scene, trajectory: Trajectory) -> list[Span]:
    """Return each hold that is not a push with its begin and end [s], ordered by begin."""
    changes = [(-np.inf, set(scene.holds))]
    for phase in trajectory.phases:
        changes.append((float(trajectory.times[phase.first]), set(phase.holds)))
    return _collect_spans(scene, changes)


def find_nominal_spans(scene: Scene, motion: Trajectory) -> list[Span]:
    """Return the holds of a motion's phases as `find_hold_spans` does, without deviations."""
    changes: list[tuple[float, set[Hold]]] = []
    for phase in motion.phases:
        nominal = {hold.nominal for hold in phase.holds}
        changes.append((float(motion.times[phase.first]), nominal))
    return _collect_spans(scene, changes)


def _collect_spans(scene: Scene, changes: Sequence[tuple[float, set[Hold]]]) -> list[Span]:
    """Return each hold that is not a push with its begin and end [s].

    Args:
        scene: Scene of the holds.
        changes: Times [s], each with all holds from then on.
    """
    spans: list[Span] = []
    begins: dict[Hold, float] = {}  # of holds that have not ended
    for time, holds in changes:
        ended = [hold for hold in begins if hold not in holds]
        for hold in ended:
            spans.append((hold, begins.pop(hold), time))
        for hold in holds:
            if not _is_push(scene, hold):
                begins.setdefault(hold, time)
    for hold, begin in begins.items():
        spans.append((hold, begin, np.inf))
    return sorted(spans, key=_get_order)


def splice_spans(known: Sequence[Span], later: Sequence[Span], begin: float) -> list[Span]:
    """Return the holds of two motions, of which the second one takes over.

    A hold that both have at that time goes on, even if the hand has lost the object since.

    Args:
        known: Holds so far.
        later: Holds of the second motion.
        begin: Time at which it takes over [s].
    """
    spliced = [(hold, first, min(last, begin)) for hold, first, last in known if first < begin]
    lasting = {hold: k for k, (hold, _, last) in enumerate(spliced) if last == begin}
    for hold, first, last in later:
        if first <= begin and hold in lasting:
            number = lasting[hold]
            spliced[number] = (hold, spliced[number][1], last)
        else:
            spliced.append((hold, max(first, begin), last))
    return sorted(spliced, key=_get_order)


def _get_order(span: Span) -> tuple[float, str]:
    """Return what spans are sorted by: their begin [s], then their text."""
    return span[1], str(span[0])


def measure_hand(
    physical: PhysicalWorld, data: Any, hold: Hold, planned: Sequence[float] | Floats
) -> tuple[tuple[float, ...], float, float]:
    """Return where a holder is at the attachment that it is to hold.

    Args:
        physical: The model.
        data: Its state, an `mujoco.MjData`.
        hold: The hold.
        planned: Planned values of the attachment's freedoms, [m] and [rad]; those beyond the limits
            count as the limits.

    Returns:
        Values of the freedoms, distance [m] and angle [rad] of the holder from the attachment: as
        planned if the hand can hold the attachment there, otherwise those that bring the
        attachment nearest to the holder.
    """
    scene = physical.world.scene
    attachment = scene.objects[hold.object].object.attachment(hold.attachment)
    holder = physical.place_frame(data, hold.frame or scene.robot.tool_frame)
    link = physical.place_frame(data, f"{hold.object}.{attachment.link}")
    measured = holder.actInv(link * attachment.placement)
    possible: list[float] = []
    for value, freedom in zip(planned, attachment.freedoms, strict=True):
        possible.append(min(max(value, freedom.lower), freedom.upper))
    values, deviation = measure_deviation(attachment, measured, possible)
    distance, angle = compute_distances(deviation)
    if not is_within_grasp(distance, angle):
        values, deviation = measure_deviation(attachment, measured)
        distance, angle = compute_distances(deviation)
    return values, distance, angle


def compute_planned_freedoms(
    scene: Scene, trajectory: Trajectory, hold: Hold, clock: float
) -> Floats:
    """Return the planned values of a grasp's degrees of freedom at a time [s], [m] and [rad]."""
    names = scene.objects[hold.object].object.attachment(hold.attachment).coordinates
    values = dict(zip(trajectory.names, trajectory.at(clock).tolist(), strict=True))
    start = dict(zip(names, hold.at, strict=False))
    return np.array([values.get(f"{hold.object}.{name}", start.get(name, 0.0)) for name in names])


def _is_push(scene: Scene, hold: Hold) -> bool:
    """Return whether a hold only pushes."""
    return scene.objects[hold.object].object.attachment(hold.attachment).contact == "push"


class Grips:
    """Activates and releases welds according to a schedule.

    Attributes:
        grips: Grips so far.
    """

    def __init__(
        self,
        physical: PhysicalWorld,
        holds: Sequence[Hold],
        schedule: Sequence[Span],
        pairs: Pairs,
        trajectory: Trajectory,
        physics: Physics,
        *,
        touching: Collection[Hold] = (),
    ) -> None:
        self.physical = physical
        self.pairs = pairs
        self.holds = list(holds)
        self.schedule = list(schedule)
        self.trajectory = trajectory
        self.physics = physics
        self._touching = touching
        self._engine = import_mujoco()
        self.grips: list[Grip] = []
        self._active: dict[Hold, tuple[int, float]] = {}  # index into grips, and end [s]
        self._forces: dict[Hold, deque[Floats]] = {}
        self._targets: dict[Hold, pin.SE3] = {}  # of the welds: placement of link in holder
        self._equality = int(self._engine.mjtConstraint.mjCNSTR_EQUALITY)
        self._window = max(1, round(_AVERAGING_TIME / physics.timestep))
        self._followed = -np.inf  # time up to which holds have begun [s]

    @property
    def has_active(self) -> bool:
        """Whether anything is welded."""
        return bool(self._active)

    @property
    def loads(self) -> dict[Hold, tuple[float, float]]:
        """Active hold → force [N] and torque [N·m] at the grasping frame, averages of 20 ms."""
        found: dict[Hold, tuple[float, float]] = {}
        for hold in self._active:
            forces = self._forces[hold]
            mean = np.mean(forces, axis=0) if forces else np.zeros(6)
            found[hold] = float(np.linalg.norm(mean[:3])), float(np.linalg.norm(mean[3:]))
        return found

    def reschedule(self, spans: Sequence[Span], last: float) -> None:
        """Replace all begins and ends that are still to come; active holds stay as they are.

        Args:
            spans: All holds, including those that have begun, with begin and end [s].
            last: Time at which the motion ends [s].
        """
        self.schedule = [span for span in spans if span[1] > self._followed]
        begun = [span for span in spans if span[1] <= self._followed]
        for hold, (number, _) in self._active.items():
            end = max(end for other, _, end in begun if other == hold)
            self._active[hold] = (number, end)
            self.grips[number] = replace(self.grips[number], end=min(end, last))

    def adopt(self, other: Grips, data: Any, other_data: Any) -> None:
        """Go on with the welds of another model, whose holds are the first ones of this model.

        Args:
            other: Grips of the other model.
            data: State of this model.
            other_data: State of the other model.
        """
        count = len(other.holds)
        model = self.physical.model
        placements = slice(0, TORQUE_SCALE)
        model.eq_data[:count, placements] = other.physical.model.eq_data[:count, placements]
        data.eq_active[:count] = other_data.eq_active[:count]
        self.grips = other.grips
        self._active = other._active
        self._forces = other._forces
        self._targets = other._targets
        self._followed = other._followed
        for hold in self._active:
            self._set_collision(hold, enabled=False)

    def follow(self, data: Any, clock: float) -> None:
        """Begin and end the holds that are due at a time [s] of the plan."""
        self._followed = clock
        ended = [hold for hold, (_, end) in self._active.items() if end <= clock]
        for hold in ended:
            self._release(data, hold)
        while self.schedule and self.schedule[0][1] <= clock:
            hold, begin, end = self.schedule.pop(0)
            self._begin(data, hold, begin, end, clock)

    def _begin(self, data: Any, hold: Hold, begin: float, end: float, clock: float) -> None:
        """Close the hand at an attachment: weld it if it is near enough."""
        first, last = self.trajectory.times[[0, -1]].tolist()
        scene = self.physical.world.scene
        planned = compute_planned_freedoms(scene, self.trajectory, hold, clock)
        values, distance, angle = measure_hand(self.physical, data, hold, planned)
        grip = Grip(str(hold), max(begin, first), min(end, last), distance=distance, angle=angle)
        if not grip.missed:
            self._engage(data, hold, values)
            self._active[hold] = (len(self.grips), end)
            self._forces[hold] = deque(maxlen=self._window)
        self.grips.append(grip)

    def measure(self, data: Any, clock: float) -> None:
        """Record the load on the welds after a step, and release those that are overloaded."""
        if not self._active:
            return
        is_equality = np.asarray(data.efc_type) == self._equality
        owners = np.asarray(data.efc_id)
        for hold, (number, _) in list(self._active.items()):
            index = self.holds.index(hold)
            rows = np.flatnonzero(is_equality & (owners == index))
            load = np.array(data.efc_force)[rows]
            # Rotational rows act on scaled half angles, as quaternions do.
            load[3:] *= 0.5 * self.physical.model.eq_data[index, TORQUE_SCALE]
            forces = self._forces[hold]
            forces.append(load)
            if len(forces) < self._window:
                continue
            mean = np.mean(forces, axis=0)
            force = float(np.linalg.norm(mean[:3]))
            torque = float(np.linalg.norm(mean[3:]))
            is_broken = force > self.physics.grasp_force or torque > self.physics.grasp_torque
            grip = self.grips[number]
            # Before, the servos settle under the load that is in the hand at the start.
            if clock >= grip.begin or is_broken:
                grip = replace(grip, force=max(force, grip.force), torque=max(torque, grip.torque))
            self.grips[number] = replace(grip, broken=clock if is_broken else None)
            if is_broken:
                self._release(data, hold)

    def preload(self, data: Any, settled: Any) -> None:
        """Displace each weld such that its load at rest keeps the bodies where they are now.

        A weld gives way under load. The relative placement G of the welded bodies becomes G' when
        the weld has settled, while its target is T. With the target T · (G⁻¹ · G')⁻¹ the same load
        leaves them at G, up to terms of second order.

        Args:
            data: The state that is to last, an `mujoco.MjData`.
            settled: The state that the welds of `data` lead to.
        """
        for hold in self._active:
            kept = self._measure_weld(data, hold)
            given_way = self._measure_weld(settled, hold)
            self._set_target(hold, self._targets[hold] * kept.actInv(given_way).inverse())

    def _measure_weld(self, data: Any, hold: Hold) -> pin.SE3:
        """Return the placement of the welded link's body in that of the holder."""
        model = self.physical.model
        number = self.holds.index(hold)
        holder = self.physical.place_body(data, int(model.eq_obj1id[number]))
        link = self.physical.place_body(data, int(model.eq_obj2id[number]))
        return holder.actInv(link)

    def _engage(self, data: Any, hold: Hold, freedoms: Sequence[float]) -> None:
        """Weld the holder to the link at their current relative placement."""
        model = self.physical.model
        number = self.holds.index(hold)
        if hold in self.physical.carriers:
            data.qpos[self.physical.carriers[hold]] = freedoms
            self._engine.mj_kinematics(model, data)
        scene = self.physical.world.scene
        link = self.physical.place_body(data, int(model.eq_obj2id[number]))
        tool = self.physical.place_frame(data, hold.frame or scene.robot.tool_frame)
        model.eq_data[number, :3] = link.actInv(tool).translation
        self._set_target(hold, self._measure_weld(data, hold))
        data.eq_active[number] = 1
        self._set_collision(hold, enabled=False)

    def _set_target(self, hold: Hold, target: pin.SE3) -> None:
        """Set the placement of the welded link's body in that of the holder."""
        model = self.physical.model
        number = self.holds.index(hold)
        anchor = np.array(model.eq_data[number, :3])  # of the weld, in the link's body
        model.eq_data[number, 3:6] = target.act(anchor)
        model.eq_data[number, 6:10] = to_mujoco_quaternion(target)
        self._targets[hold] = target

    def _release(self, data: Any, hold: Hold) -> None:
        """Open the hand."""
        data.eq_active[self.holds.index(hold)] = 0
        del self._active[hold]
        del self._forces[hold]
        self._set_collision(hold, enabled=True)

    def _set_collision(self, hold: Hold, *, enabled: bool) -> None:
        """Enable or disable contacts between the holder and the held link."""
        if hold in self._touching:
            return
        bit = self.pairs.bits[hold]
        if any(self.pairs.bits[other] == bit for other in self._active if other != hold):
            return
        own = self.physical.geoms[(self.pairs.types & bit) != 0]
        types = self.physical.model.geom_contype
        if enabled:
            types[own] |= bit
        else:
            types[own] &= ~bit


def find_latches(scene: Scene) -> list[tuple[str, float, str, float]]:
    """Return joint, latched position, releasing joint and release threshold of each latch."""
    found: list[tuple[str, float, str, float]] = []
    for name, placed in scene.objects.items():
        for latch in placed.object.latches:
            joint = f"{name}.{latch.joint}"
            release = f"{name}.{latch.released_by}"
            found.append((joint, latch.held_at, release, latch.threshold))
    return found


class Latches:
    """Latches that engage at their joint's latched position and are released by another joint."""

    def __init__(
        self,
        physical: PhysicalWorld,
        latches: Sequence[tuple[str, float, str, float]],
        first: int,
        physics: Physics,
    ) -> None:
        names = physical.world.coordinates.names
        columns = dict(zip(names, physical.columns.tolist(), strict=True))
        self._latches = [
            (columns[joint], at, columns[release], threshold - physics.latch_play)
            for joint, at, release, threshold in latches
        ]
        self._first = first

    def follow(self, data: Any) -> None:
        """Engage and release latches."""
        for number, (joint, at, release, threshold) in enumerate(self._latches, self._first):
            is_at_latch = abs(data.qpos[joint] - at) <= _LATCH_TOLERANCE
            is_engaged = bool(data.eq_active[number]) or is_at_latch
            data.eq_active[number] = is_engaged and data.qpos[release] < threshold
