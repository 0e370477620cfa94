"""Judges saved plans."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from .collisions import check_collisions
from .exemptions import find_exemptions
from .goals import check_goals
from .loads import check_loads
from .motors import check_motors
from .neighbours import Neighbours
from .plan import NotJudged, SavedPlan, Violation, read_plan
from .rules import check_motion, check_stage
from .stage import World

__all__ = ["Verdict", "find_violations", "judge"]


@dataclass
class Verdict:
    """A plan's own verdict, and the violations that the oracle finds.

    `says` are the violations in the plan's own report. `unjudged` is the reason why the oracle
    cannot judge the plan.
    """

    path: Path
    success: bool
    status: str
    says: list[str]
    found: list[Violation] = field(default_factory=list)
    unjudged: str = ""
    seconds: float = 0.0

    @property
    def agrees(self) -> bool:
        return bool(self.unjudged) or self.success == (not self.found)


def judge(path: Path) -> Verdict:
    """Return the verdict on a saved plan."""
    start_time = time.perf_counter()
    plan = read_plan(path)
    verdict = Verdict(path, plan.success, plan.status, plan.violations)
    try:
        verdict.found = find_violations(plan)
    except NotJudged as error:
        verdict.unjudged = str(error)
    except FileNotFoundError as error:  # files of the scene were moved
        verdict.unjudged = f"no longer there: {error}"
    verdict.seconds = time.perf_counter() - start_time
    return verdict


def find_violations(plan: SavedPlan) -> list[Violation]:
    """Return the worst violation of each rule and subject, sorted by time."""
    world = World(plan)
    stages = list(world.iterate_stages())
    violations = [*check_motion(world), *check_goals(world, stages), *check_loads(world, stages)]
    exemptions, neighbours = find_exemptions(world, stages), Neighbours(world)
    for stage in stages:
        violations += check_stage(world, stage)
        violations += check_motors(world, stage)
        violations += check_collisions(world, stage, exemptions, neighbours)
    worst: dict[tuple[str, str], Violation] = {}
    for violation in violations:
        key = (violation.rule, violation.subject)
        if key not in worst or worst[key].amount < violation.amount:
            worst[key] = violation
    for rule, subject in list(worst):
        if rule == "overlap":
            worst.pop(("clearance", subject), None)
    return sorted(
        worst.values(), key=lambda violation: (violation.time, violation.rule, violation.subject)
    )
