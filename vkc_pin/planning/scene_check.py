"""Checks a scene before planning: close pairs, reachable attachments, and directions of frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.base_paths.reachable_floor import CELL, find_free_floor
from vkc_pin.planning.diagnosis.diagnosis import diagnose_goals, find_impossible_conditions
from vkc_pin.planning.initialization.keyframes import sample_goal_configurations
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.merit import TOLERANCE
from vkc_pin.utils.arguments import check_instance, check_integer
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.cache import Cache
from vkc_pin.world.scene.clearance_exemptions import (
    ACCEPTED_SHORTFALL,
    ClearanceExemption,
    ClosePair,
    find_clearance_exemptions,
    find_close_pairs,
)
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Grasp, Reach

_LITTLE_FLOOR = 1.0  # [m²] for the base's origin; less than 1 m² keeps most bases from turning
_FAR = 0.25  # largest reported clearance [m]


@dataclass(frozen=True, eq=False)
class ReachableAttachment:
    """Reachability of an attachment.

    Attributes:
        object, attachment: Names of object and attachment.
        approach: Approach direction of the hand in the world frame, shape (3,).
        closing: Closing direction of the fingers in the world frame, shape (3,).
        configuration: Robot coordinates of the found grasp with the largest clearance, shape (n,);
            None if none was found.
        clearance: Its clearance, at most 0.25 [m].
        because: Reason why none was found.
    """

    object: str
    attachment: str
    approach: Floats
    closing: Floats
    configuration: Floats | None = None
    clearance: float = 0.0
    because: str = ""

    def __str__(self) -> str:
        where = ", ".join(f"{value:.2f}" for value in self.approach + 0.0)
        head = f"{self.object}.{self.attachment}, approach ({where})"
        if self.configuration is None:
            return f"{head}: not reached, {self.because}"
        x, y, yaw = self.configuration[:3]
        more = "" if self.clearance < _FAR else "more than "
        least = f"{more}{1e3 * min(self.clearance, _FAR):.0f} mm"
        return f"{head}: reached from ({x:.2f}, {y:.2f}) at {yaw:.2f} rad, with {least} of air"


@dataclass(frozen=True, eq=False)
class SceneCheck:
    """Result of checking a scene.

    Attributes:
        scene: The scene.
        dist_safe: Required clearance [m].
        robot: Close pairs of the robot at the start, with itself, objects and obstacles.
        close: Other movable links that are close to something.
        allowed: Pairs that are exempt from clearance.
        attachments: Attachments of all objects that are not grasped.
        problems: Reasons why nothing can be planned.
        warnings: Reasons why planning may fail.
    """

    scene: Scene
    dist_safe: float
    robot: tuple[ClosePair, ...]
    close: tuple[ClosePair, ...]
    allowed: tuple[ClearanceExemption, ...]
    attachments: tuple[ReachableAttachment, ...]
    problems: tuple[str, ...]
    warnings: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether planning is possible, and every object with attachments can be grasped."""
        reached = {one.object for one in self.attachments if one.configuration is not None}
        return not self.problems and reached == {one.object for one in self.attachments}

    def lines(self) -> list[str]:
        """Return the result as lines of text."""
        scene = self.scene
        counts = f"{len(scene.objects)} objects, {len(scene.obstacle_names)} obstacles"
        found = [f"{scene.name}: {scene.robot.name}, {counts}"]
        near, overlapping = (
            [pair for pair in self.close if (pair.distance < 0.0) == overlaps]
            for overlaps in (False, True)
        )
        closer = f"closer than {1e3 * self.dist_safe:g} mm to"
        for title, entries in (
            ("nothing can be planned, because", self.problems),
            ("planning may fail, because", self.warnings),
            (f"the robot is {closer}", self.robot),
            (f"{closer} each other", near),
            ("one in the other", overlapping),
            ("may be close", [_describe(one) for one in self.allowed]),
            ("attachments", self.attachments),
        ):
            if entries:
                found += [f"  {title}", *(f"    {entry}" for entry in entries)]
        return found

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def plot(self, path: str | Path | None = None) -> Any:
        """Draw the scene from above, with close pairs and reachable attachments; see `plot_scene`.

        Args:
            path: File of the picture; None: none is written.

        Returns:
            The matplotlib figure.

        Raises:
            InputError: The file name is not that of a picture.
        """
        from vkc_pin.visualization.plots.scene_view import Approach, plot_scene

        arrows = []
        for one in self.attachments:
            placed = self.scene.objects[one.object]
            grasp = placed.object.attachments[one.attachment]
            tool = placed.link_placement(grasp.link) * grasp.tool(np.zeros(len(grasp.freedoms)))
            base = None if one.configuration is None else one.configuration[:3]
            arrows.append(
                Approach(f"{one.object}.{one.attachment}", tool.translation, one.approach, base)
            )
        overlaps = [pair for pair in (*self.robot, *self.close) if pair.distance < 0.0]
        labels = [label for pair in overlaps for label in (pair.first, pair.second)]
        return plot_scene(self.scene, arrows, labels, path)


