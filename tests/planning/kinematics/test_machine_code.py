"""Tests that compiled functions equal interpreted ones bit for bit, and work without a compiler."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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
from vkc_pin.planning.kinematics.machine_code import (
    Libraries,
    MachineCode,
    compile_jobs,
    wait,
)
from vkc_pin.planning.nlp.transcription import transcribe
from vkc_pin.utils.cache import Cache
from vkc_pin.utils.disk_cache import CACHE_VARIABLE
from vkc_pin.world.task.steps import Grasp

OPTIONS = Options(reach_waypoints=3, turn_waypoints=2, move_waypoints=3, contact_slots=2)
REACH = [Grasp("door")]
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes"}


def make_function(factor: float = 3.0) -> ca.Function:
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2)
    branch = ca.if_else(x[1] > 0.3, ca.sqrt(ca.fabs(x[0])), ca.atan2(y[0], y[1]))
    values = [
        ca.sin(x[0]) * ca.cos(x[0]) + x[1] * x[2] + factor / 7.0,
        ca.log(ca.fabs(x[2])),
        branch,
        ca.norm_2(x),
    ]
    return ca.Function("f", [x, y], [ca.vertcat(*values), ca.densify(x @ y.T)], {"cse": True})


def are_equal(one: ca.Function, other: ca.Function, draws: int = 50) -> bool:
    rng = np.random.default_rng(7)
    for _ in range(draws):
        inputs = [
            ca.DM(one.sparsity_in(i), rng.normal(size=one.nnz_in(i))) for i in range(one.n_in())
        ]
        for a, b in zip(one.call(inputs), other.call(inputs), strict=True):
            if np.array(a.nonzeros()).tobytes() != np.array(b.nonzeros()).tobytes():
                return False
    return True


def compile_pending_jobs(folder: Libraries) -> None:
    lock = folder.lock()
    assert lock is not None
    compile_jobs(str(folder.path), lock)
    os.close(lock)


def use_compiler(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / "compiler"
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(0o755)
    monkeypatch.setenv("CC", str(path))


def count_files(folder: Libraries, suffix: str) -> int:
    return len(list(folder.path.glob(f"*.{suffix}")))


@pytest.mark.long
def test_program_is_rebuilt_when_machine_code_is_available(folder: Libraries) -> None:
    short = make_program(load_door_scene(), REACH, options=OPTIONS).transcription
    assert not short.uncompiled_functions
    options = Options(reach_waypoints=8, contact_slots=2)
    problem, cache = make_program(load_door_scene(), REACH, options=options), Cache()
    structure = problem.transcription.structure
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


def test_frequently_used_batch_functions_are_compiled(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(40, 3)), rng.normal(size=(40, 2))
    function = BatchFunction(make_function())

    def evaluate() -> list[bytes]:
        return [part.tobytes() for part in function(x, y)]

    expected, instructions = evaluate(), make_function().n_instructions()
    assert folder.list_jobs() == []
    monkeypatch.setattr(batch, "_MIN_INSTRUCTIONS_TO_COMPILE", 30 * instructions)
    assert evaluate() == expected
    assert wait()
    assert evaluate() == expected
    assert function._code.is_compiled
    assert evaluate() == expected
    assert function.nbytes > 0


def test_libraries_are_shared_with_later_processes(folder: Libraries) -> None:
    code = "from test_machine_code import *; MachineCode(make_function()).try_load()"
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    run, environment = [sys.executable, "-c", code], {**os.environ, "PYTHONPATH": paths}
    process = subprocess.run(run, env=environment, capture_output=True, timeout=120, check=True)
    assert process.stderr == b""
    wait_until(lambda: not folder.list_jobs())
    assert count_files(folder, "so") == 1
    shared = MachineCode(make_function())
    assert shared.try_load()
    assert are_equal(make_function(), shared.functions[0])


def test_threads_can_load_a_library_concurrently(folder: Libraries) -> None:
    MachineCode(make_function()).try_load()
    assert wait()

    def load(_: int) -> bool:
        code = MachineCode(make_function())
        return code.try_load() and are_equal(make_function(), code.functions[0], 5)

    with ThreadPoolExecutor(3) as threads:
        assert all(threads.map(load, range(9)))


def test_libraries_depend_on_function_and_compiler(
    folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    codes = [MachineCode(make_function(3.0)), MachineCode(make_function(np.nextafter(3.0, 4.0)))]
    for code in codes:
        code.try_load()
    monkeypatch.setenv("CC", "cc -O2 -w")
    codes.append(MachineCode(make_function(3.0)))
    codes[2].try_load()
    assert wait()
    assert count_files(folder, "so") == 3
    assert all(code.try_load() for code in codes)
    functions = [code.functions[0] for code in codes]
    assert are_equal(make_function(3.0), functions[0])
    assert are_equal(functions[0], functions[2])
    assert not are_equal(functions[0], functions[1])


@pytest.mark.parametrize("command", ["/nowhere/cc", "no-such-compiler", "'unbalanced"])
def test_no_compilation_is_requested_without_a_compiler(
    command: str, folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", command)
    code = MachineCode(make_function())
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


SLOW = pytest.mark.long  # waits for a compiler


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(fault, marks=() if fault in ("fails", "computes something else") else SLOW)
        for fault in BROKEN
    ],
)
def test_broken_compiler_is_tried_once(
    fault: str, folder: Libraries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_compiler(BROKEN[fault], tmp_path, monkeypatch)
    code = MachineCode(make_function())
    assert not code.try_load()
    assert wait(), fault
    assert not code.try_load()
    assert not code.is_compiled
    assert count_files(folder, "so") == 0
    assert count_files(folder, "failed") == 1
    assert not MachineCode(make_function()).try_load()
    assert folder.list_jobs() == []


def test_hanging_compiler_is_killed(
    folder: Libraries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pid = tmp_path / "pid"
    script = f"sleep 600 & echo $! > {pid}.part; mv {pid}.part {pid}; wait"
    use_compiler(script, tmp_path, monkeypatch)
    monkeypatch.setattr(machine_code, "_COMPILER_TIMEOUT", 1.0)
    monkeypatch.setattr(machine_code, "has_python", lambda: False)
    assert not MachineCode(make_function()).try_load()
    assert not wait()
    compile_pending_jobs(folder)
    assert folder.list_jobs() == []
    assert count_files(folder, "failed") == 1
    wait_until(lambda: has_ended(int(pid.read_text())))


@pytest.mark.parametrize("executable", ["", "/usr/bin/blender"])
def test_embedding_program_is_not_started_as_worker(
    executable: str, folder: Libraries, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", executable)
    assert not MachineCode(make_function()).try_load()
    assert not wait()
    assert len(folder.list_jobs()) == 1


def wait_until(condition: Callable[[], bool]) -> None:
    for _ in range(6000):
        if condition():
            return
        time.sleep(0.02)
    raise AssertionError("timeout")


def has_ended(pid: int) -> bool:
    """Return whether a process has ended or is a zombie."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True
    return status.rpartition(")")[2].split()[0] == "Z"


