"""Configurations that must hold at single waypoints: random ones, those next to others, and how far they are from free."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.planning.base_paths.arcs import Curves, nearest_arc
from vkc_pin.planning.chain.inverse_kinematics import PoseSolver
from vkc_pin.planning.initialization.collision_recovery import clear_out
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Bools, Floats

__all__ = ["ALIKE", "SCATTER", "Knots", "Known", "depth", "follow_objects", "scatter", "smooth"]

ALIKE = 0.1  # [m] and [rad] up to which configurations are alike: from both the same follows
SCATTER = 192  # random seeds of inverse kinematics for a configuration that nothing leads to


class Known:
    """What searches of one problem have found out: with the same random numbers they begin with the same configurations.

    Attributes:
        drawn: From the state of the random numbers, a waypoint and what configurations come from to
            these, which of them are what must hold there, and the state that follows.
        depths, cleared: From a waypoint and a configuration to how far that falls short, and to
            what it is when pushed.
    """

    def __init__(self) -> None:
        self.drawn: dict[tuple[str, int, bytes], tuple[Floats, Bools, Any]] = {}
        self.depths: dict[tuple[int, bytes], Floats] = {}
        self.cleared: dict[tuple[int, bytes], Floats] = {}


_Found = dict[tuple[int, bytes], Floats]


def _row_by_row(
    known: _Found, find: Callable[[Floats, int], Floats], z: Floats, waypoint: int
) -> Floats:
    """Return `find(z, waypoint)`, each row of which belongs to one of z; rows that are known are not asked for again."""
    keys = [(waypoint, row.tobytes()) for row in z]
    new = [k for k, key in enumerate(keys) if key not in known]
    if len(new) == len(z):
        found = find(z, waypoint)
        known.update(zip(keys, found, strict=True))
        return found
    if new:
        known.update(zip((keys[k] for k in new), find(z[new], waypoint), strict=True))
    return np.array([known[key] for key in keys])


class Knots:
    """Draws configurations for waypoints of a problem.

    Args:
        problem: The problem.
        rng: Random numbers.
        known: What other searches of the problem have found out; None: nothing.

    Attributes:
        problem: The problem.
        objects: The motion of the objects' joints, shape (N, n); the other columns are the start's.
        driven: Which columns these joints are.
        weights: What moving a coordinate costs, shape (n,).
        robot: Number of the robot's coordinates.
        curves: By which its base drives; None: it goes in any direction, or stands.
    """

    def __init__(
        self, problem: TrajectoryProblem, rng: np.random.Generator, known: Known | None = None
    ) -> None:
        self.problem, self.rng, self.known = problem, rng, Known() if known is None else known
        self.chain = problem.chain
        self.robot = self.chain.robot.coordinates.size
        self.weights = self.chain.metric.copy()
        self.weights[[column for column, _, _ in problem.choices]] = (
            1.0  # also where a grasp slides
        )
        self.curves = (
            None
            if problem.rolling.is_omnidirectional
            else Curves(problem.rolling.turning_radius, self.chain.robot.lever)
        )
        self.driven = np.array([self.chain.index(name) for name in problem.task.state], int)
        self.objects = follow_objects(problem, np.tile(problem.start, (problem.segments, 1)))

    def pose_at(self, waypoint: int) -> int | None:
        """Return the pose that must hold at a waypoint, if any; what must only be level says nothing of where."""
        poses = self.problem.transcription.structure.poses
        return next(
            (
                k
                for k, pose in enumerate(poses)
                if waypoint in pose.waypoints and pose.kind != "level"
            ),
            None,
        )

    def solver(self, pose: int) -> tuple[PoseSolver, pin.SE3]:
        """Return the inverse kinematics of a pose, and its target."""
        return self.problem.transcription.pose_solvers[pose], self.problem.targets[pose]

    def knot(self, before: Floats, waypoint: int, how: str) -> tuple[Floats, Bools]:
        """Return configurations for a waypoint, shape (B, n), and which of them are what must hold there.

        Args:
            before: What they come from, shape (B, n).
            waypoint: Where they are to be.
            how: "scatter": from anywhere; "track": the nearest ones; "shake": from there with the
                arms shaken, so that the search can leave a way that is closing.
        """
        if how != "scatter":
            return self._knot(before, waypoint, how)
        key = (str(self.rng.bit_generator.state), waypoint, before.tobytes())
        if key not in self.known.drawn:
            self.known.drawn[key] = (
                *self._knot(before, waypoint, how),
                self.rng.bit_generator.state,
            )
        z, found, self.rng.bit_generator.state = self.known.drawn[key]
        return z.copy(), found.copy()

    def _knot(self, before: Floats, waypoint: int, how: str) -> tuple[Floats, Bools]:
        z = before.copy()
        z[:, self.driven] = self.objects[waypoint - 1, self.driven]
        lower, upper = self.limits(before, waypoint)
        pose = self.pose_at(waypoint)
        if pose is None:
            return np.clip(z, lower, upper), np.ones(len(z), bool)
        solver, target = self.solver(pose)
        if (
            how == "scatter"
        ):  # grasps anywhere, arms near home and every other near where it comes from
            for hold in self.problem.task.phases[
                int(np.searchsorted(self.problem.ends, waypoint))
            ].grasps:
                for column in map(self.chain.index, self.chain.virtual[hold]):
                    z[:, column] = self.rng.uniform(
                        self.chain.lower[column], self.chain.upper[column], len(z)
                    )
            z[::2, 3 : self.robot] = self.chain.robot.home
        if how != "track":
            z = self._shaken(z, pose, (0.1, 2.0) if how == "scatter" else (0.05, 0.5))
        z, found = solver.solve(
            z, target, lower=lower, upper=upper, weights=self.weights, tolerance=TOLERANCE
        )
        if how == "scatter":
            z = self._unwind(z, before, lower, upper)
        elif self.curves is not None and self._held_at(waypoint):
            z, found = self._driven_to(z, found, before, waypoint, pose)
        return z, found

    def _driven_to(
        self, z: Floats, found: Bools, before: Floats, waypoint: int, pose: int
    ) -> tuple[Floats, Bools]:
        """Return configurations with the base where an arc leads from what they come from, as far as arms reach from there."""
        rolling, turning = self.problem.rolling, self.chain.robot.lever
        there, (solver, target) = z.copy(), self.solver(pose)
        there[:, :3] = nearest_arc(
            before[:, :3], z[:, :3], radius=rolling.turning_radius, turning=turning
        )
        lower, upper = self.limits(before, waypoint)
        lower[:, :3] = upper[:, :3] = np.clip(there[:, :3], lower[:, :3], upper[:, :3])
        there, reached = solver.solve(
            there, target, lower=lower, upper=upper, weights=self.weights, tolerance=TOLERANCE
        )
        return np.where(reached[:, None], there, z), reached

    def _held_at(self, waypoint: int) -> bool:
        return self.problem.closed(
            self.problem.task.phases[self.problem.contacts.find_phase(waypoint)]
        )

    def clear(self, z: Floats, waypoint: int) -> Floats:
        """Return configurations for a waypoint, shape (B, n), pushed out of collision as far as that goes; see `clearing`."""
        pose = self.pose_at(waypoint)
        if pose is None:
            return z
        return _row_by_row(
            self.known.cleared, lambda rows, at: self._clear(rows, at, pose), z, waypoint
        )

    def _clear(self, z: Floats, waypoint: int, pose: int) -> Floats:
        lower, upper = self.limits(z, waypoint)
        if self.curves is not None and self._held_at(waypoint):
            lower[:, :3] = upper[:, :3] = z[:, :3]  # where an arc led to
        solver, target = self.solver(pose)
        weights = self.weights
        pushed = clear_out(
            self.problem, z, waypoint, solver, target, lower=lower, upper=upper, weights=weights
        )
        exact, _ = solver.solve(
            pushed,
            target,
            lower=lower,
            upper=upper,
            weights=weights,
            iterations=3,
            tolerance=TOLERANCE,
        )
        return exact

    def limits(self, before: Floats, waypoint: int) -> tuple[Floats, Floats]:
        """Return the limits of what comes from `before`, shape (B, n), at a waypoint: lower and upper, shape (B, n)."""
        row = waypoint - 1
        lower, upper = (
            np.tile(limits[row], (len(before), 1))
            for limits in (self.problem.lower, self.problem.upper)
        )
        lower[:, self.driven] = upper[:, self.driven] = self.objects[row, self.driven]
        for column in self.chosen(waypoint):
            lower[:, column] = upper[:, column] = before[:, column]
        return lower, upper

    def chosen(self, waypoint: int) -> list[int]:
        """Return the columns that say how something was grasped that is held at a waypoint; they stay as long as it is."""
        return [column for column, grasp, last in self.problem.choices if grasp < waypoint <= last]

    def _shaken(self, z: Floats, pose: int, deviations: tuple[float, float]) -> Floats:
        """Return other arms, of standard deviations between two [m] and [rad], with the base under them as `pose` needs it."""
        spread, z = self.rng.uniform(*deviations, (len(z), 1)), z.copy()
        z[:, 3 : self.robot] += spread * self.rng.normal(0.0, 1.0, (len(z), self.robot - 3))
        return self._stand(np.clip(z, self.chain.lower, self.chain.upper), pose)

    def _stand(self, z: Floats, pose: int) -> Floats:
        """Move the bases so that pose `pose` fits in place and heading; its height and tilt are left to the arm.

        A base motion multiplies the frame's placement from the left, so the error T* T⁻¹, projected
        to the floor, is it.
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
        z[:, :2] = target.translation[:2] + np.einsum(
            "bij,bj->bi", planar, z[:, :2] - translation[:, :2]
        )
        z[:, 2] += turn
        return z

    def _unwind(self, z: Floats, before: Floats, lower: Floats, upper: Floats) -> Floats:
        """Replace each revolute robot joint's angle by the equal one nearest to where it comes from."""
        z = z.copy()
        for column in range(2, self.robot):
            if self.problem.unit(self.chain.names[column]) == "m":
                continue
            nearest = (
                before[:, column] + (z[:, column] - before[:, column] + np.pi) % (2 * np.pi) - np.pi
            )
            inside = (nearest >= lower[:, column]) & (nearest <= upper[:, column])
            z[:, column] = np.where(inside, nearest, z[:, column])
        return z

    def depth(self, z: Floats, waypoint: int) -> Floats:
        """Return how far each configuration falls short of its margins [m], shape (B,)."""
        return _row_by_row(
            self.known.depths, lambda rows, at: depth(self.problem, rows, at), z, waypoint
        )

    def knows_free(self, waypoint: int) -> bool:
        """Return whether a search has come upon a configuration that is free, and is what must hold at a waypoint."""
        rows = [
            np.frombuffer(row)
            for (at, row), depth in self.known.depths.items()
            if at == waypoint and depth <= 0.0
        ]
        pose = self.pose_at(waypoint)
        if pose is None or not rows:
            return bool(rows)
        solver, target = self.solver(pose)
        return bool(
            (np.abs(solver.evaluate(np.array(rows), target)[0]).max(axis=1) < TOLERANCE).any()
        )


