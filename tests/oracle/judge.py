"""Judges a saved plan."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from .collisions import check_collisions
from .goals import check_goals
from .motors import check_motors
from .neighbours import Neighbours
from .plan import NotJudged, SavedPlan, Violation, read_plan
from .rules import check_motion, check_stage
from .stage import World
from .touching import find_licences

__all__ = ["Verdict", "find_violations", "judge"]


@dataclass
class Verdict:
    """A plan's own verdict, and the violations found here.

    `unjudged` is the reason if the plan could not be judged.
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
    began = time.perf_counter()
    plan = read_plan(path)
    verdict = Verdict(path, plan.success, plan.status, plan.says)
    try:
        verdict.found = find_violations(plan)
    except NotJudged as error:
        verdict.unjudged = str(error)
    except FileNotFoundError as error:  # the scene has moved away from its plan
        verdict.unjudged = f"no longer there: {error}"
    verdict.seconds = time.perf_counter() - began
    return verdict


def find_violations(plan: SavedPlan) -> list[Violation]:
    """Return the worst violation of each rule and subject, sorted by time."""
    world = World(plan)
    stages = list(world.stages())
    found = [*check_motion(world), *check_goals(world, stages)]
    allowed, built = find_licences(world, stages), Neighbours(world)
    for stage in stages:
        found += check_stage(world, stage)
        found += check_motors(world, stage)
        found += check_collisions(world, stage, allowed, built)
    worst: dict[tuple[str, str], Violation] = {}
    for one in found:
        key = (one.rule, one.subject)
        if key not in worst or worst[key].amount < one.amount:
            worst[key] = one
    for rule, subject in list(worst):
        if rule == "overlap":
            worst.pop(("clearance", subject), None)
    return sorted(worst.values(), key=lambda one: (one.time, one.rule, one.subject))
