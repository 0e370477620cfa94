"""Searches sequences of keyframes along a task, keeping the cheapest partial paths."""

from __future__ import annotations

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

__all__ = ["BeamSearch", "SearchResult"]

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
_SHORTENING_ROUNDS = 8  # times that each keyframe is moved towards its neighbours
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


class BeamSearch:
    """Searches keyframe sequences of a problem.

    Args:
        sampler: Keyframe sampler.
        routes: Base paths that determine distances. Default: straight lines.
        for_narrow_passages: Whether grasps count as free only if the approach to them is free, too,
            paths are not shortened, and base paths are those with the arm folded.
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
        self.metric = np.sqrt(self.problem.effort.metric / self.problem.options.velocity_weight_arm)
        self.approaches = {
            int(end): find_approach_waypoint(
                int(end) - phase.segments, int(end), self.problem.options
            )
            for phase, end in zip(self.problem.task.phases, self.problem.ends, strict=True)
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
                there.
            keep_headings: Keep paths with diverse base headings. A steered base needs space to
                turn, and the cheapest path may head where there is none.
        """
        # A grasp with free coordinates is chosen before the object moves.
        chosen = [
            grasp + 1 for _, grasp, _ in self.problem.choices if grasp < self.problem.segments
        ]
        backwards = backwards and not any(map(self._is_closed_at, chosen))
        mode = _Mode(thorough, backwards, keep_headings)
        problem = self.problem
        found = SearchResult(problem.start[None, None, :], np.zeros(1), np.zeros(1), [0])
        closed = [problem.closed(phase) for phase in problem.task.phases]
        number = 0
        while number < len(closed):
            last = number
            while backwards and not closed[number] and closed[last + 1 : last + 2] == [True]:
                last += 1
            keyframes = self._place_keyframes(number, last)
            if last > number:
                found = self._extend_backwards(found, keyframes, number, mode)
            else:
                for keyframe in keyframes:
                    found = self._extend(found, keyframe, number, mode)
            number = last + 1
        return found

    def is_acceptable(self, found: SearchResult) -> bool:
        """Return whether the cheapest path has few collisions and, given routes, no base jumps."""
        best = int(np.argmin(found.cost))
        closed = [self._is_closed_at(waypoint) for waypoint in found.waypoints[1:]]
        jumps = np.abs(np.diff(found.paths[best, :, :2], axis=0)).max(axis=1) > _MAX_JUMP
        return bool(
            found.collision_cost[best] <= _ACCEPTABLE_COST
            and (self.routes is None or not np.any(jumps & closed))
        )

    def _is_closed_at(self, waypoint: int) -> bool:
        return self.problem.closed(
            self.problem.task.phases[self.problem.contacts.find_phase(waypoint)]
        )

    def _place_keyframes(self, first: int, last: int) -> list[int]:
        """Return the waypoints of the keyframes of phases `first` to `last`."""
        problem, keyframes = self.problem, list[int]()
        for number in range(first, last + 1):
            begin, end = int(problem.ends[number - 1]) if number else 0, int(problem.ends[number])
            closed, steps = (
                problem.closed(problem.task.phases[number]),
                problem.options.steps(_KEYFRAME_SPACING),
            )
            pieces = max(1, round((end - begin) / steps)) if closed else 1
            keyframes += np.linspace(begin, end, pieces + 1).round().astype(int)[1:].tolist()
        return keyframes

    def _extend(self, found: SearchResult, keyframe: int, phase: int, mode: _Mode) -> SearchResult:
        """Extend paths to the next keyframe, in a phase, and keep the cheapest."""
        parents, z, bad = self._sample_continuations(found.paths, found.cost, keyframe, phase, mode)
        total = (
            found.cost[parents] + self._compute_path_cost(found.paths[parents, -1], z, phase) + bad
        )
        sampled = len(z)
        is_open = not self.problem.closed(self.problem.task.phases[phase])
        has_pose = self.sampler.find_pose(keyframe) is not None
        if not self.for_narrow_passages and is_open and has_pose:
            parents, z, bad, total = self._add_shortened(
                found, parents, z, bad, total, keyframe, phase
            )
        best = self._select_beam(
            total, z, sampled, _BEAM_WIDTH, _SECTORS if mode.keep_headings else 1
        )
        paths = np.concatenate([found.paths[parents[best]], z[best, None]], axis=1)
        return SearchResult(
            paths,
            total[best],
            (found.collision_cost[parents] + bad)[best],
            [*found.waypoints, keyframe],
        )

    def _add_shortened(
        self,
        found: SearchResult,
        parents: Ints,
        z: Floats,
        bad: Floats,
        total: Floats,
        keyframe: int,
        phase: int,
    ) -> tuple[Ints, Floats, Floats, Floats]:
        """Append shortened versions of the best continuations."""
        best = np.argsort(total, kind="stable")[: 2 * _BEAM_WIDTH]
        before = found.paths[parents[best]]
        paths = np.concatenate([before, z[best, None]], axis=1)
        short = self.shorten(
            SearchResult(paths, total[best], bad[best], [*found.waypoints, keyframe]),
            len(found.waypoints),
        )
        end = short.paths[:, -1]
        price = (
            found.cost[parents[best]]
            + self._compute_path_cost(before[:, -1], end, phase)
            + short.collision_cost
        )
        return (
            np.concatenate([parents, parents[best]]),
            np.concatenate([z, end]),
            np.concatenate([bad, short.collision_cost]),
            np.concatenate([total, price]),
        )

    @staticmethod
    def _select_beam(total: Floats, z: Floats, sampled: int, width: int, sectors: int = 1) -> Ints:
        """Select the cheapest continuations of which no two are similar.

        At most half of them come after the first `sampled` ones, which are not shortened: a short
        path may be a dead end. With several heading sectors, those beyond the quota of their sector
        come last.

        Args:
            total: Cost of each continuation, shape (B,).
            z: Configurations, shape (B, n).
            sampled: Number of continuations that were sampled, not shortened.
            width: Maximum number to select.
            sectors: Number of heading sectors.

        Returns:
            Indices of the selected continuations.
        """
        rest, kept, late = np.argsort(total, kind="stable"), list[int](), list[int]()
        headings = (
            np.floor(z[:, 2] / (2 * np.pi) * sectors).astype(int) % sectors
            if sectors > 1
            else np.zeros(len(z), int)
        )
        full = np.zeros(sectors, int)
        while len(rest) and len(kept) < width:
            first = int(rest[0])
            (late if sectors > 1 and full[headings[first]] >= _SECTOR_QUOTA else kept).append(first)
            full[headings[first]] += 1
            rest = rest[np.abs(z[rest] - z[first]).max(axis=1) > SIMILARITY_TOLERANCE]
            if np.count_nonzero(np.array(kept) >= sampled) >= width // 2:
                rest = rest[rest < sampled]
        return np.array(kept + late[: width - len(kept)])

    def _extend_backwards(
        self, found: SearchResult, keyframes: list[int], phase: int, mode: _Mode
    ) -> SearchResult:
        """Extend paths through an open phase and the closed one after it, from the end backwards.

        Args:
            found: Paths up to the phase.
            keyframes: Waypoints of the keyframes; all but the first belong to the closed phase.
            phase: Number of the open phase.
            mode: Search mode.
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

    def _compute_path_cost(self, first: Floats, last: Floats, phase: int) -> Floats:
        """Return path lengths between configurations, both (B, n), in radians of the arm, (B,)."""
        cost = np.abs(last - first) * self.metric
        cost[:, 0], cost[:, 1] = np.hypot(cost[:, 0], cost[:, 1]), 0.0
        if self.sampler.curves is not None:
            lengths, turns = self.sampler.curves.compute_lengths(first[:, :3], last[:, :3])
            cost[:, 0], cost[:, 2] = self.metric[0] * lengths, self.metric[2] * turns
        if self.routes is not None and not self.problem.closed(self.problem.task.phases[phase]):
            distances = self.routes.compute_distances(
                phase, first[:, :3], last[:, :3], folded=self.for_narrow_passages
            )
            cost[:, 0] = self.metric[0] * distances
            np.minimum(cost, _UNREACHABLE_COST, out=cost)  # paths exist for others
        elif self.routes is not None:
            cost[:, 0] += _ACCEPTABLE_COST * (np.abs(last - first)[:, :2].max(axis=1) > _MAX_JUMP)
        return np.asarray(cost.sum(axis=1))

    def _sample_continuations(
        self, paths: Floats, cost: Floats, waypoint: int, phase: int, mode: _Mode
    ) -> tuple[Ints, Floats, Floats]:
        """Sample continuations of `paths`: parent indices, configurations, penalties."""
        sampler = self.sampler
        if not self.problem.closed(self.problem.task.phases[phase]):
            samples = []
            for _ in range(_BATCHES):
                parents = np.arange(SAMPLE_COUNT if mode.thorough else SAMPLE_COUNT // 2) % len(
                    paths
                )
                z, found = sampler.sample(paths[parents, -1], waypoint, "scatter")
                price = cost[parents] + self._compute_path_cost(paths[parents, -1], z, phase)
                samples.append(self._sort_by_cost(price, parents, z, found, waypoint))
                if sum(np.count_nonzero(bad == 0) for _, _, bad in samples) >= _ENOUGH_FREE:
                    break
            parents, z, bad = (np.concatenate(parts) for parts in zip(*samples, strict=True))
            return self._add_pushed(paths, cost, parents, z, bad, waypoint, phase)
        parents = np.arange(len(paths))
        z, found = sampler.sample(paths[:, -1], waypoint, "track")
        if not mode.thorough:
            bad = self._compute_penalty(z, found, waypoint)
            if not bad.any():
                return parents, z, bad
        more = np.arange(SAMPLE_COUNT // 2 - len(paths)) % len(paths)
        shaken, also = sampler.sample(paths[more, -1], waypoint, "shake")
        parents, z, found = (
            np.concatenate([parents, more]),
            np.concatenate([z, shaken]),
            np.concatenate([found, also]),
        )
        price = cost[parents] + self._compute_path_cost(paths[parents, -1], z, phase)
        parents, z, bad = self._sort_by_cost(price, parents, z, found, waypoint)
        if not mode.backwards:
            return parents, z, bad
        return self._add_pushed(paths, cost, parents, z, bad, waypoint, phase)

    def _add_pushed(
        self,
        paths: Floats,
        cost: Floats,
        parents: Ints,
        z: Floats,
        bad: Floats,
        waypoint: int,
        phase: int,
    ) -> tuple[Ints, Floats, Floats]:
        """Append the best continuations, pushed out of collision, if few of them are free."""
        if np.count_nonzero(bad == 0) >= (
            _BEAM_WIDTH if self._is_closed_at(waypoint) else _ENOUGH_FREE
        ):
            return parents, z, bad
        price = cost[parents] + self._compute_path_cost(paths[parents, -1], z, phase) + bad
        best = np.argsort(price, kind="stable")[: 2 * _BEAM_WIDTH]
        pushed = self.sampler.push_clear(z[best], waypoint)
        more = self._compute_penalty(pushed, np.ones(len(pushed), bool), waypoint)
        return (
            np.concatenate([parents, parents[best]]),
            np.concatenate([z, pushed]),
            np.concatenate([bad, more]),
        )

    def shorten(self, found: SearchResult, first: int = 1) -> SearchResult:
        """Shorten paths by a local search over the keyframes of open phases.

        Each such keyframe, from index `first` on, is moved in turn towards the middle of its
        neighbours along the pose's manifold, by a fraction that is halved when the path gets no
        cheaper. So paths compare by what the solver can make of them, not by luck.
        """
        paths, cost, collision_cost, at, robot = (
            found.paths.copy(),
            found.cost.copy(),
            found.collision_cost.copy(),
            found.waypoints,
            self.sampler.robot_size,
        )
        movable = [
            k
            for k in range(first, len(at))
            if not self._is_closed_at(at[k]) and self.sampler.find_pose(at[k]) is not None
        ]
        share = np.full((len(paths), len(at), 1), 0.5)
        hit = {
            k: self._compute_penalty(paths[:, k], np.ones(len(paths), bool), at[k]) for k in movable
        }
        for k in movable * _SHORTENING_ROUNDS:
            moved = paths[:, k].copy()
            middle = paths[:, [k - 1, *([k + 1] if k + 1 < len(at) else [])]].mean(axis=1)
            moved[:, :robot] += share[:, k] * (middle - moved)[:, :robot]
            moved, reached = self.sampler.sample(moved, at[k], "track")
            hits = self._compute_penalty(moved, reached, at[k])
            gain = (
                self._compute_cost_around(paths, paths[:, k], at, k)
                + hit[k]
                - self._compute_cost_around(paths, moved, at, k)
                - hits
            )
            cheaper = gain > 0.0
            paths[cheaper, k] = moved[cheaper]
            cost[cheaper] -= gain[cheaper]
            collision_cost[cheaper] += (hits - hit[k])[cheaper]
            hit[k][cheaper] = hits[cheaper]
            share[~cheaper, k] /= 2.0
        return SearchResult(paths, cost, collision_cost, at)

    def _compute_cost_around(self, paths: Floats, z: Floats, at: list[int], k: int) -> Floats:
        """Return the cost from keyframe k - 1 to k + 1 of paths through z, shape (B, n), at k."""
        cost = self._compute_path_cost(paths[:, k - 1], z, self.problem.contacts.find_phase(at[k]))
        if k + 1 < len(at):
            cost = cost + self._compute_path_cost(
                z, paths[:, k + 1], self.problem.contacts.find_phase(at[k + 1])
            )
        return cost

    def _sort_by_cost(
        self, price: Floats, parents: Ints, z: Floats, found: Bools, waypoint: int
    ) -> tuple[Ints, Floats, Floats]:
        """Sort continuations by cost; skip those that the beam would discard anyway."""
        order = np.argsort(price + _UNREACHABLE_COST * ~found, kind="stable")
        parents, z, found = parents[order], z[order], found[order]
        half = min(2 * _BEAM_WIDTH, len(z))
        bad = self._compute_penalty(z[:half], found[:half], waypoint)
        if np.count_nonzero(bad == 0) >= _BEAM_WIDTH:
            return parents[:half], z[:half], bad
        return (
            parents,
            z,
            np.concatenate([bad, self._compute_penalty(z[half:], found[half:], waypoint)]),
        )

    def _compute_penalty(self, z: Floats, found: Bools, waypoint: int) -> Floats:
        """Return the penalty for collisions and infeasibility at a waypoint, shape (B,)."""
        bad = np.full(len(z), _UNREACHABLE_COST)
        if found.any():
            shortfall = self.sampler.compute_shortfall(z[found], waypoint)
            bad[found] = _compute_collision_cost(shortfall)
            if self.for_narrow_passages and waypoint in self.approaches and (shortfall <= 0).any():
                free = np.flatnonzero(found)[shortfall <= 0]
                at = self.approaches[waypoint]
                near, reached = self.sampler.sample(z[free], at, "track")
                bad[free] += (
                    _compute_collision_cost(self.sampler.compute_shortfall(near, at))
                    + _UNREACHABLE_COST * ~reached
                )
        return bad


def _compute_collision_cost(shortfall: Floats) -> Floats:
    """Return the cost of clearance shortfalls [m], shape (B,)."""
    return np.where(shortfall > 0, _COLLISION_COST + _DEPTH_COST * shortfall, 0.0)
