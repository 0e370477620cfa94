"""Computes finger positions from the hand's shapes, and checks the opening of the gripper."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import coal
import numpy as np

from .plan import Hold, Violation
from .poses import IDENTITY
from .scene_objects import Grasp, Robot
from .supports import compute_distance

if TYPE_CHECKING:
    from .stage import World

__all__ = ["Fingers", "check_openings", "get_required_opening"]

THICKNESS = 2e-3  # [m] of the bar between the fingers that measures openings
TOLERANCE = 2e-4  # [m] of openings
WIDEST = 0.5  # [m]: no hand opens wider


class Fingers:
    """The gripper of a robot; a rigid gripper has no joints."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.joints = robot, list(robot.gripper)
        self.joints_by_opening: dict[float | None, dict[str, float]] = {
            None: {joint: robot.locked[joint] for joint in self.joints}
        }
        hand = [
            link
            for link, joints in robot.planned_joints.items()
            if joints == robot.planned_joints[robot.tool]
        ]
        self.shapes = [shape for shape in robot.tree.urdf.shapes if shape.link in hand]
        if self.joints:
            self.min_opening, self.max_opening, self.rest_opening = (
                self.measure_opening(joints)
                for joints in (
                    self.interpolate_joints(0.0),
                    self.interpolate_joints(1.0),
                    self.joints_by_opening[None],
                )
            )

    def interpolate_joints(self, share: float) -> dict[str, float]:
        """Return the joints' values between closed (0) and open (1)."""
        return {
            joint: (1.0 - share) * closed + share * open_
            for joint, (closed, open_) in self.robot.gripper.items()
        }

    def has_space_for(self, width: float, joints: dict[str, float]) -> bool:
        """Return whether a bar of a width fits between the fingers, along the tool's x axis."""
        bar, robot = coal.Box(width, THICKNESS, THICKNESS), self.robot
        links = robot.tree.compute_links(
            {**robot.locked, **joints},
            None,
            sorted({robot.tool, *(shape.link for shape in self.shapes)}),
        )
        tool = links[robot.tool].inverse()
        return all(
            compute_distance(shape.solid, tool @ links[shape.link] @ shape.placement, bar, IDENTITY)
            > 0.0
            for shape in self.shapes
        )

    def measure_opening(self, joints: dict[str, float]) -> float:
        """Return the width of the widest bar between the fingers [m]."""
        low, high = 0.0, WIDEST
        while high - low > 1e-5:
            middle = (low + high) / 2
            low, high = (middle, high) if self.has_space_for(middle, joints) else (low, middle)
        return low

    def clip_opening(self, opening: float | None) -> float | None:
        """Return an opening clipped to the range of the fingers [m]."""
        return (
            None
            if opening is None or not self.joints
            else float(np.clip(opening, self.min_opening, self.max_opening))
        )

    def find_joints(self, opening: float | None) -> dict[str, float]:
        """Return the joints' values at an opening [m]; None: at rest."""
        if opening not in self.joints_by_opening:
            low, high = 0.0, 1.0
            if (
                self.has_space_for(max(float(opening), 1e-6), self.interpolate_joints(0.0))
                or opening <= self.min_opening
            ):
                high = 0.0
            while high - low > 1e-7:
                middle = (low + high) / 2
                low, high = (
                    (low, middle)
                    if self.has_space_for(float(opening), self.interpolate_joints(middle))
                    else (middle, high)
                )
            self.joints_by_opening[opening] = self.interpolate_joints(high)
        return self.joints_by_opening[opening]


def get_required_opening(world: World, hold: Hold) -> float | None:
    """Return the opening that a grasp requires [m]; None: at rest."""
    grasp: Grasp = world.get_grasp(hold)
    return world.fingers.clip_opening(grasp.opening)


def check_openings(world: World) -> Iterator[Violation]:
    """Check that the gripper has the opening of the attachment, during a grasp and before it."""
    plan, fingers = world.plan, world.fingers
    for number, phase in enumerate(plan.phases):
        next_holds = plan.phases[number + 1].holds if number + 1 < len(plan.phases) else ()
        hold = next((hold for hold in (*phase.holds, *next_holds) if hold.by is None), None)
        if hold is None or not fingers.joints:
            continue
        actual, required = (
            fingers.rest_opening if opening is None else opening
            for opening in (phase.opening, get_required_opening(world, hold))
        )
        if abs(actual - required) > TOLERANCE:
            detail = f"{1e3 * actual:.1f} mm instead of {1e3 * required:.1f} mm"
            subject, time = f"{hold.object}.{hold.attachment}", float(plan.times[phase.first])
            yield Violation("opening", subject, time, abs(actual - required), detail)
