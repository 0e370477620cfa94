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
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.disk_cache import load_or_build
from vkc_pin.world.files.srdf import Srdf
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.files.xml import quote
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
_DESCENT_STARTS, _DESCENT_STEPS = 4, 200  # descents per pair of links, and steps of each
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

    Warns if the home was moved, or if links that are not neighbours are exempt from checks. Without
    an SRDF (`semantics`), pairs are sampled.
    """
    listed = None if semantics is None else semantics.allowed
    found = analyze_self_collisions(robot, listed, loose, samples=samples)
    names = robot.coordinates.names[3:]
    home, message = np.array(found.home), f"{robot.urdf}: "
    if moved := [
        f"{name}: {value:.3g}"
        for name, value, was in zip(names, home, robot.home, strict=True)
        if value != was
    ]:
        message += (
            "links overlap at the default home; joints without a stated home position were moved"
        )
        warnings.warn(f"{message}: {', '.join(moved)}", stacklevel=3)
    warned_reasons = {
        "Home": "overlap at home",
        **({} if listed is None else {"Always": "always overlap or touch"}),
    }
    for reason, condition in warned_reasons.items():
        links = [
            " – ".join(pair)
            for pair, why in found.allowed.items()
            if why == reason and pair not in (listed or {})
        ]
        if links:
            warnings.warn(
                f"{robot.urdf}: links that {condition} are not checked: {', '.join(links)}",
                stacklevel=3,
            )
    return set_collision_pairs(
        dataclasses.replace(robot, home=home, tight=found.tight), found.allowed
    )


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
    allowed, tight, home = load_or_build(
        key, lambda: _to_plain_lists(_compute_analysis(robot, listed, loose, samples))
    )
    return SelfCollisionAnalysis(
        {(a, b): why for a, b, why in allowed}, {(a, b): gap for a, b, gap in tight}, tuple(home)
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
    low, high = _find_sampling_bounds(robot)
    link_distances = LinkDistances(distances, groups)
    undecided = np.arange(len(groups))
    free, hit = np.zeros((2, len(groups)), bool)
    closest: list[list[tuple[float, tuple[float, ...]]]] = [[] for _ in groups]
    for z in rng.uniform(low, high, (samples, len(low))):
        distances.set_configuration(z)
        free[undecided[(bounds := link_distances.compute_lower_bounds()) > 0.0]] = True
        for k in np.flatnonzero(bounds <= _MAX_DISTANCE).tolist():
            best = closest[pair := undecided[k]]
            distance = link_distances.compute_distance(
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
        link_distances.select(left := ~(free & hit)[undecided])
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
    undecided_neighbours = {
        links: groups[links]
        for links in adjacent_bodies & groups.keys()
        if allowed.get(links) != "Never"
    }
    allowed |= {
        links: "Adjacent"
        for links, max_distance in _compute_max_distances(
            robot, undecided_neighbours, samples
        ).items()
        if max_distance < _MAX_DISTANCE
    }
    return dict(sorted(allowed.items()))


def _compute_analysis(
    robot: Robot, listed: Mapping[Pair, str] | None, loose: Collection[str], samples: int
) -> SelfCollisionAnalysis:
    allowed = dict(sample_allowed_pairs(robot, samples=samples) if listed is None else listed)
    groups = {
        links: parts for links, parts in _group_shape_pairs(robot).items() if links not in allowed
    }
    max_distances = {
        links: max_distance
        for links, max_distance in _compute_max_distances(robot, groups, samples).items()
        if max_distance < _MAX_DISTANCE
    }
    adjacent = frozenset().union(*find_neighbours(robot.file, robot.links))
    for links, max_distance in max_distances.items():
        if links in adjacent or max_distance <= _CONTACT_DISTANCE:
            allowed[links] = "Adjacent" if links in adjacent else "Always"
    groups = {links: parts for links, parts in groups.items() if links not in allowed}
    tight = {
        links: max_distance for links, max_distance in max_distances.items() if links in groups
    }
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
    """Return the robot's home, or one with fewer overlaps that differs in `loose` joints only."""
    distances = _make_shape_distances(robot)
    low, high = _find_sampling_bounds(robot)
    rng = np.random.default_rng(0)
    is_loose = np.array([name in loose for name in robot.coordinates.names])
    default_home = np.array([0.0, 0.0, 0.0, *robot.home])

    def count_violations(z: Floats, margin: float, limit: float) -> int:
        """Return the number of pairs below their margin; counting stops above `limit`."""
        distances.set_configuration(z)
        count = 0
        for links, parts in groups.items():
            least = robot.own_margin(links, margin)
            count += (
                distances.compute_distance(parts, least) < least
                if margin
                else distances.compute_distance(parts, 0.0) <= 0.0
            )
            if count > limit:
                break
        return count

    best, fewest = default_home, count_violations(default_home, 0.0, np.inf)
    if not fewest or not is_loose.any():
        return tuple(best[3:].tolist())
    for radius in _HOME_SEARCH_RADII:
        candidates = default_home + np.where(
            is_loose,
            radius
            * (rng.uniform(low, high, (_HOME_SEARCH_SAMPLES, len(default_home))) - default_home),
            0.0,
        )
        for z in candidates[
            np.argsort(
                (np.abs(candidates - default_home) / np.maximum(high - low, 1e-9)).max(axis=1),
                kind="stable",
            )
        ]:
            if (count := count_violations(z, HOME_DISTANCE, fewest - 1)) < fewest:
                best, fewest = z, count
            if not fewest:
                return tuple(best[3:].tolist())
    return tuple(best[3:].tolist())


