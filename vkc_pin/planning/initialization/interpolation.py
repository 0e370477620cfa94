"""From configurations at a few waypoints to all of them: straight, along a path of the base, or along one of base and arm."""

from __future__ import annotations

from collections import Counter

import numpy as np

from vkc_pin.planning.base_paths.arcs import Curves, between, spread_along
from vkc_pin.planning.initialization.approach_paths import Approach
from vkc_pin.planning.initialization.base_routes import Routes
from vkc_pin.planning.initialization.constrained_rrt import held_path, obstructed
from vkc_pin.planning.initialization.keyframes import Knots, smooth
from vkc_pin.planning.initialization.rrt import TRIES, connect, spread
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.task.phases import Phase

__all__ = ["CurvePaths", "DrivenPaths", "Joiner", "Paths", "RrtPaths", "base_paths"]


class DrivenPaths:
    """The base along the shortest path around what stands there where nothing fixed is held; the arm straight."""

    careful = False
    """Whether configurations on the straight paths in and out are left out where they hit something."""

    def __init__(self, routes: Routes) -> None:
        self.routes = routes

    def path(
        self, phase: int, first: Floats, last: Floats, steps: int, *, turns: bool, reaches: bool
    ) -> Floats | None:
        """Return `steps` rows from `first` to `last`, both (n,), of the robot's first coordinates, shape (steps, c).

        The last row is as `last`, but with `turns` the heading may end whole turns further, and
        without `reaches` the arm may end elsewhere. None if there is no path.
        """
        path = self.routes.path(phase, first[:3], last[:3], steps)
        if path is not None and not turns:
            path[:, 2] -= (path[-1, 2] - last[2]) * np.arange(1, steps + 1) / steps
        return path


class CurvePaths:
    """The base along the curve that leads there if nothing is in the way, where nothing fixed is held; the arm straight."""

    careful = False

    def __init__(self, curves: Curves) -> None:
        self.curves = curves

    def path(
        self, phase: int, first: Floats, last: Floats, steps: int, *, turns: bool, reaches: bool
    ) -> Floats:
        """See `DrivenPaths.path`."""
        corners = self.curves.corners(first[:3], last[:3])
        if not turns:
            corners = np.vstack([corners, last[None, :3]])
        return spread_along(corners, steps, turning=self.curves.turning)


