"""Draws docs/images/tradeoff.png from its record.

docs/results/tradeoff.json.gz is that of `python -m tests.benchmarks ablation` with other weights of
the base. A point is the mean path lengths of base and arm over the problems that succeed at every
weight.
"""

from __future__ import annotations

import gzip
import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from docs.pictures import DOCS, IMAGES
from vkc_pin.options import Options
from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style

FIELD = "velocity_weight_base"


def weight(method: str) -> float:
    """Return the base weight of a setting; the default where the setting does not change it."""
    name, _, value = method.rpartition("=")
    return float(value) if name == f"Options.{FIELD}" else getattr(Options(), FIELD)


def points(trials: Sequence[Mapping[str, Any]]) -> list[tuple[float, float, float, int]]:
    """Return weight, mean base path [m], mean arm path [rad] and number of problems, by weight."""
    found = {(weight(trial["method"]), trial["number"]): trial for trial in trials}
    weights, numbers = (sorted({key[k] for key in found}) for k in (0, 1))
    whole = [number for number in numbers if all(found[w, number]["success"] for w in weights)]
    mean = {
        field: [np.mean([found[w, n][field] for n in whole]) for w in weights]
        for field in ("base_path_length", "arm_path_length")
    }
    return [
        (w, float(base), float(arm), len(whole))
        for w, base, arm in zip(weights, *mean.values(), strict=True)
    ]


def make() -> None:
    """Draw the curve, and print its points as a table."""
    record = DOCS / "results" / "tradeoff.json.gz"
    drawn = points(json.loads(gzip.decompress(record.read_bytes()))["trials"])
    with use_style():
        figure = new_figure(5.6, 3.8)
        axes = figure.subplots()
        axes.plot(
            [base for _, base, *_ in drawn], [arm for _, _, arm, _ in drawn], "o-", color=COLOURS[0]
        )
        for w, base, arm, _ in drawn:
            usual = " (usual)" if w == getattr(Options(), FIELD) else ""
            rate = np.sqrt(w / Options().velocity_weight_arm)
            axes.annotate(
                f"{rate:.3g} rad/m{usual}",
                (base, arm),
                (6, 4),
                textcoords="offset points",
                fontsize=8,
            )
        axes.margins(x=0.25)
        axes.set_xlabel("base path, mean [m]")
        axes.set_ylabel("arm path, mean [rad]")
        axes.set_title(f"Weight of a metre of the base, {drawn[0][3]} problems", fontsize=10)
        save_figure(figure, IMAGES / "tradeoff.png")
    for row in drawn:
        sys.stdout.write("| {:g} | {:.3f} | {:.3f} | {} |\n".format(*row))
