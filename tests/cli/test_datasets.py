from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.commands import RunCommand
from helpers.datasets import SMALL

pytest.importorskip("h5py")


def write_recipe(**changes: Any) -> None:
    Path("small.yaml").write_text(yaml.safe_dump({**SMALL, **changes}), encoding="utf-8")


def test_generate_writes_episodes(run: RunCommand) -> None:
    write_recipe()
    command = "generate small.yaml --episodes 2 --out out"
    result = run(command)
    assert result.code == 0
    assert "2 episodes are in out" in result.out
    assert "2/2" in result.err
    result = run(f"{command} --variants 2 --quiet")
    assert result.code == 2
    assert "run otherwise" in result.err


@pytest.mark.parametrize(
    ("options", "changes", "code", "text"),
    [
        ("--episodes 0", {}, 2, "episodes: out of range"),
        ("--episodes 2 --jobs 0", {}, 2, "jobs: out of range"),
        (
            "--episodes 1",
            {"objects": ["random_oven", "random_fridge"]},
            2,
            "objects[1]: there is no object that opens 'random_fridge'",
        ),
        (
            "--episodes 1 --quiet",
            {"tasks": ["drive-open"], "start": {"distance": [90.0, 91.0]}, "rooms": {"count": 1}},
            1,
            "0 of 1 episodes",
        ),
    ],
)
def test_misuse_and_failure_are_explained(
    options: str, changes: dict[str, Any], code: int, text: str, run: RunCommand
) -> None:
    write_recipe(**changes)
    result = run(f"generate small.yaml {options} --out out")
    assert result.code == code
    assert text in result.err
    assert code == 1 or not Path("out").exists()
