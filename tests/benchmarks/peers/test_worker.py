"""Tests that the worker process of a solver reports errors and continues."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.benchmarks.peers import worker
from tests.benchmarks.peers.processes import start_solver
from vkc_pin import InputError

FILE = Path(worker.__file__)
# Module, its package, and a word of the error about a missing description.
SOLVERS = [("trajopt_solver", "tesseract_robotics", "/nowhere"), ("hpp_solver", "pyhpp", "URDF")]


@pytest.mark.parametrize("solver", [solver for solver, *_ in SOLVERS])
def test_worker_reports_a_missing_package(solver: str) -> None:
    command = [sys.executable, "-S", str(FILE), solver]  # without installed packages
    process = subprocess.run(command, input="", capture_output=True, text=True, timeout=60)
    error = json.loads(process.stdout)["error"]
    assert error.startswith("ModuleNotFoundError")
    assert process.returncode == 1


def test_missing_solver_raises_an_error() -> None:
    with pytest.raises(InputError, match="nothing cannot be run") as raised:
        start_solver("nothing", "no_solver")
    assert "no_solver" in str(raised.value)


def test_solver_that_crashed_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solver = "import os\nclass Solver:\n    def __call__(self, ask): return ask or os._exit(3)\n"
    (tmp_path / "crashing_solver.py").write_text(solver)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    ask_solver = start_solver("crash", "crashing_solver")
    assert ask_solver({"z": 1})["z"] == 1
    with pytest.raises(InputError, match=r"the process of crash has ended.*exit code 3"):
        ask_solver({})
    assert start_solver("crash", "crashing_solver")({"z": 2})["z"] == 2


@pytest.mark.parametrize(("solver", "package", "key"), SOLVERS)
def test_wrong_request_does_not_end_the_worker(solver: str, package: str, key: str) -> None:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        pytest.skip(f'needs {package}: pip install "vkc-pin[peers]"')
    libraries = str(Path(spec.origin).parents[3])
    request = json.dumps({"urdf": "/nowhere", "srdf": "/nowhere"})
    process = subprocess.run(
        [sys.executable, str(FILE), solver],
        input=f"{request}\n{request}\n",
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "LD_LIBRARY_PATH": libraries},
    )
    lines = [line for line in process.stdout.splitlines() if line.startswith("{")]
    first, *answers = map(json.loads, lines)
    assert first["ready"] is True
    assert [key in answer["error"] for answer in answers] == [True, True]
    assert process.returncode == 0
