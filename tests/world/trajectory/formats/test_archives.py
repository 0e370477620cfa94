"""Tests archives of plans: invalid, damaged and oversized files are rejected."""

from __future__ import annotations

import io
import json
import math
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error

import vkc_pin as vkc
from vkc_pin.world.trajectory.formats.archives import read_archive, write_archive


@pytest.fixture(scope="module")
def saved(door_plan: vkc.Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return door_plan.save(tmp_path_factory.mktemp("archives") / "door.npz")


def pack_array(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def read_members(saved: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(saved) as archive:
        return {name.removesuffix(".npy"): archive.read(name) for name in archive.namelist()}


def write_members(
    path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED
) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def write_changed(path: Path, saved: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    """Write a copy of the file with a changed description."""
    members = read_members(saved)
    about = json.loads(str(np.load(io.BytesIO(members["about"]))))
    change(about)
    return write_members(path, {**members, "about": pack_array(np.array(json.dumps(about)))})


def test_archives_survive_a_round_trip(tmp_path: Path, saved: Path) -> None:
    about = read_archive(saved)
    np.testing.assert_equal(read_archive(write_archive(tmp_path / "again", about)), about)
    motion = about["trajectory"]
    other = {
        "times": pack_array(motion["times"].astype(">f8")),
        "positions": pack_array(np.asfortranarray(motion["positions"])),
    }
    swapped = read_archive(write_members(tmp_path / "other", {**read_members(saved), **other}))
    np.testing.assert_equal(swapped, about)


Change = Callable[[dict[str, Any]], Any]
DESCRIPTIONS: list[tuple[Change, str]] = [
    (lambda about: about.pop("metrics"), "metrics: missing"),
    (
        lambda about: about["metrics"].update(arm_path_length=math.nan),
        "arm_path_length: wrong value",
    ),
    (lambda about: about["metrics"].update(rounds=-1), "metrics.rounds: out of range"),
    (lambda about: about["metrics"].update(rounds=10**400), "metrics.rounds: wrong value"),
    (lambda about: about["metrics"].update(more=None), r"metrics\.more: wrong value"),
    (lambda about: about["metrics"].update(more=math.nan), r"metrics\.more: wrong value"),
    (
        lambda about: about["metrics"].update(base_path_length=0.1),
        "base_path_length: not that of motion",
    ),
    (lambda about: about["validation"].update(clearance=math.nan), "clearance: out of range"),
    (lambda about: about["validation"].update(clearances=[0.1] * 9), "clearances: wrong number"),
    (lambda about: about["validation"].update(violations=[{"constraint": "goal"}]), "missing"),
    (lambda about: about.update(success=True), "success: there is no field 'success'"),
    (lambda about: about.update(status="<b>"), "status: wrong value"),
    (lambda about: about.update(seed=True), "seed: wrong value .expected a whole number"),
    (lambda about: about.update(history=[{"round": "two"}]), r"history\[0\]\.round: wrong value"),
    (lambda about: about["trajectory"]["phases"][0].update(first=-1), "first: out of range"),
    (lambda about: about["trajectory"].update(names=[1]), r"trajectory.names\[0\]: wrong value"),
    (lambda about: about.update(folder={"package": "../../etc"}), "folder: no folder of a scene"),
    (lambda about: about.update(steps=[{"step": "Actuate"}]), "Actuate.object: this is missing"),
    (lambda about: about.update(options={"dt": "fast"}), "Options.dt"),
    (lambda about: about["scene"].update(robot=7), "robot"),
    (lambda about: about.update(terms=[{"term": "Cost"}]), "not a saved term"),
]


@pytest.mark.parametrize(("change", "message"), DESCRIPTIONS)
def test_invalid_descriptions_are_rejected(
    tmp_path: Path, saved: Path, change: Change, message: str
) -> None:
    path = write_changed(tmp_path / "wrong", saved, change)
    with expect_error(message, file=path):
        vkc.Plan.load(path)


def _set_nan(positions: np.ndarray) -> np.ndarray:
    positions[3, 4] = np.nan
    return positions


def _repeat_time(times: np.ndarray) -> np.ndarray:
    times[3] = times[2]
    return times


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("positions", _set_nan, r"positions\[3, 4\]: not finite"),
        ("times", _repeat_time, "times do not increase"),
        ("times", lambda times: times[:-1], "phases do not follow|wrong shape"),
        ("positions", lambda positions: positions[:, :-1], "wrong shape"),
        (
            "positions",
            lambda positions: positions.astype(complex),
            "positions is an array of complex128",
        ),
        ("about", lambda about: np.array(["{}"]), r"about is an array of <U2"),
        ("about", lambda about: np.array(""), "not JSON"),
        (
            "about",
            lambda about: np.array('{"a":' * 60 + "1" + "}" * 60),
            "too many lists and objects inside each other",
        ),
    ],
)
def test_invalid_arrays_are_rejected(
    tmp_path: Path, saved: Path, name: str, change: Callable[[Any], Any], message: str
) -> None:
    members = read_members(saved)
    array = np.load(io.BytesIO(members[name]))
    path = write_members(tmp_path / "wrong", {**members, name: pack_array(change(array.copy()))})
    with expect_error(message, file=path):
        vkc.Plan.load(path)


def _make_bomb(members: dict[str, bytes]) -> dict[str, bytes]:
    return {**members, "positions": pack_array(np.zeros((100_000, 125)))}


def _nest_lists(members: dict[str, bytes]) -> dict[str, bytes]:
    return {
        **members,
        "about": pack_array(np.array('{"format": 1, "history": [' + "[]," * 3_000_000 + "[]]}")),
    }


LOAD = """
import re, sys, time
import vkc_pin as vkc
vkc.Plan.load(sys.argv[1])
before = time.process_time()
try:
    vkc.Plan.load(sys.argv[2])
except vkc.InputError as error:
    print(str(error)[:2000])
peak = re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())
print(int(peak[1]) / 1e3, time.process_time() - before)
"""


@pytest.mark.parametrize("make", [_make_bomb, pytest.param(_nest_lists, marks=pytest.mark.long)])
def test_large_contents_are_rejected_before_they_are_unpacked(
    tmp_path: Path, saved: Path, make: Callable[[Any], Any]
) -> None:
    """Rejection takes less than 500 MB, and 2 s of CPU time on an idle machine."""
    path = write_members(tmp_path / "large", make(read_members(saved)))
    run = [sys.executable, "-c", LOAD, str(saved), str(path)]
    result = subprocess.run(run, capture_output=True, text=True, timeout=100, check=True)
    message, figures = result.stdout.rsplit("\n", 2)[:2]
    assert str(path) in message, result.stdout
    memory, seconds = map(float, figures.split())
    assert memory < 500.0, message
    assert seconds < 10.0, message


def test_unreadable_files_are_rejected(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, message in (
        (tmp_path / "pipe", "a pipe or a device"),
        (tmp_path, "Is a directory"),
        (tmp_path / "none", "No such file"),
    ):
        with expect_error(f"cannot read the plan .*got {message}"):
            vkc.Plan.load(path)


def test_only_compression_methods_of_numpy_are_accepted(tmp_path: Path, saved: Path) -> None:
    members = read_members(saved)
    with expect_error("compressed by an unknown method"):
        vkc.Plan.load(write_members(tmp_path / "odd", members, zipfile.ZIP_BZIP2))
    plain = write_members(tmp_path / "plain", members, zipfile.ZIP_STORED)
    assert vkc.Plan.load(plain).seed == 0
