"""Separates bodies that penetrate over a stretch of waypoints, all on the same side."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.solver.segment_planes import Crossing, merge_contacts
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.models.shapes import triangulate

SHALLOW = 0.01  # [m] penetration up to which opposite normals of a stretch are ignored
SAME_DIRECTION = 0.99  # cosine above which two candidate directions count as one
PUSHES = 6  # Gauss-Newton steps that separate a stretch in one direction
MAX_PUSH = 0.5  # [m], [rad] limit of such a step
TRANSITION_SAMPLES = 8  # states in a segment between a displaced waypoint and its neighbour

_Key = tuple[int, tuple[int, int]]  # phase and bodies, see `_Stretch`


class _Stretch(NamedTuple):
    """Rows `first` to `last` of z at which two bodies penetrate in a phase.

    A body is the number of a joint, or minus the index of a geometry that is fixed in the world.
    `depth` is the sum of the penetrations [m].
    """

    phase: int
    bodies: tuple[int, int]
    first: int
    last: int
    normals: Floats  # of its contacts, shape (C, 3)
    depth: float
    direction: Floats | None = None  # from first to second body, in the frame of the second

    def is_at(self, contacts: Contacts, phases: Ints, bodies: Ints, margin: int) -> Bools:
        """Return which contacts are between its bodies, up to `margin` waypoints from it."""
        row = contacts.waypoint
        is_near = (row >= self.first - margin) & (row <= self.last + margin)
        is_between_bodies = (bodies == self.bodies).all(axis=1)
        return is_near & (phases == self.phase) & is_between_bodies


class _Gaps(NamedTuple):
    """Distances of P pairs of shapes in one direction at each of B configurations.

    Attributes:
        pairs: Geometries, shape (P, 2).
        margin: Required clearance, shape (P,) [m].
        normal: Direction from the first to the second shapes, in the world, shape (B, 3).
        first, second: Witness points in the world, shape (P, B, 3) [m].
        distance: Shape (P, B) [m].
    """

    pairs: Ints
    margin: Floats
    normal: Floats
    first: Floats
    second: Floats
    distance: Floats

    def to_contacts(self, pairs: Ints, configurations: Ints, rows: Ints) -> Contacts:
        """Return contacts of C chosen pairs at chosen configurations.

        Args:
            pairs: Number of each contact's pair, shape (C,).
            configurations: Number of its configuration, shape (C,).
            rows: Waypoint of each configuration, shape (B,).
        """
        return Contacts(
            waypoint=rows[configurations],
            pair=self.pairs[pairs],
            distance=self.distance[pairs, configurations],
            margin=self.margin[pairs],
            normal=self.normal[configurations],
            first=self.first[pairs, configurations],
            second=self.second[pairs, configurations],
        )


class Separation:
    """Chooses the side on which each penetrating stretch of a motion leaves the other body.

    Where a motion passes through a body, coal's normals point back before its middle and forward
    behind it, so that planes with these normals pull the waypoints apart instead of aside. Here one
    direction n is chosen for the whole stretch, fixed in the second body. Its contacts have the
    distance in this direction over the points a and b of both bodies,

        d_n = min n·b − max n·a ≤ d = max over all unit vectors v of d_v

    until the stretch is free.

    Args:
        problem: Problem.
    """

    def __init__(self, problem: TrajectoryProblem) -> None:
        self.problem = problem
        self.contacts = problem.contacts
        self._stretches: list[_Stretch] = []
        self._vertices: dict[tuple[int, int], Floats] = {}
        self._pairs: dict[_Key, Ints] = {}

    @property
    def is_active(self) -> bool:
        """Whether any stretch is left."""
        return bool(self._stretches)

    def update(self, z: Floats, contacts: Contacts, crossings: Sequence[Crossing]) -> None:
        """Find the penetrating stretches of z_1..z_N, shape (N, n), and choose their directions.

        Args:
            z: z_1..z_N.
            contacts: coal's contacts.
            crossings: Pairs that pass through each other between waypoints.
        """
        self._stretches = []
        stretches = self._find_stretches(contacts, crossings)
        stretches.sort(key=lambda stretch: -stretch.depth)
        for stretch in stretches:
            # The displacement of a deeper one may have freed it.
            if not stretch.depth or self._penetrates(z, stretch):
                direction, z = self._choose_direction(z, stretch)
                self._stretches.append(stretch._replace(direction=direction))

    def replace_contacts(self, z: Floats, at: Contacts, between: Contacts) -> Contacts:
        """Merge contacts at and between waypoints, with those of the stretches in their direction.

        Args:
            z: z_1..z_N, shape (N, n).
            at: coal's contacts at the waypoints.
            between: Contacts of segments, expressed at the waypoints.
        """
        if not self._stretches:
            return merge_contacts(at, between)
        parts = []
        for part, margin in ((at, 0), (between, 1)):
            phases = self._find_phases(part.waypoint)
            bodies = self._find_bodies(part.pair)
            covered = [stretch.is_at(part, phases, bodies, margin) for stretch in self._stretches]
            parts.append(part.select(np.flatnonzero(~np.any(covered, axis=0))))
        for stretch in self._stretches:
            parts.append(self._make_contacts(z, stretch))
        return merge_contacts(*parts)

    def _find_stretches(self, contacts: Contacts, crossings: Iterable[Crossing]) -> list[_Stretch]:
        """Return the stretches in which normals oppose each other, or that end on another side.

        Bodies that may overlap have none.
        """
        deep = contacts.select(np.flatnonzero((contacts.distance < 0.0) & (contacts.margin > 0.0)))
        phases = self._find_phases(deep.waypoint).tolist()
        bodies = self._find_bodies(deep.pair).tolist()
        overlaps = defaultdict[_Key, list[int]](list)  # indices of deep contacts
        for number, (phase, (one, other)) in enumerate(zip(phases, bodies, strict=True)):
            overlaps[phase, (one, other)].append(number)
        crossed_rows = self._find_crossed_rows(crossings)
        found = []
        for key in {**overlaps, **crossed_rows}:
            own = deep.select(np.array(overlaps[key], int))
            rows = np.array(sorted({*own.waypoint.tolist(), *crossed_rows[key]}))
            # A single waypoint without overlap does not end a stretch.
            gaps = np.flatnonzero(np.diff(rows) > 2) + 1
            for part in np.split(rows, gaps):
                first = int(part[0])
                last = int(part[-1])
                is_within = (own.waypoint >= first) & (own.waypoint <= last)
                overlap = own.select(np.flatnonzero(is_within))
                normals = overlap.normal
                depth = -overlap.distance
                opposes = depth.max(initial=0.0) > SHALLOW and (normals @ normals.T).min() < 0.0
                if opposes or not crossed_rows[key].isdisjoint(part.tolist()):
                    found.append(_Stretch(*key, first, last, normals, float(depth.sum())))
        return [stretch for stretch in found if len(self._get_pairs(stretch))]

    def _find_crossed_rows(self, crossings: Iterable[Crossing]) -> defaultdict[_Key, set[int]]:
        """Return the rows of z inside crossings, or at both ends of a crossing's only segment."""
        crossed_rows = defaultdict[_Key, set[int]](set)
        for crossing in crossings:
            one, other = self._find_bodies(np.array([crossing.pair]))[0].tolist()
            key = (self.contacts.find_phase(crossing.first + 1), (one, other))
            rows = [*range(crossing.first, crossing.last)]
            if not rows:
                rows = [crossing.first - 1, crossing.first]
            crossed_rows[key].update(row for row in rows if row >= 0)
        return crossed_rows

    def _find_phases(self, rows: Ints) -> Ints:
        """Return the phase of each row of z."""
        return self.contacts.find_phases(rows + 1)

    def _find_bodies(self, pairs: Ints) -> Ints:
        """Return the bodies of pairs of geometries, see `_Stretch`."""
        joints = self.contacts.get_joints(pairs)
        return np.where(joints > 0, joints, -pairs)

    def _get_pairs(self, stretch: _Stretch) -> Ints:
        """Return geometries and number of each pair of the bodies with a margin, shape (P, 3)."""
        key = (stretch.phase, stretch.bodies)
        if key not in self._pairs:
            part = self.contacts.phases[stretch.phase]
            own = (self._find_bodies(part.pairs) == stretch.bodies).all(axis=1)
            numbers = np.flatnonzero(own & (part.margins > 0.0))
            self._pairs[key] = np.column_stack([part.pairs[numbers], numbers])
        return self._pairs[key]

    def _penetrates(self, z: Floats, stretch: _Stretch) -> bool:
        """Return whether two bodies penetrate anywhere in a stretch."""
        rows = np.arange(stretch.first, stretch.last + 1)
        found = self.contacts.evaluate(z[rows], rows + 1, reach=0.0)
        return bool((self._find_bodies(found.pair) == stretch.bodies).all(axis=1).any())

    def _make_contacts(self, z: Floats, stretch: _Stretch) -> Contacts:
        """Return the contacts of a stretch in its direction."""
        rows = np.arange(stretch.first, stretch.last + 1)
        assert stretch.direction is not None
        directions = np.tile(stretch.direction, (len(rows), 1))
        gaps = self._measure(z[rows], stretch, directions)
        pairs, configurations = np.indices(gaps.distance.shape).reshape(2, -1)
        return merge_contacts(gaps.to_contacts(pairs, configurations, rows))

    def _measure(self, z: Floats, stretch: _Stretch, directions: Floats) -> _Gaps:
        """Measure all pairs of a stretch's bodies in one direction per configuration.

        The witness points are the points of the first shape furthest along n and of the second
        furthest along −n.

        Args:
            z: Configurations, shape (B, n).
            stretch: The stretch.
            directions: Directions in the frame of the second body, shape (B, 3).
        """
        rotations, translations = self.contacts.compute_placements(z)
        second_joint = max(stretch.bodies[1], 0)
        normal = np.einsum("bij,bj->bi", rotations[:, second_joint], directions)
        part = self.contacts.phases[stretch.phase]

        def find_supports(geometries: Ints, sign: float) -> Floats:
            """Return the points of geometries furthest along ±n, in the world, shape (P, B, 3)."""
            different, numbers = np.unique(geometries, return_inverse=True)
            supports = []
            for geometry in different.tolist():
                points = self._get_vertices(stretch.phase, geometry)
                joint = part.joint[geometry]
                local = sign * np.einsum("bij,bi->bj", rotations[:, joint], normal)
                support = points[(local @ points.T).argmax(axis=1)]
                turned = np.einsum("bij,bj->bi", rotations[:, joint], support)
                supports.append(turned + translations[:, joint])
            return np.stack(supports)[numbers]

        pairs = self._get_pairs(stretch)
        first = find_supports(pairs[:, 0], 1.0)
        second = find_supports(pairs[:, 1], -1.0)
        distance = np.einsum("bi,pbi->pb", normal, second - first)
        return _Gaps(pairs[:, :2], part.margins[pairs[:, 2]], normal, first, second, distance)

    def _get_vertices(self, phase: int, geometry: int) -> Floats:
        """Return the vertices of a geometry in the frame of its joint, shape (n, 3) [m]."""
        if (phase, geometry) not in self._vertices:
            part = self.contacts.phases[phase]
            points, _ = triangulate(part.shapes[geometry].geometry)
            placed = points @ part.rotation[geometry].T + part.translation[geometry]
            self._vertices[phase, geometry] = placed
        return self._vertices[phase, geometry]

    def _choose_direction(self, z: Floats, stretch: _Stretch) -> tuple[Floats, Floats]:
        """Choose the direction of a stretch by merit.

        In each candidate direction, the stretch and the waypoints at its ends are moved by the
        least displacement that separates the bodies. The least sum of the detour (in the metric of
        the motion cost) and of the remaining violations, at these waypoints and in the segments to
        their neighbours, decides. Directions along the motion lose, since they would move one of
        the ends through the whole body, or leave the next waypoint on the other side.

        Returns:
            The direction, shape (3,), and z_1..z_N after the displacement.
        """
        problem = self.problem
        begin = problem.ends[stretch.phase - 1] if stretch.phase else 0
        end = problem.ends[stretch.phase]
        first = max(stretch.first - 1, begin)
        last = min(stretch.last + 1, end - 1)
        rows = np.arange(first, last + 1)
        candidates = self._list_directions(z, stretch)
        count = len(candidates)
        moved = np.tile(z[rows], (count, 1))
        waypoints = np.tile(rows, count)
        directions = np.repeat(candidates, len(rows), axis=0)
        self._push(moved, waypoints, stretch, directions)
        remaining = self.contacts.evaluate(
            moved,
            waypoints + 1,
            reach=problem.options.largest_margin,
            nearest=problem.options.contact_slots,
        )
        own = self._measure(moved, stretch, directions)
        violation = np.maximum(own.margin[:, None] - own.distance, 0.0).sum(axis=0)
        shortfall = np.maximum(remaining.margin - remaining.distance, 0.0)
        np.add.at(violation, remaining.waypoint, shortfall)
        change = moved - np.tile(z[rows], (count, 1))
        detour = np.sqrt((problem.motion_cost.metric * change**2).sum(axis=1))
        moved = moved.reshape(count, len(rows), -1)
        total = violation.reshape(count, -1).sum(axis=1)
        total += self._measure_transition(problem.waypoints(z)[first], moved[:, 0], first + 1)
        if last + 2 <= end:
            total += self._measure_transition(z[last + 1], moved[:, -1], last + 2)
        merit = problem.options.penalty * total + 2.0 * detour.reshape(count, -1).max(axis=1)
        best = int(np.argmin(merit))
        z = z.copy()
        z[rows] = moved[best]
        return candidates[best], z

    def _list_directions(self, z: Floats, stretch: _Stretch) -> Floats:
        """Return candidate directions of a stretch in the frame of its second body, shape (D, 3).

        They are coal's normals and the axes of the bodies' boxes at the middle of the stretch.
        """
        part = self.contacts.phases[stretch.phase]
        middle = z[[(stretch.first + stretch.last) // 2]]
        rotations, _ = self.contacts.compute_placements(middle)
        axes = [stretch.normals]  # rows, in the world
        for geometry in np.unique(self._get_pairs(stretch)[:, :2]).tolist():
            box = (rotations[0, part.joint[geometry]] @ part.rotation[geometry]).T
            axes += [box, -box]
        second_body = rotations[0, max(stretch.bodies[1], 0)]
        return _select_distinct(np.concatenate(axes) @ second_body)

    def _measure_transition(self, begin: Floats, ends: Floats, waypoint: int) -> Floats:
        """Return the largest violation in the segments from one configuration to others.

        Args:
            begin: Configuration, shape (n,).
            ends: Other configurations, shape (B, n).
            waypoint: Waypoint that determines the phase.

        Returns:
            Missing clearance, shape (B,) [m].
        """
        s = (np.arange(TRANSITION_SAMPLES) + 0.5)[:, None] / TRANSITION_SAMPLES
        states = (begin + s * (ends[:, None] - begin)).reshape(-1, len(begin))
        found = self.contacts.evaluate(
            states,
            np.full(len(states), waypoint),
            reach=self.problem.options.largest_margin,
            nearest=1,
        )
        return found.compute_shortfall(len(states)).reshape(len(ends), -1).max(axis=1)

    def _push(self, z: Floats, rows: Ints, stretch: _Stretch, directions: Floats) -> None:
        """Move configurations z, shape (B, n), until the deepest pair is apart in its direction.

        With the gradient g of its distance d_n, zero for fixed coordinates, the least step that
        adds the shortfall m − d_n of the margin m is δz = (m − d_n) g / (gᵀg).
        """
        problem = self.problem
        lower = problem.lower[rows]
        upper = problem.upper[rows]
        free = upper - lower > 1e-9
        for _ in range(PUSHES):
            gaps = self._measure(z, stretch, directions)
            deepest = np.argmin(gaps.distance - gaps.margin[:, None], axis=0)
            every = np.arange(len(z))
            found = gaps.to_contacts(deepest, every, every)
            gradient = self.contacts.compute_gradients(z, found)
            shortfall = np.maximum(found.margin - found.distance, 0.0)
            step = free * gradient
            squared_norm = (step * gradient).sum(axis=1)
            step *= (shortfall / np.maximum(squared_norm, 1e-6))[:, None]
            size = np.abs(step).max(axis=1, keepdims=True)
            step *= np.minimum(1.0, MAX_PUSH / np.maximum(size, 1e-9))
            z[:] = np.clip(z + step, lower, upper)


def _select_distinct(directions: Floats) -> Floats:
    """Return the directions that differ from those before them, shape (n, 3)."""
    chosen: list[Floats] = []
    for direction in directions:
        if all(direction @ other < SAME_DIRECTION for other in chosen):
            chosen.append(direction)
    return np.array(chosen)
