"""Computes torques of the arm from the accelerations of all bodies, by central differences.

A joint's torque is the work that the forces on all bodies do when that joint alone moves a little
(virtual work). Nothing of rigid body algorithms is used: only where links are.
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
GRIP = 0.1  # [m] lever by which a torque of the hand counts as a force
EXCESS = 0.01  # of a limit
STILL = 1e-6
_SHARES, _STEP = (
    np.array([0.03, 0.5, 0.97]),
    0.025,
)  # where in a cubic, and how far apart three places are, as shares of it
_NUDGE = 1e-6  # [m] or [rad]


class Body(NamedTuple):
    """A body fixed to a link: mass [kg], centre in the link's frame [m], inertia [kg·m²]."""

    link: str
    mass: float
    centre: np.ndarray
    inertia: np.ndarray


Places = Callable[[np.ndarray], Mapping[str, Poses]]  # coordinates, shape (S, n) → links


def check_motors(world: World, stage: Stage) -> Iterator[Violation]:
    """Check that no motor of the arm exceeds its torque limit."""
    plan, robot = world.plan, world.robot
    bodies = [
        Body(link, *robot.tree.urdf.weight(link))
        for link, joints in robot.moved_by.items()
        if joints
    ]
    bodies = [body for body in bodies if body.mass > 0.0]
    limits = np.array([robot.efforts[joint] for joint in robot.arm])
    if plan.curve is None or not bodies or not (limits > 0.0).any():
        return
    knots = plan.curve.times
    begin, end = (float(plan.times[k]) for k in (stage.phase.first, stage.phase.last))
    cubics = np.flatnonzero((knots[:-1] >= begin - 1e-12) & (knots[1:] <= end + 1e-12))
    spans = np.diff(knots)[cubics]
    moments = (knots[cubics, None] + spans[:, None] * _SHARES).ravel()
    h = np.repeat(_STEP * spans, len(_SHARES))
    rows = [plan.evaluate(moments + k * h) for k in (-1, 0, 1)]

    known: dict[bytes, Mapping[str, Poses]] = {}

    def places(columns: np.ndarray) -> Mapping[str, Poses]:
        key = columns.tobytes()
        if key not in known:
            known[key] = find_links(columns)
        return known[key]

    def find_links(columns: np.ndarray) -> Mapping[str, Poses]:
        arm = {name: columns[:, 3 + k] for k, name in enumerate(robot.arm)}
        wanted = sorted({body.link for body in bodies} | {robot.tool})
        return robot.tree.links({**robot.locked, **arm}, columns[:, :3], wanted)

    loads = bodies + [Body(robot.tool, *weight) for weight in _find_payloads(world, stage)]
    arm = list(range(3, 3 + len(robot.arm)))
    torques = _compute_forces(places, loads, rows, h, arm, GRAVITY)
    for hold in stage.phase.holds:
        obj = world.objects[hold.object]
        if not obj.free and obj.limits:
            pulls, where = _compute_pull(world, stage, obj, world.grasp(hold), rows, h)
            local = places(rows[1])[robot.tool]
            inside = np.einsum(
                "kji,kj->ki", np.broadcast_to(local.turn, (len(h), 3, 3)), where - local.at
            )
            for k, column in enumerate(arm):
                shift, turn = _differentiate_points(places, rows[1], column, robot.tool, inside)
                torques[:, k] += np.einsum("ki,ki->k", pulls[:, :3], shift) + np.einsum(
                    "ki,ki->k", pulls[:, 3:], turn
                )
    for k, joint in enumerate(robot.arm):
        worst = int(np.argmax(np.abs(torques[:, k])))
        over = abs(torques[worst, k]) - (1.0 + EXCESS) * limits[k]
        if limits[k] > 0.0 and over > 0.0 and _can_carry(world, bodies, places, arm[k], limits[k]):
            yield Violation(
                "torque",
                joint,
                float(moments[worst]),
                float(over),
                f"{torques[worst, k]:.4g} of {limits[k]:g}",
            )


