"""Draws charts of experiments."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vkc_pin.experiments.harness.record import Record
from vkc_pin.experiments.harness.record import values as numbers
from vkc_pin.experiments.harness.tables import (
    compute_mean_and_deviation,
    compute_quartiles,
    compute_wilson_interval,
    find_common_successes,
)
from vkc_pin.planning.plan import Plan
from vkc_pin.visualization.plots.style import (
    COLOURS,
    new_figure,
    save_figure,
    shade_phases,
    use_style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_WIDTH = 0.8  # of a group of bars; the distance between groups is 1
_SAMPLES = 400  # moments of a motion that are drawn
_ROOM = (
    2.0  # a scale that is not made for all motions reaches so many times farther than the others
)
_BASE = ("x [m/s]", "y [m/s]", "yaw [rad/s]")


def success_chart(
    records: Sequence[Record],
    path: str | Path | None,
    scenes: Mapping[str, str],
    methods: Sequence[str],
    *,
    title: str = "",
) -> Figure:
    """Draw success rates as bars with Wilson's 95 % intervals, grouped by scene.

    The intervals treat all trials as independent, including repeats from the same start.

    Args:
        path: File to write; None writes nothing.
        records: Records with `scene`, `method` and `success`.
        scenes: Scene → displayed name.
        methods: Methods in the order of the bars.
        title: Title.
    """

    def bar(scene: str, method: str) -> tuple[float, float, float] | None:
        own = [bool(r["success"]) for r in records if r["scene"] == scene and r["method"] == method]
        return _rate(own) if own else None

    names = {scene: f"{name}\n{_number(records, scene, methods)}" for scene, name in scenes.items()}
    figure = _draw_groups(
        names, methods, bar, label="successful trials [%]", form=".0f", title=title
    )
    (axes,) = figure.axes
    axes.set_ylim(0.0, 108.0)
    axes.set_yticks(range(0, 101, 20))
    return save_figure(figure, path)


def means_chart(
    records: Sequence[Record],
    path: str | Path | None,
    scenes: Mapping[str, str],
    methods: Sequence[str],
    *,
    field: str,
    label: str,
    shared: bool,
) -> Figure:
    """Draw means of a field as bars with standard deviations (n − 1), grouped by scene.

    Args:
        path: File to write; None writes nothing.
        records: Records of `record.trial`.
        scenes: Scene → displayed name.
        methods: Methods in the order of the bars.
        field: Field of the records.
        label: Name and unit of the field.
        shared: Whether to use trials in which all methods succeed, or each method's successes where
            there are none. Otherwise all trials.
    """
    values: dict[tuple[str, str], list[float]] = {}
    names = {}
    for scene, name in scenes.items():
        own = [record for record in records if record["scene"] == scene]
        both = find_common_successes(own, methods) if shared else []
        for k, method in enumerate(methods):
            mine = [record for record in own if record["method"] == method]
            if shared:
                mine = [row[k] for row in both] or [record for record in mine if record["success"]]
            values[scene, method] = numbers(mine, field)
        trials = f"{len(both)} trial{'s' * (len(both) != 1)}" if both else "own successes"
        names[scene] = f"{name}\n{trials if shared else _number(own, scene, methods)}"

    def bar(scene: str, method: str) -> tuple[float, float, float] | None:
        if not values[scene, method]:
            return None
        mean, deviation = compute_mean_and_deviation(values[scene, method])
        spread = deviation if np.isfinite(deviation) else 0.0
        return mean - spread, mean, mean + spread

    over = "trials in which all methods succeed" if shared else "all trials"
    title = f"{label.partition(' [')[0].capitalize()}: mean and standard deviation over {over}"
    figure = _draw_groups(names, methods, bar, label=label, form=".3g", title=title)
    (axes,) = figure.axes
    axes.set_ylim(0.0, 1.06 * axes.get_ylim()[1])
    return save_figure(figure, path)


def criteria_chart(
    records: Sequence[Record], path: str | Path | None, methods: Sequence[str], *, title: str = ""
) -> Figure:
    """Draw success rate, path lengths and planning time of a task as bars.

    Rates have Wilson's 95 % intervals; the other bars are medians with quartiles, of times over all
    trials, of path lengths over trials in which all methods succeed, if there are any.

    Args:
        path: File to write; None writes nothing.
        records: Records of one task.
        methods: Methods in the order of the bars.
        title: Title.
    """
    both = find_common_successes(records, methods)
    where = (
        f"the\n{len(both)} trial{'s' * (len(both) != 1)} where all succeed"
        if both
        else "own successes;\nnowhere all succeed"
    )
    shared = f"median and quartiles over {where}"
    panels = (
        ("success", "success [%]", "all trials,\n95 % confidence (Wilson)", ".0f"),
        ("base_path_length", "base path length [m]", shared, ".2f"),
        ("arm_path_length", "arm path length [rad]", shared, ".2f"),
        ("planning_time", "planning time [s]", "median and quartiles\nover all trials", ".2f"),
    )
    with use_style():
        figure = new_figure(11.0, 3.4)
        for axes, (field, name, about, form) in zip(
            figure.subplots(1, len(panels)), panels, strict=True
        ):
            for k, method in enumerate(methods):
                own = [record for record in records if record["method"] == method]
                if field in ("base_path_length", "arm_path_length"):
                    own = [row[k] for row in both] or [
                        record for record in own if record["success"]
                    ]
                values = numbers(own, field)
                if values:
                    interval = (
                        _rate([value > 0.0 for value in values])
                        if field == "success"
                        else compute_quartiles(values)
                    )
                    _bar(
                        axes,
                        k,
                        interval,
                        COLOURS[k % len(COLOURS)],
                        f"{interval[1]:{form}}",
                        width=0.7,
                    )
            _name_bars(axes, methods, 0.6)
            axes.set_ylim(0.0, 110.0 if field == "success" else 1.12 * axes.get_ylim()[1])
            axes.set_title(name, fontsize=9.5)
            axes.set_xlabel(about, fontsize=7.5, color="0.35")
        figure.suptitle(title, fontsize=10.5)
        return save_figure(figure, path)


def motions_chart(plans: Mapping[str, Plan], path: str | Path | None, *, title: str = "") -> Figure:
    """Draw arm positions, arm velocities and base velocities of plans over time.

    Velocities are scaled to successful motions, if there are any.

    Args:
        path: File to write; None writes nothing.
        plans: Name → plan, one column each.
        title: Title.
    """
    with use_style():
        figure = new_figure(1.2 + 4.0 * len(plans), 7.0)
        columns: Any = figure.subplots(3, len(plans), sharex=True, sharey="row", squeeze=False).T
        for (position, velocity, base), (name, plan) in zip(columns, plans.items(), strict=True):
            motion = plan.trajectory
            fine = np.unique(
                np.concatenate(
                    [np.linspace(motion.times[0], motion.times[-1], _SAMPLES), motion.times]
                )
            )
            places, rates = motion(fine), motion.velocity(fine)
            steps: Any = {
                "linewidth": 1.2,
                "drawstyle": "steps-post" if motion.curve is None else "default",
            }
            for k, joint in enumerate(range(3, motion.robot_size)):
                colour = COLOURS[k % len(COLOURS)]
                label = motion.names[joint].removesuffix("_joint")
                position.plot(fine, places[:, joint], color=colour, label=label)
                velocity.plot(fine, rates[:, joint], color=colour, **steps)
            for k, label in enumerate(_BASE):
                base.plot(fine, rates[:, k], color=COLOURS[k], label=label, **steps)
            for axes in (position, velocity, base):
                shade_phases(axes, motion)
                axes.margins(x=0.0)
            outcome = "" if plan.success else f", FAILED: {plan.status}"
            position.set_title(
                f"{name}{outcome} ({motion.times[-1] - motion.times[0]:.1f} s)", fontsize=9.5
            )
            base.set_xlabel("time [s]")
        good = [plan.trajectory for plan in plans.values() if plan.success]
        for row, part in (
            (1, lambda motion: slice(3, motion.robot_size)),
            (2, lambda motion: slice(0, 3)),
        ):
            if good and len(good) < len(plans):
                largest = max(
                    float(np.abs(motion.velocity(motion.times)[:, part(motion)]).max())
                    for motion in good
                )
                columns[0][row].set_ylim(-_ROOM * largest, _ROOM * largest)
        for axes, label in zip(
            columns[0],
            ("arm positions [rad]", "arm velocities [rad/s]", "base velocity"),
            strict=True,
        ):
            axes.set_ylabel(label)
        for axes in columns[-1][[0, 2]]:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7.5)
        figure.suptitle(title, fontsize=10.5)
        return save_figure(figure, path)


def _draw_groups(
    scenes: Mapping[str, str],
    methods: Sequence[str],
    bar: Callable[[str, str], tuple[float, float, float] | None],
    *,
    label: str,
    form: str,
    title: str,
) -> Figure:
    """Draw grouped bars; `bar` returns lower end, height and upper end, or None."""
    with use_style():
        figure = new_figure(max(6.0, 1.0 + 0.5 * len(scenes) * (len(methods) + 1)), 3.8)
        axes = figure.subplots()
        width = _WIDTH / len(methods)
        for k, method in enumerate(methods):
            places = np.arange(len(scenes)) + (k - (len(methods) - 1) / 2.0) * width
            colour = COLOURS[k % len(COLOURS)]
            for place, scene in zip(places, scenes, strict=True):
                interval = bar(scene, method)
                if interval is not None:
                    _bar(axes, place, interval, colour, f"{interval[1]:{form}}", width=0.9 * width)
            axes.bar(0.0, 0.0, color=colour, label=method)
        _name_bars(axes, list(scenes.values()), 0.5)
        axes.set_ylabel(label)
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside lower center", ncols=len(methods))
    return figure


def _rate(good: Sequence[bool]) -> tuple[float, float, float]:
    """Return Wilson's lower limit, success rate and upper limit [%]."""
    low, high = compute_wilson_interval(sum(good), len(good))
    return 100.0 * low, 100.0 * sum(good) / len(good), 100.0 * high


