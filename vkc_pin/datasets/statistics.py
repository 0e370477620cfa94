"""Writes the statistics of a dataset as an HTML page."""

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
from vkc_pin.datasets.recipe import Recipe
from vkc_pin.visualization.plots.style import COLOURS, new_figure, use_style
from vkc_pin.visualization.plots.top_view import draw_top_view
from vkc_pin.world.trajectory.world_model import World

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_STYLE = (
    "body{font:15px/1.5 sans-serif;margin:2em auto;max-width:70em;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0}"
    "td,th{padding:.2em .8em;border-bottom:1px solid #ddd;text-align:left}"
    "td+td{text-align:right;font-variant-numeric:tabular-nums}svg{max-width:100%;height:auto}"
    ".grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(26em,1fr));gap:1em}"
    "figure{margin:0}figcaption{font-size:13px;color:#555}.bad{color:#b00}"
)
# rows of a table
_LISTED = 15
# equal parts of every interval; the fraction with an episode is the coverage
_CELLS = 10
# [m] side of the squares of the floor that are counted
_SQUARE = 0.5
# characters of a reason for failure
_REASON_LENGTH = 140


def make_statistics_page(
    recipe: Recipe,
    records: Sequence[Mapping[str, Any]],
    failures: Sequence[Mapping[str, str]],
    pictured: Iterable[Episode],
    refused: Mapping[int, str],
    problems: Sequence[str],
) -> str:
    """Return the page, which loads no other files.

    Args:
        recipe: Recipe of the episodes.
        records: Records of the episodes; see `check`.
        failures: Rows of failures.csv.
        pictured: Episodes to show from above.
        refused: Number of each invalid episode → reason.
        problems: Other problems.
    """
    name = html.escape(recipe.fields.name)
    attempts = len(records) + len(failures)
    hours = sum(float(record["duration"]) for record in records) / 3600.0
    invalid = [f"episode {number}: {reason}" for number, reason in refused.items()]
    verdict = "All of them are valid."
    if refused:
        verdict = f'<span class="bad">{len(refused)} of them are invalid.</span>'
    histograms = _render_svg(_draw_histograms(records)) if records else ""
    pictures = "".join(_make_picture(episode) for episode in pictured)
    parts = [
        f"<h1>{name}</h1><p>{len(records)} episodes, {hours:.2f} h, of {attempts} attempts; "
        f"recipe {recipe.digest}. {verdict}</p>",
        _make_list("Problems", [*invalid, *problems]),
        "<h2>Episodes</h2>",
        _make_table_of_counts("task", records),
        _make_table_of_counts("robot", records),
        _make_table_of_counts("kind", records),
        "<h2>Coverage</h2>",
        _make_table_of_coverage(recipe, records),
        histograms,
        _make_table_of_views(records),
        "<h2>Homotopy classes</h2>",
        _make_table_of_classes(records),
        "<h2>Failed attempts</h2>",
        _make_table_of_failures(failures),
        "<h2>Ten random episodes</h2>",
        f'<div class="grid">{pictures}</div>',
    ]
    head = f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{name}</title>'
    return f"{head}<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"


def _make_list(title: str, lines: Sequence[str]) -> str:
    """Return a list of lines under a title; "" without lines."""
    if not lines:
        return ""
    shown = "".join(f"<li>{html.escape(line)}</li>" for line in lines[:_LISTED])
    more = f"<li>and {len(lines) - _LISTED} more</li>" if len(lines) > _LISTED else ""
    return f'<h2 class="bad">{title}</h2><ul>{shown}{more}</ul>'


def _make_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of texts."""
    body = "".join(_make_row(row, "td") for row in rows)
    return f"<table>{_make_row(head, 'th')}{body}</table>"


def _make_row(texts: Sequence[str], tag: str) -> str:
    cells = "".join(f"<{tag}>{html.escape(text)}</{tag}>" for text in texts)
    return f"<tr>{cells}</tr>"


def _make_table_of_views(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of how often cameras see the attachment; "" without cameras."""
    shares = dict[tuple[str, str], list[float]]()
    for record in records:
        for camera, share in record.get("seen", {}).items():
            shares.setdefault((camera, str(record["task"])), []).append(share)
    if not shares:
        return ""
    rows = []
    for (camera, task), values in sorted(shares.items()):
        always = sum(value == 1.0 for value in values)
        mean = f"{100.0 * float(np.mean(values)):.0f} %"
        rows.append([camera, task, str(len(values)), mean, str(always)])
    head = ["camera", "task", "episodes", "samples", "episodes with all samples"]
    title = "<h2>Samples until the grasp in which cameras see the attachment</h2>"
    return title + _make_table(head, rows)


