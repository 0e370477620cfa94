"""Checks start, limits, rates, wheels, dwell times, latches and grasps of a motion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .gripper import check_openings
from .plan import Hold, Violation
from .poses import compute_angle, make_pose
from .stage import Stage, World

__all__ = ["check_motion", "check_stage"]

MAX_TILT = 0.1  # [rad] of a supported object
RETREAT = 1e-4  # [m] retreat of a pushed link
STILL = 1e-5  # [m] or [rad] of a joint at rest
FINE = 5e-4  # [m] and [rad] between samples of a grasp


def check_motion(world: World) -> Iterator[Violation]:
    """Check the rules that do not depend on a phase."""
    plan = world.plan
    samples = plan.sample_coordinates()
    for k, name in enumerate(plan.names):
        column = plan.positions[:, k]
        if name in world.start and (error := abs(column[0] - world.start[name])) > 1e-9:
            yield Violation(
                "start", name, 0.0, error, f"{column[0]:.6g} instead of {world.start[name]:.6g}"
            )
        low, high, max_velocity, max_acceleration = _get_limits(world, name)
        outside = np.maximum(low - samples[:, k], samples[:, k] - high)
        at_start = max(low - column[0], column[0] - high)
        if 0.0 < at_start <= 1e-2 + 1e-9:  # a robot may start slightly outside, and come back
            inside = np.flatnonzero(outside <= 0.0)
            outside[: inside[0] if len(inside) else None] -= at_start
        yield from _find_worst(
            "limit", name, outside - 1e-5, np.zeros(len(outside)), f"limits {low:.4g} to {high:.4g}"
        )
        begin = world.start_velocity.get(name, 0.0)
        end = _get_end_velocity(world, name)
        # objects in the hand move with it, which the rules of grasps judge
        owners = {hold.object for hold in world.held} if any(world.start_velocity.values()) else ()
        is_in_hand = name.partition(".")[0] in owners
        if plan.curve is None:
            spans = np.diff(plan.times)
            velocity = np.diff(column) / spans
            before = velocity[0] if is_in_hand else begin
            change = np.abs(np.diff(np.concatenate([[before], velocity, [end]])))
            shorter = np.minimum(np.append(spans, np.inf), np.append(np.inf, spans))
            acceleration = change / shorter
            acceleration_times = plan.times
            velocity_times = plan.times
        else:
            inside = plan.curve.sample_times(8)
            number = np.repeat(np.arange(len(inside)), inside.shape[1])
            acceleration_times = inside.ravel()
            velocity, acceleration = (
                np.abs(plan.curve.evaluate(acceleration_times, order, number)[:, k])
                for order in (1, 2)
            )
            velocity_times = acceleration_times
            first, last = plan.curve.velocities[[0, -1], k]
            before = first if is_in_hand else begin
            yield from _find_worst(
                "velocity",
                name,
                np.array([abs(first - before), abs(last - end)]) - 1e-6,
                plan.times[[0, -1]],
                f"begins with {before:g} and ends with {end:g}",
            )
        yield from _find_worst(
            "velocity",
            name,
            np.abs(velocity) - 1.001 * max_velocity - 1e-9,
            velocity_times,
            f"limit {max_velocity:g}",
        )
        yield from _find_worst(
            "acceleration",
            name,
            acceleration - 1.001 * max_acceleration - 1e-9,
            acceleration_times,
            f"limit {max_acceleration:g}",
        )
    if world.robot.base in ("differential", "ackermann"):
        yield from _check_rolling(world)
    yield from _check_dwell(world)
    yield from check_openings(world)


def _check_rolling(world: World) -> Iterator[Violation]:
    """Check that wheels do not slip, exceed their speed, or turn below the turning radius.

    On a curve, velocities [m/s] are checked at samples of every cubic. Otherwise steps [m] are
    checked, as chords of arcs, which have the mean heading of the base.
    """
    plan, robot = world.plan, world.robot
    if plan.curve is None:
        change = np.diff(plan.positions[:, :3], axis=0)
        times = plan.times
        spans = np.diff(plan.times)
        tolerance = 1e-4
        heading = plan.positions[:-1, 2] + change[:, 2] / 2
    else:
        inside = plan.curve.sample_times(24)
        number, times = np.repeat(np.arange(len(inside)), inside.shape[1]), inside.ravel()
        change, spans, tolerance = plan.curve.evaluate(times, 1, number)[:, :3], 1.0, 1e-3
        heading = plan.curve.evaluate(times, 0, number)[:, 2]
    local_change = np.exp(-1j * heading) * (change[:, 0] + 1j * change[:, 1])
    turn = np.abs(change[:, 2])
    yield from _find_worst(
        "slip", "base", np.abs(local_change.imag) - tolerance, times, "moves sideways"
    )
    if robot.base == "ackermann":
        shortfall = robot.turning_radius * turn - np.abs(local_change.real)
        yield from _find_worst(
            "turning",
            "base",
            shortfall - tolerance,
            times,
            f"turns tighter than {robot.turning_radius:g} m",
        )
    if robot.wheels is not None:
        track, max_speed = robot.wheels["track"], robot.wheels["radius"] * robot.wheels["speed"]
        wheel_speeds = [
            np.abs(local_change.real + side * track / 2 * turn) / spans for side in (-1, 1)
        ]
        yield from _find_worst(
            "wheels",
            "base",
            np.max(wheel_speeds, axis=0) - 1.001 * max_speed,
            times,
            f"limit {max_speed:g} m/s",
        )


def _find_worst(
    rule: str, subject: str, excess: np.ndarray, times: np.ndarray, detail: str
) -> Iterator[Violation]:
    k = int(np.argmax(excess))
    if not excess[k] <= 0.0:
        yield Violation(rule, subject, float(times[k]), float(excess[k]), detail)


def _get_limits(world: World, name: str) -> tuple[float, float, float, float]:
    owner, _, coordinate = name.partition(".")
    if not coordinate:
        low, high, velocity, acceleration = world.robot.limits[name]
        if name.startswith("base_") and world.robot.base == "fixed":
            low = high = world.start[name]
        elif name in ("base_x", "base_y"):
            first = 0 if name == "base_x" else 2
            low, high = max(low, world.arena[first]), min(high, world.arena[first + 1])
        return low, high, velocity, acceleration
    obj = world.objects[owner]
    if coordinate in obj.limits:
        return obj.limits[coordinate]
    low, high = next(
        f[3:] for grasp in obj.grasps.values() for f in grasp.freedoms if f[0] == coordinate
    )
    return low, high, np.inf, np.inf


def _check_dwell(world: World) -> Iterator[Violation]:
    """Check that the motion rests for `grasp_time` while the hand closes or opens."""
    plan, resting = world.plan, world.is_resting
    for phase, next_phase in zip(plan.phases, plan.phases[1:], strict=False):
        opening_changes = phase.opening != next_phase.opening
        if set(phase.holds) == set(next_phase.holds) and not opening_changes:
            continue
        first = last = phase.last
        while first > 0 and resting[first - 1] and not opening_changes:  # fingers move from here
            first -= 1
        while last < len(resting) and resting[last]:
            last += 1
        rest = plan.times[last] - plan.times[first]
        shortfall = float(plan.options["grasp_time"] - rest)
        if shortfall > 1e-9:
            subject = (
                ", ".join(sorted(hold.object for hold in set(phase.holds) ^ set(next_phase.holds)))
                or "gripper"
            )
            yield Violation(
                "dwell",
                subject,
                float(plan.times[phase.last]),
                shortfall,
                f"rests for {rest:.3f} s while the hand moves",
            )


def _get_end_velocity(world: World, name: str) -> float:
    """Return the velocity with which the last step asks a coordinate to end; 0: at rest."""
    for joint, value in world.plan.steps[-1].get("velocities", {}).items():
        leader, factor, _ = world.robot.coupled.get(joint, (joint, 1.0, 0.0))
        if leader == name:
            return float(value / factor)
    return 0.0


def check_stage(world: World, stage: Stage) -> Iterator[Violation]:
    """Check the rules at the samples of a phase."""
    yield from _check_unheld(world, stage)
    yield from _check_latches(world, stage)
    for hold in stage.phase.holds:
        yield from _check_closure(world, stage, hold)
        yield from _check_push(world, stage, hold)
        grasp = world.get_grasp(hold)
        for name, *_ in grasp.freedoms if grasp.firm else ():
            column = stage.columns[:, world.plan.names.index(f"{hold.object}.{name}")]
            yield from _find_worst(
                "slide",
                f"{hold.object}.{name}",
                np.abs(column - column[0]) - STILL,
                stage.times,
                "firm grasp",
            )
    for name, (owner, link) in stage.supports.items():
        turn = stage.links[name, world.objects[name].tree.urdf.base].rotation
        tilt = np.arccos(np.clip((turn @ stage.verticals[name])[:, 2], -1.0, 1.0))
        yield from _find_worst(
            "tips", name, tilt - MAX_TILT, stage.times, f"{owner}.{link} tilts under it"
        )


def _check_unheld(world: World, stage: Stage) -> Iterator[Violation]:
    """Check that objects move only in joints between the base link and a grasped link."""
    movable = set()
    for hold in stage.phase.holds:
        obj = world.objects[hold.object]
        movable |= {
            f"{hold.object}.{joint}"
            for joint in obj.tree.urdf.find_joint_path(obj.grasps[hold.attachment].link)
        }
    for k, name in enumerate(world.plan.names):
        owner, _, coordinate = name.partition(".")
        if coordinate and coordinate in world.objects[owner].limits and name not in movable:
            column = stage.columns[:, k]
            yield from _find_worst(
                "unheld",
                name,
                np.abs(column - column[0]) - STILL,
                stage.times,
                f"moves in '{stage.phase.name}'",
            )


def _check_latches(world: World, stage: Stage) -> Iterator[Violation]:
    """Check that a latched joint leaves its latched position only while the latch is released."""
    for owner, obj in world.objects.items():
        for latch in obj.latches:
            indices = [
                world.plan.find_index(f"{owner}.{latch[key]}") for key in ("joint", "released_by")
            ]
            if indices[0] is None:
                continue
            distance = np.abs(stage.columns[:, indices[0]] - latch["held_at"])
            constant = np.full(len(distance), obj.state[latch["released_by"]])
            release = constant if indices[1] is None else stage.columns[:, indices[1]]
            side = np.sign(stage.columns[:, indices[0]] - latch["held_at"])
            leaves = ((np.diff(distance) > 1e-12) | (side[1:] * side[:-1] < 0)) & (
                distance[1:] > 1e-4
            )
            leaves &= np.minimum(distance[:-1], distance[1:]) <= latch["engaged_within"]
            shortfall = np.where(
                leaves, latch["threshold"] - 1e-4 - np.minimum(release[:-1], release[1:]), -1.0
            )
            yield from _find_worst(
                "latch",
                f"{owner}.{latch['joint']}",
                shortfall,
                stage.times,
                f"needs {latch['released_by']}",
            )


def _check_push(world: World, stage: Stage, hold: Hold) -> Iterator[Violation]:
    """Check that the hand only pushes a link, and never pulls it, up to rounding."""
    grasp = world.get_grasp(hold)
    if not grasp.pushed:
        return
    size, link = len(stage.times), stage.links[hold.object, grasp.link]
    rotations = np.broadcast_to(link.rotation, (size, 3, 3))
    origins = np.broadcast_to(link.translation, (size, 3))
    contacts = (
        stage.tool @ world.compute_front(grasp.opening) @ make_pose((0.0, 0.0, grasp.standoff))
    ).translation  # in the world
    local_contacts = np.einsum("kji,kj->ki", rotations, contacts - origins)
    moved_contacts = np.einsum("kij,kj->ki", rotations[1:], local_contacts[:-1]) + origins[1:]
    directions = (rotations @ grasp.placement.rotation[0])[:-1, :, 2]
    advance = np.concatenate(
        [[0.0], np.cumsum(np.einsum("ki,ki->k", directions, moved_contacts - contacts[:-1]))]
    )
    yield from _find_worst(
        "push",
        f"{hold.object}.{hold.attachment}",
        np.maximum.accumulate(advance) - advance - RETREAT,
        stage.times,
        "pulls",
    )


def _check_closure(world: World, stage: Stage, hold: Hold) -> Iterator[Violation]:
    """Check that the tool or holding link has the pose of the attachment."""
    grasp, obj = world.get_grasp(hold), world.objects[hold.object]
    times, columns = stage.times, stage.columns
    tool, link = stage.tool, stage.links[hold.object, grasp.link]
    if hold.by is None and not obj.free:  # a closed chain needs finer samples
        robot = world.robot
        times, columns, _, _ = world.sample_phase(stage.number, FINE, FINE)
        arm = {name: columns[:, 3 + k] for k, name in enumerate(robot.arm)}
        tool = robot.tree.compute_links(
            {**robot.locked, **robot.compute_joint_values(arm)}, columns[:, :3], [robot.tool]
        )[robot.tool]
        link = obj.placement @ world.compute_object_links(obj, columns)[grasp.link]
    holder = tool @ world.compute_front(grasp.opening) if grasp.pushed else tool
    if hold.by is not None:
        owner, _, holder_link = hold.by.partition(".")
        holder = stage.links[owner, holder_link]
    target = link @ grasp.compute_tool(world.get_freedoms(hold, columns))
    size = len(times)
    distance = np.broadcast_to(
        np.linalg.norm(holder.translation - target.translation, axis=1), size
    )
    angle = np.broadcast_to(compute_angle(holder.rotation, target.rotation), size)
    limit = 1e-3
    for amount, unit in ((distance, "m"), (angle, "rad")):
        subject, detail = f"{hold.object}.{hold.attachment}", f"more than {limit:g} {unit}"
        yield from _find_worst("closure", subject, amount - limit - 1e-7, times, detail)
