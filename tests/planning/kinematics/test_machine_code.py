"""Tests that compiled functions equal interpreted ones bit for bit, and work without a compiler."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.small_problems import load_door_scene, make_program

import vkc_pin as vkc
from vkc_pin.options import Options
from vkc_pin.planning.kinematics import batch, machine_code
from vkc_pin.planning.kinematics.batch import BatchFunction
from vkc_pin.planning.kinematics.libraries import CACHE_VARIABLE, Libraries
from vkc_pin.planning.kinematics.machine_code import MachineCode, compile_jobs, wait
from vkc_pin.planning.nlp.transcription import Transcription, transcribe
from vkc_pin.planning.nlp.waypoint import WaypointFunctions
from vkc_pin.utils.cache import Cache
from vkc_pin.world.task.steps import Actuate, Grasp

OPTIONS = Options(reach_waypoints=3, turn_waypoints=2, move_waypoints=3, contact_slots=2)
REACH = [Grasp("door")]
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Libraries:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)
    found = Libraries.open_default()
    assert found is not None
    return found


def make(factor: float = 3.0) -> ca.Function:
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    branch = ca.if_else(x[1] > 0.3, ca.sqrt(ca.fabs(x[0])), ca.atan2(y[0], y[1]))
    values = [
        ca.sin(x[0]) * ca.cos(x[0]) + x[1] * x[2] + factor / 7.0,
        ca.log(ca.fabs(x[2])),
        branch,
        ca.norm_2(x),
    ]
    return ca.Function("f", [x, y], [ca.vertcat(*values), ca.densify(x @ y.T)], {"cse": True})


def equal(one: ca.Function, other: ca.Function, draws: int = 50) -> bool:
    rng = np.random.default_rng(7)
    for _ in range(draws):
        inputs = [
            ca.DM(one.sparsity_in(i), rng.normal(size=one.nnz_in(i))) for i in range(one.n_in())
        ]
        for a, b in zip(one.call(inputs), other.call(inputs), strict=True):
            if np.array(a.nonzeros()).tobytes() != np.array(b.nonzeros()).tobytes():
                return False
    return True


def compile_here(folder: Libraries) -> None:
    lock = folder.lock()
    assert lock is not None
    compile_jobs(str(folder.path), lock)
    os.close(lock)


def write_script(path: Path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(0o755)
    return str(path)


@pytest.mark.long
def test_compiled_waypoint_functions_are_equal_bit_for_bit(folder: Libraries) -> None:
    steps = [Actuate("door", {"hinge": 1.2})]
    structure = make_program(load_door_scene(), steps, options=OPTIONS).transcription.structure
    functions = WaypointFunctions(structure.model, structure.slots, structure.poses, Cache())
    interpreted = (functions.value, functions.jacobian, functions.hessian)
    assert not functions.code.try_load()
    assert functions.code.functions == interpreted
    assert wait()
    assert functions.code.try_load()
    for one, other in zip(interpreted, functions.code.functions, strict=True):
        assert other.class_name() == "External"
        assert equal(one, other)
        assert equal(one.map(5), other.map(5), 5)
    assert folder.list_jobs() == []


@pytest.mark.long
def test_program_is_rebuilt_when_machine_code_is_available(folder: Libraries) -> None:
    short = make_program(load_door_scene(), REACH, options=OPTIONS).transcription
    assert not short.uncompiled_functions
    options = Options(reach_waypoints=8, contact_slots=2)
    structure, cache = (
        make_program(load_door_scene(), REACH, options=options).transcription.structure,
        Cache(),
    )
    first = transcribe(structure, cache)
    solver = first.solver(rates=True, options=QUIET)
    assert len(first.uncompiled_functions) == 1
    assert len(folder.list_jobs()) <= 1
    assert transcribe(structure, cache) is first
    assert wait()
    second = transcribe(structure, cache)
    assert second is not first
    assert second.solver(rates=True, options=QUIET) is not solver
    assert transcribe(structure, cache) is second
    assert not second.uncompiled_functions
    rng = np.random.default_rng(0)
    x, parameters = rng.normal(size=first.size), rng.normal(size=first.parameters.numel())
    rows, others = (evaluate(program, x, parameters) for program in (first, second))
    assert rows == others


def evaluate(program: Transcription, x: np.ndarray, parameters: np.ndarray) -> tuple[bytes, bytes]:
    function = ca.Function("rows", [program.x, program.parameters], [program.g, program.jacobian])
    values, jacobian = function(x, parameters)
    return np.array(values.nonzeros()).tobytes(), np.array(jacobian.nonzeros()).tobytes()


def test_frequently_used_batch_functions_are_compiled(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(40, 3)), rng.normal(size=(40, 2))
    function = BatchFunction(make())
    expected = [part.tobytes() for part in function(x, y)]
    assert folder.list_jobs() == []
    monkeypatch.setattr(batch, "_MIN_INSTRUCTIONS_TO_COMPILE", 30 * make().n_instructions())
    assert [part.tobytes() for part in function(x, y)] == expected
    assert wait()
    assert [part.tobytes() for part in function(x, y)] == expected
    assert function._code.is_compiled
    assert [part.tobytes() for part in function(x, y)] == expected
    assert function.nbytes > 0


def test_libraries_are_shared_with_later_processes(folder: Libraries) -> None:
    code = "from test_machine_code import *; MachineCode(make()).try_load()"
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
    }
    run = [sys.executable, "-c", code]
    process = subprocess.run(run, env=environment, capture_output=True, timeout=120, check=True)
    assert process.stderr == b""
    wait_until(lambda: not folder.list_jobs())
    assert len(list(folder.path.glob("*.so"))) == 1
    mine = MachineCode(make())
    assert mine.try_load()
    assert equal(make(), mine.functions[0])


def test_concurrent_loading(folder: Libraries) -> None:
    MachineCode(make()).try_load()
    assert wait()
    right: list[bool] = []

    def load() -> None:
        for _ in range(3):
            code = MachineCode(make())
            right.append(code.try_load() and equal(make(), code.functions[0], 5))

    threads = [threading.Thread(target=load) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert right == [True] * 9


def test_libraries_depend_on_function_and_compiler(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    codes = [MachineCode(make(3.0)), MachineCode(make(np.nextafter(3.0, 4.0)))]
    for code in codes:
        code.try_load()
    monkeypatch.setenv("CC", "cc -O2 -w")
    codes.append(MachineCode(make(3.0)))
    codes[2].try_load()
    assert wait()
    assert len(list(folder.path.glob("*.so"))) == 3
    assert all(code.try_load() for code in codes)
    functions = [code.functions[0] for code in codes]
    assert equal(make(3.0), functions[0])
    assert equal(functions[0], functions[2])
    assert not equal(functions[0], functions[1])


@pytest.mark.parametrize("command", ["/nowhere/cc", "no-such-compiler", "'unbalanced"])
def test_nothing_is_requested_without_a_compiler(
    command: str, folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", command)
    code = MachineCode(make())
    assert not code.try_load()
    assert folder.list_jobs() == []
    assert code.functions[0](1.0, 2.0) is not None


BROKEN = {
    "fails": "echo nonsense >&2; exit 1",
    "writes garbage": "echo garbage > functions.so",
    "computes something else": "sed -i 's/sin(/cos(/' functions.c; exec cc \"$@\"",
    "rounds otherwise": "sed -i 's/4.2857142857142855e-01/4.2857142857142861e-01/' functions.c; "
    'exec cc "$@"',
    "lacks the function": "sed -i 's/int f(/int g(/' functions.c; exec cc \"$@\"",
    "kills": "kill -9 $PPID",
}


SLOW = pytest.mark.long  # each waits for a compiler


@pytest.mark.parametrize(
    "how",
    [
        pytest.param(how, marks=() if how in ("fails", "computes something else") else SLOW)
        for how in BROKEN
    ],
)
def test_a_broken_compiler_is_tried_once(
    how: str, folder: Libraries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", write_script(tmp_path / "broken", BROKEN[how]))
    code = MachineCode(make())
    assert not code.try_load()
    assert wait(), how
    assert not code.try_load()
    assert not code.is_compiled
    assert list(folder.path.glob("*.so")) == []
    assert len(list(folder.path.glob("*.failed"))) == 1
    assert not MachineCode(make()).try_load()
    assert folder.list_jobs() == []


def test_hanging_compiler_is_killed(
    folder: Libraries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pid = tmp_path / "pid"
    monkeypatch.setenv(
        "CC",
        write_script(
            tmp_path / "hangs", f"sleep 600 & echo $! > {pid}.part; mv {pid}.part {pid}; wait"
        ),
    )
    monkeypatch.setattr(machine_code, "_COMPILER_TIMEOUT", 1.0)
    monkeypatch.setattr(machine_code, "has_python", lambda: False)
    assert not MachineCode(make()).try_load()
    assert not wait()
    compile_here(folder)
    assert folder.list_jobs() == []
    assert len(list(folder.path.glob("*.failed"))) == 1
    wait_until(lambda: has_ended(int(pid.read_text())))


@pytest.mark.parametrize("executable", ["", "/usr/bin/blender"])
def test_embedding_program_is_not_started_as_worker(
    executable: str, folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", executable)
    assert not MachineCode(make()).try_load()
    assert not wait()
    assert len(folder.list_jobs()) == 1


def wait_until(done: Callable[[], bool]) -> None:
    for _ in range(6000):
        if done():
            return
        time.sleep(0.02)
    raise AssertionError("time is up")


def has_ended(pid: int) -> bool:
    """Whether a process is no more, but for its entry."""
    try:
        return (
            Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
            == "Z"
        )
    except (FileNotFoundError, ProcessLookupError):
        return True


def plan_door(planner: vkc.Planner | None = None) -> list[bytes]:
    """Return a plan by the given planner, or by a new one without caches."""
    steps, options = [Grasp("door")], vkc.Options(reach_waypoints=10)
    plan = vkc.plan(load_door_scene(), steps, options=options, planner=planner or vkc.Planner())
    assert plan.success, plan.summary()
    return [plan.trajectory.times.tobytes(), plan.trajectory.positions.tobytes()]


@pytest.fixture(scope="module")
def expected() -> list[bytes]:
    """Return the motion that is found without libraries."""
    assert os.environ[CACHE_VARIABLE] == "off"
    return plan_door()


@pytest.mark.long
def test_plans_are_equal_bit_for_bit(
    folder: Libraries, expected: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch, "_MIN_INSTRUCTIONS_TO_COMPILE", 0)  # all that can be compiled is
    planner = vkc.Planner()
    assert plan_door(planner) == expected
    assert wait()
    monkeypatch.setattr(machine_code, "has_python", lambda: False)
    assert list(folder.path.glob("*.failed")) == []
    loaded: list[Any] = []
    external = ca.external
    monkeypatch.setattr(ca, "external", lambda *a: loaded.append(a) or external(*a))
    assert plan_door(planner) == expected
    assert len(loaded) > 2
    loaded.clear()
    assert plan_door() == expected
    assert len(loaded) > 2


@pytest.mark.parametrize(
    "trouble",
    ["broken compiler", "truncated", pytest.param("no folder", marks=pytest.mark.long)],
)
def test_planning_works_without_a_compiler(
    trouble: str,
    folder: Libraries,
    tmp_path: Path,
    expected: list[bytes],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if trouble == "broken compiler":
        monkeypatch.setenv("CC", write_script(tmp_path / "broken", BROKEN["writes garbage"]))
    elif trouble == "truncated":
        monkeypatch.setattr(
            Libraries,
            "exists",
            lambda self, key: (self.path / f"{key}.so").write_bytes(b"\x7fELF" * 99) > 0,
        )
    else:
        monkeypatch.setenv(CACHE_VARIABLE, "/proc/nowhere")
    planner = vkc.Planner()
    assert plan_door(planner) == expected
    assert wait() == (trouble != "no folder")
    assert plan_door(planner) == expected
    assert list(folder.path.glob("*.so")) == []
