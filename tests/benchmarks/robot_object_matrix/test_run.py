"""Tests the robot–object matrix from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.robot_object_matrix.pairs import SHARE
from vkc_pin.benchmarks.robot_object_matrix.run import run
from vkc_pin.cli import main


@pytest.mark.long
def test_command_opens_a_drawer_and_records_an_unreachable_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    description = vkc.procedural.random_object("drawers", 0)
    drawers = vkc.load_object(description)
    urdf = (
        '<robot name="smooth"><link name="frame"/>'
        '<link name="ball"><collision><geometry><sphere radius="0.2"/></geometry></collision>'
        '</link><joint name="spin" type="revolute">'
        '<parent link="frame"/><child link="ball"/><axis xyz="0 0 1"/>'
        '<limit lower="0" upper="0.3" effort="1" velocity="1"/></joint></robot>'
    )
    smooth = vkc.procedural.write_object(
        {"urdf": urdf, "attachments": []}, tmp_path / "smooth.yaml"
    )
    out = tmp_path / "out"
    command = [
        "bench",
        "anything",
        "--starts",
        "1",
        "--robots",
        "husky_ur5e",
        "--objects",
        "drawers_0",
        str(smooth),
        "--quiet",
    ]
    assert main([*command, "--out", str(out)]) == 0
    table = (out / "table.md").read_text(encoding="utf-8")
    assert table in capsys.readouterr().out
    assert "| drawers_0 | 1/1 |" in table
    assert "| smooth | – |" in table
    assert "nothing of it fits between the fingers" in table
    assert (out / "success.png").stat().st_size > 5000
    records = {
        r["object"]: r
        for r in json.loads((out / "results.json").read_text(encoding="utf-8"))["trials"]
    }
    opened, unreachable = records["drawers_0"], records["smooth"]
    assert (opened["success"], opened["violations"], opened["kind"]) == (True, [], "drawers")
    reach = (drawers.upper - drawers.lower)[drawers.coordinates.index(opened["joint"])]
    assert opened["goal"] == pytest.approx(SHARE * reach, abs=1e-3)
    assert opened["base_path_length"] > 0.5, "the robot starts 2 m away"
    assert (unreachable["success"], unreachable["status"]) == (False, "unreachable")

    journal = (out / "trials.jsonl").read_bytes()
    assert main([*command, "--out", str(out)]) == 0
    again = (out / "trials.jsonl").read_bytes()
    assert again == journal, "no trial was run again"


def test_wrong_arguments_are_refused(tmp_path: Path) -> None:
    with pytest.raises(vkc.InputError, match="starts: out of range"):
        run(out=tmp_path, starts=0)
    with pytest.raises(vkc.InputError, match="robots: not a choice"):
        run(out=tmp_path, robots=["husky_ur5e", "husky_ur5e"])
    with pytest.raises(vkc.InputError, match="objects: not a choice"):
        run(out=tmp_path, objects=[])
    with pytest.raises(vkc.UnknownNameError, match="husky_ur5e"):
        run(out=tmp_path, robots=["husky_ur5"])
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'oven_0'"):
        run(out=tmp_path, objects=["ofen_0"])
