"""Plans for arms in clutter, on MoveIt's problems, beside roboplan and OMPL."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, distribution, trial, values
from vkc_pin.experiments.harness.runner import Execution
from vkc_pin.experiments.harness.tables import JUDGED, count, format_table, join_sections, select
from vkc_pin.importing.moveit_problems import Problem, list_problems, read_problem
from vkc_pin.options import Options
from vkc_pin.planning.initialization.keyframes import compute_shortfall
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.planning.prepare import plan
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL, CONTACT_DEPTH
from vkc_pin.world.task.steps import Configure, Reach, Step
from vkc_pin.world.trajectory.trajectory import Trajectory

from .peers.found import Clock
from .peers.run import PEERS, find_versions, plan_by_peer
from .peers.tasks import PeerProblem, build_program

METHODS = ("VKC", "roboplan", "OMPL")
BASES = ("fixed", "omni")
GOALS = ("joints", "pose")
_CLEARANCE = 0.002  # [m] goals of these sets are 5 mm from obstacles and more
_SAMPLING = 0.01  # [s] between configurations that are judged
_NEAR = 0.05  # [m] up to which distances are measured


def run(
    *,
    out: str | Path,
    folder: str,
    robot: str,
    seed: int = 0,
    methods: Sequence[str] = METHODS,
    bases: Sequence[str] = ("fixed",),
    goals: Sequence[str] = ("joints",),
    every: int = 1,
    time_limit: float = 60.0,
    clearance: float = _CLEARANCE,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        folder: Folder with scene and request files; see `moveit_problems`.
        robot: Name or robot.yaml file of the robot.
        seed: Random seed of planning.
        methods: Some of `METHODS`.
        bases: Some of `BASES`. Peers plan for fixed bases only.
        goals: Some of `GOALS`: the joint values of the request, or the tool's pose there. Peers
            plan to joint values only.
        every: Only every so many problems.
        time_limit: Wall-time limit of a trial [s].
        clearance: Clearance of obstacles and of the robot itself [m].
    """
    runner.check_positive(every=every)
    methods = list(runner.select_names("method", methods, METHODS))
    bases = list(runner.select_names("base", bases, BASES))
    goals = list(runner.select_names("goal", goals, GOALS))
    files = list_problems(folder)
    names = list(files)[::every]
    name = read_problem(*files[names[0]], robot).scene.robot.name
    settings = {
        "benchmark": "arms",
        "problems": len(names),
        "robot": name,
        "seed": seed,
        "methods": methods,
        "bases": bases,
        "goals": goals,
        "time_limit": time_limit,
        "clearance": clearance,
        "peers": find_versions(methods),
    }
    specs = [
        {"key": f"{name}/{base}/{goal}/{method}", "problem": name, "base": base, "goal": goal}
        | {"method": method, "seed": seed, "time_limit": time_limit, "clearance": clearance}
        for base in bases
        for goal in goals
        for name in names
        for method in methods
        if method not in PEERS or (base, goal) == ("fixed", "joints")
    ]
    function = functools.partial(_record, folder=folder, robot=robot)
    return runner.run(
        specs, function, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    settings = [(base, goal) for base in about["bases"] for goal in about["goals"]]
    rows = [
        _row(base, goal, method, own)
        for base, goal in settings
        for method in about["methods"]
        if (own := select(records, base=base, goal=goal, method=method))
    ]
    head = ["base", "goal", "method", "success", "CPU, median [s]", "95th percentile [s]"]
    head += ["search alone, median [s]", "95th percentile [s]", "arm [rad]", "motion [s]"]
    invalid = sorted({r["problem"] for r in records if not r["valid"]})
    failed = [
        f"- {r['problem']}, {r['base']}, {r['goal']}, {r['method']}: {r['status']}; "
        f"{'; '.join(r['violations'][:2]) or 'no violation'}"
        for r in records
        if r["valid"] and not r["success"]
    ]
    listed = ", ".join(f"{name} {number}" for name, number in about["peers"].items())
    return join_sections(
        about,
        "# Arms in clutter",
        f"{about['problems']} problems for {about['robot']}, seed {about['seed']}; clearance "
        f"{1e3 * about['clearance']:g} mm; at most {about['time_limit']:g} s each. Peers: "
        f"{listed or 'none'}. {JUDGED} Nothing overlaps in 100 configurations a "
        "second either. Times are CPU time; those of the search alone are without building "
        "programs, timing and validation. Lengths are medians of successes, Euclidean in joint "
        "space.",
        format_table(head, rows, text=3),
        *([_compare_lengths(records)] if len(about["methods"]) > 1 else []),
        f"Start or goal in collision, not counted: {', '.join(invalid) or 'none'}.",
        *(["\n".join(["Failures:", "", *failed])] if failed else []),
    )


def _row(base: str, goal: str, method: str, records: Sequence[Record]) -> list[str]:
    own = select(records, valid=True)
    good = select(own, success=True)
    times = [
        f"{value:.2f}" for field in ("time_final", "time_own") for value in distribution(own, field)
    ]
    lengths = [f"{distribution(good, name)[0]:.2f}" for name in ("joint_length", "duration")]
    return [base, goal, method, count(own), *times, *lengths]


def _compare_lengths(records: Sequence[Record]) -> str:
    """Return how long our paths are, relative to the shortest of the others."""
    ratios = []
    for own in select(records, method="VKC", base="fixed", goal="joints", success=True):
        same = [r for r in records if r["problem"] == own["problem"] and r["method"] in PEERS]
        others = values(select(same, success=True), "joint_length")
        if others:
            ratios.append(own["joint_length"] / min(others))
    if not ratios:
        return "No problem was solved by several methods."
    return (
        f"Length of VKC's motion relative to the shortest of the others, {len(ratios)} problems: "
        f"median {np.median(ratios):.2f}, largest {max(ratios):.2f}."
    )


def _record(spec: dict[str, Any], *, folder: str, robot: str) -> dict[str, Any]:
    scene, request = list_problems(folder)[spec["problem"]]
    problem = read_problem(scene, request, robot, base=spec["base"])
    clearance = spec["clearance"]
    options = Options(dist_safe=clearance, self_distance=clearance)
    own = PeerProblem(problem.scene, (_make_step(problem, spec["goal"]),))
    exact = build_program(PeerProblem(problem.scene, (Configure(problem.goal),)), options)
    is_valid = _is_valid(exact)
    method = spec["method"]
    seed = spec["seed"]
    began = time.process_time()
    if method in PEERS:
        found, peer = plan_by_peer(own, method, seed, Clock(spec["time_limit"]), options)
        own_time = peer.own
    else:
        found = plan(
            own.scene, own.steps, options=options, seed=seed, time_limit=spec["time_limit"]
        )
        if found.status == "interrupted":
            raise KeyboardInterrupt
        own_time = found.statistics.initialization_time
    took = time.process_time() - began
    about = {"problem": spec["problem"], "base": spec["base"], "goal": spec["goal"]}
    record = trial(found, method=method, seed=seed, **about)
    record |= {"valid": is_valid, "time_final": took, "time_own": own_time}
    if found.success:
        record |= _measure(exact, found.trajectory)
        record["success"] = record["least_distance"] >= -CONTACT_DEPTH
    return record


def _make_step(problem: Problem, goal: str) -> Step:
    if goal == "joints":
        return Configure(problem.goal)
    return Reach(problem.scene.with_start(arm=dict(problem.goal)).tool_placement())


def _is_valid(problem: TrajectoryProblem) -> bool:
    """Return whether start and goal keep the clearance that validation demands."""
    goal = np.clip(problem.start, problem.lower[-1], problem.upper[-1])
    shortfall = compute_shortfall(problem, np.array([problem.start, goal]), 1)
    return bool((shortfall <= ACCEPTED_SHORTFALL).all())


def _measure(problem: TrajectoryProblem, trajectory: Trajectory) -> dict[str, Any]:
    """Return duration [s], length in joint space [rad] and least distance [m] of a motion."""
    times = np.arange(0.0, trajectory.times[-1] + _SAMPLING, _SAMPLING)
    z = trajectory.at(np.minimum(times, trajectory.times[-1]))
    contacts = problem.contacts.evaluate(z, np.ones(len(z), int), reach=_NEAR, nearest=1)
    steps = np.diff(z[:, 3 : trajectory.robot_size], axis=0)
    return {
        "duration": float(trajectory.times[-1]),
        "joint_length": float(np.linalg.norm(steps, axis=1).sum()),
        "least_distance": float(contacts.distance.min(initial=_NEAR)),
    }
