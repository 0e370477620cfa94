"""Finds the pairs of a robot's links that need no collision check, by sampling, and writes them as an SRDF."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import coal
import numpy as np
import pinocchio as pin

if TYPE_CHECKING:
    from vkc_pin.robot import Robot

__all__ = ["sample_allowed_pairs", "write_srdf"]

_SAMPLES = 20_000
_NEAR = 0.01  # [m]: links that come this close in a sample are not "never" in collision


def sample_allowed_pairs(robot: Robot, *, samples: int = _SAMPLES, seed: int = 0) -> dict[tuple[str, str], str]:
    """Return the pairs of links that need not be kept apart, each sorted, with the reason.

    "Adjacent": a joint connects them. "Always": they collide in every sample. "Never": they stay further apart than
    10 mm in every sample. Samples are uniform within the joints' limits (±π without), the base standing still.

    Args:
        robot: The robot; its own collision pairs play no part.
        samples: How many configurations to look at.
        seed: Of the random numbers; the same seed gives the same pairs.
    """
    shapes = robot.collision.geometryObjects
    adjacent = _adjacent(robot)
    allowed = {}
    groups: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for first, second in itertools.combinations(range(len(shapes)), 2):
        if shapes[first].parentJoint == shapes[second].parentJoint:
            continue
        one, other = sorted((robot.link_of(first), robot.link_of(second)))
        if (one, other) in adjacent:
            allowed[one, other] = "Adjacent"
        else:
            groups.setdefault((one, other), []).append((first, second))
    once_free: set[tuple[str, str]] = set()
    once_near: set[tuple[str, str]] = set()
    rng = np.random.default_rng(seed)
    low, high = np.where(np.isfinite(robot.lower), robot.lower, -np.pi), np.where(np.isfinite(robot.upper), robot.upper, np.pi)
    low[:3] = high[:3] = 0.0
    data, placed = robot.model.createData(), pin.GeometryData(robot.collision)
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    solids = [shape.geometry for shape in shapes]
    open_groups = list(groups)
    for z in rng.uniform(low, high, (samples, len(low))):
        if not open_groups:
            break
        pin.updateGeometryPlacements(robot.model, data, robot.collision, placed, robot.coordinates.q(z))
        places = [coal.Transform3s(place.rotation, place.translation) for place in placed.oMg]
        for links in open_groups:
            distance = np.inf
            for first, second in groups[links]:
                result.clear()
                distance = min(distance, coal.distance(solids[first], places[first], solids[second], places[second], request, result))
            if distance > 0.0:
                once_free.add(links)
            if distance <= _NEAR:
                once_near.add(links)
        open_groups = [links for links in open_groups if links not in once_free or links not in once_near]
    for links in groups:
        if links not in once_near:
            allowed[links] = "Never"
        elif links not in once_free:
            allowed[links] = "Always"
    return dict(sorted(allowed.items()))


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
    file = Path(path)
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- Written by `vkc-pin srdf`: {samples} samples, seed {seed}. Adjacent: a joint connects the links. Always, never:",
        f"     in every sample they collide, or stay more than {1000 * _NEAR:g} mm apart. -->",
        f"<robot name={quoteattr(robot.name)}>",
        '  <group name="arm">',
        *(f"    <joint name={quoteattr(name)}/>" for name in robot.coordinates.names[3:]),
        "  </group>",
        '  <group_state name="home" group="arm">',
        *(
            f"    <joint name={quoteattr(name)} value={quoteattr(f'{value:.12g}')}/>"
            for name, value in zip(robot.coordinates.names[3:], robot.home, strict=True)
        ),
        "  </group_state>",
        *(
            f"  <disable_collisions link1={quoteattr(one)} link2={quoteattr(other)} reason={quoteattr(reason)}/>"
            for (one, other), reason in sample_allowed_pairs(robot, samples=samples, seed=seed).items()
        ),
        "</robot>",
    ]
    draft = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        draft.write_text("\n".join(lines) + "\n", encoding="utf-8")
        draft.replace(file)
    finally:
        draft.unlink(missing_ok=True)
    return file


def _adjacent(robot: Robot) -> set[tuple[str, str]]:
    """Return the pairs of links with collision shapes that one joint connects, or only links without shapes."""
    parents = {}
    for joint in robot.file.root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            parents[child.get("link", "")] = parent.get("link", "")
    solid = set(robot.links)
    pairs = set()
    for link in solid:
        above = parents.get(link)
        while above is not None and above not in solid:
            above = parents.get(above)
        if above is not None:
            first, second = sorted((link, above))
            pairs.add((first, second))
    return pairs
