"""Starts the processes of solvers that cannot share one with this package."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from vkc_pin.errors import InputError


@cache
def start_solver(
    name: str, module: str, libraries: str | None = None
) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Start the process of a solver once and return a function that sends it requests.

    Args:
        name: Name of the solver in messages.
        module: Module beside `worker.py` that has the class `Solver`.
        libraries: Folder in which its shared libraries are searched first.

    Raises:
        InputError: The solver is not installed, or its process has ended.
    """
    command = [sys.executable, str(Path(__file__).with_name("worker.py")), module]
    folders = [libraries, os.environ.get("LD_LIBRARY_PATH")]
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "LD_LIBRARY_PATH": os.pathsep.join(filter(None, folders))},
    )

    def read_answer() -> dict[str, Any]:
        assert process.stdout is not None
        while line := process.stdout.readline():
            if line.startswith("{"):
                return dict(json.loads(line))
        start_solver.cache_clear()  # the next problem has a new process
        raise InputError(
            f"the process of {name} has ended", field="method", got=f"exit code {process.wait()}"
        )

    first = read_answer()
    if "error" in first:
        raise InputError(
            f"{name} cannot be run", expected='pip install "vkc-pin[peers]"', got=first["error"]
        )

    def ask_solver(ask: dict[str, Any]) -> dict[str, Any]:
        assert process.stdin is not None
        process.stdin.write(json.dumps(ask) + "\n")
        process.stdin.flush()
        return read_answer()

    return ask_solver
