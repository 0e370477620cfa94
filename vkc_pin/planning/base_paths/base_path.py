"""Plans the base's path from a start to the best of several goals: straight drives and turns."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.planning.base_paths.lattice_search import find_cheapest_path
from vkc_pin.planning.base_paths.motion_primitives import Drive, SearchSpace
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import wrap_angle

_SHORTCUT_SPACING = 0.5  # [m] spacing of the points between which shortcuts are tried
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class BasePath:
    """Base path of straight drives with turns in place between them.

    Attributes:
        poses: x, y [m] and continuous yaw [rad] at the ends of drives and turns, shape (K, 3).
        goal: Number of the goal that it reaches.
        cost: Length driven, weighted by `BACKWARDS` and `SIDEWAYS`, angle turned times
            `BaseGrid.turning`, and the goal's additional cost [m].
    """

    poses: Floats
    goal: int
    cost: float


def shortest_path(
    grid: BaseGrid,
    start: Sequence[float],
    goals: Floats,
    *,
    costs: Sequence[float] | Floats | None = None,
    smooth: bool = True,
) -> BasePath | None:
    """Return the cheapest path from the start, (3,), to one of the goals, (G, 3), or None.

    A blocked start can be left; blocked goals are not reached. `costs`, shape (G,) [m], are
    additional costs of the goals. `smooth`: shorten the path where it turns more often than
    necessary.
    """
    begin = np.asarray(start, float)
    ends = np.asarray(goals, float)
    extra = np.zeros(len(ends)) if costs is None else np.asarray(costs, float)
    space = SearchSpace(grid, begin, ends)
    found = find_cheapest_path(space, extra)
    if found is None:
        return None
    _, goal, drives, yaw = found
    if smooth:
        drives, yaw = _shorten(space, drives, yaw)
    return _assemble(space, drives, yaw, goal, float(extra[goal]))


def sample_poses(path: BasePath, steps: int, *, turning: float) -> Floats:
    """Return poses along a path without its start, slow at both ends, shape (steps, 3).

    `turning` is the cost of turning, relative to driving [m/rad].
    """
    change = np.diff(path.poses, axis=0)
    cost = np.hypot(change[:, 0], change[:, 1]) + turning * np.abs(change[:, 2])
    passed = np.concatenate([[0.0], np.cumsum(cost)])
    s = np.arange(1, steps + 1) / steps
    at = passed[-1] * (3.0 - 2.0 * s) * s**2
    poses = np.column_stack([np.interp(at, passed, column) for column in path.poses.T])
    poses[-1] = path.poses[-1]
    return poses


def _shorten(space: SearchSpace, drives: list[Drive], last: float) -> tuple[list[Drive], float]:
    """Replace drives by straight shortcuts where those are free and cheaper.

    From each point on, a binary search finds the furthest end of a shortcut: where one is free,
    further ones are tried, otherwise nearer ones.

    Returns:
        The drives, and the yaw at the goal [rad].
    """
    result = list[Drive]()
    yaw = float(space.start[2])
    if space.exit_margins is not None:  # the first drive leaves a blocked start
        result, drives = drives[:1], drives[1:]
        yaw = result[0].yaw
    rest = list[Drive]()
    for drive in drives:
        parts = max(1, int(drive.length / _SHORTCUT_SPACING))
        points = np.linspace(drive.a, drive.b, 1 + parts)
        rest += [Drive(a, b, drive.yaw) for a, b in itertools.pairwise(points)]
    while rest:
        yaws = np.array([yaw, *(drive.yaw for drive in rest), last])
        turns = space.grid.turning * np.abs(np.diff(yaws))
        # cost up to the end of each drive, including the turn to the next
        cost = turns[0] + np.cumsum([drive.cost for drive in rest] + turns[1:])
        best = None
        low = 1  # drives that the best shortcut replaces
        high = len(rest)
        tried = high
        while low < tried:
            shortcut = _find_shortcut(
                space,
                rest[0].a,
                rest[tried - 1].b,
                before=yaw,
                after=float(yaws[tried + 1]),
                limit=float(cost[tried - 1]),
            )
            if shortcut is None:
                high = tried - 1
            else:
                best = shortcut
                low = tried
            tried = (low + high + 1) // 2
        after = float(yaws[low + 1])
        drive, end = best or (rest[0], after)
        result.append(drive)
        # The same turns from there on, relative to an equivalent angle.
        rest = [Drive(other.a, other.b, other.yaw + end - after) for other in rest[low:]]
        yaw = drive.yaw
        last = last + end - after
    return result, last


def _find_shortcut(
    space: SearchSpace, a: Floats, b: Floats, *, before: float, after: float, limit: float
) -> tuple[Drive, float] | None:
    """Return a straight drive between points, and the yaw after it, if it is free and cheap."""
    if np.hypot(*(b - a)) < _SAME:
        return None
    direction = np.arctan2(b[1] - a[1], b[0] - a[0])
    candidates = []
    for reversal in (0.0, np.pi):  # ahead, backwards
        yaw = float(before + wrap_angle(direction + reversal - before))
        drive = Drive(a, b, yaw)
        end = float(yaw + wrap_angle(after - yaw))
        cost = drive.cost + space.grid.turning * (abs(yaw - before) + abs(end - yaw))
        candidates.append((cost, reversal, drive, end))
    cost, _, drive, end = min(candidates)
    if cost >= limit - _SAME:
        return None
    if space.looks_free(drive) and space.is_sweep_free(before, drive, end):
        return drive, end
    return None


def _assemble(
    space: SearchSpace, drives: list[Drive], last: float, goal: int, extra: float
) -> BasePath:
    """Make a path of drives, merging those in line; `last` is the yaw at the goal [rad]."""
    full_turns = float(np.rint((last - space.goals[goal, 2]) / (2 * np.pi)))
    end = space.goals[goal] + [0.0, 0.0, 2 * np.pi * full_turns]
    candidates = []
    for drive in _merge_drives(drives):
        candidates.append(np.array([*drive.a, drive.yaw]))
        candidates.append(np.array([*drive.b, drive.yaw]))
    candidates.append(end)
    poses = [space.start]
    for pose in candidates:
        if np.abs(pose - poses[-1]).max() > _SAME:
            poses.append(pose)
    # The goal is exact.
    poses = [*poses[:-1], end] if len(poses) > 1 else [space.start, end]
    turned = sum(abs(b[2] - a[2]) for a, b in itertools.pairwise(poses))
    cost = sum(drive.cost for drive in drives) + space.grid.turning * turned + extra
    return BasePath(np.array(poses), goal, float(cost))


def _merge_drives(drives: list[Drive]) -> list[Drive]:
    """Merge consecutive drives in line."""
    merged: list[Drive] = []
    for drive in drives:
        if merged and merged[-1].yaw == drive.yaw:
            last = merged[-1]
            combined = Drive(last.a, drive.b, drive.yaw)
            if combined.length >= last.length + drive.length - _SAME:
                merged[-1] = combined
                continue
        merged.append(drive)
    return merged
