"""Seeds for the solver: stationary, or through configurations the planner finds itself, straight or around what is in the way."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from vkc_pin.approach import Approach
from vkc_pin.beam import Beam, Found
from vkc_pin.interrupt import NEVER, Interrupt
from vkc_pin.joining import Around, Joiner, Trees
from vkc_pin.knots import Knots, Known, follow_objects
from vkc_pin.problem import TrajectoryProblem
from vkc_pin.routes import Routes

__all__ = ["HOPELESS", "INITIALIZATIONS", "Seed", "initialize"]

INITIALIZATIONS = ("auto", "interpolated", "astar", "rrt", "stationary")
_LOOKED, _FREE = 8, 0.05  # paths whose seeds are compared; shortfalls [m], summed over waypoints, that nobody looks further for
_HIT = 1e4  # cost that lets paths with knots in collision come last
_GROWN, _POOR = 4, 0.5  # paths along which trees grow; shortfalls with which they are asked
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
        radius: How far the solver believes planes at first, shape (N,); None: as usual.
        penalty: What clearance costs the solver at first; None: as usual.
    """

    name: str
    z: NDArray[np.float64]
    shortfall: float = float("nan")
    radius: NDArray[np.float64] | None = None
    penalty: float | None = None


def initialize(
    problem: TrajectoryProblem,
    method: str,
    seed: int,
    *,
    count: int = 1,
    perturbation: float = 0.0,
    notes: list[str] | None = None,
    interrupt: Interrupt = NEVER,
) -> Iterator[Seed]:
    """Yield up to `count` seeds of each kind, best first; each is looked for when it is asked for.

    Args:
        problem: What is to be solved.
        method: "stationary": the robot stays at its start, only the objects' joints go to their goals. "interpolated":
            straight to a configuration at each goal, found by inverse kinematics from random seeds; where something fixed is
            held, the seed follows its motion. "astar": to such configurations, the base along the shortest way around what
            stands there, heading along it. "rrt": to such configurations, base and arm together along what two random trees find.
            "auto": these three in turn, the last first where the others hit things.
        seed: Of the random numbers.
        count: How many different seeds to return.
        perturbation: Standard deviation of what is added to the robot's coordinates, smoothly over time, [m] and [rad].
        notes: Gets a line for every phase in which there is no way for the base.
        interrupt: Ends the search; there are no more seeds then.
    """
    said: list[str] = [] if notes is None else notes
    if method == "stationary":
        seeds = iter([Seed(method, follow_objects(problem, np.tile(problem.start, (problem.segments, 1))))])
    elif method == "auto":
        routes, known = Routes(problem, interrupt), Known()
        parts = (_Seeds(problem, part, seed, said, routes, interrupt, known=known) for part in ("interpolated", "astar"))
        straight, around = parts
        trees = _Seeds(problem, "rrt", seed, said, routes, interrupt, known=known, like=around)
        seeds = _in_turn(straight.seeds(count), around.seeds(count), trees.seeds(max(count, 2)))
    else:
        seeds = _Seeds(problem, method, seed, said, Routes(problem, interrupt), interrupt).seeds(count)
    rng = np.random.default_rng([seed, 1])
    for item in seeds:
        yield replace(item, z=_perturbed(problem, item.z, perturbation, rng)) if perturbation else item


