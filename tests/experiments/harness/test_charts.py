from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import make_fake_plan

from tests.benchmarks.scale import scale_chart
from vkc_pin import Report
from vkc_pin.experiments.harness.charts import (
    criteria_chart,
    means_chart,
    motions_chart,
    success_chart,
)
from vkc_pin.experiments.harness.tables import TIMES, compute_wilson_interval

SCENES = {"a": "easy", "b": "hard"}
RATES = {("a", "one"): (4, 4), ("a", "two"): (3, 4), ("b", "one"): (1, 4), ("b", "two"): (0, 4)}
RECORDS: list[dict[str, Any]] = [
    {"scene": scene, "method": method, "success": k < successes}
    for (scene, method), (successes, number) in RATES.items()
    for k in range(number)
]


def read_texts(texts: Iterable[Any]) -> list[str]:
    return [text.get_text() for text in texts]


def read_bars(axes: Any) -> dict[str, list[float]]:
    """Return group → heights of its bars, in the order of methods."""
    names = read_texts(axes.get_xticklabels())
    heights: dict[str, list[float]] = {name: [] for name in names}
    for bar in axes.patches:
        if bar.get_height():  # not a bar for the legend
            heights[names[round(bar.get_x() + bar.get_width() / 2.0)]].append(bar.get_height())
    return heights


def read_intervals(axes: Any) -> list[list[float]]:
    return [line.get_segments()[0][:, 1].tolist() for line in axes.collections]


def test_success_chart_has_rates_and_intervals() -> None:
    other = {"scene": "a", "method": "other", "success": True}
    figure = success_chart([*RECORDS, other], None, SCENES, ["one", "two"])
    (axes,) = figure.axes
    assert read_bars(axes) == {"easy\n4 trials each": [100.0, 75.0], "hard\n4 trials each": [25.0]}
    expected = [
        compute_wilson_interval(*RATES[key])
        for key in (("a", "one"), ("b", "one"), ("a", "two"), ("b", "two"))
    ]
    np.testing.assert_allclose(read_intervals(axes), 100.0 * np.array(expected), atol=1e-9)
    assert read_texts(axes.texts) == ["100", "25", "75", "0"]
    assert read_texts(figure.legends[0].get_texts()) == ["one", "two"]


def test_method_without_trials_has_no_bar() -> None:
    (axes,) = success_chart(RECORDS[:4], None, SCENES, ["one", "two"]).axes
    assert read_bars(axes) == {"easy\n4 trials each": [100.0], "hard\nno trials": []}


def make_record(
    method: str, number: int, success: bool, base: float, time: float | None
) -> dict[str, Any]:
    figures = {"base_path_length": base, "arm_path_length": 10.0 * base, "planning_time": time}
    return {"scene": "a", "method": method, "number": number, "success": success, **figures}


TRIALS = [
    make_record("one", 0, True, 3.0, 1.0),
    make_record("one", 1, True, 4.0, 2.0),
    make_record("one", 2, True, 9.0, 6.0),
    make_record("two", 0, True, 5.0, 3.0),
    make_record("two", 1, True, 6.0, 4.0),
    make_record("two", 2, False, 99.0, None),  # an error
]


def test_criteria_chart_equals_values_computed_by_hand() -> None:
    figure = criteria_chart(TRIALS, None, ["one", "two"], title="All")
    success, base, arm, time = figure.axes
    assert read_bars(success) == {"one": [100.0], "two": [pytest.approx(200.0 / 3.0)]}
    assert read_bars(base) == {"one": [3.5], "two": [5.5]}  # only where both succeed
    assert read_bars(arm) == {"one": [35.0], "two": [55.0]}
    assert read_bars(time) == {"one": [2.0], "two": [3.5]}  # over all trials with a time
    assert read_intervals(success) == [
        pytest.approx([100.0 * end for end in compute_wilson_interval(successes, 3)])
        for successes in (3, 2)
    ]
    assert read_intervals(base) == [[3.25, 3.75], [5.25, 5.75]]
    assert read_intervals(arm) == [[32.5, 37.5], [52.5, 57.5]]
    assert read_intervals(time) == [[1.5, 4.0], [3.25, 3.75]]
    assert read_texts([*success.texts, *base.texts]) == ["100", "67", "3.50", "5.50"]
    labels = [axes.get_xlabel().replace("\n", " ") for axes in figure.axes]
    assert "Wilson" in labels[0]
    assert labels[1] == labels[2] == "median and quartiles over the 2 trials where all succeed"
    assert labels[3] == "median and quartiles over all trials"


