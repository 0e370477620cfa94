"""Plans tasks at a door from random starts: reach, push and both together.

Pushing starts from a given grasp, either as reached by the plan of the whole task ("push") or by
a plan that only grasps the turned lever ("push blind").
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from tqdm import tqdm

from vkc_pin.experiments.harness.record import (
    Record,
    describe_environment,
    distribution,
    trial,
)
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.prepare import plan
from vkc_pin.utils.system import measure_peak_memory
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, Grasp, Reach

TASKS = ("reach", "whole", "push", "push blind")
GOAL = {"hinge": 1.2}
# [rad] of the knob where the grasp is given
TURNED = 0.55


def reach(scene: Scene, seed: int) -> Plan:
    """Bring the tool to the door's handle in 40 waypoints."""
    placed = scene.objects["door"]
    attachment = placed.object.attachment()
    pose = placed.link_placement(attachment.link) * attachment.placement
    return plan(scene, [Reach(pin.SE3(pose))], options=Options(reach_waypoints=40), seed=seed)


def push(scene: Scene, seed: int, before: Plan) -> Plan:
    """Push the door in 40 waypoints, from the configuration in which `before` begins to push."""
    last = before.trajectory.phases[-1]
    row = last.first if last.held else last.last
    robot = before.trajectory.positions[row, : before.trajectory.robot_size]
    turned = scene.with_state("door", {"knob": before.trajectory.column("door.knob")[row]})
    held = turned.with_start(base=robot[:3], arm=robot[3:]).with_held({"door": "handle"})
    return plan(held, [Actuate("door", GOAL)], options=Options(move_waypoints=40), seed=seed)


def whole(scene: Scene, seed: int) -> Plan:
    """Approach, turn the knob and push, as one problem."""
    return plan(scene, [Actuate("door", GOAL)], seed=seed)


def run(*, trials: int, seed: int, progress: bool = True) -> dict[str, Any]:
    """Run every task from the same random starts.

    Args:
        trials: Number of starts.
        seed: Random seed of starts and planning.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}; planning times exclude building symbolic programs.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    rng = np.random.default_rng(seed)
    scene = load_scene("door")
    starts = [scene.sample_start(rng) for _ in range(trials)]
    records: list[dict[str, Any]] = []
    for number, start in enumerate(tqdm(starts, desc="door", unit="start", disable=not progress)):
        for task, result in _plan_tasks(start, seed):
            if result.status == "interrupted":
                raise KeyboardInterrupt
            records.append(trial(result, method="VKC", seed=seed, task=task, number=number))
    about = describe_environment(
        benchmark="door", seed=seed, trials=trials, peak_memory_mb=measure_peak_memory()
    )
    return {"meta": about, "trials": records}


def _plan_tasks(start: Scene, seed: int) -> Iterator[tuple[str, Plan]]:
    """Yield every task and its plan from a start."""
    yield "reach", reach(start, seed)
    whole_plan = whole(start, seed)
    yield "whole", whole_plan
    # Where there is no grasp to push from, that plan's failure is the trial's.
    yield "push", push(start, seed, whole_plan) if whole_plan.success else whole_plan
    turned = start.with_state("door", {"knob": TURNED})
    grasp = plan(turned, [Grasp("door")], seed=seed)
    yield "push blind", push(start, seed, grasp) if grasp.success else grasp


def table(result: dict[str, Any]) -> str:
    """Return success rates, times and path lengths as text, and every failure."""
    names = "".join(f"{name:>8}" for name in ("p95", *_TIMES.values()))
    head = f"{'task':12}{'success':>10}{'time [s] median':>18}{names}"
    lines = [f"{head}{'iter.':>7}{'base [m]':>10}{'arm [rad]':>11}{'build [s]':>11}"]
    for task in TASKS:
        records = [record for record in result["trials"] if record["task"] == task]
        if records:
            lines.append(_format_row(task, records))
    lines.append(f"peak memory {result['meta']['peak_memory_mb']:.0f} MB")
    for record in result["trials"]:
        if not record["success"]:
            reason = "; ".join(record["violations"]) or "no violation"
            where = f"start {record['number']}, {record['task']}"
            lines.append(f"{where}: {record['status']}; {reason}")
    return "\n".join(lines)


# Parts of planning time: field → name.
_TIMES = {
    "time_initialization": "guesses",
    "time_coal": "coal",
    "time_casadi": "CasADi",
    "time_ipopt": "Ipopt",
    "time_validation": "check",
}


def _format_row(task: str, records: Sequence[Record]) -> str:
    """Return the row of a task in the table."""
    success = f"{sum(record['success'] for record in records)}/{len(records)}"
    median, late = distribution(records, "planning_time")
    seconds = [late]
    for field in _TIMES:
        seconds.append(distribution(records, field)[0])
    times = "".join(f"{value:>8.3f}" for value in seconds)
    iterations, _ = distribution(records, "iterations")
    base, _ = distribution(records, "base_path_length")
    arm, _ = distribution(records, "arm_path_length")
    build = max(record["build_time"] for record in records)
    return (
        f"{task:12}{success:>10}{median:>18.3f}{times}"
        f"{iterations:>7.0f}{base:>10.2f}{arm:>11.2f}{build:>11.2f}"
    )
