"""Writes the data card of a dataset."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

# reasons in the card
_ROWS = 12
# characters of a reason
_REASON_LENGTH = 120


def make_card(
    about: Mapping[str, Any],
    records: Sequence[Mapping[str, Any]],
    failures: Sequence[Mapping[str, Any]],
) -> str:
    """Return the card as Markdown with the header that dataset hubs read.

    Args:
        about: Name, license, digest, versions, rate and recipe (as text).
        records: Records of episodes.
        failures: Records of failed attempts.
    """
    head = {
        "license": str(about["license"]).lower(),
        "task_categories": ["robotics"],
        "tags": ["mobile-manipulation", "whole-body-motion", "vkc_pin", "LeRobot"],
        "pretty_name": about["name"],
        "size_categories": [_choose_size_category(len(records))],
    }
    hours = sum(float(record["duration"]) for record in records) / 3600.0
    attempts = len(records) + len(failures)
    share = f"{100.0 * len(records) / attempts:.1f} %" if attempts else "–"
    reasons = Counter[str]()
    for failure in failures:
        reason = str(failure.get("reason", ""))[:_REASON_LENGTH]
        reasons[f"{failure['status']}: {reason}"] += 1
    failed = [f"- {text} ({count})" for text, count in reasons.most_common(_ROWS)]
    versions = [f"| {name} | {value} |" for name, value in about["versions"].items()]
    parts = [
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---",
        f"# {about['name']}",
        f"{len(records)} whole-body motions of mobile manipulators, {hours:.2f} h in all, each "
        "with its scene, planned by vkc_pin. The independent validation accepted every one: joint "
        "limits, velocities, accelerations, closure of grasps, clearances along the whole motion, "
        "and the goal. They are kinematic: nothing was recorded on a robot.",
        _make_table_of_counts(records),
        "## Origin",
        f"The recipe below, of digest `{about['digest']}`, and a number determine an episode. "
        f"{attempts} numbers were tried, {share} of which became episodes; `failures.csv` has the "
        "others with their reasons.",
        f"```yaml\n{about['recipe']}```",
        "\n".join(["| package | version |", "| --- | --- |", *versions]),
        "## Failures",
        "\n".join(failed) or "None.",
        "## Files",
        _FILES.format(rate=about["rate"]),
        "## Licence",
        f"{about['license']}, for the data. vkc_pin and the robot descriptions have their own.",
    ]
    return "\n\n".join(parts) + "\n"


_SIZES = ((1000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
_FILES = """\
- `shards/<robot>/shard-<k>.hdf5`: robomimic's groups, sampled at {rate:g} Hz, with the exact
  trajectory under `motion`
- `scenes/<digest>.json`: scenes
- `lerobot/<robot>/`: the same samples in LeRobot's layout 3.0, if requested
- `episodes.csv`, `failures.csv`: one line per attempt
- `statistics.html`: statistics
- `journal.jsonl`, `work/`: for resuming generation; not needed to use the data"""


def _choose_size_category(count: int) -> str:
    """Return the hubs' category of a number of episodes."""
    for most, name in _SIZES:
        if count < most:
            return name
    return _SIZES[-1][1]


def _make_table_of_counts(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of the numbers of episodes by task, robot and kind."""
    rows = ["| | episodes |", "| --- | --- |"]
    for field in ("task", "robot", "kind"):
        counts = Counter(record[field] for record in records)
        rows += [f"| {field} {name} | {count} |" for name, count in sorted(counts.items())]
    for field in ("room", "scene"):
        values = {record[field] for record in records}
        rows.append(f"| {field}s | {len(values)} |")
    return "\n".join(rows)
