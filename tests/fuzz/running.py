"""Runs cases in a worker process, and attributes crashes, hangs and memory use to them."""

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

SECONDS, MEGABYTES = 2.0, 500.0  # limits of processor time and memory for a case
PLANNING = 6.0  # additional seconds for cases that build or solve a problem
TIMEOUT = 40.0  # wall-clock seconds after which a case is aborted
CASES_PER_PROCESS = 1500
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
"""Share of each kind of case."""


def make_case(kind: str, seed: int, number: int) -> dict[str, Any]:
    """Return case `number` of a kind, determined by seed and number."""
    return _load_kinds()[kind][0](random.Random(f"{kind} {seed} {number}"))


def serve() -> None:
    """Read cases from standard input, one per line, and print their outcomes."""
    answers = os.fdopen(os.dup(1), "w")
    silent = os.open(os.devnull, os.O_RDWR)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    warnings.simplefilter("ignore")
    kinds = _load_kinds()
    _limit_memory()
    requests, sys.stdin = sys.stdin, open(os.devnull)  # noqa: SIM115, PTH123 - open while the process runs
    for line in requests:
        request = json.loads(line)
        case = (
            request["case"]
            if "case" in request
            else make_case(request["kind"], request["seed"], request["number"])
        )
        if request.get("only") == "make":
            answers.write(json.dumps({"case": case}) + "\n")
        else:
            answers.write(json.dumps(_run(kinds[request["kind"]][1], case)) + "\n")
        answers.flush()


def _limit_memory() -> None:
    """Limit the address space, so that excessive allocations fail at once."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    resource.setrlimit(
        resource.RLIMIT_AS, (pages * resource.getpagesize() + 6 * 2**30, resource.RLIM_INFINITY)
    )


def _read_memory(name: str) -> float:
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return (
        next(float(line.split()[1]) for line in text.splitlines() if line.startswith(name)) / 1024.0
    )


def _run(function: Callable[[dict[str, Any]], str], case: dict[str, Any]) -> dict[str, Any]:
    from vkc_pin.errors import VkcError

    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    before, start, error = _read_memory("VmRSS"), time.process_time(), ""
    try:
        outcome = function(case)
    except VkcError as rejection:
        outcome, error = "refused", str(rejection)[:300]
        if len(text := str(rejection)) > 4000 or not text.strip():
            outcome, error = "raw", f"a message of {len(text)} characters: {text[:200]}"
    except BaseException as exception:
        frames = [
            frame
            for frame in traceback.extract_tb(exception.__traceback__)
            if "/vkc_pin/" in frame.filename
        ]
        line = (
            f"{frames[-1].filename.rpartition('/vkc_pin/')[2]}:{frames[-1].lineno}"
            if frames
            else "the call"
        )
        outcome, error = "raw", f"{type(exception).__name__} in {line}: {str(exception)[:200]!a}"
    seconds, grown = time.process_time() - start, _read_memory("VmHWM") - before
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
    """A process that runs cases, and is restarted after a crash or a hang."""

    def __init__(self, timeout: float = TIMEOUT) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.count, self.timeout = 0, timeout

    def run(self, **request: Any) -> dict[str, Any]:
        """Return the outcome of a case, its error if any, and its time and memory."""
        if self.process is None or self.count >= CASES_PER_PROCESS:
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
            process.stdin.write(json.dumps(request).encode("ascii") + b"\n")
            process.stdin.flush()
            limit = self.timeout + 60.0 * (self.count == 1)
            if not select.select([process.stdout], [], [], limit)[0]:
                self.close()
                return {
                    "outcome": "hung",
                    "error": f"no answer in {self.timeout:g} s",
                    "seconds": self.timeout,
                    "grown": 0.0,
                }
            line = process.stdout.readline()
        except BrokenPipeError:
            line = b""
        if not line:
            exit_code = process.wait()
            self.close()
            return {
                "outcome": "crashed",
                "error": f"the interpreter exited with {exit_code}",
                "seconds": 0.0,
                "grown": 0.0,
            }
        result: dict[str, Any] = json.loads(line)
        return result

    def close(self) -> None:
        """Kill the process."""
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None
            self.folder.cleanup()