def _compute_forces(
    places: Places,
    bodies: list[Body],
    rows: list[np.ndarray],
    h: np.ndarray,
    columns: list[int],
    gravity: np.ndarray,
) -> np.ndarray:
    """Return the generalized forces for which bodies move as they do, shape (S, k)."""
    before, now, after = (places(part) for part in rows)
    found = np.zeros((len(h), len(columns)))
    nudges = [
        (places(_shift_column(rows[1], c, _NUDGE)), places(_shift_column(rows[1], c, -_NUDGE)))
        for c in columns
    ]
    for body in bodies:
        x = [frames[body.link].points(body.centre) for frames in (before, now, after)]
        pulled = body.mass * ((x[0] - 2.0 * x[1] + x[2]) / h[:, None] ** 2 - gravity)
        turns = [
            np.broadcast_to(frames[body.link].turn, (len(h), 3, 3))
            for frames in (before, now, after)
        ]
        spins = [
            _compute_rotation_vector(turns[i + 1] @ turns[i].transpose(0, 2, 1)) / h[:, None]
            for i in (0, 1)
        ]
        half = [_interpolate_rotations(turns[i], turns[i + 1]) for i in (0, 1)]
        momenta = [
            np.einsum("kij,kj->ki", t @ body.inertia @ t.transpose(0, 2, 1), w)
            for t, w in zip(half, spins, strict=True)
        ]
        twisted = (momenta[1] - momenta[0]) / h[:, None]
        for k, (more, less) in enumerate(nudges):
            shift = (more[body.link].points(body.centre) - less[body.link].points(body.centre)) / (
                2.0 * _NUDGE
            )
            turn = _compute_rotation_vector(
                more[body.link].turn @ less[body.link].turn.transpose(0, 2, 1)
            ) / (2.0 * _NUDGE)
            found[:, k] += np.einsum("ki,ki->k", pulled, np.broadcast_to(shift, pulled.shape))
            found[:, k] += np.einsum("ki,ki->k", twisted, np.broadcast_to(turn, twisted.shape))
    return found


def _shift_column(columns: np.ndarray, column: int, by: float) -> np.ndarray:
    moved = columns.copy()
    moved[:, column] += by
    return moved


