"""Seeds for the solver: stationary, or through configurations the planner finds itself, straight or around what is in the way."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from vkc_pin.approach import Approach
from vkc_pin.beam import Beam
from vkc_pin.knots import Knots, follow_objects, smooth
from vkc_pin.problem import TrajectoryProblem
from vkc_pin.routes import Routes
from vkc_pin.task import Phase

__all__ = ["HOPELESS", "METHODS", "Seed", "initialize"]

METHODS = ("auto", "interpolated", "astar", "stationary")
_TOLERABLE = 60.0  # what the solver may be left to push apart: a graze or two
_LOOKED, _FREE = 8, 0.05  # paths whose seeds are compared; shortfalls [m], summed over waypoints, that nobody looks further for
HOPELESS = 2.0
"""Shortfalls of a seed, summed over its waypoints [m], with which others come first."""
_WAVES = 6  # half waves of a perturbation over the whole motion
_DIFFERENT = 0.1  # [m] and [rad] by which the base must differ somewhere between two seeds
_ELSEWHERE, _DEARER = 0.5, 1.4  # by so much in a second seed of one search, which may cost so much more than the cheapest


@dataclass(frozen=True, eq=False)
class Seed:
    """A trajectory to start from.

    Attributes:
        name: The method, and the number of the try if it is not the first.
        z: z_1..z_N, shape (N, n).
        shortfall: By how much waypoints fall short of their clearances, summed [m]; NaN if nobody looked.
    """

    name: str
    z: NDArray[np.float64]
    shortfall: float = float("nan")


def initialize(
    problem: TrajectoryProblem,
    method: str,
    seed: int,
    *,
    count: int = 1,
    perturbation: float = 0.0,
    notes: list[str] | None = None,
) -> Iterator[Seed]:
    """Yield up to `count` seeds of each kind, best first; each is looked for when it is asked for.

    Args:
        problem: What is to be solved.
        method: "stationary": the robot stays at its start, only the objects' joints go to their goals. "interpolated":
            straight to a configuration at each goal, found by inverse kinematics from random seeds; where something fixed is
            held, the seed follows its motion. "astar": to such configurations, the base along the shortest way around what
            stands there, heading along it. "auto": these two in turn, beginning with what is cheaper.
        seed: Of the random numbers.
        count: How many different seeds to return.
        perturbation: Standard deviation of what is added to the robot's coordinates, smoothly over time, [m] and [rad].
        notes: Gets a line for every phase in which there is no way for the base.
    """
    said: list[str] = [] if notes is None else notes
    if method == "stationary":
        seeds = iter([Seed(method, follow_objects(problem, np.tile(problem.start, (problem.segments, 1))))])
    elif method == "auto":
        seeds = _in_turn(*(_Seeds(problem, part, seed, said).seeds(count) for part in ("interpolated", "astar")))
    else:
        seeds = _Seeds(problem, method, seed, said).seeds(count)
    rng = np.random.default_rng([seed, 1])
    for item in seeds:
        yield replace(item, z=_perturbed(problem, item.z, perturbation, rng)) if perturbation else item


def _in_turn(straight: Iterator[Seed], around: Iterator[Seed]) -> Iterator[Seed]:
    """Yield from both in turn, first what goes straight, unless that is hopeless."""
    for seed in straight:
        if seed.shortfall > HOPELESS:
            yield from islice(around, 1)
            yield seed
        else:
            yield seed
            yield from islice(around, 1)
    yield from around


def _perturbed(
    problem: TrajectoryProblem, z: NDArray[np.float64], deviation: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return a seed with smooth noise on the robot's coordinates: half waves in time, of decreasing amplitude."""
    robot, waves = problem.chain.robot.coordinates.size, np.arange(1, _WAVES + 1)
    shape = np.sin(np.pi * np.outer(np.arange(1, len(z) + 1) / (len(z) + 1), waves)) / waves
    noise = shape @ rng.normal(0.0, deviation, (len(waves), robot)) / np.sqrt(np.sum(0.5 / waves**2))
    z = z.copy()
    z[:, :robot] += noise
    return problem.clip(z)


