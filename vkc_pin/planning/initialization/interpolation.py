"""Interpolates between keyframes: straight, along base paths, or along paths of base and arm."""

from __future__ import annotations

from collections import Counter

import numpy as np

from vkc_pin.planning.base_paths.arcs import Curves, interpolate_arcs, sample_path
from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.closed_trees import (
    MAX_EXTENSIONS,
    find_closed_path,
    needs_trees,
)
from vkc_pin.planning.initialization.keyframes import KeyframeSampler, sample_smoothstep
from vkc_pin.planning.initialization.open_trees import Guide, OpenSearch
from vkc_pin.planning.nlp.pose_goals import find_phase_spans
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.task.phases import Phase

FIRST_CHECKS = 50_000
"""Collision checks after which the first search with trees ends."""


class AStarPaths:
    """Paths with the base on the shortest path around obstacles and the arm straight."""

    def __init__(self, routes: BaseRoutes) -> None:
        self.routes = routes

    def find_path(
        self, phase: int, first: Floats, last: Floats, steps: int, *, turns: bool, reaches: bool
    ) -> Floats | None:
        """Find a path of the robot's leading coordinates in an open phase.

        Args:
            phase: Number of the phase.
            first: Configuration at its start, shape (n,).
            last: Configuration at its end, shape (n,).
            steps: Number of rows.
            turns: Whether the final heading may differ by full turns.
            reaches: Whether the arm must end as in `last`.

        Returns:
            Rows without `first`, shape (steps, c); None if there is no path.
        """
        path = self.routes.find_path(phase, first[:3], last[:3], steps)
        if path is not None and not turns:
            path[:, 2] -= (path[-1, 2] - last[2]) * np.arange(1, steps + 1) / steps
        return path


class CurvePaths:
    """Paths with the base on the shortest curve, ignoring obstacles, and the arm straight."""

    def __init__(self, curves: Curves) -> None:
        self.curves = curves

    def find_path(
        self, phase: int, first: Floats, last: Floats, steps: int, *, turns: bool, reaches: bool
    ) -> Floats:
        """See `AStarPaths.find_path`."""
        corners = self.curves.compute_corners(first[:3], last[:3])
        if not turns:
            corners = np.vstack([corners, last[None, :3]])
        return sample_path(corners, steps, turning=self.curves.turning)


