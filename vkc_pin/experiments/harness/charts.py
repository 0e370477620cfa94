"""Draws charts of experiments."""

from __future__ import annotations

from collections import Counter
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
    select,
)
from vkc_pin.planning.plan import Plan
from vkc_pin.visualization.plots.style import (
    COLOURS,
    new_figure,
    save_figure,
    shade_phases,
    use_style,
)
from vkc_pin.world.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# width of a group of bars; the distance between groups is 1
_WIDTH = 0.8
# times of a motion that are drawn
_SAMPLES = 400
# A scale that is not made for all motions reaches so many times farther than the others.
_SCALE = 2.0
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

    def measure(scene: str, method: str) -> tuple[float, float, float] | None:
        own = select(records, scene=scene, method=method)
        return _compute_rate([bool(record["success"]) for record in own]) if own else None

    names: dict[str, str] = {}
    for scene, name in scenes.items():
        names[scene] = f"{name}\n{_describe_number(records, scene, methods)}"
    figure = _draw_groups(
        names, methods, measure, label="successful trials [%]", form=".0f", title=title
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
    names: dict[str, str] = {}
    for scene, name in scenes.items():
        own = select(records, scene=scene)
        common = find_common_successes(own, methods) if shared else []
        for k, method in enumerate(methods):
            if shared:
                mine = _select_successes(own, common, k, method)
            else:
                mine = select(own, method=method)
            values[scene, method] = numbers(mine, field)
        if not shared:
            trials = _describe_number(own, scene, methods)
        elif common:
            trials = _count_trials(len(common))
        else:
            trials = "own successes"
        names[scene] = f"{name}\n{trials}"

    def measure(scene: str, method: str) -> tuple[float, float, float] | None:
        if not values[scene, method]:
            return None
        mean, deviation = compute_mean_and_deviation(values[scene, method])
        spread = deviation if np.isfinite(deviation) else 0.0
        return mean - spread, mean, mean + spread

    over = "trials in which all methods succeed" if shared else "all trials"
    quantity = label.partition(" [")[0].capitalize()
    title = f"{quantity}: mean and standard deviation over {over}"
    figure = _draw_groups(names, methods, measure, label=label, form=".3g", title=title)
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
    common = find_common_successes(records, methods)
    where = "own successes;\nnowhere all succeed"
    if common:
        where = f"the\n{_count_trials(len(common))} where all succeed"
    shared = f"median and quartiles over {where}"
    panels = (
        ("success", "success [%]", "all trials,\n95 % confidence (Wilson)", ".0f"),
        ("base_path_length", "base path length [m]", shared, ".2f"),
        ("arm_path_length", "arm path length [rad]", shared, ".2f"),
        ("planning_time", "planning time [s]", "median and quartiles\nover all trials", ".2f"),
    )
    with use_style():
        figure = new_figure(11.0, 3.4)
        all_axes = figure.subplots(1, len(panels))
        for axes, (field, name, about, form) in zip(all_axes, panels, strict=True):
            for k, method in enumerate(methods):
                if field in ("base_path_length", "arm_path_length"):
                    own = _select_successes(records, common, k, method)
                else:
                    own = select(records, method=method)
                values = numbers(own, field)
                if not values:
                    continue
                if field == "success":
                    interval = _compute_rate([value > 0.0 for value in values])
                else:
                    interval = compute_quartiles(values)
                colour = COLOURS[k % len(COLOURS)]
                _draw_bar(axes, k, interval, colour, f"{interval[1]:{form}}", width=0.7)
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
            _draw_motion(position, velocity, base, name, plan)
        successes = [plan.trajectory for plan in plans.values() if plan.success]
        if successes and len(successes) < len(plans):
            arm_speeds = [_find_max_speed(motion, 3, motion.robot_size) for motion in successes]
            base_speeds = [_find_max_speed(motion, 0, 3) for motion in successes]
            _, arm_axes, base_axes = columns[0]
            arm_axes.set_ylim(-_SCALE * max(arm_speeds), _SCALE * max(arm_speeds))
            base_axes.set_ylim(-_SCALE * max(base_speeds), _SCALE * max(base_speeds))
        labels = ("arm positions [rad]", "arm velocities [rad/s]", "base velocity")
        for axes, label in zip(columns[0], labels, strict=True):
            axes.set_ylabel(label)
        for axes in columns[-1][[0, 2]]:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7.5)
        figure.suptitle(title, fontsize=10.5)
        return save_figure(figure, path)


