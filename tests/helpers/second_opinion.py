"""Collects the successful plans of all planners, and lets the oracle judge them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from oracle.judge import Verdict, judge

from tests.benchmarks.peers import found as peers
from vkc_pin.experiments.baselines import separate
from vkc_pin.planning import results, solve_task
from vkc_pin.planning.plan import Plan

__all__ = ["PlanJudge"]


class PlanJudge:
    """Collects successful plans and judges them.

    Attributes:
        planned, judged: Number of collected plans, and of distinct plans that were judged.
        unjudged: Reasons of plans that could not be judged.
        seconds: Time spent on judging [s].
    """

    def __init__(self) -> None:
        self.planned = self.judged = 0
        self.unjudged: list[str] = []
        self.seconds = 0.0
        self._waiting: list[Plan] = []
        self._known: set[str] = set()

    def attach(self) -> None:
        """Start to collect plans."""

        def make_plan(*values: Any, **fields: Any) -> Plan:
            plan = Plan(*values, **fields)
            if plan.success:
                self._waiting.append(plan)
            return plan

        for module in (results, solve_task, separate, peers):
            module.Plan = make_plan  # type: ignore[attr-defined]

    def drop_plans(self) -> None:
        """Drop the plans collected since the last call of `verdicts`."""
        self._waiting.clear()

    def verdicts(self, folder: Path) -> list[Verdict]:
        """Judge the plans collected since the last call; return the verdicts that disagree."""
        found = []
        waiting = self._waiting
        self._waiting = []
        self.planned += len(waiting)
        for plan in waiting:
            digest = _compute_digest(plan)
            if digest in self._known:
                continue
            self._known.add(digest)
            path = plan.save(folder / f"{digest}.npz")
            verdict = judge(path)
            self.judged += not verdict.unjudged
            self.unjudged += [verdict.unjudged] if verdict.unjudged else []
            self.seconds += verdict.seconds
            if verdict.agrees:
                path.unlink()
            else:
                found.append(verdict)
        return found


def _compute_digest(plan: Plan) -> str:
    task = [
        plan.scene.document,
        str(plan.scene.folder),
        plan.to_dict()["steps"],
        vars(plan.options),
    ]
    content = json.dumps([task, plan.trajectory.to_dict()], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:16]
