"""Planning time against the number of obstacles, drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.benchmarks.tables import TIMES, quartiles
from vkc_pin.style import COLOURS, new_figure, save_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["scale_chart"]


def scale_chart(records: Sequence[Mapping[str, Any]], path: str | Path | None, *, title: str = "") -> Figure:
    """Draw planning time against the number of obstacles, and what it is spent on: medians, and quartiles of the whole.

    Args:
        records: Records as `record.trial` makes them, with `obstacles`; those without a planning time are left out.
        path: The file to write, .png, .svg or .pdf; None writes nothing.
        title: Written above.

    Returns:
        The figure.
    """
    records = [record for record in records if record.get("planning_time") is not None]
    counts = sorted({int(record["obstacles"]) for record in records})
    rows = [[record for record in records if record["obstacles"] == count] for count in counts]

    def medians(*fields: str) -> list[float]:
        """Return, for each number of obstacles, the median of the first field less the others."""
        return [float(np.median([record[fields[0]] - sum(record[f] for f in fields[1:]) for record in own])) for own in rows]

    low, middle, high = np.array([quartiles([record["planning_time"] for record in own]) for own in rows]).reshape(-1, 3).T
    parts = {name: medians(field) for field, name in TIMES.items()} | {"setting up": medians("planning_time", *TIMES)}
    with styled():
        figure = new_figure(6.4, 4.0)
        axes = figure.subplots()
        colours = [*COLOURS[: len(TIMES)], "0.7"]
        axes.stackplot(counts, *parts.values(), labels=[*parts], colors=colours, alpha=0.55)
        error = [middle - low, high - middle]
        axes.errorbar(counts, middle, error, color="0.15", marker="o", markersize=4.0, capsize=2.5, label="planning time")
        for count, height, value in zip(counts, high, middle, strict=True):
            axes.annotate(f"{value:.2f}", (count, height), (0, 5), textcoords="offset points", ha="center", fontsize=8)
        axes.set_xscale("log")
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.minorticks_off()
        axes.set_ylim(0.0, 1.15 * float(high.max(initial=0.0)) or 1.0)
        axes.set_xlabel("obstacles")
        axes.set_ylabel("planning time, median and quartiles [s]")
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside right upper")
        if path is not None:
            save_figure(figure, Path(path))
    return figure
