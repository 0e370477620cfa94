"""Computes finger positions from the hand's shapes, and checks the gripper's opening."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import coal
import numpy as np

from .plan import Hold, Violation
from .poses import IDENTITY
from .riding import compute_distance
from .scene_objects import Grasp, Robot

if TYPE_CHECKING:
    from .stage import World

__all__ = ["Fingers", "check_openings", "get_required_opening"]

THICK = 2e-3  # [m] of the bar between the fingers by which openings are measured
SAME = 2e-4  # [m] by which openings may differ
SAFE = 0.5  # [m]: no hand opens wider


class Fingers:
    """The gripper of a robot; one that does not open has no joints."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.joints = robot, list(robot.gripper)
        self.known: dict[float | None, dict[str, float]] = {
            None: {joint: robot.locked[joint] for joint in self.joints}
        }
        hand = [
            link for link, joints in robot.moved_by.items() if joints == robot.moved_by[robot.tool]
        ]
        self.shapes = [shape for shape in robot.tree.urdf.shapes if shape.link in hand]
        if self.joints:
            self.least, self.most, self.resting = (
                self.width(at) for at in (self.share(0.0), self.share(1.0), self.known[None])
            )

    def share(self, of: float) -> dict[str, float]:
        """Return the joints' values between closed (0) and open (1)."""
        return {
            joint: (1.0 - of) * closed + of * open_
            for joint, (closed, open_) in self.robot.gripper.items()
        }

    def room(self, width: float, at: dict[str, float]) -> bool:
        """Return whether a bar of some width fits between the fingers along the tool's x axis."""
        bar, robot = coal.Box(width, THICK, THICK), self.robot
        links = robot.tree.links(
            {**robot.locked, **at},
            None,
            sorted({robot.tool, *(shape.link for shape in self.shapes)}),
        )
        tool = links[robot.tool].inverse()
        return all(
            compute_distance(shape.solid, tool @ links[shape.link] @ shape.place, bar, IDENTITY)
            > 0.0
            for shape in self.shapes
        )

    def width(self, at: dict[str, float]) -> float:
        low, high = 0.0, SAFE
        while high - low > 1e-5:
            middle = (low + high) / 2
            low, high = (middle, high) if self.room(middle, at) else (low, middle)
        return low

    def near(self, asked: float | None) -> float | None:
        """Return a requested opening, clipped to the range of the fingers [m]."""
        return (
            None
            if asked is None or not self.joints
            else float(np.clip(asked, self.least, self.most))
        )

    def find_joints(self, opening: float | None) -> dict[str, float]:
        """Return the joints' values at an opening; None: at rest."""
        if opening not in self.known:
            low, high = 0.0, 1.0
            if self.room(max(float(opening), 1e-6), self.share(0.0)) or opening <= self.least:
                high = 0.0
            while high - low > 1e-7:
                middle = (low + high) / 2
                low, high = (
                    (low, middle)
                    if self.room(float(opening), self.share(middle))
                    else (middle, high)
                )
            self.known[opening] = self.share(high)
        return self.known[opening]


def get_required_opening(world: World, hold: Hold) -> float | None:
    """Return the opening that a grasp requires; None: as at rest."""
    grasp: Grasp = world.grasp(hold)
    return world.fingers.near(grasp.opening)


def check_openings(world: World) -> Iterator[Violation]:
    """Check that the gripper is as far open as the attachment says, in a grasp and before it."""
    plan, fingers = world.plan, world.fingers
    for number, phase in enumerate(plan.phases):
        later = plan.phases[number + 1].holds if number + 1 < len(plan.phases) else ()
        hold = next((hold for hold in (*phase.holds, *later) if hold.by is None), None)
        if hold is None or not fingers.joints:
            continue
        is_, right = (
            fingers.resting if one is None else one
            for one in (phase.opening, get_required_opening(world, hold))
        )
        if abs(is_ - right) > SAME:
            detail = f"{1e3 * is_:.1f} mm instead of {1e3 * right:.1f} mm"
            subject, time = f"{hold.object}.{hold.attachment}", float(plan.times[phase.first])
            yield Violation("opening", subject, time, abs(is_ - right), detail)
