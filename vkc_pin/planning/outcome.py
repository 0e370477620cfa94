"""What planning comes to: a plan from a motion and its check, from those of single steps, or from none at all."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence

import numpy as np

from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.settings import Settings
from vkc_pin.utils.budget import ENDINGS
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.contact_rules import compute_start_opening
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step
from vkc_pin.world.task.terms import Term
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.splicing import concatenate_trajectories
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["FINAL", "TIMES", "charged", "joined", "outcome", "spent", "still", "summed"]

TIMES = ("initialization", "coal", "casadi", "ipopt", "retiming", "validation")
"""What planning spends its time on."""

FINAL = (*ENDINGS, "infeasible")
"""Statuses after which nothing else is tried."""


def spent(
    planning_time: float = 0.0,
    build_time: float = 0.0,
    *,
    iterations: float = 0,
    rounds: float = 0,
    effort: float = 0,
    times: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Return what planning took, as the metrics of a plan have it.

    Args:
        planning_time: All of it but building [s].
        build_time: On symbolic programs that were built for the first time [s].
        iterations: Of Ipopt.
        rounds: Of the solver.
        effort: Units; see `Budget`.
        times: What was spent on `TIMES`, and whatever else [s]; None: nothing.
    """
    parts = {
        f"time_{name}": value
        for name, value in {**dict.fromkeys(TIMES, 0.0), **(times or {})}.items()
    }
    counts = {"iterations": float(iterations), "rounds": float(rounds), "effort": float(effort)}
    return {"planning_time": planning_time, "build_time": build_time, **counts, **parts}


def summed(metrics: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return what several plans took: times, iterations, rounds and effort."""
    return {key: float(sum(part[key] for part in metrics)) for key in spent()}


def charged(plan: Plan, metrics: Sequence[Mapping[str, float]]) -> Plan:
    """Return a plan that took what several did."""
    return dataclasses.replace(plan, metrics={**plan.metrics, **summed(metrics)})


def outcome(
    scene: Scene,
    steps: Sequence[Step],
    options: Options,
    trajectory: Trajectory,
    report: Report,
    status: str,
    *,
    took: Mapping[str, float],
    random_seed: int,
    initialization: str,
    history: Sequence[Mapping[str, float]] = (),
    terms: tuple[Term, ...] = (),
) -> Plan:
    """Return the plan of a motion.

    Args:
        scene: Where it begins.
        steps: What was asked for.
        options: How it was planned.
        trajectory: The motion.
        report: What validation says of it.
        status: See `Plan`.
        took: What planning took; see `spent`.
        random_seed: Of the random numbers.
        initialization: Which seed trajectory it came from.
        history: A row for every round of the solver.
        terms: Own constraints and costs that were asked for.
    """
    found = {**trajectory.metrics(), **report.measures()}
    return Plan(
        scene=scene,
        steps=tuple(steps),
        options=options,
        trajectory=trajectory,
        validation=report,
        status=status,
        metrics={"planning_time": 0.0, "build_time": 0.0, **found, **took},
        seed=random_seed,
        initialization=initialization,
        history=tuple(history),
        terms=terms,
    )


def joined(
    scene: Scene,
    steps: Sequence[Step],
    settings: Settings,
    parts: Sequence[Plan],
    *,
    began: float | None = None,
    metrics: Sequence[Mapping[str, float]] | None = None,
    notes: Sequence[str] = (),
    history: Sequence[Mapping[str, float]] | None = None,
) -> Plan:
    """Return the plans of steps, one after the other, as one plan of all `steps`; where nothing was begun, nothing moves.

    Args:
        scene: Where the first begins.
        steps: What was asked for.
        settings: How it was to be planned.
        parts: The plans, each from where the one before it ends.
        began: Value of `time.perf_counter()` since which all counts as planning; None: what is in
            `metrics`, and the check.
        metrics: What planning took; None: what the parts did. The check of all of it comes on top.
        notes: For the report, before those of the last part.
        history: A row for every round of the solver; None: those of the parts.
    """
    took = summed([part.metrics for part in parts] if metrics is None else metrics)
    rows = [row for part in parts for row in part.history] if history is None else history
    if parts:
        settings.progress.doing("checking all of it")
        status = settings.budget.ended or ("rejected" if parts[-1].success else parts[-1].status)
        trajectory = concatenate_trajectories(
            [part.trajectory for part in parts], pause=settings.options.grasp_time
        )
        checked = time.perf_counter()
        report = validate(scene, steps, trajectory, settings.options, settings.terms)
        for key in ("planning_time", "time_validation"):
            took[key] += time.perf_counter() - checked
        report = dataclasses.replace(report, notes=(*notes, *parts[-1].validation.notes))
        status, name = (
            "success" if report.ok else status,
            ", ".join(part.initialization for part in parts),
        )
    else:
        trajectory, status, name = (
            still(scene, settings.options),
            settings.budget.ended or "interrupted",
            "none",
        )
        report = validate(scene, steps, trajectory, settings.options, settings.terms)
    if began is not None:
        took["planning_time"] = time.perf_counter() - began - took["build_time"]
    return outcome(
        scene,
        steps,
        settings.options,
        trajectory,
        report,
        status,
        took=took,
        random_seed=settings.random_seed,
        initialization=name,
        history=rows,
        terms=settings.terms,
    )


def still(scene: Scene, options: Options) -> Trajectory:
    """Return the motion of a robot that stays where it is for a step of time, with what it holds."""
    values = dict(zip(scene.robot.coordinates.names, scene.start.tolist(), strict=True))
    for name, placed in scene.objects.items():
        joints = zip(placed.object.coordinates.names, placed.state.tolist(), strict=True)
        values |= {f"{name}.{joint}": value for joint, value in joints}
    for hold in scene.holds:
        names = scene.objects[hold.object].object.attachment(hold.attachment).coordinates
        values |= {
            f"{hold.object}.{name}": value for name, value in zip(names, hold.at, strict=True)
        }
    row = list(values.values())
    phases = (PhaseSpan("stand", 0, 1, scene.holds, compute_start_opening(scene)),)
    return Trajectory(
        tuple(values), np.array([0.0, options.dt]), np.array([row, row]), phases, len(scene.start)
    )
