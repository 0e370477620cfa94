"""Plans chores of many steps in one call, or step by step."""

from __future__ import annotations

import functools
import itertools
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness import step_by_step as stepwise
from vkc_pin.experiments.harness.record import Record, Solve, distribution, trial, values
from vkc_pin.experiments.harness.runner import LIMITS, Execution
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    count,
    count_failures,
    format_decimal,
    format_medians,
    format_table,
    join_sections,
    select,
)
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.prepare import plan
from vkc_pin.procedural.rooms.clutter import add_clutter
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, Grasp, Place, Step

WINDOW = 2
ONE_CALL = "VKC"
STEP_BY_STEP = "step by step"
# objects in the cluttered home
THINGS = 300
# [m] around the task's objects that stays free of clutter
_AROUND = 0.2
# Eighteen steps take half a million evaluations and more.
_LIMITS = {**LIMITS, "max_evaluations": 4 * LIMITS["max_evaluations"]}

_METHODS = {ONE_CALL: "in one call", STEP_BY_STEP: "step by step"}
_SEEDS_ABOUT = (
    "Spread is the largest value of the successes over the least, minus 1; ± is half their range "
    "over its middle. Step by step, "
    "each begins where the motion of the one before ends, and nothing comes after the first that "
    "fails."
)

# Positions of placed objects in the world frame [m].
# where the cup stands in between
BAR_TABLE = (-3.0, 1.3, 1.051)
DESK = (1.75, 3.5, 0.741)
# floor before the television
CLEAR = (1.1, -2.9, 0.036)
# within its walls; released objects would fall
BIN = (3.0, -3.6, 0.16)
# floor before the low table
BEFORE_TABLE = (-0.9, 2.2, 0.036)
SHELF = (-4.61, -1.0, 0.846)


def home(scene: Scene) -> list[Step]:
    """Return the 18 steps of the scene `household`: a cup to the desk, and litter to the bin."""
    return [
        Grasp("refrigerator"),
        Actuate("refrigerator", {"hinge": 1.57}),
        Grasp("cold_cup"),
        Place("cold_cup", BAR_TABLE),
        Grasp("refrigerator"),
        Actuate("refrigerator", {"hinge": 0.0}),
        Grasp("door", "handle_free"),
        Actuate("door", {"hinge": 1.52}),
        Grasp("cold_cup"),
        Place("cold_cup", DESK),
        Grasp("door", "handle_free"),
        Actuate("door", {"hinge": 0.0}),
        Grasp("broom"),
        Grasp("litter", "pull", by="broom.bristles"),
        Place("litter", CLEAR),
        Place("broom", scene.objects["broom"].placement.translation),
        Grasp("litter", "grip"),
        Place("litter", BIN, unsupported=True),
    ]


def fetch(scene: Scene) -> list[Step]:
    """Return the 10 steps of the scene `fetch`: a ball from under a table into a cabinet."""
    return [
        Grasp("stick"),
        Grasp("ball", "pull", by="stick.tip"),
        Place("ball", BEFORE_TABLE),
        Place("stick", scene.objects["stick"].placement.translation),
        Grasp("cabinet"),
        Actuate("cabinet", {"hinge": 1.57}),
        Grasp("ball", "grip"),
        Place("ball", SHELF),
        Grasp("cabinet"),
        Actuate("cabinet", {"hinge": 0.0}),
    ]


def _make_box(name: str, *sides: tuple[float, float], colour: str = "white") -> dict[str, Any]:
    """Return a box obstacle, given by its range along x, y and z [m]."""
    size = [round(high - low, 4) for low, high in sides]
    middle = [round((low + high) / 2.0, 5) for low, high in sides]
    return {"name": name, "type": "box", "size": size, "position": middle, "colour": colour}


TIGHT: tuple[dict[str, Any], ...] = (
    # The narrow door's leaf stands 50 mm in the wall above it, and 20 mm in that beside its hinge,
    # wherever it is.
    _make_box("casing_above", (1.105, 2.01), (1.2, 1.3), (1.945, 2.07), colour="wall"),
    _make_box("casing_beside", (1.105, 1.22), (1.2, 1.3), (0.0, 2.07), colour="wall"),
    # The refrigerator's door touches the panel on its hinge's side, and is 9 mm from that beside
    # the kitchen.
    _make_box("panel_east", (-1.255, -1.235), (3.354, 4.0), (0.0, 2.1)),
    _make_box("panel_west", (-1.889, -1.859), (3.3, 4.0), (0.0, 2.1)),
    # 10 mm from the narrow door's levers: a bag that hangs from its frame, and a wardrobe, once the
    # door is open as far as asked.
    _make_box("bag", (1.875, 1.985), (1.11, 1.19), (0.8, 1.04), colour="teal"),
    _make_box("wardrobe", (0.2, 1.099), (1.3, 1.9), (0.0, 2.0), colour="oak"),
    # 10 mm from carried objects: a bottle behind the cup in the refrigerator, a mop between broom
    # and wall.
    {
        "name": "bottle",
        "type": "cylinder",
        "radius": 0.035,
        "length": 0.25,
        "position": [-1.55, 3.64, 1.105],
        "colour": "green",
    },
    {
        "name": "mop",
        "type": "cylinder",
        "radius": 0.0125,
        "length": 1.0,
        "position": [2.4, -3.935, 0.62],
        "colour": "blue",
    },
)
"""Obstacles that make the home as narrow as real ones."""


