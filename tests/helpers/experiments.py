"""Runs experiments from the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vkc_pin.cli import main


def run_experiment(words: str, out: Path) -> tuple[str, list[dict[str, Any]]]:
    """Run `vkc-pin bench WORDS`; return its table and trials. A second run must add no trial."""
    command = ["bench", *words.split(), "--quiet", "--out", str(out)]
    assert main(command) == 0
    journal = (out / "trials.jsonl").read_bytes()
    assert main(command) == 0
    assert (out / "trials.jsonl").read_bytes() == journal
    result = json.loads((out / "results.json").read_text(encoding="utf-8"))
    return (out / "table.md").read_text(encoding="utf-8"), result["trials"]
