"""Finds a robot's joints, and the placement of its base, in a MuJoCo model of someone else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.simulation.physics import import_mujoco
from vkc_pin.utils.arguments import check_mapping
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.words import clean_name
from vkc_pin.world.models.robot import Robot

BASE = ("base_x", "base_y", "base_yaw")
"""Coordinates of a robot's base."""
# [m] and sine of an angle by which a joint's axis may be elsewhere in the model than in the robot's
# description. Descriptions of one robot by different authors differ by rounding, 0.1 mm or so;
# other versions of a robot by millimetres.
_AXIS_TOLERANCE = 1e-3
_UPRIGHT_TOLERANCE = 1e-3  # sine of the tilt of a base that counts as upright
_LEAST_SINGULAR = 1e-3  # relative singular value from which axes determine a placement


def check_model(model: Any) -> Any:
    """Return the package `mujoco` after checking the type of a model."""
    mujoco = import_mujoco()
    _check_type(model, mujoco.MjModel, "model")
    return mujoco


def check_data(model: Any, data: Any) -> None:
    """Check that `data` are those of a model."""
    _check_type(data, import_mujoco().MjData, "data")
    if len(data.qpos) != model.nq:
        problem = "the data belong to another model"
        raise InputError(problem, field="data", expected=f"{model.nq} qpos", got=len(data.qpos))


def copy_positions(model: Any, data: Any) -> Any:
    """Return new `mujoco.MjData` of a model with the positions of `data`, and nothing computed."""
    copy = import_mujoco().MjData(model)
    copy.qpos[:] = data.qpos
    copy.mocap_pos[:] = data.mocap_pos
    copy.mocap_quat[:] = data.mocap_quat
    return copy


def _check_type(value: Any, kind: Any, field: str) -> None:
    if not isinstance(value, kind):
        raise InputError(
            f"this is no {field} of MuJoCo",
            field=field,
            expected=f"a mujoco.{kind.__name__}",
            got=type(value).__name__,
        )


class ModelJoints:
    """The hinges and slides of a model by name, and the names that others call them.

    Args:
        model: The `mujoco.MjModel`.
        joints: Coordinate, of a robot or of a scene → name of the model's joint, if they differ.

    Attributes:
        names: Names of the hinges and slides in the model's order.
        given: `joints`, checked.
    """

    def __init__(self, model: Any, joints: Mapping[str, str] | None) -> None:
        mujoco = import_mujoco()
        self._kinds = {
            int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
            int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
            int(mujoco.mjtJoint.mjJNT_BALL): "ball",
            int(mujoco.mjtJoint.mjJNT_FREE): "free",
        }
        self._model = model
        self._numbers = dict[str, int]()
        for joint in range(model.njnt):
            name = str(model.joint(joint).name) or f"joint_{joint}"
            self._numbers[name] = joint
        self.names = [name for name in self._numbers if self.get_kind(name) in ("hinge", "slide")]
        self.given = dict[str, str]()
        for coordinate, name in check_mapping(joints or {}, "joints").items():
            field = f"joints['{coordinate}']"
            if name not in self._numbers:
                raise UnknownNameError("joint of the model", str(name), self.names, field=field)
            if name not in self.names:
                raise InputError(
                    f"joint '{name}' has no single position",
                    field=field,
                    expected="a hinge or a slide",
                    got=f"a {self.get_kind(name)} joint",
                )
            self.given[coordinate] = name

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def get_number(self, name: str) -> int:
        """Return the number of a joint."""
        return self._numbers[name]

    def get_address(self, name: str) -> int:
        """Return the index of a joint in `qpos`."""
        return int(self._model.jnt_qposadr[self._numbers[name]])

    def get_kind(self, name: str) -> str:
        """Return "hinge", "slide", "ball" or "free"."""
        return self._kinds[int(self._model.jnt_type[self._numbers[name]])]

    def get_body(self, name: str) -> int:
        """Return the number of the body that a joint moves."""
        return int(self._model.jnt_bodyid[self._numbers[name]])

    def find(self, coordinate: str, *, of: str) -> str:
        """Return the model's joint of a coordinate.

        Args:
            coordinate: The coordinate.
            of: Whose coordinate it is, for messages.

        Raises:
            UnknownNameError: There is none.
        """
        name = self.given.get(coordinate, coordinate)
        if name in self.names:
            return name
        raise UnknownNameError(
            f"joint of the model for coordinate '{coordinate}' of {of}: no hinge or slide",
            name,
            self.names,
            field="joints",
        )

    def find_similar(self, coordinate: str) -> str | None:
        """Return the joint that a scene calls `coordinate`, whose name it may have cleaned."""
        if coordinate in self.given:
            return self.given[coordinate]
        if coordinate in self.names:
            return coordinate
        alike = [name for name in self.names if clean_name(name) == coordinate]
        return alike[0] if len(alike) == 1 else None


