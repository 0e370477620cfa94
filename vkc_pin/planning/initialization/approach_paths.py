"""Finds straight approach and retreat paths of the tool at the ends of phases."""

from __future__ import annotations

from collections.abc import Sequence, Sized

import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.inverse_kinematics import PoseSolver
from vkc_pin.planning.chain.pose import PoseRow
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.task.phases import FrameGoal, Phase

_UP = np.array([0.0, 0.0, 1.0])


class ApproachPaths:
    """Finds configurations on straight approach and retreat paths.

    A path is `Options.approach` long: back along the approach direction of a grasped or released
    object, up from where an object is lifted or placed, back along the z axis of a touching frame.
    It consists of one configuration, or of none if inverse kinematics fails.

    Args:
        sampler: Keyframe sampler of the problem.
        keeps_base_fixed: Whether the base stays where it is if the arm alone can do it, as in
            narrow places. A base on wheels always stays.
    """

    def __init__(self, sampler: KeyframeSampler, *, keeps_base_fixed: bool = False) -> None:
        self.sampler = sampler
        self.problem = sampler.problem
        self.chain = sampler.chain
        self.keeps_base_fixed = keeps_base_fixed or sampler.curves is not None
        joint, local = self.chain.frame(self.chain.robot.tool_frame)
        self.joint = joint
        self.local = local
        self.solver = PoseSolver(self.chain.tree, PoseRow(joint, ()), local, self.problem.cache)

    def find_approach_start(self, z: Floats, phase: Phase) -> Floats:
        """Return the start of the approach to z, shape (n,), the end of a phase: (K, n), K ≤ 1."""
        return self._find_departure(z, phase.grasps, phase.lowered, phase.frames)

    def find_retreat_end(self, z: Floats, phase: Phase, before: Phase | None) -> Floats:
        """Return the end of the retreat from z, shape (n,), the start of a phase: (K, n), K ≤ 1."""
        frames = before.frames if before else ()
        return self._find_departure(z, phase.released, phase.lifted, frames)

    def _find_departure(
        self, z: Floats, holds: Sequence[Hold], lifted: Sized, frames: Sequence[FrameGoal]
    ) -> Floats:
        """Return the far end of the path from a grasp, a placed object or a touched point."""
        if holds:
            return self._move_back(z, self.chain.holder(holds[0]))
        if lifted:
            return self._move_tool(z, _UP)
        for goal in frames:
            if goal.touches:
                return self._move_back(z, self.chain.frame(goal.frame, goal.hold))
        return np.empty((0, len(z)))

    def find_release_retreat(self, z: Floats, phase: Phase) -> Floats:
        """Return the end of the retreat from z, shape (n,), with a fixed base: (K, n), K ≤ 1.

        The hand moves back from an object that the phase releases at its start, or up with its
        load.
        """
        if phase.released:
            return self._move_back(z, self.chain.holder(phase.released[0]), drives=False)
        if phase.held:
            return self._move_tool(z, _UP, drives=False)
        return np.empty((0, len(z)))

    def _move_back(self, z: Floats, frame: tuple[int, pin.SE3], *, drives: bool = True) -> Floats:
        """Move the tool against the approach direction, the z axis of a frame."""
        joint, local = frame
        rotations, _ = self.chain.joint_placements(z[None])
        direction = -np.asarray((rotations[0, joint] @ local.rotation)[:, 2])
        return self._move_tool(z, direction, drives=drives)

    def _move_tool(self, z: Floats, direction: Floats, *, drives: bool = True) -> Floats:
        """Move the tool by `Options.approach` along `direction`, shape (3,): (K, n), K ≤ 1."""
        rotations, translations = self.chain.joint_placements(z[None])
        tool = pin.SE3(rotations[0, self.joint], translations[0, self.joint]) * self.local
        offset = self.problem.options.approach * direction
        target = pin.SE3(tool.rotation, tool.translation + offset)
        # Only the robot moves.
        lower = z.copy()
        upper = z.copy()
        for column, name in enumerate(self.chain.names[: self.sampler.robot_size]):
            if drives or column > 2:
                lower[column], upper[column] = self.problem.limits(name)
        limits = [(lower, upper)]
        if self.keeps_base_fixed:
            lower_with_base = np.concatenate([z[:3], lower[3:]])
            upper_with_base = np.concatenate([z[:3], upper[3:]])
            limits.insert(0, (lower_with_base, upper_with_base))
        for low, high in limits:
            moved, is_reached = self.solver.solve(
                z[None],
                target,
                lower=low,
                upper=high,
                weights=self.sampler.weights,
                tolerance=TOLERANCE,
            )
            if is_reached[0]:
                return moved
        return np.empty((0, len(z)))
