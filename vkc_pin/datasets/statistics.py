"""The page of statistics: what there is of what in a dataset, and ten episodes to look at, as one file of HTML."""

from __future__ import annotations

import html
import io
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.datasets.diversity import compute_coverage
from vkc_pin.datasets.episode import Episode
from vkc_pin.datasets.recipes.recipe import Recipe
from vkc_pin.visualization.plots.style import COLOURS, new_figure, use_style
from vkc_pin.visualization.plots.top_view import draw_top_view
from vkc_pin.world.trajectory.world_model import World

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["make_statistics_page"]

_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:70em;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0}td,th{padding:.2em .8em;border-bottom:1px solid #ddd;text-align:left}"
    "td.n{text-align:right;font-variant-numeric:tabular-nums}svg{max-width:100%;height:auto}"
    ".grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(26em,1fr));gap:1em}figure{margin:0}"
    "figcaption{font-size:13px;color:#555}.bad{color:#b00}"
)
_LISTED = 15  # rows of a table
_CELLS = 10  # of every interval, whose share with an episode is the coverage


def make_statistics_page(
    recipe: Recipe,
    records: Sequence[Mapping[str, Any]],
    failures: Sequence[Mapping[str, str]],
    pictured: Iterable[Episode],
    refused: Mapping[int, str],
    problems: Sequence[str],
) -> str:
    """Return the page, which loads nothing from anywhere.

    Args:
        recipe: What the episodes were made of.
        records: What is known of each; see `check`.
        failures: Rows of failures.csv.
        pictured: Episodes to show from above.
        refused: Number → what the validation says against it.
        problems: What else is wrong.
    """
    name, attempts = recipe.fields.name, len(records) + len(failures)
    seconds = sum(float(record["duration"]) for record in records)
    verdict = (
        "All of them are valid."
        if not refused
        else f'<span class="bad">{len(refused)} of them are refused.</span>'
    )
    parts = [
        f"<h1>{html.escape(name)}</h1>",
        f"<p>{len(records)} episodes, {seconds / 3600.0:.2f} h, of {attempts} attempts; recipe {recipe.digest}. {verdict}</p>",
        _list(
            "What is wrong", [*(f"episode {n}: {text}" for n, text in refused.items()), *problems]
        ),
        "<h2>What there is</h2>",
        *(_counts(field, records) for field in ("task", "robot", "kind")),
        "<h2>Coverage</h2>",
        _coverage(recipe, records),
        _svg(_histograms(records)) if records else "",
        "<h2>Which way round</h2>",
        _windings(records),
        "<h2>Attempts that became no episode</h2>",
        _failures(failures),
        "<h2>Ten episodes at random</h2>",
        '<div class="grid">' + "".join(_picture(episode) for episode in pictured) + "</div>",
    ]
    head = f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(name)}</title>'
    return f"{head}<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"


def _list(title: str, lines: Sequence[str]) -> str:
    if not lines:
        return ""
    shown = "".join(f"<li>{html.escape(line)}</li>" for line in lines[:_LISTED])
    more = f"<li>and {len(lines) - _LISTED} more</li>" if len(lines) > _LISTED else ""
    return f'<h2 class="bad">{title}</h2><ul>{shown}{more}</ul>'


def _rows(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f"<th>{html.escape(text)}</th>" for text in head)
    body = "".join(
        "<tr>"
        + "".join(
            f'<td class="{"n" if k else ""}">{html.escape(text)}</td>' for k, text in enumerate(row)
        )
        + "</tr>"
        for row in rows
    )
    return f"<table><tr>{top}</tr>{body}</table>"


def _counts(field: str, records: Sequence[Mapping[str, Any]]) -> str:
    counted = Counter(str(record[field]) for record in records)
    rows = []
    for name, count in counted.most_common():
        own = [record for record in records if str(record[field]) == name]
        duration = float(np.median([float(record["duration"]) for record in own]))
        gone = float(np.median([float(record["base_path_length"]) for record in own]))
        rows.append(
            [
                name,
                str(count),
                f"{duration:.1f}",
                f"{gone:.2f}",
                str(len({record["scene"] for record in own})),
            ]
        )
    return _rows([field, "episodes", "duration, median [s]", "base, median [m]", "scenes"], rows)


