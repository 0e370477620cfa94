"""Start, limits, rates, rolling, standing still, latches and grasps of a motion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .gripper import check_openings
from .plan import Hold, Violation
from .poses import compute_angle, make_pose
from .stage import Stage, World

__all__ = ["check_motion", "check_stage"]

TIP = 0.1  # [rad] by which what something stands on may tilt
BACK = 1e-4  # [m] by which a pushed link may come back
STILL = 1e-5  # [m] or [rad]
FINE = 5e-4  # [m] and [rad] between two samples at which a grasp is looked at


def check_motion(world: World) -> Iterator[Violation]:
    """Check the rules that concern waypoints alone."""
    plan = world.plan
    fine = plan.fine()
    for k, name in enumerate(plan.names):
        column = plan.positions[:, k]
        if name in world.start and (off := abs(column[0] - world.start[name])) > 1e-9:
            yield Violation(
                "start", name, 0.0, off, f"{column[0]:.6g} instead of {world.start[name]:.6g}"
            )
        low, high, fastest, strongest = _get_limits(world, name)
        outside = np.maximum(low - fine[:, k], fine[:, k] - high)
        most = (
            1e-2 if max(low - column[0], column[0] - high) <= 1e-2 else 0.0
        )  # the robot is where it is
        near = np.abs(fine[:, k] - column[0]) <= 1e-9
        outside[near] -= most
        yield from _find_worst(
            "limit", name, outside - 1e-5, np.zeros(len(outside)), f"limits {low:.4g} to {high:.4g}"
        )
        if plan.curve is None:
            spans = np.diff(plan.times)
            speed = np.diff(column) / spans
            change = np.abs(np.diff(np.concatenate([[0.0], speed, [0.0]])))  # from rest, to rest
            shorter = np.minimum(np.append(spans, np.inf), np.append(np.inf, spans))
            strength, when, moments = change / shorter, plan.times, plan.times
        else:
            inside = plan.curve.inside(8)
            number, when = np.repeat(np.arange(len(inside)), inside.shape[1]), inside.ravel()
            speed, strength = (
                np.abs(plan.curve.derivative(when, order, number)[:, k]) for order in (1, 2)
            )
            moments = when
            yield from _find_worst(
                "velocity",
                name,
                np.abs(plan.curve.rates[[0, -1], k]) - 1e-6,
                plan.times[[0, -1]],
                "no rest",
            )
        yield from _find_worst(
            "velocity", name, np.abs(speed) - 1.001 * fastest - 1e-9, moments, f"limit {fastest:g}"
        )
        yield from _find_worst(
            "acceleration", name, strength - 1.001 * strongest - 1e-9, when, f"limit {strongest:g}"
        )
    if world.robot.base in ("differential", "ackermann"):
        yield from _check_rolling(world)
    yield from _check_dwell(world)
    yield from check_openings(world)


def _check_rolling(world: World) -> Iterator[Violation]:
    """Check that wheels do not slip, exceed their speed, or turn more tightly than they can.

    Along a curve that is asked of velocities [m/s], at moments inside every cubic; otherwise of
    steps [m], of whose arc the chord points where the base heads half-way.
    """
    plan, robot = world.plan, world.robot
    if plan.curve is None:
        change, times, spans, much = (
            np.diff(plan.positions[:, :3], axis=0),
            plan.times,
            np.diff(plan.times),
            1e-4,
        )
        heading = plan.positions[:-1, 2] + change[:, 2] / 2
    else:
        inside = plan.curve.inside(24)
        number, times = np.repeat(np.arange(len(inside)), inside.shape[1]), inside.ravel()
        change, spans, much = plan.curve.derivative(times, 1, number)[:, :3], 1.0, 1e-3
        heading = plan.curve.derivative(times, 0, number)[:, 2]
    seen = np.exp(-1j * heading) * (change[:, 0] + 1j * change[:, 1])  # as the base sees it
    turn = np.abs(change[:, 2])
    yield from _find_worst("slip", "base", np.abs(seen.imag) - much, times, "moves sideways")
    if robot.base == "ackermann":
        short = robot.turning_radius * turn - np.abs(seen.real)
        yield from _find_worst(
            "turning", "base", short - much, times, f"turns tighter than {robot.turning_radius:g} m"
        )
    if robot.wheels is not None:
        track, fastest = robot.wheels["track"], robot.wheels["radius"] * robot.wheels["speed"]
        rims = [np.abs(seen.real + side * track / 2 * turn) / spans for side in (-1, 1)]
        yield from _find_worst(
            "wheels",
            "base",
            np.max(rims, axis=0) - 1.001 * fastest,
            times,
            f"limit {fastest:g} m/s",
        )


def _find_worst(
    rule: str, subject: str, excess: np.ndarray, times: np.ndarray, detail: str
) -> Iterator[Violation]:
    k = int(np.argmax(excess))
    if not excess[k] <= 0.0:
        yield Violation(rule, subject, float(times[k]), float(excess[k]), detail)


def _get_limits(world: World, name: str) -> tuple[float, float, float, float]:
    owner, _, own = name.partition(".")
    if not own:
        low, high, fastest, strongest = world.robot.limits[name]
        if name.startswith("base_") and world.robot.base == "fixed":
            low = high = world.start[name]
        elif name in ("base_x", "base_y"):
            first = 0 if name == "base_x" else 2
            low, high = max(low, world.arena[first]), min(high, world.arena[first + 1])
        return low, high, fastest, strongest
    obj = world.objects[owner]
    if own in obj.limits:
        return obj.limits[own]
    low, high = next(f[3:] for grasp in obj.grasps.values() for f in grasp.freedoms if f[0] == own)
    return low, high, np.inf, np.inf


def _check_dwell(world: World) -> Iterator[Violation]:
    """Check that all rests for `grasp_time` where a hand closes or opens during the motion."""
    plan, still = world.plan, world.is_resting
    for one, other in zip(plan.phases, plan.phases[1:], strict=False):
        opens = one.opening != other.opening
        if set(one.holds) == set(other.holds) and not opens:
            continue
        first = last = one.last
        while first > 0 and still[first - 1] and not opens:  # fingers move from here on
            first -= 1
        while last < len(still) and still[last]:
            last += 1
        rest = plan.times[last] - plan.times[first]
        short = float(plan.options["grasp_time"] - rest)
        if short > 1e-9:
            what = (
                ", ".join(sorted(hold.object for hold in set(one.holds) ^ set(other.holds)))
                or "gripper"
            )
            yield Violation(
                "dwell",
                what,
                float(plan.times[one.last]),
                short,
                f"rests for {rest:.3f} s while the hand moves",
            )


def check_stage(world: World, stage: Stage) -> Iterator[Violation]:
    """Check the rules that also concern samples between waypoints."""
    yield from _check_unheld(world, stage)
    yield from _check_latches(world, stage)
    for hold in stage.phase.holds:
        yield from _check_closure(world, stage, hold)
        yield from _check_push(world, stage, hold)
        grasp = world.grasp(hold)
        for name, *_ in grasp.freedoms if grasp.firm else ():
            column = stage.columns[:, world.plan.names.index(f"{hold.object}.{name}")]
            yield from _find_worst(
                "slide",
                f"{hold.object}.{name}",
                np.abs(column - column[0]) - STILL,
                stage.times,
                "firm grasp",
            )
    for name, (owner, link) in stage.riding.items():
        turn = stage.links[name, world.objects[name].tree.urdf.base].turn
        lean = np.arccos(np.clip((turn @ stage.upright[name])[:, 2], -1.0, 1.0))
        yield from _find_worst(
            "tips", name, lean - TIP, stage.times, f"{owner}.{link} tilts under it"
        )


def _check_unheld(world: World, stage: Stage) -> Iterator[Violation]:
    """Joints of objects move only between the base link and a link that is held."""
    driven = set()
    for hold in stage.phase.holds:
        obj = world.objects[hold.object]
        driven |= {
            f"{hold.object}.{joint}"
            for joint in obj.tree.urdf.path_to(obj.grasps[hold.attachment].link)
        }
    for k, name in enumerate(world.plan.names):
        owner, _, own = name.partition(".")
        if own and own in world.objects[owner].limits and name not in driven:
            column = stage.columns[:, k]
            yield from _find_worst(
                "unheld",
                name,
                np.abs(column - column[0]) - STILL,
                stage.times,
                f"moves in '{stage.phase.name}'",
            )


def _check_latches(world: World, stage: Stage) -> Iterator[Violation]:
    """A latched joint goes away from where it is held only while the release is far enough."""
    for owner, obj in world.objects.items():
        for latch in obj.latches:
            indices = [
                world.plan.index(f"{owner}.{latch[key]}") for key in ("joint", "released_by")
            ]
            if indices[0] is None:
                continue
            off = np.abs(stage.columns[:, indices[0]] - latch["held_at"])
            resting = np.full(len(off), obj.state[latch["released_by"]])
            release = resting if indices[1] is None else stage.columns[:, indices[1]]
            side = np.sign(stage.columns[:, indices[0]] - latch["held_at"])
            leaves = ((np.diff(off) > 1e-12) | (side[1:] * side[:-1] < 0)) & (off[1:] > 1e-4)
            leaves &= np.minimum(off[:-1], off[1:]) <= latch["engaged_within"]
            short = np.where(
                leaves, latch["threshold"] - 1e-4 - np.minimum(release[:-1], release[1:]), -1.0
            )
            yield from _find_worst(
                "latch",
                f"{owner}.{latch['joint']}",
                short,
                stage.times,
                f"needs {latch['released_by']}",
            )


def _check_push(world: World, stage: Stage, hold: Hold) -> Iterator[Violation]:
    """Check that a pushed link stays ahead of the hand at the contact, up to rounding."""
    grasp = world.grasp(hold)
    if not grasp.pushed:
        return
    size, link = len(stage.times), stage.links[hold.object, grasp.link]
    turns, middles = np.broadcast_to(link.turn, (size, 3, 3)), np.broadcast_to(link.at, (size, 3))
    touched = (
        stage.tool @ world.front(grasp.opening) @ make_pose((0.0, 0.0, grasp.standoff))
    ).at  # in the world
    in_link = np.einsum("kji,kj->ki", turns, touched - middles)
    later = np.einsum("kij,kj->ki", turns[1:], in_link[:-1]) + middles[1:]
    into = (turns @ grasp.place.turn[0])[:-1, :, 2]
    ahead = np.concatenate([[0.0], np.cumsum(np.einsum("ki,ki->k", into, later - touched[:-1]))])
    yield from _find_worst(
        "push",
        f"{hold.object}.{hold.attachment}",
        np.maximum.accumulate(ahead) - ahead - BACK,
        stage.times,
        "pulls",
    )


def _check_closure(world: World, stage: Stage, hold: Hold) -> Iterator[Violation]:
    """The tool, or what takes its place, is where the attachment has it."""
    grasp, obj = world.grasp(hold), world.objects[hold.object]
    times, columns = stage.times, stage.columns
    tool, link = stage.tool, stage.links[hold.object, grasp.link]
    if (
        hold.by is None and not obj.free
    ):  # nothing but the joints moves it: as finely as the curve may bend
        robot = world.robot
        times, columns, _, _ = world.samples(stage.number, FINE, FINE)
        arm = {name: columns[:, 3 + k] for k, name in enumerate(robot.arm)}
        tool = robot.tree.links({**robot.locked, **robot.moved(arm)}, columns[:, :3], [robot.tool])[
            robot.tool
        ]
        link = obj.at @ world.links_of(obj, columns)[grasp.link]
    holder = tool @ world.front(grasp.opening) if grasp.pushed else tool
    if hold.by is not None:
        owner, _, own = hold.by.partition(".")
        holder = stage.links[owner, own]
    right = link @ grasp.tool(world.freedoms(hold, columns))
    size = len(times)
    off = np.broadcast_to(np.linalg.norm(holder.at - right.at, axis=1), size)
    turned = np.broadcast_to(compute_angle(holder.turn, right.turn), size)
    limit = 1e-3
    for amount, unit in ((off, "m"), (turned, "rad")):
        subject, why = f"{hold.object}.{hold.attachment}", f"more than {limit:g} {unit}"
        yield from _find_worst("closure", subject, amount - limit - 1e-7, times, why)