@functools.cache
def make_cluttered_home() -> Scene:
    """Return the scene `household` with `TIGHT` and 300 more objects: 561 convex shapes."""
    home = load_scene("household")
    document = home.document
    document["obstacles"] = [*document["obstacles"], *TIGHT]
    clear = [(place, _AROUND) for place in (BAR_TABLE, DESK, CLEAR, BIN)]
    # Leaves overlap their walls, which is meant.
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        tight = Scene.from_document(document, home.folder)
        return add_clutter(tight, THINGS, clear=clear)


@dataclass(frozen=True)
class Chore:
    """A chore: its scene, steps and options."""

    scene: Callable[[], Scene]
    steps: Callable[[Scene], list[Step]]
    options: Options = field(default_factory=Options)

    def list_steps(self) -> list[Step]:
        """Return the steps."""
        return self.steps(self.scene())


CHORES = {
    "home": Chore(functools.partial(load_scene, "household"), home),
    "fetch": Chore(functools.partial(load_scene, "fetch"), fetch),
    "cluttered": Chore(make_cluttered_home, home, Options(dist_safe=0.005)),
}
"""By name."""


def plan_trial(scene: Scene, spec: Mapping[str, Any]) -> Plan:
    """Plan the chore of one trial."""
    chore = CHORES[spec["scene"]]
    return plan(
        scene,
        chore.steps(scene),
        window=WINDOW,
        options=chore.options,
        seed=spec["seed"],
        **_LIMITS,
    )


