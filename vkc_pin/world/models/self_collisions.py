"""Collision pairs of a robot's links: which need no check and how far others can get apart, by sampling; a home without overlaps.

The results are kept on disk, as they take up to a minute for large robots.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.disk_cache import record
from vkc_pin.world.files.srdf import Srdf
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.files.xml import quote
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_model import find_neighbours
from vkc_pin.world.models.shapes import LinkDistances, ShapeDistances

Pair = tuple[str, str]
Parts = list[tuple[int, int]]

__all__ = [
    "HOME_DISTANCE",
    "SelfCollisionAnalysis",
    "analyze_self_collisions",
    "apply_self_collision_analysis",
    "sample_allowed_pairs",
    "set_collision_pairs",
    "write_srdf",
]

_VERSION = 1  # of what is kept on disk: another one whenever the same robot would get other pairs
_SAMPLES = 20_000
# [m]: links that come no closer in any sample are not driven together; neighbours that are always
# closer are exempt
_MAX_DISTANCE = 0.05
# [m] as `Options.self_distance`: links that are that far apart do not count against a home
HOME_DISTANCE = 0.02
_DESCENT_STARTS, _DESCENT_STEPS = 4, 200  # how often and in how many steps the others are
_CONTACT_DISTANCE = 1e-3  # [m]: links that never get further apart touch; validation sees no less
_HOME_SEARCH_RADII, _HOME_SEARCH_SAMPLES = (
    (0.05, 0.1, 0.2, 0.4, 0.7, 1.0),
    100,
)  # a free home: shares of the joints' ranges, and postures in each


class SelfCollisionAnalysis(NamedTuple):
    """How a robot's links are to each other.

    Attributes:
        allowed: Pairs of links that need not be kept apart, each sorted, with the reason.
        tight: How far apart pairs are at most, or at home if that is less [m], of those that are
            never or not there 50 mm apart.
        home: Where the planned joints rest, shape (n - 3,).
    """

    allowed: dict[Pair, str]
    tight: dict[Pair, float]
    home: tuple[float, ...]


def set_collision_pairs(robot: Robot, allowed: Collection[Pair]) -> Robot:
    """Return `robot` with those of its links that move against each other as collision pairs, less the `allowed` ones.

    Args:
        robot: The robot; its own collision pairs play no part.
        allowed: Pairs of links that may touch, each sorted.
    """
    collision, shapes = pin.GeometryModel(), robot.collision.geometryObjects
    for shape in shapes:
        collision.addGeometryObject(shape)
    for first, second in itertools.combinations(range(len(shapes)), 2):
        links = tuple(sorted((robot.link_of(first), robot.link_of(second))))
        if shapes[first].parentJoint != shapes[second].parentJoint and links not in allowed:
            collision.addCollisionPair(pin.CollisionPair(first, second))
    return dataclasses.replace(robot, collision=collision)


def apply_self_collision_analysis(
    robot: Robot, semantics: Srdf | None, loose: Collection[str], *, samples: int
) -> Robot:
    """Return a copy of `robot` with collision pairs and home from `analyze_self_collisions`.

    Warns if the home was moved, or if links that are not neighbours are exempt from checks.

    Args:
        robot: The robot; its own collision pairs play no part.
        semantics: Its SRDF; without one pairs are sampled.
        loose: The planned joints of which nobody says where they rest.
        samples: How many configurations to look at.
    """
    listed = None if semantics is None else semantics.allowed
    found, names = (
        analyze_self_collisions(robot, listed, loose, samples=samples),
        robot.coordinates.names[3:],
    )
    home, said = np.array(found.home), f"{robot.urdf}: "
    if moved := [
        f"{name}: {value:.3g}"
        for name, value, was in zip(names, home, robot.home, strict=True)
        if value != was
    ]:
        said += "links overlap where the arm would rest; home has joints elsewhere of which nobody says where they rest"
        warnings.warn(f"{said}: {', '.join(moved)}", stacklevel=3)
    unsaid = {
        "Home": "overlap at home",
        **({} if listed is None else {"Always": "always overlap or touch"}),
    }
    for reason, what in unsaid.items():
        links = [
            " – ".join(pair)
            for pair, why in found.allowed.items()
            if why == reason and pair not in (listed or {})
        ]
        if links:
            warnings.warn(
                f"{robot.urdf}: links that {what} are not kept apart: {', '.join(links)}",
                stacklevel=3,
            )
    return set_collision_pairs(
        dataclasses.replace(robot, home=home, tight=found.tight), found.allowed
    )


def analyze_self_collisions(
    robot: Robot, listed: Mapping[Pair, str] | None, loose: Collection[str] = (), *, samples: int
) -> SelfCollisionAnalysis:
    """Return which links need not be kept apart, how far others can be, and a home at which none overlap.

    To those `listed`, or else found by `sample_allowed_pairs`, come pairs that no motion keeps
    apart: neighbours that are always close ("Adjacent"), links that always overlap or touch
    ("Always"), and those that overlap at home ("Home"). Where they do although nobody says that the
    robot rests there, the nearest posture found in which the fewest do is the home.

    Args:
        robot: The robot; its own collision pairs play no part.
        listed: The pairs of an SRDF, each sorted, with the reason.
        loose: The planned joints of which nobody says where they rest.
        samples: How many configurations to look at.
    """
    about = (
        "pairs",
        _VERSION,
        samples,
        sorted((listed or {}).items()),
        listed is None,
        sorted(loose),
        robot.fingerprint,
    )
    key = json.dumps(about).encode()
    allowed, tight, home = record(
        key, lambda: _to_plain_lists(_compute_analysis(robot, listed, loose, samples))
    )
    return SelfCollisionAnalysis(
        {(a, b): why for a, b, why in allowed}, {(a, b): gap for a, b, gap in tight}, tuple(home)
    )


def sample_allowed_pairs(
    robot: Robot, *, samples: int = _SAMPLES, seed: int = 0
) -> dict[tuple[str, str], str]:
    """Return the pairs of links that need not be kept apart, each sorted, with the reason.

    "Adjacent": a joint connects them, or one joint and fixed links while they are never 50 mm
    apart. "Always": they collide in every sample. "Never": they collide in no sample, and those
    that came closer than 50 mm not even when they are driven together from their closest samples.
    Samples are uniform within the joints' limits (±π where there are none), the base standing
    still.

    Args:
        robot: The robot; its own collision pairs play no part.
        samples: How many configurations to look at.
        seed: Of the random numbers; the same seed gives the same pairs.
    """
    groups, (joined, welded) = _group_shape_pairs(robot), find_neighbours(robot.file, robot.links)
    allowed = {links: "Adjacent" for links in groups if links in joined}
    groups = {links: parts for links, parts in groups.items() if links not in joined}
    rng, distances, (low, high) = (
        np.random.default_rng(seed),
        _make_shape_distances(robot),
        _find_sampling_bounds(robot),
    )
    look, undecided, (free, hit) = (
        LinkDistances(distances, groups),
        np.arange(len(groups)),
        np.zeros((2, len(groups)), bool),
    )
    closest: list[list[tuple[float, tuple[float, ...]]]] = [[] for _ in groups]
    for z in rng.uniform(low, high, (samples, len(low))):
        distances.set_configuration(z)
        free[undecided[(bounds := look.compute_lower_bounds()) > 0.0]] = True
        for k in np.flatnonzero(bounds <= _MAX_DISTANCE).tolist():
            best = closest[pair := undecided[k]]
            distance = look.compute_distance(
                k,
                min(_MAX_DISTANCE, best[-1][0]) if len(best) == _DESCENT_STARTS else _MAX_DISTANCE,
            )
            free[pair] |= distance > 0.0
            hit[pair] |= distance <= 0.0
            if (
                distance < _MAX_DISTANCE
                and not hit[pair]
                and (len(best) < _DESCENT_STARTS or distance < best[-1][0])
            ):
                closest[pair] = sorted([*best, (distance, tuple(z))])[:_DESCENT_STARTS]
        look.select(left := ~(free & hit)[undecided])
        undecided = undecided[left]
    for pair, (links, parts) in enumerate(groups.items()):
        if not free[pair]:
            allowed[links] = "Always"
        elif not hit[pair]:
            starts = (np.array(z) for _, z in closest[pair])
            if not any(
                _descend_to_collision(distances, parts, z, (low, high), rng) for z in starts
            ):
                allowed[links] = "Never"
    unsure = {
        links: groups[links] for links in welded & groups.keys() if allowed.get(links) != "Never"
    }
    allowed |= {
        links: "Adjacent"
        for links, room in _compute_max_distances(robot, unsure, samples).items()
        if room < _MAX_DISTANCE
    }
    return dict(sorted(allowed.items()))


def _compute_analysis(
    robot: Robot, listed: Mapping[Pair, str] | None, loose: Collection[str], samples: int
) -> SelfCollisionAnalysis:
    allowed = dict(sample_allowed_pairs(robot, samples=samples) if listed is None else listed)
    groups = {
        links: parts for links, parts in _group_shape_pairs(robot).items() if links not in allowed
    }
    rooms = {
        links: room
        for links, room in _compute_max_distances(robot, groups, samples).items()
        if room < _MAX_DISTANCE
    }
    joined = frozenset().union(*find_neighbours(robot.file, robot.links))
    for links, room in rooms.items():
        if links in joined or room <= _CONTACT_DISTANCE:
            allowed[links] = "Adjacent" if links in joined else "Always"
    groups = {links: parts for links, parts in groups.items() if links not in allowed}
    tight = {links: room for links, room in rooms.items() if links in groups}
    robot = dataclasses.replace(robot, tight=tight)
    home = _find_free_home(robot, groups, loose)
    distances = _make_shape_distances(robot)
    distances.set_configuration(np.array([0.0, 0.0, 0.0, *home]))
    for links, parts in groups.items():
        if (gap := distances.compute_distance(parts, _MAX_DISTANCE)) <= 0.0:
            allowed[links] = "Home"
            tight.pop(links, None)
        elif gap < _MAX_DISTANCE:
            tight[links] = min(gap, tight.get(links, np.inf))
    return SelfCollisionAnalysis(dict(sorted(allowed.items())), dict(sorted(tight.items())), home)


def _to_plain_lists(
    found: SelfCollisionAnalysis,
) -> tuple[list[tuple[str, str, str]], list[tuple[str, str, float]], list[float]]:
    allowed = [(*links, reason) for links, reason in found.allowed.items()]
    return allowed, [(*links, gap) for links, gap in found.tight.items()], list(found.home)


def _find_free_home(
    robot: Robot, groups: Mapping[Pair, Parts], loose: Collection[str]
) -> tuple[float, ...]:
    """Return the robot's home, or another in which the fewest of some pairs overlap, with only the `loose` joints elsewhere."""
    distances, (low, high), rng = (
        _make_shape_distances(robot),
        _find_sampling_bounds(robot),
        np.random.default_rng(0),
    )
    moves = np.array([name in loose for name in robot.coordinates.names])
    rest = np.array([0.0, 0.0, 0.0, *robot.home])

    def short(z: Floats, margin: float, most: float) -> int:
        """Return how many pairs keep less than `margin`, or what they can; no more than `most` + 1."""
        distances.set_configuration(z)
        count = 0
        for links, parts in groups.items():
            least = robot.own_margin(links, margin)
            count += (
                distances.compute_distance(parts, least) < least
                if margin
                else distances.compute_distance(parts, 0.0) <= 0.0
            )
            if count > most:
                break
        return count

    best, fewest = rest, short(rest, 0.0, np.inf)
    if not fewest or not moves.any():
        return tuple(best[3:].tolist())
    for share in _HOME_SEARCH_RADII:
        tries = rest + np.where(
            moves, share * (rng.uniform(low, high, (_HOME_SEARCH_SAMPLES, len(rest))) - rest), 0.0
        )
        for z in tries[
            np.argsort(
                (np.abs(tries - rest) / np.maximum(high - low, 1e-9)).max(axis=1), kind="stable"
            )
        ]:
            if (count := short(z, HOME_DISTANCE, fewest - 1)) < fewest:
                best, fewest = z, count
            if not fewest:
                return tuple(best[3:].tolist())
    return tuple(best[3:].tolist())


