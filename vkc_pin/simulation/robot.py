"""Defines a robot in MuJoCo that executes motions as they come, as a real one does."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError, format_value
from vkc_pin.simulation.contacts import Contact, find_unplanned_contacts
from vkc_pin.simulation.execution import check_actual
from vkc_pin.simulation.physics import Physics, complete_inertias, import_mujoco
from vkc_pin.simulation.recording import GraspedPose, GraspForce, ObjectState, Recording
from vkc_pin.simulation.reference import Reference
from vkc_pin.simulation.result import Tracking
from vkc_pin.simulation.servos import Servo, make_servos
from vkc_pin.simulation.stepping import (
    CONTACT_PERIOD,
    WELD_STEP,
    Stepper,
    compute_commands,
    silence_warnings,
)
from vkc_pin.simulation.welds import Grip
from vkc_pin.utils.arguments import (
    check_bool,
    check_choice,
    check_finite_array,
    check_instance,
    check_integer,
    check_number,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.robot_state import RobotState
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# [s] between recorded states: that of contacts
_RECORD_PERIOD = CONTACT_PERIOD
# configurations for which servos are designed; `make_servos` takes no more
_CONFIGURATIONS = 40
# time steps whose commands are computed at once
_BLOCK = 1000
# [s] by which rounding may place a time before another
_ROUNDING = 1e-9
# coordinates of the base: x, y, yaw
_BASE_SIZE = 3


@dataclass(frozen=True, eq=False)
class _Sample:
    """A measurement without noise.

    Attributes:
        number: Number of the time step at which it is taken.
        positions: Positions of base and arm, shape (n,), [m] and [rad].
        velocities: Their velocities, shape (n,), [m/s] and [rad/s].
        force, torque: Largest load on a grasp, as `GraspForce` has it, [N] and [N·m].
    """

    number: int
    positions: Floats
    velocities: Floats
    force: float
    torque: float


class SimulatedRobot:
    """A robot in physics, as `vkc_pin.execution.execute` runs it.

    Its clock begins with 0, when the robot has stood in the start of the scene for
    `physics.settle`, and advances when it waits. Grasped objects are welded to the hand where it
    closes, unless the load exceeds its strength. The servos are designed for the largest inertia
    that they move in any configuration, not for one motion.

    The base goes where its localisation places it: with a bias b, it is at q - b when q is planned
    and measured. The bias is b = `base_offset` + `base_drift` · s after s metres of travel. An
    offset is a step for the base's servos, which takes place while the robot settles; one of more
    than a few centimetres belongs into the start of `actual`.

    Args:
        scene: Scene that the planner knows.
        actual: Scene as it really is, if it differs: objects are displaced or heavier, for example.
        physics: Physical settings; defaults to `Physics()`. Steps are at most 5 ms.
        noise: Standard deviation of measured positions, [m] and [rad]: one number, or shape (n,).
        velocity_noise: That of measured velocities, [m/s] and [rad/s].
        delay: Time from a measurement until it is read [s].
        seed: Seed of the noise.
        base_offset: Bias of the base's localisation at the start: x, y [m], yaw [rad].
        base_drift: Increase of this bias per metre of travel: x, y [m/m], yaw [rad/m].
        counts_planning: Whether the time that the program takes between two calls passes for the
            robot, too. If not, planning takes no time, and executions are reproducible.

    Raises:
        InputError: MuJoCo is not installed, `actual` has another robot or lacks objects, or an
            argument is invalid.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        actual: Scene | None = None,
        physics: Physics | None = None,
        noise: ArrayLike = 0.0,
        velocity_noise: ArrayLike = 0.0,
        delay: float = 0.0,
        seed: int = 0,
        base_offset: ArrayLike = (0.0, 0.0, 0.0),
        base_drift: ArrayLike = (0.0, 0.0, 0.0),
        counts_planning: bool = True,
    ) -> None:
        import_mujoco()  # an error if it is missing
        self._scene = check_instance(scene, Scene, "scene")
        executed = scene if actual is None else check_instance(actual, Scene, "actual")
        check_actual(scene, executed)
        physics = Physics() if physics is None else check_instance(physics, Physics, "physics")
        timestep = min(physics.timestep, WELD_STEP)
        self._physics = replace(physics, timestep=timestep)
        self._size = len(scene.start)
        self._noise = _check_deviations(noise, self._size, "noise")
        self._velocity_noise = _check_deviations(velocity_noise, self._size, "velocity_noise")
        self._seed = check_integer(seed, "seed", low=0)
        self._offset = _check_bias(base_offset, "base_offset")
        self._drift = _check_bias(base_drift, "base_drift")
        self._counts_planning = check_bool(counts_planning, "counts_planning")
        delay = check_number(delay, "delay", "a time [s]", low=0.0, high=60.0)

        self._tree = World(executed)
        self.notes = tuple(complete_inertias(self._tree, self._physics))
        configurations = _sample_configurations(self._tree, self._size)
        self._servos: tuple[Servo, ...] = make_servos(self._tree, configurations, self._physics)
        self._reference = Reference(executed)
        self._holds = [hold for hold, _, _ in self._reference.spans]
        self._recording = Recording(self._tree)
        self._settling_steps = round(self._physics.settle / timestep)
        self._record_steps = max(1, round(_RECORD_PERIOD / timestep))
        self._number = -self._settling_steps  # of the next time step
        self._travelled = 0.0  # path length of the base [m]
        self._diverged: float | None = None
        self._errors: list[Floats] = []
        self._forces: list[Floats] = []
        # The oldest is the one that is read.
        self._samples: deque[_Sample] = deque(maxlen=1 + round(delay / timestep))
        self._left: float | None = None  # when the program got back control, on its own clock [s]
        self._pending = 0.0  # time of the program that the robot has not caught up with [s]
        with silence_warnings():
            self._stepper = self._make_stepper()
            self._measure()
            self._displacement = self._balance_load()
        self._advance(0.0)

    def __repr__(self) -> str:
        return f"<SimulatedRobot {self._scene.robot.name} at {self._clock:.2f} s>"

    @property
    def time(self) -> float:
        """Time of the robot's clock [s]."""
        with self._take_turn():
            return self._clock

    @property
    def _clock(self) -> float:
        return self._number * self._physics.timestep

    def read(self) -> RobotState:
        """Return the state as it was measured `delay` ago.

        A measurement has the same noise however often it is read.

        Raises:
            InputError: The integration diverged.
        """
        with self._take_turn():
            sample = self._samples[0]
            count = sample.number + self._settling_steps
            random = np.random.default_rng((self._seed, count))
            errors = random.standard_normal((2, self._size))
            return RobotState(
                sample.number * self._physics.timestep,
                sample.positions + self._noise * errors[0],
                sample.velocities + self._velocity_noise * errors[1],
                sample.force,
                sample.torque,
            )

    def send(self, motion: Trajectory, begin: float) -> None:
        """Execute a motion from a time on; until then the robot goes on with those before.

        Holds and gripper openings of its phases take place at their times. An object that is held
        when the motion begins, and that its first phase holds, stays in the hand as it is there.
        After its end the robot stays where it ends.

        Args:
            motion: The motion.
            begin: Time at which its first waypoint is due [s].

        Raises:
            InputError: `begin` is over, the motion is one of another robot or holds an object
                that is not in the scene, or the integration diverged.
        """
        check_instance(motion, Trajectory, "motion")
        begin = check_number(begin, "begin", "a time [s]")
        self._check_motion(motion)
        with self._take_turn():
            if begin < self._clock - _ROUNDING:
                expected = f"a time from {self._clock:g} s on"
                raise InputError("this is over", field="begin", expected=expected, got=begin)
            self._reference.send(motion, begin)
            self._reschedule()

    def stop(self) -> None:
        """Stay where it is, as far as the servos can: they brake with all their force.

        Raises:
            InputError: The integration diverged.
        """
        with self._take_turn():
            self._reference.rest(self._measured_positions(), self._clock)
            self._reschedule()

    def wait(self, until: float) -> None:
        """Let the time pass until `until` [s]; return at once if it is over.

        Raises:
            InputError: `until` is not finite, or the integration diverged.
        """
        until = check_number(until, "until", "a time [s]")
        with self._take_turn():
            if until > self._clock:
                self._pending = 0.0
                self._advance(until)
                self._check_stable()

    @property
    def rows(self) -> Floats:
        """Recorded world coordinates, see `World`, one row each 10 ms, shape (K, n)."""
        return self._recording.rows

    @property
    def grasped_poses(self) -> tuple[GraspedPose, ...]:
        """Poses of hand and grasped link as they really are, each 10 ms."""
        return self._recording.list_grasped_poses()

    def locate(self, name: str, link: str) -> pin.SE3:
        """Return where a link of an object really is now, in the world.

        Raises:
            UnknownNameError: There is no such object or link.
        """
        objects = self._tree.scene.objects
        check_choice(name, objects, "object", "name")
        objects[name].object.link_frame(link)  # raises an error if there is no such link
        stepper = self._stepper
        return stepper.physical.place_frame(stepper.data, f"{name}.{link}")

    @property
    def grasp_forces(self) -> tuple[GraspForce, ...]:
        """Forces and torques of grasps, each 10 ms."""
        return self._recording.list_grasp_forces()

    @property
    def bias(self) -> Floats:
        """Bias of the base's localisation now: x, y [m], yaw [rad], shape (3,)."""
        return self._offset + self._drift * self._travelled

    @property
    def held(self) -> frozenset[str]:
        """Names of the objects that are grasped now."""
        return frozenset(hold.object for hold in self._stepper.grips.loads)

    @property
    def grips(self) -> tuple[Grip, ...]:
        """Grasps so far and their largest loads."""
        return tuple(self._stepper.grips.grips)

    def object_states(self, time: float | None = None) -> dict[str, ObjectState]:
        """Return object → joint values and placement as they really are.

        Args:
            time: Time that is over [s], of which the next recorded state counts. Default: now.
        """
        row = self._stepper.physical.from_qpos(self._stepper.data.qpos)
        if time is not None:
            number = int(np.searchsorted(self._recording.times, time))
            if number < len(self._recording.times):
                row = self._recording.rows[number]
        return self._recording.get_object_states(row)

    def trajectory(self) -> Trajectory:
        """Return the motion of the robot until now, each 10 ms, with the times of its clock.

        It has the coordinates of all motions; freedoms of grasps are as planned.

        Raises:
            InputError: The robot has not waited yet.
        """
        return self._recording.make_trajectory(self._reference)

    def tracking(self) -> Tracking:
        """Return by how much the servos were off their references.

        Raises:
            InputError: The robot has not waited yet.
        """
        if not self._errors:
            expected = "a robot that has waited"
            raise InputError("nothing is recorded", field="tracking", expected=expected)
        steps = np.arange(len(self._errors)) - self._settling_steps
        times = np.asarray(steps * self._physics.timestep, float)
        return Tracking.from_samples(
            times,
            np.array(self._errors),
            np.array(self._forces),
            self._servos,
            self._size,
        )

    def contacts(
        self, scene: Scene | None = None, *, begin: float = -np.inf, end: float = np.inf
    ) -> tuple[Contact, ...]:
        """Return the contacts so far that the motions do not have.

        Args:
            scene: Scene to which the motions are compared, such as that with the placements that
                were observed. Default: the robot's.
            begin: Time from which on contacts and motions count [s].
            end: Time until which they do [s].
        """
        known = self._scene if scene is None else check_instance(scene, Scene, "scene")
        samples = dict[tuple[str, str], list[tuple[float, float]]]()
        for pair, every in self._stepper.contact_samples.items():
            own = [(time, depth) for time, depth in every if begin <= time < end]
            if own:
                samples[pair] = own
        times = self._recording.times
        times = times[(times >= begin) & (times < end)]
        if not samples or len(times) < 2:
            return ()
        planned = self._reference.make_trajectory(World(known), times)
        return find_unplanned_contacts(known, planned, samples, _RECORD_PERIOD)

    @contextlib.contextmanager
    def _take_turn(self) -> Iterator[None]:
        """Let the robot catch up with the program, whose time counts from the end of the call.

        Raises:
            InputError: The integration diverged.
        """
        if self._counts_planning and self._left is not None:
            self._pending += time.perf_counter() - self._left
            step_count = int(self._pending / self._physics.timestep)
            passed = step_count * self._physics.timestep
            self._pending -= passed
            self._advance(self._clock + passed)
        self._check_stable()
        try:
            yield
        finally:
            self._left = time.perf_counter()

    def _check_stable(self) -> None:
        """Check that the integration has not diverged."""
        if self._diverged is not None:
            raise InputError(
                "the integration diverged",
                field="robot",
                expected="other physical settings",
                got=f"diverged at {self._diverged:.2f} s",
            )

    def _check_motion(self, motion: Trajectory) -> None:
        """Check that a motion is one of this robot, and holds objects of the scene."""
        names = self._scene.robot.coordinates.names
        if motion.names[: motion.robot_size] != tuple(names):
            raise InputError(
                "a motion of another robot",
                field="motion",
                expected=", ".join(names),
                got=format_value(list(motion.names[: motion.robot_size])),
            )
        objects = self._tree.scene.objects
        for phase in motion.phases:
            for hold in phase.holds:
                check_choice(hold.object, objects, "object", "motion.phases")
                objects[hold.object].object.attachment(hold.attachment)
                if hold.by is not None:
                    # raises an error if there is no such link
                    objects[hold.by.object].link_placement(str(hold.link))

    def _make_stepper(self) -> Stepper:
        """Return the physics of the scene with welds for all holds so far."""
        spans = self._reference.spans
        motion = self._reference.segments[self._reference.find_segment(self._clock)].motion
        return Stepper(self._tree, self._physics, self._servos, self._holds, spans, motion)

    def _reschedule(self) -> None:
        """Follow the reference's holds from now on; build the model again if it lacks some."""
        spans = self._reference.spans
        new = dict.fromkeys(hold for hold, _, _ in spans if hold not in self._holds)
        if new:
            self._holds = [*self._holds, *new]
            before = self._stepper
            with silence_warnings():
                self._stepper = self._make_stepper()
                self._stepper.adopt(before)
        last = float(self._reference.segments[-1].motion.times[-1])
        self._stepper.grips.reschedule(spans, last)

    def _balance_load(self) -> Floats:
        """Return the displacements of servo commands that carry the grasped objects at the start.

        Their shape is (servos,), [m] and [rad].
        """
        self._stepper.switch(self._clock)
        _, commands = self._compute_commands(np.array([self._clock]))
        self._stepper.command(commands[0])
        return self._stepper.balance_load(self._size)

    def _compute_commands(self, clocks: Floats) -> tuple[Floats, Floats]:
        """Compute planned positions and commands at times, shape (K, servos) each."""
        targets: list[Floats] = []
        commands: list[Floats] = []
        for segment, own in self._reference.divide(clocks):
            motion = segment.motion
            # Before its first waypoint a motion has no velocity.
            times = np.maximum(own, motion.times[0])
            fingers = self._reference.sample_fingers(segment, times)
            found = compute_commands(self._tree, self._servos, motion, fingers, times)
            targets.append(found[0])
            commands.append(found[1])
        return np.vstack(targets), np.vstack(commands)

    def _advance(self, until: float) -> None:
        """Step the physics until a time [s]."""
        timestep = self._physics.timestep
        last = int(np.ceil((until - _ROUNDING) / timestep))
        with silence_warnings():
            while self._number < last and self._diverged is None:
                numbers = np.arange(self._number, min(last, self._number + _BLOCK))
                clocks = np.asarray(numbers * timestep, float)
                targets, commands = self._compute_commands(clocks)
                commands += self._displacement
                for target, command in zip(targets, commands, strict=True):
                    self._step(target, command)
                    if self._diverged is not None:
                        break

    def _step(self, target: Floats, command: Floats) -> None:
        """Advance by a time step.

        Args:
            target: Planned positions, shape (servos,), [m] and [rad].
            command: Commands of the servos, shape (servos,), [m] and [rad].
        """
        stepper = self._stepper
        clock = self._clock
        is_recorded = self._number % self._record_steps == 0
        number = self._reference.find_segment(clock)
        stepper.grips.trajectory = self._reference.segments[number].motion
        stepper.switch(clock)
        if is_recorded:
            row = stepper.physical.from_qpos(stepper.data.qpos)
            self._recording.add(clock, row, stepper.grips.loads)
        before = stepper.positions
        self._errors.append(target - before)
        # The base's controller knows the measured position only.
        command[:_BASE_SIZE] -= self.bias
        stepper.command(command)
        is_stable = stepper.step()
        self._forces.append(stepper.forces)
        if not is_stable:
            self._diverged = clock
            return
        stepper.measure(clock, with_contacts=is_recorded)
        self._number += 1
        moved = stepper.positions[:2] - before[:2]
        self._travelled += float(np.hypot(*moved))
        self._measure()

    def _measured_positions(self) -> Floats:
        """Return the positions of base and arm as measured, without noise, shape (n,)."""
        positions = self._stepper.positions[: self._size]
        positions[:_BASE_SIZE] += self.bias
        return positions

    def _measure(self) -> None:
        """Measure the present state."""
        velocities = self._stepper.velocities[: self._size]
        loads = self._stepper.grips.loads.values()
        force = max((force for force, _ in loads), default=0.0)
        torque = max((torque for _, torque in loads), default=0.0)
        positions = self._measured_positions()
        self._samples.append(_Sample(self._number, positions, velocities, force, torque))


