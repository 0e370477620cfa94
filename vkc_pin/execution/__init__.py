"""Executes plans on robots in a closed loop: monitors, plans again, brakes."""

from typing import TYPE_CHECKING, Any

from vkc_pin.execution.loop import execute
from vkc_pin.execution.monitor import Monitor
from vkc_pin.execution.record import Cycle, ExecutionResult
from vkc_pin.execution.robots import IdealRobot, LocalisedRobot, Robot
from vkc_pin.world.trajectory.robot_state import RobotState

if TYPE_CHECKING:
    from vkc_pin.simulation.robot import SimulatedRobot

__all__ = [
    "Cycle",
    "ExecutionResult",
    "IdealRobot",
    "LocalisedRobot",
    "Monitor",
    "Robot",
    "RobotState",
    "SimulatedRobot",
    "execute",
]


def __getattr__(name: str) -> Any:
    if name == "SimulatedRobot":  # loads the simulation on first use
        from vkc_pin.simulation.robot import SimulatedRobot

        return globals().setdefault(name, SimulatedRobot)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name)
