"""Checks torques of the arm, from the accelerations of all bodies by central differences.

The torque of a joint is the virtual work of the forces on all bodies for a small motion of that
joint. The computation uses link poses alone, and no algorithms of rigid body dynamics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from .plan import Violation
from .poses import Poses
from .scene_objects import Grasp, SceneObject
from .stage import Stage, World

__all__ = ["check_motors"]

GRAVITY = np.array([0.0, 0.0, -9.81])
GRIP = 0.1  # [m] lever that converts torques of the hand to forces
EXCESS = 0.01  # relative excess over a limit
STILL = 1e-6
# Positions and step of the differences, relative to the duration of a cubic
_SHARES = np.array([0.03, 0.5, 0.97])
_STEP = 0.025
_NUDGE = 1e-6  # [m] or [rad]


class Body(NamedTuple):
    """A body fixed to a link: mass [kg], centre in the link's frame [m], inertia [kg·m²]."""

    link: str
    mass: float
    centre: np.ndarray
    inertia: np.ndarray


LinkPoses = Callable[[np.ndarray], Mapping[str, Poses]]  # coordinates (S, n) → poses of links


def check_motors(world: World, stage: Stage) -> Iterator[Violation]:
    """Check the torque limits of the arm."""
    plan, robot = world.plan, world.robot
    bodies = [
        Body(link, *robot.tree.urdf.get_inertial(link))
        for link, joints in robot.planned_joints.items()
        if joints
    ]
    bodies = [body for body in bodies if body.mass > 0.0]
    limits = np.array([robot.torque_limits[joint] for joint in robot.arm])
    if plan.curve is None or not bodies or not (limits > 0.0).any():
        return
    knots = plan.curve.times
    begin, end = (float(plan.times[k]) for k in (stage.phase.first, stage.phase.last))
    cubics = np.flatnonzero((knots[:-1] >= begin - 1e-12) & (knots[1:] <= end + 1e-12))
    spans = np.diff(knots)[cubics]
    times = (knots[cubics, None] + spans[:, None] * _SHARES).ravel()
    h = np.repeat(_STEP * spans, len(_SHARES))
    rows = [plan.evaluate(times + k * h) for k in (-1, 0, 1)]

    cache: dict[bytes, Mapping[str, Poses]] = {}

    def compute_links(columns: np.ndarray) -> Mapping[str, Poses]:
        key = columns.tobytes()
        if key not in cache:
            cache[key] = compute_link_poses(columns)
        return cache[key]

    def compute_link_poses(columns: np.ndarray) -> Mapping[str, Poses]:
        arm = {name: columns[:, 3 + k] for k, name in enumerate(robot.arm)}
        names = sorted({body.link for body in bodies} | {robot.tool})
        joints = {**robot.locked, **robot.compute_joint_values(arm)}
        return robot.tree.compute_links(joints, columns[:, :3], names)

    loads = bodies + [Body(robot.tool, *inertia) for inertia in _find_payloads(world, stage)]
    arm = list(range(3, 3 + len(robot.arm)))
    torques = _compute_forces(compute_links, loads, rows, h, arm, GRAVITY)
    for hold in stage.phase.holds:
        obj = world.objects[hold.object]
        if not obj.free and obj.limits:
            wrenches, grasp_points = _compute_wrenches(
                world, stage, obj, world.get_grasp(hold), rows, h
            )
            tool = compute_links(rows[1])[robot.tool]
            local_points = np.einsum(
                "kji,kj->ki",
                np.broadcast_to(tool.rotation, (len(h), 3, 3)),
                grasp_points - tool.translation,
            )
            for k, column in enumerate(arm):
                shift, turn = _differentiate_points(
                    compute_links, rows[1], column, robot.tool, local_points
                )
                torques[:, k] += np.einsum("ki,ki->k", wrenches[:, :3], shift) + np.einsum(
                    "ki,ki->k", wrenches[:, 3:], turn
                )
    for k, joint in enumerate(robot.arm):
        worst = int(np.argmax(np.abs(torques[:, k])))
        excess = abs(torques[worst, k]) - (1.0 + EXCESS) * limits[k]
        if (
            limits[k] > 0.0
            and excess > 0.0
            and _can_carry(world, bodies, compute_links, arm[k], limits[k])
        ):
            yield Violation(
                "torque",
                joint,
                float(times[worst]),
                float(excess),
                f"{torques[worst, k]:.4g} of {limits[k]:g}",
            )


