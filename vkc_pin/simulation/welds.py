"""What is held when: welds that begin and end with the holds of a plan, and break where they are pulled too hard; and latches."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from vkc_pin.simulation.contacts import Pairs
from vkc_pin.simulation.model import PhysicalWorld
from vkc_pin.simulation.physics import Physics, engine
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["Grip", "Grips", "Latches", "latched", "spans"]

_AVERAGED = 0.02  # [s] over which forces are averaged: rubber gives way, a weld does not
_SHUT = 2e-3  # [rad] or [m] from where a latch holds its joint at which it snaps in


@dataclass(frozen=True)
class Grip:
    """One hold of a plan, from its begin to its end.

    Attributes:
        what: What is held, e.g. "door.handle".
        begin, end: When, by the plan [s].
        force, torque: The largest, averaged over 20 ms [N], [N·m]; at where the hand takes hold.
        broken: When it was pulled off [s]; None: it was not.
        slip: How far what holds moved at most against what it holds, of holds by friction [m].
    """

    what: str
    begin: float
    end: float
    force: float = 0.0
    torque: float = 0.0
    broken: float | None = None
    slip: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return plain data of it."""
        return asdict(self)


def spans(scene: Scene, trajectory: Trajectory) -> list[tuple[Hold, float, float]]:
    """Return every hold of a motion that is no push, from when to when it lasts [s], in the order in which they begin."""
    found, since = list[tuple[Hold, float, float]](), dict[Hold, float]()
    times = trajectory.times
    held = [set(scene.holds), *(set(phase.holds) for phase in trajectory.phases)]
    begins = [-np.inf, *(float(times[phase.first]) for phase in trajectory.phases)]
    for now, at in zip(held, begins, strict=True):
        for hold in [hold for hold in since if hold not in now]:
            found.append((hold, since.pop(hold), at))
        since |= {hold: at for hold in now if hold not in since and not _pushes(scene, hold)}
    found += [(hold, at, np.inf) for hold, at in since.items()]
    return sorted(found, key=lambda span: (span[1], str(span[0])))


def _pushes(scene: Scene, hold: Hold) -> bool:
    return scene.objects[hold.object].object.attachment(hold.attachment).contact == "push"