class _Seeds:
    """Joins the knots of the cheapest paths."""

    def __init__(self, problem: TrajectoryProblem, method: str, seed: int, notes: list[str]) -> None:
        self.problem, self.method, self.notes = problem, method, notes
        self.knots = Knots(problem, np.random.default_rng(seed))
        self.routes = Routes(problem) if method == "astar" and problem.chain.robot.base != "fixed" else None
        self.beam = Beam(self.knots, self.routes)
        self.approach = Approach(self.knots)

    def seeds(self, count: int) -> Iterator[Seed]:
        """Yield seeds through the cheapest paths of knots: of one quick search if that is any good, then of thorough ones."""
        given: list[NDArray[np.float64]] = []
        for attempt in range(count + 1):
            found = self.beam.search(thorough=attempt > 0)
            if attempt == 0 and found.trouble[np.argmin(found.cost)] > _TOLERABLE:
                continue
            order = np.argsort(found.cost, kind="stable")
            cheap = order[found.cost[order] <= _DEARER * found.cost[order[0]]]
            for apart, some in ((_DIFFERENT, order), (_ELSEWHERE, cheap)):
                new = [k for k in some if all(np.abs(found.paths[k] - other)[:, :3].max() > apart for other in given)]
                best = self._best(found.paths, new[:_LOOKED], found.at)
                if best is not None:
                    index, z, short = best
                    given.append(found.paths[index])
                    yield Seed(self.method if len(given) == 1 else f"{self.method} {len(given)}", z, short)
                if len(given) == count:
                    return

    def _best(
        self, paths: NDArray[np.float64], candidates: list[int], at: list[int]
    ) -> tuple[int, NDArray[np.float64], float] | None:
        """Return the path, of the cheapest, whose seed has the least l1 merit, that seed and its shortfall.

        The first that is free will do. None if there is no way for the base in any of them.
        """
        best, least = None, np.inf
        for index in candidates:
            z = self._join(paths[index], at)
            if z is None:
                continue
            short = float(self.problem.evaluate_contacts(z, reach=self.problem.options.dist_safe).shortfall(len(z)).sum())
            merit = self.problem.objective(z) + self.problem.options.penalty * short
            if merit < least:
                best, least = (index, z, short), merit
            if short < _FREE:
                break
        return best

    def _join(self, knots: NDArray[np.float64], at: list[int]) -> NDArray[np.float64] | None:
        """Return waypoints through `knots`, shape (K, n), at waypoints `at`; where something fixed is held, closed."""
        problem, size = self.problem, self.problem.chain.size
        z = np.empty((problem.segments, size))
        knots = knots.copy()
        begin, previous = 0, None
        for number, (phase, end) in enumerate(zip(problem.task.phases, problem.ends, strict=True)):
            inside = [k for k, waypoint in enumerate(at) if begin <= waypoint <= end]
            s = np.concatenate([[0.0], smooth(end - begin)])
            through, when = knots[inside], [at[k] - begin for k in inside]
            way = None
            if not problem.closed(phase):
                through, when, leave, arrive = self._ways(through, phase, previous, end - begin)
                if self.routes is not None:
                    steps = when[arrive] - when[leave]
                    way = self.routes.way(number, through[leave, :3], through[arrive, :3], steps)
                    if way is None:
                        self._note_no_way(phase, through[leave], through[arrive])
                        return None
                    turned = way[-1, 2] - through[arrive, 2]  # by whole turns: what follows goes on from there
                    if problem.lower[end - 1, 2] == problem.upper[end - 1, 2]:  # unless the goal says how far to turn
                        way[:, 2] -= turned * np.arange(1, steps + 1) / steps
                        turned = 0.0
                    through[arrive:, 2] += turned
                    knots[inside[-1] :, 2] += turned
            for column in range(size):
                z[begin:end, column] = np.interp(s[1:], s[when], through[:, column])
            if way is not None:
                z[begin + when[leave] : begin + when[arrive], :3] = way
            begin, previous = int(end), phase
        driven = self.knots.driven
        z[:, driven] = self.knots.objects[:, driven]
        for pose, row in enumerate(problem.transcription.structure.poses):
            if len(row.waypoints) > 1:
                rows = np.array(row.waypoints) - 1
                lower, upper = problem.lower[rows].copy(), problem.upper[rows].copy()
                lower[:, driven] = upper[:, driven] = self.knots.objects[np.ix_(rows, driven)]
                solver, target = self.knots.solver(pose)
                z[rows], _ = solver.solve(z[rows], target, lower=lower, upper=upper, weights=self.knots.weights, iterations=6)
        return problem.clip(z)

    def _note_no_way(self, phase: Phase, first: NDArray[np.float64], last: NDArray[np.float64]) -> None:
        """Note, once a phase, that the base finds no way between two configurations, shape (n,)."""
        problem = f"{phase.name}: found no way for the base"
        if not any(note.startswith(problem) for note in self.notes):
            self.notes.append(f"{problem} from ({first[0]:.2f}, {first[1]:.2f}) to ({last[0]:.2f}, {last[1]:.2f})")

    def _ways(
        self, ends: NDArray[np.float64], phase: Phase, previous: Phase | None, segments: int
    ) -> tuple[NDArray[np.float64], list[int], int, int]:
        """Return configurations to go through from start to end of a phase, `ends`, shape (2, n), and when, counted from 0.

        The last two numbers say between which of them it is neither a straight way out nor one in.
        """
        first = self.approach.after(ends[0], phase, previous)
        last = self.approach.before(ends[1], phase)
        steps = self.problem.options.approach_waypoints
        spacing = max(1, min(steps, segments // (2 * max(len(first) + len(last), 1))))
        when = [0, *(spacing * (1 + k) for k in range(len(first)))]
        when += [*(segments - spacing * (len(last) - k) for k in range(len(last))), segments]
        return np.vstack([ends[:1], first, last, ends[1:]]), when, len(first), len(first) + 1
