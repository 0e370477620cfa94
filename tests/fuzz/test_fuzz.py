"""Random input gives a result or an error of the package, in little time and memory."""

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
FRESH = int(os.environ.get("FUZZ_SEED", random.SystemRandom().randrange(10**6)))
CASES = {1: 60, FRESH: 40}
"""Random seed → number of cases of all kinds."""


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    """Yield the process that runs the cases."""
    made = Worker()
    yield made
    made.close()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", CASES, ids=["fixed", "fresh"])
def test_random_input_yields_a_result_or_an_error(worker: Worker, kind: str, seed: int) -> None:
    bad = []
    for number in range(round(CASES[seed] * KINDS[kind])):
        found = worker.run(kind=kind, seed=seed, number=number)
        if found["outcome"] in BAD:
            show = f"python -m tests.fuzz --kind {kind} --seed {seed} --show {number}"
            bad.append(f"{found['outcome']}, {found['error']}: {show}")
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize("file", CORPUS, ids=[file.stem for file in CORPUS])
def test_past_failures_yield_a_result_or_an_error(worker: Worker, file: Path) -> None:
    kept = json.loads(file.read_text(encoding="ascii"))
    found = worker.run(kind=kept["kind"], case=kept["case"])
    assert found["outcome"] not in BAD, (
        f"{found['outcome']}, {found['error']}; before: {kept['was']}"
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
        content = (files.make_pool() / name).read_bytes().decode("latin-1")
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
    wrong = []
    for kind, case in cases:
        found = worker.run(kind=kind, case=case)
        if found["outcome"] not in ("done", "loaded", "made", "planned"):
            wrong.append((kind, {**case, "content": ""}, found))
    assert wrong == []