def _make_table_of_counts(field: str, records: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of the episodes by the values of a field."""
    rows: list[list[str]] = []
    for name, count in Counter(str(record[field]) for record in records).most_common():
        own = [record for record in records if str(record[field]) == name]
        duration = np.median([float(record["duration"]) for record in own])
        length = np.median([float(record["base_path_length"]) for record in own])
        scenes = len({record["scene"] for record in own})
        rows.append([name, str(count), f"{duration:.1f}", f"{length:.2f}", str(scenes)])
    head = [field, "episodes", "duration, median [s]", "base, median [m]", "scenes"]
    return _make_table(head, rows)


def _make_table_of_coverage(recipe: Recipe, records: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of how much of the recipe's ranges is covered."""
    if not records:
        return "<p>There are no episodes.</p>"
    headings = [float(record["start"][2]) % (2.0 * np.pi) for record in records]
    covered = compute_coverage(headings, 0.0, 2.0 * np.pi, _CELLS)
    starts = np.array([record["start"][:2] for record in records])
    squares = {tuple(square) for square in np.floor(starts / _SQUARE).astype(int).tolist()}
    rooms = {record["room"] for record in records}
    objects = {(record["scene"], record["object"]) for record in records}
    attachments = {(record["kind"], record["attachment"]) for record in records}
    rows = [
        ["start headings of the base, in 10 equal sectors", f"{100.0 * covered:.0f} %"],
        ["cells of 0.5 m on the floor with a start", str(len(squares))],
        ["rooms", str(len(rooms))],
        ["different objects", str(len(objects))],
        ["attachments", str(len(attachments))],
    ]
    missing = set(recipe.fields.tasks) - {str(record["task"]) for record in records}
    if missing:
        rows.append(["tasks of the recipe without an episode", ", ".join(sorted(missing))])
    return _make_table(["quantity", "found"], rows)


def _make_table_of_classes(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of homotopy classes."""
    counted = Counter(len(record["winding"]) for record in records)
    classes = {(record["room"], str(record["winding"])) for record in records}
    rooms = len({record["room"] for record in records})
    text = (
        "Winding numbers of the base path about each object in the room, relative to the straight "
        f"line between its ends: {len(classes)} pairs of a room and a class, in {rooms} rooms."
    )
    rows: list[list[str]] = []
    for number, count in sorted(counted.items()):
        path = f"around {number} objects" if number else "as the straight line"
        rows.append([path, str(count)])
    return f"<p>{text}</p>" + _make_table(["path of the base", "episodes"], rows)


def _make_table_of_failures(failures: Sequence[Mapping[str, str]]) -> str:
    """Return a table of failed attempts by task, status and reason, whose numbers do not count."""
    counted = Counter[tuple[str, str, str]]()
    for row in failures:
        reason = re.sub(r"[-\d.]+", "#", row["reason"])
        counted[row["task"] or "–", row["status"], reason[:_REASON_LENGTH]] += 1
    if not counted:
        return "<p>None.</p>"
    rows = [[*key, str(count)] for key, count in counted.most_common(_LISTED)]
    return _make_table(["task", "status", "reason", "attempts"], rows)


def _draw_histograms(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw durations, path lengths, clearances, goals and starts."""
    tasks = sorted({str(record["task"]) for record in records})
    fields = {
        "duration": "duration [s]",
        "base_path_length": "base path length [m]",
        "arm_path_length": "arm path length [rad]",
        "clearance": "least clearance [m]",
    }
    with use_style():
        figure = new_figure(10.0, 5.6)
        *axes, goal_axes, start_axes = figure.subplots(2, 3).ravel()
        for own, (field, label) in zip(axes, fields.items(), strict=True):
            columns: dict[str, list[float]] = {task: [] for task in tasks}
            for record in records:
                if field in record:
                    columns[record["task"]].append(float(record[field]))
            own.hist(
                list(columns.values()),
                bins=24,
                stacked=True,
                color=COLOURS[: len(tasks)],
                label=tasks,
            )
            own.set(xlabel=label, ylabel="episodes")
        axes[0].legend(fontsize=8)
        goals = [
            float(record["goal"]) for record in records if not isinstance(record["goal"], list)
        ]
        goal_axes.hist(goals, bins=24, color=COLOURS[0])
        goal_axes.set(xlabel="goal of the joint [rad] or [m]", ylabel="episodes")
        starts = np.array([record["start"][:2] for record in records])
        start_axes.plot(*starts.T, ".", markersize=2.0, color=COLOURS[0], alpha=0.5)
        start_axes.set(aspect="equal", xlabel="x of the start [m]", ylabel="y [m]")
        return figure


def _render_svg(figure: Figure) -> str:
    """Return a figure as reproducible SVG."""
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "vkc_pin"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return re.sub(r"^.*?(?=<svg)", "", buffer.getvalue(), flags=re.DOTALL)


def _make_picture(episode: Episode) -> str:
    """Return a top view of an episode with a caption."""
    with use_style():
        figure = new_figure(5.2, 4.6)
        draw_top_view(figure, World(episode.scene()), episode.trajectory)
        picture = _render_svg(figure)
    about = episode.about
    times = episode.trajectory.times
    duration = float(times[-1] - times[0])
    caption = (
        f"{episode.number}: {about['task']}, {about['robot']}, {about['kind']} in "
        f"{about['room']}, {duration:.1f} s"
    )
    return f"<figure>{picture}<figcaption>{html.escape(caption)}</figcaption></figure>"
