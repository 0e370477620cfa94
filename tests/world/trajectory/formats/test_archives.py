"""Files of saved plans with anything in them: each is refused in time, in little memory, and for its reason."""

from __future__ import annotations

import contextlib
import inspect
import io
import json
import math
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.baselines import attempt, following
from vkc_pin.world.trajectory.formats import archives
from vkc_pin.world.trajectory.formats.archives import METRICS, STATUSES, read_archive, write_archive


@pytest.fixture(scope="module")
def saved(door_plan: vkc.Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return door_plan.save(tmp_path_factory.mktemp("archives") / "door.npz")


def packed(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def parts(saved: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(saved) as archive:
        return {name.removesuffix(".npy"): archive.read(name) for name in archive.namelist()}


def written(path: Path, found: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in found.items():
            archive.writestr(f"{name}.npy", data)
    return path


def changed(path: Path, saved: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    """The same file with another description."""
    about, _ = read_archive(saved)
    change(about)
    return written(path, {**parts(saved), "about": packed(np.array(json.dumps(about)))})


def test_what_is_written_is_read(tmp_path: Path, saved: Path) -> None:
    about, arrays = read_archive(saved)
    whole = {**about, "trajectory": {**about["trajectory"], **arrays}}
    again = write_archive(tmp_path / "again", whole)
    assert json.dumps(read_archive(again)[0]) == json.dumps(about)
    for found, kept in (
        (read_archive(again)[1], arrays),
        (read_archive(again)[1]["curve"], arrays["curve"]),
    ):
        assert found.keys() == kept.keys()
        assert all(
            found[name].tobytes() == kept[name].tobytes() for name in kept if name != "curve"
        )
    other = {
        "times": packed(arrays["times"].astype(">f8")),
        "positions": packed(np.asfortranarray(arrays["positions"])),
    }
    for name, array in read_archive(written(tmp_path / "other", {**parts(saved), **other}))[
        1
    ].items():
        for key, values in array.items() if name == "curve" else [(name, array)]:
            np.testing.assert_array_equal(
                values, arrays["curve"][key] if name == "curve" else arrays[key]
            )
    straight = {name: value for name, value in whole["trajectory"].items() if name != "curve"}
    assert set(
        read_archive(write_archive(tmp_path / "straight", {**about, "trajectory": straight}))[1]
    ) == {"times", "positions"}


DESCRIPTIONS: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda about: about.pop("metrics"), "metrics: missing"),
    (lambda about: about.update(metrics=[1, 2]), "metrics: wrong value"),
    (lambda about: about["metrics"].pop("base_path_length"), "metrics.base_path_length: missing"),
    (
        lambda about: about["metrics"].update(arm_path_length=math.nan),
        "metrics.arm_path_length: wrong value .expected a finite number",
    ),
    (lambda about: about["metrics"].update(rounds=-1), "metrics.rounds: out of range"),
    (lambda about: about["metrics"].update(rounds=10**400), "metrics.rounds: wrong value"),
    (
        lambda about: about["metrics"].update(duration="long"),
        "metrics.duration: wrong value .expected a number",
    ),
    (lambda about: about["metrics"].update(more=None), "metrics: the metric 'more' is none"),
    (lambda about: about["metrics"].update(clearance=math.nan), "metrics.clearance: out of range"),
    (
        lambda about: about["metrics"].update(base_path_length=0.1),
        r"metrics.base_path_length: not that of motion and report .*got 0.1",
    ),
    (
        lambda about: about["metrics"].update(clearance=0.1),
        r"metrics.clearance: not that of motion and report .*got 0.1",
    ),
    (
        lambda about: about["validation"].update(clearance=math.nan),
        r"validation.clearance: out of range",
    ),
    (
        lambda about: about["validation"].update(closure_error=math.inf),
        r"validation.closure_error: wrong value",
    ),
    (
        lambda about: about["validation"].update(states="many"),
        r"validation.states: wrong value .expected a whole number",
    ),
    (
        lambda about: about["validation"].update(violations=[{"constraint": "goal"}]),
        r"validation.violations\[0\].subject: missing",
    ),
    (lambda about: about["validation"].update(ok=True), r"validation.ok: there is no field 'ok'"),
    (lambda about: about.update(success=True), "success: there is no field 'success'"),
    (
        lambda about: about.update(status="sucess"),
        "status: there is no status 'sucess'; did you mean 'success'",
    ),
    (lambda about: about.update(status=1), "status: there is no status '1'"),
    (lambda about: about.update(seed=-1), "seed: out of range"),
    (lambda about: about.update(seed=0.5), "seed: wrong value .expected a whole number"),
    (lambda about: about.update(seed=True), "seed: wrong value .expected a whole number"),
    (lambda about: about.update(initialization=None), "initialization: wrong value .expected text"),
    (lambda about: about.update(history={}), "history: wrong value .expected a list"),
    (
        lambda about: about.update(history=[{"round": 1}, {"round": "two"}]),
        r"history\[1\]: 'round' is no number",
    ),
    (
        lambda about: about["trajectory"].update(robot_size=0.5),
        r"trajectory.robot_size: wrong value",
    ),
    (
        lambda about: about["trajectory"]["phases"][0].update(first=-1),
        r"trajectory.phases\[0\].first: out of range",
    ),
    (
        lambda about: about["trajectory"]["phases"][0].update(held=["door"]),
        r"trajectory.phases\[0\].held: wrong value",
    ),
    (
        lambda about: about["trajectory"].update(names=[1]),
        r"trajectory.names\[0\]: wrong value .expected text",
    ),
    (lambda about: about.update(folder={"package": "../../etc"}), "folder: no folder of a scene"),
    (lambda about: about.update(steps=[{"step": "Actuate"}]), "Actuate.object: this is missing"),
    (lambda about: about.update(steps=[{"step": "GoTo", "x": "a", "y": 0}]), "GoTo.x"),
    (lambda about: about.update(options={"dt": "fast"}), "Options.dt"),
    (lambda about: about["scene"].update(robot=7), "robot"),
    (lambda about: about.update(terms=[{"term": "Cost"}]), "not a saved term"),
]


@pytest.mark.parametrize(
    ("change", "said"), DESCRIPTIONS, ids=lambda value: value[:40] if isinstance(value, str) else ""
)
def test_a_wrong_description(
    tmp_path: Path, saved: Path, change: Callable[[dict[str, Any]], Any], said: str
) -> None:
    path = changed(tmp_path / "wrong", saved, change)
    with pytest.raises(vkc.InputError, match=said) as caught:
        vkc.Plan.load(path)
    assert caught.value.file == path


def _holes(positions: np.ndarray) -> np.ndarray:
    positions[3, 4] = np.nan
    return positions


def _back(times: np.ndarray) -> np.ndarray:
    times[3] = times[2]
    return times


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("positions", _holes, r"positions\[3, 4\]: not finite"),
        ("times", _back, "times do not increase"),
        ("times", lambda times: times[:-1], "phases do not follow|wrong shape"),
        (
            "times",
            lambda times: times[:, None],
            "not a saved plan .*times is an array of float64 and shape",
        ),
        ("positions", lambda positions: positions[:, :-1], "wrong shape"),
        (
            "positions",
            lambda positions: positions.astype(complex),
            "positions is an array of complex128",
        ),
        ("positions", lambda positions: positions.astype("S8"), r"positions is an array of \|S8"),
        ("about", lambda about: np.array(b"{}"), r"about is an array of \|S2"),
        ("about", lambda about: np.array(["{}"]), r"about is an array of <U2"),
        ("about", lambda about: np.array(""), "not JSON"),
        ("about", lambda about: np.array("[" * 100_000 + "]" * 100_000), "JSON|too many lists"),
        (
            "about",
            lambda about: np.array('{"a":' * 60 + "1" + "}" * 60),
            "too many lists and objects inside each other",
        ),
        ("about", lambda about: np.array("9" * 5000), "not JSON"),
    ],
)
def test_a_wrong_array(
    tmp_path: Path, saved: Path, name: str, change: Callable[[Any], Any], said: str
) -> None:
    found = parts(saved)
    array = np.load(io.BytesIO(found[name]))
    path = written(tmp_path / "wrong", {**found, name: packed(change(array.copy()))})
    with pytest.raises(vkc.InputError, match=said) as caught:
        vkc.Plan.load(path)
    assert caught.value.file == path


def _header(shape: str, dtype: str = "<f8") -> bytes:
    text = (
        f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117)
        + b"\n"
    )
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def _bomb(found: dict[str, bytes]) -> dict[str, bytes]:
    return {**found, "positions": _header("(100000, 1000)") + bytes(800_000_000)}