def _bar(
    axes: Axes,
    place: float,
    interval: tuple[float, float, float],
    colour: str,
    text: str,
    *,
    width: float,
) -> None:
    """Draw a bar with an error bar from its lower end, height and upper end."""
    low, height, high = interval
    axes.bar(place, height, width, color=colour)
    error = np.clip([[height - low], [high - height]], 0.0, None)
    axes.errorbar(place, height, error, color="0.25", linewidth=0.9, capsize=2.5)
    axes.annotate(
        text, (place, high), (0, 2), textcoords="offset points", ha="center", fontsize=7.5
    )


def _name_bars(axes: Axes, names: Sequence[str], margin: float) -> None:
    """Label bars at 0, 1, ... and leave a margin on both sides."""
    axes.set_xticks(range(len(names)), names)
    axes.set_xlim(-margin, len(names) - 1 + margin)
    axes.tick_params(axis="x", length=0.0)
    axes.grid(visible=False, axis="x")
    axes.set_axisbelow(True)


def _number(records: Sequence[Record], scene: str, methods: Sequence[str]) -> str:
    """Return the number of trials of each method in a scene, in words."""
    shown = [
        record["method"]
        for record in records
        if record["scene"] == scene and record["method"] in methods
    ]
    numbers = sorted({shown.count(method) for method in shown})
    return f"{' or '.join(map(str, numbers))} trials each" if numbers else "no trials"
