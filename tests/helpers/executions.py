"""Provides plans to simulate, a simulation result, and stationary motions."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pinocchio as pin

import vkc_pin as vkc
from vkc_pin.planning.plan import Plan
from vkc_pin.simulation.result import SimulationResult
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import PhaseSpan, Trajectory

__all__ = [
    "make_grasping_scene",
    "make_stationary_motion",
    "plan_door",
    "plan_drawer",
    "replace_mass",
    "simulate_drawer",
]


@cache
def plan_drawer() -> Plan:
    """Return a plan that pulls the drawer."""
    plan = vkc.plan(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 0.3})])
    assert plan.success
    return plan


@cache
def plan_door() -> Plan:
    """Return a plan that turns the door's lever and pushes it open."""
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 1.2})])
    assert plan.success
    return plan


@cache
def simulate_drawer() -> SimulationResult:
    """Return the execution of the plan that pulls the drawer."""
    return plan_drawer().simulate()


def make_grasping_scene() -> Scene:
    """Return a scene with the stick grasped."""
    return vkc.load_scene("init_1").with_held({"stick": "grip"})


def make_stationary_motion(scene: Scene, seconds: float = 1.0) -> Trajectory:
    """Return a stationary motion with the grasps of the start."""
    names = list(scene.robot.coordinates.names)
    values = scene.start.tolist()
    for hold in scene.holds:
        coordinates = scene.objects[hold.object].object.attachment(hold.attachment).coordinates
        names += [f"{hold.object}.{name}" for name in coordinates]
        values += list(hold.at)
    phase = PhaseSpan("stand", 0, 1, scene.holds)
    return Trajectory(
        tuple(names),
        np.array([0.0, seconds]),
        np.array([values, values]),
        (phase,),
        len(scene.start),
    )


def replace_mass(scene: Scene, name: str, mass: float) -> Scene:
    """Return a scene in which the last body of an object has another mass [kg] and inertia."""
    placed = scene.objects[name]
    model = pin.Model(placed.object.model)
    last = len(model.inertias) - 1
    old = model.inertias[last]
    model.inertias[last] = pin.Inertia(mass, old.lever, np.asarray(old.inertia) * mass / old.mass)
    changed = dataclasses.replace(placed, object=dataclasses.replace(placed.object, model=model))
    return dataclasses.replace(scene, objects={**scene.objects, name: changed})
