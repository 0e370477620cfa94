"""Inverse kinematics of the arm alone, for a given base and a given state of the object.

It uses the differential inverse kinematics of Pink (https://github.com/stephane-caron/pink), with
joint limits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.inverse_kinematics import MAX_STEP
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import record_evaluations

__all__ = ["QP", "ArmKinematics"]

QP = "daqp"
"""Solver of quadratic programs, by its name in `qpsolvers`."""
_ITERATIONS = 30
_FRAME = "closure"


class ArmKinematics:
    """Closes the chain at waypoints at which a fixed object is grasped.

    Attributes:
        columns: Decided coordinates: the arm's joints, and the freedoms of its grasps.
    """

    def __init__(self, problem: TrajectoryProblem, sampler: KeyframeSampler) -> None:
        self.problem, self.sampler = problem, sampler
        chain = problem.chain
        virtual = [chain.index(name) for names in chain.virtual.values() for name in names]
        self.columns = np.array([*range(3, sampler.robot_size), *virtual], int)
        self._models: dict[int, pin.Model] = {}

    def solve(self, z: Floats, waypoint: int) -> tuple[Floats, bool]:
        """Iterate from `z`, shape (n,); return the result and whether the chain is closed."""
        import pink

        pose = self.sampler.find_pose(waypoint)
        if pose is None:
            return z, True
        model, chain = self._model(pose), self.problem.chain
        task = pink.tasks.FrameTask(
            _FRAME, position_cost=1.0, orientation_cost=1.0, lm_damping=1e-3
        )
        task.set_target(self.problem.targets[pose])
        box = _Box(self.columns, chain.lower, chain.upper, z.copy())
        configuration = pink.Configuration(model, model.createData(), chain.coordinates.q(box.z))
        for _ in range(_ITERATIONS):
            record_evaluations(1)
            if np.abs(task.compute_error(configuration)).max() < TOLERANCE:
                return box.z, True
            try:
                step = pink.solve_ik(
                    configuration, [task], 1.0, QP, damping=1e-9, limits=[box], safety_break=False
                )
            except pink.exceptions.NoSolutionFound:
                break
            box.take(step)
            configuration.update(chain.coordinates.q(box.z))
        return box.z, False

    def _model(self, pose: int) -> pin.Model:
        """Return the chain's model with a frame for a pose constraint."""
        if pose not in self._models:
            row = self.problem.transcription.structure.poses[pose]
            model = pin.Model(self.problem.chain.model)
            model.addFrame(pin.Frame(_FRAME, row.joint, row.local, pin.FrameType.OP_FRAME))
            self._models[pose] = model
        return self._models[pose]


class _Box:
    """A limit for Pink: joint limits, bounded steps, and fixed coordinates except `columns`."""

    def __init__(self, columns: Ints, lower: Floats, upper: Floats, z: Floats) -> None:
        self.columns, self.lower, self.upper, self.z = columns, lower, upper, z
        self._rows = np.vstack([np.eye(len(z)), -np.eye(len(z))])

    def take(self, step: Floats) -> None:
        """Take a step, shape (n,), without rounding errors of the solver in fixed coordinates."""
        at, z = self.columns, self.z.copy()
        z[at] = np.clip(z[at] + step[at], self.lower[at], self.upper[at])
        self.z = z

    def compute_qp_inequalities(self, configuration: Any, dt: float) -> tuple[Floats, Floats]:
        """Return G and h of G·δz ≤ h, shapes (2n, n) and (2n,)."""
        most, least = np.zeros(len(self.z)), np.zeros(len(self.z))
        at = self.columns
        most[at] = np.clip(self.upper[at] - self.z[at], 0.0, MAX_STEP)
        least[at] = np.clip(self.lower[at] - self.z[at], -MAX_STEP, 0.0)
        return self._rows, np.concatenate([most, -least])
