"""Which windows hold for which pairs: against going through all of them, and how a motion's own shapes count."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.validation.contact_windows import Window
from vkc_pin.validation.pairs import PairTable, _WindowIndex

numbers = st.integers(0, 6)
pairs = st.lists(st.tuples(numbers, numbers), min_size=1, max_size=8, unique=True)
spans = st.tuples(
    st.integers(0, 5),
    st.integers(0, 5),
    st.lists(st.tuples(numbers, numbers), max_size=4, unique=True),
)


def made(windows: list[Window], mine: np.ndarray) -> PairTable:
    """Return a table that knows nothing but its pairs, each of which keeps 0.02."""
    table = object.__new__(PairTable)
    table.pairs, table.margins = mine, np.full(len(mine), 0.02)
    table._windows = _WindowIndex(windows, mine)
    return table


@given(pairs, st.lists(spans, max_size=6), st.data())
def test_what_holds_for_a_pair_between_two_waypoints(
    mine: list[tuple[int, int]],
    given_spans: list[tuple[int, int, list[tuple[int, int]]]],
    data: st.DataObject,
) -> None:
    windows = [
        Window(
            np.array(own, int).reshape(-1, 2),
            first,
            last,
            0.01 - 0.004 * k,
            1e-4 * (k + 1),
            k % 2 == 0,
        )
        for k, (first, last, own) in enumerate(given_spans)
    ]
    table = made(windows, np.array(mine))
    asked = data.draw(
        st.lists(
            st.tuples(st.integers(0, len(mine) - 1), st.integers(0, 5), st.integers(0, 2)),
            max_size=12,
        )
    )
    which, first, longer = (np.array([row[k] for row in asked], int) for k in range(3))
    last = first + longer
    k, window = table._windows.at(which, first, last)
    expected = [
        (row, w)
        for row, (p, begin, more) in enumerate(asked)
        for w, (a, b, own) in enumerate(given_spans)
        if mine[p] in own and a <= begin and begin + more <= b
    ]
    assert sorted(zip(k.tolist(), window.tolist(), strict=True)) == expected

    def of(row: int, name: str) -> list[float]:
        return [getattr(windows[w], name) for r, w in expected if r == row]

    rows = range(len(asked))
    assert table.get_contact_overlaps(which, first, last).tolist() == [
        max([0.0, *of(row, "contact")]) for row in rows
    ]
    assert table.find_moving_together(which, first, last).tolist() == [
        any(of(row, "moves_together")) for row in rows
    ]
    here = [
        [
            windows[w].margin
            for w, (a, b, own) in enumerate(given_spans)
            if mine[p] in own and a <= t <= b
        ]
        for p, t, _ in asked
    ]
    assert table.get_margins(which, first).tolist() == [min([0.02, *margins]) for margins in here]
    assert (table.margins == 0.02).all()  # they are left as they are
