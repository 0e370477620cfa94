"""The sweep on a line: points that move along it and balls in their way, so that every distance is known by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vkc_pin.validation import sweep as module
from vkc_pin.validation.sweep import RESOLUTION, Hit, _find_group_minima, sweep


class Line:
    """Fake of `PairTable` and `CollisionShapes`: points at z[:, 0] and z[:, 1], and fixed balls.

    Attributes:
        asked: At which states distances were asked for, in turn, and of which pairs.
    """

    def __init__(
        self,
        *balls: tuple[float, float],
        margin: float = 0.02,
        margins: dict[tuple[int, int], float] | None = None,
        contact: dict[tuple[int, int, int], float] | None = None,
        together: set[tuple[int, int, int]] | None = None,
    ) -> None:
        self.balls = balls
        self.pairs = np.array([(point, 2 + k) for k in range(len(balls)) for point in (0, 1)])
        self.margins, self.groups = np.full(len(self.pairs), margin), [""] * (2 + len(balls))
        self.own, self.contact, self.moves_together = (
            margins or {},
            contact or {},
            together or set(),
        )
        labels = ["one", "two", *(f"ball_{k}" for k in range(len(balls)))]
        self.world = SimpleNamespace(
            coordinates=SimpleNamespace(q=lambda z: z), collision_labels=labels
        )
        self.solids: Any = self
        self.asked: list[tuple[float, ...]] = []

    def place(self, q: np.ndarray) -> Any:
        def distances(states: np.ndarray, pairs: np.ndarray) -> np.ndarray:
            point, ball = pairs[:, 0], pairs[:, 1] - 2
            where = q[states, point]
            self.asked.append(tuple(np.unique(q[states], axis=0)[:, 0].round(9).tolist()))
            balls = np.array(self.balls)
            return np.abs(where - balls[ball, 0]) - balls[ball, 1]

        class PlacedShapes:
            __len__ = staticmethod(lambda: len(q))

        placed: Any = PlacedShapes()
        placed.compute_distances = distances
        return placed

    def find_close_pairs(
        self, placed: Any, first: np.ndarray, last: np.ndarray, moved: np.ndarray, limit: float
    ) -> Any:
        k = np.repeat(np.arange(len(first)), len(self.pairs))
        return k, np.tile(np.arange(len(self.pairs)), len(first))

    def get_margins(self, pairs: np.ndarray, at: np.ndarray) -> np.ndarray:
        return np.array(
            [
                self.own.get((int(p), int(t)), self.margins[p])
                for p, t in zip(pairs, at, strict=True)
            ]
        )

    def get_contact_overlaps(
        self, pairs: np.ndarray, first: np.ndarray, last: np.ndarray
    ) -> np.ndarray:
        spans = zip(pairs.tolist(), first.tolist(), last.tolist(), strict=True)
        return np.array([self.contact.get(span, 0.0) for span in spans])

    def find_exempt(self, pairs: np.ndarray, at: np.ndarray) -> np.ndarray:
        return np.zeros(len(pairs), bool)

    def find_moving_together(
        self, pairs: np.ndarray, first: np.ndarray, last: np.ndarray
    ) -> np.ndarray:
        spans = zip(pairs.tolist(), first.tolist(), last.tolist(), strict=True)
        return np.array([span in self.moves_together for span in spans], bool)


@pytest.fixture(autouse=True)
def _as_far_as_they_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """How far shapes move at most: the points as far as they do, balls not at all."""

    def bound_displacements(line: Line, z: np.ndarray) -> np.ndarray:
        way = np.cumsum(np.abs(np.diff(z, axis=0, prepend=z[:1])), axis=0)
        return np.column_stack([way, np.zeros((len(z), len(line.balls)))])

    monkeypatch.setattr(module, "bound_displacements", bound_displacements)


def swept(line: Line, z: Any, waypoints: list[int], aside: float = 50.0) -> list[Hit]:
    """Return what is told of a point that is at `z`, while the other rests far away."""
    rows = np.column_stack([z, np.full(len(z), aside)])
    table: Any = line
    return list(sweep(table, rows, np.array(waypoints)))


def test_the_closest_of_every_waypoint_comes_first_and_all_that_are_too_close() -> None:
    line = Line((10.0, 0.5), (10.3, 0.5), (-10.0, 0.5))
    hits = swept(line, [0.0, 9.485, 9.0, 9.795], [0, 1, 2, 3])
    first = [hit for hit in hits if hit.at_waypoint]
    assert first == hits[: len(first)]
    assert [(hit.row, hit.first, hit.second, round(hit.distance, 9)) for hit in first] == [
        (0, "one", "ball_0", 9.5),
        (1, "one", "ball_0", 0.015),
        (2, "one", "ball_0", 0.5),
        (3, "one", "ball_0", -0.295),
        (3, "one", "ball_1", 0.005),
    ]
    assert {hit.margin for hit in first} == {0.02}


def test_what_overlaps_is_told_of_even_where_nothing_is_asked() -> None:
    """With no margin, or a negative one; what moves as one is nobody's closest."""
    line = Line((10.0, 0.5), (10.3, 0.5), margins={(0, 1): 0.0, (2, 1): -0.01, (0, 2): -np.inf})
    hits = [hit for hit in swept(line, [9.0, 10.0, 9.45], [0, 1, 2]) if hit.at_waypoint]
    assert [(hit.row, hit.second, round(hit.distance, 9), hit.margin) for hit in hits] == [
        (0, "ball_0", 0.5, 0.02),
        (1, "ball_0", -0.5, 0.0),
        (1, "ball_1", -0.2, -0.01),
        (2, "ball_1", 0.35, 0.02),
    ]