def _tall_tale(found: dict[str, bytes]) -> dict[str, bytes]:
    return {**found, "positions": _header("(1000000000, 1000)") + bytes(80)}


def _many(found: dict[str, bytes]) -> dict[str, bytes]:
    return {**found, **{str(number): b"" for number in range(100_000)}}


def _lists(found: dict[str, bytes]) -> dict[str, bytes]:
    return {
        **found,
        "about": packed(np.array('{"format": 1, "history": [' + "[]," * 3_000_000 + "[]]}")),
    }


def _numbers(found: dict[str, bytes]) -> dict[str, bytes]:
    about = json.loads(str(np.load(io.BytesIO(found["about"]))))
    about["trajectory"]["names"] = [1] * 290_000
    return {**found, "about": packed(np.array(json.dumps(about)))}


def _held(found: dict[str, bytes]) -> dict[str, bytes]:
    about = json.loads(str(np.load(io.BytesIO(found["about"]))))
    about["trajectory"]["phases"][0]["held"] = {f"o{k}": "handle" for k in range(20_000)}
    about["trajectory"]["phases"][0]["by"] = {f"o{k}": f"o{k + 1}.link" for k in range(19_999)}
    return {**found, "about": packed(np.array(json.dumps(about)))}


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


@pytest.mark.parametrize("make", [_bomb, _tall_tale, _many, _lists, _numbers, _held])
def test_what_is_large_when_unpacked_is_refused_before(
    tmp_path: Path, saved: Path, make: Callable[[Any], Any]
) -> None:
    """In less than 500 MB, and 2 s of the processor on a machine that does nothing else."""
    path = written(tmp_path / "large", make(parts(saved)))
    run = [sys.executable, "-c", LOAD, str(saved), str(path)]
    done = subprocess.run(run, capture_output=True, text=True, timeout=100, check=True)
    said, figures = done.stdout.rsplit("\n", 2)[:2]
    assert str(path) in said, done.stdout
    print(said, figures)
    memory, seconds = map(float, figures.split())
    assert memory < 500.0, said
    assert seconds < 10.0, said


