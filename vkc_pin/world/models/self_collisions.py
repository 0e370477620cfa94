"""Finds the collision pairs of a robot's links by sampling, and a collision-free home.

The results are cached on disk, since they take up to a minute for large robots.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.utils.disk_cache import load_or_build
from vkc_pin.world.files.srdf import Srdf, format_srdf
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_model import find_neighbours
from vkc_pin.world.models.shapes import LinkDistances, ShapeDistances

Pair = tuple[str, str]
Parts = list[tuple[int, int]]


_VERSION = 1  # of the cached results: increase it whenever the same robot would get other pairs
_SAMPLES = 20_000
# [m]: pairs of links that stay further apart in all samples never collide; neighbours that are
# always closer are exempt
_MAX_DISTANCE = 0.05
# [m] equal to `Options.self_distance`: distance of links that a home must keep
HOME_DISTANCE = 0.02
_DESCENT_STARTS = 4  # descents per pair of links
_DESCENT_STEPS = 200  # steps of each descent
# [m] equal to the resolution of validation: links that never get further apart count as touching
_CONTACT_DISTANCE = 1e-3
# Fractions of the joint ranges in which a home is searched in turn, and samples in each
_HOME_SEARCH_RADII = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
_HOME_SEARCH_SAMPLES = 100


class SelfCollisionAnalysis(NamedTuple):
    """Self-collisions of a robot.

    Attributes:
        allowed: Sorted pair of links that need not be checked → reason.
        tight: Sorted pair of links that are less than 50 mm apart in all samples, or at home →
            their largest distance, or that at home if it is less [m].
        home: Home positions of the planned joints, shape (n − 3,) [m], [rad].
    """

    allowed: dict[Pair, str]
    tight: dict[Pair, float]
    home: tuple[float, ...]


def set_collision_pairs(robot: Robot, allowed: Collection[Pair]) -> Robot:
    """Return a copy of `robot` with all pairs in relative motion but those `allowed`."""
    shapes = robot.collision.geometryObjects
    collision = pin.GeometryModel()
    for shape in shapes:
        collision.addGeometryObject(shape)
    for first, second in itertools.combinations(range(len(shapes)), 2):
        links = tuple(sorted((robot.link_of(first), robot.link_of(second))))
        in_relative_motion = shapes[first].parentJoint != shapes[second].parentJoint
        if in_relative_motion and links not in allowed:
            collision.addCollisionPair(pin.CollisionPair(first, second))
    return dataclasses.replace(robot, collision=collision)


def apply_self_collision_analysis(
    robot: Robot, semantics: Srdf | None, loose: Collection[str], *, samples: int
) -> Robot:
    """Return a copy of `robot` with collision pairs and home from `analyze_self_collisions`.

    Warns if the home was moved, or if links that are not neighbours are exempt from checks. Without
    an SRDF (`semantics`), pairs are sampled.
    """
    listed = None if semantics is None else semantics.allowed
    found = analyze_self_collisions(robot, listed, loose, samples=samples)
    home = np.array(found.home)
    moved = list[str]()
    for name, position, default in zip(robot.coordinates.names[3:], home, robot.home, strict=True):
        if position != default:
            moved.append(f"{name}: {position:.3g}")
    if moved:
        warnings.warn(
            f"{robot.urdf}: links overlap at the default home; joints without a stated home "
            f"position were moved: {', '.join(moved)}",
            stacklevel=3,
        )
    warned_reasons = {"Home": "overlap at home"}
    if listed is not None:
        warned_reasons["Always"] = "always overlap or touch"
    for reason, condition in warned_reasons.items():
        unlisted = list[str]()
        for pair, pair_reason in found.allowed.items():
            if pair_reason == reason and pair not in (listed or {}):
                unlisted.append(" – ".join(pair))
        if unlisted:
            warnings.warn(
                f"{robot.urdf}: links that {condition} are not checked: {', '.join(unlisted)}",
                stacklevel=3,
            )
    analyzed = dataclasses.replace(robot, home=home, tight=found.tight)
    return set_collision_pairs(analyzed, found.allowed)


def analyze_self_collisions(
    robot: Robot, listed: Mapping[Pair, str] | None, loose: Collection[str] = (), *, samples: int
) -> SelfCollisionAnalysis:
    """Return the pairs of links that need no check, tight pairs, and a collision-free home.

    Allowed pairs are those `listed`, or else those of `sample_allowed_pairs`, and pairs that no
    motion can separate: neighbours that are always close ("Adjacent"), links that always overlap or
    touch ("Always"), and links that overlap at home ("Home"). If links overlap at home, the home is
    moved to the nearest sampled configuration with the fewest overlaps.

    Args:
        robot: The robot; its collision pairs are ignored.
        listed: Sorted pairs of the SRDF → reason.
        loose: Planned joints without a stated home position, which may be moved.
        samples: Number of random configurations.
    """
    inputs = (
        "pairs",
        _VERSION,
        samples,
        sorted((listed or {}).items()),
        listed is None,
        sorted(loose),
        robot.fingerprint,
    )
    key = json.dumps(inputs).encode()

    def build() -> tuple[list[Any], list[Any], list[float]]:
        return _to_plain_lists(_compute_analysis(robot, listed, loose, samples))

    allowed, tight, home = load_or_build(key, build)
    return SelfCollisionAnalysis(
        allowed={(one, other): reason for one, other, reason in allowed},
        tight={(one, other): distance for one, other, distance in tight},
        home=tuple(home),
    )


def sample_allowed_pairs(
    robot: Robot, *, samples: int = _SAMPLES, seed: int = 0
) -> dict[tuple[str, str], str]:
    """Return sorted pairs of links that need no collision check → reason.

    "Adjacent": a joint connects the links, or the rigid bodies they belong to if they are always
    less than 50 mm apart. "Always": they collide in all samples. "Never": they collide in no
    sample; pairs closer than 50 mm do not collide in random descents from the closest samples
    either. Samples are uniform within the joint limits (±π without limits), with the base at the
    origin.

    Args:
        robot: The robot; its collision pairs are ignored.
        samples: Number of random configurations.
        seed: Random seed.
    """
    groups = _group_shape_pairs(robot)
    adjacent, adjacent_bodies = find_neighbours(robot.file, robot.links)
    allowed = {links: "Adjacent" for links in groups if links in adjacent}
    groups = {links: parts for links, parts in groups.items() if links not in adjacent}
    rng = np.random.default_rng(seed)
    distances = _make_shape_distances(robot)
    limits = _find_sampling_bounds(robot)
    is_free, is_hit, closest = _sample_pairs(distances, groups, limits, rng, samples)
    for number, (links, parts) in enumerate(groups.items()):
        if not is_free[number]:
            allowed[links] = "Always"
        elif not is_hit[number]:
            collides = any(
                _descend_to_collision(distances, parts, np.array(z), limits, rng)
                for _, z in closest[number]
            )
            if not collides:
                allowed[links] = "Never"
    neighbours = dict[Pair, Parts]()
    for links in adjacent_bodies & groups.keys():
        if allowed.get(links) != "Never":
            neighbours[links] = groups[links]
    for links, max_distance in _compute_max_distances(robot, neighbours, samples).items():
        if max_distance < _MAX_DISTANCE:
            allowed[links] = "Adjacent"
    return dict(sorted(allowed.items()))


class _Sampled(NamedTuple):
    """Result of sampling: for each pair of links, whether it was apart, and whether it collided.

    `closest` has the least distances [m] that are not above 50 mm, with their configurations.
    """

    is_free: Bools
    is_hit: Bools
    closest: list[list[tuple[float, tuple[float, ...]]]]


def _sample_pairs(
    distances: ShapeDistances,
    groups: Mapping[Pair, Parts],
    limits: tuple[Floats, Floats],
    rng: np.random.Generator,
    samples: int,
) -> _Sampled:
    """Sample pairs of links until each was found free and in collision, or samples end."""
    low, high = limits
    link_distances = LinkDistances(distances, groups)
    is_free = np.zeros(len(groups), bool)
    is_hit = np.zeros(len(groups), bool)
    closest: list[list[tuple[float, tuple[float, ...]]]] = [[] for _ in groups]
    undecided = np.arange(len(groups))
    for z in rng.uniform(low, high, (samples, len(low))):
        distances.set_configuration(z)
        lower_bounds = link_distances.compute_lower_bounds()
        is_apart = lower_bounds > 0.0
        is_free[undecided[is_apart]] = True
        for k in np.flatnonzero(lower_bounds <= _MAX_DISTANCE).tolist():
            number = undecided[k]
            best = closest[number]
            is_full = len(best) == _DESCENT_STARTS
            limit = min(_MAX_DISTANCE, best[-1][0]) if is_full else _MAX_DISTANCE
            distance = link_distances.compute_distance(k, limit)
            is_free[number] |= distance > 0.0
            is_hit[number] |= distance <= 0.0
            if distance < limit and not is_hit[number]:
                closest[number] = sorted([*best, (distance, tuple(z))])[:_DESCENT_STARTS]
        remains = ~(is_free & is_hit)[undecided]
        link_distances.select(remains)
        undecided = undecided[remains]
    return _Sampled(is_free, is_hit, closest)


def _compute_analysis(
    robot: Robot, listed: Mapping[Pair, str] | None, loose: Collection[str], samples: int
) -> SelfCollisionAnalysis:
    allowed = dict(sample_allowed_pairs(robot, samples=samples) if listed is None else listed)
    groups = _omit_pairs(_group_shape_pairs(robot), allowed)
    max_distances = dict[Pair, float]()
    for links, max_distance in _compute_max_distances(robot, groups, samples).items():
        if max_distance < _MAX_DISTANCE:
            max_distances[links] = max_distance
    adjacent = frozenset().union(*find_neighbours(robot.file, robot.links))
    for links, max_distance in max_distances.items():
        if links in adjacent:
            allowed[links] = "Adjacent"
        elif max_distance <= _CONTACT_DISTANCE:
            allowed[links] = "Always"
    groups = _omit_pairs(groups, allowed)
    tight = {links: distance for links, distance in max_distances.items() if links in groups}
    robot = dataclasses.replace(robot, tight=tight)
    home = _find_free_home(robot, groups, loose)
    distances = _make_shape_distances(robot)
    distances.set_configuration(np.array([0.0, 0.0, 0.0, *home]))
    for links, parts in groups.items():
        distance = distances.compute_distance(parts, _MAX_DISTANCE)
        if distance <= 0.0:
            allowed[links] = "Home"
            tight.pop(links, None)
        elif distance < _MAX_DISTANCE:
            tight[links] = min(distance, tight.get(links, np.inf))
    return SelfCollisionAnalysis(dict(sorted(allowed.items())), dict(sorted(tight.items())), home)


def _omit_pairs(groups: Mapping[Pair, Parts], allowed: Collection[Pair]) -> dict[Pair, Parts]:
    return {links: parts for links, parts in groups.items() if links not in allowed}


def _to_plain_lists(found: SelfCollisionAnalysis) -> tuple[list[Any], list[Any], list[float]]:
    """Return an analysis as lists that JSON has: (link, link, reason), (link, link, distance)."""
    allowed = [(*links, reason) for links, reason in found.allowed.items()]
    tight = [(*links, distance) for links, distance in found.tight.items()]
    return allowed, tight, list(found.home)


def _find_free_home(
    robot: Robot, groups: Mapping[Pair, Parts], loose: Collection[str]
) -> tuple[float, ...]:
    """Return the robot's home, or one with fewer overlaps that differs in `loose` joints only."""
    distances = _make_shape_distances(robot)
    limits = _find_sampling_bounds(robot)
    rng = np.random.default_rng(0)
    is_loose = np.array([name in loose for name in robot.coordinates.names])
    default_home = np.array([0.0, 0.0, 0.0, *robot.home])

    def count_violations(z: Floats, limit: int) -> int:
        """Return the number of pairs below their margin; counting stops above `limit`."""
        distances.set_configuration(z)
        count = 0
        for links, parts in groups.items():
            margin = robot.own_margin(links, HOME_DISTANCE)
            if distances.compute_distance(parts, margin) < margin:
                count += 1
            if count > limit:
                break
        return count

    distances.set_configuration(default_home)
    overlaps = [parts for parts in groups.values() if distances.compute_distance(parts, 0.0) <= 0.0]
    best = default_home
    fewest = len(overlaps)
    if fewest == 0 or not is_loose.any():
        return tuple(best[3:].tolist())
    for radius in _HOME_SEARCH_RADII:
        candidates = _sample_around(default_home, is_loose, radius, limits, rng)
        for z in candidates:
            count = count_violations(z, fewest - 1)
            if count < fewest:
                best = z
                fewest = count
            if fewest == 0:
                return tuple(best[3:].tolist())
    return tuple(best[3:].tolist())