class Grips:
    """Welds that follow a schedule.

    Args:
        physical: The model, whose first equalities are the welds of `holds`.
        holds: What they hold.
        schedule: See `spans`.
        pairs: What may touch what.
        trajectory: The plan, for where the freedoms of a grasp are when it begins.
        physics: How hard a hand holds.
        touching: Holds in which what holds and what it holds meet all the same.

    Attributes:
        grips: What has been held so far.
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
        self._touching = touching
        self.physical, self.holds, self.schedule, self.pairs = (
            physical,
            list(holds),
            list(schedule),
            pairs,
        )
        self.trajectory, self.physics, self._engine = trajectory, physics, engine()
        self.grips: list[Grip] = []
        self._active: dict[Hold, tuple[int, float]] = {}  # which of the grips, and when it ends
        self._forces: dict[Hold, deque[Floats]] = {}
        self._equality = int(self._engine.mjtConstraint.mjCNSTR_EQUALITY)
        self._length = max(1, round(_AVERAGED / physics.timestep))

    def follow(self, data: Any, clock: float) -> None:
        """Begin and end what begins and ends by a time [s] of the plan."""
        for hold in [hold for hold, (_, end) in self._active.items() if end <= clock]:
            self._let_go(data, hold)
        while self.schedule and self.schedule[0][1] <= clock:
            hold, begin, end = self.schedule.pop(0)
            self._take(data, hold, clock)
            self._active[hold], self._forces[hold] = (
                (len(self.grips), end),
                deque(maxlen=self._length),
            )
            times = self.trajectory.times
            self.grips.append(
                Grip(str(hold), max(begin, float(times[0])), min(end, float(times[-1])))
            )

    def holding(self, hold: Hold) -> bool:
        """Return whether something is held now."""
        return hold in self._active

    def measure(self, data: Any, clock: float) -> None:
        """Note how hard the welds are pulled after a step; let go of what is pulled too hard."""
        if not self._active:
            return
        kinds, owners = np.asarray(data.efc_type), np.asarray(data.efc_id)
        for hold, (number, _) in list(self._active.items()):
            rows = np.flatnonzero((kinds == self._equality) & (owners == self.holds.index(hold)))
            forces = self._forces[hold]
            forces.append(
                np.asarray(data.efc_force)[rows] * [1.0, 1.0, 1.0, 0.5, 0.5, 0.5]
            )  # of half angles, as quaternions are
            if len(forces) < self._length:
                continue
            mean = np.mean(forces, axis=0)
            force, torque = float(np.linalg.norm(mean[:3])), float(np.linalg.norm(mean[3:]))
            grip = self.grips[number]
            broken = (
                clock
                if force > self.physics.grasp_force or torque > self.physics.grasp_torque
                else None
            )
            if (
                clock >= grip.begin or broken is not None
            ):  # before, the servos take up what is in the hand at the start
                grip = replace(grip, force=max(force, grip.force), torque=max(torque, grip.torque))
            self.grips[number] = replace(grip, broken=broken)
            if broken is not None:
                self._let_go(data, hold)

    def _take(self, data: Any, hold: Hold, clock: float) -> None:
        """Weld what holds to what it holds, as they are now."""
        model, number = self.physical.model, self.holds.index(hold)
        if hold in self.physical.carriers:
            data.qpos[self.physical.carriers[hold]] = self._freedoms(hold, clock)
            self._engine.mj_kinematics(model, data)
        first, second = int(model.eq_obj1id[number]), int(model.eq_obj2id[number])
        tool = self._tool(data, hold)
        one, other = (np.asarray(data.xmat[body]).reshape(3, 3) for body in (first, second))
        quaternion = np.zeros(4)
        self._engine.mju_mat2Quat(quaternion, (one.T @ other).ravel())
        model.eq_data[number, :3] = other.T @ (tool - data.xpos[second])
        model.eq_data[number, 3:6] = one.T @ (tool - data.xpos[first])
        model.eq_data[number, 6:10] = quaternion
        data.eq_active[number] = 1
        self._meet(hold, meets=False)

    def _let_go(self, data: Any, hold: Hold) -> None:
        data.eq_active[self.holds.index(hold)] = 0
        del self._active[hold], self._forces[hold]
        self._meet(hold, meets=True)

    def _meet(self, hold: Hold, *, meets: bool) -> None:
        """Let what holds and the link that it holds meet, or not."""
        if hold in self._touching:
            return
        bit = self.pairs.bits[hold]
        if any(self.pairs.bits[other] == bit for other in self._active if other != hold):
            return
        own = self.physical.geoms[(self.pairs.types & bit) != 0]
        types = self.physical.model.geom_contype
        types[own] = types[own] | bit if meets else types[own] & ~bit

    def _freedoms(self, hold: Hold, clock: float) -> Floats:
        """Return where the plan has the freedoms of a grasp."""
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

    def _tool(self, data: Any, hold: Hold) -> Floats:
        """Return where what holds takes hold, in the world [m]."""
        tree = self.physical.world.model
        frame = tree.frames[
            tree.getFrameId(hold.frame or self.physical.world.scene.robot.tool_frame)
        ]
        body = self.physical.bodies[frame.parentJoint]
        return np.asarray(
            data.xpos[body]
            + np.asarray(data.xmat[body]).reshape(3, 3) @ frame.placement.translation
        )


def latched(scene: Scene) -> list[tuple[str, float, str, float]]:
    """Return all latches of a scene: coordinate, where it is held, and the coordinate that releases it from what value on."""
    return [
        (f"{name}.{latch.joint}", latch.held_at, f"{name}.{latch.released_by}", latch.threshold)
        for name, placed in scene.objects.items()
        for latch in placed.object.latches
    ]


class Latches:
    """Latches that snap in where they hold their joint, and are released by another one.

    Args:
        physical: The model.
        latches: See `latched`.
        first: Which equality is that of the first.
        physics: Their play.
    """

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
        """Engage and release."""
        for number, (joint, at, by, threshold) in enumerate(self._latches, self._first):
            shut = bool(data.eq_active[number]) or abs(data.qpos[joint] - at) <= _SHUT
            data.eq_active[number] = shut and data.qpos[by] < threshold
