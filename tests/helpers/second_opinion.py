"""Lets the oracle judge every motion that is planned, by keeping the plans that planners make."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from oracle.judge import Verdict, judge

from vkc_pin.baselines import separate
from vkc_pin.benchmarks.peers import found as peers
from vkc_pin.planning import results, solve_task
from vkc_pin.planning.plan import Plan

__all__ = ["SecondOpinion"]


class SecondOpinion:
    """Keeps the plans that succeed, and judges them.

    Attributes:
        planned, judged: How many motions were planned, and how many different ones were judged.
        unjudged: Why others were not.
        seconds: What judging took.
    """

    def __init__(self) -> None:
        self.planned = self.judged = 0
        self.unjudged: list[str] = []
        self.seconds = 0.0
        self._waiting: list[Plan] = []
        self._known: set[str] = set()

    def attach(self) -> None:
        """Listen from now on."""

        def make_plan(*values: Any, **fields: Any) -> Plan:
            plan = Plan(*values, **fields)
            if plan.success:
                self._waiting.append(plan)
            return plan

        for module in (results, solve_task, separate, peers):
            module.Plan = make_plan  # type: ignore[attr-defined]

    def forget(self) -> None:
        """Drop the plans made since the last call of `verdicts`."""
        self._waiting.clear()

    def verdicts(self, folder: Path) -> list[Verdict]:
        """Judge the motions planned since the last call; return the verdicts that disagree."""
        found, waiting, self._waiting = [], self._waiting, []
        self.planned += len(waiting)
        for plan in waiting:
            if (digest := _digest(plan)) in self._known:
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


def _digest(plan: Plan) -> str:
    about = [
        plan.scene.document,
        str(plan.scene.folder),
        plan.to_dict()["steps"],
        vars(plan.options),
    ]
    content = json.dumps([about, plan.trajectory.to_dict()], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:16]