def _differentiate_points(
    places: Places, columns: np.ndarray, column: int, link: str, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives of points of a link, (S, 3) in its frame, and of its rotation."""
    more, less = (
        places(_shift_column(columns, column, sign * _NUDGE))[link] for sign in (1.0, -1.0)
    )
    ends = [
        np.einsum("kij,kj->ki", np.broadcast_to(p.turn, (len(inside), 3, 3)), inside) + p.at
        for p in (more, less)
    ]
    turn = _compute_rotation_vector(more.turn @ less.turn.transpose(0, 2, 1)) / (2.0 * _NUDGE)
    return (ends[0] - ends[1]) / (2.0 * _NUDGE), np.broadcast_to(turn, inside.shape)


def _compute_rotation_vector(turns: np.ndarray) -> np.ndarray:
    """Return small rotations as vectors, shape (S, 3)."""
    skew = np.stack(
        [
            turns[:, 2, 1] - turns[:, 1, 2],
            turns[:, 0, 2] - turns[:, 2, 0],
            turns[:, 1, 0] - turns[:, 0, 1],
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
    """Yield weights of carried objects in the tool's frame, at the start of the phase."""
    held = {hold.object for hold in stage.phase.holds if world.objects[hold.object].free}
    held |= {name for name, (owner, _) in stage.riding.items() if owner in held}
    for name in sorted(held):
        places = {
            link: stage.tool.row(0).inverse() @ place.row(0)
            for (owner, link), place in stage.links.items()
            if owner == name
        }
        yield from _find_weights(world.objects[name], places)


def _find_weights(
    obj: SceneObject, links: Mapping[str, Poses]
) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Yield the weights of an object's links, of which none is known by shape alone here."""
    own = {link: obj.tree.urdf.weight(link) for link in obj.tree.urdf.links}
    total = sum(mass for mass, _, _ in own.values())
    factor = 1.0 if obj.mass is None or not total > 0.0 else obj.mass / total
    for link, (mass, centre, inertia) in own.items():
        if mass > 0.0:
            turn = links[link].turn[0]
            yield factor * mass, links[link].points(centre)[0], factor * turn @ inertia @ turn.T


def _compute_pull(
    world: World,
    stage: Stage,
    obj: SceneObject,
    grasp: Grasp,
    rows: list[np.ndarray],
    h: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return least wrenches that move an object's joints, (S, 6), and the grasp's place, (S, 3)."""
    plan = world.plan
    names = list(obj.limits)

    def state(columns: np.ndarray) -> np.ndarray:
        known = [plan.index(f"{obj.name}.{joint}") for joint in names]
        return np.stack([np.full(len(columns), obj.state[j]) if k is None else columns[:, k]
                         for j, k in zip(names, known, strict=True)], axis=1)  # fmt: skip

    def places(values: np.ndarray) -> Mapping[str, Poses]:
        links = obj.tree.links(
            {j: values[:, k] for k, j in enumerate(names)}, None, obj.tree.urdf.links
        )
        return {link: obj.at @ place for link, place in links.items()}

    z = [state(part) for part in rows]
    own = [Body(link, *obj.tree.urdf.weight(link)) for link in obj.tree.urdf.links]
    asked = _compute_forces(places, own, z, h, list(range(len(names))), np.zeros(3))
    riders = []
    for name, (owner, link) in stage.riding.items():
        if owner != obj.name:
            continue
        for weight in _find_weights(
            world.objects[name],
            {
                part: stage.links[owner, link].row(0).inverse() @ place.row(0)
                for (one, part), place in stage.links.items()
                if one == name
            },
        ):
            riders.append(Body(link, *weight))
    asked += (
        _compute_forces(places, riders, z, h, list(range(len(names))), GRAVITY) if riders else 0.0
    )
    speed, change = (z[2] - z[0]) / (2.0 * h[:, None]), (z[0] - 2.0 * z[1] + z[2]) / h[:, None] ** 2
    bolts = {latch["joint"]: latch["held_at"] for latch in obj.latches}
    for k, joint in enumerate(names):
        own_terms, moving = (
            obj.resists[joint],
            np.where(np.abs(speed[:, k]) > STILL, speed[:, k], 0.0),
        )
        asked[:, k] += own_terms["stiffness"] * (z[1][:, k] - own_terms["springref"])
        asked[:, k] += own_terms["damping"] * moving + own_terms["friction"] * np.sign(moving)
        low, high = obj.limits[joint][:2]
        stopped = (z[1][:, k] <= low + STILL) & (asked[:, k] > 0.0) | (
            z[1][:, k] >= high - STILL
        ) & (asked[:, k] < 0.0)
        stopped |= np.abs(z[1][:, k] - bolts.get(joint, np.inf)) <= STILL
        asked[stopped & (moving == 0.0) & (np.abs(change[:, k]) <= 1e-5), k] = 0.0
    index = {f: plan.index(f"{obj.name}.{f}") for f, *_ in grasp.freedoms}
    values = {f: np.zeros(len(h)) if k is None else rows[1][:, k] for f, k in index.items()}
    link = places(z[1])[grasp.link]
    tool = link @ grasp.tool(values)
    where = np.broadcast_to(tool.at, (len(h), 3))
    inside = np.broadcast_to(grasp.tool(values).at, (len(h), 3))
    path = [k for k, joint in enumerate(names) if joint in obj.tree.urdf.path_to(grasp.link)]
    ways = [np.hstack(_differentiate_points(places, z[1], k, grasp.link, inside)) for k in path]
    wants = [asked[:, k] for k in path]
    if grasp.pushed:
        normal = np.broadcast_to((link.turn @ grasp.place.turn)[:, :, 2], (len(h), 3))
        along = np.stack([np.einsum("ki,ki->k", way[:, :3], normal) for way in ways], axis=1)
        size = np.einsum("ki,ki->k", along, np.stack(wants, axis=1)) / np.maximum(
            (along**2).sum(axis=1), 1e-12
        )
        return np.hstack([size[:, None] * normal, np.zeros((len(h), 3))]), where
    for freedom in () if grasp.firm else values:
        ends = [
            link @ grasp.tool({**values, freedom: values[freedom] + sign * _NUDGE})
            for sign in (1.0, -1.0)
        ]
        shift = (ends[0].at - ends[1].at) / (2.0 * _NUDGE)
        turn = _compute_rotation_vector(ends[0].turn @ ends[1].turn.transpose(0, 2, 1)) / (
            2.0 * _NUDGE
        )
        ways.append(np.hstack([np.broadcast_to(part, (len(h), 3)) for part in (shift, turn)]))
        wants.append(np.zeros(len(h)))
    costs = np.diag([1.0] * 3 + [GRIP**-2] * 3)
    size = 6 + len(ways)
    system, right = np.zeros((len(h), size, size)), np.zeros((len(h), size))
    system[:, :6, :6] = costs
    for k, (way, want) in enumerate(zip(ways, wants, strict=True)):
        system[:, 6 + k, :6] = system[:, :6, 6 + k] = way
        right[:, 6 + k] = want
    return np.stack(
        [np.linalg.lstsq(a, b, rcond=1e-12)[0][:6] for a, b in zip(system, right, strict=True)]
    ), where


def _can_carry(world: World, bodies: list[Body], places: Places, column: int, limit: float) -> bool:
    """Return whether a motor holds the arm everywhere; if not, its limit is a placeholder."""
    names = world.plan.names[: world.plan.robot_size]
    spans = [world.robot.limits[name][:2] for name in names]
    low, high = (np.clip([span[k] for span in spans], -np.pi, np.pi) for k in (0, 1))
    postures = np.random.default_rng(1).uniform(low, high, (200, len(names)))
    more, less = (places(_shift_column(postures, column, sign * _NUDGE)) for sign in (1.0, -1.0))
    lift = sum(
        body.mass
        * (more[body.link].points(body.centre) - less[body.link].points(body.centre))[:, 2]
        for body in bodies
    )
    return bool(np.abs(9.81 * lift / (2.0 * _NUDGE)).max() <= limit)
