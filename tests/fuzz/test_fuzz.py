"""Tests that random input yields results or errors of the package within time and memory limits."""

from __future__ import annotations

import json
import os
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fuzz.running import BAD, KINDS, Worker

CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.json"))
NEW_SEED = int(os.environ.get("FUZZ_SEED", random.SystemRandom().randrange(10**6)))
CASES = {1: 60, NEW_SEED: 40}
"""Random seed → number of cases of all kinds."""


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    """Yield the process that runs the cases."""
    process = Worker()
    yield process
    process.close()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", CASES, ids=["fixed", "fresh"])
def test_random_input_yields_a_result_or_an_error(worker: Worker, kind: str, seed: int) -> None:
    failures = []
    for number in range(round(CASES[seed] * KINDS[kind])):
        result = worker.run(kind=kind, seed=seed, number=number)
        if result["outcome"] in BAD:
            show = f"python -m tests.fuzz --kind {kind} --seed {seed} --show {number}"
            failures.append(f"{result['outcome']}, {result['error']}: {show}")
    assert not failures, "\n".join(failures)


@pytest.mark.parametrize("file", CORPUS, ids=[file.stem for file in CORPUS])
def test_past_failures_yield_a_result_or_an_error(worker: Worker, file: Path) -> None:
    record = json.loads(file.read_text(encoding="ascii"))
    result = worker.run(kind=record["kind"], case=record["case"])
    assert result["outcome"] not in BAD, (
        f"{result['outcome']}, {result['error']}; before: {record['was']}"
    )


@pytest.mark.long
def test_valid_input_yields_a_result(worker: Worker) -> None:
    from fuzz import calls, files, imports

    cases: list[tuple[str, Any]] = [
        ("calls", {"call": name, "changes": []}) for name in calls.CALLS
    ]
    names = [
        "scenes/door.yaml",
        "scenes/meshes.yaml",
        "scenes/objects/cup.urdf",
        "scenes/furniture/desk.urdf",
    ]
    names += ["robots/husky_ur5e/husky_ur5e.srdf", "scenes/box.dae"]
    for name in names:
        content = (files.copy_resources() / name).read_bytes().decode("latin-1")
        cases.append(
            ("files", {"file": name, "content": content, "plan": name == "scenes/door.yaml"})
        )
    cases += [("documents", {"scene": "household", "changes": []}), ("plans", {"about": []})]
    for name, text in imports.FILES.items():
        content = {
            name: text,
            **{key: data.decode("latin-1") for key, data in imports.make_neighbor_files().items()},
        }
        cases.append(
            ("imports", {"file": name, "kind": Path(name).stem, "content": content, "plan": False})
        )
    cases += [("datasets", {"changes": [], "plan": True}), ("journals", {"line": 0, "changes": []})]
    failures = []
    for kind, case in cases:
        result = worker.run(kind=kind, case=case)
        if result["outcome"] not in ("done", "loaded", "planned"):
            failures.append((kind, {**case, "content": ""}, result))
    assert failures == []
