"""Seeds for the solver: stationary, or interpolated to configurations the planner finds itself."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.inverse_kinematics import PoseSolver
from vkc_pin.problem import TrajectoryProblem

__all__ = ["METHODS", "initialize", "scatter"]

METHODS = ("interpolated", "stationary")
_SCATTER = 192  # random seeds for a configuration that nothing leads to
_BEAM, _QUICK_BEAM, _CHILDREN = 40, 24, 4  # configurations kept per knot, and tried from each for the next
_SPACING = 4  # waypoints between knots along a phase in which something is held
_APPROACH = 6  # configurations looked at on the way to a grasp
_EASY = 0.5  # share of the beam that must go on freely for a knot to be easy
_COLLISION, _DEPTH = 10.0, 300.0  # what a collision costs, and a metre of its depth, beside radians of motion
_TOLERABLE = 60.0  # what the solver may be left to push apart: a graze or two
_DIFFERENT = 0.1  # [m] and [rad] by which the base must differ somewhere between two seeds
_NOT_FOUND = 1e3
_CHOICE = 0.1  # what it costs to grasp elsewhere, beside radians of motion
_ROUGH = 1e-4  # [m] and [rad], of knots; what is joined from them is exact


def initialize(
    problem: TrajectoryProblem, method: str, rng: np.random.Generator, *, count: int = 1
) -> Iterator[NDArray[np.float64]]:
    """Yield up to `count` seeds z_1..z_N, each of shape (N, n), best first; each is looked for when it is asked for.

    Args:
        problem: What is to be solved.
        method: "stationary": the robot stays at its start, only the objects' joints go to their goals. "interpolated":
            straight to a configuration at each goal, found by inverse kinematics from random seeds; where something is
            held, the seed follows its motion.
        rng: Source of randomness.
        count: How many different seeds to return.
    """
    if method == "stationary":
        return iter([_objects(problem, np.tile(problem.start, (problem.segments, 1)))])
    return _Interpolation(problem, rng).seeds(count)


def scatter(
    problem: TrajectoryProblem, waypoint: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return random configurations that try to be at the goal of `waypoint`, shape (B, n), and their residuals, shape (B,).

    None if there is neither a pose to reach nor a place for the base there.
    """
    search = _Interpolation(problem, rng)
    pose, row = search.pose_at(waypoint), waypoint - 1
    z = np.tile(problem.start, (_SCATTER, 1))
    if pose is not None:
        z, _ = search.knot(z, waypoint, "scatter")
        residual, _ = problem.transcription.pose_solvers[pose].evaluate(z, problem.targets[pose])
        return z, np.abs(residual).max(axis=1)
    if (problem.lower[row, :2] < problem.upper[row, :2]).any():
        return None
    z[:, 2:] += rng.normal(0.0, 1.0, z[:, 2:].shape)
    return np.clip(z, problem.lower[row], problem.upper[row]), np.zeros(len(z))


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
        self.weights[[column for column, _, _ in problem.transcription.structure.clamped]] = _CHOICE
        self.beam = _BEAM
        self.driven = np.array([self.chain.index(name) for name in problem.task.state], int)
        self.objects = _objects(problem, np.tile(problem.start, (problem.segments, 1)))

    def seeds(self, count: int) -> Iterator[NDArray[np.float64]]:
        """Yield seeds through the cheapest paths of knots: of one quick search if that is any good, then of thorough ones."""
        given: list[NDArray[np.float64]] = []
        for attempt in range(count + 1):
            paths, cost, trouble, at = self._search(thorough=attempt > 0)
            if attempt == 0 and trouble[np.argmin(cost)] > _TOLERABLE:
                continue
            for index in np.argsort(cost, kind="stable").tolist():
                if all(np.abs(paths[index] - other)[:, :3].max() > _DIFFERENT for other in given):
                    given.append(paths[index])
                    yield self._join(paths[index], at)
                    break
            if len(given) == count:
                return

    def _search(self, *, thorough: bool) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], list[int]]:
        """Go from knot to knot, keeping the cheapest paths: a beam search on the closure's manifold.

        Returns:
            Paths, shape (B, knots, n), what each costs and how much of that is for collisions, shape (B,), and the knots.
        """
        self.beam = _BEAM if thorough else _QUICK_BEAM
        problem = self.problem
        paths = problem.start[None, None, :]
        cost, trouble = np.zeros(1), np.zeros(1)
        at, begin = [0], 0
        for phase, end in zip(problem.task.phases, problem.ends, strict=True):
            closed = problem.closed(phase)
            pieces = max(1, round((end - begin) / _SPACING)) if closed else 1
            for knot in np.linspace(begin, end, pieces + 1).round().astype(int)[1:].tolist():
                parents, z, bad = self._continue(paths, cost, knot, fresh=not closed, thorough=thorough)
                total = cost[parents] + np.abs(z - paths[parents, -1]) @ self.weights + bad
                best = np.argsort(total, kind="stable")[: self.beam]
                paths = np.concatenate([paths[parents[best]], z[best, None]], axis=1)
                cost, trouble = total[best], (trouble[parents] + bad)[best]
                at.append(knot)
            if not closed:
                cost = cost + self._approach(paths[:, -2], paths[:, -1], begin, end)
            begin = end
        return paths, cost, trouble, at

    def _continue(
        self, paths: NDArray[np.float64], cost: NDArray[np.float64], waypoint: int, *, fresh: bool, thorough: bool
    ) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64]]:
        """Return continuations of `paths` to a waypoint: which path each goes on from, where to, and what is wrong there."""
        if fresh:
            parents = np.arange(_SCATTER if thorough else _SCATTER // 2) % len(paths)
            z, found = self.knot(paths[parents, -1], waypoint, "scatter")
        else:
            parents = np.arange(len(paths))
            z, found = self.knot(paths[:, -1], waypoint, "track")
            if not thorough:
                bad = self._bad(z, found, waypoint)
                if np.count_nonzero(bad == 0) >= _EASY * len(paths):
                    return parents, z, bad
            more = np.arange(self.beam * _CHILDREN - len(paths)) % len(paths)
            shaken, also = self.knot(paths[more, -1], waypoint, "shake")
            parents, z, found = np.concatenate([parents, more]), np.concatenate([z, shaken]), np.concatenate([found, also])
        # The cheapest first; what the beam cannot keep anyway need not be looked at.
        price = cost[parents] + np.abs(z - paths[parents, -1]) @ self.weights + _NOT_FOUND * ~found
        order = np.argsort(price, kind="stable")
        parents, z, found = parents[order], z[order], found[order]
        half = min(2 * self.beam, len(z))
        bad = self._bad(z[:half], found[:half], waypoint)
        if np.count_nonzero(bad == 0) >= self.beam:
            return parents[:half], z[:half], bad
        return parents, z, np.concatenate([bad, self._bad(z[half:], found[half:], waypoint)])

    def _bad(self, z: NDArray[np.float64], found: NDArray[np.bool_], waypoint: int) -> NDArray[np.float64]:
        """Return what is wrong with configurations at a waypoint, as a cost, shape (B,)."""
        bad = np.full(len(z), _NOT_FOUND)
        if found.any():
            depth = self._depth(z[found], waypoint)
            bad[found] = np.where(depth > 0, _COLLISION + _DEPTH * depth, 0.0)
        return bad

    def _approach(self, first: NDArray[np.float64], last: NDArray[np.float64], begin: int, end: int) -> NDArray[np.float64]:
        """Return what the straight ways from `first` to `last`, both (B, n), cost in collisions, shape (B,)."""
        s = np.arange(1, _APPROACH) / _APPROACH
        between = first[:, None] + s[:, None] * (last - first)[:, None]
        depth = self._depth(between.reshape(-1, between.shape[-1]), min(begin + 1, end))
        return np.sum(np.where(depth > 0, 1.0 + _DEPTH / _APPROACH * depth, 0.0).reshape(len(first), -1), axis=1)

    def pose_at(self, waypoint: int) -> int | None:
        """Return the pose that must hold at a waypoint, if any."""
        poses = self.problem.transcription.structure.poses
        return next((k for k, pose in enumerate(poses) if waypoint in pose.waypoints), None)

    def _solver(self, pose: int) -> tuple[PoseSolver, pin.SE3]:
        return self.problem.transcription.pose_solvers[pose], self.problem.targets[pose]

    def knot(self, before: NDArray[np.float64], waypoint: int, how: str) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return configurations for a waypoint, shape (B, n), and which of them are what must hold there.

        Args:
            before: What they come from, shape (B, n).
            waypoint: Where they are to be.
            how: "scatter": from anywhere; "track": the nearest ones; "shake": from there with the arms shaken, so that the
                search can leave a way that is closing.
        """
        problem, row = self.problem, waypoint - 1
        z = before.copy()
        z[:, self.driven] = self.objects[row, self.driven]
        lower, upper = np.tile(problem.lower[row], (len(z), 1)), np.tile(problem.upper[row], (len(z), 1))
        lower[:, self.driven] = upper[:, self.driven] = self.objects[row, self.driven]
        for column, first, last in problem.transcription.structure.clamped:
            if first < waypoint <= last:
                lower[:, column] = upper[:, column] = before[:, column]
        pose = self.pose_at(waypoint)
        if pose is None:
            return np.clip(z, lower, upper), np.ones(len(z), bool)
        solver, target = self._solver(pose)
        if how == "scatter":
            self._choose(z, waypoint)
            z = self._scatter(z, pose)
        elif how == "shake":
            z = self._shake(z, pose)
        z, found = solver.solve(z, target, lower=lower, upper=upper, weights=self.weights, tolerance=_ROUGH)
        if how == "scatter":
            z = self._unwind(z, before, lower, upper)
        return z, found

    def _choose(self, z: NDArray[np.float64], waypoint: int) -> None:
        """Grasp anywhere: draw the freedoms of what is grasped at a waypoint, in place."""
        problem = self.problem
        for hold in problem.task.phases[int(np.searchsorted(problem.ends, waypoint))].grasps:
            for column in map(self.chain.index, self.chain.virtual[hold]):
                z[:, column] = self.rng.uniform(self.chain.lower[column], self.chain.upper[column], len(z))

    def _scatter(self, z: NDArray[np.float64], pose: int) -> NDArray[np.float64]:
        """Return arms near home, nearer and further, with the base under them as `pose` needs it."""
        home = self.chain.robot.home
        spread = self.rng.uniform(0.1, 1.0, (len(z), 1))
        z = z.copy()
        z[:, 3 : self.robot] = home + spread * self.rng.normal(0.0, 1.0, (len(z), len(home)))
        return self._stand(np.clip(z, self.problem.chain.lower, self.problem.chain.upper), pose)

    def _shake(self, z: NDArray[np.float64], pose: int) -> NDArray[np.float64]:
        spread = self.rng.uniform(0.05, 0.5, (len(z), 1))
        z = z.copy()
        z[:, 3 : self.robot] += spread * self.rng.normal(0.0, 1.0, (len(z), self.robot - 3))
        return self._stand(np.clip(z, self.problem.chain.lower, self.problem.chain.upper), pose)

    def _stand(self, z: NDArray[np.float64], pose: int) -> NDArray[np.float64]:
        """Move the bases so that pose `pose` fits in place and heading; its height and tilt are left to the arm.

        A base motion multiplies the frame's placement from the left, so the error T* T⁻¹, projected to the floor, is it.
        """
        row, target = self.problem.transcription.structure.poses[pose], self.problem.targets[pose]
        rotations, translations = self.chain.joint_placements(z)
        rotation = rotations[:, row.joint] @ row.local.rotation
        translation = rotations[:, row.joint] @ row.local.translation + translations[:, row.joint]
        error = np.einsum("ij,bkj->bik", target.rotation, rotation)
        if row.kind == "pose":
            turn = np.arctan2(error[:, 1, 0] - error[:, 0, 1], error[:, 0, 0] + error[:, 1, 1])
        else:  # any heading will do
            turn = self.rng.uniform(-np.pi, np.pi, len(z))
        cos, sin = np.cos(turn), np.sin(turn)
        planar = np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)
        z = z.copy()
        z[:, :2] = target.translation[:2] + np.einsum("bij,bj->bi", planar, z[:, :2] - translation[:, :2])
        z[:, 2] += turn
        return z

    def _unwind(
        self, z: NDArray[np.float64], before: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Replace each revolute robot joint's angle by the equal one nearest to where it comes from."""
        z = z.copy()
        for column in range(2, self.robot):
            if self.problem.unit(self.chain.names[column]) == "m":
                continue
            nearest = before[:, column] + (z[:, column] - before[:, column] + np.pi) % (2 * np.pi) - np.pi
            inside = (nearest >= lower[:, column]) & (nearest <= upper[:, column])
            z[:, column] = np.where(inside, nearest, z[:, column])
        return z

    def _depth(self, z: NDArray[np.float64], waypoint: int) -> NDArray[np.float64]:
        """Return how far each configuration falls short of its margins [m], shape (B,)."""
        margin = self.problem.options.dist_safe
        contacts = self.problem.contacts.evaluate(z, np.full(len(z), waypoint), reach=margin, nearest=1)
        return contacts.shortfall(len(z))

    def _join(self, knots: NDArray[np.float64], at: list[int]) -> NDArray[np.float64]:
        """Return waypoints through `knots`, shape (K, n), at waypoints `at`; where something is held, closed."""
        problem = self.problem
        z = np.empty((problem.segments, self.chain.size))
        begin = 0
        for phase, end in zip(problem.task.phases, problem.ends, strict=True):
            inside = [k for k, waypoint in enumerate(at) if begin <= waypoint <= end]
            s = np.concatenate([[0.0], smooth(end - begin)])
            xp = s[[at[k] - begin for k in inside]] if problem.closed(phase) else np.array([0.0, 1.0])
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
