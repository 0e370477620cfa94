"""Tests that writers leave complete files or none, and do not follow links out of their folder."""

from __future__ import annotations

import contextlib
import functools
import io
import os
import resource
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from helpers.datasets import SMALL

import vkc_pin as vkc
from vkc_pin import InputError
from vkc_pin.cli import main
from vkc_pin.experiments.harness.record import find_commit
from vkc_pin.experiments.harness.runner import run
from vkc_pin.procedural import random_object, write_object
from vkc_pin.world.models.self_collisions import write_srdf

ROBOT = Path(__file__).parent / "fuzz" / "inputs" / "robot.urdf"
OBJECT = ROBOT.with_name("cabinet.urdf")
HOME = ROBOT.with_name("home.xml")


@functools.cache
def make_plan() -> vkc.Plan:
    return vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 0.2})])


@functools.cache
def save_plan() -> Path:
    return make_plan().save(Path(tempfile.mkdtemp(), "plan.npz"))


@functools.cache
def simulate() -> vkc.SimulationResult:
    pytest.importorskip("mujoco")
    return make_plan().simulate()


def _import_object(path: Path, **options: Any) -> None:
    vkc.importing.import_object(OBJECT, path, most=1, **options)


def _import_home(path: Path, **options: Any) -> None:
    pytest.importorskip("mujoco")
    vkc.importing.import_home(HOME, path, most=1, **options)


def _generate(path: Path) -> None:
    pytest.importorskip("h5py")
    vkc.datasets.generate(SMALL, 1, path)


def _render_film(path: Path) -> None:
    if shutil.which("ffmpeg") is None:
        pytest.importorskip("imageio_ffmpeg")
    simulate().to_mp4(path, rate=2.0)


def _write_ros(path: Path) -> None:
    """Write ROS messages with the command line, whose errors are text."""
    text = io.StringIO()
    with contextlib.redirect_stderr(text), contextlib.redirect_stdout(io.StringIO()):
        code = main(["export", str(save_plan()), "--ros", str(path)])
    if code:
        raise InputError(text.getvalue())


def _write_rosbag(path: Path, **options: Any) -> None:
    pytest.importorskip("rosbags")
    make_plan().to_rosbag(path, **options)


FILES: dict[str, Callable[[Path], Any]] = {
    "a.npz": lambda path: make_plan().save(path),
    "a.json": lambda path: make_plan().to_json(path),
    "a.csv": lambda path: make_plan().to_csv(path),
    "motion.csv": lambda path: make_plan().trajectory.to_csv(path),
    "motion.json": lambda path: make_plan().trajectory.to_json(path),
    "result.json": lambda path: simulate().to_json(path),
    "drawers.yaml": lambda path: write_object(random_object("drawers", seed=1), path),
    "plot.png": lambda path: make_plan().plot(path),
    "ros.json": _write_ros,
}
FOLDERS: dict[str, Callable[..., Any]] = {
    "bag": _write_rosbag,
    "object": _import_object,
    "home": _import_home,
    "robot": lambda path, **options: vkc.importing.import_robot(
        ROBOT, path, samples=100, most_pieces=1, **options
    ),
}
RESUMED: dict[str, Callable[[Path], Any]] = {
    "dataset": _generate,
    "benchmark": lambda path: run(
        [{"key": "0"}],
        lambda trial: {**trial, "status": "success"},
        path,
        settings={},
        progress=False,
    ),
}
"""Writers that continue an unfinished folder."""
SLOW: dict[str, Callable[[Path], Any]] = {
    "a.html": lambda path: make_plan().to_html(path),
    "robot.srdf": lambda path: write_srdf(make_plan().scene.robot, path, samples=50),
}
RENDERED: dict[str, Callable[[Path], Any]] = {
    "pictures.png": lambda path: simulate().plot(path, count=2),
    "film.mp4": _render_film,
}
"""Slow writers, which check their target first."""
WRITERS = {**FILES, **FOLDERS, **RESUMED, **RENDERED}


