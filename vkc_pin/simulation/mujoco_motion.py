"""Writes a motion in the coordinates of a MuJoCo model of someone else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.simulation.model import to_mujoco_quaternion
from vkc_pin.simulation.robot_in_model import (
    ModelJoints,
    RobotInModel,
    check_data,
    check_model,
    copy_positions,
)
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.utils.words import clean_name
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# [m], [rad] by which a base that the plan does not move may stand elsewhere in the model
_BASE_TOLERANCE = 1e-3
_DEGREE = 5  # coefficients of the polynomial of a coupling


@dataclass(frozen=True, eq=False)
class MujocoMotion:
    """A motion in the coordinates of a MuJoCo model.

    Attributes:
        times: Times, shape (K,) [s], from 0 to the end of the motion.
        qpos: Positions, shape (K, nq), in the model's order, [m] and [rad]. Joints that the motion
            does not move are as they were.
        ctrl: Controls, shape (K, nu), at which position actuators are at rest at `qpos`; None if
            one of `driven` lacks such an actuator. Other controls are as they were.
        driven: Names of the model's joints that the robot's motors move.
        moved: Names of all joints that the motion determines: `driven`, joints of objects, and free
            joints.
        holding: Whether the hand holds something, shape (K,).
        notes: Coordinates that the model lacks.
    """

    times: Floats
    qpos: Floats
    ctrl: Floats | None
    driven: tuple[str, ...]
    moved: tuple[str, ...]
    holding: Bools
    notes: tuple[str, ...] = ()
    _columns: Mapping[str, int] = field(default_factory=dict, repr=False)

    def __repr__(self) -> str:
        return f"<MujocoMotion {self.times[-1]:.1f} s, {len(self.times)} samples>"

    def positions(self, names: Sequence[str] | None = None) -> Floats:
        """Return the positions of hinges and slides, shape (K, n); default: of `driven`.

        Raises:
            UnknownNameError: The model has no such hinge or slide.
        """
        chosen = self.driven if names is None else names
        return self.qpos[:, [_find_column(self._columns, name) for name in chosen]]


def _find_column(columns: Mapping[str, int], name: str) -> int:
    if name not in columns:
        raise UnknownNameError("hinge or slide of the model", name, columns, field="names")
    return columns[name]


def make_mujoco_motion(
    scene: Scene,
    trajectory: Trajectory,
    model: Any,
    rate: float,
    *,
    data: Any = None,
    joints: Mapping[str, str] | None = None,
    robot_body: str | None = None,
) -> MujocoMotion:
    """Return a motion of a scene in the coordinates of a model; see `Plan.to_mujoco`."""
    mujoco = check_model(model)
    if data is not None:
        check_data(model, data)
    times, _ = trajectory.sample(rate)
    writer = _Writer(mujoco, model, data, scene, joints, robot_body)
    return writer.write(trajectory, times)


class _Writer:
    """Writes motions of a scene in the coordinates of a model."""

    def __init__(
        self,
        mujoco: Any,
        model: Any,
        data: Any,
        scene: Scene,
        joints: Mapping[str, str] | None,
        robot_body: str | None,
    ) -> None:
        self._mujoco = mujoco
        self._model = model
        self._scene = scene
        self._joints = ModelJoints(model, joints)
        self._robot = RobotInModel(model, scene.robot, self._joints, body=robot_body)
        # New data have the positions `qpos0`.
        self._data = mujoco.MjData(model) if data is None else copy_positions(model, data)
        self._ctrl = np.zeros(model.nu) if data is None else np.array(data.ctrl)
        self._world = World(scene)
        self._notes = list[str]()
        self._check_joint_names()

    def write(self, trajectory: Trajectory, times: Floats) -> MujocoMotion:
        """Return the motion at some times."""
        rows = self._world.compute_positions(trajectory, times)
        columns = {name: rows[:, k] for k, name in enumerate(self._world.coordinates.names)}
        qpos = np.tile(np.array(self._data.qpos), (len(times), 1))
        rise = self._write_base(qpos, rows)
        driven = [*self._robot.base_joints, *self._robot.arm_joints]
        names = self._scene.robot.coordinates.names[3:]
        for coordinate, joint in zip(names, self._robot.arm_joints, strict=True):
            qpos[:, self._joints.get_address(joint)] = columns[coordinate]
        driven += self._write_fingers(qpos, columns)
        moved = [*driven, *self._write_objects(qpos, columns)]
        moved += self._write_free_objects(qpos, rows, rise)
        moved += self._write_couplings(qpos, moved)
        holding = np.zeros(len(times), bool)
        for phase in trajectory.phases:
            if phase.holds:
                begin, end = trajectory.times[[phase.first, phase.last]]
                holding |= (times >= begin) & (times <= end)
        addresses = {name: self._joints.get_address(name) for name in self._joints.names}
        return MujocoMotion(
            times=times - times[0],
            qpos=qpos,
            ctrl=self._compute_controls(qpos, driven),
            driven=tuple(driven),
            moved=tuple(moved),
            holding=holding,
            notes=tuple(self._notes),
            _columns=addresses,
        )

    def _check_joint_names(self) -> None:
        """Check that `joints` names coordinates of the scene alone."""
        robot = self._scene.robot
        known = [*self._world.coordinates.names]
        known += [str(robot.model.names[move.joint]) for move in robot.coordinates.followers]
        for coordinate in self._joints.given:
            if coordinate not in known:
                raise UnknownNameError("coordinate of the scene", coordinate, known, field="joints")

    def _write_base(self, qpos: Floats, rows: Floats) -> float:
        """Write the positions of the base, and return the height of the scene's floor [m].

        Raises:
            InputError: The base stands elsewhere than in the scene.
        """
        addresses = [self._joints.get_address(name) for name in self._robot.arm_joints]
        self._data.qpos[addresses] = rows[0, 3 : 3 + len(addresses)]
        self._mujoco.mj_kinematics(self._model, self._data)
        pose, elevation = self._robot.find_base(self._data)
        # The scene's robot is built at its height above the scene's floor.
        if self._robot.base_joints:
            motion = self._robot.find_base_motion(self._data)
            base = [self._joints.get_address(name) for name in self._robot.base_joints]
            positions = motion.invert(rows[:, :3])
            # The scene's heading may count other turns than the hinge, whose servo would turn back.
            gap = positions[0, 2] - self._data.qpos[base[2]]
            positions[:, 2] += wrap_angle(gap) - gap
            qpos[:, base] = positions
            return elevation
        gap = rows[0, :3] - pose
        gap[2] = wrap_angle(gap[2])
        if np.abs(gap).max() > _BASE_TOLERANCE:
            raise InputError(
                f"the base of robot '{self._scene.robot.name}' stands elsewhere in this state",
                field="data",
                expected=f"x, y, yaw = {rows[0, :3].round(4).tolist()}",
                got=pose.round(4).tolist(),
            )
        return elevation

    def _write_fingers(self, qpos: Floats, columns: Mapping[str, Floats]) -> list[str]:
        """Write the positions of fingers that the model has, and return their joints."""
        gripper = self._scene.robot.gripper
        written = list[str]()
        for name in gripper.names if gripper is not None else ():
            joint = self._joints.given.get(name, name)
            if joint in self._joints:
                qpos[:, self._joints.get_address(joint)] = columns[name]
                written.append(joint)
            else:
                self._notes.append(f"the model has no finger joint '{joint}': left out")
        return written

    def _write_objects(self, qpos: Floats, columns: Mapping[str, Floats]) -> list[str]:
        """Write the positions of the objects' joints, and return the model's joints."""
        written = list[str]()
        for name, placed in self._scene.objects.items():
            for own in placed.object.coordinates.names:
                coordinate = f"{name}.{own}"
                joint = self._joints.given.get(coordinate) or self._joints.find_similar(own)
                if joint is None:
                    raise UnknownNameError(
                        f"joint of the model for '{coordinate}': no hinge or slide",
                        own,
                        self._joints.names,
                        field="joints",
                    )
                address = self._joints.get_address(joint)
                qpos[:, address] = columns[coordinate] + self._model.qpos0[address]
                written.append(joint)
        return written

    def _write_free_objects(self, qpos: Floats, rows: Floats, rise: float) -> list[str]:
        """Write the poses of free objects, and return their joints.

        The scene's frame of an object is fixed in the body. With its poses P(t) in the scene and
        B(0) of the body, the body is at S P(t) P(0)⁻¹ S⁻¹ B(0); S raises the scene's floor to the
        model's.
        """
        lift = pin.SE3(np.eye(3), np.array([0.0, 0.0, rise]))
        written = list[str]()
        for name, placed in self._scene.objects.items():
            if not placed.object.free:
                continue
            joint = self._find_free_joint(name)
            address = int(self._model.jnt_qposadr[joint])
            body = int(self._model.jnt_bodyid[joint])
            rotation = np.array(self._data.xmat[body]).reshape(3, 3)
            first = pin.SE3(rotation, np.array(self._data.xpos[body]))
            start = self._world.get_placement(name, rows[0])
            for k, row in enumerate(rows):
                motion = self._world.get_placement(name, row) * start.inverse()
                pose = lift * motion * lift.inverse() * first
                qpos[k, address : address + 3] = pose.translation
                qpos[k, address + 3 : address + 7] = to_mujoco_quaternion(pose)
            written.append(str(self._model.joint(joint).name) or f"joint_{joint}")
        return written

    def _find_free_joint(self, name: str) -> int:
        """Return the free joint of the body that the scene calls `name`."""
        names = list[str]()
        for joint in range(self._model.njnt):
            if int(self._model.jnt_type[joint]) != int(self._mujoco.mjtJoint.mjJNT_FREE):
                continue
            body = int(self._model.jnt_bodyid[joint])
            own = str(self._model.body(body).name) or f"body_{body}"
            if clean_name(own) == name:
                return joint
            names.append(own)
        raise UnknownNameError("free body of the model", name, names, field="model")

    def _write_couplings(self, qpos: Floats, moved: Sequence[str]) -> list[str]:
        """Write the positions of joints that follow moved ones, and return them.

        y = y₀ + Σ aₖ (x − x₀)ᵏ, with positions y₀ and x₀ in `qpos0`.
        """
        model = self._model
        numbers = {self._joints.get_number(name) for name in moved if name in self._joints}
        written = list[str]()
        for equality in np.flatnonzero(model.eq_active0).tolist():
            follower = int(model.eq_obj1id[equality])
            leader = int(model.eq_obj2id[equality])
            if int(model.eq_type[equality]) != int(self._mujoco.mjtEq.mjEQ_JOINT):
                continue
            if leader not in numbers or follower in numbers:
                continue
            own = int(model.jnt_qposadr[follower])
            led = int(model.jnt_qposadr[leader])
            coefficients = model.eq_data[equality][:_DEGREE]
            displacement = qpos[:, led] - model.qpos0[led]
            polynomial = np.polynomial.polynomial.polyval(displacement, coefficients)
            qpos[:, own] = model.qpos0[own] + polynomial
            written.append(str(model.joint(follower).name) or f"joint_{follower}")
        return written

    def _compute_controls(self, qpos: Floats, driven: Sequence[str]) -> Floats | None:
        """Return the controls of the position actuators of joints, or None if one has none.

        The force of a position actuator is k u + b₀ + b₁ g q + b₂ g q̇ with its gear g and b₁ < 0;
        it is zero at rest for u = −(b₀ + b₁ g q) / k.
        """
        model = self._model
        types = self._mujoco
        ctrl = np.tile(self._ctrl, (len(qpos), 1))
        for name in driven:
            joint = self._joints.get_number(name)
            found = list[int]()
            for actuator in range(model.nu):
                gain = float(model.actuator_gainprm[actuator][0])
                is_servo = (
                    int(model.actuator_trntype[actuator]) == int(types.mjtTrn.mjTRN_JOINT)
                    and int(model.actuator_trnid[actuator][0]) == joint
                    and int(model.actuator_gaintype[actuator]) == int(types.mjtGain.mjGAIN_FIXED)
                    and int(model.actuator_biastype[actuator]) == int(types.mjtBias.mjBIAS_AFFINE)
                    and gain != 0.0
                    and float(model.actuator_biasprm[actuator][1]) < 0.0
                )
                if is_servo:
                    found.append(actuator)
            if len(found) != 1:
                return None
            (actuator,) = found
            gain = float(model.actuator_gainprm[actuator][0])
            offset, slope = model.actuator_biasprm[actuator][:2]
            lengths = model.actuator_gear[actuator][0] * qpos[:, self._joints.get_address(name)]
            ctrl[:, actuator] = -(offset + slope * lengths) / gain
        return ctrl
