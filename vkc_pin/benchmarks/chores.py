"""Chores of many steps, each planned in one call from random starts: eighteen in a home, also cluttered, and ten in an arena."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS
from vkc_pin.benchmarks.harness.record import Solve, distribution, trial
from vkc_pin.benchmarks.harness.tables import decimal, failures, foot, markdown
from vkc_pin.options import Options
from vkc_pin.planning.chore import plan_chore
from vkc_pin.planning.plan import Plan
from vkc_pin.scene.rooms.clutter import cluttered
from vkc_pin.scene.scene import Scene, load_scene
from vkc_pin.task.steps import Actuate, Grasp, Place, Step

__all__ = ["CHORES", "Chore", "cluttered_home", "fetch", "home", "plan_trial", "report", "run"]

WINDOW = 2
THINGS = 300  # in the cluttered home
_AROUND = 0.2  # [m] around what the chore is about that stays free there
_LIMITS = {**LIMITS, "effort": 4 * LIMITS["effort"]}  # eighteen steps take half a million units and more

BAR_TABLE = (-3.0, 1.3, 1.051)  # [m], where the cup stands in between
DESK = (1.75, 3.5, 0.741)
CLEAR = (1.1, -2.9, 0.036)  # floor before the television
BIN = (3.0, -3.6, 0.16)  # within its walls; what is let go of there falls
BEFORE_TABLE = (-0.9, 2.2, 0.036)  # floor before the low table
SHELF = (-4.61, -1.0, 0.846)


def home(scene: Scene) -> list[Step]:
    """Return the eighteen steps of the scene `household`: a cup to the desk in the other room, and litter to the bin."""
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
        Place("litter", BIN),
    ]


def fetch(scene: Scene) -> list[Step]:
    """Return the ten steps of the scene `fetch`: a ball from under a table, with a stick, into a cabinet."""
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


@functools.cache
def cluttered_home() -> Scene:
    """Return the scene `household` as full as homes are: with 300 things more there are 553 convex shapes."""
    places = (BAR_TABLE, DESK, CLEAR, BIN)
    return cluttered(load_scene("household"), THINGS, clear=[(place, _AROUND) for place in places])


@dataclass(frozen=True)
class Chore:
    """A chore.

    Attributes:
        scene: Returns where it is done.
        steps: Returns what is to be done in that scene.
        options: How it is planned.
    """

    scene: Callable[[], Scene]
    steps: Callable[[Scene], list[Step]]
    options: Options = field(default_factory=Options)

    def planned(self) -> list[Step]:
        """Return its steps."""
        return self.steps(self.scene())


CHORES = {
    "home": Chore(functools.partial(load_scene, "household"), home),
    "fetch": Chore(functools.partial(load_scene, "fetch"), fetch),
    "cluttered": Chore(cluttered_home, home, Options(dist_safe=0.005)),
}
"""By name."""


def plan_trial(scene: Scene, spec: Mapping[str, Any]) -> Plan:
    """Plan the chore of one trial."""
    chore = CHORES[spec["chore"]]
    return plan_chore(scene, chore.steps(scene), window=WINDOW, options=chore.options, seed=spec["seed"], **_LIMITS)


def run(
    *,
    trials: int,
    seed: int,
    out: str | Path,
    jobs: int = 1,
    chores: Sequence[str] = tuple(CHORES),
    progress: bool = True,
    solve: Solve = plan_trial,
) -> dict[str, Any]:
    """Run the benchmark, or what is left of it, and write results.json, results.csv and table.md to `out`.

    Args:
        trials: Number of random starts per chore; the first is the scene's own start.
        seed: Of the starts and of planning.
        out: The folder; if it has trials of the same settings already, they are not run again.
        jobs: Number of processes.
        chores: Some of `CHORES`.
        progress: Whether to show a progress bar.
        solve: What plans a trial.

    Returns:
        {"meta": ..., "trials": [...]}; see `runner.run`.

    Raises:
        UnknownNameError: There is no such chore.
        InputError: No chores, or `out` has trials of other settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    chores = runner.chosen("chore", chores, CHORES)
    specs = []
    for chore in chores:
        scene = CHORES[chore].scene()
        rng = np.random.default_rng([seed, list(CHORES).index(chore)])
        for number in range(trials):
            base = (scene.sample_start(rng) if number else scene).start[:3].tolist()
            specs.append({"key": f"{chore}/{number:04d}", "chore": chore, "number": number, "base": base, "seed": seed})
    settings = {"benchmark": "chores", "seed": seed, "starts": trials, "chores": chores}
    settings |= {"window": WINDOW, **_LIMITS, "steps": {name: list(map(str, CHORES[name].planned())) for name in chores}}
    settings |= {"dist_safe": {name: CHORES[name].options.dist_safe for name in chores}}
    return runner.run(
        specs, functools.partial(_record, solve=solve), out, settings=settings, report=report, jobs=jobs, progress=progress
    )


def report(result: Mapping[str, Any]) -> str:
    """Return the table of a result in Markdown, with versions and machine at the foot."""
    about, rows = result["meta"], []
    for chore in about["chores"]:
        own = [record for record in result["trials"] if record["scene"] == chore]
        good = [record for record in own if record["success"]]
        planning, late = distribution(own, "planning_time")
        wall, _ = distribution(own, "wall_time")
        efforts = (decimal(distribution(good, field)[0]) for field in ("base_effort", "arm_effort", "duration"))
        number = str(len(about["steps"][chore]))
        times = (decimal(value) for value in (wall, planning, late))
        rows.append([chore, number, f"{len(good)} of {len(own)}", *times, *efforts, failures(own)])
    head = ["chore", "steps", "success", "in all, median [s]", "planning, median [s]", "95th percentile [s]"]
    head += ["base [m]", "arm [rad]", "duration [s]", "failures"]
    every = [
        [record["scene"], str(record["number"]), record["status"]]
        + [decimal(record.get(field) or float("nan")) for field in ("wall_time", "planning_time", "base_effort", "arm_effort")]
        for record in result["trials"]
    ]
    parts = [
        "# Chores",
        f"Each chore in one call, from {about['starts']} starts, the first of them the scene's own; seed {about['seed']}, a "
        f"window of {about['window']} actions. Success is the word of the independent validation of the whole motion. The time "
        "in all is that of planning and of building symbolic programs; efforts and durations are medians of successes.",
        markdown(head, rows),
        "## Every trial",
        markdown(["chore", "start", "status", "in all [s]", "planning [s]", "base [m]", "arm [rad]"], every, text=3),
        foot(about),
    ]
    return "\n\n".join(parts) + "\n"


def _record(spec: dict[str, Any], solve: Solve) -> dict[str, Any]:
    scene = CHORES[spec["chore"]].scene().with_start(base=spec["base"])
    began = time.perf_counter()
    plan = solve(scene, spec)
    spent = time.perf_counter() - began
    own = {"number": spec["number"], "wall_time": spent, "duration": plan.trajectory.metrics()["duration"]}
    return {**trial(plan, method="VKC", seed=spec["seed"], **own), "scene": spec["chore"]}
