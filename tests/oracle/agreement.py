"""Compares the plans' own verdicts with those of the oracle: JSON lines and a table."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

from .judge import Verdict, judge

__all__ = ["format_table", "judge_all", "record_violations", "write_verdicts"]


def judge_all(paths: Sequence[Path], *, jobs: int = 1) -> list[Verdict]:
    """Return the verdicts on saved plans, in their order."""
    if jobs == 1:
        return [judge(path) for path in paths]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(judge, paths, chunksize=4))


def write_verdicts(verdicts: Iterable[Verdict], folder: Path) -> None:
    """Write verdicts.jsonl, a line a plan, and agreement.md into a folder."""
    verdicts = list(verdicts)
    lines = [
        json.dumps({**asdict(one), "path": one.path.relative_to(folder).as_posix()})
        for one in verdicts
    ]
    (folder / "verdicts.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "agreement.md").write_text(format_table(verdicts) + "\n", encoding="utf-8")


def record_violations(verdicts: Iterable[Verdict], record: Path) -> None:
    """Add the number of violations in each trial's plan to a record of trials, as its `oracle`.

    Plans are matched to trials by key.

    Raises:
        ValueError: Trials and plans are not the same, or a plan was not judged; nothing is written.
    """
    result = json.loads(record.read_text(encoding="utf-8"))
    own = {one.path.stem: one for one in verdicts}
    keys = {trial["key"] for trial in result["trials"]}
    if keys != set(own):
        raise ValueError(
            f"{record}: plans and trials are others: {', '.join(sorted(keys ^ set(own))[:5])}"
        )
    if skipped := [one.path for one in own.values() if one.unjudged]:
        raise ValueError(f"{record}: {len(skipped)} plans were not judged, {skipped[0]} for one")
    for trial in result["trials"]:
        trial["oracle"] = len(own[trial["key"]].found)
    record.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def format_table(verdicts: Sequence[Verdict]) -> str:
    """Return how often both agree, and every plan of which they do not, in Markdown."""
    said = [one for one in verdicts if not one.unjudged]
    rows = ["| plan | oracle | plans |", "| --- | --- | ---: |"]
    for success, right, what in (
        (True, True, "success, and nothing found"),
        (True, False, "**false success**"),
        (False, False, "failure, and something found"),
        (False, True, "failure, and nothing found"),
    ):
        count = sum(one.success == success and (not one.found) == right for one in said)
        rows.append(f"| {'success' if success else 'failure'} | {what} | {count} |")
    rows.append(f"| any | not judged | {len(verdicts) - len(said)} |")
    for one in said:
        if not one.agrees:
            rows += [
                "",
                f"- {one.path.name}: {one.status}; the plan finds "
                f"{', '.join(one.says) or 'nothing'}",
            ]
            rows += [f"  - {violation}" for violation in one.found]
    for reason, count in Counter(one.unjudged for one in verdicts if one.unjudged).items():
        rows += ["", f"- not judged, {count}: {reason}"]
    seconds = sum(one.seconds for one in verdicts)
    rows += ["", f"{len(verdicts)} plans in {seconds:.1f} s."]
    return "\n".join(rows)
