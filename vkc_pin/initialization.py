"""Seeds for the solver: stationary, or interpolated to configurations the planner finds itself."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.inverse_kinematics import PoseSolver
from vkc_pin.problem import TrajectoryProblem

__all__ = ["METHODS", "initialize"]

METHODS = ("interpolated", "stationary")
_SEEDS = 64  # configurations tried per goal
_TRACK = 6  # knots along a phase in which something is held


def initialize(problem: TrajectoryProblem, method: str, rng: np.random.Generator, *, count: int = 1) -> list[NDArray[np.float64]]:
    """Return up to `count` seeds z_1..z_N, each of shape (N, n), best first.

    Args:
        problem: What is to be solved.
        method: "stationary": the robot stays at its start, only the objects' joints go to their goals. "interpolated":
            straight to a configuration at each goal, found by inverse kinematics from random seeds; where something is
            held, the seed follows its motion.
        rng: Source of randomness.
        count: How many different seeds to return.
    """
    if method == "stationary":
        return [_objects(problem, np.tile(problem.start, (problem.segments, 1)))]
    return _Interpolation(problem, rng).seeds(count)


def smooth(steps: int) -> NDArray[np.float64]:
    """Return s at 1/steps, ..., 1 of the profile that starts and ends at rest, 3s² − 2s³, shape (steps,)."""
    s = np.arange(1, steps + 1) / steps
    return s * s * (3.0 - 2.0 * s)


def _objects(problem: TrajectoryProblem, z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Let the objects' joints run to their goals phase by phase."""
    begin, current = 0, problem.start.copy()
    for phase, end in zip(problem.task.phases, problem.ends, strict=True):
        for name in phase.before:
            column = problem.chain.index(name)
            goal = problem.lower[end - 1, column] if name in phase.values else current[column]
            z[begin:end, column] = current[column] + (goal - current[column]) * smooth(end - begin)
            current[column] = goal
        begin = end
    return problem.clip(z)


