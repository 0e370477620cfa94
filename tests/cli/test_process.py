"""The command as a process: closed and full outputs lose nothing, Ctrl-C leaves nothing half done."""

from __future__ import annotations

import os
import re
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import vkc_pin as vkc

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-m", "vkc_pin.cli"]
UNFINISHED = [
    "plan",
    "drawer",
    "--set",
    "drawer.slide=0.3",
    "--time-limit",
    "0.001",
    "--initialization",
    "stationary",
]
INFEASIBLE = ["plan", "drawer", "--set", "drawer.slide=9"]
SUCCESS = ["plan", "drawer", "--set", "drawer.slide=0.3"]


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    )


@pytest.fixture
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A device that is always full: one of our own if we may make one, or the machine's."""
    path = tmp_path_factory.mktemp("device") / "full"
    if os.getuid() == 0:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 7))
    else:
        path = Path("/dev/full")
    if not path.is_char_device():
        pytest.skip("there is no device that is always full")
    return path


def shell(
    redirected: str, words: list[str], folder: Path, full: Path
) -> subprocess.CompletedProcess[str]:
    """Run a command with outputs redirected as a shell does it; PIPE is one that nobody reads from any more."""
    reads, writes = os.pipe()
    os.close(reads)
    redirected = redirected.replace("PIPE", f"&{writes}").replace("FULL", str(full))
    command = ["bash", "-c", f'exec "$@" {redirected}', "bash", *COMMAND, *words]
    try:
        return subprocess.run(
            command,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=120,
            pass_fds=[writes],
            check=False,
        )
    finally:
        os.close(writes)


def whole(folder: Path) -> set[str]:
    """Return the names of all files in a folder, each of which is complete."""
    names = {path.name for path in folder.iterdir()}
    assert not [name for name in names if name.startswith(".")]
    for name in names:
        text = (folder / name).read_bytes()
        if name.endswith(".npz"):
            vkc.Plan.load(folder / name)
        elif name.endswith(".html"):
            assert text.startswith(b"<!DOCTYPE html>")
            assert text.endswith(b"</html>\n")
        else:
            assert vkc.Trajectory.from_json(folder / name).times[0] == 0.0
    return names


@pytest.mark.parametrize(
    ("redirected", "words", "code"),
    [
        *(
            (redirected, UNFINISHED, 1)
            for redirected in (">PIPE", ">&-", "2>&-", "2>PIPE", "2>FULL", ">PIPE 2>PIPE")
        ),
        (">&- 2>&- <&-", INFEASIBLE, 3),
    ],
)
def test_closed_outputs_lose_nothing(
    redirected: str, words: list[str], code: int, tmp_path: Path, full: Path
) -> None:
    """Nor is the next file that is opened taken for the output that is closed."""
    done = shell(
        redirected,
        [*words, "--save", "plan.npz", "--json", "plan.json", "--html", "plan.html"],
        tmp_path,
        full,
    )
    assert done.returncode == code, done
    assert "Traceback" not in done.stderr
    assert "cannot print" not in done.stderr
    assert whole(tmp_path) == {"plan.npz", "plan.json", "plan.html"}
    if redirected.startswith("2"):
        assert "wrote plan.html" in done.stdout


@pytest.mark.parametrize("redirected", ["", ">PIPE", ">&-", "2>FULL"])
def test_progress_that_nobody_sees_is_no_failure(
    redirected: str, tmp_path: Path, full: Path
) -> None:
    done = shell(redirected, [*SUCCESS, "--save", "plan.npz"], tmp_path, full)
    assert done.returncode == 0, done
    assert vkc.Plan.load(tmp_path / "plan.npz").success
    assert ("round  1" in done.stderr) == ("2>" not in redirected)
    assert ("drawer: success" in done.stdout) == (redirected in ("", "2>FULL"))


@pytest.mark.parametrize(
    ("words", "code"),
    [(UNFINISHED, 1), (INFEASIBLE, 3), (["view", "drawer"], 2)],
    ids=["failed", "infeasible", "done"],
)
def test_a_full_disk_is_no_success(words: list[str], code: int, tmp_path: Path, full: Path) -> None:
    """The files are there all the same, and what was no success stays what it was."""
    done = shell(">FULL", [*words, "--html", "page.html"], tmp_path, full)
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.splitlines()[-1] == "vkc-pin: cannot print: No space left on device"
    assert "Traceback" not in done.stderr
    assert whole(tmp_path) == {"page.html"}


