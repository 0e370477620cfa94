"""Straight paths in and out: a hand nears what it grasps, and a stick what it touches, from where there is room."""

from __future__ import annotations

from collections.abc import Sequence, Sized

import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.inverse_kinematics import PoseSolver
from vkc_pin.planning.chain.pose import PoseRow
from vkc_pin.planning.initialization.keyframes import Knots
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.task.phases import FrameGoal, Phase

__all__ = ["Approach"]

_UP = np.array([0.0, 0.0, 1.0])


class Approach:
    """Finds configurations on straight paths to and from the ends of a problem's phases.

    A path is the tool's, `Options.approach` long: back along its approach for what it grasps or
    lets go of, up for what is lifted or put down, back along the frame's z axis for what a frame
    touches. It is one configuration, or none where none is found.

    Args:
        knots: Of the problem.
        stands: Whether the base stands still meanwhile, as long as the arm alone can do it: in
            narrow places it has no room. One on wheels always does.
    """

    def __init__(self, knots: Knots, *, stands: bool = False) -> None:
        self.knots, self.problem, self.chain, self.stands = (
            knots,
            knots.problem,
            knots.chain,
            stands or knots.curves is not None,
        )
        joint, local = self.chain.frame(self.chain.robot.tool_frame)
        self.joint, self.local = joint, local
        model, cache = self.chain.model, self.problem.cache
        key = ("tool", model.saveToString(), joint, local.homogeneous.tobytes())
        self.solver = cache.get(key, lambda: PoseSolver(model, PoseRow(joint, local, ()), cache))

    def before(self, z: Floats, phase: Phase) -> Floats:
        """Return where the path to `z`, shape (n,), a phase's end, begins: shape (K, n), K is 1 or 0."""
        return self._leaving(z, phase.grasps, phase.lowered, phase.frames)

    def after(self, z: Floats, phase: Phase, before: Phase | None) -> Floats:
        """Return where the path from `z`, shape (n,), a phase's start, leads: shape (K, n), K is 1 or 0."""
        return self._leaving(z, phase.released, phase.lifted, before.frames if before else ())

    def _leaving(
        self, z: Floats, holds: Sequence[Hold], lifted: Sized, frames: Sequence[FrameGoal]
    ) -> Floats:
        """Return where the path away from a grasp, from where something stands, or from what a frame touches, leads."""
        if holds:
            return self._retreat(z, -self._ahead(z, self.chain.holder(holds[0])))
        if lifted:
            return self._retreat(z, _UP)
        for goal in frames:
            if goal.touches:
                return self._retreat(z, -self._ahead(z, self.chain.frame(goal.frame, goal.hold)))
        return np.empty((0, len(z)))

    def away(self, z: Floats, phase: Phase) -> Floats:
        """Return the configuration to which the path leads from `z`, shape (n,), the base where it is: shape (K, n), K is 1 or 0.

        The hand goes back from what a phase lets go of at its start, or up with what is carried in
        it.
        """
        if phase.released:
            return self._retreat(
                z, -self._ahead(z, self.chain.holder(phase.released[0])), drives=False
            )
        return self._retreat(z, _UP, drives=False) if phase.held else np.empty((0, len(z)))

    def _ahead(self, z: Floats, frame: tuple[int, pin.SE3]) -> Floats:
        """Return the direction of a frame's z axis in the world, at `z`: in it a hand nears what it grasps."""
        joint, local = frame
        rotations, _ = self.chain.joint_placements(z[None])
        return np.asarray((rotations[0, joint] @ local.rotation)[:, 2])

    def _retreat(self, z: Floats, direction: Floats, *, drives: bool = True) -> Floats:
        """Return a configuration, the tool `Options.approach` further along `direction`: shape (K, n), K is 1 or 0."""
        rotations, translations = self.chain.joint_placements(z[None])
        carrier = pin.SE3(rotations[0, self.joint], translations[0, self.joint])
        tool = carrier * self.local
        target = pin.SE3(
            tool.rotation, tool.translation + self.problem.options.approach * direction
        )
        lower, upper = z.copy(), z.copy()  # only the robot moves
        for column, name in enumerate(self.chain.names[: self.knots.robot]):
            if drives or column > 2:
                lower[column], upper[column] = self.problem.limits(name)
        standing = np.concatenate([z[:3], lower[3:]]), np.concatenate([z[:3], upper[3:]])
        for low, high in (standing, (lower, upper)) if self.stands else ((lower, upper),):
            near, ok = self.solver.solve(
                z[None],
                target,
                lower=low,
                upper=high,
                weights=self.knots.weights,
                tolerance=TOLERANCE,
            )
            if ok[0]:
                return near
        return np.empty((0, len(z)))