def test_files_that_are_no_files_or_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, saved: Path
) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, said in (
        (tmp_path / "pipe", "a pipe or a device"),
        (tmp_path, "Is a directory"),
        (tmp_path / "none", "No such file"),
    ):
        with pytest.raises(vkc.InputError, match=f"cannot read the plan .*got {said}"):
            vkc.Plan.load(path)
    monkeypatch.setattr(archives, "LARGEST_ARCHIVE", 100)
    with pytest.raises(vkc.InputError, match="the plan is too large"):
        vkc.Plan.load(saved)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_only_what_numpy_packs_is_unpacked(tmp_path: Path, saved: Path, method: int) -> None:
    with pytest.raises(vkc.InputError, match="packed in an unknown way"):
        vkc.Plan.load(written(tmp_path / "odd", parts(saved), method))
    assert vkc.Plan.load(written(tmp_path / "plain", parts(saved), zipfile.ZIP_STORED)).seed == 0


def test_no_byte_makes_anything_else_than_an_input_error(tmp_path: Path, saved: Path) -> None:
    """Wherever a byte of the file is another one, or the file ends."""
    data, random = saved.read_bytes(), np.random.default_rng(0)
    path = tmp_path / "odd"
    for _ in range(150):
        odd = bytearray(data)
        for at in random.integers(len(data), size=random.integers(1, 4)):
            odd[at] = random.integers(256)
        path.write_bytes(bytes(odd[: random.integers(len(odd))] if random.random() < 0.2 else odd))
        with contextlib.suppress(vkc.InputError):
            assert vkc.Plan.load(path).trajectory.times[0] == 0.0


def test_every_status_and_metric_is_known(door_plan: vkc.Plan) -> None:
    assert set(door_plan.metrics) == set(METRICS)
    told = re.findall(
        r'"([\w ]+)"', (vkc.Plan.__doc__ or "").split("status:")[1].split("metrics:")[0]
    )
    ended = set(
        re.findall(
            r'FailedError\("([\w ]+)"|(?:cause = |found, )"([\w ]+)"',
            inspect.getsource(attempt) + inspect.getsource(following),
        )
    )
    named = {name for pair in ended for name in pair if name}
    assert len(named) >= 5
    assert set(told) | named <= set(STATUSES)
