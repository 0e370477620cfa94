"""Searches sequences of keyframes along a task, keeping the cheapest partial paths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.keyframes import (
    SAMPLE_COUNT,
    SIMILARITY_TOLERANCE,
    KeyframeSampler,
)
from vkc_pin.planning.nlp.pose_goals import find_approach_waypoint, find_phase_spans
from vkc_pin.utils.arrays import Bools, Floats, Ints

_BATCHES = 6  # maximum number of batches of random samples: good grasps are rare
# number of collision-free configurations at a keyframe that ends sampling in open phases
_ENOUGH_FREE = 60
# [s] between keyframes in phases with a closed chain, at one waypoint per `Options.dt`
_KEYFRAME_SPACING = 1.0
_BEAM_WIDTH = 24  # configurations kept per keyframe
# cost of a collision, and of its depth [1/m]; 1 rad of a joint costs 1
_COLLISION_COST = 10.0
_DEPTH_COST = 300.0
_UNREACHABLE_COST = 1e3  # cost of an infeasible configuration or a missing base path
_ACCEPTABLE_COST = 60.0  # collision cost that the solver can repair: one or two grazing contacts
_SECTORS = 8  # of base headings
_SECTOR_QUOTA = 4  # configurations preferred per sector
# [m] base motion between keyframes of a closed chain that surely crosses an obstacle
_MAX_JUMP = 0.5


class SearchResult(NamedTuple):
    """Result of a beam search.

    Attributes:
        paths: Configurations at the keyframes, shape (B, keyframes, n), starting with the start.
        cost: Cost of each path, shape (B,).
        collision_cost: Part of the cost that is due to collisions, shape (B,).
        waypoints: Waypoints of the keyframes.
    """

    paths: Floats
    cost: Floats
    collision_cost: Floats
    waypoints: list[int]


class _Mode(NamedTuple):
    """Search mode; see `BeamSearch.search`."""

    thorough: bool
    backwards: bool
    keep_headings: bool = False


class _Continuations(NamedTuple):
    """Indices of the continued paths, shape (B,), configurations, (B, n), and penalties, (B,)."""

    parents: Ints
    z: Floats
    penalty: Floats

    @staticmethod
    def concatenate(parts: Sequence[_Continuations]) -> _Continuations:
        """Return the continuations of all parts."""
        return _Continuations(
            np.concatenate([part.parents for part in parts]),
            np.concatenate([part.z for part in parts]),
            np.concatenate([part.penalty for part in parts]),
        )


class BeamSearch:
    """Searches keyframe sequences of a problem.

    Args:
        sampler: Keyframe sampler.
        routes: Base paths that determine distances. Default: straight lines.
        for_narrow_passages: Whether grasps count as free only if the approach to them is free, too,
            and base paths are those with the arm folded.
    """

    def __init__(
        self,
        sampler: KeyframeSampler,
        routes: BaseRoutes | None = None,
        *,
        for_narrow_passages: bool = False,
    ) -> None:
        self.sampler = sampler
        self.problem = sampler.problem
        self.routes = routes
        self.for_narrow_passages = for_narrow_passages
        options = self.problem.options
        self.metric = np.sqrt(self.problem.metric / options.velocity_weight_arm)
        self.approaches = dict[int, int]()  # waypoint of a grasp → that of the approach to it
        for phase, first, grasp in find_phase_spans(self.problem.task):
            if phase.grasps:
                self.approaches[grasp] = find_approach_waypoint(first, grasp, options)

    def search(
        self, *, thorough: bool, backwards: bool = False, keep_headings: bool = False
    ) -> SearchResult:
        """Search from keyframe to keyframe, keeping the cheapest paths.

        Args:
            thorough: Draw more samples, and perturb the arms at every keyframe of a closed chain.
            backwards: Search closed chains from the release back to the grasp. A passage may be
                wide at its end only, and few configurations that are free at its beginning lead
                there. Or a path onward begins at few configurations only: a robot that pulls a door
                open may end behind it.
            keep_headings: Keep paths with diverse base headings. A steered base needs space to
                turn, and the cheapest path may head where there is none.
        """
        problem = self.problem
        # A grasp with free coordinates is chosen before the object moves.
        for _, grasp, _ in problem.choices:
            if grasp < problem.segments and self.sampler.is_closed_at(grasp + 1):
                backwards = False
        mode = _Mode(thorough, backwards, keep_headings)
        found = SearchResult(problem.start[None, None, :], np.zeros(1), np.zeros(1), [0])
        is_closed = [problem.is_closed(phase) for phase in problem.task.phases]
        count = len(is_closed)
        number = 0
        while number < count:
            last = number  # of an open phase and the closed ones that follow it
            if backwards and not is_closed[number]:
                while last + 1 < count and is_closed[last + 1]:
                    last += 1
            keyframes = list[int]()
            for phase in range(number, last + 1):
                keyframes += self._place_keyframes(phase)
            if last > number:
                found = self._extend_backwards(found, keyframes, number, mode)
            else:
                for keyframe in keyframes:
                    found = self._extend(found, keyframe, number, mode)
            number = last + 1
        return found

    @property
    def has_dead_ends(self) -> bool:
        """Whether a goal was out of reach from where the phases before it ended."""
        return self.routes is not None and bool(self.sampler.cache.unreached)

    def is_acceptable(self, found: SearchResult) -> bool:
        """Return whether the cheapest path has few collisions and, given routes, no base jumps."""
        best = int(np.argmin(found.cost))
        if found.collision_cost[best] > _ACCEPTABLE_COST:
            return False
        if self.routes is None:
            return True
        is_closed = [self.sampler.is_closed_at(waypoint) for waypoint in found.waypoints[1:]]
        motions = np.abs(np.diff(found.paths[best, :, :2], axis=0)).max(axis=1)
        return not np.any((motions > _MAX_JUMP) & is_closed)

    def _is_closed(self, phase: int) -> bool:
        return self.problem.is_closed(self.problem.task.phases[phase])

    def _place_keyframes(self, phase: int) -> list[int]:
        """Return the waypoints of a phase's keyframes."""
        _, begin, end = find_phase_spans(self.problem.task)[phase]
        pieces = 1
        if self._is_closed(phase):
            steps = self.problem.options.steps(_KEYFRAME_SPACING)
            pieces = max(1, round((end - begin) / steps))
        return np.linspace(begin, end, pieces + 1).round().astype(int)[1:].tolist()

    def _extend(self, found: SearchResult, keyframe: int, phase: int, mode: _Mode) -> SearchResult:
        """Extend paths to the next keyframe, in a phase, and keep the cheapest."""
        more = self._sample_continuations(found, keyframe, phase, mode)
        total = self._compute_total(found, more.parents, more.z, phase) + more.penalty
        total += self._compute_onward_cost(more.z, keyframe)
        if keyframe == self.problem.ends[phase] and not self._is_closed(phase):
            self._find_dead_end(found, more, phase)
        best = _select_beam(total, more.z, _SECTORS if mode.keep_headings else 1)
        parents = more.parents[best]
        return SearchResult(
            np.concatenate([found.paths[parents], more.z[best, None]], axis=1),
            total[best],
            found.collision_cost[parents] + more.penalty[best],
            [*found.waypoints, keyframe],
        )

    def _extend_backwards(
        self, found: SearchResult, keyframes: list[int], phase: int, mode: _Mode
    ) -> SearchResult:
        """Extend paths through an open phase and the closed ones after it, from the end backwards.

        All `keyframes` but the first belong to the closed phases.
        """
        known = found.paths.shape[1]
        found = self._extend(found, keyframes[-1], phase, mode)
        for keyframe in keyframes[-2::-1]:
            found = self._extend(found, keyframe, phase + 1, mode)
        found_backwards = found.paths[:, : known - 1 : -1]
        paths = np.concatenate([found.paths[:, :known], found_backwards], axis=1)
        # The search went from the start to the end first: replace this by the path to the grasp.
        start = paths[:, known - 1]
        grasp = paths[:, known]
        end = paths[:, -1]
        cost_to_grasp = self._compute_path_cost(start, grasp, phase)
        cost_to_end = self._compute_path_cost(start, end, phase)
        cost = found.cost + cost_to_grasp - cost_to_end
        waypoints = [*found.waypoints[:known], *keyframes]
        return SearchResult(paths, cost, found.collision_cost, waypoints)

    def _find_dead_end(self, found: SearchResult, more: _Continuations, phase: int) -> None:
        """Record the goal of an open phase if no path leads there from where paths end."""
        begin = found.waypoints[-1]
        if self.routes is None or self.for_narrow_passages or not begin:
            return
        starts = found.paths[more.parents, -1, :3]
        goals = more.z[:, :3]
        if np.isinf(self.routes.compute_distances(phase, starts, goals)).all():
            goal = goals[int(np.argmin(more.penalty))]
            self.sampler.cache.unreached.setdefault(begin, goal)

    def _compute_onward_cost(self, z: Floats, waypoint: int) -> Floats:
        """Return the cost of configurations from which no path leads onward, shape (B,)."""
        goal = self.sampler.cache.unreached.get(waypoint)
        if self.routes is None or goal is None:
            return np.zeros(len(z))
        phase = self.problem.contacts.find_phase(waypoint + 1)
        goals = np.tile(goal, (len(z), 1))
        distances = self.routes.compute_distances(phase, goals, z[:, :3])
        return _UNREACHABLE_COST * np.isinf(distances)

    def _compute_total(self, found: SearchResult, parents: Ints, z: Floats, phase: int) -> Floats:
        """Return the costs of continuations, shape (B,), without penalties at their ends."""
        return found.cost[parents] + self._compute_path_cost(found.paths[parents, -1], z, phase)

    def _compute_path_cost(self, first: Floats, last: Floats, phase: int) -> Floats:
        """Return path lengths between configurations, both (B, n), in radians of the arm, (B,)."""
        cost = np.abs(last - first) * self.metric
        # x stands for the base's path, y for nothing.
        cost[:, 0] = np.hypot(cost[:, 0], cost[:, 1])
        cost[:, 1] = 0.0
        if self.sampler.curves is not None:
            lengths, turns = self.sampler.curves.compute_lengths(first[:, :3], last[:, :3])
            cost[:, 0] = self.metric[0] * lengths
            cost[:, 2] = self.metric[2] * turns
        if self.routes is not None and not self._is_closed(phase):
            distances = self.routes.compute_distances(
                phase, first[:, :3], last[:, :3], folded=self.for_narrow_passages
            )
            cost[:, 0] = self.metric[0] * distances
            np.minimum(cost, _UNREACHABLE_COST, out=cost)  # paths exist for others
        elif self.routes is not None:
            is_jump = np.abs(last - first)[:, :2].max(axis=1) > _MAX_JUMP
            cost[:, 0] += _ACCEPTABLE_COST * is_jump
        return np.asarray(cost.sum(axis=1))

    def _sample_continuations(
        self, found: SearchResult, waypoint: int, phase: int, mode: _Mode
    ) -> _Continuations:
        """Sample continuations of paths to a waypoint in a phase."""
        sampler = self.sampler
        count = len(found.paths)
        if not self._is_closed(phase):
            return self._sample_open_continuations(found, waypoint, phase, mode)
        parents = np.arange(count)
        z, reached = sampler.sample(found.paths[:, -1], waypoint, "track")
        if not mode.thorough:
            penalty = self._compute_penalty(z, waypoint, reached)
            if not penalty.any():
                return _Continuations(parents, z, penalty)
        others = np.arange(SAMPLE_COUNT // 2 - count) % count
        shaken, are_reached = sampler.sample(found.paths[others, -1], waypoint, "shake")
        parents = np.concatenate([parents, others])
        z = np.concatenate([z, shaken])
        reached = np.concatenate([reached, are_reached])
        more = self._sort_by_cost(found, parents, z, reached, waypoint, phase)
        if mode.backwards:
            return self._add_pushed(found, more, waypoint, phase)
        return more

    def _sample_open_continuations(
        self, found: SearchResult, waypoint: int, phase: int, mode: _Mode
    ) -> _Continuations:
        """Sample continuations in an open phase, batch by batch until enough are free."""
        size = SAMPLE_COUNT if mode.thorough else SAMPLE_COUNT // 2
        parents = np.arange(size) % len(found.paths)
        batches: list[_Continuations] = []
        free = 0
        for _ in range(_BATCHES):
            z, reached = self.sampler.sample(found.paths[parents, -1], waypoint, "scatter")
            batch = self._sort_by_cost(found, parents, z, reached, waypoint, phase)
            batches.append(batch)
            free += int(np.count_nonzero(batch.penalty == 0))
            if free >= _ENOUGH_FREE:
                break
        more = _Continuations.concatenate(batches)
        return self._add_pushed(found, more, waypoint, phase)

    def _sort_by_cost(
        self,
        found: SearchResult,
        parents: Ints,
        z: Floats,
        reached: Bools,
        waypoint: int,
        phase: int,
    ) -> _Continuations:
        """Sort continuations by cost; skip those that the beam would discard anyway."""
        cost = self._compute_total(found, parents, z, phase) + _UNREACHABLE_COST * ~reached
        order = np.argsort(cost, kind="stable")
        parents = parents[order]
        z = z[order]
        reached = reached[order]
        half = min(2 * _BEAM_WIDTH, len(z))
        penalty = self._compute_penalty(z[:half], waypoint, reached[:half])
        if np.count_nonzero(penalty == 0) >= _BEAM_WIDTH:
            return _Continuations(parents[:half], z[:half], penalty)
        rest = self._compute_penalty(z[half:], waypoint, reached[half:])
        return _Continuations(parents, z, np.concatenate([penalty, rest]))

    def _add_pushed(
        self, found: SearchResult, more: _Continuations, waypoint: int, phase: int
    ) -> _Continuations:
        """Append the best continuations, pushed out of collision, if few of them are free."""
        enough = _BEAM_WIDTH if self.sampler.is_closed_at(waypoint) else _ENOUGH_FREE
        if np.count_nonzero(more.penalty == 0) >= enough:
            return more
        cost = self._compute_total(found, more.parents, more.z, phase) + more.penalty
        best = np.argsort(cost, kind="stable")[: 2 * _BEAM_WIDTH]
        pushed = self.sampler.push_clear(more.z[best], waypoint)
        penalty = self._compute_penalty(pushed, waypoint)
        return more.concatenate([more, _Continuations(more.parents[best], pushed, penalty)])

    def _compute_penalty(self, z: Floats, waypoint: int, reached: Bools | None = None) -> Floats:
        """Return the penalty for collisions and unreached poses at a waypoint, shape (B,)."""
        reached = np.ones(len(z), bool) if reached is None else reached
        penalty = np.full(len(z), _UNREACHABLE_COST)
        if not reached.any():
            return penalty
        shortfall = self.sampler.compute_shortfall(z[reached], waypoint)
        penalty[reached] = _compute_collision_cost(shortfall)
        is_free = shortfall <= 0
        if self.for_narrow_passages and waypoint in self.approaches and is_free.any():
            free = np.flatnonzero(reached)[is_free]
            approach = self.approaches[waypoint]
            behind, is_feasible = self.sampler.sample(z[free], approach, "track")
            collision_cost = _compute_collision_cost(
                self.sampler.compute_shortfall(behind, approach)
            )
            penalty[free] += collision_cost + _UNREACHABLE_COST * ~is_feasible
        return penalty


def _select_beam(total: Floats, z: Floats, sectors: int) -> Ints:
    """Select the cheapest continuations of which no two are similar; return their indices.

    With several heading sectors, those beyond the quota of their sector come last.
    """
    rest = np.argsort(total, kind="stable")
    kept = list[int]()
    beyond_quota = list[int]()
    sector = np.floor(z[:, 2] / (2 * np.pi) * sectors).astype(int) % sectors
    counts = np.zeros(sectors, int)
    while len(rest) and len(kept) < _BEAM_WIDTH:
        first = int(rest[0])
        if sectors > 1 and counts[sector[first]] >= _SECTOR_QUOTA:
            beyond_quota.append(first)
        else:
            kept.append(first)
        counts[sector[first]] += 1
        is_different = np.abs(z[rest] - z[first]).max(axis=1) > SIMILARITY_TOLERANCE
        rest = rest[is_different]
    return np.array(kept + beyond_quota[: _BEAM_WIDTH - len(kept)])


def _compute_collision_cost(shortfall: Floats) -> Floats:
    """Return the cost of clearance shortfalls [m], shape (B,)."""
    return np.where(shortfall > 0, _COLLISION_COST + _DEPTH_COST * shortfall, 0.0)
