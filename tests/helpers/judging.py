"""Validates plans, and changes their scenes and motions."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import pinocchio as pin

import vkc_pin as vkc
from vkc_pin.validation.report import Report, Violation
from vkc_pin.validation.validate import validate
from vkc_pin.world.models.articulated_object import Attachment
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory


def get_only_violation(report: Report) -> Violation:
    """Return the only violation of a report."""
    assert len(report.violations) == 1, "\n".join(report.lines())
    return report.violations[0]


def check_only_violation(
    report: Report, constraint: str, subject: str, unit: str | None = None, **fields: Any
) -> Violation:
    """Check and return the only violation of a report; `fields` are further expected values."""
    found = get_only_violation(report)
    expected = {"constraint": constraint, "subject": subject, "unit": unit or found.unit, **fields}
    assert {name: getattr(found, name) for name in expected} == expected
    return found


def get_violation_names(report: Report) -> set[tuple[str, str]]:
    return {(violation.constraint, violation.subject) for violation in report.violations}


def check(
    plan: vkc.Plan,
    *,
    scene: Scene | None = None,
    trajectory: Trajectory | None = None,
    **options: float,
) -> Report:
    """Validate a plan with another scene, trajectory or options."""
    return validate(
        scene or plan.scene,
        plan.steps,
        trajectory or plan.trajectory,
        dataclasses.replace(plan.options, **options),
    )


def replace_object(
    scene: Scene, name: str = "door", *, placement: pin.SE3 | None = None, **fields: object
) -> Scene:
    """Return `scene` with another placement or other fields of an object."""
    placed = scene.objects[name]
    changed = dataclasses.replace(placed, object=dataclasses.replace(placed.object, **fields))
    if placement is not None:
        changed = dataclasses.replace(changed, placement=placement)
    return dataclasses.replace(scene, objects={**scene.objects, name: changed})


def replace_attachments(scene: Scene, change: Mapping[str, Attachment]) -> Scene:
    return replace_object(scene, attachments={**scene.objects["door"].object.attachments, **change})


def get_approach(plan: vkc.Plan) -> Trajectory:
    """Return the first phase of the planned motion."""
    return plan.trajectory.parts()[0]
