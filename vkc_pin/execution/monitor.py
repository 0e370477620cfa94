"""Compares a running motion with the world and the robot as they are measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from vkc_pin.execution.robots import RobotState
from vkc_pin.planning.plan import Plan
from vkc_pin.utils.arguments import check_number
from vkc_pin.validation.remaining import RemainingCheck
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.world_model import find_phase_at

# Displacement of an object from which on the motion to it is planned again [m], [rad]: validation
# accepts 1 mm at a grasp, and 2 mrad are 2 mm at a lever of a metre.
_TOLERANCES = (1e-3, 2e-3)
# That of free objects: a hand that is off strains no mechanism, but holds them a little elsewhere
_FREE_TOLERANCES = (3e-3, 3e-2)


class Monitor:
    """Checks the rest of a plan's motion against the present world and robot.

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

    def check_world(self, time: float, scene: Scene | None) -> tuple[str, float]:
        """Return why the world does not let the motion go on as planned; "" if it does.

        Args:
            time: Time of the motion [s].
            scene: The plan's scene with the present placements of objects and of obstacles. None:
                they are unknown.

        Returns:
            Also the time of the motion until which neither an obstacle nor an object that is
            elsewhere is too near [s]; inf without any.
        """
        if scene is None:
            return "", np.inf
        moved = self._find_moved_objects(scene)
        # Objects that are where the plan has them, to within tolerances, are there exactly.
        known = replace(scene, objects=self.plan.scene.objects)
        for name in moved:
            known = self._add_moved_object(known, scene, name, time)
        found = self._check.check(known, time)
        if moved:
            return f"{moved[0]} is elsewhere", found.clear_until
        if found.violations:
            return found.violations[0].subject, found.clear_until
        return "", np.inf

    def _add_moved_object(self, known: Scene, scene: Scene, name: str, time: float) -> Scene:
        """Return a scene that has a displaced object among its obstacles, unless the hand holds it.

        Args:
            known: Scene to which it is added.
            scene: Scene that has it where it is.
            name: The object.
            time: Time of the motion [s].
        """
        holds = find_phase_at(self.plan.trajectory, time).holds
        if name in [hold.object for hold in holds]:
            return known
        state = self.plan.scene_at(time).objects[name].state
        shapes = make_world_shapes(replace(scene.objects[name], state=state))
        return replace(
            known,
            obstacles=(*known.obstacles, *shapes),
            obstacle_labels=(*known.obstacle_labels, *[name] * len(shapes)),
        )

    def check_tracking(self, time: float, state: RobotState) -> str:
        """Return how the robot is off its motion at a time of the motion [s]; "" if it is not."""
        motion = self.plan.trajectory
        errors = np.abs(state.positions - motion.at(time)[: motion.robot_size])
        worst = int(np.argmax(errors))
        if errors[worst] <= self.tracking:
            return ""
        coordinates = self.plan.scene.robot.coordinates
        unit = coordinates.units[worst]
        return f"{coordinates.names[worst]} is {errors[worst]:.3g} {unit} off"

    def _find_moved_objects(self, scene: Scene) -> list[str]:
        """Return the names of the objects that are not where the plan has them."""
        moved = list[str]()
        for name, placed in self.plan.scene.objects.items():
            displacement = placed.placement.actInv(scene.objects[name].placement)
            distance = float(np.linalg.norm(displacement.translation))
            angle = float(np.linalg.norm(pin.log3(displacement.rotation)))
            most, most_angle = _FREE_TOLERANCES if placed.object.free else _TOLERANCES
            if distance > most or angle > most_angle:
                moved.append(name)
        return moved
