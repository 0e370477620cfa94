"""Executes plans in physics with MuJoCo."""

from vkc_pin.simulation.contacts import Contact
from vkc_pin.simulation.execution import simulate
from vkc_pin.simulation.goals import Miss
from vkc_pin.simulation.mujoco_motion import MujocoMotion
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.result import SimulationResult, Tracking
from vkc_pin.simulation.welds import Grip

__all__ = [
    "Contact",
    "Grip",
    "Miss",
    "MujocoMotion",
    "Physics",
    "SimulationResult",
    "Tracking",
    "simulate",
]
