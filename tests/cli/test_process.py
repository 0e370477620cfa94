"""Tests that closed or full outputs lose no files, and that Ctrl-C leaves no partial files."""

from __future__ import annotations

import os
import re
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

import vkc_pin as vkc

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-m", "vkc_pin.cli"]
SUCCESS = "plan drawer --set drawer.slide=0.3"
TIMED_OUT = f"{SUCCESS} --time-limit 0.001 --initialization stationary"
INFEASIBLE = "plan drawer --set drawer.slide=9"
OUTPUTS = "--save plan.npz --json plan.json --csv plan.csv"
Shell = Callable[[str, str], subprocess.CompletedProcess[str]]


@pytest.fixture(autouse=True)
def add_source_to_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    )


@pytest.fixture
def shell(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> Shell:
    """Return a function that runs a command with redirected outputs in the test's folder.

    PIPE has no reader; FULL is a device that is always full: a new one if permitted, else the
    system's.
    """
    full = tmp_path_factory.mktemp("device") / "full"
    if os.getuid() == 0:
        os.mknod(full, stat.S_IFCHR | 0o666, os.makedev(1, 7))
    else:
        full = Path("/dev/full")
    if not full.is_char_device():
        pytest.skip("no device is always full")

    def run_in_shell(redirection: str, words: str) -> subprocess.CompletedProcess[str]:
        reads, writes = os.pipe()
        os.close(reads)
        redirection = redirection.replace("PIPE", f"&{writes}").replace("FULL", str(full))
        command = ["bash", "-c", f'exec "$@" {redirection}', "bash", *COMMAND, *words.split()]
        options = {"capture_output": True, "text": True, "timeout": 120, "check": False}
        try:
            done = subprocess.run(command, cwd=tmp_path, pass_fds=[writes], **options)  # type: ignore[call-overload]
        finally:
            os.close(writes)
        assert "Traceback" not in done.stderr
        return done

    return run_in_shell


def check_complete(folder: Path) -> set[str]:
    """Return the names of all files in a folder; each of them must be complete."""
    names = {path.name for path in folder.iterdir()}
    assert not [name for name in names if name.startswith(".")]
    for name in names:
        text = (folder / name).read_bytes()
        if name.endswith(".npz"):
            vkc.Plan.load(folder / name)
        elif name.endswith(".html"):
            assert text.startswith(b"<!DOCTYPE html>")
            assert text.endswith(b"</html>\n")
        elif name.endswith(".csv"):
            assert len({line.count(b",") for line in text.splitlines()}) == 1
            assert text.endswith(b"\n")
        else:
            assert vkc.Trajectory.from_json(folder / name).times[0] == 0.0
    return names


@pytest.mark.parametrize(
    ("redirection", "words", "code"),
    [
        pytest.param(">PIPE", TIMED_OUT, 1, marks=pytest.mark.long),
        pytest.param("2>FULL", TIMED_OUT, 1, marks=pytest.mark.long),
        (">&- 2>&- <&-", INFEASIBLE, 3),
    ],
)
def test_files_are_written_when_outputs_are_closed(
    redirection: str, words: str, code: int, tmp_path: Path, shell: Shell
) -> None:
    """A file opened later must not reuse the descriptor of a closed output."""
    done = shell(redirection, f"{words} {OUTPUTS}")
    assert done.returncode == code, done
    assert "cannot print" not in done.stderr
    assert check_complete(tmp_path) == {"plan.npz", "plan.json", "plan.csv"}
    if redirection.startswith("2"):
        assert "wrote plan.csv" in done.stdout


@pytest.mark.long
def test_progress_on_a_full_device_does_not_fail(tmp_path: Path, shell: Shell) -> None:
    done = shell("2>FULL", f"{SUCCESS} --save plan.npz")
    assert done.returncode == 0, done
    assert vkc.Plan.load(tmp_path / "plan.npz").success
    assert "drawer: success" in done.stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "code"),
    [pytest.param(INFEASIBLE, 3, marks=pytest.mark.long), (SUCCESS, 2)],
    ids=["infeasible", "success"],
)
def test_report_on_a_full_device_fails(words: str, code: int, tmp_path: Path, shell: Shell) -> None:
    """Files are still written, and a failure keeps its exit code."""
    done = shell(">FULL", f"{words} --quiet --json plan.json")
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.splitlines()[-1] == "vkc-pin: cannot print: No space left on device"
    assert check_complete(tmp_path) == {"plan.json"}


@pytest.mark.parametrize(("redirection", "code"), [(">PIPE", 0), (">FULL", 2)])
def test_help_on_closed_and_full_outputs(redirection: str, code: int, shell: Shell) -> None:
    assert shell(redirection, "--help").returncode == code