class RrtPaths:
    """Base and arm along what two random trees find: guided by a path of the base, or on the manifold of what is held."""

    careful = True

    def __init__(self, knots: Knots, routes: Routes) -> None:
        self.knots, self.problem, self.routes = knots, knots.problem, routes
        self.failed: Counter[int] = Counter()  # how often in a row in each phase

    def path(
        self, phase: int, first: Floats, last: Floats, steps: int, *, turns: bool, reaches: bool
    ) -> Floats | None:
        """See `DrivenPaths.path`."""
        problem, size = self.problem, self.knots.robot
        poses, last = first[None, :3], last.copy()
        if problem.chain.robot.base != "fixed":
            guide = self.routes.guide(phase, first[:3], last[:3], 2 * steps)
            if guide is None:
                return None
            turned = 2 * np.pi * np.rint((guide[-1, 2] - last[2]) / (2 * np.pi))
            if turns:
                last[2] += turned
            else:
                guide[:, 2] -= turned  # the trees find where there is room to turn
            poses = guide
        folded = (
            self.routes.folded_arm(phase),
            self.routes.nearest_folded_arm(phase, first[3:size], last[3:size]),
        )
        arms = [first[3:size], last[3:size], problem.chain.robot.home, *folded]
        ends = np.tile(last[:size], (1 if reaches else len(arms), 1))
        if not reaches:
            ends[:, 3:] = arms
        rng, tries = self.knots.rng, self._tries(phase)
        path = connect(
            problem, phase, first, ends, poses=poses, arms=np.array(arms), rng=rng, tries=tries
        )
        self.failed[phase] = 0 if path is not None else self.failed[phase] + 1
        return (
            None if path is None else spread(path, steps, self.knots.chain.metric[: path.shape[1]])
        )

    def held(self, phase: int, through: Floats, straight: Floats) -> Floats | None:
        """Return waypoints of a phase in which something fixed is held, if trees lead around what is in the straight way."""
        if not obstructed(self.knots, phase, through, straight):
            return None
        path = held_path(self.knots, phase, through, len(straight), self._tries(phase))
        self.failed[phase] = 0 if path is not None else self.failed[phase] + 1
        return path

    def _tries(self, phase: int) -> int:
        """Return how often trees may grow in a phase: what failed before is likely to fail again."""
        return max(1, TRIES // 2 ** self.failed[phase])


Paths = CurvePaths | DrivenPaths | RrtPaths


def base_paths(knots: Knots, routes: Routes | None) -> Paths | None:
    """Return the paths of the base around what stands there, or, without routes, as if nothing did; None: straight ones."""
    if routes is not None:
        return DrivenPaths(routes)
    return None if knots.curves is None else CurvePaths(knots.curves)


class Joiner:
    """Joins knots of a problem.

    Args:
        knots: Of the problem.
        approach: The straight paths in and out.
        paths: The others, where nothing fixed is held; None: straight, too.
    """

    def __init__(self, knots: Knots, approach: Approach, paths: Paths | None) -> None:
        self.knots, self.problem, self.approach, self.paths = knots, knots.problem, approach, paths
        self.blocked: list[str] = []
        """A line for every phase in which there was no path."""

    def join(self, through: Floats, at: list[int]) -> Floats | None:
        """Return waypoints through configurations, shape (K, n), at waypoints `at`; where something fixed is held, closed.

        None if there is no path somewhere.
        """
        problem, size = self.problem, self.problem.chain.size
        z, knots, objects = (
            np.empty((problem.segments, size)),
            through.copy(),
            self.knots.objects.copy(),
        )
        begin, previous = 0, None
        for number, (phase, end) in enumerate(
            zip(problem.task.phases, problem.ends.tolist(), strict=True)
        ):
            inside = [k for k, waypoint in enumerate(at) if begin <= waypoint <= end]
            if problem.closed(phase):
                self._straight(z[begin:end], knots[inside], [at[k] - begin for k in inside])
                held = (
                    self.paths.held(number, knots[inside], z[begin:end])
                    if isinstance(self.paths, RrtPaths)
                    else None
                )
                if held is not None:
                    z[begin:end] = objects[begin:end] = held
                    knots[inside[-1]] = held[-1]
            elif not self._open(z[begin:end], knots, inside, number, previous):
                return None
            begin, previous = end, phase
        self._close(z, objects)
        return problem.clip(z)

    def _straight(self, z: Floats, through: Floats, when: list[int]) -> None:
        """Fill rows of z, shape (steps, n), with straight lines through configurations, `when` counted from the row before z."""
        s = np.concatenate([[0.0], smooth(len(z))])
        for column in range(z.shape[1]):
            z[:, column] = np.interp(s[1:], s[when], through[:, column])
        if self.knots.curves is not None:
            at = np.interp(s[1:], s[when], np.arange(len(when)))
            leg = np.minimum(at.astype(int), len(when) - 2)
            z[:, :3] = between(through[leg, :3], through[leg + 1, :3], at - leg)

    def _open(
        self, z: Floats, knots: Floats, inside: list[int], number: int, previous: Phase | None
    ) -> bool:
        """Fill the rows of a phase in which nothing fixed is held; turn the knots that follow as that ends. False: no path."""
        problem, phase = self.problem, self.problem.task.phases[number]
        end = int(problem.ends[number])
        through, when, leave, arrive = self._via(knots[inside], number, previous, len(z))
        path = None
        if self.paths is not None:
            steps = when[arrive] - when[leave]
            reaches = self.knots.pose_at(end) is not None
            turns = (
                problem.lower[end - 1, 2] < problem.upper[end - 1, 2]
            )  # unless the goal says how far to turn
            path = self.paths.path(
                number, through[leave], through[arrive], steps, turns=turns, reaches=reaches
            )
            if path is None:
                blocked = f"{phase.name}: found no way for the base"
                (x, y), (u, v) = through[[leave, arrive], :2]
                if not any(note.startswith(blocked) for note in self.blocked):
                    self.blocked.append(f"{blocked} from ({x:.2f}, {y:.2f}) to ({u:.2f}, {v:.2f})")
                return False
            turned = path[-1, 2] - through[arrive, 2]  # what follows goes on from there
            through[arrive:, 2] += turned
            knots[inside[-1] :, 2] += turned
        self._straight(z, through, when)
        if path is not None:
            z[when[leave] : when[arrive], : path.shape[1]] = path
            knots[inside[-1], : path.shape[1]] = z[-1, : path.shape[1]]
        return True

    def _via(
        self, ends: Floats, number: int, previous: Phase | None, segments: int
    ) -> tuple[Floats, list[int], int, int]:
        """Return configurations to go through from start to end of a phase, `ends`, shape (2, n), and when, counted from 0.

        The last two numbers say between which of them it is neither a straight path out nor one in.
        """
        phase = self.problem.task.phases[number]
        first = self.approach.after(ends[0], phase, previous)
        last = self.approach.before(ends[1], phase)
        if self.paths is not None and self.paths.careful:
            waypoint = self.problem.contacts.find_waypoint(number)
            first, last = (
                part[: len(part) if self._free(part, waypoint) else 0] for part in (first, last)
            )
        steps = self.problem.options.steps(self.problem.options.approach_time)
        spacing = max(1, min(steps, segments // (2 * max(len(first) + len(last), 1))))
        when = [0, *(spacing * (1 + k) for k in range(len(first)))]
        when += [*(segments - spacing * (len(last) - k) for k in range(len(last))), segments]
        return np.vstack([ends[:1], first, last, ends[1:]]), when, len(first), len(first) + 1

    def _free(self, z: Floats, waypoint: int) -> bool:
        return not len(z) or bool(
            np.all(self.knots.depth(z, waypoint) < self.problem.options.dist_safe / 2)
        )

    def _close(self, z: Floats, objects: Floats) -> None:
        """Move the objects' joints in z, shape (N, n), as they are driven in `objects`, and the robot with what it holds."""
        problem, driven = self.problem, self.knots.driven
        z[:, driven] = objects[:, driven]
        for pose, row in enumerate(problem.transcription.structure.poses):
            if len(row.waypoints) > 1:
                rows = np.array(row.waypoints) - 1
                lower, upper = problem.lower[rows].copy(), problem.upper[rows].copy()
                lower[:, driven] = upper[:, driven] = objects[np.ix_(rows, driven)]
                if self.knots.curves is not None:
                    lower[:, :3] = upper[:, :3] = z[rows, :3]
                solver, target = self.knots.solver(pose)
                z[rows], _ = solver.solve(
                    z[rows],
                    target,
                    lower=lower,
                    upper=upper,
                    weights=self.knots.weights,
                    iterations=6,
                )
