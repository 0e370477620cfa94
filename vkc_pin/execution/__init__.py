"""Executes plans on robots in a closed loop: monitors, plans again, brakes."""

from vkc_pin.execution.loop import execute
from vkc_pin.execution.monitor import Monitor
from vkc_pin.execution.record import Cycle, ExecutionResult
from vkc_pin.execution.robots import IdealRobot, Robot, RobotState

__all__ = [
    "Cycle",
    "ExecutionResult",
    "IdealRobot",
    "Monitor",
    "Robot",
    "RobotState",
    "execute",
]