@pytest.mark.parametrize(
    ("redirected", "code"), [(">PIPE", 0), (">&-", 0), (">FULL", 2), ("2>FULL >FULL", 2)]
)
@pytest.mark.parametrize("word", ["--help", "--version"])
def test_help_goes_the_same_way(
    redirected: str, code: int, word: str, tmp_path: Path, full: Path
) -> None:
    done = shell(redirected, [word], tmp_path, full)
    assert done.returncode == code, done
    assert "Traceback" not in done.stderr


def test_letters_that_the_terminal_does_not_have(
    tmp_path: Path, full: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    done = shell("", UNFINISHED, tmp_path, full)
    assert done.returncode == 1, done
    assert "drawer: FAILED, time limit \\u2014 stand" in done.stdout


def started(words: list[str], folder: Path, *options: str) -> subprocess.Popen[str]:
    """Start a command that Ctrl-C reaches, with options of Python."""
    command = [COMMAND[0], *options, *COMMAND[1:], *words]
    return subprocess.Popen(
        command,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(
            signal.SIGINT, signal.SIG_DFL
        ),  # a shell may have made the tests ignore it
    )


def lines(process: subprocess.Popen[str], said: list[str]) -> Iterator[str]:
    assert process.stderr is not None
    for line in process.stderr:
        said.append(line)
        yield line


def ended(process: subprocess.Popen[str], said: list[str]) -> int:
    """Return the code a process ends with, which says nothing that it should not."""
    assert process.stderr is not None
    said += process.stderr.readlines()
    process.communicate(timeout=60)
    told = "".join(line for line in said if not line.startswith("import time:"))
    assert "Traceback" not in told, told
    assert "Exception ignored" not in told, told
    return process.returncode


OUTPUTS = ["--save", "plan.npz", "--json", "plan.json", "--html", "plan.html"]


@pytest.mark.parametrize(
    "module",
    [
        "_signal",
        "argparse",
        "numpy",
        "pinocchio",
        "vkc_pin.world.scene.scene",
        "coal",
        "casadi",
        "vkc_pin.planning.plan",
        "vkc_pin.planning.solver.loop",
    ],
)
def test_ctrl_c_while_it_imports(module: str, tmp_path: Path) -> None:
    process, said = (
        started([*SUCCESS, *OUTPUTS], tmp_path, "-X", "importtime"),
        [],
    )  # it then tells what it imports
    begun = False
    for line in lines(process, said):
        name = line.rpartition("|")[2].strip()
        begun = (
            begun or name == "vkc_pin"
        )  # from here on it is in our hands, but for the few lines that take it there
        if begun and (name == module or module == "_signal"):
            time.sleep(0.05 if module == "_signal" else 0.0)
            process.send_signal(signal.SIGINT)
            break
    else:
        pytest.fail(f"{module} is not imported")
    assert ended(process, said) == 130
    assert whole(tmp_path) == set()


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.3])
def test_ctrl_c_while_it_plans(delay: float, tmp_path: Path) -> None:
    """It returns the best there is by then, and writes it."""
    process, said = started([*SUCCESS, *OUTPUTS], tmp_path), []
    next(line for line in lines(process, said) if re.match(r"  round +1 ", line))
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    code = ended(process, said)
    assert code in (0, 130)  # at the very end it makes no difference any more
    assert whole(tmp_path) <= {"plan.npz", "plan.json", "plan.html"}
    if code == 130 and (tmp_path / "plan.npz").exists():
        assert vkc.Plan.load(tmp_path / "plan.npz").status in ("interrupted", "success")


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.1, 0.2, 0.4, 0.8])
def test_ctrl_c_while_it_writes(delay: float, tmp_path: Path) -> None:
    """Written is the plan, and of the rest nothing or all."""
    process = started([*SUCCESS, *OUTPUTS, "--plots", "plots", "--quiet"], tmp_path)
    while not (tmp_path / "plan.npz").exists():
        assert process.poll() is None
        time.sleep(0.002)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    assert ended(process, []) in (0, 130)
    for picture in (tmp_path / "plots").glob("*"):
        assert picture.read_bytes()[-8:-4] == b"IEND"
        picture.unlink()
    if (tmp_path / "plots").is_dir():
        (tmp_path / "plots").rmdir()
    assert {"plan.npz"} <= whole(tmp_path)


def test_ctrl_c_that_is_ignored_stays_so(tmp_path: Path) -> None:
    """As it is in the background of a script."""
    command = [*COMMAND, "view", "drawer", "--html", "page.html"]
    process = subprocess.Popen(
        command, cwd=tmp_path, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN)
    )
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    assert process.returncode == 0
    assert whole(tmp_path) == {"page.html"}