def _compute_forces(
    compute_links: LinkPoses,
    bodies: list[Body],
    rows: list[np.ndarray],
    h: np.ndarray,
    columns: list[int],
    gravity: np.ndarray,
) -> np.ndarray:
    """Return the generalized forces of the motion of bodies, shape (S, k)."""
    before, now, after = (compute_links(part) for part in rows)
    forces = np.zeros((len(h), len(columns)))
    nudges = [
        (
            compute_links(_shift_column(rows[1], c, _NUDGE)),
            compute_links(_shift_column(rows[1], c, -_NUDGE)),
        )
        for c in columns
    ]
    for body in bodies:
        x = [frames[body.link].transform_point(body.centre) for frames in (before, now, after)]
        force = body.mass * ((x[0] - 2.0 * x[1] + x[2]) / h[:, None] ** 2 - gravity)
        rotations = [
            np.broadcast_to(frames[body.link].rotation, (len(h), 3, 3))
            for frames in (before, now, after)
        ]
        velocities = [
            _compute_rotation_vector(rotations[i + 1] @ rotations[i].transpose(0, 2, 1))
            / h[:, None]
            for i in (0, 1)
        ]
        mean_rotations = [_interpolate_rotations(rotations[i], rotations[i + 1]) for i in (0, 1)]
        momenta = [
            np.einsum("kij,kj->ki", t @ body.inertia @ t.transpose(0, 2, 1), w)
            for t, w in zip(mean_rotations, velocities, strict=True)
        ]
        moment = (momenta[1] - momenta[0]) / h[:, None]
        for k, (forward, backward) in enumerate(nudges):
            translation = (
                forward[body.link].transform_point(body.centre)
                - backward[body.link].transform_point(body.centre)
            ) / (2.0 * _NUDGE)
            rotation = _compute_rotation_vector(
                forward[body.link].rotation @ backward[body.link].rotation.transpose(0, 2, 1)
            ) / (2.0 * _NUDGE)
            forces[:, k] += np.einsum("ki,ki->k", force, np.broadcast_to(translation, force.shape))
            forces[:, k] += np.einsum("ki,ki->k", moment, np.broadcast_to(rotation, moment.shape))
    return forces


def _shift_column(columns: np.ndarray, column: int, shift: float) -> np.ndarray:
    shifted = columns.copy()
    shifted[:, column] += shift
    return shifted


