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
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.scene.clearance_exemptions import CONTACT_DEPTH
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step, as_steps
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

GRASPS = ("weld", "friction")
"""Grasp models."""
# [s] longest time step with friction grasps; see `Builder`
_FRICTION_STEP = 5e-4
# [s] Longest time step with welds. MuJoCo computes a weld's force without the implicit damping of
# servos, which then is too large for light wrists: from 7 ms on, one with a load of 4 kg oscillates
# by 0.07 rad.
_WELD_STEP = 5e-3
# [s] between the closing of fingers on an object that is in the hand at the start, and the moment
# when they carry it
_CLOSED_TIME = 0.2
# [s] between recorded states
_FRAME_PERIOD = 0.02
# [s] in which servos settle under load: ten time constants of the slowest
_BALANCE_TIME = 0.5
# [m] or [rad] by which servos at rest still give way
_BALANCED = 1e-8
# After each round a hundredth of the deflection is left, of up to 0.05 rad; contacts may chatter.
_BALANCE_ROUNDS = 8
# [s] between two recordings of contacts
_CONTACT_PERIOD = 0.01
# time steps, of which each keeps a row: 1.1 h at 2 ms
_MAX_STEPS = 2_000_000


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
    _check_actual(scene, executed_scene)
    run = _Run(executed_scene, trajectory, physics, friction=grasp == "friction")
    # By default MuJoCo logs warnings to a file in the working directory; see `diverged`.
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        run.execute()
    finally:
        mujoco.set_mju_user_warning(None)
    return run.make_result(scene, steps)


