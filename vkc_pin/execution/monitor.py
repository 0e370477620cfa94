"""Compares a running motion with the world and the robot as they are measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.execution.robots import RobotState
from vkc_pin.planning.plan import Plan
from vkc_pin.utils.arguments import check_number
from vkc_pin.validation.remaining import RemainingCheck
from vkc_pin.validation.report import Violation
from vkc_pin.world.scene.scene import Scene

# Displacement of an object from which on the motion to it is planned again [m], [rad]: what
# validation accepts at a grasp.
_OBJECT_TOLERANCES = (1e-3, 2e-3)


@dataclass(frozen=True)
class Finding:
    """What a monitor found.

    Attributes:
        reason: Why the motion cannot go on as planned; "" if it can.
        time: Earliest time of the motion at which something would be touched [s]; inf: never.
    """

    reason: str = ""
    time: float = np.inf


class Monitor:
    """Checks what is left of a plan's motion against the present world and robot.

    Args:
        plan: A successful plan.
        tracking: Largest accepted distance of the measured from the planned configuration, [m] and
            [rad] of each coordinate.
    """

    def __init__(self, plan: Plan, *, tracking: float = 0.02) -> None:
        plan.check_success()
        self.plan = plan
        self.tracking = check_number(tracking, "tracking", low=0.0, strict=True)
        self._check = RemainingCheck(plan.scene, plan.steps, plan.trajectory, plan.options)

    def check(self, time: float, state: RobotState | None, scene: Scene | None) -> Finding:
        """Check the motion from a time on.

        Args:
            time: Time of the motion [s].
            state: Measured state of the robot; None: not measured.
            scene: The plan's scene with what was measured since: placements of objects and of
                obstacles. None: nothing was.
        """
        if scene is not None:
            moved = self._find_moved_object(scene)
            if moved:
                return Finding(f"{moved} is elsewhere")
            violations = self._check.find_violations(scene, time)
            if violations:
                return Finding(str(violations[0].subject), _find_first_time(violations))
        if state is not None:
            return self._check_tracking(time, state)
        return Finding()

    def _find_moved_object(self, scene: Scene) -> str:
        """Return the name of an object that is not where the plan has it; "" if all are."""
        for name, placed in self.plan.scene.objects.items():
            displacement = placed.placement.actInv(scene.objects[name].placement)
            distance = float(np.linalg.norm(displacement.translation))
            angle = float(np.linalg.norm(pin.log3(displacement.rotation)))
            if distance > _OBJECT_TOLERANCES[0] or angle > _OBJECT_TOLERANCES[1]:
                return name
        return ""

    def _check_tracking(self, time: float, state: RobotState) -> Finding:
        motion = self.plan.trajectory
        planned = motion.at(time)[: motion.robot_size]
        errors = np.abs(state.positions - planned)
        worst = int(np.argmax(errors))
        if errors[worst] <= self.tracking:
            return Finding()
        coordinates = self.plan.scene.robot.coordinates
        unit = coordinates.units[worst]
        return Finding(f"{coordinates.names[worst]} is {errors[worst]:.3g} {unit} off")


def _find_first_time(violations: tuple[Violation, ...]) -> float:
    return min(violation.time for violation in violations)
