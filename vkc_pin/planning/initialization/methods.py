"""Generates initial guesses for the solver: stationary, interpolated, A* and RRT."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

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
from vkc_pin.planning.initialization.rrt import has_arm_detour
from vkc_pin.planning.nlp.merit import Merit, measure_infeasibility
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["INITIALIZATIONS", "MAX_GOOD_PENETRATION", "initialize", "interleave_guesses"]

INITIALIZATIONS = ("auto", "interpolated", "astar", "rrt", "stationary")
# [m] penetration at a waypoint above which other guesses come first, and total shortfall up to
# which a guess is good enough
MAX_GOOD_PENETRATION = 0.045
_COMPARED_PATHS = 8  # paths of the beam that are turned into guesses and compared
_PLACE_SAMPLES = 128  # random places that are compared for each phase end of a stationary guess


def initialize(
    problem: TrajectoryProblem,
    method: str,
    random_seed: int,
    *,
    count: int = 1,
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
            arm that two random trees find. "auto": these three in turn; if one finds a guess in
            collision, the next one is tried at once, and the best guess so far comes first.
        random_seed: Random seed.
        count: Maximum number of guesses per method.
        perturbation: Standard deviation of smooth noise on the robot's coordinates [m] or [rad].
        notes: List that receives a line for every phase without a base path.
        is_infeasible: Called by "auto" before trees grow, with the numbers of the phases at whose
            ends no search has found a collision-free configuration. If it returns True, no trees
            grow.

    Yields:
        Initial guesses.
    """
    messages: list[str] = [] if notes is None else notes
    if method == "stationary":
        guesses = _generate_stationary_guesses(
            problem, 2 * count - 1, np.random.default_rng([random_seed, 2])
        )
    else:
        shared = _Shared(problem, random_seed, messages, BaseRoutes(problem), KeyframeCache())
        kinds = ("interpolated", "astar", "rrt") if method == "auto" else (method,)
        check = is_infeasible if method == "auto" else lambda _: False
        guesses = interleave_guesses(
            *(_generate_guesses(kind, shared, count, check) for kind in kinds)
        )
    rng = np.random.default_rng([random_seed, 1])
    for guess in guesses:
        yield (
            replace(guess, z=perturb(problem, guess.z, perturbation, rng))
            if perturbation
            else guess
        )


def _generate_guesses(
    method: str, shared: _Shared, count: int, is_infeasible: Callable[[Sequence[int]], bool]
) -> Iterator[InitialGuess | None]:
    """Generate the guesses of one method; nothing is computed before the first is requested."""
    if method != "rrt":
        yield from _GuessSearch(shared, method).generate(count)
    elif not is_infeasible(shared.find_phases_without_free_end()):  # trees take time
        yield from _RrtSearch(shared).generate(count)


def interleave_guesses(*kinds: Iterator[InitialGuess | None]) -> Iterator[InitialGuess]:
    """Interleave the initialization methods.

    Guesses in collision are postponed until no method offers a collision-free one. Methods are
    tried in order until one returns a good guess. Next time, methods that returned none come after
    the others, and those that have waited longest come first. If no method returns a good guess,
    the best one so far is yielded.
    """
    waiting, found, poor = list(kinds), list[InitialGuess](), set[Iterator[InitialGuess | None]]()
    while waiting or found:
        for kind in sorted(waiting, key=lambda kind: kind in poor):
            waiting.remove(kind)
            try:
                guess = next(kind)
            except StopIteration:
                continue
            waiting.append(kind)
            good = guess is not None and not guess.penetration > MAX_GOOD_PENETRATION
            (poor.discard if good else poor.add)(kind)
            if guess is not None:
                found.append(guess)
            if good:
                break
        if found:
            yield found.pop(min(range(len(found)), key=lambda k: found[k].penetration))