def _differentiate_points(
    compute_links: LinkPoses, columns: np.ndarray, column: int, link: str, local_points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of points of a link, (S, 3) in its frame, and of its rotation."""
    forward, backward = (
        compute_links(_shift_column(columns, column, sign * _NUDGE))[link] for sign in (1.0, -1.0)
    )
    ends = [
        np.einsum(
            "kij,kj->ki", np.broadcast_to(p.rotation, (len(local_points), 3, 3)), local_points
        )
        + p.translation
        for p in (forward, backward)
    ]
    rotation = _compute_rotation_vector(forward.rotation @ backward.rotation.transpose(0, 2, 1)) / (
        2.0 * _NUDGE
    )
    return (ends[0] - ends[1]) / (2.0 * _NUDGE), np.broadcast_to(rotation, local_points.shape)


def _compute_rotation_vector(rotations: np.ndarray) -> np.ndarray:
    """Return the rotation vectors of small rotations, shape (S, 3)."""
    skew = np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        axis=1,
    )
    sine = 0.5 * np.linalg.norm(skew, axis=1, keepdims=True)
    return (
        0.5
        * skew
        * np.where(sine > 1e-9, np.arcsin(np.minimum(sine, 1.0)) / np.maximum(sine, 1e-12), 1.0)
    )


def _interpolate_rotations(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the rotations halfway between close rotations."""
    u, _, v = np.linalg.svd(one + other)
    return u @ v


def _find_payloads(world: World, stage: Stage) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Yield the inertias of attached objects in the tool's frame, at the start of the phase."""
    attached = {hold.object for hold in stage.phase.holds if world.objects[hold.object].free}
    attached |= {name for name, (owner, _) in stage.supports.items() if owner in attached}
    for name in sorted(attached):
        poses = {
            link: stage.tool.get_sample(0).inverse() @ place.get_sample(0)
            for (owner, link), place in stage.links.items()
            if owner == name
        }
        yield from _find_inertias(world.objects[name], poses)


def _find_inertias(
    obj: SceneObject, links: Mapping[str, Poses]
) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Yield mass, centre and inertia of an object's links, scaled to its mass."""
    inertias = {link: obj.tree.urdf.get_inertial(link) for link in obj.tree.urdf.links}
    total = sum(mass for mass, _, _ in inertias.values())
    factor = 1.0 if obj.mass is None or not total > 0.0 else obj.mass / total
    for link, (mass, centre, inertia) in inertias.items():
        if mass > 0.0:
            rotation = links[link].rotation[0]
            yield (
                factor * mass,
                links[link].transform_point(centre)[0],
                factor * rotation @ inertia @ rotation.T,
            )


def _compute_wrenches(
    world: World,
    stage: Stage,
    obj: SceneObject,
    grasp: Grasp,
    rows: list[np.ndarray],
    h: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least wrenches that move an object's joints, (S, 6), and grasp points, (S, 3)."""
    plan = world.plan
    names = list(obj.limits)

    def find_joint_values(columns: np.ndarray) -> np.ndarray:
        indices = [plan.find_index(f"{obj.name}.{joint}") for joint in names]
        return np.stack([np.full(len(columns), obj.state[j]) if k is None else columns[:, k]
                         for j, k in zip(names, indices, strict=True)], axis=1)  # fmt: skip

    def compute_links(values: np.ndarray) -> Mapping[str, Poses]:
        links = obj.tree.compute_links(
            {j: values[:, k] for k, j in enumerate(names)}, None, obj.tree.urdf.links
        )
        return {link: obj.placement @ place for link, place in links.items()}

    joint_rows = [find_joint_values(part) for part in rows]
    bodies = [Body(link, *obj.tree.urdf.get_inertial(link)) for link in obj.tree.urdf.links]
    forces = _compute_forces(
        compute_links, bodies, joint_rows, h, list(range(len(names))), np.zeros(3)
    )
    supported = []
    for name, (owner, link) in stage.supports.items():
        if owner != obj.name:
            continue
        for inertia in _find_inertias(
            world.objects[name],
            {
                part: stage.links[owner, link].get_sample(0).inverse() @ place.get_sample(0)
                for (object_name, part), place in stage.links.items()
                if object_name == name
            },
        ):
            supported.append(Body(link, *inertia))
    forces += (
        _compute_forces(compute_links, supported, joint_rows, h, list(range(len(names))), GRAVITY)
        if supported
        else 0.0
    )
    velocity = (joint_rows[2] - joint_rows[0]) / (2.0 * h[:, None])
    acceleration = (joint_rows[0] - 2.0 * joint_rows[1] + joint_rows[2]) / h[:, None] ** 2
    latched = {latch["joint"]: latch["held_at"] for latch in obj.latches}
    for k, joint in enumerate(names):
        resistance = obj.resistances[joint]
        moving = np.where(np.abs(velocity[:, k]) > STILL, velocity[:, k], 0.0)
        forces[:, k] += resistance["stiffness"] * (joint_rows[1][:, k] - resistance["springref"])
        forces[:, k] += resistance["damping"] * moving + resistance["friction"] * np.sign(moving)
        low, high = obj.limits[joint][:2]
        stopped = (joint_rows[1][:, k] <= low + STILL) & (forces[:, k] > 0.0) | (
            joint_rows[1][:, k] >= high - STILL
        ) & (forces[:, k] < 0.0)
        stopped |= np.abs(joint_rows[1][:, k] - latched.get(joint, np.inf)) <= STILL
        forces[stopped & (moving == 0.0) & (np.abs(acceleration[:, k]) <= 1e-5), k] = 0.0
    index = {f: plan.find_index(f"{obj.name}.{f}") for f, *_ in grasp.freedoms}
    values = {f: np.zeros(len(h)) if k is None else rows[1][:, k] for f, k in index.items()}
    link = compute_links(joint_rows[1])[grasp.link]
    tool = link @ grasp.compute_tool(values)
    grasp_points = np.broadcast_to(tool.translation, (len(h), 3))
    local_points = np.broadcast_to(grasp.compute_tool(values).translation, (len(h), 3))
    path = [
        k for k, joint in enumerate(names) if joint in obj.tree.urdf.find_joint_path(grasp.link)
    ]
    directions = [
        np.hstack(_differentiate_points(compute_links, joint_rows[1], k, grasp.link, local_points))
        for k in path
    ]
    required = [forces[:, k] for k in path]
    if grasp.pushed:
        normal = np.broadcast_to((link.rotation @ grasp.placement.rotation)[:, :, 2], (len(h), 3))
        along = np.stack(
            [np.einsum("ki,ki->k", direction[:, :3], normal) for direction in directions], axis=1
        )
        size = np.einsum("ki,ki->k", along, np.stack(required, axis=1)) / np.maximum(
            (along**2).sum(axis=1), 1e-12
        )
        return np.hstack([size[:, None] * normal, np.zeros((len(h), 3))]), grasp_points
    for freedom in () if grasp.firm else values:
        ends = [
            link @ grasp.compute_tool({**values, freedom: values[freedom] + sign * _NUDGE})
            for sign in (1.0, -1.0)
        ]
        translation = (ends[0].translation - ends[1].translation) / (2.0 * _NUDGE)
        rotation = _compute_rotation_vector(
            ends[0].rotation @ ends[1].rotation.transpose(0, 2, 1)
        ) / (2.0 * _NUDGE)
        directions.append(
            np.hstack([np.broadcast_to(part, (len(h), 3)) for part in (translation, rotation)])
        )
        required.append(np.zeros(len(h)))
    weights = np.diag([1.0] * 3 + [GRIP**-2] * 3)
    size = 6 + len(directions)
    system, right_side = np.zeros((len(h), size, size)), np.zeros((len(h), size))
    system[:, :6, :6] = weights
    for k, (direction, value) in enumerate(zip(directions, required, strict=True)):
        system[:, 6 + k, :6] = system[:, :6, 6 + k] = direction
        right_side[:, 6 + k] = value
    return np.stack(
        [np.linalg.lstsq(a, b, rcond=1e-12)[0][:6] for a, b in zip(system, right_side, strict=True)]
    ), grasp_points


def _can_carry(
    world: World, bodies: list[Body], compute_links: LinkPoses, column: int, limit: float
) -> bool:
    """Return whether a motor holds the arm in all postures; if not, its limit is a placeholder."""
    names = world.plan.names[: world.plan.robot_size]
    spans = [world.robot.limits[name][:2] for name in names]
    low, high = (np.clip([span[k] for span in spans], -np.pi, np.pi) for k in (0, 1))
    postures = np.random.default_rng(1).uniform(low, high, (200, len(names)))
    forward, backward = (
        compute_links(_shift_column(postures, column, sign * _NUDGE)) for sign in (1.0, -1.0)
    )
    lifted = sum(
        body.mass
        * (
            forward[body.link].transform_point(body.centre)
            - backward[body.link].transform_point(body.centre)
        )[:, 2]
        for body in bodies
    )
    return bool(np.abs(9.81 * lifted / (2.0 * _NUDGE)).max() <= limit)
