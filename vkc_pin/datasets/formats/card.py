"""The data card: what a dataset is, for people and for the programs that list datasets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

__all__ = ["make_card"]

_ROWS = 12  # of reasons


def make_card(
    about: Mapping[str, Any],
    records: Sequence[Mapping[str, Any]],
    failures: Sequence[Mapping[str, Any]],
) -> str:
    """Return the card as Markdown, headed by the fields that dataset hubs read.

    Args:
        about: name, license, digest, versions, rate, recipe (its text).
        records: Of the episodes.
        failures: Of the attempts that became none.
    """
    size = next((name for most, name in _SIZES if len(records) < most), _SIZES[-1][1])
    head = {
        "license": str(about["license"]).lower(),
        "task_categories": ["robotics"],
        "tags": ["mobile-manipulation", "whole-body-motion", "vkc_pin", "LeRobot"],
        "pretty_name": about["name"],
        "size_categories": [size],
    }
    seconds = sum(float(record["duration"]) for record in records)
    attempts = len(records) + len(failures)
    share = f"{100.0 * len(records) / attempts:.1f} %" if attempts else "–"
    reasons = Counter(
        f"{record['status']}: {str(record.get('reason', ''))[:120]}" for record in failures
    )
    parts = [
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---",
        f"# {about['name']}",
        f"{len(records)} whole-body motions of mobile manipulators, {seconds / 3600.0:.2f} h in all, each with its scene. Every "
        "one was planned by vkc_pin and accepted by its independent validation: joint limits, velocities, accelerations, closure "
        "of what is held, clearances along the whole motion, and the goal. They are kinematic: nothing was recorded on a robot.",
        _counted(records),
        "## Where they come from",
        f"The recipe below, of digest `{about['digest']}`, and a number determine an episode. {attempts} numbers were tried, "
        f"{share} of which became episodes; `failures.csv` has the others with their reasons.",
        f"```yaml\n{about['recipe']}```",
        "| what | version |\n| --- | --- |\n"
        + "\n".join(f"| {name} | {value} |" for name, value in about["versions"].items()),
        "## What went wrong",
        "\n".join(f"- {text} ({count})" for text, count in reasons.most_common(_ROWS))
        or "Nothing.",
        "## Files",
        "- `shards/<robot>/shard-<k>.hdf5`: groups as robomimic's, sampled at "
        f"{about['rate']:g} Hz, with the exact motion under `motion`\n"
        "- `scenes/<digest>.json`: scenes by their content\n- `lerobot/<robot>/`: the same samples in LeRobot's layout 3.0, "
        "if it was asked for\n"
        "- `episodes.csv`, `failures.csv`: a line for each attempt\n- `statistics.html`: what there is of what\n"
        "- `journal.jsonl`, `work/`: with these the run can be gone on with; not needed to use the data",
        "## Licence",
        f"{about['license']}, for the data. vkc_pin and the descriptions of robots have licences of their own.",
    ]
    return "\n\n".join(parts) + "\n"


_SIZES = ((1000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))


def _counted(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of how many episodes there are of which task, robot and kind of object."""
    rows = ["| | episodes |", "| --- | --- |"]
    for field in ("task", "robot", "kind"):
        rows += [
            f"| {field} {name} | {count} |"
            for name, count in sorted(Counter(r[field] for r in records).items())
        ]
    rooms = len({record["room"] for record in records})
    return "\n".join(
        [
            *rows,
            f"| rooms | {rooms} |",
            f"| scenes | {len({record['scene'] for record in records})} |",
        ]
    )
