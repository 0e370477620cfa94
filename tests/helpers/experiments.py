"""Runs experiments and benchmarks from the command line."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks import commands
from vkc_pin.cli import main

Trials = list[dict[str, Any]]


def run_experiment(words: str, out: Path) -> tuple[str, Trials]:
    """Run `vkc-pin bench WORDS`; return its table and trials. A second run must add no trial."""
    return _run_twice(main, ["bench", *words.split()], out)


def run_benchmark(words: str, out: Path) -> tuple[str, Trials]:
    """Run `python -m tests.benchmarks WORDS`, as `run_experiment` does."""
    return _run_twice(commands.main, words.split(), out)


def _run_twice(
    run: Callable[[Sequence[str]], int], words: Sequence[str], out: Path
) -> tuple[str, Trials]:
    command = [*words, "--quiet", "--out", str(out)]
    assert run(command) == 0
    journal = (out / "trials.jsonl").read_bytes()
    assert run(command) == 0
    assert (out / "trials.jsonl").read_bytes() == journal
    result = json.loads((out / "results.json").read_text(encoding="utf-8"))
    return (out / "table.md").read_text(encoding="utf-8"), result["trials"]
