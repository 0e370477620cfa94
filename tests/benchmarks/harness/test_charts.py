from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fake_plan import make_fake_plan

from vkc_pin.benchmarks.harness.charts import (
    criteria_chart,
    means_chart,
    motions_chart,
    success_chart,
)
from vkc_pin.benchmarks.harness.tables import TIMES, compute_wilson_interval
from vkc_pin.benchmarks.scale import scale_chart
from vkc_pin.planning.plan import Plan
from vkc_pin.validation.report import Report

SCENES = {"a": "easy", "b": "hard"}
RATES = {("a", "one"): (4, 4), ("a", "two"): (3, 4), ("b", "one"): (1, 4), ("b", "two"): (0, 4)}
RECORDS: list[dict[str, Any]] = [
    {"scene": scene, "method": method, "success": k < successes}
    for (scene, method), (successes, number) in RATES.items()
    for k in range(number)
]


def test_success_chart_has_rates_and_intervals() -> None:
    figure = success_chart(
        [*RECORDS, {"scene": "a", "method": "other", "success": True}], None, SCENES, ["one", "two"]
    )
    (axes,) = figure.axes
    bars = [bar for bar in axes.patches if bar.get_width() < 0.5]
    places = [bar.get_x() + bar.get_width() / 2.0 for bar in bars]
    assert [bar.get_height() for bar in bars] == [100.0, 25.0, 75.0, 0.0]  # method by method
    assert places == pytest.approx([-0.2, 0.8, 0.2, 1.2])
    assert len({bar.get_facecolor() for bar in bars[:2]}) == 1
    assert bars[0].get_facecolor() != bars[2].get_facecolor()
    intervals = [line.get_segments()[0][:, 1] for line in axes.collections]
    expected = [
        compute_wilson_interval(*RATES[key])
        for key in (("a", "one"), ("b", "one"), ("a", "two"), ("b", "two"))
    ]
    np.testing.assert_allclose(intervals, 100.0 * np.array(expected), atol=1e-9)
    assert [text.get_text() for text in axes.texts] == ["100", "25", "75", "0"]
    assert [label.get_text() for label in axes.get_xticklabels()] == [
        "easy\n4 trials each",
        "hard\n4 trials each",
    ]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "two"]
    assert all(
        bar.get_height() == 0.0 for bar in axes.patches if bar not in bars
    )  # bars for the legend have no height


def test_method_without_trials_has_no_bar() -> None:
    figure = success_chart(RECORDS[:4], None, SCENES, ["one", "two"])
    assert [text.get_text() for text in figure.axes[0].texts] == ["100"]
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == [
        "easy\n4 trials each",
        "hard\nno trials",
    ]


def make_record(
    method: str, number: int, success: bool, base: float, time: float | None
) -> dict[str, Any]:
    figures = {"base_path_length": base, "arm_path_length": 10.0 * base, "planning_time": time}
    return {"scene": "a", "method": method, "number": number, "success": success, **figures}


TRIALS = [
    *(
        make_record("one", number, True, base, time)
        for number, base, time in ((0, 3.0, 1.0), (1, 4.0, 2.0), (2, 9.0, 6.0))
    ),
    *(
        make_record("two", number, successes, base, time)
        for number, successes, base, time in ((0, True, 5.0, 3.0), (1, True, 6.0, 4.0))
    ),
    make_record("two", 2, False, 99.0, None),  # an error
]


def read_bars(axes: Any) -> list[tuple[str, float]]:
    names = [label.get_text() for label in axes.get_xticklabels()]
    return [
        (names[round(bar.get_x() + bar.get_width() / 2.0)], bar.get_height())
        for bar in axes.patches
    ]


def test_criteria_chart_equals_values_computed_by_hand() -> None:
    figure = criteria_chart(TRIALS, None, ["one", "two"], title="All")
    success, base, arm, time = figure.axes
    assert read_bars(success) == [("one", 100.0), ("two", pytest.approx(200.0 / 3.0))]
    assert read_bars(base) == [("one", 3.5), ("two", 5.5)]  # only where both succeed
    assert read_bars(arm) == [("one", 35.0), ("two", 55.0)]
    assert read_bars(time) == [("one", 2.0), ("two", 3.5)]  # over all trials with a time
    ends = [
        [line.get_segments()[0][:, 1].tolist() for line in axes.collections] for axes in figure.axes
    ]
    assert ends[0] == [
        pytest.approx([100.0 * end for end in compute_wilson_interval(successes, 3)])
        for successes in (3, 2)
    ]
    assert ends[1:] == [
        [[3.25, 3.75], [5.25, 5.75]],
        [[32.5, 37.5], [52.5, 57.5]],
        [[1.5, 4.0], [3.25, 3.75]],
    ]
    assert [text.get_text() for text in success.texts + base.texts] == ["100", "67", "3.50", "5.50"]
    labels = [axes.get_xlabel().replace("\n", " ") for axes in figure.axes]
    assert "Wilson" in labels[0]
    assert labels[1] == labels[2] == "median and quartiles over the 2 trials where all succeed"
    assert labels[3] == "median and quartiles over all trials"
    colours = [[bar.get_facecolor() for bar in axes.patches] for axes in figure.axes]
    assert all(pair == colours[0] for pair in colours)
    assert colours[0][0] != colours[0][1]


def read_grouped_bars(axes: Any) -> dict[str, list[float]]:
    """Return group → heights of its bars, in the order of methods."""
    names = [label.get_text() for label in axes.get_xticklabels()]
    heights: dict[str, list[float]] = {name: [] for name in names}
    for bar in axes.patches:
        if bar.get_width() < 0.5:  # not a bar for the legend
            heights[names[round(bar.get_x() + bar.get_width() / 2.0)]].append(bar.get_height())
    return heights