def _sample_around(
    center: Floats,
    is_loose: Bools,
    radius: float,
    limits: tuple[Floats, Floats],
    rng: np.random.Generator,
) -> Floats:
    """Return random configurations around one, the nearest first, shape (samples, n).

    Nearest is the one with the least largest step of a joint, relative to the joint's range.

    Args:
        center: Configuration, shape (n,) [m], [rad].
        is_loose: Whether each coordinate may change, shape (n,).
        radius: Largest step, relative to the distance from `center` to the limits.
        limits: Lower and upper limits, shape (n,) each [m], [rad].
        rng: Random numbers.
    """
    low, high = limits
    samples = rng.uniform(low, high, (_HOME_SEARCH_SAMPLES, len(center)))
    steps = np.where(is_loose, radius * (samples - center), 0.0)
    candidates = center + steps
    ranges = np.maximum(high - low, 1e-9)
    relative_steps = (np.abs(candidates - center) / ranges).max(axis=1)
    order = np.argsort(relative_steps, kind="stable")
    return np.asarray(candidates[order])


def _group_shape_pairs(robot: Robot) -> dict[Pair, Parts]:
    """Return sorted pairs of links in relative motion → pairs of their shapes."""
    shapes = robot.collision.geometryObjects
    groups = dict[Pair, Parts]()
    for first, second in itertools.combinations(range(len(shapes)), 2):
        if shapes[first].parentJoint != shapes[second].parentJoint:
            one, other = sorted((robot.link_of(first), robot.link_of(second)))
            parts = groups.setdefault((one, other), [])
            parts.append((first, second))
    return groups