@pytest.mark.long
def test_characters_outside_the_encoding_are_escaped(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    done = shell("", TIMED_OUT)
    assert done.returncode == 1, done
    assert "drawer: FAILED, time limit \\u2014 stand" in done.stdout


def test_warnings_name_the_file_and_no_code(tmp_path: Path, shell: Shell) -> None:
    box = "<collision><geometry><box size='0.2 0.2 0.2'/></geometry></collision>"
    lid = (
        f"<robot name='chest'><link name='chest'/><link name='lid'>{box}</link>"
        "<joint name='hinge' type='revolute'><parent link='chest'/><child link='lid'/>"
        "<axis xyz='0 1 0'/><limit lower='0' upper='1' velocity='1' effort='1'/></joint></robot>"
    )
    beam = {"name": "beam", "type": "box", "size": [0.1, 0.1, 0.1], "position": [2.0, 0.0, 0.5]}
    # Without attachments there is nothing to reach, which would take longest to check.
    chest = {"name": "chest", "type": {"urdf": lid, "attachments": []}, "position": [2.0, 0.0, 0.5]}
    scene = {
        "robot": "husky_ur5e",
        "start": {"base": [0.0, 0.0, 0.0]},
        "objects": [chest],
        "obstacles": [beam],
    }
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene), encoding="utf-8")
    done = shell("", "check scene.yaml")
    assert done.stderr.startswith("vkc-pin: scene.yaml: movable links overlap other shapes: ")
    assert "Warning" not in done.stderr
    assert len(done.stderr.splitlines()) == 1


def start_process(words: str, folder: Path, *options: str) -> subprocess.Popen[str]:
    """Start a command that Ctrl-C interrupts, with options of the Python interpreter."""
    return subprocess.Popen(
        [COMMAND[0], *options, *COMMAND[1:], *words.split()],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # The shell that runs the tests may ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def read_lines(process: subprocess.Popen[str], printed: list[str]) -> Iterator[str]:
    assert process.stderr is not None
    for line in process.stderr:
        printed.append(line)
        yield line


def wait_for_exit(process: subprocess.Popen[str], printed: list[str]) -> int:
    """Return the exit code of a process; it must end without a traceback."""
    assert process.stderr is not None
    printed += process.stderr.readlines()
    process.communicate(timeout=60)
    errors = "".join(line for line in printed if not line.startswith("import time:"))
    assert "Traceback" not in errors, errors
    assert "Exception ignored" not in errors, errors
    return process.returncode


@pytest.mark.parametrize("module", ["argparse", "pinocchio", "vkc_pin.planning.solver.loop"])
def test_ctrl_c_during_imports_writes_nothing(module: str, tmp_path: Path) -> None:
    process, printed = start_process(f"{SUCCESS} {OUTPUTS}", tmp_path, "-X", "importtime"), []
    begun = False
    for line in read_lines(process, printed):
        name = line.rpartition("|")[2].strip()
        begun = begun or name == "vkc_pin"  # the handler is installed from here on
        if begun and name == module:
            process.send_signal(signal.SIGINT)
            break
    else:
        pytest.fail(f"{module} is not imported")
    assert wait_for_exit(process, printed) == 130
    assert check_complete(tmp_path) == set()


def test_ctrl_c_while_planning_writes_the_best_motion(tmp_path: Path) -> None:
    process, printed = start_process(f"{SUCCESS} {OUTPUTS}", tmp_path), []
    next(line for line in read_lines(process, printed) if re.match(r"  round +1 ", line))
    process.send_signal(signal.SIGINT)
    code = wait_for_exit(process, printed)
    assert code in (0, 130)  # planning may be over by then
    assert check_complete(tmp_path) <= {"plan.npz", "plan.json", "plan.csv"}
    if code == 130 and (tmp_path / "plan.npz").exists():
        assert vkc.Plan.load(tmp_path / "plan.npz").status in ("interrupted", "success")


@pytest.mark.parametrize("delay", [pytest.param(0.0, marks=pytest.mark.long), 0.2])
def test_ctrl_c_while_writing_leaves_complete_files(delay: float, tmp_path: Path) -> None:
    outputs = f"{OUTPUTS} --html plan.html --plots plots --quiet"
    process = start_process(f"{SUCCESS} {outputs}", tmp_path)
    while not (tmp_path / "plan.npz").exists():
        assert process.poll() is None
        time.sleep(0.002)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    assert wait_for_exit(process, []) in (0, 130)
    for picture in (tmp_path / "plots").glob("*"):
        assert picture.read_bytes()[-8:-4] == b"IEND"
        picture.unlink()
    if (tmp_path / "plots").is_dir():
        (tmp_path / "plots").rmdir()
    assert {"plan.npz"} <= check_complete(tmp_path)


@pytest.mark.long
def test_ignored_ctrl_c_stays_ignored(tmp_path: Path) -> None:
    """Background processes of scripts ignore Ctrl-C."""
    command = [*COMMAND, *SUCCESS.split(), "--quiet", "--json", "plan.json"]
    process = subprocess.Popen(
        command, cwd=tmp_path, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN)
    )
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    assert process.returncode == 0
    assert check_complete(tmp_path) == {"plan.json"}