def _group_shape_pairs(robot: Robot) -> dict[Pair, Parts]:
    """Return sorted pairs of links in relative motion → pairs of their shapes."""
    shapes, groups = robot.collision.geometryObjects, dict[Pair, Parts]()
    for first, second in itertools.combinations(range(len(shapes)), 2):
        if shapes[first].parentJoint != shapes[second].parentJoint:
            one, other = sorted((robot.link_of(first), robot.link_of(second)))
            groups.setdefault((one, other), []).append((first, second))
    return groups


def _compute_max_distances(
    robot: Robot, groups: Mapping[Pair, Parts], samples: int
) -> dict[Pair, float]:
    """Return the largest distances at home and in samples [m]; above 50 mm, lower bounds."""
    distances = _make_shape_distances(robot)
    low, high = _find_sampling_bounds(robot)
    rng = np.random.default_rng(0)
    link_distances, max_distances = LinkDistances(distances, groups), dict.fromkeys(groups, -np.inf)
    for z in (np.array([0.0, 0.0, 0.0, *robot.home]), *rng.uniform(low, high, (samples, len(low)))):
        if not link_distances.links:
            break
        distances.set_configuration(z)
        for k, (links, bound) in enumerate(
            zip(link_distances.links, link_distances.compute_lower_bounds(), strict=True)
        ):
            max_distances[links] = max(
                max_distances[links],
                float(bound)
                if bound > _MAX_DISTANCE
                else link_distances.compute_distance(k, _MAX_DISTANCE),
            )
        link_distances.select(
            [max_distances[links] < _MAX_DISTANCE for links in link_distances.links]
        )
    return max_distances


def _find_sampling_bounds(robot: Robot) -> tuple[Floats, Floats]:
    """Return lower and upper bounds of sampled configurations, shape (n,) each [m], [rad]."""
    low = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
    high = np.where(np.isfinite(robot.upper), robot.upper, np.pi)
    low[:3] = high[:3] = 0.0
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
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- Written by `vkc-pin srdf`: {samples} samples, seed {seed}. Adjacent: connected by",
        "     a joint. Always: in collision in all samples. Never: in collision in no sample, nor",
        "     after descents of the distance from the closest samples. -->",
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
    """Return whether a random descent of the distance from `z` ends in a collision."""
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