def _generate_stationary_guesses(
    problem: TrajectoryProblem, count: int, rng: np.random.Generator
) -> Iterator[InitialGuess]:
    """Generate a guess with a stationary robot, then others in which the base moves straight.

    The base moves to the random place, near or far, with the least merit up to the end of the
    phase. An arm on a fixed base moves to random postures in the same way.
    """
    still = interpolate_object_joints(problem, problem.still)
    yield InitialGuess("stationary", still)
    robot = problem.chain.robot
    columns = np.arange(3, robot.coordinates.size) if robot.base == "fixed" else np.arange(3)
    for number in range(2, count + 1):
        z = still
        for begin, end in itertools.pairwise([0, *problem.ends.tolist()]):
            now = problem.waypoints(z)[begin, columns]
            share = np.minimum(np.arange(1, len(z) - begin + 1) / (end - begin), 1.0)[:, None]
            tried = np.tile(z, (_PLACE_SAMPLES, 1, 1))
            for moved in tried:
                moved[begin:, columns] = now + share * rng.uniform() * (
                    _sample_place(problem, end, columns, rng) - now
                )
            z = min(map(problem.clip, tried), key=lambda z: _compute_merit(problem, z, end))
        yield InitialGuess(f"stationary {number}", z)


def _sample_place(
    problem: TrajectoryProblem, waypoint: int, columns: Ints, rng: np.random.Generator
) -> Floats:
    """Sample coordinates at a waypoint: lengths within limits, angles within π of the start."""
    lower, upper = problem.lower[waypoint - 1, columns], problem.upper[waypoint - 1, columns]
    turning = np.array([problem.unit(problem.chain.names[column]) == "rad" for column in columns])
    middle = problem.start[columns]
    return rng.uniform(
        np.where(turning, middle - np.pi, lower), np.where(turning, middle + np.pi, upper)
    )


def _compute_merit(problem: TrajectoryProblem, z: Floats, waypoint: int) -> float:
    """Return the merit of z_1..z_N, shape (N, n), without violations after a waypoint."""
    timing, options = problem.timing_for(z), problem.options
    contacts = problem.evaluate_contacts(
        z, reach=options.largest_margin, nearest=options.contact_slots
    )
    penalty = Merit(options.penalty).compute_penalty(
        measure_infeasibility(problem, z, timing, contacts, rates=False), clearance=True
    )
    return problem.objective(z, timing.dt) + float(penalty[:waypoint].sum())


@dataclass(frozen=True, eq=False)
class _Shared:
    """Data that the searches of one problem share, among it base paths and sampled keyframes."""

    problem: TrajectoryProblem
    random_seed: int
    notes: list[str]
    routes: BaseRoutes
    cache: KeyframeCache

    @property
    def driving_routes(self) -> BaseRoutes | None:
        """The base paths; None for a fixed base."""
        return self.routes if self.problem.chain.robot.base != "fixed" else None

    def make_sampler(self) -> KeyframeSampler:
        """Return a keyframe sampler with its own random number generator."""
        return KeyframeSampler(self.problem, np.random.default_rng(self.random_seed), self.cache)

    def find_phases_without_free_end(self) -> list[int]:
        """Return the numbers of phases without a known collision-free end configuration."""
        return [
            number
            for number, end in enumerate(self.problem.ends.tolist())
            if not self.make_sampler().has_free_keyframe(end)
        ]


