"""Executes a trajectory in MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.simulation.contacts import Contact, Pairs, find_contact_pairs, find_unplanned_contacts
from vkc_pin.simulation.friction import (
    Span,
    Squeezes,
    find_fingers,
    find_grip_changes,
    insert_pauses,
    limit_finger_servos,
    split_spans,
)
from vkc_pin.simulation.goals import measure_goal_errors
from vkc_pin.simulation.model import Builder, PhysicalWorld
from vkc_pin.simulation.physics import Physics, complete_inertias, import_mujoco
from vkc_pin.simulation.result import SimulationResult, Tracking
from vkc_pin.simulation.servos import (
    Servo,
    compute_feedforward,
    make_servos,
    sample_fingers,
    sample_reference,
)
from vkc_pin.simulation.welds import Grips, Latches, find_hold_spans, find_latches
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.clearance_exemptions import CONTACT_DEPTH
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step, as_steps
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

GRASPS = ("weld", "friction")
"""Grasp models."""
_FRICTION_STEP = 5e-4  # [s] longest time step with friction grasps; see `Builder`
# [s] Longest time step with welds. MuJoCo computes a weld's force without the implicit damping of
# servos, which then is too large for light wrists: from 7 ms on, one with a load of 4 kg oscillates
# by 0.07 rad.
_WELD_STEP = 5e-3
# [s] between the closing of fingers on an object that is in the hand at the start, and the moment
# when they carry it
_CLOSED_TIME = 0.2
_FRAME_PERIOD = 0.02  # [s] between recorded states
_BALANCE_TIME = 0.5  # [s] in which servos settle under load: ten time constants of the slowest
_BALANCED = 1e-8  # [m] or [rad] by which servos at rest still give way
# After each round a hundredth of the deflection is left, of up to 0.05 rad; contacts may chatter.
_BALANCE_ROUNDS = 8
_CONTACT_PERIOD = 0.01  # [s] between two recordings of contacts
_MAX_STEPS = 2_000_000  # time steps, of which each keeps a row: 1.1 h at 2 ms


def simulate(
    scene: Scene,
    steps: Sequence[Step],
    trajectory: Trajectory,
    *,
    actual: Scene | None = None,
    grasp: str = "weld",
    physics: Physics | None = None,
) -> SimulationResult:
    """Execute a trajectory in MuJoCo.

    Args:
        scene: Scene of the plan.
        steps: Steps that the trajectory is to complete.
        trajectory: The trajectory.
        actual: Scene of the execution, if it differs: objects are displaced or heavier, for
            example.
        grasp: "weld": grasped objects are welded to the hand while the plan holds them, unless the
            load exceeds the hand's strength. "friction": fingers close and hold objects by friction
            alone; the robot waits while they close and open.
        physics: Physical settings; defaults to `Physics()`.

    Returns:
        The executed motion with its errors, grips and contacts.

    Raises:
        InputError: MuJoCo is not installed, `actual` has another robot or lacks objects, or an
            argument is invalid.
    """
    mujoco = import_mujoco()
    physics = Physics() if physics is None else check_instance(physics, Physics, "physics")
    if grasp not in GRASPS:
        raise InputError(
            "unknown grasp model", field="grasp", expected=", ".join(GRASPS), got=grasp
        )
    steps = as_steps(steps)
    executed_scene = scene if actual is None else check_instance(actual, Scene, "actual")
    for name, placed in scene.objects.items():
        if (
            name not in executed_scene.objects
            or executed_scene.objects[name].object.coordinates.names
            != placed.object.coordinates.names
        ):
            raise InputError(
                f"`actual` lacks the object '{name}' of the plan's scene",
                field="actual",
                expected=name,
                got=", ".join(executed_scene.objects),
            )
    if executed_scene.robot.coordinates.names != scene.robot.coordinates.names:
        raise InputError(
            "`actual` has another robot",
            field="actual",
            expected=scene.robot.name,
            got=executed_scene.robot.name,
        )
    run = _Run(executed_scene, trajectory, physics, friction=grasp == "friction")
    # By default MuJoCo logs warnings to a file in the working directory; see `diverged`.
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        run.execute()
    finally:
        mujoco.set_mju_user_warning(None)
    return run.make_result(scene, steps)


@dataclass(eq=False)
class _Run:
    """One execution of a trajectory.

    Attributes:
        scene: Scene of the execution.
        trajectory: Reference that the robot tracks.
        physics: Physical settings.
        friction: Whether the robot's hand grasps by friction.
    """

    scene: Scene
    trajectory: Trajectory
    physics: Physics
    friction: bool = False

    def __post_init__(self) -> None:
        schedule, friction_spans = find_hold_spans(self.scene, self.trajectory), list[Span]()
        longest = _FRICTION_STEP if self.friction else _WELD_STEP if schedule else np.inf
        if self.physics.timestep > longest:
            self.physics = replace(self.physics, timestep=longest)
        physics = self.physics
        self.mj, self.tree = import_mujoco(), World(self.scene)
        self.notes = complete_inertias(self.tree, physics)
        holds: list[Hold] = list(dict.fromkeys(hold for hold, _, _ in schedule))
        if self.friction:
            _, friction_spans = split_spans(schedule, float(self.trajectory.times[0]))
            waits = find_grip_changes(self.trajectory, friction_spans)
            self.trajectory = insert_pauses(self.trajectory, waits, physics.grip_time)
            schedule, friction_spans = split_spans(
                find_hold_spans(self.scene, self.trajectory), float(self.trajectory.times[0])
            )
        trajectory, welded = self.trajectory, list(dict.fromkeys(hold for hold, _, _ in schedule))
        self.planned = self.tree.compute_positions(trajectory)
        self.servos: tuple[Servo, ...] = make_servos(self.tree, self.planned, physics)
        self.fingers = find_fingers(self.tree, physics) if friction_spans else None
        if self.fingers is not None:
            self.servos = limit_finger_servos(self.servos, self.fingers, self.tree, physics)
        friction_holds = [hold for hold, _, _ in friction_spans]
        self.pairs: Pairs = find_contact_pairs(
            self.tree, [hold for hold in holds if hold not in friction_holds]
        )
        latches = find_latches(self.scene)
        latch_equalities = [(joint, at) for joint, at, _, _ in latches]
        builder = Builder(self.tree, physics, has_friction_grasps=bool(friction_spans))
        callbacks = (
            {}
            if self.fingers is None
            else {"add_bodies": self.fingers.add_bodies, "add_extras": self.fingers.add_drives}
        )
        self.physical: PhysicalWorld = builder.build(
            self.pairs, self.servos, welded, latch_equalities, **callbacks
        )
        self.grips = Grips(
            self.physical,
            welded,
            schedule,
            self.pairs,
            trajectory,
            physics,
            touching=friction_holds,
        )
        self.latches = Latches(self.physical, latches, len(welded), physics)
        self.squeezes: Squeezes | None = None
        if self.fingers is not None:
            self.squeezes = Squeezes(
                self.physical, self.fingers, friction_spans, trajectory, physics, _CONTACT_PERIOD
            )
        settle = physics.settle
        if self.scene.holds and friction_spans:
            settle = max(settle, physics.grip_time + _CLOSED_TIME)
        start = float(trajectory.times[0]) - settle
        end = float(trajectory.times[-1]) + physics.settle
        count = (end - start) / physics.timestep
        if count > _MAX_STEPS:
            raise InputError(
                "the motion takes too many time steps",
                field="trajectory",
                expected=f"at most {_MAX_STEPS * physics.timestep:g} s, with those of `settle`",
                got=f"{end - start:.6g} s",
            )
        steps = np.arange(int(np.ceil(count - 1e-9)) + 1)
        self.times: Floats = np.asarray(start + physics.timestep * steps, float)
        self.diverged: float | None = None
        self.contact_samples: dict[tuple[str, str], list[tuple[float, float]]] = {}

    def execute(self) -> None:
        """Run the simulation."""
        mj, model, physics = self.mj, self.physical.model, self.physics
        data = mj.MjData(model)
        data.qpos[:] = self.physical.to_qpos(self.tree.start)
        mj.mj_forward(model, data)
        targets, commands = self._sample_commands()
        if self.squeezes is not None and self.fingers is not None:
            finger_columns, finger_motors = self.fingers.find_addresses(self.physical)
            open_fingers = (
                targets[:, self.trajectory.robot_size :]
                if self.fingers.sides is None
                else np.zeros((len(self.times), len(finger_columns)))
            )
            squeeze = self.squeezes.compute_commands(self.times, open_fingers)
        driven, dofs = (
            where[: len(self.servos)] for where in (self.physical.columns, self.physical.dofs)
        )
        self.grips.follow(data, float(self.times[0]))
        self.latches.follow(data)
        data.ctrl[: len(self.servos)] = commands[0]
        if self.squeezes is not None:
            data.ctrl[finger_motors] = squeeze[0]
        commands += self._balance_load(data)
        labels = np.zeros(model.ngeom, int)
        labels[self.physical.geoms] = np.arange(len(self.physical.geoms))
        contact_steps, frame_steps = (
            max(1, round(span / physics.timestep)) for span in (_CONTACT_PERIOD, _FRAME_PERIOD)
        )
        self.errors, self.efforts = np.zeros((2, len(self.times), len(self.servos)))
        recorded = [
            k for k in range(len(self.times)) if k % frame_steps == 0 or k == len(self.times) - 1
        ]
        self.clocks, records = self.times[recorded], list[Floats]()
        for k, clock in enumerate(self.times.tolist()):
            self.grips.follow(data, clock)
            self.latches.follow(data)
            if k == recorded[len(records)]:
                records.append(np.array(data.qpos))
            self.errors[k] = targets[k] - data.qpos[driven]
            data.ctrl[: len(self.servos)] = commands[k]
            if self.squeezes is not None:
                data.ctrl[finger_motors] = squeeze[k]
            mj.mj_step(model, data)
            self.efforts[k] = data.qfrc_actuator[dofs]
            # MuJoCo resets a state that diverged; it has no welds then.
            if self._has_diverged(data):
                self.diverged, end = clock, k + 1
                self.times, self.errors = self.times[:end], self.errors[:end]
                self.efforts = self.efforts[:end]
                break
            self.grips.measure(data, clock)
            if k % contact_steps == 0 and data.ncon:
                self._record_contacts(data, labels, clock)
            if k % contact_steps == 0 and self.squeezes is not None:
                self.squeezes.measure(data, clock)
        # After a divergence the last state is repeated.
        records += [records[-1]] * (len(recorded) - len(records))
        self.states: Floats = np.array(records)

    def _sample_commands(self) -> tuple[Floats, Floats]:
        """Return planned positions and commands of all servos, shape (steps, servos) each."""
        motion = sample_reference(self.trajectory, self.times)
        fingers = sample_fingers(self.tree, self.planned, self.trajectory.times, self.times)
        targets = np.column_stack([motion[0], fingers])
        feedforward = compute_feedforward(self.tree, self.servos, targets, motion)
        count = motion[1].shape[1]
        feedforward[:, :count] += motion[1] * [servo.damping for servo in self.servos[:count]]
        return targets, targets + feedforward / [servo.stiffness for servo in self.servos]

    def _has_diverged(self, data: Any) -> bool:
        """Return whether the integration has diverged."""
        warnings = self.mj.mjtWarning
        kinds = (warnings.mjWARN_BADQPOS, warnings.mjWARN_BADQVEL, warnings.mjWARN_BADQACC)
        is_reset = any(data.warning[kind].number for kind in kinds)
        return is_reset or not np.isfinite(data.qpos).all()

    def _balance_load(self, data: Any) -> Floats:
        """Make the robot carry from the beginning what it holds at the start.

        Servos and welds give way under load, and the plan begins where they have done so. They
        would give way once more at every continuation of an execution. A motor at rest carries its
        load where it is: each servo's command is displaced by the deflection under the load, as
        integral action would, and so is each weld. Since the load depends on the configuration,
        this is repeated.

        Args:
            data: State at the start, with its welds and commands.

        Returns:
            Displacement of each servo's command, shape (servos,), [m] and [rad]: at most that of
            full effort, and 0 for fingers.
        """
        displacement = np.zeros(len(self.servos))
        if not self.grips.has_active:
            return displacement
        mj, model, count = self.mj, self.physical.model, len(self.servos)
        driven = self.physical.columns[:count]
        largest = np.array([servo.limit / servo.stiffness for servo in self.servos])
        largest[self.trajectory.robot_size :] = 0.0
        start, commands = data.qpos[driven].copy(), data.ctrl[:count].copy()
        for _ in range(_BALANCE_ROUNDS):
            settled = mj.MjData(model)
            mj.mj_copyData(settled, model, data)
            settled.ctrl[:count] = commands + displacement
            mj.mj_step(model, settled, nstep=round(_BALANCE_TIME / self.physics.timestep))
            if self._has_diverged(settled):
                return displacement  # the execution diverges as well, and says so
            mj.mj_kinematics(model, settled)
            self.grips.preload(data, settled)
            deflection = start - settled.qpos[driven]
            displacement = np.clip(displacement + deflection, -largest, largest)
            if np.abs(deflection).max() < _BALANCED:
                break
        return displacement

    def _record_contacts(self, data: Any, labels: Any, clock: float) -> None:
        """Record the deepest penetration of each pair of links that touch."""
        names, contacts = self.tree.collision_labels, data.contact
        depths = -np.asarray(contacts.dist)
        allowed = set() if self.squeezes is None else self.squeezes.allowed_contacts(clock)
        deepest: dict[tuple[str, str], float] = {}
        for i in np.flatnonzero(depths > CONTACT_DEPTH).tolist():
            one, other = (names[labels[geom]] for geom in np.asarray(contacts.geom)[i])
            pair = (min(one, other), max(one, other))
            if pair in allowed:
                continue
            deepest[pair] = max(deepest.get(pair, 0.0), float(depths[i]))
        for pair, depth in deepest.items():
            self.contact_samples.setdefault(pair, []).append((clock, depth))

    def make_result(self, scene: Scene, steps: Sequence[Step]) -> SimulationResult:
        """Return the result of the execution."""
        rows = self.physical.from_qpos(self.states)
        contacts: tuple[Contact, ...] = find_unplanned_contacts(
            scene, self.trajectory, self.contact_samples, _CONTACT_PERIOD
        )
        notes = list(self.notes)
        if self.pairs.overlapping:
            names = "; ".join(" – ".join(pair) for pair in self.pairs.overlapping)
            notes.append(f"overlap at the start, and therefore do not collide: {names}")
        if self.fingers is not None and self.fingers.sides is not None:
            reason = "the hand is described without finger joints"
            notes.append(f"{reason}: its two sides slide towards each other")
        grips = [
            grip for grip in self.grips.grips if grip.end > grip.begin or grip.broken is not None
        ]
        grips += [] if self.squeezes is None else self.squeezes.grips
        executed = self._make_trajectory(rows)
        misses = measure_goal_errors(scene, steps, self.trajectory, self.tree, executed.times, rows)
        return SimulationResult(
            scene=self.scene,
            steps=tuple(steps),
            planned=self.trajectory,
            trajectory=executed,
            rows=rows,
            misses=misses,
            tracking=Tracking.from_samples(
                self.times, self.errors, self.efforts, self.servos, self.trajectory.robot_size
            ),
            grips=tuple(grips),
            contacts=contacts,
            physics=self.physics,
            notes=tuple(notes),
            diverged=self.diverged,
        )

    def _make_trajectory(self, rows: Floats) -> Trajectory:
        """Return the executed motion in the plan's coordinates."""
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