@dataclass(frozen=True, eq=False)
class _BaseMotion:
    """How two slides and a hinge move an upright base.

    With the positions p of the slides, the hinge's position a and the yaw θ of the base, its
    origin is at c₀ + A p + R(θ) d, and θ = θ₀ + s a.
    """

    origin: Floats
    directions: Floats
    sign: float
    yaw: float
    lever: Floats

    def invert(self, poses: Floats) -> Floats:
        """Return positions of slides and hinge, shape (K, 3), for poses x, y, yaw, shape (K, 3)."""
        cos = np.cos(poses[:, 2])
        sin = np.sin(poses[:, 2])
        lever_x = cos * self.lever[0] - sin * self.lever[1]
        lever_y = sin * self.lever[0] + cos * self.lever[1]
        middle = poses[:, :2] - np.column_stack([lever_x, lever_y]) - self.origin
        slides = np.linalg.solve(self.directions, middle.T).T
        return np.column_stack([slides, self.sign * (poses[:, 2] - self.yaw)])


class RobotInModel:
    """A robot in a model, which has hinges and slides for all of its coordinates.

    Args:
        model: The `mujoco.MjModel`.
        robot: The robot.
        joints: The model's joints.
        body: Name of the body that carries the robot; defaults to the one below the world.

    Attributes:
        base_joints: Joints of the base in the order of `BASE`, or () if it stands.
        arm_joints: Joints of the other coordinates, in order.
        root: Number of the body that carries the robot.

    Raises:
        UnknownNameError: A coordinate has no joint.
        InputError: A joint is of another kind.
    """

    def __init__(
        self, model: Any, robot: Robot, joints: ModelJoints, *, body: str | None = None
    ) -> None:
        self._mujoco = import_mujoco()
        self._model = model
        self._robot = robot
        self._joints = joints
        owner = f"robot '{robot.name}'"
        names = robot.coordinates.names
        self.arm_joints = tuple(joints.find(name, of=owner) for name in names[3:])
        self.base_joints: tuple[str, ...] = ()
        if robot.base != "fixed":
            self.base_joints = tuple(joints.find(name, of=owner) for name in BASE)
        kinds = [*("slide", "slide", "hinge")[: len(self.base_joints)]]
        kinds += ["slide" if unit == "m" else "hinge" for unit in robot.coordinates.units[3:]]
        for name, kind in zip(self.base_joints + self.arm_joints, kinds, strict=True):
            if joints.get_kind(name) != kind:
                raise InputError(
                    f"joint '{name}' does not move as that of {owner} does",
                    field="joints",
                    expected=f"a {kind}",
                    got=f"a {joints.get_kind(name)}",
                )
        self.root = self._find_root(body)

    def read_arm(self, qpos: Floats) -> dict[str, float]:
        """Return the positions of the arm's joints by coordinate, [m] or [rad]."""
        names = self._robot.coordinates.names[3:]
        found = dict[str, float]()
        for coordinate, joint in zip(names, self.arm_joints, strict=True):
            found[coordinate] = float(qpos[self._joints.get_address(joint)])
        return found

    def find_base(self, data: Any) -> tuple[Floats, float]:
        """Return where the base is: x, y [m], yaw [rad], and its height above the robot's own [m].

        The axes of the arm's joints determine it: their lines in the model are those of the
        robot's description.

        Args:
            data: `mujoco.MjData` with computed kinematics.

        Raises:
            InputError: No placement of the robot has its joints where the model has them, or the
                base is not upright.
        """
        placement = self._fit_placement(data)
        tilt = float(np.linalg.norm(placement.rotation[:2, 2]))
        if tilt > _UPRIGHT_TOLERANCE or placement.rotation[2, 2] < 0.0:
            raise InputError(
                f"the base of robot '{self._robot.name}' is not upright in the model",
                field="robot",
                expected="a z axis that points up",
                got=f"one tilted by {np.degrees(np.arctan2(tilt, placement.rotation[2, 2])):.1f}°",
            )
        yaw = np.arctan2(placement.rotation[1, 0], placement.rotation[0, 0])
        x, y, z = placement.translation
        return np.array([x, y, yaw]), float(z)

    def find_base_motion(self, data: Any) -> _BaseMotion:
        """Return how the joints of the base move it.

        Args:
            data: `mujoco.MjData` whose positions are changed and restored.

        Raises:
            InputError: They are no two slides followed by a hinge, with horizontal motion.
        """
        before = np.array(data.qpos)
        addresses = [self._joints.get_address(name) for name in self.base_joints]
        number = self._joints.get_number(self.base_joints[2])

        def place(values: Floats) -> tuple[Floats, Floats]:
            """Return the anchor of the hinge, and the pose of the base."""
            data.qpos[:] = before
            data.qpos[addresses] = values
            self._mujoco.mj_kinematics(self._model, data)
            return np.array(data.xanchor[number][:2]), self.find_base(data)[0]

        origin, pose = place(np.zeros(3))
        columns = [place(np.eye(3)[k])[0] - origin for k in (0, 1)]
        directions = np.array(columns).T
        sign = float(np.sign(np.sin(place(np.array([0.0, 0.0, 0.5]))[1][2] - pose[2])))
        cos = np.cos(pose[2])
        sin = np.sin(pose[2])
        lever = np.array([[cos, sin], [-sin, cos]]) @ (pose[:2] - origin)
        motion = _BaseMotion(origin, directions, sign, float(pose[2]), lever)
        # A pose with all three of them: slides that turn with the hinge move it elsewhere.
        test = np.array([[0.3, -0.2, 0.4]])
        is_flat = abs(abs(np.linalg.det(directions)) - 1.0) < _AXIS_TOLERANCE and sign != 0.0
        if is_flat:
            there = place(test[0])[1]
            is_flat = bool(np.allclose(motion.invert(there[None]), test, atol=_AXIS_TOLERANCE))
        data.qpos[:] = before
        self._mujoco.mj_kinematics(self._model, data)
        if not is_flat:
            raise InputError(
                "the model's base does not move as x, y and yaw",
                field="joints",
                expected="two horizontal slides at right angles, then a vertical hinge",
                got=", ".join(self.base_joints),
            )
        return motion

    def _find_root(self, name: str | None) -> int:
        """Return the body of this name, or the one below the world, that carries all joints."""
        model = self._model
        names = [str(model.body(body).name) for body in range(model.nbody)]
        if name is not None and name not in names[1:]:
            raise UnknownNameError("body of the model", name, names[1:], field="robot_body")
        roots = dict[int, str]()  # a joint of each
        for joint in self.base_joints + self.arm_joints:
            body = self._joints.get_body(joint)
            while model.body_parentid[body] and names[body] != name:
                body = int(model.body_parentid[body])
            roots[body] = joint
        if len(roots) == 1 and (name is None or names[min(roots)] == name):
            return min(roots)
        carried = [f"'{joint}' by '{names[body]}'" for body, joint in roots.items()]
        raise InputError(
            f"no one body carries the joints of robot '{self._robot.name}'",
            field="joints" if name is None else "robot_body",
            expected="joints of one robot",
            got=", ".join(carried),
        )

    def _fit_placement(self, data: Any) -> pin.SE3:
        """Return the placement T of the robot's base frame that its joints' axes determine.

        With the origins pᵢ and axes aᵢ of the joints in the base frame, and anchors mᵢ and axes bᵢ
        in the model, R aᵢ = bᵢ, and the line through R pᵢ + t along bᵢ contains mᵢ:
        (I − bᵢ bᵢᵀ)(R pᵢ + t − mᵢ) = 0 for each hinge.
        """
        robot = self._robot
        positions = self.read_arm(data.qpos)
        z = np.array([0.0, 0.0, 0.0, *positions.values()])
        kinematics = robot.model.createData()
        pin.forwardKinematics(robot.model, kinematics, robot.coordinates.q(z))
        anchors = list[Floats]()
        axes = list[Floats]()
        for joint in robot.coordinates.joints[3:]:
            placement = kinematics.oMi[joint]
            subspace = np.asarray(kinematics.joints[joint].S, float).ravel()
            slides = not subspace[3:].any()
            axes.append(placement.rotation @ (subspace[:3] if slides else subspace[3:]))
            anchors.append(np.array(placement.translation))
        numbers = [self._joints.get_number(name) for name in self.arm_joints]
        model_axes = np.array([data.xaxis[number] for number in numbers])
        model_anchors = np.array([data.xanchor[number] for number in numbers])
        is_hinge = np.array([unit == "rad" for unit in robot.coordinates.units[3:]])
        rotation = self._fit_rotation(np.array(axes), model_axes)
        rotated = np.array(anchors) @ rotation.T
        projections = np.eye(3) - model_axes[:, :, None] * model_axes[:, None, :]
        rows = projections[is_hinge].reshape(-1, 3)
        gaps = np.einsum("kij,kj->ki", projections, model_anchors - rotated)[is_hinge].ravel()
        translation, _, rank, _ = np.linalg.lstsq(rows, gaps, rcond=_LEAST_SINGULAR)
        if rank < 3:
            raise self._make_undetermined_error()
        directions = np.linalg.norm(np.array(axes) @ rotation.T - model_axes, axis=1)
        offsets = np.einsum("kij,kj->ki", projections, rotated + translation - model_anchors)
        distances = np.where(is_hinge, np.linalg.norm(offsets, axis=1), 0.0)
        self._check_axes(distances, directions)
        return pin.SE3(rotation, translation)

    def _fit_rotation(self, axes: Floats, model_axes: Floats) -> Floats:
        """Return the rotation that turns axes, shape (k, 3), into those of the model best."""
        left, values, right = np.linalg.svd(model_axes.T @ axes)
        # Two axes that are not parallel determine a rotation.
        if len(axes) < 2 or values[1] < _LEAST_SINGULAR * values[0]:
            raise self._make_undetermined_error()
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        return np.asarray(left @ flip @ right)

    def _make_undetermined_error(self) -> InputError:
        return InputError(
            f"the axes of robot '{self._robot.name}' do not determine where its base is",
            field="robot",
            expected="hinges with axes that are not parallel",
            got=", ".join(self.arm_joints),
        )

    def _check_axes(self, distances: Floats, directions: Floats) -> None:
        """Check that all joints of the model are where the robot's description has them."""
        worst = int(np.argmax(np.maximum(distances, directions)))
        if max(distances[worst], directions[worst]) <= _AXIS_TOLERANCE:
            return
        coordinate = self._robot.coordinates.names[3:][worst]
        raise InputError(
            f"the model's robot is not '{self._robot.name}', or `joints` maps its joints wrongly: "
            f"joint '{self.arm_joints[worst]}' is not where '{coordinate}' is",
            field="robot",
            expected=f"axes that agree within {1e3 * _AXIS_TOLERANCE:g} mm and mrad",
            got=f"{1e3 * distances[worst]:.1f} mm, {1e3 * directions[worst]:.1f} mrad",
        )
