from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from helpers.datasets import SMALL

from vkc_pin.cli import main

pytest.importorskip("h5py")


@pytest.fixture
def recipe(tmp_path: Path) -> str:
    file = tmp_path / "small.yaml"
    file.write_text(yaml.safe_dump(SMALL), encoding="utf-8")
    return str(file)


def test_generate_writes_episodes(
    recipe: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["generate", recipe, "--episodes", "2", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert f"2 episodes are in {tmp_path / 'out'}" in printed.out
    assert "2/2" in printed.err
    assert main([*command, "--variants", "2", "--quiet"]) == 2
    assert "run otherwise" in capsys.readouterr().err


def test_misuse_is_explained(
    recipe: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = tmp_path / "mine.yaml"
    wrong.write_text("name: mine\nobjects:\n  - random_oven\n  - random_fridge\n", encoding="utf-8")
    for words, expected in (
        ([recipe, "--episodes", "0"], "episodes: out of range"),
        ([recipe, "--episodes", "2", "--jobs", "0"], "jobs: out of range"),
        (
            [str(wrong), "--episodes", "1"],
            f"{wrong}:4: objects[1]: there is no object that opens 'random_fridge'",
        ),
    ):
        assert main(["generate", *words, "--out", str(tmp_path / "out")]) == 2
        assert expected in capsys.readouterr().err
        assert not (tmp_path / "out").exists()


def test_infeasible_recipe_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "far.yaml"
    far = {"tasks": ["drive-open"], "start": {"distance": [90.0, 91.0]}, "rooms": {"count": 1}}
    file.write_text(yaml.safe_dump({**SMALL, **far}), encoding="utf-8")
    out = str(tmp_path / "out")
    assert main(["generate", str(file), "--episodes", "1", "--out", out, "--quiet"]) == 1
    assert "0 of 1 episodes" in capsys.readouterr().err
