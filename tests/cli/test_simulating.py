"""The command `simulate` executes saved plans."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.executions import drawer_plan

from vkc_pin.cli import main


@pytest.fixture
def plan(tmp_path: Path) -> str:
    return str(drawer_plan().save(tmp_path / "plan.npz"))


def test_saved_plan_is_executed(
    plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, data = tmp_path / "page.html", tmp_path / "data.json"
    command = ["simulate", plan, "--html", str(page), "--json", str(data), "--grasp", "friction"]
    assert main(command) == 0
    output = capsys.readouterr().out
    assert "drawer in physics: ok" in output
    assert "slips by" in output
    assert f"wrote {page}" in output
    assert "in physics" in page.read_text(encoding="utf-8")
    assert json.loads(data.read_text(encoding="utf-8"))["ok"] is True


def test_misuse_is_explained_and_writes_nothing(
    plan: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Path(plan).read_bytes()
    for options, expected in (
        (["--actual", "door", "--json", str(tmp_path / "data.json")], "lacks the object 'drawer'"),
        (["--json", plan], "--json"),
        (["--grasp", "glue"], "expected weld, friction, got glue"),
    ):
        assert main(["simulate", plan, *options]) == 2
        assert expected in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["plan.npz"]
    assert Path(plan).read_bytes() == before