def test_between_waypoints_overlaps_are_told_at_every_sample() -> None:
    line = Line((1.0, 0.05))
    z = np.linspace(0.0, 2.0, 201)
    hits = [hit for hit in swept(line, z, [0, 200]) if not hit.at_waypoint]
    inside = {
        round(float(z[hit.row]), 2): round(hit.distance, 6) for hit in hits if hit.distance < -1e-9
    }
    assert inside == {
        round(x, 2): round(abs(x - 1.0) - 0.05, 6) for x in np.arange(0.96, 1.045, 0.01)
    }
    assert {hit.second for hit in hits} == {"ball_0"}


def test_what_cannot_come_closer_than_the_closest_is_not_looked_at() -> None:
    """A point that stops 0.4 before one ball need not be looked at on its way; one that passes another must be."""
    line = Line((1.0, 0.1))
    swept(line, np.linspace(0.0, 0.5, 51), [0, 50])
    asked = sorted({x for states in line.asked for x in states})
    assert asked == [0.0, 0.5]
    line = Line((1.0, 0.1))
    hits = swept(line, np.linspace(0.0, 2.0, 5), [0, 4])
    assert sorted({x for states in line.asked for x in states}) == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert min(hit.distance for hit in hits) == pytest.approx(-0.1)


def test_what_stands_still_is_looked_at_only_where_it_overlaps() -> None:
    for place, states in ((0.905, 1), (0.895, 0)):
        line = Line((1.0, 0.1))
        hits = swept(line, np.full(9, place), [0, 8])
        between = {hit.row for hit in hits if not hit.at_waypoint}
        assert between == (set(range(1, 8)) if states else set())


def test_halves_are_looked_at_in_turn() -> None:
    """First the middle, then the middles of the halves in which something may be, at last between two samples."""
    line = Line((5.3, 0.05))
    swept(line, np.linspace(0.0, 8.0, 9), [0, 8])
    looks = [states for states in line.asked if not {0.0, 8.0} & set(states)]
    assert looks[:4] == [(4.0,), (2.0, 6.0), (3.0, 5.0, 7.0), (5.5,)]


@pytest.mark.parametrize(
    ("radius", "told"),
    [(0.05, True), (1.2 * RESOLUTION, True), (0.1 * RESOLUTION, None)],
)
def test_nothing_slips_between_a_sample_and_the_next(radius: float, told: bool | None) -> None:
    """Wherever between them; something as thin as the resolution may."""
    assert RESOLUTION == 1e-3  # [m], as the pages say
    for place in (0.5, 0.3, 0.123, 0.77):
        line = Line((place, radius))
        hits = swept(line, [0.0, 1.0], [0, 1])
        inside = [hit for hit in hits if hit.distance < 0.0]
        if told:
            assert inside
            assert all(
                (hit.row, hit.at_waypoint, hit.first, hit.second) == (0, False, "one", "ball_0")
                for hit in inside
            )
            assert len(inside) == 1  # one place says so
        assert all(hit.distance >= -radius - 1e-12 for hit in hits)


def test_what_is_in_contact_or_moves_as_one_may_be_in_between() -> None:
    """Where it overlaps no more than counts as contact it is looked for deeper; where it moves as one it is not."""
    thin = (0.5, 0.002)
    assert any(hit.distance < 0.0 for hit in swept(Line(thin), [0.0, 1.0, 2.0], [0, 1, 2]))
    deep = Line((0.5, 0.1), contact={(0, 0, 1): 0.05})
    hits = [hit for hit in swept(deep, [0.45, 0.55], [0, 1]) if not hit.at_waypoint]
    assert hits == []  # it is in it at both ends, and that is told of there
    touching = Line((0.5, 0.1), contact={(0, 0, 1): 0.05})
    hits = [hit for hit in swept(touching, [0.44, 0.56], [0, 1]) if not hit.at_waypoint]
    assert [(hit.row, round(hit.distance, 9), hit.contact) for hit in hits] == [(0, -0.1, 0.05)]
    assert [
        hit
        for hit in swept(Line(thin, together={(0, 0, 1)}), [0.0, 1.0, 2.0], [0, 1, 2])
        if hit.distance < 0.0
    ] == []
    other = Line(thin, together={(0, 1, 2), (0, 0, 0)})
    assert [hit for hit in swept(other, [0.0, 1.0, 2.0], [0, 1, 2]) if hit.distance < 0.0] != []


def test_at_a_waypoint_the_contact_is_that_of_the_waypoint_and_between_that_of_both() -> None:
    contact = {(0, 1, 1): 0.1, (0, 0, 1): 0.2, (0, 1, 2): 0.3, (0, 0, 0): 0.4}
    line = Line((1.0, 0.5), contact=contact)
    hits = swept(line, [0.9, 0.95, 1.0, 1.05, 1.1], [0, 2, 4])
    told = {(hit.row, hit.at_waypoint): hit.contact for hit in hits}
    assert told[0, True] == 0.4
    assert told[2, True] == 0.1
    assert told[1, False] == 0.2
    assert told[3, False] == 0.3


def test_of_each_group_the_smallest_and_of_these_the_first() -> None:
    groups = np.array([3, 1, 3, 1, 0, 3])
    values = np.array([0.5, 0.2, 0.1, 0.2, 9.0, 0.1])
    assert _find_group_minima(groups, values).tolist() == [4, 1, 2]
    assert _find_group_minima(np.zeros(0, int), np.zeros(0)).tolist() == []
    assert _find_group_minima(np.array([1, 1]), np.array([1.0, 0.0])).tolist() == [1]
