"""Steps a scene in MuJoCo: commands its servos, switches welds and latches, and measures."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from vkc_pin.simulation.contacts import Pairs, find_contact_pairs
from vkc_pin.simulation.friction import Fingers, Squeezes
from vkc_pin.simulation.model import Builder, PhysicalWorld
from vkc_pin.simulation.physics import Physics, import_mujoco
from vkc_pin.simulation.servos import Servo, compute_feedforward, sample_reference
from vkc_pin.simulation.welds import Grips, Latches, Span, find_latches
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.scene.clearance_exemptions import CONTACT_DEPTH
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

WELD_STEP = 5e-3
"""Longest time step with welds [s].

MuJoCo computes a weld's force without the implicit damping of servos, which then is too large for
light wrists: from 7 ms on, one with a load of 4 kg oscillates by 0.07 rad.
"""
CONTACT_PERIOD = 0.01
"""Time between two recordings of contacts [s]."""
# [s] in which servos settle under load: ten time constants of the slowest
_BALANCE_TIME = 0.5
# [m] or [rad] by which servos at rest still give way
_BALANCED = 1e-8
# After each round a hundredth of the deflection is left, of up to 0.05 rad; contacts may chatter.
_BALANCE_ROUNDS = 8


@contextlib.contextmanager
def silence_warnings() -> Iterator[None]:
    """Let MuJoCo write no log file into the working directory, as it does by default.

    `Stepper.has_diverged` finds the causes of its warnings.
    """
    mujoco = import_mujoco()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def compute_commands(
    tree: World, servos: Sequence[Servo], motion: Trajectory, fingers: Floats, times: Floats
) -> tuple[Floats, Floats]:
    """Compute planned positions and commands of all servos, shape (K, servos) each.

    Args:
        tree: The scene, all of whose bodies have masses.
        servos: Servos of base, arm and fingers.
        motion: Reference of base and arm.
        fingers: Positions of the fingers, shape (K, fingers), [m] and [rad].
        times: Times of the motion, shape (K,) [s].
    """
    reference = sample_reference(motion, times)
    positions, velocities, _ = reference
    targets = np.column_stack([positions, fingers])
    # The servo subtracts damping · (actual velocity), so that the command adds the planned one.
    feedforward = compute_feedforward(tree, servos, targets, reference)
    count = velocities.shape[1]
    damping = [servo.damping for servo in servos[:count]]
    feedforward[:, :count] += velocities * damping
    stiffness = [servo.stiffness for servo in servos]
    return targets, targets + feedforward / stiffness


class Stepper:
    """A scene in physics.

    Args:
        tree: The scene, all of whose bodies have masses.
        physics: Physical settings.
        servos: Servos of base, arm and fingers.
        welded: Holds that are welds.
        schedule: These holds with begin and end [s], by begin.
        trajectory: Reference, which knows the freedoms of grasps.
        fingers: Fingers that grasp by friction; None: there are none.
        squeezed: Grasps by friction, with begin and end [s].

    Attributes:
        physical: The model.
        data: Its state, a `mujoco.MjData`.
        pairs: Shapes that may touch.
        grips: Welds.
        latches: Latches.
        squeezes: Grasps by friction; None: there are none.
        contact_samples: Maps pairs of labels to samples (time [s], depth [m]) at which they
            touched.
    """

    def __init__(
        self,
        tree: World,
        physics: Physics,
        servos: Sequence[Servo],
        welded: Sequence[Hold],
        schedule: Sequence[Span],
        trajectory: Trajectory,
        *,
        fingers: Fingers | None = None,
        squeezed: Sequence[Span] = (),
    ) -> None:
        self._mj = import_mujoco()
        self.tree = tree
        self.physics = physics
        self.servos = tuple(servos)
        friction_holds = [hold for hold, _, _ in squeezed]
        self.pairs: Pairs = find_contact_pairs(
            tree, [hold for hold in welded if hold not in friction_holds]
        )
        latches = find_latches(tree.scene)
        builder = Builder(tree, physics, has_friction_grasps=bool(squeezed))
        self.physical: PhysicalWorld = builder.build(
            self.pairs,
            self.servos,
            welded,
            [(joint, at) for joint, at, _, _ in latches],
            add_bodies=None if fingers is None else fingers.add_bodies,
            add_extras=None if fingers is None else fingers.add_drives,
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
        if fingers is not None:
            self.squeezes = Squeezes(
                self.physical, fingers, squeezed, trajectory, physics, CONTACT_PERIOD
            )
        self.contact_samples: dict[tuple[str, str], list[tuple[float, float]]] = {}
        servo_count = len(self.servos)
        self._driven = self.physical.columns[:servo_count]
        self._dofs = self.physical.dofs[:servo_count]
        model = self.physical.model
        self._labels: Ints = np.zeros(model.ngeom, int)
        self._labels[self.physical.geoms] = np.arange(len(self.physical.geoms))
        self.data: Any = self._mj.MjData(model)
        self.data.qpos[:] = self.physical.to_qpos(tree.start)
        self._mj.mj_forward(model, self.data)

    def adopt(self, other: Stepper) -> None:
        """Take over the state of another model of the same scene, which has fewer holds.

        Its holds are the first ones of this model.
        """
        old = other.physical.model
        new = self.physical.model
        mj = self._mj
        for joint in range(old.njnt):
            name = old.joint(joint).name
            for field in ("qpos", "qvel", "qacc_warmstart"):
                getattr(self.data.joint(name), field)[:] = getattr(other.data.joint(name), field)
        first = len(other.grips.holds)
        others = slice(len(self.grips.holds), None)
        self.data.eq_active[others] = other.data.eq_active[first:]
        self.grips.adopt(other.grips, self.data, other.data)
        self.contact_samples = other.contact_samples
        mj.mj_forward(new, self.data)

    @property
    def positions(self) -> Floats:
        """Positions of the driven coordinates, shape (servos,), [m] and [rad]."""
        return np.array(self.data.qpos[self._driven])

    @property
    def velocities(self) -> Floats:
        """Velocities of the driven coordinates, shape (servos,), [m/s] and [rad/s]."""
        return np.array(self.data.qvel[self._dofs])

    @property
    def forces(self) -> Floats:
        """Forces of the motors in the last step, shape (servos,), [N·m] and [N]."""
        return np.array(self.data.qfrc_actuator[self._dofs])

    def command(self, values: Floats) -> None:
        """Set the commands of all servos, shape (servos,), [m] and [rad]."""
        self.data.ctrl[: len(self.servos)] = values

    def switch(self, clock: float) -> None:
        """Begin and end the welds that are due at a time [s], and move the latches."""
        self.grips.follow(self.data, clock)
        self.latches.follow(self.data)

    def step(self) -> bool:
        """Advance by a time step; return whether the integration is still stable.

        MuJoCo resets a state that diverged; it has no welds then.
        """
        self._mj.mj_step(self.physical.model, self.data)
        return not self.has_diverged(self.data)

    def measure(self, clock: float, *, with_contacts: bool) -> None:
        """Record the loads on welds after the step from a time [s] on, and maybe contacts."""
        self.grips.measure(self.data, clock)
        if not with_contacts:
            return
        if self.data.ncon:
            self._record_contacts(clock)
        if self.squeezes is not None:
            self.squeezes.measure(self.data, clock)

    def has_diverged(self, data: Any) -> bool:
        """Return whether the integration of a state has diverged."""
        warnings = self._mj.mjtWarning
        kinds = (warnings.mjWARN_BADQPOS, warnings.mjWARN_BADQVEL, warnings.mjWARN_BADQACC)
        is_reset = any(data.warning[kind].number for kind in kinds)
        return is_reset or not np.isfinite(data.qpos).all()

    def balance_load(self, robot_size: int) -> Floats:
        """Make the robot carry from the beginning the objects that it grasps at the start.

        Servos and welds give way under load, and the plan begins where they have done so. They
        would give way once more at every continuation of an execution. A motor at rest carries its
        load where it is: each servo's command is displaced by the deflection under the load, as
        integral action would, and so is each weld. Since the load depends on the configuration,
        this is repeated.

        Welds and commands are those of the start.

        Args:
            robot_size: Number of coordinates of base and arm.

        Returns:
            Displacement of each servo's command, shape (servos,), [m] and [rad]: at most that of
            full effort, and 0 for fingers.
        """
        displacement = np.zeros(len(self.servos))
        if not self.grips.has_active:
            return displacement
        mj = self._mj
        model = self.physical.model
        count = len(self.servos)
        largest = np.array([servo.limit / servo.stiffness for servo in self.servos])
        largest[robot_size:] = 0.0
        start = self.positions
        commands = self.data.ctrl[:count].copy()
        step_count = round(_BALANCE_TIME / self.physics.timestep)
        for _ in range(_BALANCE_ROUNDS):
            settled = mj.MjData(model)
            mj.mj_copyData(settled, model, self.data)
            settled.ctrl[:count] = commands + displacement
            mj.mj_step(model, settled, nstep=step_count)
            if self.has_diverged(settled):
                return displacement  # the execution diverges as well, and says so
            mj.mj_kinematics(model, settled)
            self.grips.preload(self.data, settled)
            deflection = start - settled.qpos[self._driven]
            displacement = np.clip(displacement + deflection, -largest, largest)
            if np.abs(deflection).max() < _BALANCED:
                break
        return displacement

    def _record_contacts(self, clock: float) -> None:
        """Record the deepest penetration of each pair of links that touch."""
        names = self.tree.collision_labels
        depths = -np.asarray(self.data.contact.dist)
        geoms = np.asarray(self.data.contact.geom)
        allowed = set() if self.squeezes is None else self.squeezes.list_allowed_contacts(clock)
        deepest: dict[tuple[str, str], float] = {}
        for i in np.flatnonzero(depths > CONTACT_DEPTH).tolist():
            first, second = (names[self._labels[geom]] for geom in geoms[i])
            pair = (min(first, second), max(first, second))
            if pair in allowed:
                continue
            deepest[pair] = max(deepest.get(pair, 0.0), float(depths[i]))
        for pair, depth in deepest.items():
            self.contact_samples.setdefault(pair, []).append((clock, depth))
