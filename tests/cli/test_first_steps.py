"""Tests the commands for the first steps: demo, new and completion."""

from __future__ import annotations

import runpy
import shutil
import subprocess
from pathlib import Path

import pytest
from helpers.commands import RunCommand

import vkc_pin as vkc


def test_demo_writes_the_page_of_the_door(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: RunCommand
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("CC", "/nonexistent")
    result = run("demo")
    assert result.code == 0
    assert [file.name for file in tmp_path.iterdir()] == ["vkc-pin-demo.html"]
    assert "door: success" in result.out
    assert "there is no C compiler (/nonexistent)" in result.out
    assert (tmp_path / "vkc-pin-demo.html").as_uri() in result.out


def test_new_scene_runs(run: RunCommand, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path("deep/mine")
    assert "python deep/mine/plan.py" in run("new deep/mine").out
    assert {file.name for file in folder.iterdir()} == {"scene.yaml", "plan.py"}
    runpy.run_path(str(folder / "plan.py"))
    assert "first: success" in capsys.readouterr().out
    assert vkc.Plan.load(folder / "plan.npz").success
    assert (folder / "plan.html").is_file()


def test_a_folder_stands_for_its_scene(run: RunCommand) -> None:
    run("new mine")
    file = Path("mine/scene.yaml")
    scenes = [vkc.load_scene(path) for path in ("mine", Path("mine"), file)]
    assert len({str(scene.file) for scene in scenes}) == 1
    assert run("check mine").code == 0
    before = file.read_bytes()
    result = run("plan mine --set drawer.slide=0.1 --save mine/scene.yaml")
    assert result.code == 2
    assert "another file than SCENE" in result.err
    assert file.read_bytes() == before
    assert run("plan mine --set drawer.slide=0.1").code == 0
    Path("empty").mkdir()
    with pytest.raises(vkc.InputError, match="there is no scene 'empty'"):
        vkc.load_scene("empty")


def test_new_does_not_overwrite_files(run: RunCommand) -> None:
    Path("plan.py").write_text("mine")
    result = run("new .")
    assert result.code == 2
    assert "expected a new or empty folder" in result.err
    assert Path("plan.py").read_text() == "mine"
    assert not Path("scene.yaml").exists()


def test_bash_completes_commands_and_options(run: RunCommand) -> None:
    if (bash := shutil.which("bash")) is None:
        pytest.skip("no bash")
    script = run("completion bash").out
    for words, expected in ((["vkc-pin", "de"], "demo"), (["vkc-pin", "plan", "--ht"], "--html")):
        typed = f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}"
        ask = f"{typed}; _shtab_vkc_pin; echo ${{COMPREPLY[@]}}"
        done = subprocess.run(
            [bash, "-c", f"{script}\n{ask}"], capture_output=True, text=True, check=False
        )
        assert done.stdout.split() == [expected], done.stderr


def test_help_keeps_each_command_on_a_line_and_lists_groups(run: RunCommand) -> None:
    text = run("completion --help").out
    for shell in ("bash", "zsh"):
        assert f'eval "$(vkc-pin completion {shell})"\n' in text
    lines = run("--help").out.splitlines()
    after = lines[lines.index("first steps:") + 1 : lines.index("motions:") - 1]
    assert [line.split()[0] for line in after] == ["demo", "new"]
    assert sum(line.startswith("  plan ") for line in lines) == 1
