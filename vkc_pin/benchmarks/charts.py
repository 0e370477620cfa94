"""Charts of experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.benchmarks.tables import wilson
from vkc_pin.plotting import _COLOURS, _figure, _save, _style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["success_chart"]

_WIDTH = 0.8  # of a group of bars; the distance between groups is 1


def success_chart(
    records: Sequence[Mapping[str, Any]],
    path: str | Path | None,
    scenes: Mapping[str, str],
    methods: Sequence[str],
    *,
    title: str = "",
) -> Figure:
    """Draw success rates as bars, grouped by scene, with Wilson's intervals of 95 % confidence.

    The intervals take all trials for independent, repeats from the same start too.

    Args:
        records: Records with `scene`, `method` and `success`.
        path: The file to write, .png, .svg or .pdf; None writes nothing.
        scenes: Scene → name to show, one group each.
        methods: One bar of each group, in this order.
        title: Written above.

    Returns:
        The figure.
    """
    with _style():
        figure = _figure(max(6.0, 1.0 + 0.5 * len(scenes) * (len(methods) + 1)), 3.8)
        axes = figure.subplots()
        width = _WIDTH / len(methods)
        for k, method in enumerate(methods):
            places = np.arange(len(scenes)) + (k - (len(methods) - 1) / 2.0) * width
            colour = _COLOURS[k % len(_COLOURS)]
            for place, scene in zip(places, scenes, strict=True):
                own = [bool(r["success"]) for r in records if r["scene"] == scene and r["method"] == method]
                if not own:
                    continue
                rate, (low, high) = 100.0 * sum(own) / len(own), (100.0 * end for end in wilson(sum(own), len(own)))
                axes.bar(place, rate, 0.9 * width, color=colour)
                error = np.clip([[rate - low], [high - rate]], 0.0, None)
                axes.errorbar(place, rate, error, color="0.25", linewidth=0.9, capsize=2.5)
                axes.annotate(f"{rate:.0f}", (place, high), (0, 2), textcoords="offset points", ha="center", fontsize=7.5)
            axes.bar(0.0, 0.0, color=colour, label=method)
        axes.set_xticks(range(len(scenes)), [f"{name}\n{_number(records, scene, methods)}" for scene, name in scenes.items()])
        axes.set_xlim(-0.5, len(scenes) - 0.5)
        axes.tick_params(axis="x", length=0.0)
        axes.grid(visible=False, axis="x")
        axes.set_axisbelow(True)
        axes.set_ylim(0.0, 108.0)
        axes.set_yticks(range(0, 101, 20))
        axes.set_ylabel("successful trials [%]")
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside lower center", ncols=len(methods))
        if path is not None:
            _save(figure, Path(path))
    return figure


def _number(records: Sequence[Mapping[str, Any]], scene: str, methods: Sequence[str]) -> str:
    """Return how many trials each method has in a scene."""
    shown = [record["method"] for record in records if record["scene"] == scene and record["method"] in methods]
    numbers = sorted({shown.count(method) for method in shown})
    return f"{' or '.join(map(str, numbers))} trials each" if numbers else "no trials"
