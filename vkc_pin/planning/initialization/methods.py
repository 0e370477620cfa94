"""Generates initial guesses for the solver: stationary, interpolated, A* and RRT."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from vkc_pin.planning.initialization.approach_paths import ApproachPaths
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.beam_search import BeamSearch, SearchResult
from vkc_pin.planning.initialization.initial_guess import InitialGuess, perturb
from vkc_pin.planning.initialization.interpolation import Interpolator, RrtPaths, make_base_paths
from vkc_pin.planning.initialization.keyframes import (
    SIMILARITY_TOLERANCE,
    KeyframeCache,
    KeyframeSampler,
    interpolate_object_joints,
)
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats

Initialization = Literal["auto", "interpolated", "astar", "rrt", "stationary"]
INITIALIZATIONS: tuple[Initialization, ...] = get_args(Initialization)
MAX_GOOD_PENETRATION = 0.045
"""Penetration [m] at a waypoint, or total shortfall, of a guess that is good enough."""
_Kind = Iterator[InitialGuess | None]
_COMPARED_PATHS = 8  # paths of the beam that are turned into guesses and compared


def initialize(
    problem: TrajectoryProblem,
    method: str,
    random_seed: int,
    *,
    count: int = 1,
    check_factor: int = 1,
    perturbation: float = 0.0,
    notes: list[str] | None = None,
    is_infeasible: Callable[[Sequence[int]], bool] = lambda _: False,
) -> Iterator[InitialGuess]:
    """Generate up to `count` initial guesses per method, best first and on demand.

    Args:
        problem: Problem to solve.
        method: "stationary": the robot stays at its start, and only the object joints move to their
            goals; in later guesses, twice as many since they need no search, the base moves
            straight to random places. "interpolated": straight to a configuration at each goal,
            found by inverse kinematics from random starts; where the robot moves an articulated
            object, the guess follows its motion. "astar": to such configurations with the base on
            the shortest path around obstacles. "rrt": to such configurations on paths of base and
            arm that two random trees find. "auto": these three, interleaved.
        random_seed: Random seed.
        count: Maximum number of guesses per method.
        check_factor: Factor of the collision checks of searches with trees.
        perturbation: Standard deviation of smooth noise on the robot's coordinates [m] or [rad].
        notes: List that receives a line for every phase without a base path.
        is_infeasible: Called by "auto" before trees grow, with the numbers of the phases at whose
            ends no search has found a collision-free configuration. If it returns True, no trees
            grow.
    """
    if method == "stationary":
        rng = np.random.default_rng([random_seed, 2])
        guesses = _generate_stationary_guesses(problem, 2 * count - 1, rng)
    else:
        notes = [] if notes is None else notes
        shared = _Shared(
            problem,
            problem.compute_cost,
            random_seed,
            notes,
            BaseRoutes(problem),
            KeyframeCache(),
            check_factor,
        )
        if method == "auto":
            kinds = ["interpolated", "astar", "rrt"]
            if problem.chain.robot.base == "fixed":
                kinds.remove("astar")  # it would equal "interpolated"
            guesses = interleave_guesses(
                *[_generate_guesses(kind, shared, count, is_infeasible) for kind in kinds]
            )
        else:
            found = _generate_guesses(method, shared, count, lambda _: False)
            guesses = (guess for guess in found if guess is not None)
    rng = np.random.default_rng([random_seed, 1])
    for guess in guesses:
        if perturbation:
            guess = replace(guess, z=perturb(problem, guess.z, perturbation, rng))
        yield guess


def interleave_guesses(*kinds: _Kind) -> Iterator[InitialGuess]:
    """Interleave initialization methods; None is a search without a guess.

    Methods are tried in order until one returns a good guess, which is nearly collision-free, and
    this is yielded. Next time, methods without a good guess come last, and otherwise those first
    that have waited longest. Without a good guess, the best of the methods that were yielded least
    often is next: guesses of one method tend to fail for the same reason. Deep guesses wait until
    the searches have ended: these take less time than solving from one, which seldom succeeds.
    """

    def is_good(guess: InitialGuess | None) -> bool:
        return guess is not None and not guess.penetration > MAX_GOOD_PENETRATION

    def rank(kind_and_guess: tuple[_Kind, InitialGuess]) -> tuple[int, float]:
        kind, guess = kind_and_guess
        return 0 if is_good(guess) else 1 + yield_counts[kind], guess.penetration

    waiting = list(kinds)  # methods that may have further guesses
    poor = set[_Kind]()  # methods whose last search found no good guess
    found = list[tuple[_Kind, InitialGuess]]()  # guesses that were not yielded yet
    yield_counts = Counter[_Kind]()
    while waiting or found:
        for kind in sorted(waiting, key=lambda kind: kind in poor):
            waiting.remove(kind)
            try:
                guess = next(kind)
            except StopIteration:
                continue
            waiting.append(kind)
            if guess is not None:
                found.append((kind, guess))
            if is_good(guess):
                poor.discard(kind)
                break
            poor.add(kind)
        ready = found
        if waiting:
            ready = [(kind, guess) for kind, guess in found if not guess.is_deep]
        if ready:
            best = min(ready, key=rank)
            found.remove(best)
            kind, guess = best
            yield_counts[kind] += 1
            yield guess


def _generate_stationary_guesses(
    problem: KinematicProblem, count: int, rng: np.random.Generator
) -> Iterator[InitialGuess]:
    """Generate a guess with a stationary robot, then others in which the base moves straight.

    The base moves to a random place, near or far, in each phase; an arm on a fixed base, to a
    random posture. Lengths are sampled within limits, angles within π of the start.
    """
    still = interpolate_object_joints(problem, problem.still)
    yield InitialGuess("stationary", still)
    robot = problem.chain.robot
    columns = np.arange(3, robot.coordinates.size) if robot.base == "fixed" else np.arange(3)
    units = [problem.unit(problem.chain.names[column]) for column in columns]
    is_angle = np.array([unit == "rad" for unit in units])
    middle = problem.start[columns]
    for number in range(2, count + 1):
        z = still.copy()
        for begin, end in itertools.pairwise([0, *problem.ends.tolist()]):
            now = problem.waypoints(z)[begin, columns]
            s = np.minimum(np.arange(1, len(z) - begin + 1) / (end - begin), 1.0)[:, None]
            low = np.where(is_angle, middle - np.pi, problem.lower[end - 1, columns])
            high = np.where(is_angle, middle + np.pi, problem.upper[end - 1, columns])
            # Part of the displacement to a random place: near places are as likely as far ones.
            fraction = rng.uniform()
            displacement = rng.uniform(low, high) - now
            z[begin:, columns] = now + s * fraction * displacement
        yield InitialGuess(f"stationary {number}", problem.clip(z))


@dataclass(frozen=True, eq=False)
class _Shared:
    """Data that the searches of one problem share."""

    problem: KinematicProblem
    compute_cost: Callable[[Floats], float]
    random_seed: int
    notes: list[str]
    routes: BaseRoutes
    cache: KeyframeCache
    check_factor: int

    @property
    def driving_routes(self) -> BaseRoutes | None:
        """Base paths, unless the base is fixed."""
        return self.routes if self.problem.chain.robot.base != "fixed" else None

    def make_sampler(self) -> KeyframeSampler:
        """Return a sampler that starts with the random seed, and shares results."""
        return KeyframeSampler(self.problem, np.random.default_rng(self.random_seed), self.cache)


def _generate_guesses(
    method: str, shared: _Shared, count: int, is_infeasible: Callable[[Sequence[int]], bool]
) -> Iterator[InitialGuess | None]:
    """Generate the guesses of one method; nothing is computed before the first is requested."""
    if method != "rrt":
        yield from _GuessSearch(shared, method).generate(count)
        return
    blocked = []
    for number, end in enumerate(shared.problem.ends.tolist()):
        if not shared.make_sampler().has_free_keyframe(end):
            blocked.append(number)
    if not is_infeasible(blocked):
        yield from _RrtSearch(shared, method).generate(count)


class _GuessSearch:
    """Generates guesses along the cheapest keyframe paths: straight, or with A* for the base."""

    def __init__(self, shared: _Shared, method: str) -> None:
        self.problem = shared.problem
        self.compute_cost = shared.compute_cost
        self.notes = shared.notes
        self.method = method
        self.beam, self.interpolator = self._make_parts(shared)

    def _make_parts(self, shared: _Shared) -> tuple[BeamSearch, Interpolator]:
        """Return the search of keyframes, and the interpolation between them."""
        sampler = shared.make_sampler()
        routes = shared.driving_routes if self.method == "astar" else None
        paths = make_base_paths(sampler, routes)
        return BeamSearch(sampler, routes), Interpolator(sampler, ApproachPaths(sampler), paths)

    def generate(self, count: int) -> Iterator[InitialGuess | None]:
        """Generate guesses: one from a quick search if it is acceptable, others from thorough ones.

        None is a search without a guess.
        """
        used: list[Floats] = []
        for attempt in range(count + 1):
            found = self._search(attempt)
            best = None if found is None else self._select_best(found, used)
            if best is None:
                yield None
                continue
            path, z, penetration = best
            used.append(path)
            name = self.method if len(used) == 1 else f"{self.method} {len(used)}"
            yield InitialGuess(name, z, penetration)
            if len(used) == count:
                return

    def _search(self, attempt: int) -> SearchResult | None:
        """Run a search; None if it was quick and its result is not acceptable."""
        is_thorough = attempt > 0
        found = self._run_beam_search(thorough=is_thorough, backwards=self.beam.has_dead_ends)
        if is_thorough or self.beam.is_acceptable(found):
            return found
        return None

    def _run_beam_search(self, **how: bool) -> SearchResult:
        """Run the beam search; if it fails for a steered base, again with diverse headings."""
        found = self.beam.search(**how)
        if self.problem.rolling.turning_radius > 0.0 and not self.beam.is_acceptable(found):
            other = self.beam.search(**how, keep_headings=True)
            found = min(found, other, key=lambda result: float(result.cost.min()))
        return found

    def _interpolate(self, path: Floats, found: SearchResult) -> Floats | None:
        """Interpolate along a path of keyframes."""
        return self.interpolator.interpolate(path, found.waypoints)

    def _is_same(self, path: Floats, other: Floats) -> bool:
        """Return whether two paths lead to the same guess."""
        return bool(np.abs(path - other).max() <= SIMILARITY_TOLERANCE)

    def _order_paths(self, found: SearchResult) -> Iterable[Floats]:
        """Return paths by cost."""
        return found.paths[np.argsort(found.cost, kind="stable")]

    def _is_sufficient(self, z: Floats, shortfall: float, penetration: float) -> bool:
        """Return whether a guess is good enough to skip the comparison with others."""
        return shortfall < MAX_GOOD_PENETRATION

    def _select_best(
        self, found: SearchResult, used: Sequence[Floats]
    ) -> tuple[Floats, Floats, float] | None:
        """Select the guess of least ℓ1 merit among the first paths that differ from `used` ones.

        The first sufficient guess ends the comparison. Returns path, guess and penetration [m].
        """
        problem = self.problem
        options = problem.options
        best = None
        least_merit = np.inf
        compared = list[Floats]()
        for path in self._order_paths(found):
            if len(compared) == _COMPARED_PATHS:
                break
            if any(self._is_same(path, other) for other in [*used, *compared]):
                continue
            compared.append(path)
            z = self._interpolate(path, found)
            self.notes += [line for line in self.interpolator.blocked if line not in self.notes]
            if z is None:
                continue
            contacts = problem.evaluate_contacts(z, reach=options.largest_margin, nearest=1)
            shortfall = contacts.compute_shortfall(len(z))
            penetration = float(max(shortfall.max() - options.dist_safe, 0.0))
            total = float(shortfall.sum())
            merit = self.compute_cost(z) + options.penalty * total
            if merit < least_merit:
                best = (path, z, penetration)
                least_merit = merit
            if self._is_sufficient(z, total, penetration):
                break
        return best


class _RrtSearch(_GuessSearch):
    """Generates guesses with RRT paths of base and arm.

    Trees are slow, so the first guess that is nearly free is taken.
    """

    def _make_parts(self, shared: _Shared) -> tuple[BeamSearch, Interpolator]:
        # Directions (backwards or not) in which the last search failed.
        self.failed_directions = set[bool]()
        sampler = shared.make_sampler()
        beam = BeamSearch(sampler, shared.driving_routes, for_narrow_passages=True)
        self.paths = RrtPaths(sampler, shared.routes, check_factor=shared.check_factor)
        approach = ApproachPaths(sampler, keeps_base_fixed=True)
        return beam, Interpolator(sampler, approach, self.paths)

    def _search(self, attempt: int) -> SearchResult | None:
        """Run a search, every second one backwards, avoiding a direction that alone failed last."""
        backwards = attempt % 2 == 1
        if self.failed_directions == {backwards}:
            backwards = not backwards
        found = self._run_beam_search(thorough=attempt > 0, backwards=backwards)
        if self.beam.is_acceptable(found):
            self.failed_directions.discard(backwards)
            return found
        self.failed_directions.add(backwards)
        return None

    def _interpolate(self, path: Floats, found: SearchResult) -> Floats | None:
        """Interpolate along a path; an arm may end in other postures of the same goal."""
        are_same = (found.paths[:, :-1] == path[:-1]).all(axis=(1, 2))
        is_free = found.collision_cost <= 0.0
        self.paths.final_ends = found.paths[are_same & is_free, -1]
        return super()._interpolate(path, found)

    def _is_same(self, path: Floats, other: Floats) -> bool:
        return False  # trees find another path each time

    def _is_sufficient(self, z: Floats, shortfall: float, penetration: float) -> bool:
        return penetration <= MAX_GOOD_PENETRATION

    def _order_paths(self, found: SearchResult) -> Iterable[Floats]:
        # Paths with keyframes in collision come last.
        return found.paths[np.lexsort((found.cost, found.collision_cost > 0))]
