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


def test_generate(recipe: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["generate", recipe, "--episodes", "2", "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert f"2 episodes are in {out}" in said.out
    assert "2/2" in said.err
    assert (
        main(
            ["generate", recipe, "--episodes", "2", "--out", str(out), "--variants", "2", "--quiet"]
        )
        == 2
    )
    assert "run otherwise" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--episodes", "0"], "episodes: out of range"),
        (["--episodes", "-4"], "episodes: out of range"),
        (["--episodes", "2", "--jobs", "0"], "jobs: out of range"),
    ],
)
def test_misuse(
    recipe: str, tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["generate", recipe, *words, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_name_that_nearly_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("name: mine\nobjects:\n  - random_oven\n  - random_fridge\n", encoding="utf-8")
    assert main(["generate", str(file), "--episodes", "1", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert f"{file}:4: objects[1]: there is no object that opens 'random_fridge'" in said
    assert not (tmp_path / "out").exists()


def test_hopeless(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "far.yaml"
    text = yaml.safe_dump(
        {
            **SMALL,
            "tasks": ["drive-open"],
            "start": {"distance": [90.0, 91.0]},
            "rooms": {"count": 1},
        }
    )
    file.write_text(text, encoding="utf-8")
    assert (
        main(["generate", str(file), "--episodes", "1", "--out", str(tmp_path / "out"), "--quiet"])
        == 1
    )
    assert "0 episodes of 1" in capsys.readouterr().err