def _compute_max_distances(
    robot: Robot, groups: Mapping[Pair, Parts], samples: int
) -> dict[Pair, float]:
    """Return the largest distances at home and in samples [m]; above 50 mm, lower bounds."""
    distances = _make_shape_distances(robot)
    low, high = _find_sampling_bounds(robot)
    rng = np.random.default_rng(0)
    home = np.array([0.0, 0.0, 0.0, *robot.home])
    configurations = (home, *rng.uniform(low, high, (samples, len(low))))
    link_distances = LinkDistances(distances, groups)
    max_distances = dict.fromkeys(groups, -np.inf)
    for z in configurations:
        if not link_distances.links:
            break
        distances.set_configuration(z)
        lower_bounds = link_distances.compute_lower_bounds()
        for k, links in enumerate(link_distances.links):
            distance = float(lower_bounds[k])
            if distance <= _MAX_DISTANCE:
                distance = link_distances.compute_distance(k, _MAX_DISTANCE)
            max_distances[links] = max(max_distances[links], distance)
        # Pairs that were far apart once need no more samples.
        remains = [max_distances[links] < _MAX_DISTANCE for links in link_distances.links]
        link_distances.select(remains)
    return max_distances


def _find_sampling_bounds(robot: Robot) -> tuple[Floats, Floats]:
    """Return lower and upper bounds of sampled configurations, shape (n,) each [m], [rad]."""
    low = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
    high = np.where(np.isfinite(robot.upper), robot.upper, np.pi)
    low[:3] = 0.0
    high[:3] = 0.0
    return low, high