class _GuessSearch:
    """Generates guesses along the cheapest keyframe paths.

    Args:
        shared: Shared data.
        method: "interpolated": straight between keyframes. "astar": the base on the shortest path,
            the arm straight.

    Attributes:
        compared_columns: Number of leading coordinates by which paths are compared; None: all.
    """

    compared_columns: ClassVar[int | None] = None

    def __init__(self, shared: _Shared, method: str) -> None:
        self.problem, self.notes, self.method = shared.problem, shared.notes, method
        self.beam, self.interpolator = self._make_parts(shared)

    def _make_parts(self, shared: _Shared) -> tuple[BeamSearch, Interpolator]:
        """Return the keyframe search and the interpolation between keyframes."""
        sampler, routes = (
            shared.make_sampler(),
            shared.driving_routes if self.method == "astar" else None,
        )
        return BeamSearch(sampler, routes), Interpolator(
            sampler, ApproachPaths(sampler), make_base_paths(sampler, routes)
        )

    def generate(self, count: int) -> Iterator[InitialGuess | None]:
        """Generate guesses: one from a quick search if it is acceptable, others from thorough ones.

        Yields:
            Guesses, or None for a search without one.
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
        """Run a quick search, None if it is not acceptable; from attempt 1 on, a thorough one."""
        found = self._run_beam_search(thorough=attempt > 0)
        return found if attempt > 0 or self.beam.is_acceptable(found) else None

    def _run_beam_search(self, **how: bool) -> SearchResult:
        """Run the beam search; if it fails for a steered base, again with diverse headings."""
        found = self.beam.search(**how)
        if self.problem.rolling.turning_radius > 0.0 and not self.beam.is_acceptable(found):
            found = min(
                found,
                self.beam.search(**how, keep_headings=True),
                key=lambda one: float(one.cost.min()),
            )
        return found

    def _order_paths(self, found: SearchResult) -> Iterable[Floats]:
        """Return paths by cost, each after its shortened version.

        A shortened path may graze obstacles, so the merit of the guesses decides between the two.
        """
        if len(found.waypoints) == 2:  # paths to a single keyframe are shortened already
            return found.paths[np.argsort(found.cost, kind="stable")]
        short = self.beam.shorten(found)
        order = np.argsort(short.cost, kind="stable")
        return itertools.chain.from_iterable(
            zip(short.paths[order], found.paths[order], strict=True)
        )

    def _select_distinct(self, paths: Sequence[Floats]) -> Sequence[Floats]:
        """Return a few paths of which no two are similar."""
        kept: list[Floats] = []
        for path in paths:
            if len(kept) < _COMPARED_PATHS and all(
                np.abs(path - other)[:, : self.compared_columns].max() > SIMILARITY_TOLERANCE
                for other in kept
            ):
                kept.append(path)
        return kept

    def _base_differs(self, path: Floats, other: Floats) -> bool:
        """Return whether base poses differ along paths, (K, n), by more than the clearance."""
        return bool(np.abs(path - other)[:, :3].max() > self.problem.options.dist_safe)

    def _is_sufficient(self, z: Floats, shortfall: float, penetration: float) -> bool:
        """Return whether a guess is good enough to skip the comparison with others.

        Args:
            z: z_1..z_N, shape (N, n).
            shortfall: Total clearance shortfall [m].
            penetration: Largest penetration [m].
        """
        return shortfall < MAX_GOOD_PENETRATION

    def _select_best(
        self, found: SearchResult, used: Sequence[Floats]
    ) -> tuple[Floats, Floats, float] | None:
        """Select the guess of least ℓ1 merit among the first paths that differ from `used` ones.

        The first sufficient guess ends the comparison.

        Returns:
            Path, guess z_1..z_N, penetration [m]; None if there is no guess.
        """
        new = [
            path
            for path in self._order_paths(found)
            if all(self._base_differs(path, other) for other in used)
        ]
        best, least = None, np.inf
        for path in self._select_distinct(new):
            z = self.interpolator.interpolate(path, found.waypoints)
            self.notes += [line for line in self.interpolator.blocked if line not in self.notes]
            if z is None:
                continue
            contacts = self.problem.evaluate_contacts(
                z, reach=self.problem.options.largest_margin, nearest=1
            )
            shortfall = contacts.compute_shortfall(len(z))
            penetration = float(max(shortfall.max() - self.problem.options.dist_safe, 0.0))
            merit = self.problem.objective(
                z, self.problem.timing_for(z).dt
            ) + self.problem.options.penalty * float(shortfall.sum())
            if merit < least:
                best, least = (path, z, penetration), merit
            if self._is_sufficient(z, float(shortfall.sum()), penetration):
                break
        return best


class _RrtSearch(_GuessSearch):
    """Generates guesses with RRT paths of base and arm.

    Trees are slow, so the first guess that is nearly free and direct is taken.
    """

    compared_columns = 3  # if trees fail along a base path, another arm rarely helps

    def __init__(self, shared: _Shared) -> None:
        super().__init__(shared, "rrt")
        # Directions (backwards or not) in which the last search failed.
        self.failed_directions = set[bool]()

    def _make_parts(self, shared: _Shared) -> tuple[BeamSearch, Interpolator]:
        sampler = shared.make_sampler()
        beam = BeamSearch(sampler, shared.driving_routes, for_narrow_passages=True)
        return beam, Interpolator(
            sampler, ApproachPaths(sampler, keeps_base_fixed=True), RrtPaths(sampler, shared.routes)
        )

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

    def _is_sufficient(self, z: Floats, shortfall: float, penetration: float) -> bool:
        return penetration <= MAX_GOOD_PENETRATION and not has_arm_detour(self.problem, z)

    def _order_paths(self, found: SearchResult) -> Iterable[Floats]:
        # Paths with keyframes in collision come last.
        return found.paths[np.lexsort((found.cost, found.collision_cost > 0))]