class RrtPaths:
    """Paths of base and arm by RRT: guided by a base path, or constrained to a closed chain."""

    def __init__(
        self, sampler: KeyframeSampler, routes: BaseRoutes, *, check_factor: int = 1
    ) -> None:
        self.sampler = sampler
        self.problem = sampler.problem
        self.routes = routes
        self.check_factor = check_factor  # factor of the collision checks
        self._failures: Counter[int] = Counter()  # consecutive ones per phase
        # Configurations at which the motion may end, shape (E, n).
        self.final_ends = np.empty((0, self.problem.chain.size))
        # Pair that collides between start and goal, if the last search for an open path failed.
        self.obstruction: tuple[str, str] | None = None

    def find_path(
        self, phase: int, first: Floats, last: Floats, steps: int, *, turns: bool, reaches: bool
    ) -> Floats | None:
        """See `AStarPaths.find_path`."""
        problem = self.problem
        size = self.sampler.robot_size
        self.obstruction = None
        guide = None
        last = last.copy()
        if problem.chain.robot.base == "fixed":
            arms = np.array([last[3:size], first[3:size], problem.chain.robot.home])
        else:
            arms = self._list_postures(phase, first[3:size], last[3:size])
            poses = self.routes.find_guide_path(phase, first[:3], last[:3], 2 * steps)
            if poses is None:
                return None
            full_turns = 2 * np.pi * np.rint((poses[-1, 2] - last[2]) / (2 * np.pi))
            if turns:
                last[2] += full_turns
            else:
                poses[:, 2] -= full_turns  # the trees find where the base can turn
            guide = Guide(poses, arms)
        if not reaches:
            ends = self._list_ends(phase, last, arms)
        elif guide is None and phase + 1 == len(problem.ends):
            ends = self._list_final_ends(last)
        else:
            ends = last[None]
        # Every other attempt allows no shortfall, and pairs of attempts get twice the checks.
        failures = self._failures[phase]
        allowed = 0.0 if failures % 2 else problem.options.dist_safe
        max_checks = self.check_factor * FIRST_CHECKS * 2 ** (failures // 2)
        search = OpenSearch(self.sampler, phase, first, ends, guide, allowed=allowed)
        path = search.find_path(steps, max_checks)
        self._count_failures(phase, path)
        if path is None:
            self.obstruction = search.find_obstruction()
            return None
        return path[:, :size]

    def _list_postures(self, phase: int, start: Floats, goal: Floats) -> Floats:
        """Return postures that are likely to be needed between two of them, shape (A, m - 3)."""
        folded = self.routes.get_folded_arm(phase)
        nearest = self.routes.find_nearest_folded_arm(phase, start, goal)
        return np.array([start, goal, self.problem.chain.robot.home, folded, nearest])

    def _list_ends(self, phase: int, last: Floats, arms: Floats) -> Floats:
        """Return configurations like `last` with other postures, within the limits of the goal."""
        end = int(self.problem.ends[phase]) - 1
        ends = np.tile(last, (len(arms), 1))
        ends[:, 3 : self.sampler.robot_size] = arms
        ends = np.clip(ends, self.problem.lower[end], self.problem.upper[end])
        return np.unique(ends, axis=0)

    def _list_final_ends(self, last: Floats) -> Floats:
        """Return the final ends that differ from `last`, one of them, in the robot alone."""
        size = self.sampler.robot_size
        ends = self.final_ends
        if not (ends == last).all(axis=1).any():
            return last[None]
        return np.asarray(ends[(ends[:, size:] == last[size:]).all(axis=1)])

    def find_closed_path(self, phase: int, through: Floats, straight: Floats) -> Floats | None:
        """Find waypoints of a closed phase around obstacles; None if straight lines are free."""
        if not needs_trees(self.sampler, phase, through, straight):
            return None
        limit = self._get_extension_limit(phase)
        path = find_closed_path(self.sampler, phase, through, len(straight), limit)
        self._count_failures(phase, path)
        return path

    def _get_extension_limit(self, phase: int) -> int:
        """Return the maximum number of extensions, which is halved after every failure."""
        return max(1, MAX_EXTENSIONS // 2 ** self._failures[phase])

    def _count_failures(self, phase: int, path: Floats | None) -> None:
        """Count the consecutive failures in a phase."""
        if path is None:
            self._failures[phase] += 1
        else:
            self._failures[phase] = 0


Paths = CurvePaths | AStarPaths | RrtPaths


def make_base_paths(sampler: KeyframeSampler, routes: BaseRoutes | None) -> Paths | None:
    """Return base paths around obstacles or, without routes, along curves; None: straight."""
    if routes is not None:
        return AStarPaths(routes)
    return None if sampler.curves is None else CurvePaths(sampler.curves)


class Interpolator:
    """Interpolates between keyframes of a problem.

    Args:
        sampler: Keyframe sampler.
        approach: Straight approach and retreat paths.
        paths: Paths for open phases. Default: straight.

    Attributes:
        blocked: A line for every phase without a path.
    """

    def __init__(
        self, sampler: KeyframeSampler, approach: ApproachPaths, paths: Paths | None
    ) -> None:
        self.sampler = sampler
        self.problem = sampler.problem
        self.approach = approach
        self.paths = paths
        self.blocked: list[str] = []

    def interpolate(self, through: Floats, at: list[int]) -> Floats | None:
        """Interpolate waypoints through keyframes, and close the chain where it must be closed.

        Args:
            through: Configurations at the keyframes, shape (K, n).
            at: Waypoints of the keyframes.

        Returns:
            z_1..z_N, shape (N, n); None if a phase has no path.
        """
        problem = self.problem
        keyframes = through.copy()
        objects = self.sampler.object_motion.copy()
        z = np.empty((problem.segments, problem.chain.size))
        previous = None
        for number, (phase, begin, end) in enumerate(find_phase_spans(problem.task)):
            inside = [k for k, waypoint in enumerate(at) if begin <= waypoint <= end]
            rows = z[begin:end]
            if problem.is_closed(phase):
                self._fill_straight(rows, keyframes[inside], [at[k] - begin for k in inside])
                path = None
                if isinstance(self.paths, RrtPaths):
                    path = self.paths.find_closed_path(number, keyframes[inside], rows)
                if path is not None:
                    rows[:] = path
                    objects[begin:end] = path
                    keyframes[inside[-1]] = path[-1]
            elif not self._fill_open_phase(rows, keyframes, inside, number, previous):
                return None
            previous = phase
        self._close_chain(z, problem.clip(objects))
        return problem.clip(z)

    def _fill_straight(self, z: Floats, through: Floats, when: list[int]) -> None:
        """Fill rows of z with straight lines through configurations, at rows `when` from 1."""
        s = np.concatenate([[0.0], sample_smoothstep(len(z))])
        for column in range(z.shape[1]):
            z[:, column] = np.interp(s[1:], s[when], through[:, column])
        if self.sampler.curves is not None:
            at = np.interp(s[1:], s[when], np.arange(len(when)))
            piece = np.minimum(at.astype(int), len(when) - 2)
            z[:, :3] = interpolate_arcs(through[piece, :3], through[piece + 1, :3], at - piece)

    def _fill_open_phase(
        self, z: Floats, keyframes: Floats, inside: list[int], number: int, previous: Phase | None
    ) -> bool:
        """Fill the rows of an open phase if it has a path, and turn later keyframes by full turns.

        Its start and its end are keyframes `inside`.
        """
        problem = self.problem
        phase = problem.task.phases[number]
        end = int(problem.ends[number])
        through, when, leave, arrive = self._find_via_points(
            keyframes[inside], number, previous, len(z)
        )
        path = None
        if self.paths is not None:
            steps = when[arrive] - when[leave]
            reaches = self.sampler.find_pose(end) is not None
            # The heading is free unless the goal fixes it.
            turns = problem.lower[end - 1, 2] < problem.upper[end - 1, 2]
            path = self.paths.find_path(
                number, through[leave], through[arrive], steps, turns=turns, reaches=reaches
            )
            if path is None:
                self._note_missing_path(phase, *through[[leave, arrive], :2])
                return False
            # Later headings continue from there.
            full_turns = path[-1, 2] - through[arrive, 2]
            through[arrive:, 2] += full_turns
            keyframes[inside[-1] :, 2] += full_turns
        self._fill_straight(z, through, when)
        if path is not None:
            z[when[leave] : when[arrive], : path.shape[1]] = path
            keyframes[inside[-1], : path.shape[1]] = z[-1, : path.shape[1]]
        return True

    def _note_missing_path(self, phase: Phase, start: Floats, end: Floats) -> None:
        """Note that a phase has no path of the base between places on the floor, shape (2,)."""
        is_fixed = self.problem.chain.robot.base == "fixed"
        text = f"{phase.name}: found no path for the {'arm' if is_fixed else 'base'}"
        if any(note.startswith(text) for note in self.blocked):
            return
        if not is_fixed:
            text += f" from ({start[0]:.2f}, {start[1]:.2f}) to ({end[0]:.2f}, {end[1]:.2f})"
        if isinstance(self.paths, RrtPaths) and self.paths.obstruction is not None:
            first, second = self.paths.obstruction
            text += f": between start and goal, {first} meets {second}"
        self.blocked.append(text)

    def _find_via_points(
        self, ends: Floats, number: int, previous: Phase | None, segments: int
    ) -> tuple[Floats, list[int], int, int]:
        """Add retreat and approach to the configurations at the ends of a phase, shape (2, n).

        Returns configurations, shape (K, n), their waypoints from 0, and the indices of those
        between which the path is neither retreat nor approach.
        """
        phase = self.problem.task.phases[number]
        options = self.problem.options
        retreat = self.approach.find_retreat_end(ends[0], phase, previous)
        approach = self.approach.find_approach_start(ends[1], phase)
        if isinstance(self.paths, RrtPaths):  # which avoid collisions elsewhere
            waypoint = self.problem.contacts.find_waypoint(number)
            if not self._is_free(retreat, waypoint):
                retreat = retreat[:0]
            if not self._is_free(approach, waypoint):
                approach = approach[:0]
        steps = options.steps(options.approach_time)
        via_points = len(retreat) + len(approach)
        spacing = max(1, min(steps, segments // (2 * max(via_points, 1))))
        when = [0]
        when += [spacing * (1 + k) for k in range(len(retreat))]
        when += [segments - spacing * (len(approach) - k) for k in range(len(approach))]
        when.append(segments)
        through = np.vstack([ends[:1], retreat, approach, ends[1:]])
        return through, when, len(retreat), len(retreat) + 1

    def _is_free(self, z: Floats, waypoint: int) -> bool:
        """Return whether configurations, shape (K, n), keep at least half their clearance."""
        if not len(z):
            return True
        shortfall = self.sampler.compute_shortfall(z, waypoint)
        return bool(np.all(shortfall < self.problem.options.dist_safe / 2))

    def _close_chain(self, z: Floats, objects: Floats) -> None:
        """Set object joints in z, shape (N, n), to those of `objects`, and solve the closures."""
        problem = self.problem
        columns = self.sampler.object_columns
        z[:, columns] = objects[:, columns]
        for pose, goal in enumerate(problem.pose_goals):
            if len(goal.row.waypoints) > 1:
                rows = np.array(goal.row.waypoints) - 1
                lower = problem.lower[rows].copy()
                upper = problem.upper[rows].copy()
                for limits in (lower, upper):
                    limits[:, columns] = objects[np.ix_(rows, columns)]
                    if self.sampler.curves is not None:
                        limits[:, :3] = z[rows, :3]  # the base stays on its arcs
                z[rows], _ = self.sampler.solve_pose(
                    z[rows], pose, lower, upper, iterations=6, tolerance=1e-6
                )