def depth(
    problem: TrajectoryProblem,
    z: Floats,
    waypoint: int,
    *,
    standing: bool = True,
    reach: float | None = None,
) -> Floats:
    """Return how far configurations at a waypoint, shape (B, n), fall short of their margins [m], shape (B,).

    Args:
        problem: Whose robot it is.
        z: Configurations, shape (B, n).
        waypoint: Where they are.
        standing: Whether what stands in the world counts, too; otherwise only the robot itself and
            what it carries.
        reach: Pairs further apart do not count [m]; None: all that may fall short.
    """
    waypoints, reach = (
        np.full(len(z), waypoint),
        problem.options.largest_margin if reach is None else reach,
    )
    contacts = problem.contacts.evaluate(z, waypoints, reach=reach, nearest=1, static=standing)
    return contacts.compute_shortfall(len(z))


def scatter(
    problem: TrajectoryProblem, waypoint: int, rng: np.random.Generator
) -> tuple[Floats, Floats] | None:
    """Return random configurations that try to be at the goal of `waypoint`, shape (B, n), and their residuals, shape (B,).

    None if there is neither a pose to reach nor a place for the base there.
    """
    search = Knots(problem, rng)
    pose, row = search.pose_at(waypoint), waypoint - 1
    z = np.tile(problem.start, (SCATTER, 1))
    for column in search.chosen(waypoint):  # how it was grasped is as open as the rest
        lower, upper = np.clip(
            [problem.lower[row, column], problem.upper[row, column]], -np.pi, np.pi
        )
        z[:, column] = rng.uniform(lower, upper, SCATTER)
    if pose is not None:
        z, found = search.knot(z, waypoint, "scatter")
        pushed = z.copy()
        pushed[found] = search.clear(z[found], waypoint)
        solver, target = search.solver(pose)
        before, after = (
            np.abs(solver.evaluate(rows, target)[0]).max(axis=1) for rows in (z, pushed)
        )
        kept = after < TOLERANCE  # where being pushed did not cost what must hold there
        return np.where(kept[:, None], pushed, z), np.where(kept, after, before)
    if (problem.lower[row, :2] < problem.upper[row, :2]).any():
        return None
    z[:, 2:] += rng.normal(0.0, 1.0, z[:, 2:].shape)
    return np.clip(z, problem.lower[row], problem.upper[row]), np.zeros(len(z))


def smooth(steps: int) -> Floats:
    """Return s at 1/steps, ..., 1 of the profile that starts and ends at rest, 3s² − 2s³, shape (steps,)."""
    s = np.arange(1, steps + 1) / steps
    return s * s * (3.0 - 2.0 * s)


def follow_objects(problem: TrajectoryProblem, z: Floats) -> Floats:
    """Let the objects' joints run to their goals phase by phase."""
    begin, current = 0, problem.start.copy()
    for phase, end in zip(problem.task.phases, problem.ends, strict=True):
        for name in phase.initial_values:
            column = problem.chain.index(name)
            goal = problem.lower[end - 1, column] if name in phase.values else current[column]
            z[begin:end, column] = current[column] + (goal - current[column]) * smooth(end - begin)
            current[column] = goal
        begin = end
    return problem.clip(z)
