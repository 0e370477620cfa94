"""What a notebook shows of a plan that is a cell's value: what came out, a small table, and the motion from above."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from vkc_pin.overview import card, picture, table

if TYPE_CHECKING:
    from vkc_pin.plan import Plan

__all__ = ["plan_html"]

_LISTED = 6  # violations and notes that are shown; the report has them all
_GOOD, _BAD = "#1a7f37", "#c62828"


def plan_html(plan: Plan) -> str:
    """Return a plan's overview as HTML; it needs no screen, and nothing from elsewhere."""
    m = plan.metrics
    good = plan.success
    status = "success" if good else f"FAILED, {plan.status}"
    head = f'<b>{escape(plan.scene.name)}: <span style="color: {_GOOD if good else _BAD}">{escape(status)}</span></b>'
    phases = escape(", ".join(phase.name for phase in plan.trajectory.phases))
    rows = [
        ("base", _value(m, "base_effort", "m", 2)),
        ("arm", _value(m, "arm_effort", "rad", 2)),
        ("clearance", _value(m, "clearance", "mm", 1, 1e3)),
        ("duration", _value(m, "duration", "s", 1)),
        ("planned in", _value(m, "planning_time", "s", 2)),
        ("seed", escape(f"{plan.initialization or 'unknown'}, random numbers {plan.seed}")),
    ]
    found = [str(violation) for violation in plan.validation.violations] + list(plan.validation.notes)
    lines = [*found[:_LISTED], *([f"... and {len(found) - _LISTED} more"] if len(found) > _LISTED else [])]
    listed = "".join(f"<li>{escape(line)}</li>" for line in lines)
    problems = f'<ul style="color: {_BAD}; margin: 4px 0">{listed}</ul>' if lines else ""
    view = picture(plan.scene, plan.trajectory, "the motion from above")
    return card(f"{head}<div>{phases}</div>{table(rows)}{problems}", view)


def _value(metrics: Mapping[str, float], name: str, unit: str, digits: int, factor: float = 1.0) -> str:
    value = metrics.get(name)
    return f"{factor * value:.{digits}f} {unit}" if value is not None and np.isfinite(value) else "–"
