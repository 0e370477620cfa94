"""MuJoCo, which simulating needs and planning does not, and what it assumes where descriptions say nothing."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arguments import flag, number
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import optional_package
from vkc_pin.world.models.dynamics.mass import compute_solid_inertia
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Physics", "engine", "weigh"]

_NO_MASS, _LEAST_MASS = (
    1e-9,
    1e-3,
)  # [kg] up to which a body counts as none that is stated; of bodies without mass or shape
_LEAST_INERTIA = 1e-6  # of any body, as a share of its mass [m²]: (1 mm)²
_ROUNDED = 0.05  # of the largest moment of inertia that is added without a word
_MAY_BE_ZERO = (
    "settle",
    "damping_ratio",
    "revolute_damping",
    "prismatic_damping",
    "friction",
    "latch_play",
)
_LONGEST = 0.01  # [s] contacts are lost between longer steps


@dataclass(frozen=True, kw_only=True)
class Physics:
    """Settings of a simulation.

    Attributes:
        timestep: Of the integration [s], at most 0.01.
        settle: For how long everything comes to rest, the robot standing still, before the motion
            and after it [s].
        arm_bandwidth: Natural frequency of the position servos of arm and fingers, for the largest
            inertia that each has to move along the plan [rad/s]; 40 are about 6 Hz, what position
            interfaces of industrial arms reach.
        base_bandwidth: The same of the base [rad/s].
        damping_ratio: Of all servos; 1 does not overshoot.
        revolute_damping: Of joints of objects whose URDF states none [N·m·s/rad].
        prismatic_damping: The same of sliding joints [N·s/m].
        density: Of links without a mass, in the volume of their collision shapes [kg/m³]: that of
            hollow furniture.
        friction: Coulomb's coefficient of sliding friction between any two surfaces.
        grasp_force: A hand that is pulled harder than this, on average over 20 ms, lets go [N]. A
            parallel gripper that closes with 235 N holds 2 · 0.6 · 235 N by its rubber pads.
        grasp_torque: The same of a torque [N·m].
        closing_force: Of each finger where hands hold by friction [N]; fingers whose URDF states
            less effort have that.
        grip_time: How long fingers take to close or to open there [s].
        balanced: Whether springs carry the weight of doors, lids and levers, as a dishwasher's do
            and those of a door's handle: joints of what stands fixed stay where nobody moves them,
            as in plans. What is laid on them weighs all the same.
        latch_play: By how much the joint that releases a latch may fall short of where its
            description says, [rad] or [m].

    Raises:
        InputError: A value is no number, or out of range.
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
    grasp_force: float = 280.0
    grasp_torque: float = 30.0
    closing_force: float = 235.0
    grip_time: float = 0.6
    balanced: bool = True
    latch_play: float = 0.02

    def __post_init__(self) -> None:
        for item in fields(self):
            name = item.name
            if name == "balanced":
                flag(self.balanced, "Physics.balanced")
                continue
            high = _LONGEST if name == "timestep" else float("inf")
            value = number(
                getattr(self, name),
                f"Physics.{name}",
                low=0.0,
                high=high,
                above=name not in _MAY_BE_ZERO,
            )
            object.__setattr__(self, name, value)


def engine() -> Any:
    """Return the package `mujoco`.

    Raises:
        InputError: It is not installed, or cannot be imported.
    """
    return optional_package("mujoco", "sim", what="simulating")


def weigh(world: World, physics: Physics) -> list[str]:
    """Give every body of a tree a mass and an inertia that a body can have; return what was assumed, a line each.

    Args:
        world: The tree; its model is changed.
        physics: The density of what has no mass.
    """
    tree, notes, guessed = world.model, list[str](), list[str]()
    for j in range(1, tree.njoints):
        inertia, name = tree.inertias[j], str(tree.names[j])
        if inertia.mass <= _NO_MASS:
            solids = [shape for shape in world.bodies.geometryObjects if shape.parentJoint == j]
            guessed += [name] if solids else []
            inertia = pin.Inertia(
                _LEAST_MASS, np.zeros(3), 1e3 * _LEAST_INERTIA * _LEAST_MASS * np.eye(3)
            )
            for solid in solids:
                inertia += solid.placement.act(compute_solid_inertia(solid, physics.density))
        tensor, added = _possible(inertia)
        if added > _ROUNDED:
            notes.append(
                f"no body has the inertia that is stated for {name}: {100.0 * added:.0f} % are added to its moments"
            )
        tree.inertias[j] = pin.Inertia(inertia.mass, inertia.lever, tensor)
    if guessed:
        density = f"{physics.density:g} kg/m³ in the volume of the collision shapes"
        notes.append(f"no mass is stated for {', '.join(guessed)}: {density}")
    return notes


def _possible(inertia: pin.Inertia) -> tuple[Floats, float]:
    """Return the nearest inertia that a body can have [kg·m²], shape (3, 3), and what was added, as a share of the largest.

    No principal moment is larger than the two others together, but descriptions are rounded.
    """
    tensor = np.asarray(inertia.inertia)
    first, second, third = np.linalg.eigvalsh(tensor).tolist()
    added = max(0.0, third - first - second, _LEAST_INERTIA * inertia.mass - first) * (1.0 + 1e-6)
    return tensor + added * np.eye(3), added / max(third, 1e-12) if first > 0.0 else 0.0