def plan_door(planner: vkc.Planner | None = None) -> list[bytes]:
    """Return times and positions of a plan, by `planner` or by one without caches."""
    steps, options = [Grasp("door")], vkc.Options(reach_waypoints=10)
    plan = vkc.plan(load_door_scene(), steps, options=options, planner=planner or vkc.Planner())
    assert plan.success, plan.summary()
    return [plan.trajectory.times.tobytes(), plan.trajectory.positions.tobytes()]


@pytest.fixture(scope="module")
def interpreted_plan() -> list[bytes]:
    """Return the plan without compiled libraries."""
    assert os.environ[CACHE_VARIABLE] == "off"
    return plan_door()


@pytest.mark.long
def test_plans_are_equal_bit_for_bit_with_compiled_functions(
    folder: Libraries, interpreted_plan: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch, "_MIN_INSTRUCTIONS_TO_COMPILE", 0)  # compile everything
    planner = vkc.Planner()
    assert plan_door(planner) == interpreted_plan
    assert wait()
    monkeypatch.setattr(machine_code, "has_python", lambda: False)
    assert count_files(folder, "failed") == 0
    loaded: list[Any] = []
    external = ca.external
    monkeypatch.setattr(ca, "external", lambda *a: loaded.append(a) or external(*a))
    assert plan_door(planner) == interpreted_plan
    assert len(loaded) > 2
    loaded.clear()
    assert plan_door() == interpreted_plan
    assert len(loaded) > 2


@pytest.mark.parametrize(
    "fault",
    ["broken compiler", "truncated", pytest.param("no folder", marks=pytest.mark.long)],
)
def test_planning_works_without_usable_libraries(
    fault: str,
    folder: Libraries,
    tmp_path: Path,
    interpreted_plan: list[bytes],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if fault == "broken compiler":
        use_compiler(BROKEN["writes garbage"], tmp_path, monkeypatch)
    elif fault == "truncated":
        monkeypatch.setattr(
            Libraries,
            "exists",
            lambda self, key: (self.path / f"{key}.so").write_bytes(b"\x7fELF" * 99) > 0,
        )
    else:
        monkeypatch.setenv(CACHE_VARIABLE, "/proc/nowhere")
    planner = vkc.Planner()
    assert plan_door(planner) == interpreted_plan
    assert wait() == (fault != "no folder")
    assert plan_door(planner) == interpreted_plan
    assert count_files(folder, "so") == 0