def test_means_chart_equals_values_computed_by_hand() -> None:
    unpaired = [
        {**make_record("one", 0, True, 7.0, 5.0), "scene": "b"},
        {**make_record("two", 0, False, 1.0, 7.0), "scene": "b"},
    ]
    what = {"field": "base_path_length", "label": "base path length [m]"}
    figure = means_chart([*TRIALS, *unpaired], None, SCENES, ["one", "two"], **what, shared=True)
    (axes,) = figure.axes
    # The trials with 9 and 99 are not shared.
    assert read_bars(axes) == {"easy\n2 trials": [3.5, 5.5], "hard\nown successes": [7.0]}
    spread = np.sqrt(0.5)  # of 3 and 4, and of 5 and 6; a single value has none
    assert read_intervals(axes) == [
        pytest.approx([3.5 - spread, 3.5 + spread]),
        [7.0, 7.0],
        pytest.approx([5.5 - spread, 5.5 + spread]),
    ]
    assert read_texts(axes.texts) == ["3.5", "7", "5.5"]
    assert axes.get_ylabel() == what["label"]
    assert axes.get_title().startswith("Base path length: mean and standard deviation over trials")
    assert axes.get_ylim()[1] > 7.0


def test_motions_chart_shows_the_plans(tmp_path: Path) -> None:
    plan = make_fake_plan()
    motion = dataclasses.replace(plan.trajectory, times=2.0 * plan.trajectory.times)
    slow = dataclasses.replace(plan, status="success", report=Report(), trajectory=motion)
    path = tmp_path / "new" / "motions.png"
    figure = motions_chart({"first": plan, "second": slow}, path, title="Both")
    rows = np.array(figure.axes).reshape(3, 2)
    titles = [axes.get_title() for axes in rows[0]]
    assert titles == ["first, FAILED: rejected (6.0 s)", "second (12.0 s)"]
    for column, charted in enumerate((plan.trajectory, motion)):
        for axes, read, columns in zip(
            rows[:, column],
            (charted.at, charted.velocity, charted.velocity),
            (slice(3, 9), slice(3, 9), slice(0, 3)),
            strict=True,
        ):
            times = axes.lines[0].get_xdata()
            assert set(charted.times) <= set(times)
            lines = [line.get_ydata() for line in axes.lines]
            np.testing.assert_allclose(lines, read(times)[:, columns].T)
    for row in rows:
        assert row[0].get_ylim() == row[1].get_ylim()
    limit = 2.0 * np.abs(motion.velocities()[:, 3:9]).max()
    assert rows[1, 0].get_ylim() == pytest.approx((-limit, limit)), "failed plans set no scale"
    assert {axes.get_xlim() for axes in rows.ravel()} == {(0.0, 12.0)}
    joints, base = (read_texts(rows[k, 1].get_legend().get_texts()) for k in (0, 2))
    assert joints[:2] == ["shoulder_pan", "shoulder_lift"]
    assert base == ["x [m/s]", "y [m/s]", "yaw [rad/s]"]
    assert path.stat().st_size > 10_000


def test_scale_chart_shows_medians_and_shares(tmp_path: Path) -> None:
    times = {10: (1.0, 1.2, 1.1), 300: (2.0, 1.6, 1.8), 30: (1.3, 1.4, 1.5)}
    share = dict(zip(TIMES, (0.3, 0.1, 0.2, 0.15, 0.05), strict=True))
    records: list[dict[str, Any]] = [
        {"obstacles": count, "planning_time": time, **{name: s * time for name, s in share.items()}}
        for count, samples in times.items()
        for time in samples
    ]
    error = {"obstacles": 10, "status": "error"}
    figure = scale_chart([*records, error], tmp_path / "scale.png", title="Many")
    (axes,), areas = figure.axes, len(TIMES) + 1
    np.testing.assert_allclose(axes.lines[0].get_xydata(), [[10.0, 1.1], [30.0, 1.4], [300.0, 1.8]])
    tops = [area.get_paths()[0].vertices[:, 1].max() for area in axes.collections[:areas]]
    np.testing.assert_allclose(tops, 1.8 * np.array([*np.cumsum(list(share.values())), 1.0]))
    (bars,) = [part for part in axes.collections[areas:] if len(part.get_paths()) == 3]
    np.testing.assert_allclose(
        [bar[:, 1] for bar in bars.get_segments()], [[1.05, 1.15], [1.35, 1.45], [1.7, 1.9]]
    )
    assert read_texts(axes.texts) == ["1.10", "1.40", "1.80"]
    assert read_texts(axes.get_xticklabels()) == ["10", "30", "300"]
    names = read_texts(figure.legends[0].get_texts())
    assert names == [*TIMES.values(), "setting up", "planning time"]
    assert (tmp_path / "scale.png").stat().st_size > 10_000
    assert scale_chart([], None).axes
