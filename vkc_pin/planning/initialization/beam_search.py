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
from vkc_pin.planning.nlp.pose_goals import find_approach_waypoint
from vkc_pin.utils.arrays import Bools, Floats, Ints

_BATCHES = 6  # maximum number of batches of random samples: good grasps are rare
# number of collision-free configurations at a keyframe that ends sampling in open phases
_ENOUGH_FREE = 60
# [s] between keyframes in phases with a closed chain, at one waypoint per `Options.dt`
_KEYFRAME_SPACING = 1.0
_BEAM_WIDTH = 24  # configurations kept per keyframe
# cost of a collision, and of its depth [1/m]; 1 rad of a joint costs 1
_COLLISION_COST, _DEPTH_COST = 10.0, 300.0
_UNREACHABLE_COST = 1e3  # cost of an infeasible configuration or a missing base path
_ACCEPTABLE_COST = 60.0  # collision cost that the solver can repair: one or two grazing contacts
_SECTORS, _SECTOR_QUOTA = 8, 4  # sectors of base headings, and configurations preferred per sector
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
        return _Continuations(*map(np.concatenate, zip(*parts, strict=True)))


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
        self.sampler, self.problem, self.routes = sampler, sampler.problem, routes
        self.for_narrow_passages = for_narrow_passages
        self.metric = np.sqrt(
            self.problem.motion_cost.metric / self.problem.options.velocity_weight_arm
        )
        self.approaches = {
            end: find_approach_waypoint(end - phase.segments, end, self.problem.options)
            for phase, end in zip(self.problem.task.phases, self.problem.ends.tolist(), strict=True)
            if phase.grasps
        }

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
        chosen = [grasp + 1 for _, grasp, _ in problem.choices if grasp < problem.segments]
        backwards = backwards and not any(map(self.sampler.is_closed_at, chosen))
        mode = _Mode(thorough, backwards, keep_headings)
        found = SearchResult(problem.start[None, None, :], np.zeros(1), np.zeros(1), [0])
        closed = [problem.is_closed(phase) for phase in problem.task.phases]
        number = 0
        while number < len(closed):
            last = number
            while backwards and not closed[number] and closed[last + 1 : last + 2] == [True]:
                last += 1
            keyframes = [
                k for phase in range(number, last + 1) for k in self._place_keyframes(phase)
            ]
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
        closed = [self.sampler.is_closed_at(waypoint) for waypoint in found.waypoints[1:]]
        jumps = np.abs(np.diff(found.paths[best, :, :2], axis=0)).max(axis=1) > _MAX_JUMP
        has_jumps = self.routes is not None and bool(np.any(jumps & closed))
        return bool(found.collision_cost[best] <= _ACCEPTABLE_COST) and not has_jumps

    def _is_closed(self, phase: int) -> bool:
        return self.problem.is_closed(self.problem.task.phases[phase])

    def _place_keyframes(self, phase: int) -> list[int]:
        """Return the waypoints of a phase's keyframes."""
        begin, end = [0, *self.problem.ends.tolist()][phase : phase + 2]
        steps = self.problem.options.steps(_KEYFRAME_SPACING)
        pieces = max(1, round((end - begin) / steps)) if self._is_closed(phase) else 1
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
        paths = np.concatenate([found.paths[:, :known], found.paths[:, : known - 1 : -1]], axis=1)
        start, grasp, end = paths[:, known - 1], paths[:, known], paths[:, -1]
        cost = (
            found.cost
            + self._compute_path_cost(start, grasp, phase)
            - self._compute_path_cost(start, end, phase)
        )
        return SearchResult(
            paths, cost, found.collision_cost, [*found.waypoints[:known], *keyframes]
        )

    def _find_dead_end(self, found: SearchResult, more: _Continuations, phase: int) -> None:
        """Record the goal of an open phase if no path leads there from where paths end."""
        begin = found.waypoints[-1]
        if self.routes is None or self.for_narrow_passages or not begin:
            return
        starts, goals = found.paths[more.parents, -1, :3], more.z[:, :3]
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
        cost[:, 0], cost[:, 1] = np.hypot(cost[:, 0], cost[:, 1]), 0.0
        if self.sampler.curves is not None:
            lengths, turns = self.sampler.curves.compute_lengths(first[:, :3], last[:, :3])
            cost[:, 0], cost[:, 2] = self.metric[0] * lengths, self.metric[2] * turns
        if self.routes is not None and not self._is_closed(phase):
            distances = self.routes.compute_distances(
                phase, first[:, :3], last[:, :3], folded=self.for_narrow_passages
            )
            cost[:, 0] = self.metric[0] * distances
            np.minimum(cost, _UNREACHABLE_COST, out=cost)  # paths exist for others
        elif self.routes is not None:
            cost[:, 0] += _ACCEPTABLE_COST * (np.abs(last - first)[:, :2].max(axis=1) > _MAX_JUMP)
        return np.asarray(cost.sum(axis=1))

    def _sample_continuations(
        self, found: SearchResult, waypoint: int, phase: int, mode: _Mode
    ) -> _Continuations:
        sampler, count = self.sampler, len(found.paths)
        if not self._is_closed(phase):
            samples: list[_Continuations] = []
            parents = np.arange(SAMPLE_COUNT if mode.thorough else SAMPLE_COUNT // 2) % count
            for _ in range(_BATCHES):
                z, reached = sampler.sample(found.paths[parents, -1], waypoint, "scatter")
                samples.append(self._sort_by_cost(found, parents, z, reached, waypoint, phase))
                if sum(np.count_nonzero(part.penalty == 0) for part in samples) >= _ENOUGH_FREE:
                    break
            more = _Continuations.concatenate(samples)
            return self._add_pushed(found, more, waypoint, phase)
        parents = np.arange(count)
        z, reached = sampler.sample(found.paths[:, -1], waypoint, "track")
        if not mode.thorough:
            penalty = self._compute_penalty(z, waypoint, reached)
            if not penalty.any():
                return _Continuations(parents, z, penalty)
        others = np.arange(SAMPLE_COUNT // 2 - count) % count
        shaken, are_reached = sampler.sample(found.paths[others, -1], waypoint, "shake")
        parents, z = np.concatenate([parents, others]), np.concatenate([z, shaken])
        reached = np.concatenate([reached, are_reached])
        more = self._sort_by_cost(found, parents, z, reached, waypoint, phase)
        return self._add_pushed(found, more, waypoint, phase) if mode.backwards else more

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
        parents, z, reached = parents[order], z[order], reached[order]
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
        if reached.any():
            shortfall = self.sampler.compute_shortfall(z[reached], waypoint)
            penalty[reached] = _compute_collision_cost(shortfall)
            if self.for_narrow_passages and waypoint in self.approaches and (shortfall <= 0).any():
                free = np.flatnonzero(reached)[shortfall <= 0]
                at = self.approaches[waypoint]
                near, is_near = self.sampler.sample(z[free], at, "track")
                penalty[free] += (
                    _compute_collision_cost(self.sampler.compute_shortfall(near, at))
                    + _UNREACHABLE_COST * ~is_near
                )
        return penalty


def _select_beam(total: Floats, z: Floats, sectors: int) -> Ints:
    """Select the cheapest continuations of which no two are similar; return their indices.

    With several heading sectors, those beyond the quota of their sector come last.
    """
    rest, kept, late = np.argsort(total, kind="stable"), list[int](), list[int]()
    headings = np.floor(z[:, 2] / (2 * np.pi) * sectors).astype(int) % sectors
    count = np.zeros(sectors, int)
    while len(rest) and len(kept) < _BEAM_WIDTH:
        first = int(rest[0])
        (late if sectors > 1 and count[headings[first]] >= _SECTOR_QUOTA else kept).append(first)
        count[headings[first]] += 1
        rest = rest[np.abs(z[rest] - z[first]).max(axis=1) > SIMILARITY_TOLERANCE]
    return np.array(kept + late[: _BEAM_WIDTH - len(kept)])


def _compute_collision_cost(shortfall: Floats) -> Floats:
    """Return the cost of clearance shortfalls [m], shape (B,)."""
    return np.where(shortfall > 0, _COLLISION_COST + _DEPTH_COST * shortfall, 0.0)
