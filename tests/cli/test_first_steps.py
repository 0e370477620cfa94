"""Tests the commands for the first steps: demo, new and completion."""

from __future__ import annotations

import runpy
import shutil
import subprocess
from pathlib import Path

import pytest

import vkc_pin as vkc
from vkc_pin.cli import main


def test_demo_writes_the_page_of_the_door(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("CC", "/nonexistent")
    assert main(["demo"]) == 0
    assert [file.name for file in tmp_path.iterdir()] == ["vkc-pin-demo.html"]
    out = capsys.readouterr().out
    assert "door: success" in out
    assert "there is no C compiler (/nonexistent)" in out
    assert (tmp_path / "vkc-pin-demo.html").as_uri() in out


def test_new_scene_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "deep" / "mine"
    assert main(["new", str(folder)]) == 0
    assert {file.name for file in folder.iterdir()} == {"scene.yaml", "plan.py"}
    assert f"python {folder}/plan.py" in capsys.readouterr().out
    runpy.run_path(str(folder / "plan.py"))
    assert "first: success" in capsys.readouterr().out
    assert vkc.Plan.load(folder / "plan.npz").success
    assert (folder / "plan.html").is_file()


def test_new_does_not_overwrite_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan.py").write_text("mine")
    assert main(["new", str(tmp_path)]) == 2
    assert "expected a new or empty folder" in capsys.readouterr().err
    assert (tmp_path / "plan.py").read_text() == "mine"
    assert not (tmp_path / "scene.yaml").exists()


def test_bash_completes_commands_and_options(capsys: pytest.CaptureFixture[str]) -> None:
    if (bash := shutil.which("bash")) is None:
        pytest.skip("no bash")
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    for words, expected in ((["vkc-pin", "de"], "demo"), (["vkc-pin", "plan", "--ht"], "--html")):
        typed = f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}"
        ask = f"{typed}; _shtab_vkc_pin; echo ${{COMPREPLY[@]}}"
        done = subprocess.run(
            [bash, "-c", f"{script}\n{ask}"], capture_output=True, text=True, check=False
        )
        assert done.stdout.split() == [expected], done.stderr


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_help_of_completion_keeps_each_command_on_a_line(
    shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["completion", "--help"])
    assert f'eval "$(vkc-pin completion {shell})"\n' in capsys.readouterr().out


def test_help_lists_commands_in_groups(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    lines = capsys.readouterr().out.splitlines()
    after = lines[lines.index("first steps:") + 1 : lines.index("motions:") - 1]
    assert [line.split()[0] for line in after] == ["demo", "new"]
    assert sum(line.startswith("  plan ") for line in lines) == 1