def _group_shape_pairs(robot: Robot) -> dict[Pair, Parts]:
    """Return the pairs of links that move against each other, each sorted, with the pairs of their shapes."""
    shapes, groups = robot.collision.geometryObjects, dict[Pair, Parts]()
    for first, second in itertools.combinations(range(len(shapes)), 2):
        if shapes[first].parentJoint != shapes[second].parentJoint:
            one, other = sorted((robot.link_of(first), robot.link_of(second)))
            groups.setdefault((one, other), []).append((first, second))
    return groups


def _compute_max_distances(
    robot: Robot, groups: Mapping[Pair, Parts], samples: int
) -> dict[Pair, float]:
    """Return how far links are apart at most [m], at home or in random configurations; 50 mm or more where that is certain."""
    distances, (low, high), rng = (
        _make_shape_distances(robot),
        _find_sampling_bounds(robot),
        np.random.default_rng(0),
    )
    look, rooms = LinkDistances(distances, groups), dict.fromkeys(groups, -np.inf)
    for z in (np.array([0.0, 0.0, 0.0, *robot.home]), *rng.uniform(low, high, (samples, len(low)))):
        if not look.links:
            break
        distances.set_configuration(z)
        for k, (links, bound) in enumerate(
            zip(look.links, look.compute_lower_bounds(), strict=True)
        ):
            rooms[links] = max(
                rooms[links],
                float(bound) if bound > _MAX_DISTANCE else look.compute_distance(k, _MAX_DISTANCE),
            )
        look.select([rooms[links] < _MAX_DISTANCE for links in look.links])
    return rooms


