"""The command `simulate`, as users run it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.executions import drawer_plan

from vkc_pin.cli import main


def test_a_saved_plan_is_executed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan, page, data = tmp_path / "plan.npz", tmp_path / "page.html", tmp_path / "data.json"
    drawer_plan().save(plan)
    assert main(["simulate", str(plan), "--html", str(page), "--json", str(data)]) == 0
    said = capsys.readouterr().out
    assert "drawer in physics: ok" in said
    assert f"wrote {page}" in said
    assert "in physics" in page.read_text(encoding="utf-8")
    assert json.loads(data.read_text(encoding="utf-8"))["ok"] is True


def test_another_scene_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan, data = tmp_path / "plan.npz", tmp_path / "data.json"
    drawer_plan().save(plan)
    assert main(["simulate", str(plan), "--actual", "door", "--json", str(data)]) == 2
    assert "not there" in capsys.readouterr().err
    assert not data.exists()


def test_outputs_over_the_plan_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.npz"
    drawer_plan().save(plan)
    before = plan.read_bytes()
    assert main(["simulate", str(plan), "--json", str(plan)]) == 2
    assert "--json" in capsys.readouterr().err
    assert plan.read_bytes() == before


def test_a_hand_may_hold_by_friction(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = tmp_path / "plan.npz"
    drawer_plan().save(plan)
    assert main(["simulate", str(plan), "--grasp", "friction"]) == 0
    assert "slips by" in capsys.readouterr().out
    assert main(["simulate", str(plan), "--grasp", "glue"]) == 2
    assert "expected weld, friction, got glue" in capsys.readouterr().err
