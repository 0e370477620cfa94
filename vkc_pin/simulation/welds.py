"""Models grasps as welds that follow the plan's holds and break under load, and models latches."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from vkc_pin.simulation.contacts import Pairs
from vkc_pin.simulation.model import PhysicalWorld
from vkc_pin.simulation.physics import Physics, import_mujoco
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["Grip", "Grips", "Latches", "find_hold_spans", "find_latches"]

_AVERAGING_TIME = 0.02  # [s] of the moving average of forces: rubber yields, a weld does not
_LATCH_TOLERANCE = 2e-3  # [rad] or [m] from the latched position within which a latch engages


@dataclass(frozen=True)
class Grip:
    """One hold of a plan, from begin to end.

    Attributes:
        what: Grasped attachment, e.g. "door.handle".
        begin, end: Begin and end of the hold according to the plan [s].
        force, torque: Largest 20 ms average at the grasping frame [N], [N·m].
        broken: Time at which the hand lost its hold [s]; None if it did not.
        slip: Largest displacement between holder and object, for grasps by friction [m].
    """

    what: str
    begin: float
    end: float
    force: float = 0.0
    torque: float = 0.0
    broken: float | None = None
    slip: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the grip as plain data."""
        return asdict(self)


def find_hold_spans(scene: Scene, trajectory: Trajectory) -> list[tuple[Hold, float, float]]:
    """Return each hold that is not a push with its begin and end [s], ordered by begin."""
    spans, active_since = list[tuple[Hold, float, float]](), dict[Hold, float]()
    times = trajectory.times
    held = [set(scene.holds), *(set(phase.holds) for phase in trajectory.phases)]
    begins = [-np.inf, *(float(times[phase.first]) for phase in trajectory.phases)]
    for now, at in zip(held, begins, strict=True):
        for hold in [hold for hold in active_since if hold not in now]:
            spans.append((hold, active_since.pop(hold), at))
        active_since |= {
            hold: at for hold in now if hold not in active_since and not _is_push(scene, hold)
        }
    spans += [(hold, at, np.inf) for hold, at in active_since.items()]
    return sorted(spans, key=lambda span: (span[1], str(span[0])))


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
        schedule: Sequence[tuple[Hold, float, float]],
        pairs: Pairs,
        trajectory: Trajectory,
        physics: Physics,
        *,
        touching: Collection[Hold] = (),
    ) -> None:
        self.physical, self.pairs, self._touching = physical, pairs, touching
        self.holds, self.schedule = list(holds), list(schedule)
        self.trajectory, self.physics, self._engine = trajectory, physics, import_mujoco()
        self.grips: list[Grip] = []
        self._active: dict[Hold, tuple[int, float]] = {}  # index into grips, and end [s]
        self._forces: dict[Hold, deque[Floats]] = {}
        self._equality = int(self._engine.mjtConstraint.mjCNSTR_EQUALITY)
        self._window = max(1, round(_AVERAGING_TIME / physics.timestep))

    def follow(self, data: Any, clock: float) -> None:
        """Begin and end the holds that are due at a time [s] of the plan."""
        for hold in [hold for hold, (_, end) in self._active.items() if end <= clock]:
            self._release(data, hold)
        while self.schedule and self.schedule[0][1] <= clock:
            hold, begin, end = self.schedule.pop(0)
            self._engage(data, hold, clock)
            self._active[hold] = len(self.grips), end
            self._forces[hold] = deque(maxlen=self._window)
            first, last = self.trajectory.times[[0, -1]].tolist()
            self.grips.append(Grip(str(hold), max(begin, first), min(end, last)))

    def measure(self, data: Any, clock: float) -> None:
        """Record the load on the welds after a step, and release those that are overloaded."""
        if not self._active:
            return
        kinds, owners = np.asarray(data.efc_type), np.asarray(data.efc_id)
        for hold, (number, _) in list(self._active.items()):
            rows = np.flatnonzero((kinds == self._equality) & (owners == self.holds.index(hold)))
            forces = self._forces[hold]
            # Rotational rows act on half angles, as quaternions do.
            forces.append(np.asarray(data.efc_force)[rows] * [1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
            if len(forces) < self._window:
                continue
            mean = np.mean(forces, axis=0)
            force, torque = float(np.linalg.norm(mean[:3])), float(np.linalg.norm(mean[3:]))
            grip = self.grips[number]
            broken = (
                clock
                if force > self.physics.grasp_force or torque > self.physics.grasp_torque
                else None
            )
            # Before, the servos settle under the load that is in the hand at the start.
            if clock >= grip.begin or broken is not None:
                grip = replace(grip, force=max(force, grip.force), torque=max(torque, grip.torque))
            self.grips[number] = replace(grip, broken=broken)
            if broken is not None:
                self._release(data, hold)

    def _engage(self, data: Any, hold: Hold, clock: float) -> None:
        """Weld the holder to the link at their current relative placement."""
        model, number = self.physical.model, self.holds.index(hold)
        if hold in self.physical.carriers:
            data.qpos[self.physical.carriers[hold]] = self._planned_freedoms(hold, clock)
            self._engine.mj_kinematics(model, data)
        first, second = int(model.eq_obj1id[number]), int(model.eq_obj2id[number])
        tool = self._grasp_point(data, hold)
        one, other = (np.asarray(data.xmat[body]).reshape(3, 3) for body in (first, second))
        quaternion = np.zeros(4)
        self._engine.mju_mat2Quat(quaternion, (one.T @ other).ravel())
        model.eq_data[number, :3] = other.T @ (tool - data.xpos[second])
        model.eq_data[number, 3:6] = one.T @ (tool - data.xpos[first])
        model.eq_data[number, 6:10] = quaternion
        data.eq_active[number] = 1
        self._set_collision(hold, enabled=False)

    def _release(self, data: Any, hold: Hold) -> None:
        data.eq_active[self.holds.index(hold)] = 0
        del self._active[hold], self._forces[hold]
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
        types[own] = types[own] | bit if enabled else types[own] & ~bit

    def _planned_freedoms(self, hold: Hold, clock: float) -> Floats:
        """Return the planned values of a grasp's degrees of freedom."""
        names = (
            self.physical.world.scene.objects[hold.object]
            .object.attachment(hold.attachment)
            .coordinates
        )
        values = dict(zip(self.trajectory.names, self.trajectory.at(clock).tolist(), strict=True))
        start = dict(zip(names, hold.at, strict=False))
        return np.array(
            [values.get(f"{hold.object}.{name}", start.get(name, 0.0)) for name in names]
        )

    def _grasp_point(self, data: Any, hold: Hold) -> Floats:
        """Return the position of the holder's grasping frame in the world [m]."""
        tree = self.physical.world.model
        frame = tree.frames[
            tree.getFrameId(hold.frame or self.physical.world.scene.robot.tool_frame)
        ]
        body = self.physical.bodies[frame.parentJoint]
        return np.asarray(
            data.xpos[body]
            + np.asarray(data.xmat[body]).reshape(3, 3) @ frame.placement.translation
        )


def find_latches(scene: Scene) -> list[tuple[str, float, str, float]]:
    """Return joint, latched position, releasing joint and release threshold of each latch."""
    return [
        (f"{name}.{latch.joint}", latch.held_at, f"{name}.{latch.released_by}", latch.threshold)
        for name, placed in scene.objects.items()
        for latch in placed.object.latches
    ]


class Latches:
    """Latches that engage at their joint's latched position and are released by another joint."""

    def __init__(
        self,
        physical: PhysicalWorld,
        latches: Sequence[tuple[str, float, str, float]],
        first: int,
        physics: Physics,
    ) -> None:
        columns: Mapping[str, int] = dict(
            zip(physical.world.coordinates.names, physical.columns.tolist(), strict=True)
        )
        self._latches = [
            (columns[joint], at, columns[by], threshold - physics.latch_play)
            for joint, at, by, threshold in latches
        ]
        self._first = first

    def follow(self, data: Any) -> None:
        """Engage and release latches."""
        for number, (joint, at, by, threshold) in enumerate(self._latches, self._first):
            engaged = bool(data.eq_active[number]) or abs(data.qpos[joint] - at) <= _LATCH_TOLERANCE
            data.eq_active[number] = engaged and data.qpos[by] < threshold
