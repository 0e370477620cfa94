"""Checks the clearances of a motion at its waypoints, and that nothing penetrates anywhere."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from vkc_pin.options import Options
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.validation.collisions import Hit, Hits, PairTable, sweep
from vkc_pin.validation.contact_windows import find_contact_windows
from vkc_pin.validation.distances import CollisionShapes, bound_displacements
from vkc_pin.validation.neighbours import ExemptPairs, find_exempt_pairs
from vkc_pin.validation.report import Exemption, Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL, CONTACT_DEPTH
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step


class ClearanceResult:
    """Result of the check of clearances and penetrations.

    Attributes:
        smallest: Smallest distance of each phase [m]; infinite without a pair.
        exemptions: Used exemptions by the labels of their shapes.
    """

    def __init__(self, samples: Samples) -> None:
        self._samples = samples
        self._first_row: int | None = None  # of a violation
        self._lasts = [phase.last for phase in samples.trajectory.phases]
        # The worst hit of each constraint and pair of links, with the amount of its violation.
        self._worst: dict[tuple[str, str, str], tuple[Hit, float]] = {}
        self.smallest = np.full(len(self._lasts), np.inf)
        self.exemptions: dict[tuple[str, str], Exemption] = {}

    def add(
        self,
        hits: Hits,
        exemptions: Mapping[tuple[int, int], Sequence[ExemptPairs]],
        have_exemptions: Bools,
    ) -> None:
        """Judge distances of pairs.

        Args:
            hits: The distances.
            exemptions: Exemptions of two shapes.
            have_exemptions: Which pairs of the table have some, shape (P,).
        """
        required = np.zeros(len(hits.rows))
        if hits.at_waypoints:
            clearances = np.maximum(hits.margins, hits.exempt_clearances)
            required = np.maximum(clearances - ACCEPTED_SHORTFALL, 0.0)
        is_clear = ~have_exemptions[hits.pairs] & (hits.distances >= required)
        counts = is_clear & (hits.margins > -np.inf)
        self._add_distances(hits.rows[counts], hits.distances[counts])
        for hit in hits.to_list(~is_clear):
            self._judge(hit, exemptions.get(hit.shapes, []))

    def _judge(self, hit: Hit, exempt: Sequence[ExemptPairs]) -> None:
        """Judge the distance of a pair, with the exemptions of the pair."""
        # The exemption also covers the segment before it ends and the one after it begins.
        state = self._samples.z[[hit.row]]
        tolerated = 0.0  # overlap [m]
        for one in exempt:
            if one.are_active(state)[0]:
                tolerated = max(tolerated, -one.margin)
        contact = hit.contact
        margin = hit.margin
        if tolerated > 0.0:
            contact = max(contact, CONTACT_DEPTH + tolerated)
            margin = min(margin, -tolerated)
        elif hit.margin > -np.inf:
            self._add_distances(np.array([hit.row]), np.array([hit.distance]))
        is_checked = hit.at_waypoint and hit.row > 0
        shortfall = margin - ACCEPTED_SHORTFALL - hit.distance
        if hit.distance < -contact:
            self._add_violation("penetration", hit, -hit.distance)
        elif is_checked and shortfall > 0.0:
            self._add_violation("clearance", hit, shortfall)
        elif hit.distance < -CONTACT_DEPTH or (
            is_checked and hit.distance < hit.exempt_clearance - ACCEPTED_SHORTFALL
        ):
            self._add_exemption(hit, exempt)

    def _add_distances(self, rows: Ints, distances: Floats) -> None:
        waypoints = np.searchsorted(self._samples.waypoint_rows, rows, side="right") - 1
        phases = np.searchsorted(self._lasts, waypoints)
        np.minimum.at(self.smallest, phases, distances)

    def _add_violation(self, kind: str, hit: Hit, amount: float) -> None:
        if self._first_row is None or hit.row < self._first_row:
            self._first_row = hit.row
        key = (kind, hit.first, hit.second)
        known = self._worst.get(key)
        if known is None or known[1] < amount:
            self._worst[key] = (hit, amount)

    @property
    def clear_until(self) -> float:
        """Time until which nothing is violated [s]: of the last waypoint before; inf without."""
        if self._first_row is None:
            return np.inf
        rows = self._samples.waypoint_rows
        waypoint = int(np.searchsorted(rows, self._first_row)) - 1
        return float(self._samples.times[rows[max(waypoint, 0)]])

    @property
    def violations(self) -> list[Violation]:
        """Worst violation of each constraint and pair of links."""
        found = list[Violation]()
        for (kind, first, second), (hit, amount) in self._worst.items():
            millimetres = 1e3 * abs(hit.distance)
            detail = f"overlap by {millimetres:.1f} mm"
            if kind == "clearance":
                required = f"{1e3 * hit.margin:.0f} mm are required"
                detail = f"are only {millimetres:.1f} mm apart, {required}"
            subject = f"{first} – {second}"
            found.append(
                self._samples.make_violation(kind, subject, amount, "m", detail, row=hit.row)
            )
        return found

    def _add_exemption(self, hit: Hit, exempt: Sequence[ExemptPairs]) -> None:
        """Record the smallest distance of a pair that used its exemption."""
        known = self.exemptions.get((hit.first, hit.second))
        if known is not None and known.distance <= hit.distance:
            return
        reason = exempt[0].reason if exempt else "no deeper than the object at the start"
        subject = f"{hit.first} – {hit.second}"
        self.exemptions[hit.first, hit.second] = Exemption(subject, hit.distance, reason)


class ClearanceCheck:
    """Checks the clearance at waypoints (eqs. 6 and 7), and that nothing penetrates anywhere.

    Pairs that move together are ignored. At the start the clearance may be violated, since the
    robot is already there, but nothing may penetrate.

    Args:
        samples: Sampled motion.
        steps: Steps of the motion.
        options: Clearances to keep.
        tolerances: Accepted errors of goals.
    """

    def __init__(
        self, samples: Samples, steps: Sequence[Step], options: Options, tolerances: Tolerances
    ) -> None:
        self._samples = samples
        self._steps = steps
        self._options = options
        self._tolerances = tolerances
        self._solids = CollisionShapes(samples.world)
        self._moved = bound_displacements(self._solids, samples.z)

    def check_all(self) -> ClearanceResult:
        """Check all pairs of the motion."""
        return self._check(self._solids, self._moved, obstacles_only=False, first_row=0)

    def check_obstacles(self, scene: Scene, first_row: int) -> ClearanceResult:
        """Check only the obstacles of another scene, from a sample to the end.

        Args:
            scene: The scene of the motion with the obstacles that are checked.
            first_row: First sample that is checked.
        """
        solids = self._solids.with_obstacles(scene)
        moved = np.zeros((len(self._moved), len(solids.world.shapes)))
        bodies = slice(solids.body_count)
        moved[:, bodies] = self._moved[:, bodies]
        return self._check(solids, moved, obstacles_only=True, first_row=first_row)

    def _check(
        self, solids: CollisionShapes, moved: Floats, *, obstacles_only: bool, first_row: int
    ) -> ClearanceResult:
        samples = self._samples
        scene = solids.world.scene
        dist_safe = self._options.dist_safe
        windows = find_contact_windows(
            samples,
            solids,
            self._steps,
            self._options,
            self._tolerances,
            obstacles_only=obstacles_only,
        )
        table = PairTable(
            scene,
            solids,
            samples.trajectory,
            dist_safe,
            self._options.self_distance,
            windows=windows,
            samples=samples,
            obstacles_only=obstacles_only,
        )
        exemptions: dict[tuple[int, int], list[ExemptPairs]] = {}
        for one in find_exempt_pairs(scene, solids, dist_safe, obstacles_only=obstacles_only):
            for first, second in one.pairs.tolist():
                exemptions.setdefault((first, second), []).append(one)
        have_exemptions = _are_listed(table.pairs, exemptions)
        deepest_only = None
        if obstacles_only:
            # Where a pair may overlap for a while, its deepest overlap need not be a violation.
            deepest_only = ~(table.have_windows | have_exemptions)
        result = ClearanceResult(samples)
        hits = sweep(
            table,
            samples.z,
            samples.waypoint_rows,
            moved=moved,
            first_row=first_row,
            deepest_only=deepest_only,
        )
        for found in hits:
            result.add(found, exemptions, have_exemptions)
        return result


def _are_listed(pairs: Ints, listed: Collection[tuple[int, int]]) -> Bools:
    """Return which pairs, shape (P, 2), are in a collection of pairs, shape (P,)."""
    return np.array([(first, second) in listed for first, second in pairs.tolist()], bool)