def _check_actual(scene: Scene, actual: Scene) -> None:
    """Check that the scene of the execution has the robot and objects of the plan's scene."""
    for name, placed in scene.objects.items():
        joints = placed.object.coordinates.names
        other = actual.objects.get(name)
        if other is None or other.object.coordinates.names != joints:
            raise InputError(
                f"`actual` lacks the object '{name}' of the plan's scene",
                field="actual",
                expected=name,
                got=", ".join(actual.objects),
            )
    if actual.robot.coordinates.names != scene.robot.coordinates.names:
        raise InputError(
            "`actual` has another robot",
            field="actual",
            expected=scene.robot.name,
            got=actual.robot.name,
        )


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
        schedule = find_hold_spans(self.scene, self.trajectory)
        all_holds = _list_holds(schedule)
        self._limit_timestep(has_holds=bool(schedule))
        physics = self.physics
        self.mj = import_mujoco()
        self.tree = World(self.scene)
        self.notes = complete_inertias(self.tree, physics)
        friction_spans: list[Span] = []
        if self.friction:
            self._insert_grip_pauses(schedule)
            schedule, friction_spans = split_spans(
                find_hold_spans(self.scene, self.trajectory), float(self.trajectory.times[0])
            )
        trajectory = self.trajectory
        welded = _list_holds(schedule)
        friction_holds = [hold for hold, _, _ in friction_spans]
        self.planned = self.tree.compute_positions(trajectory)
        self.servos: tuple[Servo, ...] = make_servos(self.tree, self.planned, physics)
        self.fingers = find_fingers(self.tree, physics) if friction_spans else None
        if self.fingers is not None:
            self.servos = limit_finger_servos(self.servos, self.fingers, self.tree, physics)
        self.pairs: Pairs = find_contact_pairs(
            self.tree, [hold for hold in all_holds if hold not in friction_holds]
        )
        latches = find_latches(self.scene)
        builder = Builder(self.tree, physics, has_friction_grasps=bool(friction_spans))
        self.physical: PhysicalWorld = builder.build(
            self.pairs,
            self.servos,
            welded,
            [(joint, at) for joint, at, _, _ in latches],
            add_bodies=None if self.fingers is None else self.fingers.add_bodies,
            add_extras=None if self.fingers is None else self.fingers.add_drives,
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
        self.times: Floats = self._choose_times(has_friction_grasps=bool(friction_spans))
        self.diverged: float | None = None
        self.contact_samples: dict[tuple[str, str], list[tuple[float, float]]] = {}

    def _limit_timestep(self, *, has_holds: bool) -> None:
        """Shorten the time step if grasps require it."""
        if self.friction:
            longest = _FRICTION_STEP
        elif has_holds:
            longest = _WELD_STEP
        else:
            longest = np.inf
        if self.physics.timestep > longest:
            self.physics = replace(self.physics, timestep=longest)

    def _insert_grip_pauses(self, schedule: Sequence[Span]) -> None:
        """Let the robot wait where the hand closes or opens in grasps by friction."""
        _, friction_spans = split_spans(schedule, float(self.trajectory.times[0]))
        waypoints = find_grip_changes(self.trajectory, friction_spans)
        self.trajectory = insert_pauses(self.trajectory, waypoints, self.physics.grip_time)

    def _choose_times(self, *, has_friction_grasps: bool) -> Floats:
        """Return the times of all steps, on the plan's clock, shape (steps,) [s]."""
        timestep = self.physics.timestep
        settle = self.physics.settle
        if self.scene.holds and has_friction_grasps:
            settle = max(settle, self.physics.grip_time + _CLOSED_TIME)
        start = float(self.trajectory.times[0]) - settle
        end = float(self.trajectory.times[-1]) + self.physics.settle
        count = (end - start) / timestep
        if count > _MAX_STEPS:
            raise InputError(
                "the motion takes too many time steps",
                field="trajectory",
                expected=f"at most {_MAX_STEPS * timestep:g} s, with those of `settle`",
                got=f"{end - start:.6g} s",
            )
        steps = np.arange(int(np.ceil(count - 1e-9)) + 1)
        return np.asarray(start + timestep * steps, float)

    def execute(self) -> None:
        """Run the simulation."""
        mj = self.mj
        model = self.physical.model
        servo_count = len(self.servos)
        driven = self.physical.columns[:servo_count]
        dofs = self.physical.dofs[:servo_count]
        data = mj.MjData(model)
        data.qpos[:] = self.physical.to_qpos(self.tree.start)
        mj.mj_forward(model, data)
        targets, commands = self._sample_commands()
        finger_motors, finger_commands = self._compute_finger_commands(targets)
        self.grips.follow(data, float(self.times[0]))
        self.latches.follow(data)
        data.ctrl[:servo_count] = commands[0]
        data.ctrl[finger_motors] = finger_commands[0]
        commands += self._balance_load(data)
        labels = np.zeros(model.ngeom, int)
        labels[self.physical.geoms] = np.arange(len(self.physical.geoms))
        contact_steps = max(1, round(_CONTACT_PERIOD / self.physics.timestep))
        recorded = self._choose_recorded_steps()
        records: list[Floats] = []
        self.clocks = self.times[recorded]
        self.errors = np.zeros((len(self.times), servo_count))
        self.efforts = np.zeros((len(self.times), servo_count))
        for k, clock in enumerate(self.times.tolist()):
            self.grips.follow(data, clock)
            self.latches.follow(data)
            if k == recorded[len(records)]:
                records.append(np.array(data.qpos))
            self.errors[k] = targets[k] - data.qpos[driven]
            data.ctrl[:servo_count] = commands[k]
            data.ctrl[finger_motors] = finger_commands[k]
            mj.mj_step(model, data)
            self.efforts[k] = data.qfrc_actuator[dofs]
            # MuJoCo resets a state that diverged; it has no welds then.
            if self._has_diverged(data):
                self.diverged = clock
                self._truncate(k + 1)
                break
            self.grips.measure(data, clock)
            if k % contact_steps == 0:
                if data.ncon:
                    self._record_contacts(data, labels, clock)
                if self.squeezes is not None:
                    self.squeezes.measure(data, clock)
        # After a divergence the last state is repeated.
        missing = len(recorded) - len(records)
        records += [records[-1]] * missing
        self.states: Floats = np.array(records)

    def _choose_recorded_steps(self) -> list[int]:
        """Return the steps whose states are recorded: one in each period, and the last one."""
        frame_steps = max(1, round(_FRAME_PERIOD / self.physics.timestep))
        last = len(self.times) - 1
        recorded = list(range(0, len(self.times), frame_steps))
        if recorded[-1] != last:
            recorded.append(last)
        return recorded

    def _truncate(self, count: int) -> None:
        """Forget all steps after the first `count`."""
        self.times = self.times[:count]
        self.errors = self.errors[:count]
        self.efforts = self.efforts[:count]

    def _compute_finger_commands(self, targets: Floats) -> tuple[Ints, Floats]:
        """Return the motors of fingers that grasp by friction, (k,), and commands, (steps, k)."""
        if self.squeezes is None or self.fingers is None:
            return np.zeros(0, int), np.zeros((len(self.times), 0))
        columns, motors = self.fingers.find_addresses(self.physical)
        if self.fingers.sides is None:
            planned = targets[:, self.trajectory.robot_size :]
        else:
            planned = np.zeros((len(self.times), len(columns)))
        return motors, self.squeezes.compute_commands(self.times, planned)

    def _sample_commands(self) -> tuple[Floats, Floats]:
        """Return planned positions and commands of all servos, shape (steps, servos) each."""
        motion = sample_reference(self.trajectory, self.times)
        positions, velocities, _ = motion
        fingers = sample_fingers(self.tree, self.planned, self.trajectory.times, self.times)
        targets = np.column_stack([positions, fingers])
        # The servo subtracts damping · (actual velocity), so that the command adds the planned one.
        feedforward = compute_feedforward(self.tree, self.servos, targets, motion)
        count = velocities.shape[1]
        damping = [servo.damping for servo in self.servos[:count]]
        feedforward[:, :count] += velocities * damping
        stiffness = [servo.stiffness for servo in self.servos]
        return targets, targets + feedforward / stiffness

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
        mj = self.mj
        model = self.physical.model
        count = len(self.servos)
        driven = self.physical.columns[:count]
        largest = np.array([servo.limit / servo.stiffness for servo in self.servos])
        largest[self.trajectory.robot_size :] = 0.0
        start = data.qpos[driven].copy()
        commands = data.ctrl[:count].copy()
        step_count = round(_BALANCE_TIME / self.physics.timestep)
        for _ in range(_BALANCE_ROUNDS):
            settled = mj.MjData(model)
            mj.mj_copyData(settled, model, data)
            settled.ctrl[:count] = commands + displacement
            mj.mj_step(model, settled, nstep=step_count)
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
        names = self.tree.collision_labels
        depths = -np.asarray(data.contact.dist)
        geoms = np.asarray(data.contact.geom)
        allowed = set() if self.squeezes is None else self.squeezes.list_allowed_contacts(clock)
        deepest: dict[tuple[str, str], float] = {}
        for i in np.flatnonzero(depths > CONTACT_DEPTH).tolist():
            first, second = (names[labels[geom]] for geom in geoms[i])
            pair = (min(first, second), max(first, second))
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
        if self.squeezes is not None:
            grips += self.squeezes.grips
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
        planned = self.trajectory
        world_names = self.tree.coordinates.names
        positions = planned.at(self.clocks)
        for column, name in enumerate(planned.names):
            if name in world_names:
                positions[:, column] = rows[:, world_names.index(name)]
        last = len(self.clocks) - 1
        phases: list[PhaseSpan] = []
        before = 0  # the end of the phase before
        for number, phase in enumerate(planned.phases):
            end = int(np.searchsorted(self.clocks, planned.times[phase.last]))
            # Each phase has at least one interval between recorded states.
            remaining = len(planned.phases) - 1 - number
            end = last if remaining == 0 else min(max(end, before + 1), last - remaining)
            phases.append(replace(phase, first=before, last=end))
            before = end
        return Trajectory(planned.names, self.clocks, positions, tuple(phases), planned.robot_size)


def _list_holds(spans: Sequence[Span]) -> list[Hold]:
    """Return the holds of spans without repetition."""
    return list(dict.fromkeys(hold for hold, _, _ in spans))