@contextlib.contextmanager
def fill_disk(free: int = 100) -> Iterator[None]:
    """Limit files to `free` bytes, as on a full disk.

    Imports write no bytecode meanwhile, because Python 3.11 keeps truncated files.
    """
    before, writes_no_bytecode = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    with mock.patch.dict(os.environ, PYTHONDONTWRITEBYTECODE="1"):
        sys.dont_write_bytecode = True
        resource.setrlimit(resource.RLIMIT_FSIZE, (free, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
            sys.dont_write_bytecode = writes_no_bytecode


def list_files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return an empty folder beside a folder with the file of another user."""
    (tmp_path / "others").mkdir()
    (tmp_path / "others" / "letter.txt").write_text("dear", encoding="utf-8")
    (tmp_path / "mine").mkdir()
    return tmp_path / "mine"


@pytest.mark.parametrize("name", [*FILES, *FOLDERS, *SLOW])
def test_full_disk_leaves_no_partial_files(folder: Path, name: str) -> None:
    if name.startswith("result"):
        simulate()
    save_plan()
    previous = {name: "before"} if name in FILES else {}
    for file, text in previous.items():
        (folder / file).write_text(text, encoding="utf-8")
    with fill_disk(), pytest.raises(InputError, match=r"cannot write this .*(large|disk)"):
        {**WRITERS, **SLOW}[name](folder / name)
    assert {file.name: file.read_text(encoding="utf-8") for file in folder.iterdir()} == previous
    assert list_files(folder.parent / "others") == {"letter.txt"}


@pytest.mark.parametrize("name", [pytest.param("dataset", marks=pytest.mark.long), "benchmark"])
def test_writers_continue_after_a_full_disk(folder: Path, name: str) -> None:
    find_commit()  # cached, because git killed by the size limit leaves a lock
    with fill_disk(), pytest.raises(InputError, match=r"cannot write this .*File too large"):
        RESUMED[name](folder / name)
    RESUMED[name](folder / name)
    assert len(list_files(folder / name)) > 2
    assert list_files(folder.parent / "others") == {"letter.txt"}


@pytest.mark.parametrize("name", WRITERS)
def test_pipes_link_loops_and_paths_below_files_are_refused(folder: Path, name: str) -> None:
    os.mkfifo(folder / f"pipe{Path(name).suffix}")
    (folder / f"loop{Path(name).suffix}").symlink_to(f"loop{Path(name).suffix}")
    (folder / "file").touch()
    before = list_files(folder)
    for target in (f"pipe{Path(name).suffix}", f"loop{Path(name).suffix}", f"file/{name}"):
        with pytest.raises(InputError):
            WRITERS[name](folder / target)
        assert list_files(folder) == before


@pytest.mark.parametrize("name", FOLDERS)
@pytest.mark.parametrize("force", [False, True])
def test_folders_with_other_files_are_not_replaced(folder: Path, name: str, force: bool) -> None:
    others = folder.parent / "others"
    (folder / name).symlink_to(others)
    for target in (others, folder / name):
        with pytest.raises(InputError, match=r"other files|already exists|did not write"):
            FOLDERS[name](target, force=force)
    assert (folder / name).is_symlink()
    assert (others / "letter.txt").read_text(encoding="utf-8") == "dear"


@pytest.mark.parametrize("name", FOLDERS)
def test_links_in_a_replaced_folder_are_not_followed(folder: Path, name: str) -> None:
    FOLDERS[name](folder / name)
    others = folder.parent / "others"
    written = sorted(path for path in (folder / name).iterdir() if path.is_file())
    for path in written:
        if path.suffix != ".yaml" and path.name != ".vkc-pin.json":
            path.unlink()
            path.symlink_to(others / "letter.txt")
    FOLDERS[name](folder / name, force=True)
    assert not any(path.is_symlink() for path in (folder / name).rglob("*"))
    assert (others / "letter.txt").read_text(encoding="utf-8") == "dear"
    assert list_files(others) == {"letter.txt"}


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
@pytest.mark.parametrize("name", WRITERS)
def test_missing_permission_is_reported(folder: Path, name: str) -> None:
    folder.chmod(0o500)
    try:
        with pytest.raises(InputError, match="ermission"):
            WRITERS[name](folder / name)
    finally:
        folder.chmod(0o700)