def test_means_chart_equals_values_computed_by_hand() -> None:
    unpaired = [
        {**make_record("one", 0, True, 7.0, 5.0), "scene": "b"},
        {**make_record("two", 0, False, 1.0, 7.0), "scene": "b"},
    ]
    records, scenes = [*TRIALS, *unpaired], {"a": "easy", "b": "hard"}
    figure = means_chart(
        records,
        None,
        scenes,
        ["one", "two"],
        field="base_path_length",
        label="base path length [m]",
        shared=True,
    )
    (axes,) = figure.axes
    assert read_grouped_bars(axes) == {
        "easy\n2 trials": [3.5, 5.5],
        "hard\nown successes": [7.0],
    }  # 9 and 99 are not shared
    ends = [line.get_segments()[0][:, 1].tolist() for line in axes.collections]
    spread = np.sqrt(0.5)  # of 3 and 4, and of 5 and 6; a single value has none
    assert ends == [
        pytest.approx([3.5 - spread, 3.5 + spread]),
        [7.0, 7.0],
        pytest.approx([5.5 - spread, 5.5 + spread]),
    ]
    assert [text.get_text() for text in axes.texts] == ["3.5", "7", "5.5"]
    assert axes.get_ylabel() == "base path length [m]"
    assert (
        axes.get_title()
        == "Base path length: mean and standard deviation over trials in which all methods succeed"
    )
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "two"]
    assert axes.get_ylim()[1] > 7.0


def compute_peak_speed(plan: Plan) -> float:
    return float(np.abs(plan.trajectory.velocities()[:, 3:9]).max())


def test_motions_chart_shows_the_plans(tmp_path: Path) -> None:
    from matplotlib.image import imread

    plan = make_fake_plan()
    slow = dataclasses.replace(
        plan,
        status="success",
        report=Report(),
        trajectory=dataclasses.replace(plan.trajectory, times=2.0 * plan.trajectory.times),
    )
    path = tmp_path / "new" / "motions.png"
    figure = motions_chart({"first": plan, "second": slow}, path, title="Both")
    rows = np.array(figure.axes).reshape(3, 2)
    assert rows[0, 0].get_title() == "first, FAILED: rejected (6.0 s)"
    assert rows[0, 1].get_title() == "second (12.0 s)"
    for column, charted in enumerate((plan, slow)):
        motion, (position, velocity, base) = charted.trajectory, rows[:, column]
        for axes, read, columns in (
            (position, motion.at, slice(3, 9)),
            (velocity, motion.velocity, slice(3, 9)),
            (base, motion.velocity, slice(0, 3)),
        ):
            times = axes.lines[0].get_xdata()
            assert set(motion.times) <= set(times)
            np.testing.assert_allclose(
                [line.get_ydata() for line in axes.lines], read(times)[:, columns].T
            )
    for row in rows:
        assert row[0].get_ylim() == row[1].get_ylim()
    assert rows[1, 0].get_ylim() == pytest.approx(
        (-2.0 * compute_peak_speed(slow), 2.0 * compute_peak_speed(slow))
    )  # the scale ignores the failed plan
    assert {axes.get_xlim() for axes in rows.ravel()} == {(0.0, 12.0)}
    assert [text.get_text() for text in rows[0, 1].get_legend().get_texts()][:2] == [
        "shoulder_pan",
        "shoulder_lift",
    ]
    assert [text.get_text() for text in rows[2, 1].get_legend().get_texts()] == [
        "x [m/s]",
        "y [m/s]",
        "yaw [rad/s]",
    ]
    image = imread(path)[..., :3]
    assert float((np.ptp(image, axis=2) > 0.2).mean()) > 0.005  # coloured lines


def test_scale_chart_shows_medians_and_shares(tmp_path: Path) -> None:
    times = {10: (1.0, 1.2, 1.1), 300: (2.0, 1.6, 1.8), 30: (1.3, 1.4, 1.5)}
    share = dict(zip(TIMES, (0.3, 0.1, 0.2, 0.15, 0.05), strict=True))
    records: list[dict[str, Any]] = [
        {
            "obstacles": count,
            "planning_time": time,
            **{field: part * time for field, part in share.items()},
        }
        for count, samples in times.items()
        for time in samples
    ]
    figure = scale_chart(
        [*records, {"obstacles": 10, "status": "error"}], tmp_path / "scale.png", title="Many"
    )
    (axes,) = figure.axes
    np.testing.assert_allclose(axes.lines[0].get_xydata(), [[10.0, 1.1], [30.0, 1.4], [300.0, 1.8]])
    tops = [area.get_paths()[0].vertices[:, 1].max() for area in axes.collections[: len(TIMES) + 1]]
    np.testing.assert_allclose(tops, 1.8 * np.array([*np.cumsum(list(share.values())), 1.0]))
    (bars,) = [
        part
        for part in axes.collections
        if len(part.get_paths()) == 3 and part not in axes.collections[: len(TIMES) + 1]
    ]
    np.testing.assert_allclose(
        [bar[:, 1] for bar in bars.get_segments()], [[1.05, 1.15], [1.35, 1.45], [1.7, 1.9]]
    )
    assert [text.get_text() for text in axes.texts] == ["1.10", "1.40", "1.80"]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["10", "30", "300"]
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == [*TIMES.values(), "setting up", "planning time"]
    assert (tmp_path / "scale.png").stat().st_size > 10_000
    assert scale_chart([], None).axes