def _coverage(recipe: Recipe, records: Sequence[Mapping[str, Any]]) -> str:
    """Return which share of what the recipe allows there is."""
    if not records:
        return "<p>Nothing.</p>"
    headings = [float(record["start"][2]) % (2.0 * np.pi) for record in records]
    starts = np.array([record["start"][:2] for record in records])
    cells = {tuple(cell) for cell in np.floor(starts / 0.5).astype(int).tolist()}
    rows = [
        [
            "headings of the base at the start, in 10 equal sectors",
            f"{100.0 * compute_coverage(headings, 0.0, 2.0 * np.pi, _CELLS):.0f} %",
        ],
        ["cells of 0.5 m on the floor that something starts in", str(len(cells))],
        ["rooms", str(len({record["room"] for record in records}))],
        [
            "objects that differ",
            str(len({(record["scene"], record["object"]) for record in records})),
        ],
        ["attachments", str(len({(record["kind"], record["attachment"]) for record in records}))],
    ]
    wanted = set(recipe.fields.tasks) - {str(record["task"]) for record in records}
    rows += (
        [["tasks of the recipe without an episode", ", ".join(sorted(wanted))]] if wanted else []
    )
    return _rows(["what", "found"], rows)


def _windings(records: Sequence[Mapping[str, Any]]) -> str:
    """Return how many classes of paths there are."""
    counted = Counter(len(record["winding"]) for record in records)
    classes = {(record["room"], str(record["winding"])) for record in records}
    text = (
        "How a path of the base winds round each thing in the room, beside the straight line between its ends: "
        f"{len(classes)} pairs of a room and a class, in {len({record['room'] for record in records})} rooms."
    )
    rows = [
        [f"round {number} things" if number else "as the straight line", str(count)]
        for number, count in sorted(counted.items())
    ]
    return f"<p>{text}</p>" + _rows(["path of the base", "episodes"], rows)


def _failures(failures: Sequence[Mapping[str, str]]) -> str:
    if not failures:
        return "<p>There are none.</p>"
    counted = Counter(
        (row["task"] or "–", row["status"], re.sub(r"[-\d.]+", "#", row["reason"])[:140])
        for row in failures
    )
    return _rows(
        ["task", "status", "reason", "attempts"],
        [[*key, str(count)] for key, count in counted.most_common(_LISTED)],
    )


def _histograms(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw how durations, ways, clearances, goals and starts are spread."""
    tasks = sorted({str(record["task"]) for record in records})
    with use_style():
        figure = new_figure(10.0, 5.6)
        axes = figure.subplots(2, 3).ravel()
        fields = (
            ("duration", "duration [s]"),
            ("base_path_length", "way of the base [m]"),
            ("arm_path_length", "way of the arm [rad]"),
        )
        for own, (field, label) in zip(
            axes, (*fields, ("clearance", "least clearance [m]")), strict=False
        ):
            columns = [
                [float(r[field]) for r in records if r["task"] == task and field in r]
                for task in tasks
            ]
            own.hist(columns, bins=24, stacked=True, color=COLOURS[: len(tasks)], label=tasks)
            own.set_xlabel(label)
            own.set_ylabel("episodes")
        axes[0].legend(fontsize=8)
        goals = [
            float(record["goal"]) for record in records if not isinstance(record["goal"], list)
        ]
        axes[4].hist(goals, bins=24, color=COLOURS[0])
        axes[4].set_xlabel("goal of what is opened [rad] or [m]")
        axes[4].set_ylabel("episodes")
        starts = np.array([record["start"][:2] for record in records])
        axes[5].plot(starts[:, 0], starts[:, 1], ".", markersize=2.0, color=COLOURS[0], alpha=0.5)
        axes[5].set_aspect("equal")
        axes[5].set_xlabel("x of the start [m]")
        axes[5].set_ylabel("y [m]")
        return figure


def _svg(figure: Figure) -> str:
    """Return a figure as part of a page; the same figure gives the same text."""
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "vkc_pin"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return re.sub(r"^.*?(?=<svg)", "", buffer.getvalue(), flags=re.DOTALL)


def _picture(episode: Episode) -> str:
    """Return an episode from above, with what it does."""
    scene = episode.scene()
    with use_style():
        figure = new_figure(5.2, 4.6)
        draw_top_view(figure, World(scene), episode.trajectory)
        drawn = _svg(figure)
    about = episode.about
    said = (
        f"{episode.number}: {about['task']}, {about['robot']}, {about['kind']} in {about['room']}, "
    )
    seconds = float(episode.trajectory.times[-1] - episode.trajectory.times[0])
    return f"<figure>{drawn}<figcaption>{html.escape(said)}{seconds:.1f} s</figcaption></figure>"
