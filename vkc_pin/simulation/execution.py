"""Executes a trajectory in MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.simulation.contacts import Contact, find_unplanned_contacts
from vkc_pin.simulation.friction import (
    find_fingers,
    find_grip_changes,
    insert_pauses,
    limit_finger_servos,
    split_spans,
)
from vkc_pin.simulation.goals import measure_goal_errors
from vkc_pin.simulation.physics import Physics, complete_inertias, import_mujoco
from vkc_pin.simulation.result import SimulationResult, Tracking
from vkc_pin.simulation.servos import Servo, make_servos, sample_fingers
from vkc_pin.simulation.stepping import (
    CONTACT_PERIOD,
    WELD_STEP,
    Stepper,
    compute_commands,
    silence_warnings,
)
from vkc_pin.simulation.welds import Span, find_hold_spans
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Floats, Ints
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
# [s] between the closing of fingers on an object that is in the hand at the start, and the moment
# when they carry it
_CLOSED_TIME = 0.2
# [s] between recorded states
_FRAME_PERIOD = 0.02
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
    import_mujoco()  # an error if it is missing
    physics = Physics() if physics is None else check_instance(physics, Physics, "physics")
    if grasp not in GRASPS:
        raise InputError(
            "unknown grasp model", field="grasp", expected=", ".join(GRASPS), got=grasp
        )
    steps = as_steps(steps)
    executed_scene = scene if actual is None else check_instance(actual, Scene, "actual")
    check_actual(scene, executed_scene)
    with silence_warnings():
        run = _Run(executed_scene, trajectory, physics, friction=grasp == "friction")
        run.execute()
    return run.make_result(scene, steps)


def check_actual(scene: Scene, actual: Scene) -> None:
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
        self._limit_timestep(has_holds=bool(schedule))
        physics = self.physics
        self.tree = World(self.scene)
        self.notes = complete_inertias(self.tree, physics)
        friction_spans: list[Span] = []
        if self.friction:
            self._insert_grip_pauses(schedule)
            schedule, friction_spans = split_spans(
                find_hold_spans(self.scene, self.trajectory), float(self.trajectory.times[0])
            )
        self.planned = self.tree.compute_positions(self.trajectory)
        self.servos: tuple[Servo, ...] = make_servos(self.tree, self.planned, physics)
        self.fingers = find_fingers(self.tree, physics) if friction_spans else None
        if self.fingers is not None:
            self.servos = limit_finger_servos(self.servos, self.fingers, self.tree, physics)
        self.stepper = Stepper(
            self.tree,
            physics,
            self.servos,
            _list_holds(schedule),
            schedule,
            self.trajectory,
            fingers=self.fingers,
            squeezed=friction_spans,
        )
        self.times: Floats = self._choose_times(has_friction_grasps=bool(friction_spans))
        self.diverged: float | None = None

    def _limit_timestep(self, *, has_holds: bool) -> None:
        """Shorten the time step if grasps require it."""
        if self.friction:
            longest = _FRICTION_STEP
        elif has_holds:
            longest = WELD_STEP
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
        stepper = self.stepper
        data = stepper.data
        targets, commands = self._sample_commands()
        finger_motors, finger_commands = self._compute_finger_commands(targets)
        stepper.switch(float(self.times[0]))
        stepper.command(commands[0])
        data.ctrl[finger_motors] = finger_commands[0]
        commands += stepper.balance_load(self.trajectory.robot_size)
        contact_steps = max(1, round(CONTACT_PERIOD / self.physics.timestep))
        recorded = self._choose_recorded_steps()
        records: list[Floats] = []
        self.clocks = self.times[recorded]
        self.errors = np.zeros((len(self.times), len(self.servos)))
        self.efforts = np.zeros((len(self.times), len(self.servos)))
        for k, clock in enumerate(self.times.tolist()):
            stepper.switch(clock)
            if k == recorded[len(records)]:
                records.append(np.array(data.qpos))
            self.errors[k] = targets[k] - stepper.positions
            stepper.command(commands[k])
            data.ctrl[finger_motors] = finger_commands[k]
            is_stable = stepper.step()
            self.efforts[k] = stepper.forces
            if not is_stable:
                self.diverged = clock
                self._truncate(k + 1)
                break
            stepper.measure(clock, with_contacts=k % contact_steps == 0)
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
        squeezes = self.stepper.squeezes
        if squeezes is None or self.fingers is None:
            return np.zeros(0, int), np.zeros((len(self.times), 0))
        columns, motors = self.fingers.find_addresses(self.stepper.physical)
        if self.fingers.sides is None:
            planned = targets[:, self.trajectory.robot_size :]
        else:
            planned = np.zeros((len(self.times), len(columns)))
        return motors, squeezes.compute_commands(self.times, planned)

    def _sample_commands(self) -> tuple[Floats, Floats]:
        """Return planned positions and commands of all servos, shape (steps, servos) each."""
        fingers = sample_fingers(self.tree, self.planned, self.trajectory.times, self.times)
        return compute_commands(self.tree, self.servos, self.trajectory, fingers, self.times)

    def make_result(self, scene: Scene, steps: Sequence[Step]) -> SimulationResult:
        """Return the result of the execution."""
        rows = self.stepper.physical.from_qpos(self.states)
        contacts: tuple[Contact, ...] = find_unplanned_contacts(
            scene, self.trajectory, self.stepper.contact_samples, CONTACT_PERIOD
        )
        notes = list(self.notes)
        if self.stepper.pairs.overlapping:
            names = "; ".join(" – ".join(pair) for pair in self.stepper.pairs.overlapping)
            notes.append(f"overlap at the start, and therefore do not collide: {names}")
        if self.fingers is not None and self.fingers.sides is not None:
            reason = "the hand is described without finger joints"
            notes.append(f"{reason}: its two sides slide towards each other")
        grips = [
            grip
            for grip in self.stepper.grips.grips
            if grip.end > grip.begin or grip.broken is not None
        ]
        if self.stepper.squeezes is not None:
            grips += self.stepper.squeezes.grips
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