def _find_sampling_bounds(robot: Robot) -> tuple[Floats, Floats]:
    """Return within which bounds configurations are looked at, shape (n,)."""
    low, high = (
        np.where(np.isfinite(robot.lower), robot.lower, -np.pi),
        np.where(np.isfinite(robot.upper), robot.upper, np.pi),
    )
    low[:3] = high[:3] = 0.0
    return low, high


def _make_shape_distances(robot: Robot) -> ShapeDistances:
    return ShapeDistances(robot.model, robot.coordinates.q, robot.collision.geometryObjects)


def write_srdf(robot: Robot, path: str | Path, *, samples: int = _SAMPLES, seed: int = 0) -> Path:
    """Write an SRDF with the allowed collisions of `robot` and its home; at once, so that no reader sees half a file.

    Args:
        robot: The robot.
        path: The file to write.
        samples: See `sample_allowed_pairs`.
        seed: The same.

    Returns:
        The file.
    """
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- Written by `vkc-pin srdf`: {samples} samples, seed {seed}. Adjacent: a joint connects the links. Always: they",
        "     collide in every sample. Never: in none, nor when driven together from those in which they came closest. -->",
        f"<robot name={quote(robot.name)}>",
        '  <group name="arm">',
        *(f"    <joint name={quote(name)}/>" for name in robot.coordinates.names[3:]),
        "  </group>",
        '  <group_state name="home" group="arm">',
        *(
            f"    <joint name={quote(name)} value={quote(f'{value:.12g}')}/>"
            for name, value in zip(robot.coordinates.names[3:], robot.home, strict=True)
        ),
        "  </group_state>",
        *(
            f"  <disable_collisions link1={quote(a)} link2={quote(b)} reason={quote(reason)}/>"
            for (a, b), reason in sample_allowed_pairs(robot, samples=samples, seed=seed).items()
        ),
        "</robot>",
    ]
    return write_atomically(path, ("\n".join(lines) + "\n").encode())


def _descend_to_collision(
    distances: ShapeDistances,
    parts: Parts,
    z: Floats,
    limits: tuple[Floats, Floats],
    rng: np.random.Generator,
) -> bool:
    """Return whether random steps from `z` that lessen the distance end in a collision."""
    low, high = limits
    distances.set_configuration(z)
    nearest = distances.compute_distance(parts)
    for width in np.geomspace(0.2, 0.002, _DESCENT_STEPS):
        trial = np.clip(z + width * (high - low) / 6.0 * rng.standard_normal(len(z)), low, high)
        distances.set_configuration(trial)
        distance = distances.compute_distance(parts)
        if distance < nearest:
            z, nearest = trial, distance
        if nearest <= 0.0:
            return True
    return False
