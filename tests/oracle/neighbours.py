"""Finds pairs that may stay close: those that a scene allows, and those close by construction.

A shape of an object that no hand can carry away, and another that is fixed there, are neighbours if
they are closer than the clearance at the start or with every joint at zero: for as long as each of
their joints is between the values at which it alone would take them that far apart. Neighbours need
no clearance. Those that overlap where they stand may do so, as deep as one joint alone takes them.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .poses import make_pose
from .riding import compute_distance

if TYPE_CHECKING:
    from .poses import Poses
    from .stage import Solid, Stage, World
    from .urdf import Shape

__all__ = ["Neighbours"]

NEARLY = 1e-3  # [m] short of the clearance that is as good as having it
RESTS = 1e-4  # [m] of overlap that is none
VALUES = 150  # of a joint on its way to a limit


@dataclass(frozen=True)
class Pair:
    """Two shapes, their penetration limit [m], and "<object>.<joint>" → interval of the joint."""

    shapes: frozenset[tuple[str, int]]
    depth: float
    joints: Mapping[str, tuple[float, float]]


class Neighbours:
    """The neighbouring pairs of a world."""

    def __init__(self, world: World) -> None:
        self.world, self.safe = world, float(world.plan.options["dist_safe"])
        self.listed = list(self._listed())
        self.fixed = {name: obj for name, obj in world.objects.items() if not obj.free}
        zero = {
            name: {joint: float(np.clip(0.0, *obj.limits[joint][:2])) for joint in obj.state}
            for name, obj in self.fixed.items()
        }
        self.pairs = [
            *self._found({name: obj.state for name, obj in self.fixed.items()}),
            *self._found(zero),
        ]

    def _listed(self) -> list[tuple[str, str, float]]:
        found = []
        for item in self.world.plan.scene.get("allow") or ():
            if item.get("srdf"):
                root = ElementTree.parse(self.world.plan.folder / item["srdf"]).getroot()
                found += [
                    (each.get("link1"), each.get("link2"), -np.inf)
                    for each in root.iter("disable_collisions")
                ]
            else:
                margin = item.get("margin")
                found.append((*item["pair"], -np.inf if margin is None else float(margin)))
        return found

    def margin(self, one: Solid, other: Solid) -> float:
        """Return the clearance that a scene asks of two shapes; infinite if it says nothing."""

        def means(name: str, part: Solid) -> bool:
            return part.label == name or (part.owner == name and name in self.world.objects)

        return min(
            (
                m
                for a, b, m in self.listed
                if (means(a, one) and means(b, other)) or (means(a, other) and means(b, one))
            ),
            default=np.inf,
        )

    def during(self, stage: Stage, one: Solid, other: Solid) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples at which shapes need no clearance, and their penetration limit."""
        close, depth = np.zeros(len(stage.times), bool), np.zeros(len(stage.times))
        shapes = frozenset((part.label, id(part.shape)) for part in (one, other))
        for pair in self.pairs:
            if pair.shapes == shapes:
                holds = np.ones(len(stage.times), bool)
                for name, (low, high) in pair.joints.items():
                    index, (owner, _, joint) = self.world.plan.index(name), name.partition(".")
                    values = (
                        stage.columns[:, index]
                        if index is not None
                        else np.array([self.fixed[owner].state[joint]])
                    )
                    holds &= (low <= values) & (values <= high)
                close |= holds
                depth = np.maximum(depth, np.where(holds, pair.depth, 0.0))
        return close, depth

    def _found(self, state: dict[str, dict[str, float]]) -> list[Pair]:
        """Return the close pairs in a state of all objects that no hand carries away."""
        links = {
            name: obj.tree.links(state[name], None, obj.tree.urdf.links)
            for name, obj in self.fixed.items()
        }
        parts: list[tuple[str, Shape, Poses]] = []
        for name, obj in self.fixed.items():
            for shape in obj.tree.urdf.shapes:
                parts.append(
                    (
                        f"{name}.{shape.link}",
                        shape,
                        obj.at @ links[name][shape.link] @ shape.place,
                    )
                )
        parts += [
            (solid.label, solid.shape, solid.at)
            for solid in self.world.obstacles
            if solid.owner != "floor"
        ]
        found, done = [], set()
        centres = np.array([(place @ make_pose(shape.centre)).at[0] for _, shape, place in parts])
        radii = np.array([shape.radius for _, shape, _ in parts])
        for k, (label, shape, place) in enumerate(parts):
            if not self._joints(label):
                continue
            gaps = np.linalg.norm(centres - centres[k], axis=1) - radii - radii[k]
            for other, second, there in (parts[i] for i in np.flatnonzero(gaps <= self.safe)):
                key = frozenset(((label, id(shape)), (other, id(second))))
                if label.partition(".")[0] == other.partition(".")[0] or key in done:
                    continue
                done.add(key)
                apart = self._apart((shape, place), (second, there))
                if apart < self.safe - NEARLY:
                    ranges, deepest = {}, max(0.0, -apart)
                    for (mine, own), (_, body, where) in (
                        ((label, shape), (other, second, there)),
                        ((other, second), (label, shape, place)),
                    ):
                        owner = mine.partition(".")[0]
                        for joint in self._joints(mine):
                            ends, deep = self._range(mine, own, joint, state[owner], (body, where))
                            ranges[f"{owner}.{joint}"], deepest = ends, max(deepest, deep)
                    depth = 0.0 if apart > -RESTS else np.inf if len(ranges) == 1 else deepest
                    found.append(Pair(key, depth, ranges))
        return found

    def _apart(self, one: tuple[Shape, object], other: tuple[Shape, object], k: int = 0) -> float:
        (a, here), (b, there) = one, other
        i, j = (0 if len(place.turn) == 1 else k for place in (here, there))
        centres = here.turn[i] @ a.centre + here.at[i], there.turn[j] @ b.centre + there.at[j]
        least = float(np.linalg.norm(centres[0] - centres[1])) - a.radius - b.radius
        return least if least > self.safe else compute_distance(a.solid, here, b.solid, there, k)

    def _joints(self, label: str) -> list[str]:
        owner, _, link = label.partition(".")
        if owner not in self.fixed:
            return []
        urdf = self.fixed[owner].tree.urdf
        return [joint for joint in urdf.path_to(link) if urdf.moves(joint)]

    def _range(
        self,
        label: str,
        shape: Shape,
        joint: str,
        state: dict[str, float],
        other: tuple[Shape, Poses],
    ) -> tuple[tuple[float, float], float]:
        """Return the joint interval in which a shape violates the clearance, and the depth."""
        owner, _, link = label.partition(".")
        obj, deepest = self.fixed[owner], 0.0

        def apart(values: np.ndarray) -> np.ndarray:
            place = (
                obj.at @ obj.tree.links({**state, joint: values}, None, [link])[link] @ shape.place
            )
            return np.array([self._apart((shape, place), other, k) for k in range(len(values))])

        ends = []
        for limit, sign in zip(obj.limits[joint][:2], (-1.0, 1.0), strict=True):
            values = np.linspace(
                state[joint], limit if np.isfinite(limit) else state[joint] + sign * np.pi, VALUES
            )
            distances = apart(values)
            beyond = np.flatnonzero(distances >= self.safe)
            inside = distances[: beyond[0]] if len(beyond) else distances
            if len(inside) and inside.min() < 0.0:
                k = int(np.argmin(inside))
                around = np.linspace(values[max(k - 1, 0)], values[min(k + 1, VALUES - 1)], VALUES)
                deepest = max(deepest, float(-apart(around).min()))
            if not len(beyond):
                ends.append(sign * np.inf)
                continue
            near, far = values[max(beyond[0] - 1, 0)], values[beyond[0]]
            for _ in range(30):
                middle = (near + far) / 2
                near, far = (
                    (near, middle) if apart(np.array([middle]))[0] >= self.safe else (middle, far)
                )
            ends.append(float(far))
        return (ends[0], ends[1]), deepest
