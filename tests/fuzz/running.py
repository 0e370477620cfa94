"""Runs cases in a watched process, so that crashes, hangs and memory use are assigned to a case."""

from __future__ import annotations

import json
import os
import random
import resource
import select
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["BAD", "KINDS", "Worker", "make_case", "serve"]

SECONDS, MEGABYTES = 2.0, 500.0  # of processor time and memory that a case may take
PLANNING = 6.0  # seconds more where there is a problem to build, and to plan for its time limit
HUNG = 40.0  # seconds of the clock after which a case is given up
FRESH = 1500  # cases after which a new process begins
BAD = ("raw", "slow", "memory", "crashed", "hung")
TESTS = Path(__file__).resolve().parents[1]


def _load_kinds() -> dict[
    str, tuple[Callable[[random.Random], dict[str, Any]], Callable[[dict[str, Any]], str]]
]:
    from . import calls, datasets, files, imports, plans

    return {
        "files": (files.make_case, files.run),
        "documents": (files.make_document_case, files.run_document),
        "calls": (calls.make_case, calls.run),
        "plans": (plans.make_case, plans.run),
        "imports": (imports.make_case, imports.run),
        "datasets": (datasets.make_case, datasets.run),
        "journals": (datasets.make_journal_case, datasets.run_journal),
    }


KINDS = {
    **{"files": 0.25, "documents": 0.15, "calls": 0.25, "plans": 0.1},
    **{"imports": 0.1, "datasets": 0.1, "journals": 0.05},
}
"""Kind of cases → its share."""


def make_case(kind: str, seed: int, number: int) -> dict[str, Any]:
    """Return case `number` of a kind, determined by seed and number."""
    return _load_kinds()[kind][0](random.Random(f"{kind} {seed} {number}"))


def serve() -> None:
    """Read cases from standard input, a line each, and print the outcome of each."""
    answers = os.fdopen(os.dup(1), "w")
    silent = os.open(os.devnull, os.O_RDWR)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    warnings.simplefilter("ignore")
    kinds = _load_kinds()
    _limit_memory()
    requests, sys.stdin = sys.stdin, open(os.devnull)  # noqa: SIM115, PTH123 - for as long as the process lives
    for line in requests:
        asked = json.loads(line)
        case = (
            asked["case"]
            if "case" in asked
            else make_case(asked["kind"], asked["seed"], asked["number"])
        )
        if asked.get("only") == "make":
            answers.write(json.dumps({"case": case}) + "\n")
        else:
            answers.write(json.dumps(_run(kinds[asked["kind"]][1], case)) + "\n")
        answers.flush()


def _limit_memory() -> None:
    """Let an allocation fail that is far too large, before the machine has to find room for it."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    resource.setrlimit(
        resource.RLIMIT_AS, (pages * resource.getpagesize() + 6 * 2**30, resource.RLIM_INFINITY)
    )


def _read_memory(name: str) -> float:
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return (
        next(float(line.split()[1]) for line in text.splitlines() if line.startswith(name)) / 1024.0
    )


def _run(does: Callable[[dict[str, Any]], str], case: dict[str, Any]) -> dict[str, Any]:
    from vkc_pin.errors import VkcError

    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak begins anew
    before, began, error = _read_memory("VmRSS"), time.process_time(), ""
    try:
        outcome = does(case)
    except VkcError as refusal:
        outcome, error = "refused", str(refusal)[:300]
        if len(text := str(refusal)) > 4000 or not text.strip():
            outcome, error = "raw", f"a message of {len(text)} characters: {text[:200]}"
    except BaseException as raised:
        frames = [
            frame
            for frame in traceback.extract_tb(raised.__traceback__)
            if "/vkc_pin/" in frame.filename
        ]
        where = (
            f"{frames[-1].filename.rpartition('/vkc_pin/')[2]}:{frames[-1].lineno}"
            if frames
            else "the call"
        )
        outcome, error = "raw", f"{type(raised).__name__} in {where}: {str(raised)[:200]!a}"
    seconds, grown = time.process_time() - began, _read_memory("VmHWM") - before
    if outcome != "raw" and seconds > SECONDS + PLANNING * _is_planning(case):
        outcome, error = "slow", f"{seconds:.1f} s"
    if outcome != "raw" and grown > MEGABYTES:
        outcome, error = "memory", f"{grown:.0f} MB"
    return {"outcome": outcome, "error": error, "seconds": seconds, "grown": grown}


def _is_planning(case: dict[str, Any]) -> bool:
    name = case.get("call", "")
    pictures = ("Plan.to_html", "to_html", "show", "animate", "Plan.plot")
    planning = (
        *pictures,
        "plan",
        "plan_window",
        "plan_separately",
        "Constraint",
        "Cost",
        "build",
        "validate",
        "random_room",
        "random_task",
    )
    return bool(case.get("plan")) or name in planning


class Worker:
    """A process that runs cases, and is begun anew when one of them ends it."""

    def __init__(self, hung: float = HUNG) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.count, self.hung = 0, hung

    def run(self, **asked: Any) -> dict[str, Any]:
        """Return the outcome of a case, its error if any, and its time and memory."""
        if self.process is None or self.count >= FRESH:
            self.close()
            self.folder = tempfile.TemporaryDirectory(prefix="vkc_fuzz_")
            code = (
                f"import sys; sys.path.insert(0, {str(TESTS)!r}); "
                "from fuzz.running import serve; serve()"
            )
            environment = {
                **os.environ,
                "OMP_NUM_THREADS": "1",
                "VKC_PIN_CACHE": "off",
                "VKC_PIN_PARSE_SECONDS": "10",
                "MPLBACKEND": "agg",
                "TMPDIR": self.folder.name,
            }
            pipe = subprocess.PIPE
            self.process = subprocess.Popen(
                [sys.executable, "-c", code],
                cwd=TESTS.parent,
                env=environment,
                stdin=pipe,
                stdout=pipe,
            )
            self.count = 0
        self.count += 1
        process = self.process
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(asked).encode("ascii") + b"\n")
            process.stdin.flush()
            if not select.select([process.stdout], [], [], self.hung + 60.0 * (self.count == 1))[0]:
                self.close()
                return {
                    "outcome": "hung",
                    "error": f"no answer in {self.hung:g} s",
                    "seconds": self.hung,
                    "grown": 0.0,
                }
            line = process.stdout.readline()
        except BrokenPipeError:
            line = b""
        if not line:
            code_ = process.wait()
            self.close()
            return {
                "outcome": "crashed",
                "error": f"the interpreter ended with {code_}",
                "seconds": 0.0,
                "grown": 0.0,
            }
        found: dict[str, Any] = json.loads(line)
        return found

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None
            self.folder.cleanup()
