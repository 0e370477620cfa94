"""Runs a solver in its own process; requests and answers are lines of JSON.

Solvers whose libraries must be loaded first, or found through the environment, run here. Nothing
of this package is imported: this file is run as a script, and solvers are modules beside it.
"""

from __future__ import annotations

import importlib
import json
import sys
import time


def main(name: str) -> int:
    """Answer requests to the solver in the module `name` until the input ends."""
    try:
        solve = importlib.import_module(name).Solver()
    except Exception as error:
        print(json.dumps({"error": f"{type(error).__name__}: {error}"}), flush=True)
        return 1
    print(json.dumps({"ready": True, "cpu": time.process_time()}), flush=True)
    for line in sys.stdin:
        began = time.process_time()
        try:
            answer = solve(json.loads(line))
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps({**answer, "cpu": time.process_time() - began}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
