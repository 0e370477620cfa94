"""Plans tasks at a door from random starts: reach, push and both together.

Pushing starts from a given grasp, either as reached by the plan of the whole task ("push") or by
a plan that only grasps the turned lever ("push blind").
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from tqdm import tqdm

from vkc_pin.experiments.harness.record import (
    describe_environment,
    distribution,
    trial,
)
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import plan
from vkc_pin.utils.system import measure_peak_memory
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, Grasp, Reach

TASKS = ("reach", "whole", "push", "push blind")
GOAL = {"hinge": 1.2}
TURNED = 0.55  # [rad] of the knob where the grasp is given


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
    records = []
    for number, start in enumerate(tqdm(starts, desc="door", unit="start", disable=not progress)):

        def record(task: str, result: Plan, number: int = number) -> Plan:
            if result.status == "interrupted":
                raise KeyboardInterrupt
            records.append(trial(result, method="VKC", seed=seed, task=task, number=number))
            return result

        record("reach", reach(start, seed))
        whole_plan = record("whole", whole(start, seed))
        # Where there is no grasp to push from, that plan's failure is the trial's.
        record("push", push(start, seed, whole_plan) if whole_plan.success else whole_plan)
        grasp = plan(start.with_state("door", {"knob": TURNED}), [Grasp("door")], seed=seed)
        record("push blind", push(start, seed, grasp) if grasp.success else grasp)
    return {
        "meta": describe_environment(
            benchmark="door", seed=seed, trials=trials, peak_memory_mb=measure_peak_memory()
        ),
        "trials": records,
    }


def table(result: dict[str, Any]) -> str:
    """Return success rates, times and path lengths as text, and every failure."""
    parts = {"initialization": "guesses", "coal": "coal", "casadi": "CasADi", "ipopt": "Ipopt"}
    parts["validation"] = "check"
    names = "".join(f"{name:>8}" for name in ("p95", *parts.values()))
    head = f"{'task':12}{'success':>10}{'time [s] median':>18}{names}"
    lines = [f"{head}{'iter.':>7}{'base [m]':>10}{'arm [rad]':>11}{'build [s]':>11}"]
    for task in TASKS:
        rows = [t for t in result["trials"] if t["task"] == task]
        if not rows:
            continue
        time, late = distribution(rows, "planning_time")
        seconds = (late, *(distribution(rows, f"time_{part}")[0] for part in parts))
        iterations, base, arm = (
            distribution(rows, field)[0]
            for field in ("iterations", "base_path_length", "arm_path_length")
        )
        success = f"{sum(t['success'] for t in rows)}/{len(rows)}"
        line = f"{task:12}{success:>10}{time:>18.3f}" + "".join(f"{s:>8.3f}" for s in seconds)
        build = max(t["build_time"] for t in rows)
        lines.append(f"{line}{iterations:>7.0f}{base:>10.2f}{arm:>11.2f}{build:>11.2f}")
    lines.append(f"peak memory {result['meta']['peak_memory_mb']:.0f} MB")
    for t in result["trials"]:
        if not t["success"]:
            reason = "; ".join(t["violations"]) or "no violation"
            lines.append(f"start {t['number']}, {t['task']}: {t['status']}; {reason}")
    return "\n".join(lines)
