"""Input at random: a plan, or an error of the package's own, within a few seconds and a few hundred megabytes."""

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
CASES = 300  # of all kinds, with each of the two seeds
FIXED, FRESH = 1, int(os.environ.get("FUZZ_SEED", random.SystemRandom().randrange(10**6)))


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    """A process for all that follows."""
    made = Worker()
    yield made
    made.close()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [FIXED, "fresh"])
def test_cases_at_random(worker: Worker, kind: str, seed: int | str) -> None:
    number_of = round(CASES * KINDS[kind])
    chosen = FRESH if isinstance(seed, str) else seed
    bad = []
    for number in range(number_of):
        found = worker.run(kind=kind, seed=chosen, number=number)
        if found["outcome"] in BAD:
            bad.append(
                f"{found['outcome']}, {found['error']}: python -m tests.fuzz --kind {kind} --seed {chosen} --show {number}"
            )
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize("file", CORPUS, ids=[file.stem for file in CORPUS])
def test_what_once_broke_it(worker: Worker, file: Path) -> None:
    kept = json.loads(file.read_text(encoding="ascii"))
    found = worker.run(kind=kept["kind"], case=kept["case"])
    assert found["outcome"] not in BAD, (
        f"{found['outcome']}, {found['error']}; before: {kept['was']}"
    )


def test_what_is_not_spoiled_works(worker: Worker) -> None:
    from fuzz import calls, files

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
        content = (files.pool() / name).read_bytes().decode("latin-1")
        cases.append(
            ("files", {"file": name, "content": content, "plan": name == "scenes/door.yaml"})
        )
    cases += [
        ("documents", {"scene": "household", "changes": []}),
        ("options", {"fields": {}, "plan": True}),
    ]
    cases += [
        ("plans", {"about": []}),
        ("lines", {"argv": ["export", "NPZ", "--json", "OUT/a.json"]}),
    ]
    wrong = []
    for kind, case in cases:
        found = worker.run(kind=kind, case=case)
        if found["outcome"] not in ("done", "loaded", "made", "planned"):
            wrong.append((kind, {**case, "content": ""}, found))
    assert wrong == []


def test_what_goes_wrong_is_noticed() -> None:
    outcomes = {
        "raise": "raw",
        "exit": "raw",
        "spin": "slow",
        "eat": "memory",
        "sleep": "hung",
        "crash": "crashed",
    }
    worker = Worker(hung=20.0)
    for does, outcome in outcomes.items():
        assert worker.run(kind="planted", case={"does": does})["outcome"] == outcome
        assert worker.run(kind="planted", case={"does": "refuse"})["outcome"] == "refused"
    worker.close()
