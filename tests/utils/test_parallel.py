from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from helpers.expected_errors import expect_error
from helpers.tasks import crash_once, double, hang, identify_worker

from vkc_pin.utils.interrupt import start_without_interrupt
from vkc_pin.utils.parallel import MAX_CRASHES, CrashedTask, check_processes, run_tasks


def make_tasks(count: int) -> list[tuple[str, int]]:
    return [(str(k), k) for k in range(count)]


@pytest.mark.parametrize("jobs", [1, 2])
def test_tasks_run_once_in_any_number_of_processes(jobs: int) -> None:
    if jobs > 1:
        pytest.importorskip("distributed")
    found = list(run_tasks(double, make_tasks(20), jobs=jobs))
    assert sorted((int(key), value) for key, value in found) == [(k, 2 * k) for k in range(20)]


@pytest.mark.long
def test_crashes_neither_lose_nor_repeat_other_tasks(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    tasks = [(str(k), (str(tmp_path), k)) for k in range(8)]
    found = list(run_tasks(crash_once, tasks, jobs=2))
    assert sorted((int(key), value) for key, value in found) == [(k, 2 * k) for k in range(8)]
    assert (tmp_path / "2").exists()


@pytest.mark.long
def test_tasks_that_crash_every_process_are_given_up() -> None:
    pytest.importorskip("distributed")
    found = dict(run_tasks(hang, make_tasks(4), jobs=2, limit=1.0))
    assert isinstance(found["1"], CrashedTask)
    assert f"{MAX_CRASHES} processes died" in found["1"].reason
    assert [found[key] for key in ("0", "2", "3")] == [0, 4, 6]


@pytest.mark.parametrize("jobs", [1, 2])
def test_tasks_are_consumed_on_demand(jobs: int) -> None:
    """Earlier results determine the number of tasks; other processes have one thread."""
    if jobs > 1:
        pytest.importorskip("distributed")
    consumed, found = [], list[tuple[int, str]]()

    def tasks() -> Any:
        for k in range(1000):
            if len(found) >= 8:
                return
            consumed.append(k)
            yield str(k), k

    for _, result in run_tasks(identify_worker, tasks(), jobs=jobs):
        found.append(result)
    assert 8 <= len(consumed) <= 8 + 4
    if jobs > 1:
        assert len({process for process, _ in found} - {os.getpid()}) == 2
        assert {threads for _, threads in found} == {"1"}


def test_missing_schedulers_raise(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("vkc_pin.utils.parallel._CONNECT_TIMEOUT", 1.0)
    with expect_error("no scheduler answers", field="scheduler"):
        list(run_tasks(double, make_tasks(2), scheduler="tcp://127.0.0.1:9"))


def test_several_processes_need_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with expect_error("pip install .*distributed.*the extra `cluster`", field="jobs"):
        list(run_tasks(double, make_tasks(2), jobs=2))
    assert dict(run_tasks(double, make_tasks(2))) == {"0": 0, "1": 2}


@pytest.mark.parametrize("address", ["here", "tcp://here", "tcp://:8786", 3])
def test_invalid_addresses_raise(address: Any) -> None:
    pytest.importorskip("distributed")
    with expect_error("not an address", field="scheduler"):
        check_processes(1, address)


def test_schedulers_without_workers_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("vkc_pin.utils.parallel._CHECK_INTERVAL", 0.2)
    lines: list[str] = []
    with distributed.LocalCluster(
        n_workers=0, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:

        def tell(line: str) -> None:
            lines.append(line)
            if "no workers" in line:
                cluster.scale(1)

        assert dict(
            run_tasks(double, make_tasks(3), scheduler=cluster.scheduler_address, tell=tell)
        ) == {"0": 0, "1": 2, "2": 4}
    assert sum("no workers" in line for line in lines) == 1


INTERRUPTED = """
import os, signal, threading, time
import psutil
from vkc_pin.utils.parallel import run_tasks

def interrupt():
    while len(psutil.Process().children(recursive=True)) < {processes}:
        time.sleep(0.005)
    os.killpg(0, signal.SIGINT)

if __name__ == "__main__":
    threading.Thread(target=interrupt, daemon=True).start()
    try:
        for _ in run_tasks(time.sleep, ((str(k), 1.0) for k in range(600)), jobs=2):
            print("a result", flush=True)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
    lines = [" ".join(child.cmdline()) for child in psutil.Process().children()]
    assert not any("spawn_main" in line for line in lines), lines
"""


@pytest.mark.parametrize(
    "processes",
    [pytest.param(1, marks=pytest.mark.long), 2, pytest.param(3, marks=pytest.mark.long)],
)
def test_ctrl_c_while_workers_start_is_not_lost(processes: int, tmp_path: Path) -> None:
    """Ctrl-C reaches all processes of the terminal. Only the first one takes notice of it."""
    pytest.importorskip("distributed")
    script = tmp_path / "script.py"
    script.write_text(INTERRUPTED.format(processes=processes))
    done = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        start_new_session=True,
        timeout=120,
    )
    assert done.stdout == "interrupted\n", done
    assert "Traceback" not in done.stderr, done.stderr
    assert done.returncode == 0


SPAWNED = """
import multiprocessing, signal
from vkc_pin.utils.interrupt import start_without_interrupt

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    children = [context.Process(target=signal.raise_signal, args=(signal.SIGINT,)) for _ in "12"]
    with start_without_interrupt():
        for child in children:
            child.start()
    for child in children:
        child.join()
    print([child.exitcode for child in children], signal.pthread_sigmask(signal.SIG_BLOCK, ()))
"""


def test_ctrl_c_never_reaches_the_first_process_that_multiprocessing_spawns(tmp_path: Path) -> None:
    """With it starts a tracker of resources, which unblocks the signal for those after it."""
    script = tmp_path / "script.py"
    script.write_text(SPAWNED)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("[0, 0] set()\n", "")


def test_ctrl_c_is_deferred_while_processes_start() -> None:
    code = [sys.executable, "-c", "import signal; signal.raise_signal(signal.SIGINT)"]
    statuses: list[int] = []

    def start() -> None:
        with start_without_interrupt():
            signal.raise_signal(signal.SIGINT)
            statuses.append(subprocess.run(code, capture_output=True).returncode)

    with pytest.raises(KeyboardInterrupt):
        start()
    assert statuses == [0]
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
