"""Tests of pauses, times and grasp coordinates with fake phases."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from vkc_pin.planning.solver.to_trajectory import make_trajectory
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.trajectory import Trajectory

DOOR, STICK = Hold("door", "free"), Hold("stick", "grip")


def phase(
    name: str,
    *,
    held: tuple[Hold, ...] = (),
    released: tuple[Hold, ...] = (),
    grasps: tuple[Hold, ...] = (),
    opening: Any = None,
) -> Any:
    return SimpleNamespace(name=name, held=held, released=released, grasps=grasps, opening=opening)


def made(
    phases: list[Any],
    ends: list[int],
    *,
    after: tuple[Hold, ...] = (),
    holds: tuple[Hold, ...] = (),
) -> tuple[Trajectory, np.ndarray]:
    """Return the trajectory and the waypoints of a fake problem.

    Steps take 1, 2, 3, ... seconds, and the gripper a tenth of one.
    """
    count = ends[-1]
    path = np.column_stack(
        [10.0 + np.arange(count + 1.0), np.zeros((count + 1, 2)), 100.0 + np.arange(count + 1.0)]
    )
    names = ("joint", "aside", "turn", "door.free")
    used = DOOR in holds or any(DOOR in (*phase.held, *phase.grasps) for phase in phases)
    problem: Any = SimpleNamespace(
        waypoints=lambda z: np.vstack([path[:1], z]),
        options=SimpleNamespace(grasp_time=0.1),
        task=SimpleNamespace(phases=phases, after=after),
        ends=np.array(ends),
        chain=SimpleNamespace(
            names=names,
            virtual={DOOR: ("door.free",)} if used else {},
            index=names.index,
            robot=SimpleNamespace(coordinates=SimpleNamespace(size=3)),
        ),
        scene=SimpleNamespace(holds=holds),
    )
    motion = make_trajectory(problem, path[1:].copy(), 1.0 + np.arange(count))
    assert motion.names == names
    assert motion.robot_size == 3
    return motion, path


def seen(motion: Trajectory) -> tuple[list[float], list[float], list[tuple[str, int, int]]]:
    spans = [(span.name, span.first, span.last) for span in motion.phases]
    return motion.positions[:, 0].tolist(), np.diff(motion.times).round(9).tolist(), spans


def test_robot_waits_after_grasping() -> None:
    """The pause is at the beginning of the next phase."""
    motion, _ = made(
        [phase("reach", grasps=(STICK,)), phase("carry", held=(STICK,))], [2, 4], after=(STICK,)
    )
    assert seen(motion) == (
        [10, 11, 12, 12, 13, 14],
        [1, 2, 0.1, 3, 4],
        [("reach", 0, 2), ("carry", 2, 5)],
    )
    assert motion.times[0] == 0.0
    assert [span.holds for span in motion.phases] == [(), (STICK,)]


def test_robot_waits_while_releasing() -> None:
    """The first phase may begin with a release, too."""
    motion, _ = made(
        [phase("away", released=(STICK,)), phase("on"), phase("again", released=(STICK,))],
        [1, 2, 4],
    )
    assert seen(motion) == (
        [10, 10, 11, 12, 12, 13, 14],
        [0.1, 1, 2, 0.1, 3, 4],
        [("away", 0, 2), ("on", 2, 3), ("again", 3, 6)],
    )
    both = [phase("reach", grasps=(STICK,)), phase("on", released=(STICK,))]
    assert seen(made(both, [1, 2])[0])[1] == [1, 0.1, 2]  # once, for both


def test_robot_waits_for_a_final_release() -> None:
    held = [phase("carry", held=(STICK,), opening=0.05)]
    motion, _ = made(held, [2], after=())
    assert seen(motion) == ([10, 11, 12, 12], [1, 2, 0.1], [("carry", 0, 2), ("let go", 2, 3)])
    assert (motion.phases[-1].holds, motion.phases[-1].opening) == ((), 0.05)
    assert seen(made(held, [2], after=(STICK,))[0])[2] == [("carry", 0, 2)]
    grasped = [phase("reach", held=(DOOR,), grasps=(STICK,))]
    assert seen(made(grasped, [2], after=(DOOR, STICK), holds=(DOOR,))[0])[2] == [("reach", 0, 2)]
    one_of_both = made(grasped, [2], after=(DOOR,), holds=(DOOR,))[0]
    assert [span.holds for span in one_of_both.phases] == [(DOOR,), (DOOR,)]
    assert seen(made([phase("go")], [2])[0])[2] == [("go", 0, 2)]


def chosen(
    phases: list[Any],
    ends: list[int],
    *,
    holds: tuple[Hold, ...] = (),
    after: tuple[Hold, ...] = (),
) -> list[int]:
    """Return the source waypoint of each grasp coordinate, without pauses."""
    motion, _ = made(phases, ends, holds=holds, after=after)
    column, rows = motion.positions[:, 3] - 100.0, motion.positions[:, 0] - 10.0
    _, first = np.unique(rows, return_index=True)
    return [int(value) for value in column[first]]


def test_inactive_grasp_coordinates_take_the_next_or_last_value() -> None:
    """During the grasp, the program's own values are used."""
    hold = (DOOR,)
    grasp = [phase("reach", grasps=hold), phase("pull", held=hold), phase("away", released=hold)]
    assert chosen(grasp, [2, 4, 6]) == [2, 2, 2, 3, 4, 4, 4]
    again = [phase("pull", held=hold), phase("away"), phase("reach", grasps=hold)]
    assert chosen(again, [1, 4, 6], holds=hold, after=hold) == [0, 1, 6, 6, 6, 6, 6]
    assert chosen([phase("go")], [3], holds=hold) == [0, 0, 0, 0]  # as it was at the start
    assert chosen([phase("reach", grasps=hold)], [3], after=hold) == [3, 3, 3, 3]
    assert chosen([phase("go"), phase("pull", held=hold)], [2, 3], after=hold) == [2, 2, 2, 3]
