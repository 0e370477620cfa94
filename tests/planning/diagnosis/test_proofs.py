"""Tests that proven failures are impossible, and that feasible tasks are not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from helpers.drives import hall
from helpers.small_problems import SHORT, program_of

import vkc_pin as vkc
from vkc_pin.planning.base_paths.base_path import shortest_path
from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.planning.diagnosis.proofs import PROVEN, find_proofs
from vkc_pin.planning.initialization.base_routes import collect_grid_shapes

FAR = vkc.Reach((4.0, 0.0, 1.0, 0.0, np.pi / 2, 0.0))


def box(name: str, size: Sequence[float], at: Sequence[float], yaw: float = 0.0) -> dict[str, Any]:
    return {
        "name": name,
        "type": "box",
        "size": list(size),
        "position": list(at),
        "rpy": [0.0, 0.0, yaw],
    }


def problem(obstacles: Sequence[dict[str, Any]], *steps: Any) -> vkc.TrajectoryProblem:
    return program_of(hall(obstacles=obstacles), list(steps), options=SHORT)


def gap(width: float) -> list[dict[str, Any]]:
    length = 6.0 - width / 2
    return [
        box(name, (0.1, length, 1.0), (1.2, side * (width + length) / 2, 0.5))
        for name, side in (("left", 1), ("right", -1))
    ]


def ring(x: float, y: float, half: float = 1.0) -> list[dict[str, Any]]:
    sides = {"north": (0, 1), "south": (0, -1), "east": (1, 0), "west": (-1, 0)}
    return [
        box(
            name,
            (0.1 if u else 2 * half, 0.1 if v else 2 * half, 1.0),
            (x + half * u, y + half * v, 0.5),
        )
        for name, (u, v) in sides.items()
    ]


@pytest.mark.parametrize("step", [vkc.GoTo(3.0, 0.0), vkc.GoTo(3.0, 2.0, 1.0), FAR], ids=str)
def test_closed_wall_separates_the_goal(step: Any) -> None:
    clutter = [
        box("crate", (0.4, 0.4, 0.4), (0.0, 2.0, 0.2)),
        box("shelf", (0.4, 2.0, 1.0), (5.0, 3.0, 0.5)),
    ]
    (line,) = find_proofs(
        problem([box("fence", (0.1, 12.0, 1.0), (1.2, 0.0, 0.5)), *clutter], step)
    )
    assert "no path for the base, " + PROVEN in line
    assert line.endswith("cut off by fence")


@pytest.mark.parametrize(("x", "goal"), [(0.0, 4.0), (4.0, 4.0)], ids=["start", "goal"])
def test_all_sides_of_a_ring_are_named(x: float, goal: float) -> None:
    (line,) = find_proofs(problem(ring(x, 0.0), vkc.GoTo(goal, 0.0)))
    assert line.endswith("cut off by north, south, east, west")


@pytest.mark.parametrize("width", [0.3, 0.5, 0.62])
def test_narrow_gap_is_proven(width: float) -> None:
    (line,) = find_proofs(problem(gap(width), vkc.GoTo(3.0, 0.0)))
    assert line.endswith("cut off by left, right")


@pytest.mark.parametrize("width", [0.68, 0.7, 0.85, 2.0])  # the base is 0.67 m wide
def test_wide_gap_proves_nothing(width: float) -> None:
    assert find_proofs(problem(gap(width), vkc.GoTo(3.0, 0.0))) == []


def test_wall_that_the_arm_reaches_across_proves_nothing() -> None:
    assert (
        find_proofs(
            problem(
                [box("fence", (0.1, 12.0, 0.6), (1.2, 0.0, 0.3))],
                vkc.Reach((1.8, 0.0, 1.0, 0.0, np.pi / 2, 0.0)),
            )
        )
        == []
    )


def test_wall_that_the_base_passes_under_proves_nothing() -> None:
    assert (
        find_proofs(problem([box("beam", (0.1, 12.0, 0.3), (1.2, 0.0, 1.5))], vkc.GoTo(3.0, 0.0)))
        == []
    )


@pytest.mark.parametrize("height", [0.42, 0.47])
def test_wall_that_the_arm_mount_hits_is_proven(height: float) -> None:
    beam = box("beam", (0.1, 13.0, 1.0), (1.2, 0.0, 0.5 + height))
    (line,) = find_proofs(problem([beam], vkc.GoTo(3.0, 0.0)))
    assert line.endswith("cut off by beam")
    shorter = {
        **beam,
        "size": [0.1, 12.0, 1.0],
    }  # the base passes under it at the arena's edge, the foot beside it
    assert find_proofs(problem([shorter], vkc.GoTo(3.0, 0.0))) == []


def test_blocked_goal_is_proven() -> None:
    (line,) = find_proofs(
        problem([box("crate", (0.6, 0.6, 0.4), (1.5, 0.0, 0.2))], vkc.GoTo(1.5, 0.0))
    )
    assert line.startswith("go to: no place for the base, " + PROVEN)
    assert line.endswith("it hits crate")


def test_goal_too_high_is_proven() -> None:
    (line,) = find_proofs(problem([], vkc.Reach((1.5, 0.0, 3.0, 0.0, 0.0, 0.0))))
    assert line.startswith("reach with tool: out of reach, " + PROVEN)


@pytest.mark.parametrize(
    "obstacles", [[], [box("crate", (0.4, 0.4, 0.4), (0.0, 2.0, 0.2))]], ids=["empty", "crate"]
)
def test_goal_outside_the_arena_is_proven(obstacles: list[dict[str, Any]]) -> None:
    (line,) = find_proofs(problem(obstacles, vkc.Reach((8.0, 0.0, 0.8, np.pi / 2, 0.0, 0.0))))
    assert line.endswith("proven: the goal is in reach from outside the arena alone")


def test_failing_phase_is_named() -> None:
    steps = [vkc.GoTo(-1.0, 0.0), vkc.GoTo(3.0, 0.0)]
    lines = find_proofs(problem([box("fence", (0.1, 12.0, 1.0), (1.2, 0.0, 0.5))], *steps))
    assert len(lines) == 1
    assert lines[0].startswith("go to: ")
    assert find_proofs(problem([box("fence", (0.1, 12.0, 1.0), (1.2, 0.0, 0.5))], steps[0])) == []


def door_room(*steps: Any) -> vkc.TrajectoryProblem:
    return program_of(vkc.load_scene("door"), list(steps), options=SHORT)


def test_closed_door_is_named_unless_opened() -> None:
    (line,) = find_proofs(door_room(vkc.GoTo(4.0, 0.0)))
    assert "door.panel" in line
    assert line.endswith("; door is closed meanwhile")
    assert find_proofs(door_room(vkc.Actuate("door", {"hinge": 1.4}), vkc.GoTo(4.0, 0.0))) == []


@pytest.mark.parametrize("seed", range(40))
def test_existing_path_disproves_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-5.0, 5.0, (70, 2))
    places = places[np.hypot(*places.T) > 1.5]
    sizes = rng.uniform(0.1, 1.6, (len(places), 2))
    obstacles = [
        box(f"box_{k}", (*size, 1.0), (*at, 0.5), float(rng.uniform(-np.pi, np.pi)))
        for k, (at, size) in enumerate(zip(places, sizes, strict=True))
    ]
    x, y = rng.uniform(-5.0, 5.0, 2).tolist()
    own = problem(obstacles, vkc.GoTo(x, y))
    z = own.start.copy()
    z[:3] = 0.0
    moving, standing = collect_grid_shapes(own, 0, z)
    grid = BaseGrid(
        [shape for joint, shape in moving if joint <= 1], [], standing, own.scene.arena, 0.0
    )
    goals = np.array([(x, y, yaw) for yaw in np.linspace(0.0, 2 * np.pi, 16, endpoint=False)])
    if shortest_path(grid, own.start[:3].tolist(), goals) is not None:
        assert find_proofs(own) == []


@pytest.mark.parametrize(
    "name", ["door", "drawer", "corridor_door", "aisle_drawer", "gap_table", "household", "fetch"]
)
def test_nothing_is_proven_for_packaged_scenes(name: str) -> None:
    scene = vkc.load_scene(name)
    fixed = [
        n
        for n, placed in scene.objects.items()
        if not placed.object.free and placed.object.attachments
    ]
    for thing in fixed[:3]:
        assert find_proofs(program_of(scene, [vkc.Grasp(thing)], options=SHORT)) == []
