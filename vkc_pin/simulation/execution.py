"""Executes a motion in physics: servos follow it, hands hold what it holds, and everything else goes as it goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.simulation.contacts import Contact, Pairs, touching_pairs, unwanted
from vkc_pin.simulation.friction.fingers import fingers_of, limited
from vkc_pin.simulation.friction.friction_grasps import Span, Squeezes, grip_changes, split
from vkc_pin.simulation.friction.pauses import paused
from vkc_pin.simulation.goals import missed
from vkc_pin.simulation.model import Builder, PhysicalWorld
from vkc_pin.simulation.physics import Physics, engine, weigh
from vkc_pin.simulation.result import SimulationResult, Tracking
from vkc_pin.simulation.servos import Servo, efforts_for, finger_rows, reference, servos
from vkc_pin.simulation.welds import Grips, Latches, latched, spans
from vkc_pin.utils.arguments import instance
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.contact_rules import CONTACT
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step, as_list
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

__all__ = ["GRASPS", "simulate"]

GRASPS = ("weld", "friction")
"""How a hand can hold on."""
_FINE = 5e-4  # [s] the longest step with which fingers hold by friction; see `Builder`
# [s] for which fingers have closed on what is in the hand at the start, before they carry it
_CLOSED = 0.2
_FRAME, _LOOK = 0.02, 0.01  # [s] between recorded states, and between two looks at the contacts


def simulate(
    scene: Scene,
    steps: Sequence[Step],
    trajectory: Trajectory,
    *,
    actual: Scene | None = None,
    grasp: str = "weld",
    physics: Physics | None = None,
) -> SimulationResult:
    """Execute a motion in MuJoCo.

    Args:
        scene: The scene that it was planned in.
        steps: What it was to bring about.
        trajectory: The motion.
        actual: The scene that it happens in, if that is another: something stands elsewhere, or is
            heavier.
        grasp: "weld": what is held is welded to the hand as long as the motion says, unless it is
            pulled too hard. "friction": fingers close on it, and nothing but their friction holds
            it; the robot waits while they close and open.
        physics: What to assume; `Physics()` if left out.

    Returns:
        What came of it.

    Raises:
        InputError: MuJoCo is not installed, `actual` has another robot or lacks objects, or an
            argument is none of its kind.
    """
    mujoco = engine()
    physics = Physics() if physics is None else instance(physics, Physics, "physics")
    if grasp not in GRASPS:
        raise InputError("unknown", field="grasp", expected=", ".join(GRASPS), got=grasp)
    steps, here = as_list(steps), scene if actual is None else instance(actual, Scene, "actual")
    for name, placed in scene.objects.items():
        if (
            name not in here.objects
            or here.objects[name].object.coordinates.names != placed.object.coordinates.names
        ):
            raise InputError(
                "an object of the plan's scene is not there",
                field="actual",
                expected=name,
                got=", ".join(here.objects),
            )
    if here.robot.coordinates.names != scene.robot.coordinates.names:
        raise InputError(
            "another robot", field="actual", expected=scene.robot.name, got=here.robot.name
        )
    run = _Run(here, trajectory, physics, friction=grasp == "friction")
    mujoco.set_mju_user_warning(
        lambda text: None
    )  # it would write a file into the working directory; see `diverged`
    try:
        run.go()
    finally:
        mujoco.set_mju_user_warning(None)
    return run.result(scene, steps)


@dataclass(eq=False)
class _Run:
    """One execution.

    Attributes:
        scene: Where it happens.
        trajectory: What the robot follows.
        physics: What is assumed.
        friction: Whether the hand holds by the friction of its fingers.
    """

    scene: Scene
    trajectory: Trajectory
    physics: Physics
    friction: bool = False

    def __post_init__(self) -> None:
        if self.friction and self.physics.timestep > _FINE:
            self.physics = replace(self.physics, timestep=_FINE)
        physics = self.physics
        self.mj, self.tree = engine(), World(self.scene)
        self.notes = weigh(self.tree, physics)
        schedule, squeezed = spans(self.scene, self.trajectory), list[Span]()
        holds: list[Hold] = list(dict.fromkeys(hold for hold, _, _ in schedule))
        if self.friction:
            _, squeezed = split(schedule, float(self.trajectory.times[0]))
            waits = grip_changes(self.trajectory, squeezed)
            self.trajectory = paused(self.trajectory, waits, physics.grip_time)
            schedule, squeezed = split(
                spans(self.scene, self.trajectory), float(self.trajectory.times[0])
            )
        trajectory, welded = self.trajectory, list(dict.fromkeys(hold for hold, _, _ in schedule))
        self.planned = self.tree.positions(trajectory)
        self.servos: tuple[Servo, ...] = servos(self.tree, self.planned, physics)
        self.fingers = fingers_of(self.tree, physics) if squeezed else None
        if self.fingers is not None:
            self.servos = limited(self.servos, self.fingers, self.tree, physics)
        squeezing = [hold for hold, _, _ in squeezed]
        self.pairs: Pairs = touching_pairs(
            self.tree, [hold for hold in holds if hold not in squeezing]
        )
        latches = latched(self.scene)
        shut = [(joint, at) for joint, at, _, _ in latches]
        builder = Builder(self.tree, physics, gripping=bool(squeezed))
        more = (
            {}
            if self.fingers is None
            else {"before": self.fingers.add_bodies, "more": self.fingers.add_drives}
        )
        self.physical: PhysicalWorld = builder.built(self.pairs, self.servos, welded, shut, **more)
        self.grips = Grips(
            self.physical, welded, schedule, self.pairs, trajectory, physics, touching=squeezing
        )
        self.latches = Latches(self.physical, latches, len(welded), physics)
        self.squeezes: Squeezes | None = None
        if self.fingers is not None:
            self.squeezes = Squeezes(
                self.physical, self.fingers, squeezed, trajectory, physics, _LOOK
            )
        settle = max(
            physics.settle, physics.grip_time + _CLOSED if self.scene.holds and squeezed else 0.0
        )
        start, end = (
            float(trajectory.times[0]) - settle,
            float(trajectory.times[-1]) + physics.settle,
        )
        steps = np.arange(int(np.ceil((end - start) / physics.timestep - 1e-9)) + 1)
        self.times: Floats = np.asarray(start + physics.timestep * steps, float)
        self.diverged: float | None = None
        self.seen: dict[tuple[str, str], list[tuple[float, float]]] = {}

    def go(self) -> None:
        """Execute."""
        mj, model, physics = self.mj, self.physical.model, self.physics
        data = mj.MjData(model)
        data.qpos[:] = self.physical.qpos(self.tree.start)
        mj.mj_forward(model, data)
        motion = reference(self.trajectory, self.times)
        fingers = finger_rows(self.tree, self.planned, self.trajectory.times, self.times)
        wanted = np.column_stack([motion[0], fingers])
        ahead = efforts_for(self.tree, self.servos, wanted, motion)
        ahead[:, : motion[1].shape[1]] += motion[1] * [
            servo.damping for servo in self.servos[: motion[1].shape[1]]
        ]
        commands = wanted + ahead / [servo.stiffness for servo in self.servos]
        if self.squeezes is not None and self.fingers is not None:
            closing, commanded = self.fingers.addresses(self.physical)
            rest = (
                fingers if self.fingers.sides is None else np.zeros((len(self.times), len(closing)))
            )
            squeeze = self.squeezes.commands(self.times, rest)
        driven, dofs = (
            where[: len(self.servos)] for where in (self.physical.columns, self.physical.dofs)
        )
        labels = np.zeros(model.ngeom, int)
        labels[self.physical.geoms] = np.arange(len(self.physical.geoms))
        look, frame = (max(1, round(span / physics.timestep)) for span in (_LOOK, _FRAME))
        self.errors, self.efforts = np.zeros((2, len(self.times), len(self.servos)))
        kept = [k for k in range(len(self.times)) if k % frame == 0 or k == len(self.times) - 1]
        self.clocks, records = self.times[kept], list[Floats]()
        for k, clock in enumerate(self.times.tolist()):
            self.grips.follow(data, clock)
            self.latches.follow(data)
            if k == kept[len(records)]:
                records.append(np.array(data.qpos))
            self.errors[k] = wanted[k] - data.qpos[driven]
            data.ctrl[: len(self.servos)] = commands[k]
            if self.squeezes is not None:
                data.ctrl[commanded] = squeeze[k]
            mj.mj_step(model, data)
            self.efforts[k] = data.qfrc_actuator[dofs]
            self.grips.measure(data, clock)
            if k % look == 0 and data.ncon:
                self._look(data, labels, clock)
            if k % look == 0 and self.squeezes is not None:
                self.squeezes.measure(data, clock)
            if (
                not np.isfinite(data.qpos).all()
                or data.warning[mj.mjtWarning.mjWARN_BADQACC].number
            ):
                self.times, self.errors, self.efforts = (
                    self.times[: k + 1],
                    self.errors[: k + 1],
                    self.efforts[: k + 1],
                )
                self.diverged = clock
                break
        records += [records[-1]] * (
            len(kept) - len(records)
        )  # where it broke down, all stays as it was last
        self.states: Floats = np.array(records)

    def _look(self, data: Any, labels: Any, clock: float) -> None:
        """Note what touches."""
        names, contacts = self.tree.collision_labels, data.contact
        depths = -np.asarray(contacts.dist)
        held = set() if self.squeezes is None else self.squeezes.may_touch(clock)
        deepest: dict[tuple[str, str], float] = {}
        for i in np.flatnonzero(depths > CONTACT).tolist():
            one, other = (names[labels[geom]] for geom in np.asarray(contacts.geom)[i])
            pair = (min(one, other), max(one, other))
            if pair in held:
                continue
            deepest[pair] = max(deepest.get(pair, 0.0), float(depths[i]))
        for pair, depth in deepest.items():
            self.seen.setdefault(pair, []).append((clock, depth))

    def result(self, scene: Scene, steps: Sequence[Step]) -> SimulationResult:
        """Return what came of it.

        Args:
            scene: What was planned in.
            steps: What was asked for.
        """
        rows = self.physical.row(self.states)
        contacts: tuple[Contact, ...] = unwanted(scene, self.trajectory, self.seen, _LOOK)
        notes = list(self.notes)
        if self.pairs.overlapping:
            told = "; ".join(" – ".join(pair) for pair in self.pairs.overlapping)
            notes.append(f"overlap at the start, and go through each other: {told}")
        if self.fingers is not None and self.fingers.sides is not None:
            notes.append(
                "the hand's fingers do not move in its description: its two sides slide towards each other"
            )
        grips = [
            grip for grip in self.grips.grips if grip.end > grip.begin or grip.broken is not None
        ]
        grips += [] if self.squeezes is None else self.squeezes.grips
        executed = self._executed(rows)
        misses = missed(scene, steps, self.trajectory, self.tree, executed.times, rows)
        return SimulationResult(
            scene=self.scene,
            steps=tuple(steps),
            planned=self.trajectory,
            trajectory=executed,
            rows=rows,
            misses=misses,
            tracking=Tracking.of(
                self.times, self.errors, self.efforts, self.servos, self.trajectory.robot_size
            ),
            grips=tuple(grips),
            contacts=contacts,
            physics=self.physics,
            notes=tuple(notes),
            diverged=self.diverged,
        )

    def _executed(self, rows: Floats) -> Trajectory:
        """Return what happened as a trajectory of the plan's coordinates; freedoms of grasps are as planned."""
        names, own = self.trajectory.names, self.tree.coordinates.names
        positions = self.trajectory.at(self.clocks)
        for column, name in enumerate(names):
            if name in own:
                positions[:, column] = rows[:, own.index(name)]
        ends = np.searchsorted(
            self.clocks, [self.trajectory.times[phase.last] for phase in self.trajectory.phases]
        )
        last, before, phases = len(self.clocks) - 1, 0, []
        for number, (phase, end) in enumerate(
            zip(self.trajectory.phases, ends.tolist(), strict=True)
        ):
            left = len(self.trajectory.phases) - 1 - number
            end = last if left == 0 else min(max(end, before + 1), last - left)
            phases.append(replace(phase, first=before, last=end))
            before = end
        return Trajectory(names, self.clocks, positions, tuple(phases), self.trajectory.robot_size)