class _Interpolation:
    """Finds knots (goal configurations), and joins them."""

    def __init__(self, problem: TrajectoryProblem, rng: np.random.Generator) -> None:
        self.problem, self.rng = problem, rng
        self.chain = problem.chain
        self.robot = self.chain.robot.coordinates.size
        self.weights = np.ones(self.chain.size)
        self.weights[:3] = 3.0
        self.driven = [self.chain.index(name) for name in problem.task.state]
        self.objects = _objects(problem, np.tile(problem.start, (problem.segments, 1)))

    def seeds(self, count: int) -> list[NDArray[np.float64]]:
        batch = np.tile(self.problem.start, (_SEEDS, 1))[:, None, :]  # (B, knots, n), the start first
        penalty = np.zeros(len(batch))
        at = [0]
        begin = 0
        for phase, end in zip(self.problem.task.phases, self.problem.ends, strict=True):
            if phase.held:
                knots = np.unique(np.linspace(begin, end, _TRACK + 1).round().astype(int))[1:]
            else:
                knots = np.array([end])
            for knot in knots:
                z, bad = self._knot(batch[:, -1, :], int(knot), fresh=not phase.held)
                batch = np.concatenate([batch, z[:, None, :]], axis=1)
                penalty += bad
                at.append(int(knot))
            begin = end
        cost = np.sum(np.abs(np.diff(batch, axis=1)) * self.weights, axis=(1, 2)) + penalty
        chosen: list[int] = []
        for index in np.argsort(cost, kind="stable"):
            near = (np.abs(batch[index] - batch[other])[:, :3].max() < 0.15 for other in chosen)
            if not any(near):
                chosen.append(int(index))
            if len(chosen) == count:
                break
        return [self._join(batch[index], at) for index in chosen]

    def _pose_at(self, waypoint: int) -> int | None:
        poses = self.problem.transcription.structure.poses
        return next((k for k, pose in enumerate(poses) if waypoint in pose.waypoints), None)

    def _solver(self, pose: int) -> tuple[PoseSolver, pin.SE3]:
        return self.problem.transcription.pose_solvers[pose], self.problem.targets[pose]

    def _knot(self, before: NDArray[np.float64], waypoint: int, *, fresh: bool) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return configurations for a waypoint, shape (B, n), and what is wrong with each, as a cost."""
        problem, row = self.problem, waypoint - 1
        z = before.copy()
        z[:, self.driven] = self.objects[row, self.driven]
        lower, upper = problem.lower[row].copy(), problem.upper[row].copy()
        lower[self.driven] = upper[self.driven] = self.objects[row, self.driven]
        pose = self._pose_at(waypoint)
        if pose is None:
            return np.clip(z, lower, upper), np.zeros(len(z))
        solver, target = self._solver(pose)
        if fresh:
            z = self._scatter(z, pose)
        z, found = solver.solve(z, target, lower=lower, upper=upper, weights=self.weights)
        if fresh:
            z = self._unwind(z, before, lower, upper)
        depth = self._depth(z, waypoint)
        return z, 1e3 * ~found + np.where(depth > 0, 10.0 + 200.0 * depth, 0.0)

    def _scatter(self, z: NDArray[np.float64], pose: int) -> NDArray[np.float64]:
        """Put bases around the place to reach, at any heading, and arms near their present pose and home."""
        problem, rng, count = self.problem, self.rng, len(z)
        goal = self._grasp_point(pose)
        radius, angle = rng.uniform(0.4, 1.2, count), rng.uniform(-np.pi, np.pi, count)
        z = z.copy()
        z[:, 0], z[:, 1] = goal[0] + radius * np.cos(angle), goal[1] + radius * np.sin(angle)
        z[:, 2] = rng.uniform(-np.pi, np.pi, count)
        home = self.chain.robot.home
        arm = z[:, 3 : self.robot]
        arm[count // 2 :] = home
        arm += rng.normal(0.0, 0.4, arm.shape)
        return np.clip(z, problem.chain.lower, problem.chain.upper)

    def _grasp_point(self, pose: int) -> NDArray[np.float64]:
        """Return where the tool is to be when pose `pose` holds, shape (3,) [m]: the tool if it is a robot frame's."""
        name = self.problem.pose_names[pose]
        if not name.startswith("closure "):
            return np.array(self.problem.targets[pose].translation)
        placed = self.problem.scene.objects[name.removeprefix("closure ")]
        attachment = placed.object.attachments[self.problem.task.grasps[placed.name]]
        return np.array((placed.link_placement(attachment.link) * attachment.placement).translation)

    def _unwind(
        self, z: NDArray[np.float64], before: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Replace each revolute robot joint's angle by the equal one nearest to where it comes from."""
        z = z.copy()
        for column in range(2, self.robot):
            if self.chain.model.joints[self.chain.coordinates.joints[column]].shortname().startswith("JointModelP") and column > 2:
                continue
            nearest = before[:, column] + (z[:, column] - before[:, column] + np.pi) % (2 * np.pi) - np.pi
            inside = (nearest >= lower[column]) & (nearest <= upper[column])
            z[:, column] = np.where(inside, nearest, z[:, column])
        return z

    def _depth(self, z: NDArray[np.float64], waypoint: int) -> NDArray[np.float64]:
        """Return how far each configuration falls short of its margins [m], shape (B,)."""
        contacts = self.problem.contacts.evaluate(z, np.full(len(z), waypoint), reach=self.problem.options.dist_safe)
        depth = np.zeros(len(z))
        np.maximum.at(depth, contacts.waypoint, contacts.margin - contacts.distance)
        return depth

    def _join(self, knots: NDArray[np.float64], at: list[int]) -> NDArray[np.float64]:
        """Return waypoints through `knots`, shape (K, n), at waypoints `at`; where something is held, closed."""
        problem = self.problem
        z = np.empty((problem.segments, self.chain.size))
        begin = 0
        for phase, end in zip(problem.task.phases, problem.ends, strict=True):
            inside = [k for k, waypoint in enumerate(at) if begin <= waypoint <= end]
            s = np.concatenate([[0.0], smooth(end - begin)])
            xp = s[[at[k] - begin for k in inside]] if phase.held else np.array([0.0, 1.0])
            for column in range(self.chain.size):
                z[begin:end, column] = np.interp(s[1:], xp, knots[inside, column])
            begin = end
        z[:, self.driven] = self.objects[:, self.driven]
        for pose, row in enumerate(problem.transcription.structure.poses):
            if len(row.waypoints) > 1:
                rows = np.array(row.waypoints) - 1
                lower, upper = problem.lower[rows].copy(), problem.upper[rows].copy()
                lower[:, self.driven] = upper[:, self.driven] = self.objects[np.ix_(rows, self.driven)]
                solver, target = self._solver(pose)
                z[rows], _ = solver.solve(z[rows], target, lower=lower, upper=upper, weights=self.weights, iterations=6)
        return problem.clip(z)
