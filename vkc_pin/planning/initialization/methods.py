"""Seeds for the solver: stationary, or through configurations the planner finds itself, straight or around what is in the way."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from vkc_pin.planning.initialization.approach_paths import Approach
from vkc_pin.planning.initialization.base_routes import Routes
from vkc_pin.planning.initialization.beam_search import Beam, Found
from vkc_pin.planning.initialization.initial_guess import Seed, perturbed
from vkc_pin.planning.initialization.interpolation import Joiner, RrtPaths, base_paths
from vkc_pin.planning.initialization.keyframes import ALIKE, Knots, Known, follow_objects
from vkc_pin.planning.initialization.rrt import far_round
from vkc_pin.planning.nlp.merit import Merit, measure_infeasibility
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["INITIALIZATIONS", "initialize"]

INITIALIZATIONS = ("auto", "interpolated", "astar", "rrt", "stationary")
# [m] overlap at a waypoint above which other seeds come first, and shortfall in all up to which a
# seed will do
_POOR = 0.045
_COMPARED_PATHS = 8  # paths of the beam whose seeds are compared, or along which trees grow
_PLACES = (
    128  # random places of which one is where a phase ends, once the stationary seed led nowhere
)


def initialize(
    problem: TrajectoryProblem,
    method: str,
    random_seed: int,
    *,
    count: int = 1,
    perturbation: float = 0.0,
    notes: list[str] | None = None,
    hopeless: Callable[[Sequence[int]], bool] = lambda _: False,
) -> Iterator[Seed]:
    """Yield up to `count` seeds of each kind, best first; each is looked for when it is asked for.

    Args:
        problem: What is to be solved.
        method: "stationary": the robot stays at its start, only the objects' joints go to their
            goals; in seeds after the first the base goes straight to random places, twice as many,
            as they take no search. "interpolated": straight to a configuration at each goal, found
            by inverse kinematics from random seeds; where something fixed is held, the seed follows
            its motion. "astar": to such configurations, the base along the shortest way around what
            stands there, heading along it. "rrt": to such configurations, base and arm together
            along what two random trees find. "auto": these three in turn; where what one finds
            overlaps things, the next is asked at once, and the best that was found comes first.
        random_seed: Of the random numbers.
        count: How many different seeds to return.
        perturbation: Standard deviation of what is added to the robot's coordinates, smoothly over
            time, [m] and [rad].
        notes: Gets a line for every phase in which there is no way for the base.
        hopeless: Asked by "auto" before trees grow: whether no way helps, since a goal is blocked;
            then none grow. It is told which phases, by number, have ends at which no search has
            come upon a free configuration.
    """
    said: list[str] = [] if notes is None else notes
    if method == "stationary":
        seeds = _stationary(problem, 2 * count - 1, np.random.default_rng([random_seed, 2]))
    else:
        shared = _Shared(problem, random_seed, said, Routes(problem), Known())
        kinds = ("interpolated", "astar", "rrt") if method == "auto" else (method,)
        asked = hopeless if method == "auto" else lambda _: False
        seeds = _in_turn(*(_kind(kind, shared, count, asked) for kind in kinds))
    rng = np.random.default_rng([random_seed, 1])
    for item in seeds:
        yield (
            replace(item, z=perturbed(problem, item.z, perturbation, rng)) if perturbation else item
        )


def _kind(
    method: str, shared: _Shared, count: int, hopeless: Callable[[Sequence[int]], bool]
) -> Iterator[Seed | None]:
    """Yield the seeds of one kind; nothing is made before the first is asked for."""
    if method != "rrt":
        yield from _SeedSearch(shared, method).seeds(count)
    elif not hopeless(shared.unknown()):  # trees take their time
        yield from _Rrt(shared).seeds(count)


def _in_turn(*kinds: Iterator[Seed | None]) -> Iterator[Seed]:
    """Yield from all kinds in turn; seeds that hit things wait until no kind has a better one.

    Kinds are asked in this order until one finds a seed that is good. The next time, those that
    found none the last time come after the others; of both, those come first that have waited
    longest. If none finds any, the best of all so far is yielded.
    """
    waiting, found, poor = list(kinds), list[Seed](), set[Iterator[Seed | None]]()
    while waiting or found:
        for kind in sorted(waiting, key=lambda kind: kind in poor):
            waiting.remove(kind)
            try:
                seed = next(kind)
            except StopIteration:
                continue
            waiting.append(kind)
            good = seed is not None and not seed.overlap > _POOR
            (poor.discard if good else poor.add)(kind)
            if seed is not None:
                found.append(seed)
            if good:
                break
        if found:
            yield found.pop(min(range(len(found)), key=lambda k: found[k].overlap))


def _stationary(problem: TrajectoryProblem, count: int, rng: np.random.Generator) -> Iterator[Seed]:
    """Yield a seed in which the robot stands still, then others in which its base goes straight to random places.

    Of the places drawn for the end of a phase, near and far, the one is taken with which the merit
    up to there is least. An arm on a fixed base goes to random postures in the same way.
    """
    still = follow_objects(problem, problem.still)
    yield Seed("stationary", still)
    robot = problem.chain.robot
    columns = np.arange(3, robot.coordinates.size) if robot.base == "fixed" else np.arange(3)
    for number in range(2, count + 1):
        z = still
        for begin, end in itertools.pairwise([0, *problem.ends.tolist()]):
            now = problem.waypoints(z)[begin, columns]
            share = np.minimum(np.arange(1, len(z) - begin + 1) / (end - begin), 1.0)[:, None]
            tried = np.tile(z, (_PLACES, 1, 1))
            for moved in tried:
                moved[begin:, columns] = now + share * rng.uniform() * (
                    _place(problem, end, columns, rng) - now
                )
            z = min(map(problem.clip, tried), key=lambda z: _merit(problem, z, end))
        yield Seed(f"stationary {number}", z)


def _place(
    problem: TrajectoryProblem, waypoint: int, columns: Ints, rng: np.random.Generator
) -> Floats:
    """Return random values of coordinates at a waypoint: lengths within their limits, angles up to half a turn from the start."""
    lower, upper = problem.lower[waypoint - 1, columns], problem.upper[waypoint - 1, columns]
    turning = np.array([problem.unit(problem.chain.names[column]) == "rad" for column in columns])
    middle = problem.start[columns]
    return rng.uniform(
        np.where(turning, middle - np.pi, lower), np.where(turning, middle + np.pi, upper)
    )


def _merit(problem: TrajectoryProblem, z: Floats, waypoint: int) -> float:
    """Return the merit of z_1..z_N, shape (N, n), from which what is missing after a waypoint is left out."""
    timing, options = problem.timing_for(z), problem.options
    contacts = problem.evaluate_contacts(
        z, reach=options.largest_margin, nearest=options.contact_slots
    )
    missing = Merit(options.penalty).compute_penalty(
        measure_infeasibility(problem, z, timing, contacts, rates=False), clearance=True
    )
    return problem.objective(z, timing.dt) + float(missing[:waypoint].sum())


@dataclass(frozen=True, eq=False)
class _Shared:
    """What the searches for seeds of one problem have in common: also the paths of the base, and what was found out."""

    problem: TrajectoryProblem
    random_seed: int
    notes: list[str]
    routes: Routes
    known: Known

    @property
    def driven(self) -> Routes | None:
        """The paths of the base; None if it is fixed."""
        return self.routes if self.problem.chain.robot.base != "fixed" else None

    def knots(self) -> Knots:
        """Return where configurations come from, with random numbers of its own."""
        return Knots(self.problem, np.random.default_rng(self.random_seed), self.known)

    def unknown(self) -> list[int]:
        """Return the numbers of the phases at whose ends no search has come upon a free configuration so far."""
        return [
            number
            for number, end in enumerate(self.problem.ends.tolist())
            if not self.knots().knows_free(end)
        ]


class _SeedSearch:
    """Joins the knots of the cheapest paths.

    Args:
        shared: Problem, random numbers, notes.
        method: "interpolated": straight from knot to knot; "astar": the base along the shortest
            path, the arm straight.

    Attributes:
        alike: How many coordinates decide whether paths are alike.
    """

    alike: ClassVar[int | None] = None

    def __init__(self, shared: _Shared, method: str) -> None:
        self.problem, self.notes, self.method = shared.problem, shared.notes, method
        self.beam, self.joiner = self._parts(shared)

    def _parts(self, shared: _Shared) -> tuple[Beam, Joiner]:
        """Return what finds knots, and what joins them."""
        knots, routes = shared.knots(), shared.driven if self.method == "astar" else None
        return Beam(knots, routes), Joiner(knots, Approach(knots), base_paths(knots, routes))

    def seeds(self, count: int) -> Iterator[Seed | None]:
        """Yield seeds through the cheapest paths of knots: of one quick search if that is any good, then of thorough ones.

        None is a search without one.
        """
        given: list[Floats] = []
        for attempt in range(count + 1):
            found = self._search(attempt)
            best = None if found is None else self._best(found, given)
            if best is None:
                yield None
                continue
            path, z, overlap = best
            given.append(path)
            yield Seed(
                self.method if len(given) == 1 else f"{self.method} {len(given)}", z, overlap
            )
            if len(given) == count:
                return

    def _search(self, attempt: int) -> Found | None:
        """Return what a search finds: a quick one, None if it is no good, then thorough ones."""
        found = self._searched(thorough=attempt > 0)
        return found if attempt > 0 or self.beam.tolerable(found) else None

    def _searched(self, **how: bool) -> Found:
        """Return what a search finds; if it is no good, and the base is steered, with headings kept apart."""
        found = self.beam.search(**how)
        if self.problem.rolling.turning_radius > 0.0 and not self.beam.tolerable(found):
            found = min(
                found, self.beam.search(**how, apart=True), key=lambda one: float(one.cost.min())
            )
        return found

    def _ordered(self, found: Found) -> Iterable[Floats]:
        """Return paths in the order in which they are to be joined, each after what it comes to when it is shortened.

        What is short may be what grazes things, so that the merit of their seeds chooses between
        the two.
        """
        if len(found.at) == 2:  # the search has shortened ways to one knot alone
            return found.paths[np.argsort(found.cost, kind="stable")]
        short = self.beam.shortened(found)
        order = np.argsort(short.cost, kind="stable")
        return itertools.chain.from_iterable(
            zip(short.paths[order], found.paths[order], strict=True)
        )

    def _tried(self, paths: Sequence[Floats]) -> Sequence[Floats]:
        """Return a few paths of which no two are alike."""
        kept: list[Floats] = []
        for path in paths:
            if len(kept) < _COMPARED_PATHS and all(
                np.abs(path - other)[:, : self.alike].max() > ALIKE for other in kept
            ):
                kept.append(path)
        return kept

    def _differ(self, path: Floats, other: Floats) -> bool:
        """Return whether the base is elsewhere somewhere along paths, (K, n), by more than a clearance [m] or [rad]."""
        return bool(np.abs(path - other)[:, :3].max() > self.problem.options.dist_safe)

    def _will_do(self, z: Floats, short: float, overlap: float) -> bool:
        """Return whether a seed that falls so short of clearances [m], and overlaps so much [m], is not compared with others."""
        return short < _POOR

    def _best(self, found: Found, given: Sequence[Floats]) -> tuple[Floats, Floats, float] | None:
        """Return the path, of the first that are not `given`, whose seed has the least l1 merit, that seed and its overlap.

        The first that will do is not compared with those after it. None if no path of the robot
        leads through any of them.
        """
        new = [
            path
            for path in self._ordered(found)
            if all(self._differ(path, other) for other in given)
        ]
        best, least = None, np.inf
        for path in self._tried(new):
            z = self.joiner.join(path, found.at)
            self.notes += [line for line in self.joiner.blocked if line not in self.notes]
            if z is None:
                continue
            contacts = self.problem.evaluate_contacts(
                z, reach=self.problem.options.largest_margin, nearest=1
            )
            short = contacts.compute_shortfall(len(z))
            overlap = float(max(short.max() - self.problem.options.dist_safe, 0.0))
            merit = self.problem.objective(
                z, self.problem.timing_for(z).dt
            ) + self.problem.options.penalty * float(short.sum())
            if merit < least:
                best, least = (path, z, overlap), merit
            if self._will_do(z, float(short.sum()), overlap):
                break
        return best


class _Rrt(_SeedSearch):
    """Base and arm together along what two random trees find; slow, so the first seed that is nearly free and direct will do."""

    alike = 3  # where nothing leads along the base's path, hardly anything does with another arm

    def __init__(self, shared: _Shared) -> None:
        super().__init__(shared, "rrt")
        self.vain = set[
            bool
        ]()  # directions, backwards or not, in which the last search found nothing

    def _parts(self, shared: _Shared) -> tuple[Beam, Joiner]:
        knots = shared.knots()
        beam = Beam(knots, shared.driven, careful=True)
        return beam, Joiner(knots, Approach(knots, stands=True), RrtPaths(knots, shared.routes))

    def _search(self, attempt: int) -> Found | None:
        """Return what a search finds: every other goes backwards, but none where only the last of its direction was in vain."""
        backwards = attempt % 2 == 1
        if self.vain == {backwards}:
            backwards = not backwards
        found = self._searched(thorough=attempt > 0, backwards=backwards)
        if self.beam.tolerable(found):
            self.vain.discard(backwards)
            return found
        self.vain.add(backwards)
        return None

    def _will_do(self, z: Floats, short: float, overlap: float) -> bool:
        return overlap <= _POOR and not far_round(self.problem, z)

    def _ordered(self, found: Found) -> Iterable[Floats]:
        return found.paths[
            np.lexsort((found.cost, found.trouble > 0))
        ]  # those with knots in collision last