def check_scene(scene: Scene, *, options: Options | None = None, seed: int = 0) -> SceneCheck:
    """Check a scene as a plan would see it: close or overlapping pairs, and reachable attachments.

    Args:
        scene: The scene.
        options: Clearances. Default: `Options()`.
        seed: Random seed of the configurations with which attachments are tried.

    Returns:
        The result. It is no guarantee: a reachable attachment need not be on any path, and another
        one may be reachable nevertheless.

    Raises:
        InputError: An argument is invalid.
    """
    check_instance(scene, Scene, "scene")
    options = Options() if options is None else check_instance(options, Options, "options")
    seed, cache = check_integer(seed, "seed", low=0), Cache()
    reach = [Reach(scene.tool_placement())]
    problem = KinematicProblem(
        scene, compile_task(scene, reach, options, nothing=True), options, cache=cache
    )
    contacts = problem.contacts.evaluate(
        problem.start[None], np.array([0]), reach=options.dist_safe
    )
    labels = problem.contacts.phases[0].labels
    pairs: dict[tuple[str, str], float] = {}
    for (i, j), distance in zip(contacts.pair.tolist(), contacts.distance.tolist(), strict=True):
        key = (labels[i], labels[j])
        pairs[key] = min(distance, pairs.get(key, np.inf))
    return SceneCheck(
        scene=scene,
        dist_safe=options.dist_safe,
        robot=tuple(
            sorted(
                (ClosePair(*key, distance) for key, distance in pairs.items()),
                key=lambda pair: pair.distance,
            )
        ),
        close=tuple(find_close_pairs(scene, options.dist_safe)),
        allowed=find_clearance_exemptions(scene, options.dist_safe),
        attachments=tuple(_check_attachments(scene, options, seed, cache)),
        problems=tuple(
            f"{one.subject}: {one.detail}" for one in find_impossible_conditions(problem)
        ),
        warnings=tuple(_check_floor(scene)),
    )


def _check_floor(scene: Scene) -> Iterator[str]:
    """Yield a warning if the base has so little floor that it can hardly turn."""
    from scipy import ndimage

    if scene.robot.base == "fixed":
        return
    cells, free = find_free_floor(scene)
    regions, _ = ndimage.label(free)
    start = regions[cells.at(scene.start[:2])]
    area = float((regions == start).sum()) * CELL**2 if start else 0.0
    x_low, x_high, y_low, y_high = scene.arena
    if area < _LITTLE_FLOOR:
        yield (
            f"the base reaches at most {area:.1f} m² of floor in the arena of "
            f"{x_high - x_low:.1f} × {y_high - y_low:.1f} m: make the arena larger, "
            "or move the start"
        )


def _check_attachments(
    scene: Scene, options: Options, seed: int, cache: Cache
) -> Iterator[ReachableAttachment]:
    empty = scene.with_held({})
    for name, placed in scene.objects.items():
        attachments = placed.object.attachments if name not in scene.held else {}
        for attachment, grasp in attachments.items():
            turned = (placed.link_placement(grasp.link) * grasp.placement).rotation
            about: dict[str, Any] = {
                "approach": turned[:, 2].copy(),
                "closing": turned[:, 0].copy(),
            }
            try:
                task = compile_task(empty, [Grasp(name, attachment)], options, nothing=True)
            except InputError as error:
                yield ReachableAttachment(name, attachment, **about, because=str(error))
                continue
            problem = KinematicProblem(empty, task, options, cache=cache)
            yield ReachableAttachment(name, attachment, **about, **_find_grasp(problem, seed))


def _find_grasp(problem: KinematicProblem, seed: int) -> dict[str, Any]:
    """Return the sampled grasp with the largest clearance, or the reason why there is none."""
    end, safe = int(problem.ends[-1]), problem.options.dist_safe
    for draw in range(3):
        tried = sample_goal_configurations(problem, end, np.random.default_rng((seed, draw)))
        z = np.zeros((0, problem.chain.size)) if tried is None else tried[0][tried[1] < TOLERANCE]
        if not len(z):
            continue
        contacts = problem.contacts.evaluate(z, np.full(len(z), end), reach=_FAR)
        clearance = np.full(len(z), _FAR)
        full = contacts.margin >= safe
        np.minimum.at(clearance, contacts.waypoint[full], contacts.distance[full])
        clearance[contacts.compute_shortfall(len(z)) > ACCEPTED_SHORTFALL] = -np.inf
        best = int(np.argmax(clearance))
        if clearance[best] > -np.inf:
            robot = problem.chain.robot.coordinates.size
            return {"configuration": z[best, :robot].copy(), "clearance": float(clearance[best])}
    blocked = diagnose_goals(problem, seed)
    return {"because": blocked[0].text if blocked else "no free configuration was found"}


def _describe(one: ClearanceExemption) -> str:
    kept = "at any distance" if one.margin == -np.inf else f"down to {1e3 * one.margin:.4g} mm"
    ends = {
        name: [f"{end:.3g}" if np.isfinite(end) else "its limit" for end in both]
        for name, both in one.ranges.items()
    }
    while_ = ", ".join(f"{name} from {low} to {high}" for name, (low, high) in ends.items())
    return f"{one} {kept}, " + (f"with {while_}" if while_ else "as the scene says")
