"""Compares the verdicts of plans and oracle, in JSON lines and a table."""

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
    """Return the verdicts on saved plans, in the same order."""
    if jobs == 1:
        return [judge(path) for path in paths]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(judge, paths, chunksize=4))


def write_verdicts(verdicts: Iterable[Verdict], folder: Path) -> None:
    """Write verdicts.jsonl, with one line per plan, and agreement.md into a folder."""
    verdicts = list(verdicts)
    lines = [
        json.dumps({**asdict(one), "path": one.path.relative_to(folder).as_posix()})
        for one in verdicts
    ]
    (folder / "verdicts.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "agreement.md").write_text(format_table(verdicts) + "\n", encoding="utf-8")


def record_violations(verdicts: Iterable[Verdict], record: Path) -> None:
    """Add the number of violations in each trial's plan to a record of trials, as `oracle`.

    Plans are matched to trials by key.

    Raises:
        ValueError: Trials and plans differ, or a plan was not judged; nothing is written.
    """
    result = json.loads(record.read_text(encoding="utf-8"))
    by_key = {verdict.path.stem: verdict for verdict in verdicts}
    keys = {trial["key"] for trial in result["trials"]}
    if keys != set(by_key):
        raise ValueError(
            f"{record}: plans and trials are others: {', '.join(sorted(keys ^ set(by_key))[:5])}"
        )
    if skipped := [verdict.path for verdict in by_key.values() if verdict.unjudged]:
        raise ValueError(f"{record}: {len(skipped)} plans were not judged, {skipped[0]} for one")
    for trial in result["trials"]:
        trial["oracle"] = len(by_key[trial["key"]].found)
    record.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def format_table(verdicts: Sequence[Verdict]) -> str:
    """Return a Markdown table of agreements, and a list of the plans with disagreement."""
    judged = [one for one in verdicts if not one.unjudged]
    rows = ["| plan | oracle | plans |", "| --- | --- | ---: |"]
    for success, is_clean, label in (
        (True, True, "success, and nothing found"),
        (True, False, "**false success**"),
        (False, False, "failure, and something found"),
        (False, True, "failure, and nothing found"),
    ):
        count = sum(one.success == success and (not one.found) == is_clean for one in judged)
        rows.append(f"| {'success' if success else 'failure'} | {label} | {count} |")
    rows.append(f"| any | not judged | {len(verdicts) - len(judged)} |")
    for one in judged:
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
