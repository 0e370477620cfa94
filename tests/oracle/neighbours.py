"""Finds pairs that may stay close: pairs that a scene allows, and pairs close by construction.

Neighbours are a shape of an articulated object and a shape of another object or obstacle that are
closer than the clearance, at the start or with all joints at zero. They need no clearance while
each of their joints is in the interval in which it alone keeps them that close. Neighbours that
overlap at the start may overlap as much later, and by an error of the model at least. A leaf with
its hinge inside the other shape may penetrate it further, by its thickness. An overlap with all
joints at zero alone is an error of the model if it is small. Otherwise the pair is not exempt.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .plan import NotJudged
from .poses import make_pose
from .supports import compute_distance

if TYPE_CHECKING:
    from .poses import Poses
    from .stage import Solid, Stage, World
    from .urdf import Shape

__all__ = ["Neighbours"]

SLACK = 1e-3  # [m] of the clearance
ROUNDING = 1e-4  # [m] of penetration
MODEL_ERROR = 0.005  # [m] of penetration; kitchens of other packages have up to 0.004
VALUES = 150  # of a joint between its state and a limit


@dataclass(frozen=True)
class Pair:
    """Two shapes, the allowed penetration [m], and "<object>.<joint>" → interval of the joint."""

    shapes: frozenset[tuple[str, int]]
    depth: float
    joints: Mapping[str, tuple[float, float]]


class Neighbours:
    """The neighbouring pairs of a world."""

    def __init__(self, world: World) -> None:
        self.world, self.clearance = world, float(world.plan.options["dist_safe"])
        self.allowed_pairs = list(self._read_allowed_pairs())
        self.fixed = {name: obj for name, obj in world.objects.items() if not obj.free}
        zeros = {
            name: {joint: float(np.clip(0.0, *obj.limits[joint][:2])) for joint in obj.state}
            for name, obj in self.fixed.items()
        }
        self.pairs = [
            *self._find_pairs({name: obj.state for name, obj in self.fixed.items()}, at_start=True),
            *self._find_pairs(zeros, at_start=False),
        ]

    def _read_allowed_pairs(self) -> list[tuple[str, str, float]]:
        pairs = []
        for item in self.world.plan.scene.get("allow") or ():
            if item.get("srdf"):
                root = ElementTree.parse(self.world.plan.folder / item["srdf"]).getroot()
                if root.find("disable_default_collisions") is not None:
                    raise NotJudged("an SRDF with defaults of links")
                pairs += [
                    (pair.get("link1"), pair.get("link2"), -np.inf)
                    for pair in root.iter("disable_collisions")
                ]
            else:
                margin = item.get("margin")
                pairs.append((*item["pair"], -np.inf if margin is None else float(margin)))
        return pairs

    def get_margin(self, one: Solid, other: Solid) -> float:
        """Return the clearance that a scene sets for two shapes; infinite by default."""

        def matches(name: str, part: Solid) -> bool:
            if part.owner in self.world.objects and part.label == f"{part.owner}.{name}":
                return True  # as an SRDF names links
            return part.label == name or (part.owner == name and name in self.world.objects)

        return min(
            (
                margin
                for a, b, margin in self.allowed_pairs
                if (matches(a, one) and matches(b, other))
                or (matches(a, other) and matches(b, one))
            ),
            default=np.inf,
        )

    def find_exempt_samples(
        self, stage: Stage, one: Solid, other: Solid
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples at which shapes need no clearance, and the allowed penetrations."""
        close, depth = np.zeros(len(stage.times), bool), np.zeros(len(stage.times))
        shapes = frozenset((part.label, id(part.shape)) for part in (one, other))
        for pair in self.pairs:
            if pair.shapes == shapes:
                inside = np.ones(len(stage.times), bool)
                for name, (low, high) in pair.joints.items():
                    index, (owner, _, joint) = self.world.plan.find_index(name), name.partition(".")
                    values = (
                        stage.columns[:, index]
                        if index is not None
                        else np.array([self.fixed[owner].state[joint]])
                    )
                    inside &= (low <= values) & (values <= high)
                close |= inside
                depth = np.maximum(depth, np.where(inside, pair.depth, 0.0))
        return close, depth

    def _find_pairs(self, state: dict[str, dict[str, float]], *, at_start: bool) -> list[Pair]:
        """Return the close pairs in a state of the objects' joints."""
        links = {
            name: obj.tree.compute_links(state[name], None, obj.tree.urdf.links)
            for name, obj in self.fixed.items()
        }
        parts: list[tuple[str, Shape, Poses]] = []
        for name, obj in self.fixed.items():
            for shape in obj.tree.urdf.shapes:
                parts.append(
                    (
                        f"{name}.{shape.link}",
                        shape,
                        obj.placement @ links[name][shape.link] @ shape.placement,
                    )
                )
        parts += [
            (solid.label, solid.shape, solid.poses)
            for solid in self.world.obstacles
            if solid.owner != "floor"
        ]
        pairs, done = [], set()
        centres = np.array(
            [(placement @ make_pose(shape.centre)).translation[0] for _, shape, placement in parts]
        )
        radii = np.array([shape.radius for _, shape, _ in parts])
        for k, (label, shape, placement) in enumerate(parts):
            if not self._find_joints(label):
                continue
            distances = np.linalg.norm(centres - centres[k], axis=1) - radii - radii[k]
            for other, other_shape, other_placement in (
                parts[i] for i in np.flatnonzero(distances <= self.clearance)
            ):
                shapes = frozenset(((label, id(shape)), (other, id(other_shape))))
                if label.partition(".")[0] == other.partition(".")[0] or shapes in done:
                    continue
                done.add(shapes)
                distance = self._compute_distance(
                    (shape, placement), (other_shape, other_placement)
                )
                is_model_error = distance >= -MODEL_ERROR
                if distance < self.clearance - SLACK and (at_start or is_model_error):
                    ranges, turns_inside, sides = {}, True, []
                    for (moving_label, moving_shape), (_, fixed_shape, fixed_placement) in (
                        ((label, shape), (other, other_shape, other_placement)),
                        ((other, other_shape), (label, shape, placement)),
                    ):
                        owner = moving_label.partition(".")[0]
                        joints = self._find_joints(moving_label)
                        for joint in joints:
                            interval, always_overlaps = self._find_joint_range(
                                moving_label,
                                moving_shape,
                                joint,
                                state[owner],
                                (fixed_shape, fixed_placement),
                            )
                            ranges[f"{owner}.{joint}"] = interval
                            kind = self.fixed[owner].tree.urdf.get_joint_type(joint)
                            turns_inside &= always_overlaps and kind != "prismatic"
                        sides += [2.0 * float(moving_shape.half.min())] if joints else []
                    depth = 0.0
                    if distance < -ROUNDING:
                        depth = max(MODEL_ERROR, -distance)
                    if distance < -ROUNDING and at_start and turns_inside:
                        depth = max(MODEL_ERROR, -distance + min(sides))
                    pairs.append(Pair(shapes, depth, ranges))
        return pairs

    def _compute_distance(
        self, one: tuple[Shape, object], other: tuple[Shape, object], k: int = 0
    ) -> float:
        (a, placement), (b, other_placement) = one, other
        i, j = (0 if len(poses.rotation) == 1 else k for poses in (placement, other_placement))
        centres = (
            placement.rotation[i] @ a.centre + placement.translation[i],
            other_placement.rotation[j] @ b.centre + other_placement.translation[j],
        )
        lower_bound = float(np.linalg.norm(centres[0] - centres[1])) - a.radius - b.radius
        return (
            lower_bound
            if lower_bound > self.clearance
            else compute_distance(a.solid, placement, b.solid, other_placement, k)
        )

    def _find_joints(self, label: str) -> list[str]:
        owner, _, link = label.partition(".")
        if owner not in self.fixed:
            return []
        urdf = self.fixed[owner].tree.urdf
        return [joint for joint in urdf.find_joint_path(link) if urdf.is_movable(joint)]

    def _find_joint_range(
        self,
        label: str,
        shape: Shape,
        joint: str,
        state: dict[str, float],
        other: tuple[Shape, Poses],
    ) -> tuple[tuple[float, float], bool]:
        """Return the joint interval in which a shape violates the clearance.

        Also return whether it overlaps the other shape at every value of the joint.
        """
        owner, _, link = label.partition(".")
        obj, always_overlaps = self.fixed[owner], True

        def compute_distances(values: np.ndarray) -> np.ndarray:
            placement = (
                obj.placement
                @ obj.tree.compute_links({**state, joint: values}, None, [link])[link]
                @ shape.placement
            )
            return np.array(
                [self._compute_distance((shape, placement), other, k) for k in range(len(values))]
            )

        ends = []
        for limit, sign in zip(obj.limits[joint][:2], (-1.0, 1.0), strict=True):
            values = np.linspace(
                state[joint], limit if np.isfinite(limit) else state[joint] + sign * np.pi, VALUES
            )
            distances = compute_distances(values)
            beyond = np.flatnonzero(distances >= self.clearance)
            always_overlaps &= bool((distances < -ROUNDING).all())
            if not len(beyond):
                ends.append(sign * np.inf)
                continue
            near, far = values[max(beyond[0] - 1, 0)], values[beyond[0]]
            for _ in range(30):
                middle = (near + far) / 2
                near, far = (
                    (near, middle)
                    if compute_distances(np.array([middle]))[0] >= self.clearance
                    else (middle, far)
                )
            ends.append(float(far))
        return (ends[0], ends[1]), always_overlaps
