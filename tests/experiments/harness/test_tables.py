from __future__ import annotations

from typing import Any

import pytest
from helpers.markdown import parse_cells

from vkc_pin.experiments.harness import tables

SCENES = {"a": "easy", "b": "hard"}


def make_record(
    scene: str,
    method: str,
    number: int,
    time: float | None,
    base: float,
    arm: float,
    failure: str = "",
) -> dict[str, Any]:
    """Return a record; `failure` is "status" or "status: constraint subject", "" for a success."""
    status, _, constraint = (failure or "success").partition(": ")
    record = {"scene": scene, "method": method, "number": number, "repeat": 0, "status": status}
    record |= {"success": not failure}
    record |= {"failed_constraint": (constraint or status) if failure else None}
    if time is None:
        return record
    lengths = {"base_path_length": base, "base_path_length_l1": 2.0 * base, "arm_path_length": arm}
    return {**record, "planning_time": time, **lengths}


RECORDS = [
    make_record("a", "auto", 0, 1.0, 3.0, 10.0),
    make_record("a", "auto", 1, 2.0, 4.0, 12.0),
    make_record("a", "auto", 2, 3.0, 5.0, 17.0),
    make_record("a", "slow", 0, 5.0, 6.0, 11.0),
    make_record("a", "slow", 1, 9.0, 99.0, 99.0, "rejected: penetration forearm – sofa"),
    make_record("a", "slow", 2, 7.0, 4.0, 17.0),
    make_record("b", "auto", 0, 2.5, 7.0, 20.0),
    make_record("b", "slow", 0, 20.0, 99.0, 99.0, "time limit"),
    make_record("b", "slow", 1, None, 0.0, 0.0, "error: error"),
    make_record("b", "slow", 2, 20.0, 99.0, 99.0, "time limit"),
]


def test_methods_table_equals_values_computed_by_hand() -> None:
    head, *rows = parse_cells(tables.methods_table(RECORDS, SCENES, ["auto", "slow", "unused"]))
    times = ["time, median [s]", "95th percentile [s]"]
    assert head == [
        "scene",
        "method",
        "success",
        *times,
        "base [m]",
        "arm [rad]",
        "timed out",
        "failures",
    ]
    assert rows == [
        # 95th percentile of 1, 2, 3: 2 + 0.9 · 1; path lengths of successes only
        ["easy", "auto", "3 of 3", "2.00", "2.90", "4.00", "12.00", "0", "none"],
        [
            "easy",
            "slow",
            "2 of 3",
            "7.00",
            "8.80",
            "5.00",
            "14.00",
            "0",
            "rejected (penetration) 1",
        ],
        ["hard", "auto", "1 of 1", "2.50", "2.50", "7.00", "20.00", "0", "none"],
        # An error has no time.
        ["hard", "slow", "0 of 3", "20.00", "20.00", "–", "–", "2", "error 1"],
        ["all", "auto", "4 of 4", "2.25", "2.92", "4.50", "14.50", "0", "none"],
        [
            "all",
            "slow",
            "2 of 6",
            "9.00",
            "20.00",
            "5.00",
            "14.00",
            "2",
            "error 1, rejected (penetration) 1",
        ],
    ]


def test_comparison_table_equals_values_computed_by_hand() -> None:
    head, *rows = parse_cells(
        tables.comparison_table(RECORDS, SCENES, ("auto", "slow"), ("one", "two")).replace(
            "\\|", "/"
        )
    )
    assert head == [
        "scene",
        "path length",
        "one: median (quartiles)",
        "two: median (quartiles)",
        "lower with one",
    ]
    # Starts 0 and 2 of scene a: 3 and 5 against 6 and 4; 10 and 17 against 11 and 17.
    easy = [
        ["base [m]", "4.00 (3.50–4.50)", "5.00 (4.50–5.50)", "1 of 2"],
        ["base /dx/+/dy/ [m]", "8.00 (7.00–9.00)", "10.00 (9.00–11.00)", "1 of 2"],
        ["arm [rad]", "13.50 (11.75–15.25)", "14.00 (12.50–15.50)", "1 of 2"],
    ]
    hard = [[name, "–", "–", "0 of 0"] for name, *_ in easy]
    assert rows == [
        [scene, *row]
        for scene, part in (("easy", easy), ("hard", hard), ("all", easy))
        for row in part
    ]


def test_common_successes_are_starts_where_all_methods_succeed() -> None:
    third = make_record("a", "third", 2, 1.0, 1.0, 1.0)
    del third["repeat"]  # an experiment without repeats
    common = tables.find_common_successes(
        [*RECORDS, third, make_record("a", "third", 1, 1.0, 1.0, 1.0)], ["third", "slow", "auto"]
    )
    assert [[(r["method"], r["number"]) for r in row] for row in common] == [
        [("third", 2), ("slow", 2), ("auto", 2)]
    ]


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # Published values of the interval: 81 of 263 (Newcombe 1998), 15 of 148, 0 of 20, 1 of 29.
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (0, 0, 0.0, 1.0),
    ],
)
def test_wilson_interval_against_published_values(
    successes: int, trials: int, low: float, high: float
) -> None:
    assert tables.compute_wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)
    assert tables.compute_wilson_interval(trials - successes, trials) == pytest.approx(
        (1.0 - high, 1.0 - low), abs=5e-5
    )


def test_footer_states_machine_versions_and_time() -> None:
    machine = {"system": "Linux", "processor": "Abacus 3", "cores": 2, "python": "3.12.1"}
    sessions = [
        {"jobs": 2, "trials": 5, "seconds": 60.0},
        {"jobs": 1, "trials": 7, "seconds": 30.0},
    ]
    meta = {"versions": {"vkc-pin": "1.2", "pin": "4.1"}, "machine": machine}
    measured = "Measured on 2 cores of Abacus 3, Linux, Python 3.12.1, vkc-pin 1.2, pin 4.1"
    assert tables.describe_run(meta) == f"{measured}."
    meta["versions"]["sources"] = "abc"
    assert tables.describe_run({**meta, "sessions": sessions, "peak_memory_mb": 320.4}) == (
        f"{measured} (sources abc). "
        "12 trials, 1 or 2 at a time, took 1.5 min and up to 320 MB a process."
    )
