from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vkc_pin.benchmarks.charts import success_chart
from vkc_pin.benchmarks.tables import wilson

SCENES = {"a": "easy", "b": "hard"}
RATES = {("a", "one"): (4, 4), ("a", "two"): (3, 4), ("b", "one"): (1, 4), ("b", "two"): (0, 4)}
RECORDS: list[dict[str, Any]] = [
    {"scene": scene, "method": method, "success": k < good}
    for (scene, method), (good, number) in RATES.items()
    for k in range(number)
]


def test_bars_and_intervals() -> None:
    figure = success_chart([*RECORDS, {"scene": "a", "method": "other", "success": True}], None, SCENES, ["one", "two"])
    (axes,) = figure.axes
    bars = [bar for bar in axes.patches if bar.get_width() < 0.5]
    places = [bar.get_x() + bar.get_width() / 2.0 for bar in bars]
    assert [bar.get_height() for bar in bars] == [100.0, 25.0, 75.0, 0.0]  # method by method
    assert places == pytest.approx([-0.2, 0.8, 0.2, 1.2])
    assert len({bar.get_facecolor() for bar in bars[:2]}) == 1
    assert bars[0].get_facecolor() != bars[2].get_facecolor()
    intervals = [line.get_segments()[0][:, 1] for line in axes.collections]
    expected = [wilson(*RATES[key]) for key in (("a", "one"), ("b", "one"), ("a", "two"), ("b", "two"))]
    np.testing.assert_allclose(intervals, 100.0 * np.array(expected), atol=1e-9)
    assert [text.get_text() for text in axes.texts] == ["100", "25", "75", "0"]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["easy\n4 trials each", "hard\n4 trials each"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "two"]
    assert all(bar.get_height() == 0.0 for bar in axes.patches if bar not in bars)  # what the legend needs shows nothing


def test_the_file(tmp_path: Path) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.image import imread

    path = tmp_path / "new" / "success.png"
    figure = success_chart(RECORDS, path, SCENES, ["one", "two"], title="Success")
    image = imread(path)[..., :3]
    assert min(image.shape[:2]) > 300
    shares = [
        float((np.abs(image - np.array(to_rgb(bar.get_facecolor()))).max(axis=2) < 0.02).mean())
        for bar in figure.axes[0].patches
        if bar.get_height() in (100.0, 75.0)
    ]
    assert all(share > 0.02 for share in shares)  # the bars are there
    assert shares[0] > shares[1] > 0.5 * shares[0]  # 125 % against 75 % in all
    assert float((image > 0.99).all(axis=2).mean()) > 0.4  # on white


def test_a_method_without_trials_has_no_bar() -> None:
    figure = success_chart(RECORDS[:4], None, SCENES, ["one", "two"])
    assert [text.get_text() for text in figure.axes[0].texts] == ["100"]
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["easy\n4 trials each", "hard\nno trials"]
