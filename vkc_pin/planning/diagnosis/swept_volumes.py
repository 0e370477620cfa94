"""Proves that an object's link collides between its start and its goal, whoever moves it."""

from __future__ import annotations

import itertools

import numpy as np

from vkc_pin.planning.diagnosis.proofs import PROVEN
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.scene.clearance_exemptions import PlacedShapes, find_clearance_exemptions
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.task.phases import Phase

__all__ = ["find_swept_collisions"]

_CERTAIN_OVERLAP = 1e-3  # [m] more than validation accepts
_SAMPLES = 200  # joint values between start and goal


def find_swept_collisions(problem: TrajectoryProblem) -> list[str]:
    """Explain which object joint certainly cannot reach its goal; empty if nothing is proven.

    A link that depends on a single joint passes all positions between start and goal on any motion.
    """
    for phase in problem.task.phases:
        for coordinate in phase.values:
            text = _find_collision(problem, phase, coordinate)
            if text:
                return [f"{phase.name}: no path for {coordinate}, {PROVEN}{text}"]
    return []


def _find_collision(problem: TrajectoryProblem, phase: Phase, coordinate: str) -> str:
    """Return which link a joint moves into what in a phase; empty if no collision is certain."""
    scene, (name, _, joint) = problem.scene, coordinate.partition(".")
    placed = scene.objects[name]
    if placed.object.free:
        return ""
    begin = phase.initial_values[coordinate]
    end = float(np.clip(phase.values[coordinate], *problem.limits(coordinate)))
    values = np.linspace(begin, end, _SAMPLES)
    fixed = {owner: one for owner, one in scene.objects.items() if not one.object.free}
    shapes = PlacedShapes(scene, fixed)
    exemptions = find_clearance_exemptions(scene, problem.options.dist_safe)
    links = {
        f"{owner}.{link}": shapes.find_joints(f"{owner}.{link}")
        for owner, one in fixed.items()
        for link in one.object.links
    }
    swept = [f"{name}.{link}" for link in placed.object.links if links[f"{name}.{link}"] == [joint]]
    others = {
        label for label, joints in links.items() if not joints and label.partition(".")[0] != name
    }
    others |= set(scene.obstacle_labels) - {FLOOR}
    deepest, text = -_CERTAIN_OVERLAP, ""
    index = placed.object.coordinates.index(joint)
    for label in swept:
        for other in sorted(others & shapes.find_links_near_sweep(label, index, values)):
            own, hit = shapes.find_shapes([label]), shapes.find_shapes([other])
            distances = shapes.compute_distances(label, index, values, hit, 0.0)
            for one in exemptions:
                if not one.is_between(label, other):
                    continue
                is_active = one.is_active([coordinate], values[:, None])
                pairs = set(one.find_shape_pairs(shapes.labels, shapes.keys))
                for k, j in itertools.product(range(len(own)), range(len(hit))):
                    if (min(own[k], hit[j]), max(own[k], hit[j])) in pairs:
                        distances[is_active, k, j] += max(0.0, -one.margin)
            distance = distances.min(axis=(1, 2))
            worst = int(np.argmin(distance))
            if distance[worst] < deepest:
                deepest = float(distance[worst])
                first = values[np.argmax(distance < -_CERTAIN_OVERLAP)]
                text = (
                    f"between {begin:.3g} and {end:.3g}, at {values[worst]:.3g}, {label} – {other} "
                    f"overlap by {-1e3 * deepest:.1f} mm, and first at {first:.3g}"
                )
    return text