def run(
    *,
    trials: int,
    seed: int,
    out: str | Path,
    chores: Sequence[str] = tuple(CHORES),
    seeds: int = 1,
    step_by_step: bool = False,
    solve: Solve = plan_trial,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        trials: Number of starts per chore; the first is that of the scene, the others are random.
        seed: Random seed of starts, and the first one of planning.
        chores: Some of `CHORES`.
        seeds: Number of planning seeds per start.
        step_by_step: Whether to plan the steps one by one as well.
        solve: Plans a trial in one call.
    """
    chores = runner.select_names("chore", chores, CHORES)
    methods = (ONE_CALL, STEP_BY_STEP) if step_by_step else (ONE_CALL,)
    specs: list[dict[str, Any]] = []
    for chore in chores:
        scene = CHORES[chore].scene()
        rng = np.random.default_rng([seed, list(CHORES).index(chore)])
        for number in range(trials):
            start = scene.sample_start(rng) if number else scene
            for planning_seed, method in itertools.product(range(seed, seed + seeds), methods):
                specs.append(
                    {
                        "key": f"{chore}/{number:04d}/{planning_seed:04d}/{method}",
                        "scene": chore,
                        "number": number,
                        "base": start.start[:3].tolist(),
                        "seed": planning_seed,
                        "method": method,
                    }
                )
    steps: dict[str, list[str]] = {}
    for name in chores:
        steps[name] = [str(step) for step in CHORES[name].list_steps()]
    settings = {
        "benchmark": "chores",
        "seed": seed,
        "starts": trials,
        "seeds": seeds,
        "methods": methods,
        "chores": chores,
        "window": WINDOW,
        **_LIMITS,
        "steps": steps,
        "dist_safe": {name: CHORES[name].options.dist_safe for name in chores},
    }
    return runner.run(
        specs,
        functools.partial(_record, solve=solve),
        out,
        settings=settings,
        format_results=format_results,
        **execution,
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    seeds = about.get("seeds", 1)
    methods = about.get("methods", [ONE_CALL])
    parts = [
        "# Chores",
        f"Each chore in one call, from {about['starts']} starts, the first of them the scene's "
        f"own, with {seeds} seeds each from {about['seed']} on; a window of {about['window']} "
        f"actions. {JUDGED} The time in all includes building symbolic programs; path lengths "
        "and durations are medians of successes.",
        _tabulate_chores(result),
    ]
    if seeds > 1 or len(methods) > 1:
        parts += ["## Seeds", _SEEDS_ABOUT, _tabulate_seeds(result)]
    parts += ["## Every trial", _tabulate_trials(result)]
    return join_sections(about, *parts)


def _tabulate_chores(result: Mapping[str, Any]) -> str:
    """Tabulate the trials in one call by chore."""
    rows: list[list[str]] = []
    for chore in result["meta"]["chores"]:
        own = select(result["trials"], scene=chore, method=ONE_CALL)
        successes = select(own, success=True)
        steps = str(len(result["meta"]["steps"][chore]))
        times = format_medians(own, "wall_time", "planning_time")
        late = format_decimal(distribution(own, "planning_time")[1])
        lengths = format_medians(successes, "base_path_length", "arm_path_length", "duration")
        rows.append([chore, steps, count(own), *times, late, *lengths, count_failures(own)])
    head = ["chore", "steps", "success"]
    head += ["in all, median [s]", "planning, median [s]", "95th percentile [s]"]
    head += ["base [m]", "arm [rad]", "duration [s]", "failures"]
    return format_table(head, rows)


def _tabulate_trials(result: Mapping[str, Any]) -> str:
    """Tabulate every trial."""
    rows: list[list[str]] = []
    for record in result["trials"]:
        row = [record["scene"], str(record["number"]), str(record["seed"])]
        row += [_METHODS[record["method"]], record["status"]]
        for name in ("wall_time", "planning_time", "base_path_length", "arm_path_length"):
            row.append(format_decimal(record.get(name) or float("nan")))
        rows.append(row)
    head = ["chore", "start", "seed", "planned", "status", "in all [s]", "planning [s]"]
    head += ["base [m]", "arm [rad]"]
    return format_table(head, rows, text=5)


def _tabulate_seeds(result: Mapping[str, Any]) -> str:
    """Tabulate the dependence on the planning seed by chore, start and method."""
    groups: dict[tuple[str, int, str], list[Record]] = {}
    for record in result["trials"]:
        group = (record["scene"], record["number"], record["method"])
        groups.setdefault(group, []).append(record)
    rows: list[list[str]] = []
    for (chore, number, method), own in groups.items():
        row = [chore, str(number), _METHODS[method], count(own)]
        steps = len(result["meta"]["steps"][chore])
        done = ["all" if n == steps else f"{n:.0f}" for n in values(own, "steps_done")]
        row.append(", ".join(done) or "–")
        times = values(own, "cpu_time")
        if times:
            row += [format_decimal(float(np.median(times))), format_decimal(max(times))]
        else:
            row += ["–", "–"]
        successes = select(own, success=True)
        for length in ("base_path_length", "arm_path_length"):
            lengths = values(successes, length)
            row += _format_spread(min(lengths), max(lengths)) if lengths else ["–", "–", "–"]
        rows.append(row)
    head = ["chore", "start", "planned", "success", "steps done", "CPU, median [s]", "most [s]"]
    head += ["base [m]", "spread [%]", "±[%]", "arm [rad]", "spread [%]", "±[%]"]
    return format_table(head, rows, text=3)


def _format_spread(low: float, high: float) -> list[str]:
    """Return a range, its spread over the lower end, and half of it over the middle [%]."""
    span = f"{low:.1f}–{high:.1f}"
    if not low > 0.0:
        return [span, "–", "–"]
    spread = high / low - 1.0
    half = (high - low) / (high + low)
    return [span, f"{100.0 * spread:.0f}", f"{100.0 * half:.0f}"]


def _record(spec: dict[str, Any], solve: Solve) -> dict[str, Any]:
    """Plan a trial and return its record."""
    chore = CHORES[spec["scene"]]
    scene = chore.scene().with_start(base=spec["base"])
    steps = chore.steps(scene)
    about = {"method": spec["method"], "seed": spec["seed"]}
    fields: dict[str, Any] = {"number": spec["number"]}
    began = time.perf_counter()
    cpu_began = time.process_time()
    if spec["method"] == STEP_BY_STEP:
        plans = stepwise.plan_step_by_step(scene, steps, options=chore.options, seed=spec["seed"])
        fields["wall_time"] = time.perf_counter() - began
        fields["cpu_time"] = time.process_time() - cpu_began
        record = stepwise.combine_records(plans, len(steps), **about, **fields)
    else:
        plan = solve(scene, spec)
        fields["wall_time"] = time.perf_counter() - began
        fields["cpu_time"] = time.process_time() - cpu_began
        fields["duration"] = plan.trajectory.metrics()["duration"]
        fields["steps_done"] = len(steps) if plan.success else None
        record = trial(plan, **about, **fields)
    record["scene"] = spec["scene"]
    return record