def _make_shape_distances(robot: Robot) -> ShapeDistances:
    return ShapeDistances(robot.model, robot.coordinates.q, robot.collision.geometryObjects)


def write_srdf(robot: Robot, path: str | Path, *, samples: int = _SAMPLES, seed: int = 0) -> Path:
    """Write an SRDF with the allowed collisions and the home of `robot`, atomically.

    Args:
        robot: The robot.
        path: Path of the file.
        samples: Number of random configurations; see `sample_allowed_pairs`.
        seed: Random seed.

    Returns:
        Path of the file.
    """
    comment = (
        f"Written by `vkc-pin srdf`: {samples} samples, seed {seed}. Adjacent: connected by\n"
        "     a joint. Always: in collision in all samples. Never: in collision in no sample, nor\n"
        "     after descents of the distance from the closest samples."
    )
    home = dict(zip(robot.coordinates.names[3:], robot.home.tolist(), strict=True))
    allowed = sample_allowed_pairs(robot, samples=samples, seed=seed)
    return write_atomically(path, format_srdf(robot.name, home, allowed, comment).encode())


def _descend_to_collision(
    distances: ShapeDistances,
    parts: Parts,
    z: Floats,
    limits: tuple[Floats, Floats],
    rng: np.random.Generator,
) -> bool:
    """Return whether a random descent of the distance from `z` ends in a collision."""
    low, high = limits
    distances.set_configuration(z)
    nearest = distances.compute_distance(parts)
    for width in np.geomspace(0.2, 0.002, _DESCENT_STEPS):
        step = width * (high - low) / 6.0 * rng.standard_normal(len(z))
        trial = np.clip(z + step, low, high)
        distances.set_configuration(trial)
        distance = distances.compute_distance(parts)
        if distance < nearest:
            z = trial
            nearest = distance
        if nearest <= 0.0:
            return True
    return False
