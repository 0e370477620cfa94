"""`python -m tests.kills --kills N --within S --log FILE -- COMMAND ...`: runs a command and kills its workers at random moments.

The log has a line of JSON for every kill, and every half a minute one with the memory of all
workers [MB].
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import time
from pathlib import Path

import psutil

_SAMPLED = 30.0  # [s]
_WORKER = "spawn_main"  # in the command line of processes that Python's multiprocessing starts
_READY = 100.0  # [MB]: it has imported the package


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--within", type=float, default=3600.0, help="seconds from the start")
    parser.add_argument("--seed", type=int, default=0, help="of moments and workers")
    parser.add_argument("--log", type=Path, required=True)
    parser.add_argument("command", nargs="+")
    given = parser.parse_args(arguments)
    rng = random.Random(given.seed)
    moments = sorted(rng.uniform(0.0, given.within) for _ in range(given.kills))
    began, sampled = time.monotonic(), 0.0
    with (
        subprocess.Popen(given.command) as command,
        given.log.open("a", encoding="utf-8", buffering=1) as log,
    ):
        while command.poll() is None:
            time.sleep(0.2)
            now = time.monotonic() - began
            found = workers(command.pid)
            if moments and now >= moments[0] and found:
                moments.pop(0)
                one = rng.choice(sorted(found))
                log.write(
                    json.dumps({"seconds": round(now, 1), "killed": one, "memory_mb": found[one]})
                    + "\n"
                )
                psutil.Process(one).kill()
            elif now - sampled >= _SAMPLED:
                sampled = now
                log.write(json.dumps({"seconds": round(now, 1), "memory_mb": found}) + "\n")
        return command.returncode


def workers(parent: int) -> dict[int, float]:
    """Return the memory of each worker below a process [MB], by its number."""
    found = {}
    for one in psutil.Process(parent).children(recursive=True):
        try:
            memory = one.memory_info().rss / 2**20
            if _WORKER in " ".join(one.cmdline()) and memory > _READY:
                found[one.pid] = round(memory, 1)
        except psutil.Error:  # it has just ended
            continue
    return found


if __name__ == "__main__":
    sys.exit(main())
