from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from helpers.tasks import double, fatal, fatal_once, greedy, hanging, profiled, slow, where

from vkc_pin.errors import InputError
from vkc_pin.utils.parallel.engine import MAX_CRASHES, CrashedTask, require_dask, run_tasks


def numbered(count: int) -> list[tuple[str, int]]:
    return [(str(k), k) for k in range(count)]


@pytest.mark.parametrize(
    "how", [{}, {"jobs": 2}, {"jobs": 2, "dask": True}], ids=["here", "processes", "dask"]
)
def test_every_task_once(how: dict[str, Any]) -> None:
    if how.get("dask"):
        pytest.importorskip("distributed")
    found = list(run_tasks(double, numbered(20), **how))
    assert sorted((int(key), value) for key, value in found) == [(k, 2 * k) for k in range(20)]


@pytest.mark.parametrize("how", [{}, {"jobs": 2, "dask": True}], ids=["here", "dask"])
def test_tasks_are_taken_when_they_are_needed(how: dict[str, Any]) -> None:
    """What was yielded decides how many there are."""
    if how.get("dask"):
        pytest.importorskip("distributed")
    taken, enough = [], False

    def tasks() -> Any:
        for k in range(1000):
            if enough:
                return
            taken.append(k)
            yield str(k), k

    for count, _ in enumerate(run_tasks(double, tasks(), **how), start=1):
        enough = count >= 5
    assert 5 <= len(taken) <= 5 + 4


def test_processes_do_not_watch_their_tasks() -> None:
    """Dask's own profiler would keep what it saw, more of it every second."""
    pytest.importorskip("distributed")
    assert list(run_tasks(profiled, numbered(1), jobs=2, dask=True)) == [("0", False)]


def test_a_process_that_dies_loses_and_repeats_nothing(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    tasks = [(str(k), (str(tmp_path), k)) for k in range(8)]
    found = list(run_tasks(fatal_once, tasks, jobs=2, dask=True))
    assert sorted((int(key), value) for key, value in found) == [(k, 2 * k) for k in range(8)]
    assert (tmp_path / "2").exists()


@pytest.mark.parametrize(
    ("function", "limit"), [(fatal, None), (hanging, 1.0)], ids=["dies", "hangs"]
)
def test_a_task_that_no_process_survives(function: Any, limit: float | None) -> None:
    pytest.importorskip("distributed")
    found = dict(run_tasks(function, numbered(4), jobs=2, dask=True, limit=limit))
    assert isinstance(found["1"], CrashedTask)
    assert f"{MAX_CRASHES} processes died" in found["1"].reason
    assert [found[key] for key in ("0", "2", "3")] == [0, 4, 6]


def test_a_task_that_takes_all_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(
        "vkc_pin.utils.parallel.engine._compute_memory_limit", lambda jobs: 600 << 20
    )
    found = dict(run_tasks(greedy, numbered(4), jobs=2, dask=True))
    assert isinstance(found["1"], CrashedTask)
    assert "out of memory" in found["1"].reason
    assert [found[key] for key in ("0", "2", "3")] == [0, 4, 6]


def test_processes_that_keep_much_are_not_paused() -> None:
    """Dask would, until they have less; ours keep what they have built, and all would wait for ever."""
    dask = pytest.importorskip("dask")
    pytest.importorskip("distributed")
    with dask.config.set({"distributed.worker.memory.pause": 1e-4}):
        assert dict(run_tasks(slow, numbered(6), jobs=2, dask=True)) == {
            str(k): 2 * k for k in range(6)
        }


def test_many_processes_have_enough_memory_each() -> None:
    pytest.importorskip("distributed")
    from vkc_pin.utils.parallel import engine

    assert engine._compute_memory_limit(1000) == engine._MIN_MEMORY
    assert engine._compute_memory_limit(1) > engine._MIN_MEMORY


def test_processes_have_one_thread_and_are_not_this_one() -> None:
    pytest.importorskip("distributed")
    found = [value for _, value in run_tasks(where, numbered(12), jobs=2, dask=True)]
    assert len({process for process, _ in found}) == 2
    assert os.getpid() not in {process for process, _ in found}
    assert {threads for _, threads in found} == {"1"}


def test_a_scheduler_of_somebody_else() -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        found = dict(run_tasks(double, numbered(5), scheduler=cluster.scheduler_address))
    assert found == {str(k): 2 * k for k in range(5)}


def test_no_scheduler_there(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("vkc_pin.utils.parallel.engine._CONNECT_TIMEOUT", 1.0)
    with pytest.raises(InputError, match="no scheduler answers") as caught:
        list(run_tasks(double, numbered(2), scheduler="tcp://127.0.0.1:9"))
    assert caught.value.field == "scheduler"


@pytest.mark.parametrize("address", ["", "here", "tcp://here", "here:8786", "tcp://:8786", 3])
def test_what_is_no_address(address: Any) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="not an address") as caught:
        require_dask(address)
    assert caught.value.field == "scheduler"


def test_a_scheduler_without_workers_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("vkc_pin.utils.parallel.engine._CHECK_INTERVAL", 0.2)
    told: list[str] = []
    with distributed.LocalCluster(
        n_workers=0, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:

        def tell(line: str) -> None:
            told.append(line)
            if "no workers" in line:
                cluster.scale(1)

        assert dict(
            run_tasks(double, numbered(3), scheduler=cluster.scheduler_address, tell=tell)
        ) == {"0": 0, "1": 2, "2": 4}
    assert sum("no workers" in line for line in told) == 1
