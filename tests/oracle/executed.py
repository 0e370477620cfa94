"""Judges how robots really moved in the closed loop, and compares with the experiment's verdict.

Usage: `python -m tests.oracle.executed FOLDER`, after
`vkc-pin bench closed-loop --save-motions --out FOLDER`.

Of the rules of plans, those count that a robot in physics can keep: it overlaps nothing, pushed
objects included, and reaches its goals. An overlap with an object counts from when its place is
known.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .agreement import format_table
from .judge import Verdict, find_violations
from .plan import Violation, read_plan
from .stage import World

DEEPEST = 1e-3  # [m] of overlaps that count as none
MISS, ANGULAR_MISS = 0.01, 0.02  # [m], [rad] of goals beyond the tolerances of plans


def judge_motion(path: Path, trial: Mapping[str, Any]) -> Verdict:
    """Return the experiment's verdict on a saved motion, and the violations that count.

    Args:
        path: The motion.
        trial: Its record.
    """
    start_time = time.perf_counter()
    motion = read_plan(path)
    world = World(motion)
    counting = list[Violation]()
    for violation in find_violations(motion):
        clock = violation.time + trial["recorded_since"]
        is_known = clock >= find_begin(violation.subject, trial)
        is_overlap = violation.rule == "overlap" and violation.amount > DEEPEST
        allowed = get_allowed_miss(world, violation.subject)
        is_miss = violation.rule == "goal" and violation.amount > allowed
        if is_miss or (is_overlap and is_known):
            counting.append(violation)
    reason = trial["closed_reason"]
    status = "failure" if reason else "success"
    verdict = Verdict(path, trial["closed"], status, [reason] if reason else [], counting)
    verdict.seconds = time.perf_counter() - start_time
    return verdict


def get_allowed_miss(world: World, subject: str) -> float:
    """Return the accepted miss of a goal: of a joint "<object>.<joint>" that turns, or other."""
    owner, _, joint = subject.partition(".")
    item = world.objects.get(owner)
    turns = item is not None and joint in item.state and not item.is_prismatic(joint)
    return ANGULAR_MISS if turns else MISS


def find_begin(subject: str, trial: Mapping[str, Any]) -> float:
    """Return when the places of two links, "one - other", and of the robot became known [s]."""
    since = [trial["robot_since"]]
    owners = [label.partition(".")[0] for label in subject.split(" - ")]
    if trial["object"] in owners:
        since.append(trial["object_since"])
    return max(math.inf if moment is None else moment for moment in since)


def judge_trials(folder: Path) -> list[Verdict]:
    """Judge the motions of all trials that were planned."""
    result = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    verdicts = []
    for trial in result["trials"]:
        if trial["success"]:
            verdicts.append(judge_motion(folder / trial["motion"], trial))
    return verdicts


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge motions; return 1 if the oracle finds violations in one that counts as success."""
    parser = argparse.ArgumentParser(prog="python -m tests.oracle.executed", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the experiment")
    verdicts = judge_trials(parser.parse_args(arguments).folder)
    print(format_table(verdicts))
    return int(any(verdict.success and verdict.found for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