def _draw_motion(position: Axes, velocity: Axes, base: Axes, name: str, plan: Plan) -> None:
    """Draw arm positions, arm velocities and base velocities of a plan over time."""
    motion = plan.trajectory
    begin, end = motion.times[[0, -1]]
    times = np.unique(np.concatenate([np.linspace(begin, end, _SAMPLES), motion.times]))
    positions = motion(times)
    velocities = motion.velocity(times)
    style: Any = {
        "linewidth": 1.2,
        "drawstyle": "steps-post" if motion.curve is None else "default",
    }
    for k, joint in enumerate(range(3, motion.robot_size)):
        colour = COLOURS[k % len(COLOURS)]
        label = motion.names[joint].removesuffix("_joint")
        position.plot(times, positions[:, joint], color=colour, label=label)
        velocity.plot(times, velocities[:, joint], color=colour, **style)
    for k, label in enumerate(_BASE):
        base.plot(times, velocities[:, k], color=COLOURS[k], label=label, **style)
    for axes in (position, velocity, base):
        shade_phases(axes, motion)
        axes.margins(x=0.0)
    outcome = "" if plan.success else f", FAILED: {plan.status}"
    position.set_title(f"{name}{outcome} ({end - begin:.1f} s)", fontsize=9.5)
    base.set_xlabel("time [s]")


def _find_max_speed(motion: Trajectory, first: int, last: int) -> float:
    """Return the largest speed at waypoints among the coordinates from `first` to `last` - 1."""
    return float(np.abs(motion.velocity(motion.times)[:, first:last]).max())


def _select_successes(
    records: Sequence[Record],
    common: Sequence[tuple[Record, ...]],
    k: int,
    method: str,
) -> list[Record]:
    """Return the records of method k where all methods succeed, or else its own successes."""
    if common:
        return [row[k] for row in common]
    own = select(records, method=method)
    return [record for record in own if record["success"]]


def _count_trials(count: int) -> str:
    return "1 trial" if count == 1 else f"{count} trials"


def _draw_groups(
    scenes: Mapping[str, str],
    methods: Sequence[str],
    measure: Callable[[str, str], tuple[float, float, float] | None],
    *,
    label: str,
    form: str,
    title: str,
) -> Figure:
    """Draw grouped bars; `measure` returns lower end, height and upper end, or None."""
    with use_style():
        figure_width = max(6.0, 1.0 + 0.5 * len(scenes) * (len(methods) + 1))
        figure = new_figure(figure_width, 3.8)
        axes = figure.subplots()
        width = _WIDTH / len(methods)
        for k, method in enumerate(methods):
            shift = (k - (len(methods) - 1) / 2.0) * width
            places = np.arange(len(scenes)) + shift
            colour = COLOURS[k % len(COLOURS)]
            for place, scene in zip(places, scenes, strict=True):
                interval = measure(scene, method)
                if interval is not None:
                    text = f"{interval[1]:{form}}"
                    _draw_bar(axes, place, interval, colour, text, width=0.9 * width)
            axes.bar(0.0, 0.0, color=colour, label=method)
        _name_bars(axes, list(scenes.values()), 0.5)
        axes.set_ylabel(label)
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside lower center", ncols=len(methods))
    return figure


def _compute_rate(successes: Sequence[bool]) -> tuple[float, float, float]:
    """Return Wilson's lower limit, success rate and upper limit [%]."""
    low, high = compute_wilson_interval(sum(successes), len(successes))
    return 100.0 * low, 100.0 * sum(successes) / len(successes), 100.0 * high


def _draw_bar(
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


def _describe_number(records: Sequence[Record], scene: str, methods: Sequence[str]) -> str:
    """Return the number of trials of each method in a scene, in words."""
    own = select(records, scene=scene)
    counts = Counter(record["method"] for record in own if record["method"] in methods)
    if not counts:
        return "no trials"
    different = sorted(set(counts.values()))
    return f"{' or '.join(str(count) for count in different)} trials each"
