"""Records the motions of a simulated robot and of the objects around it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.simulation.reference import Reference
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World


@dataclass(frozen=True, eq=False)
class ObjectState:
    """Where an object is.

    Attributes:
        joints: Joint → value, [m] or [rad].
        placement: Placement of its base link in the world.
    """

    joints: Mapping[str, float]
    placement: pin.SE3


@dataclass(frozen=True, eq=False)
class GraspedPose:
    """Where a hand and the link that it holds are at a time.

    Attributes:
        time: [s].
        hold: The hold, without deviation.
        hand: Placement of the grasping frame in the world.
        link: Placement of the grasped link in the world.
    """

    time: float
    hold: Hold
    hand: pin.SE3
    link: pin.SE3


@dataclass(frozen=True)
class GraspForce:
    """Load on a grasp at a time: the constraint force of its weld, averaged over 20 ms.

    Attributes:
        time: [s].
        hold: The hold, without deviation.
        force: Magnitude of the force at the grasping frame [N].
        torque: Magnitude of the torque [N·m].
    """

    time: float
    hold: Hold
    force: float
    torque: float


class Recording:
    """States of a scene at times, and the loads on grasps.

    Args:
        world: The scene as one tree.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._clocks: list[float] = []
        self._rows: list[Floats] = []
        self._loads: list[Mapping[Hold, tuple[float, float]]] = []

    @property
    def times(self) -> Floats:
        """Times, shape (K,) [s]."""
        return np.array(self._clocks)

    @property
    def rows(self) -> Floats:
        """World coordinates at these times, shape (K, n)."""
        return np.array(self._rows).reshape(-1, len(self._world.start))

    def add(self, clock: float, row: Floats, loads: Mapping[Hold, tuple[float, float]]) -> None:
        """Record a state.

        Args:
            clock: Its time [s].
            row: World coordinates, shape (n,).
            loads: Active hold → force [N] and torque [N·m].
        """
        self._clocks.append(clock)
        self._rows.append(row)
        self._loads.append(loads)

    def list_grasp_forces(self) -> tuple[GraspForce, ...]:
        """Return the loads on all grasps."""
        found: list[GraspForce] = []
        for clock, loads in zip(self._clocks, self._loads, strict=True):
            for hold, (force, torque) in loads.items():
                found.append(GraspForce(clock, hold, force, torque))
        return tuple(found)

    def list_grasped_poses(self) -> tuple[GraspedPose, ...]:
        """Return the poses of hands and of the links that they hold."""
        world = self._world
        data = world.model.createData()
        found: list[GraspedPose] = []

        def get_placement(frame: str) -> pin.SE3:
            return data.oMf[world.model.getFrameId(frame)].copy()

        for clock, row, loads in zip(self._clocks, self._rows, self._loads, strict=True):
            if not loads:
                continue
            pin.framesForwardKinematics(world.model, data, world.coordinates.q(row))
            for hold in loads:
                attachment = world.scene.objects[hold.object].object.attachment(hold.attachment)
                hand = get_placement(hold.frame or world.scene.robot.tool_frame)
                link = get_placement(f"{hold.object}.{attachment.link}")
                found.append(GraspedPose(clock, hold, hand, link))
        return tuple(found)

    def make_trajectory(self, reference: Reference) -> Trajectory:
        """Return the motion in the coordinates of a reference.

        Degrees of freedom of grasps are as in the reference.

        Raises:
            InputError: Less than two states are recorded.
        """
        if len(self._clocks) < 2:
            raise InputError(
                "nothing is recorded", field="trajectory", expected="a robot that has waited"
            )
        planned = reference.make_trajectory(self._world, self.times)
        positions = np.array(planned.positions)
        rows = self.rows
        names = self._world.coordinates.names
        for column, name in enumerate(planned.names):
            if name in names:
                positions[:, column] = rows[:, names.index(name)]
        return replace(planned, positions=positions)

    def get_object_states(self, row: Floats) -> dict[str, ObjectState]:
        """Return object → its state at world coordinates, shape (n,)."""
        values = dict(zip(self._world.coordinates.names, row.tolist(), strict=True))
        found: dict[str, ObjectState] = {}
        for name, placed in self._world.scene.objects.items():
            joints = {joint: values[f"{name}.{joint}"] for joint in placed.object.coordinates.names}
            placement = placed.placement
            if placed.object.free:
                placement = self._world.get_placement(name, row)
            found[name] = ObjectState(joints, placement)
        return found
