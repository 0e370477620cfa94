"""Checks the rest of a motion after obstacles have moved."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, format_value
from vkc_pin.options import Options
from vkc_pin.utils.arguments import check_instance, check_number
from vkc_pin.validation.clearance import ClearanceCheck
from vkc_pin.validation.report import Violation, select_worst
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.validation.validate import check_arguments
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.trajectory import Trajectory

# attributes of a scene that may differ from the prepared one
_FREE_FIELDS = {
    "name",
    "file",
    "folder",
    "obstacles",
    "obstacle_labels",
    "obstacle_names",
    "obstacle_visual",
    "obstacle_visual_labels",
    "start_region",
    "described",
    "memory",
}
_FIXED_FIELDS = {field.name for field in dataclasses.fields(Scene)} - _FREE_FIELDS
# entries of its document that may differ, or are compared one by one
_FREE_ENTRIES = {"name", "obstacles", "objects", "start_region"}


class RemainingResult(NamedTuple):
    """Result of a check of the rest of a motion.

    Attributes:
        violations: See `RemainingCheck.find_violations`.
        clear_until: Time of the last waypoint before the first violation [s]; inf without any.
    """

    violations: tuple[Violation, ...]
    clear_until: float


class RemainingCheck:
    """Checks a validated motion against obstacles that move while it is executed.

    For monitors of executions. It is prepared once for a motion that `validate` has accepted.
    `find_violations` then compares a measured scene with that of the motion, and checks the
    obstacles that differ for the rest of the motion. Distances, clearances, exemptions and the
    check between waypoints are those of `validate`:

        check = RemainingCheck(plan.scene, plan.steps, plan.trajectory, plan.options)
        scene = plan.scene.with_obstacle("person", [1.2, 0.4, 0.9, 0.0, 0.0, 0.0])
        violations = check.find_violations(scene, time=2.5)

    The obstacles count as if they had always been where they are now, and as if they stayed there.
    Whatever does not depend on distances to obstacles is not checked again; nor is whether a
    released object still rests on an obstacle.

    Args:
        scene: Scene of the motion.
        steps: Steps that the motion carries out.
        trajectory: The motion.
        options: Clearances to keep. Default: `Options()`.
        tolerances: Accepted errors of goals, at which contacts count. Default: `Tolerances()`.

    Raises:
        InputError: The trajectory does not belong to the scene's robot and objects, or is too long
            to be checked for collisions.
        UnknownNameError: A step names something that does not exist.
    """

    def __init__(
        self,
        scene: Scene,
        steps: Sequence[Step],
        trajectory: Trajectory,
        options: Options | None = None,
        *,
        tolerances: Tolerances | None = None,
    ) -> None:
        options = Options() if options is None else check_instance(options, Options, "options")
        tolerances = Tolerances() if tolerances is None else tolerances
        check_instance(tolerances, Tolerances, "tolerances")
        self._samples, asked, _ = check_arguments(scene, steps, trajectory)
        self._scene = scene
        self._document = scene.document
        if self._samples.is_truncated:
            raise InputError(
                "the motion is too long to be checked for collisions", field="trajectory"
            )
        self._clearance = ClearanceCheck(self._samples, asked, options, tolerances)

    def find_violations(self, scene: Scene, time: float = 0.0) -> tuple[Violation, ...]:
        """Find the collisions of the remaining motion with obstacles that have changed.

        Args:
            scene: The prepared scene with any number of obstacles moved (`Scene.with_obstacle`),
                replaced, added or removed.
            time: Time of the trajectory that the execution has reached [s]. The motion is checked
                from the last sample up to then, and after its end at its last configuration.

        Returns:
            Worst violation of each pair of links and constraint ("clearance" or "penetration"), in
            order of time; those that `validate` would find for these obstacles. Empty if no
            obstacle has changed.

        Raises:
            InputError: Something else than obstacles differs from the prepared scene, such as the
                placement of an object, which needs a new plan; or `time` is not a number.
        """
        return self.check(scene, time).violations

    def check(self, scene: Scene, time: float = 0.0) -> RemainingResult:
        """Find these collisions, and until when there is none.

        A violation's own time is that of its deepest point.

        Args:
            scene: See `find_violations`.
            time: See `find_violations` [s].

        Raises:
            InputError: See `find_violations`.
        """
        check_instance(scene, Scene, "scene")
        time = check_number(time, "time", "a time [s]")
        self._check_unchanged(scene)
        changed = _find_changed_obstacles(self._scene, scene)
        if not changed:
            return RemainingResult((), np.inf)
        alone = dataclasses.replace(
            scene,
            obstacles=tuple(scene.obstacles[k] for k in changed),
            obstacle_labels=tuple(scene.obstacle_labels[k] for k in changed),
        )
        row = int(np.searchsorted(self._samples.times, time, side="right")) - 1
        found = self._clearance.check_obstacles(alone, max(row, 0))
        return RemainingResult(select_worst(found.violations), found.clear_until)

    def _check_unchanged(self, scene: Scene) -> None:
        """Check that a scene differs from the prepared one in its obstacles alone."""
        if all(getattr(scene, name) is getattr(self._scene, name) for name in _FIXED_FIELDS):
            return  # as `Scene.with_obstacle` leaves them
        document = scene.document
        entries = dict.fromkeys([*self._document, *document])
        for name in entries:
            if name not in _FREE_ENTRIES:
                _check_same_entry(document.get(name), self._document.get(name), name)
        objects = _index_by_name(self._document["objects"])
        new_objects = _index_by_name(document["objects"])
        for name in dict.fromkeys([*objects, *new_objects]):
            _check_same_entry(new_objects.get(name), objects.get(name), f"objects.{name}")


def _index_by_name(entries: Sequence[Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    return {entry["name"]: entry for entry in entries}


def _check_same_entry(entry: Any, expected: Any, field: str) -> None:
    """Check that an entry of a scene's document has not changed."""
    if entry != expected:
        raise InputError(
            "only obstacles may differ from the prepared scene; plan again if anything else does",
            field=f"scene.{field}",
            expected=format_value(expected),
            got=format_value(entry),
        )


def _find_changed_obstacles(before: Scene, now: Scene) -> list[int]:
    """Return the indices of the shapes of obstacles that were not there before, or elsewhere."""
    shapes_before = _group_obstacles(before)
    changed = list[int]()
    for label, indices in _group_obstacles(now).items():
        shapes = [now.obstacles[k] for k in indices]
        old_shapes = [before.obstacles[k] for k in shapes_before.get(label, [])]
        if len(shapes) != len(old_shapes) or not all(map(_is_same_shape, shapes, old_shapes)):
            changed += indices
    return sorted(changed)


def _group_obstacles(scene: Scene) -> dict[str, list[int]]:
    """Return obstacle → indices of its shapes."""
    groups = dict[str, list[int]]()
    for k, label in enumerate(scene.obstacle_labels):
        groups.setdefault(label, []).append(k)
    return groups


def _is_same_shape(one: pin.GeometryObject, other: pin.GeometryObject) -> bool:
    if one is other:
        return True
    return bool(one.placement == other.placement and one.geometry == other.geometry)
