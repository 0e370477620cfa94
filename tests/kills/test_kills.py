from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("psutil")
pytest.importorskip("distributed")

PROGRAM = """
import time
from vkc_pin.utils.parallel.engine import results
from helpers.tasks import slow
if __name__ == "__main__":
    found = dict(results(slow, [(str(k), k) for k in range(6)], jobs=2, dask=True))
    assert found == {str(k): 2 * k for k in range(6)}, found
"""


def test_workers_die_and_nothing_is_lost(tmp_path: Path) -> None:
    from tests.kills.__main__ import main

    program, log = tmp_path / "program.py", tmp_path / "kills.jsonl"
    tests = Path(__file__).parents[1]
    program.write_text(
        f"import sys; sys.path.insert(0, {str(tests)!r})\n{PROGRAM}", encoding="utf-8"
    )
    assert (
        main(
            [
                "--kills",
                "1",
                "--within",
                "0.1",
                "--log",
                str(log),
                "--",
                sys.executable,
                str(program),
            ]
        )
        == 0
    )
    first = json.loads(log.read_text(encoding="utf-8").splitlines()[0])
    assert set(first) == {"seconds", "killed", "memory_mb"}
