"""How often plans do in physics what they say, and how exactly, at the experiments' tasks from random starts."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS, allowed
from vkc_pin.benchmarks.harness.record import Record, trial, values
from vkc_pin.benchmarks.harness.tables import foot, markdown, wilson
from vkc_pin.benchmarks.problems.problem_set import TASKS as ALL
from vkc_pin.benchmarks.problems.problem_set import started
from vkc_pin.errors import InputError
from vkc_pin.planning.planner import plan
from vkc_pin.simulation.execution import GRASPS, simulate
from vkc_pin.simulation.physics import Physics, import_mujoco
from vkc_pin.simulation.result import SimulationResult
from vkc_pin.utils.arguments import check_choice

__all__ = ["TASKS", "report", "run"]

TASKS: Mapping[str, str] = {
    "door": "push a door with a latched lever",
    "corridor_door": "the same in a corridor",
    "drawer": "pull a drawer",
    "household_refrigerator": "pull a refrigerator open",
    "household_dishwasher": "pull a dishwasher's rack out",
    "household_cabinet": "pull a cabinet open",
    "household_cup": "carry a cup to a table",
    "init_1": "touch a cube with a stick",
}
"""What is done: name among the experiments' tasks → in words."""
_HEAD = [
    "task",
    "plans",
    "executed",
    "of plans [%]",
    "arm [°]",
    "base [mm]",
    "goal [mm]",
    "goal [rad]",
    "grasp [N]",
    "grasp [N·m]",
    "slip [mm]",
]


def run(
    *,
    out: str | Path,
    trials: int = 10,
    seed: int = 0,
    jobs: int = 1,
    scheduler: str | None = None,
    tasks: Sequence[str] = tuple(TASKS),
    grasp: str = "weld",
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv and table.md to `out`.

    Args:
        out: The folder; if it has trials of the same settings already, they are not run again.
        trials: Number of random starts per task, at least 1.
        seed: Of the starts and of planning.
        jobs: Number of processes.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        tasks: Some of `TASKS`.
        grasp: What holds, see `simulate`.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}; see `runner.run`.

    Raises:
        UnknownNameError: There is no such task or grasp.
        InputError: No trials or tasks, MuJoCo is not installed, or `out` has trials of other
            settings.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    import_mujoco()
    if trials < 1:
        raise InputError("out of range", field="trials", expected="at least 1", got=trials)
    names = runner.chosen("task", tasks, TASKS)
    settings = {
        "benchmark": "execution",
        "seed": seed,
        "starts": trials,
        "tasks": names,
        "mujoco": version("mujoco"),
        **LIMITS,
    }
    settings |= {"physics": vars(Physics()), "grasp": check_choice(grasp, GRASPS, "grasp")}
    specs = [
        {
            "key": f"{list(TASKS).index(name):02d}/{number:04d}",
            "task": name,
            "number": number,
            "seed": seed,
            "grasp": grasp,
        }
        for name in names
        for number in range(trials)
    ]
    return runner.run(
        specs,
        _record,
        out,
        settings=settings,
        report=report,
        jobs=jobs,
        scheduler=scheduler,
        progress=progress,
    )


def report(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown, with versions and machine at the foot."""
    about, records = result["meta"], result["trials"]
    rows = [
        _row(name, [record for record in records if record.get("task") == name])
        for name in about["tasks"]
    ]
    rows += [_row("all", records)] if len(rows) > 1 else []
    problems = Counter(
        f"{r.get('task')}: {text}" for r in records for text in r.get("problems", ())
    )
    parts = [
        "# Plans in physics" + (", held by friction" if about.get("grasp") == "friction" else ""),
        f"{about['starts']} random starts per task, seed {about['seed']}, {allowed(about)} each. Plans are counted by the "
        "independent validation, and executed if they end within 10 mm and 0.02 rad of the goal, nothing is pulled out of the "
        "hand, and nothing is touched by more than 1 mm that the plan does not touch; beside it Wilson's interval of 95 %. "
        "Errors of arm and base, misses of goals, forces, torques and slips are the largest of any moment of any trial.",
        markdown(_HEAD, rows),
        "## What went wrong",
        "\n".join(
            f"- {text}" + (f" ({count} times)" if count > 1 else "")
            for text, count in problems.items()
        )
        or "Nothing.",
    ]
    return "\n\n".join([*parts, foot(about)]) + "\n"


def _row(name: str, records: Sequence[Record]) -> list[str]:
    planned = [record for record in records if record.get("success")]
    good = sum(bool(record.get("executed")) for record in planned)
    low, high = wilson(good, len(planned))
    interval = f"{100.0 * low:.0f}–{100.0 * high:.0f}" if planned else "–"
    own = [
        _largest(planned, "arm_error", 180.0 / np.pi, 2),
        _largest(planned, "base_error", 1e3, 1),
        _largest(planned, "miss_m", 1e3, 1),
        _largest(planned, "miss_rad", 1.0, 4),
        _largest(planned, "grasp_force", 1.0, 0),
        _largest(planned, "grasp_torque", 1.0, 1),
        _largest(planned, "slip", 1e3, 1),
    ]
    return [name, f"{len(planned)} of {len(records)}", f"{good} of {len(planned)}", interval, *own]


def _largest(records: Iterable[Record], field: str, factor: float, digits: int) -> str:
    found = values(records, field)
    return f"{factor * max(found):.{digits}f}" if found else "–"


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    scene, steps = started(spec["task"], spec["seed"], spec["number"]), ALL[spec["task"]].steps
    found = plan(scene, steps, seed=spec["seed"], **LIMITS)
    more: dict[str, Any] = {"task": spec["task"], "number": spec["number"], "executed": False}
    if found.success:
        begin = time.perf_counter()
        executed = simulate(found.scene, found.steps, found.trajectory, grasp=spec["grasp"])
        more |= {"simulation_time": time.perf_counter() - begin, **_figures(executed)}
    return trial(found, method="VKC", seed=spec["seed"], duration=found.metrics["duration"], **more)


def _figures(result: SimulationResult) -> dict[str, Any]:
    """Return what is kept of an execution."""
    missed = {
        unit: max((m.amount for m in result.misses if m.unit == unit), default=None)
        for unit in ("m", "rad")
    }
    return {
        "executed": result.ok,
        "problems": result.problems(),
        "arm_error": result.tracking.arm[0],
        "arm_error_rms": result.tracking.arm[1],
        "base_error": result.tracking.base[0],
        "base_error_rms": result.tracking.base[1],
        "heading_error": result.tracking.heading[0],
        "miss_m": missed["m"],
        "miss_rad": missed["rad"],
        "grasp_force": max((grip.force for grip in result.grips), default=None),
        "grasp_torque": max((grip.torque for grip in result.grips), default=None),
        "slip": max((grip.slip for grip in result.grips), default=0.0) or None,
        "effort_share": max(result.tracking.shares.values(), default=None),
        "contacts": [str(contact) for contact in result.contacts],
    }
