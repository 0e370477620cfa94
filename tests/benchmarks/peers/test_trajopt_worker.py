"""The process that runs trajopt says what it cannot do, and goes on."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from vkc_pin.benchmarks.peers import trajopt_worker

FILE = Path(trajopt_worker.__file__)


def test_worker_reports_a_missing_package() -> None:
    command = [sys.executable, "-S", str(FILE)]  # without what is installed
    done = subprocess.run(command, input="", capture_output=True, text=True, timeout=60)
    assert json.loads(done.stdout) == {"error": "tesseract_robotics is not installed"}
    assert done.returncode == 1


@pytest.mark.skipif(
    find_spec("tesseract_robotics") is None,
    reason='needs tesseract-robotics-nanobind: pip install "vkc-pin[peers]"',
)
def test_wrong_request_does_not_end_the_worker() -> None:
    asked = json.dumps({"urdf": "/nowhere", "srdf": "/nowhere"})
    done = subprocess.run(
        [sys.executable, str(FILE)],
        input=f"{asked}\n{asked}\n",
        capture_output=True,
        text=True,
        timeout=120,
    )
    first, *answers = [
        json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")
    ]
    assert first["ready"] is True
    assert len(answers) == 2
    assert all("/nowhere" in answer["error"] for answer in answers)
    assert done.returncode == 0
