"""Judges how robots really moved in the closed loop, and compares with the experiment's verdict.

Usage: `python -m tests.oracle.executed FOLDER`, after
`vkc-pin bench closed-loop --save-motions --out FOLDER`.

Of the rules of plans, those count that a robot in physics can keep: it overlaps nothing, objects
included that it pushed, and reaches its goals. Overlaps do not count before it was known what is
elsewhere.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .judge import find_violations
from .plan import Violation, read_plan
from .stage import World

DEEPEST = 1e-3  # [m] of overlaps that count as none
MISS, ANGULAR_MISS = 0.01, 0.02  # [m], [rad] of goals beyond the tolerances of plans


class Comparison(NamedTuple):
    """The experiment's verdict on a trial, and what the oracle finds in its motion."""

    trial: Mapping[str, Any]
    found: list[Violation]


def judge_executed(path: Path, trial: Mapping[str, Any]) -> list[Violation]:
    """Return the violations of a saved motion that count.

    Args:
        path: The motion.
        trial: Its record.
    """
    counting = []
    motion = read_plan(path)
    world = World(motion)
    for violation in find_violations(motion):
        clock = violation.time + trial["recorded_since"]
        is_known = clock >= find_begin(violation.subject, trial)
        is_overlap = violation.rule == "overlap" and violation.amount > DEEPEST
        allowed = get_allowed_miss(world, violation.subject)
        is_miss = violation.rule == "goal" and violation.amount > allowed
        if is_miss or (is_overlap and is_known):
            counting.append(violation)
    return counting


def get_allowed_miss(world: World, subject: str) -> float:
    """Return the accepted miss of a goal: of a joint "<object>.<joint>" that turns, or other."""
    owner, _, joint = subject.partition(".")
    item = world.objects.get(owner)
    turns = item is not None and joint in item.state and not item.is_prismatic(joint)
    return ANGULAR_MISS if turns else MISS


def find_begin(subject: str, trial: Mapping[str, Any]) -> float:
    """Return when the places of two links, "one - other", and of the robot became known [s]."""
    times = [trial["robot_since"]]
    owners = [label.partition(".")[0] for label in subject.split(" - ")]
    if trial["object"] in owners:
        times.append(trial["object_since"])
    return max(math.inf if time is None else time for time in times)


def compare_all(folder: Path) -> list[Comparison]:
    """Judge the motions of all trials that were planned."""
    result = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    comparisons = []
    for trial in result["trials"]:
        if trial["success"]:
            found = judge_executed(folder / "motions" / f"{trial['key']}.npz", trial)
            comparisons.append(Comparison(trial, found))
    return comparisons


def format_comparisons(comparisons: Sequence[Comparison]) -> str:
    """Return a Markdown table of agreements, and a list of the trials with disagreement."""
    rows = ["| experiment | oracle | motions |", "| --- | --- | ---: |"]
    for closed, is_clean, label in (
        (True, True, "success, and nothing found"),
        (True, False, "**success, and something found**"),
        (False, False, "failure, and something found"),
        (False, True, "failure, and nothing found"),
    ):
        matching = [one for one in comparisons if one.trial["closed"] == closed]
        count = sum((not one.found) == is_clean for one in matching)
        rows.append(f"| {'success' if closed else 'failure'} | {label} | {count} |")
    for one in comparisons:
        if one.trial["closed"] != (not one.found):
            rows.append("")
            rows.append(f"- {one.trial['key']}: {one.trial['closed_reason'] or 'success'}")
            rows += [f"  - {violation}" for violation in one.found]
    return "\n".join(rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge motions; return 1 if the oracle finds violations in one that counts as success."""
    parser = argparse.ArgumentParser(prog="python -m tests.oracle.executed", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the experiment")
    comparisons = compare_all(parser.parse_args(arguments).folder)
    print(format_comparisons(comparisons))
    return int(any(one.trial["closed"] and one.found for one in comparisons))


if __name__ == "__main__":
    sys.exit(main())