def _in_turn(straight: Iterator[Seed], around: Iterator[Seed], trees: Iterator[Seed]) -> Iterator[Seed]:
    """Yield from all in turn, first what goes straight, unless that is hopeless.

    Where what goes straight hits things, and so does what goes around, or does not get there, base and arm are looked for
    together; that comes first then.
    """
    for seed in straight:
        other = next(around, None) if seed.shortfall > _POOR else None
        if seed.shortfall > _POOR and (other is None or other.shortfall > _POOR):
            poor = sorted([seed] if other is None else [seed, other], key=lambda one: one.shortfall)
            for good in trees:
                yield good
                poor = [replace(one, shortfall=max(one.shortfall, 2 * HOPELESS)) for one in poor]
            yield from poor
        elif other is not None and seed.shortfall > HOPELESS:
            yield other
            yield seed
        else:
            yield seed
            yield from islice(around, 1) if other is None else [other]
    yield from around
    yield from trees


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

    def __init__(
        self,
        problem: TrajectoryProblem,
        method: str,
        seed: int,
        notes: list[str],
        routes: Routes,
        interrupt: Interrupt,
        *,
        known: Known | None = None,
        like: _Seeds | None = None,
    ) -> None:
        self.problem, self.method, self.notes, self.like = problem, method, notes, like
        self.interrupt = interrupt
        self.found: Found | None = None
        self.knots = Knots(problem, np.random.default_rng(seed), known)
        drives = problem.chain.robot.base != "fixed"
        self.beam = Beam(self.knots, routes if drives and method != "interpolated" else None, interrupt)
        approach = Approach(self.knots)
        if method == "rrt":
            approach.stands = self.beam.careful = True
            self.joiner = Joiner(self.knots, approach, Trees(self.knots, routes, interrupt))
        else:
            self.joiner = Joiner(self.knots, approach, Around(routes) if drives and method == "astar" else None)

    def seeds(self, count: int) -> Iterator[Seed]:
        """Yield seeds through the cheapest paths of knots: of one quick search if that is any good, then of thorough ones."""
        given: list[NDArray[np.float64]] = []
        for attempt in range(count + 1):
            if self.interrupt.pressed:
                return
            found = self._search(attempt)
            if found is None:
                continue
            order = np.argsort(found.cost + _HIT * (found.trouble > 0) * (self.method == "rrt"), kind="stable")
            cheap = order[found.cost[order] <= _DEARER * found.cost[order[0]]]
            for apart, some in ((_DIFFERENT, order), (_ELSEWHERE, cheap)):
                new = [k for k in some if all(_distance(found.paths[k], other) > apart for other in given)]
                best = self._best(found.paths, new, found.at)
                if best is None:  # nor elsewhere: that is some of the same
                    break
                index, z, short = best
                given.append(found.paths[index])
                yield Seed(self.method if len(given) == 1 else f"{self.method} {len(given)}", z, short)
                if len(given) == count:
                    return

    def _search(self, attempt: int) -> Found | None:
        """Return what a search finds: a quick one, then thorough ones, with trees also backwards; None if it is no good."""
        found = self.like.found if attempt == 0 and self.like is not None else None
        if found is None or found.trouble.min() > 0:
            found = self.beam.search(thorough=attempt > 0, backwards=self.method == "rrt" and attempt % 2 == 1)
        if found is None:
            return None
        self.found = found if self.beam.tolerable(found) else None
        return self.found if attempt == 0 or self.method == "rrt" else found

    def _best(
        self, paths: NDArray[np.float64], candidates: list[int], at: list[int]
    ) -> tuple[int, NDArray[np.float64], float] | None:
        """Return the path, of the cheapest, whose seed has the least l1 merit, that seed and its shortfall.

        The first that is free will do, with trees the first that is nearly so. None if there is no way in any of them.
        """
        best, least, tries = None, np.inf, _LOOKED
        if self.method == "rrt":
            candidates, tries = self._apart(paths, candidates), _GROWN
        for index in candidates[:tries]:
            z = self.joiner.join(paths[index], at)
            if self.interrupt.pressed:  # what was not found may be there all the same
                return None
            self.notes += [line for line in self.joiner.blocked if line not in self.notes]
            if z is None:
                continue
            contacts = self.problem.evaluate_contacts(z, reach=self.problem.options.dist_safe, nearest=1)
            short = float(contacts.shortfall(len(z)).sum())
            merit = self.problem.objective(z, self.problem.timing_for(z).dt) + self.problem.options.penalty * short
            if merit < least:
                best, least = (index, z, short), merit
            if short < (_POOR if self.method == "rrt" else _FREE):
                break
        return best

    def _apart(self, paths: NDArray[np.float64], candidates: list[int]) -> list[int]:
        """Return candidates of which no two are alike: where no way is found to one, there is hardly one to the other."""
        kept: list[int] = []
        for index in candidates:
            if all(_distance(paths[index], paths[other]) > _DIFFERENT for other in kept):
                kept.append(index)
        return kept


def _distance(path: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return by how much the base differs somewhere between two paths, both (K, n) [m] or [rad]."""
    return float(np.abs(path - other)[:, :3].max())
