"""Loads MuJoCo on demand, and defines physical settings that complete the descriptions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arguments import check_bool, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.world.models.dynamics import compute_solid_inertia
from vkc_pin.world.trajectory.world_model import World

# [kg] up to which a body counts as massless
_NO_MASS = 1e-9
# [kg] of bodies with neither mass nor collision shape
_LEAST_MASS = 1e-3
# [m²] smallest moment of inertia per mass: (1 mm)²
_LEAST_INERTIA = 1e-6
# largest correction of an inertia that is not reported, relative
_ROUNDING = 0.05
# Smallest and largest settings. Shorter time steps and longer waits take hours and gigabytes;
# longer time steps miss contacts; beyond the others the integration breaks down at once.
_RANGES = {
    "timestep": (1e-4, 0.01),
    "settle": (0.0, 60.0),
    "arm_bandwidth": (1e-3, 1e7),
    "base_bandwidth": (1e-3, 1e7),
    "damping_ratio": (0.0, 100.0),
    "revolute_damping": (0.0, 1e6),
    "prismatic_damping": (0.0, 1e6),
    "density": (1e-3, 1e5),
    "friction": (0.0, 100.0),
    "rolling_friction": (0.0, 1.0),
    "grasp_force": (1e-6, 1e9),
    "grasp_torque": (1e-6, 1e9),
    "grasp_stiffness": (1.0, 1e9),
    "grasp_turning_stiffness": (0.1, 1e9),
    "closing_force": (1e-6, 1e6),
    "grip_time": (1e-3, 60.0),
    "latch_play": (0.0, 10.0),
}


@dataclass(frozen=True, kw_only=True)
class Physics:
    """Settings of a simulation.

    Attributes:
        timestep: Integration step [s], from 1e-4 to 0.01. Grasps shorten it: to 5 ms, by friction
            to 0.5 ms.
        settle: Time at rest before and after the motion [s], at most 60.
        arm_bandwidth: Natural frequency of the arm's and fingers' position servos, for the largest
            inertia that each moves along the plan [rad/s]. The default is about 6 Hz, as position
            interfaces of industrial arms reach.
        base_bandwidth: Natural frequency of the base's servos [rad/s].
        damping_ratio: Damping ratio of all servos; 1 does not overshoot.
        revolute_damping: Damping of objects' revolute joints whose URDF states none [N·m·s/rad].
        prismatic_damping: Damping of objects' prismatic joints whose URDF states none [N·s/m].
        density: Density of links without a mass, in the volume of their collision shapes [kg/m³].
            The default suits hollow furniture.
        friction: Coulomb friction coefficient between any two surfaces.
        rolling_friction: Coefficient of rolling friction of spheres [m]: the distance by which the
            reaction leads the centre, a thirtieth of the radius of a rubber ball. Without it, a
            ball that is put down never comes to rest.
        grasp_force: Force, averaged over 20 ms, above which a hand loses its hold [N]. A parallel
            gripper that closes with 235 N holds 2 · 0.6 · 235 N by its rubber pads.
        grasp_torque: Torque, averaged over 20 ms, above which a hand loses its hold [N·m].
        grasp_stiffness: Stiffness of a hand against displacements of the object [N/m].
        grasp_turning_stiffness: Stiffness against rotations [N·m/rad]. The default is that of a
            strain wave gear of a wrist; fingers with rubber pads yield more.
        closing_force: Force of each finger in grasps by friction [N]; a lower effort limit in the
            URDF takes precedence.
        grip_time: Time that fingers take to close or open in grasps by friction [s].
        balanced: Whether springs balance the weight of doors, lids and levers, so that joints of
            fixed objects stay where they are, as in plans. Loads on them are not balanced.
        latch_play: How far the releasing joint of a latch may stay below its stated threshold [rad]
            or [m].

    Raises:
        InputError: A value is not a number or out of range.
    """

    timestep: float = 0.002
    settle: float = 0.5
    arm_bandwidth: float = 40.0
    base_bandwidth: float = 20.0
    damping_ratio: float = 1.0
    revolute_damping: float = 0.1
    prismatic_damping: float = 1.0
    density: float = 300.0
    friction: float = 0.8
    rolling_friction: float = 1e-3
    grasp_force: float = 280.0
    grasp_torque: float = 30.0
    grasp_stiffness: float = 1e6
    grasp_turning_stiffness: float = 1e4
    closing_force: float = 235.0
    grip_time: float = 0.6
    balanced: bool = True
    latch_play: float = 0.02

    def __post_init__(self) -> None:
        for item in fields(self):
            name = item.name
            if name == "balanced":
                check_bool(self.balanced, "Physics.balanced")
                continue
            low, high = _RANGES[name]
            expected = f"a number from {low:g} to {high:g}"
            stated = getattr(self, name)
            value = check_number(stated, f"Physics.{name}", expected, low=low, high=high)
            object.__setattr__(self, name, value)


def import_mujoco() -> Any:
    """Return the package `mujoco`."""
    return import_optional("mujoco", "sim", purpose="simulating")


def complete_inertias(world: World, physics: Physics) -> list[str]:
    """Give every body a mass and a physically possible inertia; return one note per assumption."""
    tree = world.model
    notes: list[str] = []
    estimated: list[str] = []
    for j in range(1, tree.njoints):
        inertia = tree.inertias[j]
        name = str(tree.names[j])
        if inertia.mass <= _NO_MASS:
            solids = [shape for shape in world.bodies.geometryObjects if shape.parentJoint == j]
            if solids:
                estimated.append(name)
            inertia = _estimate_inertia(solids, physics.density)
        tensor, increase = _make_inertia_possible(inertia)
        if increase > _ROUNDING:
            notes.append(
                f"the inertia of {name} is physically impossible: "
                f"its moments are increased by {100.0 * increase:.0f} %"
            )
        tree.inertias[j] = pin.Inertia(inertia.mass, inertia.lever, tensor)
    if estimated:
        assumed = f"assumed {physics.density:g} kg/m³ in the volume of the collision shapes"
        notes.append(f"no valid mass is stated for {', '.join(estimated)}: {assumed}")
    return notes


def _estimate_inertia(solids: Sequence[pin.GeometryObject], density: float) -> pin.Inertia:
    """Return the inertia of a massless body from its collision shapes, at a density [kg/m³]."""
    moment = 1e3 * _LEAST_INERTIA * _LEAST_MASS
    inertia = pin.Inertia(_LEAST_MASS, np.zeros(3), moment * np.eye(3))
    for solid in solids:
        inertia += solid.placement.act(compute_solid_inertia(solid, density))
    return inertia


def _make_inertia_possible(inertia: pin.Inertia) -> tuple[Floats, float]:
    """Return the nearest possible inertia [kg·m²], shape (3, 3), and the relative increase.

    The largest principal moment of a body is at most the sum of the two others. Adding a to all
    three moments reduces the excess over this sum by a, and leaves the axes as they are. The
    increase counts as 0 where a moment is not positive.
    """
    tensor = np.asarray(inertia.inertia)
    smallest, middle, largest = np.linalg.eigvalsh(tensor).tolist()
    excess = largest - smallest - middle
    shortfall = _LEAST_INERTIA * inertia.mass - smallest
    added = max(0.0, excess, shortfall) * (1.0 + 1e-6)
    increase = added / max(largest, 1e-12) if smallest > 0.0 else 0.0
    return tensor + added * np.eye(3), increase
