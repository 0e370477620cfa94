"""Plans impossible problems of known cause, to measure failure times and explanations."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import distribution, trial
from vkc_pin.experiments.harness.runner import LIMITS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import format_decimal, format_table, join_sections, select
from vkc_pin.planning.diagnosis.proofs import PROVEN
from vkc_pin.planning.prepare import plan
from vkc_pin.procedural.rooms.random_room import sample_layout
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Step

from .ablation import tabulate_trials

_WIDTH = 0.67  # [m] of the robot's base
_HALL = 6.0  # [m] from the middle of the hall to its edges

_Problem = tuple[Scene, tuple[Step, ...]]


def run(
    *,
    out: str | Path,
    problems: int = 50,
    seed: int = 0,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder.
        problems: Number of problems, at least 1; the kinds alternate.
        seed: Random seed of problems and planning.

    Returns:
        See `runner.run`. Trials have `kind`, `notes`, `wall_time` without building programs [s],
        `explained` (the report names a cause) and `proven`.
    """
    runner.check_positive(problems=problems)
    settings = {"benchmark": "impossible", "seed": seed, "problems": problems, **LIMITS}
    specs = [{"key": f"{number:05d}", "number": number, "seed": seed} for number in range(problems)]
    return runner.run(
        specs, _record, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    rows = []
    fields = ("success", "explained", "proven")
    for kind in (*KINDS, "all"):
        own = records if kind == "all" else select(records, kind=kind)
        counts = [str(sum(bool(record.get(field)) for record in own)) for field in fields]
        rows.append(
            [kind, str(len(own)), *counts, *map(format_decimal, distribution(own, "wall_time"))]
        )
    lines = [
        f"- {r['kind']}, problem {r['number']}: {'; '.join(r['notes'] or r['violations'][:1])}"
        for r in records
        if "notes" in r
    ]
    return join_sections(
        about,
        "# Impossible problems",
        f"{about['problems']} impossible problems, seed {about['seed']}, {describe_limit(about)} "
        "each. "
        "Explained: the report names a cause. Proven: it does so for certain.",
        format_table(
            ["kind", "problems", *fields, "time, median [s]", "95th percentile [s]"], rows
        ),
        "## What the reports say",
        "\n".join(lines),
        "## Every trial",
        tabulate_trials(records),
    )


def sample_impossible_problem(seed: int, number: int) -> _Problem:
    """Return scene and steps of problem `number`."""
    rng = np.random.default_rng([4, seed, number])
    return list(KINDS.values())[number % len(KINDS)](rng)


def _record(spec: dict[str, Any]) -> dict[str, Any]:
    number = spec["number"]
    seed = spec["seed"]
    kind = list(KINDS)[number % len(KINDS)]
    scene, steps = sample_impossible_problem(seed, number)
    began = time.perf_counter()
    found = plan(scene, steps, seed=seed, **LIMITS)
    took = time.perf_counter() - began - found.metrics["build_time"]
    notes = found.report.notes
    reasons = [violation for violation in found.report.violations if violation.constraint == "goal"]
    explained = bool(notes) or (found.status == "infeasible" and bool(reasons))
    proven = any(PROVEN in note for note in notes) or (found.status == "infeasible" and not notes)
    more = {
        "number": number,
        "problem": f"{kind} {number}",
        "kind": kind,
        "wall_time": took,
        "notes": list(notes),
    }
    return trial(found, method="VKC", seed=seed, explained=explained, proven=proven, **more)


def _box(
    name: str, size: tuple[float, float, float], at: tuple[float, float], *, bottom: float = 0.0
) -> dict[str, Any]:
    return {
        "name": name,
        "type": "box",
        "size": list(size),
        "position": [*at, bottom + size[2] / 2],
    }


def _hall(*obstacles: dict[str, Any]) -> Scene:
    """Return an empty hall with obstacles, the robot in its middle."""
    return Scene.from_document(
        {
            "name": "hall",
            "robot": {"name": "husky_ur5e", "base": "omni"},
            "start": {"base": [0.0, 0.0, 0.0], "arm": "home"},
            "arena": {"x": [-_HALL, _HALL], "y": [-_HALL, _HALL]},
            "obstacles": list(obstacles),
        }
    )


def _with(scene: Scene, *obstacles: dict[str, Any]) -> Scene:
    return Scene.from_document(
        {**scene.document, "obstacles": [*scene.document["obstacles"], *obstacles]}, scene.folder
    )


def _beyond(rng: np.random.Generator) -> Step:
    """Return a step to be done where x is between 3 and 5 m: the base goes there, or the tool."""
    x, y, yaw = (float(value) for value in rng.uniform((3.5, -2.0, -np.pi), (5.0, 2.0, np.pi)))
    return (
        GoTo(x, y)
        if rng.random() < 0.5
        else Reach((x, y, float(rng.uniform(0.5, 1.1)), np.pi / 2, 0.0, yaw))
    )


def _wall(rng: np.random.Generator) -> _Problem:
    return _hall(_box("fence", (0.1, 2 * _HALL, 2.0), (float(rng.uniform(1.0, 1.6)), 0.0))), (
        _beyond(rng),
    )


def _ring(x: float, y: float, half: float, height: float) -> list[dict[str, Any]]:
    sides = {
        "fence_north": (0, 1),
        "fence_south": (0, -1),
        "fence_east": (1, 0),
        "fence_west": (-1, 0),
    }
    return [
        _box(
            name,
            (0.1 if u else 2 * half, 0.1 if v else 2 * half, height),
            (x + half * u, y + half * v),
        )
        for name, (u, v) in sides.items()
    ]


def _fenced_in(rng: np.random.Generator) -> _Problem:
    return _hall(*_ring(0.0, 0.0, float(rng.uniform(0.9, 1.6)), float(rng.uniform(0.3, 1.5)))), (
        _beyond(rng),
    )


def _fenced_out(rng: np.random.Generator) -> _Problem:
    x, y = (float(value) for value in rng.uniform((3.5, -2.0), (4.0, 2.0)))
    step = GoTo(x, y) if rng.random() < 0.5 else Reach((x, y, 0.6, np.pi / 2, 0.0, 0.0))
    return _hall(*_ring(x, y, float(rng.uniform(1.6, 1.9)), float(rng.uniform(0.3, 1.5)))), (step,)


def _narrow(rng: np.random.Generator) -> _Problem:
    gap = _WIDTH - 0.05
    y = float(rng.uniform(-2.0, 2.0))
    x = float(rng.uniform(1.2, 1.8))
    ends = {"wall_left": (y + gap / 2, _HALL), "wall_right": (-_HALL, y - gap / 2)}
    walls = [
        _box(name, (0.2, high - low, 2.0), (x, (low + high) / 2))
        for name, (low, high) in ends.items()
    ]
    return _hall(*walls), (_beyond(rng),)


def _bend(rng: np.random.Generator) -> _Problem:
    """Return a passage as wide as the base, with a corner too tight to turn in."""
    x = float(rng.uniform(1.2, 1.4))
    width = _WIDTH + 0.08
    walls = [_box("wall_low", (2.0 + width, 0.1, 1.0), (x + 1.0 + width / 2, -width / 2 - 0.05))]
    walls += [_box("wall_high", (2.0, 0.1, 1.0), (x + 1.0, width / 2 + 0.05))]
    walls += [_box("wall_east", (0.1, 3.0 + width, 1.0), (x + 2.05 + width, 1.5))]
    walls += [_box("wall_west", (0.1, 3.0, 1.0), (x + 1.95, width / 2 + 1.5))]
    ends = {"wall_left": (width / 2, _HALL), "wall_right": (-_HALL, -width / 2)}
    walls += [
        _box(name, (0.1, high - low, 1.0), (x, (low + high) / 2))
        for name, (low, high) in ends.items()
    ]
    return _hall(*walls), (GoTo(x + 2.4, float(rng.uniform(4.3, 4.8))),)


def _low_beam(rng: np.random.Generator) -> _Problem:
    """Return a wall that the base fits under, but not the arm."""
    return _hall(
        _box("beam", (0.2, 2 * _HALL + 1.0, 1.5), (float(rng.uniform(1.2, 1.6)), 0.0), bottom=0.42)
    ), (_beyond(rng),)


def _make_occupied_place(rng: np.random.Generator) -> _Problem:
    x, y = (float(value) for value in rng.uniform((1.5, -2.0), (4.0, 2.0)))
    return _hall(_box("crate", (0.6, 0.6, 0.5), (x, y))), (
        GoTo(x + float(rng.uniform(-0.2, 0.2)), y),
    )


def _make_blocked_heading(rng: np.random.Generator) -> _Problem:
    """Return a goal where the base fits, but not at the requested heading."""
    x, y = (float(value) for value in rng.uniform((2.0, -2.0), (4.0, 2.0)))
    walls = [
        _box(f"wall_{k}", (2.0, 0.1, 1.0), (x, y + side * 0.45)) for k, side in enumerate((-1, 1))
    ]
    return _hall(*walls), (GoTo(x, y, np.pi / 2),)


def _inside(rng: np.random.Generator) -> _Problem:
    x, y = (float(value) for value in rng.uniform((1.5, -2.0), (4.0, 2.0)))
    pose = (x, y, 0.4, np.pi / 2, 0.0, float(rng.uniform(-np.pi, np.pi)))
    return _hall(_box("block", (0.7, 0.7, 0.8), (x, y))), (Reach(pose),)


def _high(rng: np.random.Generator) -> _Problem:
    x, y, z = (float(value) for value in rng.uniform((1.0, -2.0, 1.85), (4.0, 2.0, 2.6)))
    return _hall(), (Reach((x, y, z, np.pi / 2, 0.0, float(rng.uniform(-np.pi, np.pi)))),)


def _outside(rng: np.random.Generator) -> _Problem:
    return _hall(), (
        Reach((_HALL + float(rng.uniform(1.6, 3.0)), 0.0, 0.8, np.pi / 2, 0.0, np.pi / 2)),
    )


def _make_blocked_drawer(rng: np.random.Generator) -> _Problem:
    """Return a drawer behind a board."""
    scene = load_scene("drawer")
    return _with(scene, _box("board", (0.04, 1.0, 1.2), (float(rng.uniform(1.46, 1.5)), 0.0))), (
        Actuate("drawer", {"slide": 0.3}),
    )


def _beyond_limits(rng: np.random.Generator) -> _Problem:
    return load_scene("door"), (Actuate("door", {"hinge": float(rng.uniform(1.7, 3.0))}),)


def _shut(rng: np.random.Generator) -> _Problem:
    return load_scene("door"), (
        GoTo(*(float(value) for value in rng.uniform((3.6, -1.0), (4.4, 1.0)))),
    )


def _cup(rng: np.random.Generator) -> tuple[Scene, Any]:
    layout = sample_layout(
        int(rng.integers(1000)), clutter=0.0, objects=(), tables=2, carried=("cup",)
    )
    return layout.make_scene(), layout.find_part("table_2")


def _make_covered_cup(rng: np.random.Generator) -> _Problem:
    """Return a cup under a lid."""
    scene, _ = _cup(rng)
    x, y, z = scene.objects["cup"].placement.translation.tolist()
    return _with(scene, _box("lid", (0.5, 0.5, 0.05), (x, y), bottom=z + 0.11), *_sides(x, y, z)), (
        Grasp("cup"),
    )


def _sides(x: float, y: float, z: float) -> list[dict[str, Any]]:
    around = ((0.22, 0.0), (-0.22, 0.0), (0.0, 0.22), (0.0, -0.22))
    sizes = ((0.05, 0.5), (0.05, 0.5), (0.5, 0.05), (0.5, 0.05))
    return [
        _box(f"side_{k}", (*sizes[k], 0.1), (x + u, y + v), bottom=z + 0.005)
        for k, (u, v) in enumerate(around)
    ]


def _make_occupied_goal(rng: np.random.Generator) -> _Problem:
    """Return a cup whose goal is occupied."""
    scene, table = _cup(rng)
    x, y = table.frame.transform_point(float(rng.uniform(-0.15, 0.0)), 0.0)
    vase = {
        "name": "vase",
        "type": "cylinder",
        "radius": 0.12,
        "length": 0.3,
        "position": [x, y, table.size[2] + 0.15],
    }
    return _with(scene, vase), (Place("cup", (x, y, table.size[2] + 0.001)),)


KINDS: Mapping[str, Callable[[np.random.Generator], _Problem]] = {
    "closed wall": _wall,
    "fence round the start": _fenced_in,
    "fence round the goal": _fenced_out,
    "gap too narrow": _narrow,
    "bend too tight": _bend,
    "beam too low": _low_beam,
    "place taken": _make_occupied_place,
    "no room for the heading": _make_blocked_heading,
    "pose inside a block": _inside,
    "pose too high": _high,
    "pose outside the arena": _outside,
    "drawer boxed in": _make_blocked_drawer,
    "joint beyond its limit": _beyond_limits,
    "door shut between": _shut,
    "cup covered": _make_covered_cup,
    "cup to an occupied spot": _make_occupied_goal,
}
"""Kinds of problems, and what draws one."""
