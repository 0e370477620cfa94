"""Executes plans of the experiments' tasks in physics, also from measured grasps."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Unpack, cast

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, trial, values
from vkc_pin.experiments.harness.runner import LIMITS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import (
    compute_wilson_interval,
    count,
    format_table,
    join_sections,
    select,
)
from vkc_pin.experiments.tasks import TASKS as ALL
from vkc_pin.experiments.tasks import make_start
from vkc_pin.options import Options
from vkc_pin.planning.initialization.keyframes import KeyframeSampler
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.prepare import plan
from vkc_pin.simulation.execution import GRASPS, simulate
from vkc_pin.simulation.physics import Physics, import_mujoco
from vkc_pin.simulation.result import SimulationResult
from vkc_pin.utils.arguments import check_choice, check_list, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.hold import MAX_POSITION_DEVIATION
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate, Grasp, Place, Reach

DEGREES_PER_MM = 0.4
"""Rotation of a displaced hand per displacement [°/mm]."""
# directions that are tried
_DRAWS = 20
# [m], [rad] of inverse kinematics
_TOLERANCE = 1e-8
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
"""Task → description."""
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
_FIGURES = {
    "arm_error": (180.0 / np.pi, 2),
    "base_error": (1e3, 1),
    "miss_m": (1e3, 1),
    "miss_rad": (1.0, 4),
    "grasp_force": (1.0, 0),
    "grasp_torque": (1.0, 1),
    "slip": (1e3, 1),
}
"""Field of a record → factor to its displayed unit, and number of decimals."""


def grasp_in_physics(
    scene: Scene, step: Actuate | Place, seed: int, grasp: str, limits: Any
) -> tuple[Plan, Scene | None]:
    """Plan and execute the grasp of the object that a step moves.

    Returns:
        Plan, and the scene as measured after its execution; None if either failed.
    """
    found = plan(scene, [Grasp(step.object, step.attachment)], seed=seed, **limits)
    if not found.success:
        return found, None
    executed = simulate(scene, found.steps, found.trajectory, grasp=grasp)
    return found, executed.end_scene() if executed.ok else None


def displace_hand(scene: Scene, distance: float, rng: np.random.Generator) -> Scene:
    """Return a scene in which the hand holds the object elsewhere, by a random displacement.

    Args:
        scene: Scene with a held object.
        distance: Displacement of the hand [mm]; see `DEGREES_PER_MM`.
        rng: Random generator of directions.

    Raises:
        InputError: The robot cannot reach there.
    """
    (hold,) = scene.holds
    tool = scene.tool_placement()
    for _ in range(_DRAWS):
        direction, axis = (draw / np.linalg.norm(draw) for draw in rng.normal(size=(2, 3)))
        rotation = pin.exp3(axis * np.radians(DEGREES_PER_MM * distance))
        displaced = tool * pin.SE3(rotation, 1e-3 * distance * direction)
        row = _reach(scene.with_held({}), displaced)
        if row is not None:
            return scene.with_measured_grasp(hold.object, base=row[:3], arm=row[3:])
    raise InputError("the robot cannot hold the object elsewhere", got=f"{distance:g} mm off")


def _reach(scene: Scene, tool: pin.SE3) -> Floats | None:
    """Return the configuration near the start that brings the tool to a pose; None if none."""
    options = Options()
    problem = KinematicProblem(scene, compile_task(scene, [Reach(tool)], options), options)
    search = KeyframeSampler(problem, np.random.default_rng(0))
    pose = search.find_pose(problem.segments)
    assert pose is not None
    solver, target = search.get_pose_solver(pose)
    z, found = solver.solve(
        problem.start[None].copy(),
        target,
        lower=problem.chain.lower[None],
        upper=problem.chain.upper[None],
        weights=search.weights,
        iterations=100,
        tolerance=_TOLERANCE,
    )
    return np.asarray(z[0]) if found[0] else None


def run(
    *,
    out: str | Path,
    trials: int = 10,
    seed: int = 0,
    tasks: Sequence[str] | None = None,
    grasp: str = "weld",
    off: Sequence[float] = (),
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        trials: Number of random starts per task, at least 1.
        seed: Random seed of starts and planning.
        tasks: Some of `TASKS`. Default: all; with `off`, those that move a single object.
        grasp: Kind of grasp; see `simulate`.
        off: Instead of whole tasks: the grasp is executed and measured, and the rest is planned
            from there and executed, for each distance [mm] by which the hand closes elsewhere.
    """
    import_mujoco()
    runner.check_positive(trials=trials)
    graspable = [task for task in TASKS if isinstance(ALL[task].steps[0], Actuate | Place)]
    default = graspable if off else TASKS
    names = runner.select_names("task", default if tasks is None else tasks, TASKS)
    settings = {
        "benchmark": "execution",
        "seed": seed,
        "starts": trials,
        "tasks": names,
        "mujoco": version("mujoco"),
        **LIMITS,
        "physics": vars(Physics()),
        "grasp": check_choice(grasp, GRASPS, "grasp"),
    }
    largest = 1e3 * MAX_POSITION_DEVIATION
    given: tuple[Any, ...] = check_list(off, "off", "distances [mm]")
    distances = [
        check_number(mm, f"off[{k}]", f"0 to {largest:g} mm", low=0.0, high=largest)
        for k, mm in enumerate(given)
    ]
    if distances:
        for name in names:
            check_choice(name, graspable, "task that moves a single object", "tasks")
        settings["off"] = distances
    specs: list[dict[str, Any]] = []
    for name, number in itertools.product(names, range(trials)):
        spec = {
            "key": f"{list(TASKS).index(name):02d}/{number:04d}",
            "task": name,
            "number": number,
            "seed": seed,
            "grasp": grasp,
        }
        if not distances:
            specs.append(spec)
        for mm in distances:
            specs.append({**spec, "key": f"{spec['key']}/{mm:g}", "off": mm})
    return runner.run(
        specs, _record, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    sections = [_tabulate_tasks(result)]
    if about.get("off"):
        about_off = (
            "The grasp is executed first. The rest is planned from there, as measured and with the "
            f"hand displaced, and turned by {DEGREES_PER_MM:g}° per mm, in random directions."
        )
        sections = [about_off, *sections, _list_trials(records)]
    title = "# Plans in physics"
    if about.get("grasp") == "friction":
        title += ", held by friction"
    return join_sections(
        about,
        title,
        f"{about['starts']} random starts per task, seed {about['seed']}, {describe_limit(about)} "
        "each. "
        "Plans are counted by the independent validation, and executed if they end within 10 mm "
        "and 0.02 rad of the goal, nothing is pulled out of the hand, and no contact is deeper "
        "than planned by more than 1 mm; beside it Wilson's interval of 95 %. Errors of arm and "
        "base, misses of goals, forces, torques and slips are the largest of all trials.",
        *sections,
        "## What went wrong",
        _list_problems(records),
    )


def _tabulate_tasks(result: Mapping[str, Any]) -> str:
    """Tabulate the trials by task, and by displacement of the hand if there are any."""
    about = result["meta"]
    records = result["trials"]
    distances = about.get("off", ())
    rows: list[list[str]] = []
    for name in about["tasks"]:
        if not distances:
            rows.append(_make_row(name, select(records, task=name)))
        for mm in distances:
            rows.append(_make_row(f"{name}, {mm:g} mm off", select(records, task=name, off=mm)))
    if len(rows) > 1:
        rows.append(_make_row("all", records))
    return format_table(_HEAD, rows)


def _list_problems(records: Sequence[Record]) -> str:
    """Return a list of the different problems of all trials."""
    problems = Counter[str]()
    for record in records:
        for text in record.get("problems", ()):
            problems[f"{record.get('task')}: {text}"] += 1
    lines: list[str] = []
    for text, number in problems.items():
        lines.append(f"- {text} ({number} times)" if number > 1 else f"- {text}")
    return "\n".join(lines) or "Nothing."


def _list_trials(records: Sequence[Record]) -> str:
    """Return a list of all trials with their starts and random seeds."""
    lines = ["## Trials", ""]
    for record in records:
        where = f"{record['task']}, start {record['number']}, seed {record['seed']}"
        outcome = "executed" if record.get("executed") else "not executed"
        lines.append(f"- {where}, {record['off']:g} mm off: {record['status']}, {outcome}")
    return "\n".join(lines)


def _make_row(name: str, records: Sequence[Record]) -> list[str]:
    """Return the row of a table for some trials."""
    planned = select(records, success=True)
    executed = len([record for record in planned if record.get("executed")])
    low, high = compute_wilson_interval(executed, len(planned))
    interval = f"{100.0 * low:.0f}–{100.0 * high:.0f}" if planned else "–"
    cells = [name, count(records), count(planned, "executed"), interval]
    for field, (factor, digits) in _FIGURES.items():
        found = values(planned, field)
        cells.append(f"{factor * max(found):.{digits}f}" if found else "–")
    return cells


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    """Plan and execute a trial, and return its record."""
    seed = spec["seed"]
    steps = ALL[spec["task"]].steps
    start = make_start(spec["task"], seed, spec["number"])
    fields: dict[str, Any] = {"task": spec["task"], "number": spec["number"], "executed": False}
    distance = spec.get("off")
    if distance is not None:
        fields["off"] = distance
        step = cast("Actuate | Place", steps[0])
        found, grasped = grasp_in_physics(start, step, seed, spec["grasp"], LIMITS)
        if grasped is None:
            problems = [f"the grasp: {found.status}"]
            record = trial(found, method="VKC", seed=seed, **fields, problems=problems)
            record["success"] = False
            return record
        start = grasped
        if distance:
            rng = np.random.default_rng([seed, spec["number"], round(1e3 * distance)])
            start = displace_hand(grasped, distance, rng)
    found = plan(start, steps, seed=seed, **LIMITS)
    if found.success:
        began = time.perf_counter()
        executed = simulate(found.scene, found.steps, found.trajectory, grasp=spec["grasp"])
        fields["simulation_time"] = time.perf_counter() - began
        fields.update(_measure_execution(executed))
    return trial(found, method="VKC", seed=seed, duration=found.metrics["duration"], **fields)


def _measure_execution(result: SimulationResult) -> dict[str, Any]:
    """Return the figures of an execution."""
    tracking = result.tracking
    grips = result.grips
    misses_m = [miss.amount for miss in result.misses if miss.unit == "m"]
    misses_rad = [miss.amount for miss in result.misses if miss.unit == "rad"]
    return {
        "executed": result.ok,
        "problems": result.problems(),
        "arm_error": tracking.arm[0],
        "arm_error_rms": tracking.arm[1],
        "base_error": tracking.base[0],
        "base_error_rms": tracking.base[1],
        "heading_error": tracking.heading[0],
        "miss_m": max(misses_m, default=None),
        "miss_rad": max(misses_rad, default=None),
        "grasp_force": max((grip.force for grip in grips), default=None),
        "grasp_torque": max((grip.torque for grip in grips), default=None),
        "slip": max((grip.slip for grip in grips), default=0.0) or None,
        "effort_share": max(tracking.shares.values(), default=None),
        "contacts": [str(contact) for contact in result.contacts],
    }