def _check_deviations(value: ArrayLike, size: int, field: str) -> Floats:
    """Return standard deviations of coordinates, shape (n,)."""
    found = check_finite_array(value, field)
    if found.shape not in ((), (size,)) or (found < 0.0).any():
        expected = f"one number of at least 0, or {size} of them"
        raise InputError("invalid noise", field=field, expected=expected, got=format_value(value))
    return np.broadcast_to(found, (size,)).copy()


def _check_bias(value: ArrayLike, field: str) -> Floats:
    """Return a bias of the base, shape (3,)."""
    found = check_finite_array(value, field)
    if found.shape != (_BASE_SIZE,):
        raise InputError(
            "wrong shape", field=field, expected="x, y and yaw", got=format_value(value)
        )
    return found


def _sample_configurations(tree: World, size: int) -> Floats:
    """Return world coordinates of the start and of random configurations of the arm.

    Continuous joints turn once. The shape is (configurations, n).
    """
    rows = np.tile(tree.start, (_CONFIGURATIONS, 1))
    arm = slice(_BASE_SIZE, size)
    lower = np.maximum(tree.coordinates.lower[arm], -np.pi)
    upper = np.minimum(tree.coordinates.upper[arm], np.pi)
    random = np.random.default_rng(0)
    rows[1:, arm] = random.uniform(lower, upper, (_CONFIGURATIONS - 1, size - _BASE_SIZE))
    return rows
