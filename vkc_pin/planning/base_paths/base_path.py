"""The path of the mobile base from a start to the best of several goals: straight drives with turns between them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.planning.base_paths.lattice_search import cheapest
from vkc_pin.planning.base_paths.motion_primitives import Drive, Ground, wrapped
from vkc_pin.utils.arrays import Floats

__all__ = ["BasePath", "poses_along", "shortest_path"]

_KNOT = 0.5  # [m] between places where the path may be shortened
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class BasePath:
    """A path of the base: straight drives, forwards or backwards, with turns in place between them.

    Attributes:
        poses: x, y [m] and yaw [rad, continuous] where a drive or turn begins or ends; from the
            start to the goal, shape (K, 3).
        goal: Which goal it reaches.
        cost: Metres driven, backwards times `BACKWARDS`, sideways next to start or goal times
            `SIDEWAYS`, plus radians turned times `BaseGrid.turning`, plus the goal's extra cost
            [m].
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
    """Return the cheapest path from the start to one of the goals, or None if there is none.

    A blocked start can be left; goals that are blocked are not reached. Nothing here is random.

    Args:
        grid: Where the base fits.
        start: x, y, yaw [m, rad].
        goals: The same for each goal, shape (G, 3).
        costs: What reaching each goal costs beside the path, shape (G,) [m]; None: nothing.
        smooth: Shorten the path over the grid where it turns more often than needed.

    Raises:
        InputError: Shapes do not fit, or a number is not finite.
    """
    begin, ends = np.asarray(start, float), np.asarray(goals, float)
    extra = np.zeros(len(ends)) if costs is None else np.asarray(costs, float)
    for field, value, shape in (
        ("start", begin, (3,)),
        ("goals", ends, (len(ends), 3)),
        ("costs", extra, (len(ends),)),
    ):
        if value.shape != shape or not np.all(np.isfinite(value)):
            expected = f"finite numbers, shape {shape}"
            raise InputError(
                "not what the search needs", field=field, expected=expected, got=value.tolist()
            )
    if np.any(extra < 0.0):
        raise InputError(
            "a cost is negative", field="costs", expected="numbers >= 0", got=extra.tolist()
        )
    ground = Ground(grid, begin, ends)
    found = cheapest(ground, extra)
    if found is None:
        return None
    _, goal, drives, yaw = found
    if smooth:
        drives, yaw = _shortened(ground, drives, yaw)
    return _assembled(ground, drives, yaw, goal, float(extra[goal]))


def poses_along(path: BasePath, steps: int, *, turning: float) -> Floats:
    """Return `steps` poses along a path, without its start, the last at its goal: slow at both ends, shape (steps, 3) [m, rad].

    Args:
        path: The path.
        steps: How many poses, at least 1.
        turning: How many metres of driving take as long as turning by one radian [m/rad].
    """
    if steps < 1:
        raise InputError("no waypoints", field="steps", expected="at least 1", got=steps)
    change = np.diff(path.poses, axis=0)
    passed = np.concatenate(
        [[0.0], np.cumsum(np.hypot(change[:, 0], change[:, 1]) + turning * np.abs(change[:, 2]))]
    )
    u = np.arange(1, steps + 1) / steps
    at = passed[-1] * (3.0 - 2.0 * u) * u**2
    poses = np.column_stack([np.interp(at, passed, column) for column in path.poses.T])
    poses[-1] = path.poses[-1]
    return poses


def _shortened(ground: Ground, drives: list[Drive], last: float) -> tuple[list[Drive], float]:
    """Return drives, and the yaw at the goal, that go straight between places on the path where that is free and cheaper."""
    forced = 0 if ground.leaving is None else 1  # the first drive leaves what the base stands in
    result, yaw = drives[:forced], drives[0].yaw if forced else float(ground.start[2])
    rest = []
    for drive in drives[forced:]:
        knots = np.linspace(drive.a, drive.b, 1 + max(1, int(drive.length / _KNOT)))
        rest += [Drive(a, b, drive.yaw) for a, b in itertools.pairwise(knots)]
    while rest:
        yaws = np.array([yaw, *(drive.yaw for drive in rest), last])
        turns = ground.grid.turning * np.abs(np.diff(yaws))
        # Up to the end of each drive, turned as the path goes on there.
        cost = turns[0] + np.cumsum([drive.cost for drive in rest] + turns[1:])
        best, low, high = None, 1, len(rest)
        tried = high
        while low < tried:
            turns_to, limit = float(yaws[tried + 1]), float(cost[tried - 1])
            straight = _straight(
                ground, rest[0].a, rest[tried - 1].b, before=yaw, after=turns_to, limit=limit
            )
            if straight is None:
                high = tried - 1
            else:
                best, low = straight, tried
            tried = (low + high + 1) // 2
        after = float(yaws[low + 1])
        drive, end = best or (rest[0], after)
        result.append(drive)
        # The same turns from there on, counted from an equal angle.
        rest = [Drive(other.a, other.b, other.yaw + end - after) for other in rest[low:]]
        yaw, last = drive.yaw, last + end - after
    return result, last


def _straight(
    ground: Ground, a: Floats, b: Floats, *, before: float, after: float, limit: float
) -> tuple[Drive, float] | None:
    """Return a straight drive, and the yaw after turning at its end, if these, and the turn before it, cost less than `limit`."""
    found = []
    if np.hypot(*(b - a)) < _SAME:
        return None
    for backwards in (0.0, np.pi):
        yaw = float(before + wrapped(np.arctan2(b[1] - a[1], b[0] - a[0]) + backwards - before))
        drive, end = Drive(a, b, yaw), float(yaw + wrapped(after - yaw))
        found.append(
            (
                drive.cost + ground.grid.turning * (abs(yaw - before) + abs(end - yaw)),
                backwards,
                drive,
                end,
            )
        )
    cost, _, drive, end = min(found)
    return (
        (drive, end)
        if cost < limit - _SAME and ground.likely(drive) and ground.swept(before, drive, end)
        else None
    )


def _assembled(
    ground: Ground, drives: list[Drive], last: float, goal: int, extra: float
) -> BasePath:
    """Return the path through `drives`, which ends at the yaw `last` [rad]."""
    merged: list[Drive] = []
    for drive in drives:
        joined = Drive(merged[-1].a, drive.b, drive.yaw) if merged else drive
        if (
            merged
            and merged[-1].yaw == drive.yaw
            and joined.length >= merged[-1].length + drive.length - _SAME
        ):
            merged[-1] = joined
        else:
            merged.append(drive)
    turns = float(np.rint((last - ground.goals[goal, 2]) / (2 * np.pi)))
    end = ground.goals[goal] + [0.0, 0.0, 2 * np.pi * turns]
    poses = [ground.start]
    for pose in [
        *(np.array([*place, drive.yaw]) for drive in merged for place in (drive.a, drive.b)),
        end,
    ]:
        if np.abs(pose - poses[-1]).max() > _SAME:
            poses.append(pose)
    poses = [*poses[:-1], end] if len(poses) > 1 else [ground.start, end]
    turned = sum(abs(b[2] - a[2]) for a, b in itertools.pairwise(poses))
    cost = sum(drive.cost for drive in drives) + ground.grid.turning * turned + extra
    return BasePath(np.array(poses), goal, float(cost))
