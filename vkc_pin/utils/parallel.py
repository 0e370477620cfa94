"""Runs a function on many tasks: in this process, or by Dask in others, here or on a cluster.

Only the calling process writes files. The tasks of a lost process are run again.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import re
import secrets
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import Any

from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.interrupt import start_without_interrupt
from vkc_pin.utils.optional_imports import import_optional

MAX_CRASHES = 4
"""Number of processes that a task may crash before it is given up."""
_ADDRESS = re.compile(r"[a-z]+://[^/\s]+:\d{1,5}")
_QUEUED_PER_WORKER = 2  # so that no worker waits for a task
_CONNECT_TIMEOUT = 20.0  # [s]
_CHECK_INTERVAL = 5.0  # [s] without a result, after which the workers are checked
_MIN_MEMORY = 2_000_000_000  # [bytes] that each process may use, however many there are

Function = Callable[[Any], Any]
Results = Generator[tuple[str, Any]]


@dataclass(frozen=True)
class CrashedTask:
    """Result of a task that crashed all its processes, with the reason in words."""

    reason: str


def check_processes(jobs: int, scheduler: str | None) -> None:
    """Check that Dask is installed if it is needed, and the address of its scheduler.

    Raises:
        InputError: Dask is not installed, or the address is invalid.
    """
    if scheduler is None and jobs == 1:
        return
    field = "jobs"
    if scheduler is not None:
        field = "scheduler"
        if not isinstance(scheduler, str) or not _ADDRESS.fullmatch(scheduler):
            raise InputError(
                "not an address",
                field=field,
                expected="such as tcp://HOST:8786",
                got=format_value(scheduler),
            )
    import_optional("distributed", "cluster", purpose="running in other processes", field=field)


def is_dask_installed() -> bool:
    """Return whether Dask is installed (the extra `cluster`)."""
    return find_spec("distributed") is not None


def run_tasks(
    function: Function,
    tasks: Iterable[tuple[str, Any]],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    limit: float | None = None,
    tell: Callable[[str], object] | None = None,
) -> Results:
    """Yield the key and the result of every task, in the order of completion.

    Tasks are taken from their iterable only when a process is nearly free, so that earlier results
    can decide about them. Other processes need a function and tasks that can be pickled, and leave
    Ctrl-C to this one.

    Args:
        function: Function of a task.
        tasks: Key and task, each.
        jobs: Number of processes on this machine, each with one BLAS thread, which are restarted
            when they crash; 1: this process.
        scheduler: Address of a Dask scheduler ("tcp://host:8786") whose workers run the tasks.
        limit: Wall-clock time of a task [s] after which its process is killed; not in this process.
        tell: Receives messages for users, such as the address of Dask's dashboard.

    Yields:
        Key and result; a `CrashedTask` if the task crashed `MAX_CRASHES` processes.

    Raises:
        InputError: Dask is needed and not installed, or no scheduler answers.
    """
    if scheduler is not None or jobs > 1:
        yield from _run_on_cluster(function, tasks, jobs, scheduler, limit, tell)
    else:
        for key, task in tasks:
            yield key, function(task)


def _run_on_cluster(
    function: Function,
    tasks: Iterable[tuple[str, Any]],
    jobs: int,
    scheduler: str | None,
    limit: float | None,
    tell: Callable[[str], object] | None,
) -> Results:
    check_processes(jobs, scheduler)
    with _open_client(jobs, scheduler) as (client, cluster), client.as_current():
        if tell is not None:
            tell(f"Dask's dashboard: {client.dashboard_link}")
        run = _ClusterRun(client, function, iter(tasks), limit)
        workers = None if scheduler else jobs
        run.submit_tasks(workers)
        try:
            while run.running:
                try:
                    future = run.ended.get(timeout=_CHECK_INTERVAL)
                except queue.Empty:
                    if cluster is not None:
                        cluster.scale(jobs)  # restarts processes that were killed at their start
                    elif tell is not None and not client.nthreads():
                        tell(f"{scheduler} has no workers; waiting for some")
                        tell = None
                    continue
                outcome = run.collect(future)
                if outcome is not None:
                    yield outcome
                run.submit_tasks(workers)
        finally:
            client.cancel([future for *_, future in run.running.values()], force=True)


class _ClusterRun:
    """Tasks on a cluster. After a crash, tasks are repeated alone to find its cause."""

    def __init__(
        self, client: Any, function: Function, tasks: Iterator[tuple[str, Any]], limit: float | None
    ) -> None:
        self.client = client
        self.function = function
        self.tasks = tasks
        self.limit = limit
        self.running: dict[str, tuple[str, Any, Any]] = {}
        self.ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.suspects: list[tuple[str, Any]] = []
        self.is_alone = False

    def submit_tasks(self, workers: int | None) -> None:
        """Submit as many tasks as keep `workers` busy; None: all workers that there are."""
        if self.running and (self.is_alone or self.suspects):
            return
        self.is_alone = bool(self.suspects)
        if self.is_alone:
            self._submit(*self.suspects.pop())
            return
        if workers is None:
            workers = max(1, len(self.client.nthreads()))
        missing = _QUEUED_PER_WORKER * workers - len(self.running)
        for key, task in itertools.islice(self.tasks, max(0, missing)):
            self._submit(key, task)

    def _submit(self, key: str, task: Any) -> None:
        # Clients share results of the same name.
        name = f"vkc-{key}-{secrets.token_hex(4)}"
        future = self.client.submit(
            run_with_time_limit, self.function, task, self.limit, key=name, pure=False
        )
        self.running[name] = key, task, future
        future.add_done_callback(self.ended.put)

    def collect(self, future: Any) -> tuple[str, Any] | None:
        """Return key and result of a task; None if it is to be repeated alone."""
        from distributed import KilledWorker

        key, task, _ = self.running.pop(future.key)
        try:
            result = future.result()
        except KilledWorker:
            if not self.is_alone:
                self.suspects.append((key, task))
                return None
            reason = f"{MAX_CRASHES} processes died with it: out of memory, a crash"
            if self.limit is not None:
                reason += f", or longer than {self.limit:g} s"
            result = CrashedTask(reason)
        future.release()
        return key, result


@contextlib.contextmanager
def _open_client(jobs: int, scheduler: str | None) -> Generator[tuple[Any, Any]]:
    """Yield a client, and the local cluster that it started, if no scheduler is given."""
    import logging

    import dask
    from distributed import Client, LocalCluster

    settings = {
        # Tasks of a crash are run twice, the second time alone.
        "distributed.scheduler.allowed-failures": MAX_CRASHES // 2 - 1,
        "distributed.logging.distributed": "error",
        "distributed.worker.multiprocessing-method": "spawn",
        # The profiler keeps stacks of the last hour, 150 kB per second.
        "distributed.worker.profile.enabled": False,
        # Tasks take seconds. Checks at Dask's own intervals, 20 to 500 ms, took 4 % of a core.
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.tick.cycle": "10s",
        "distributed.admin.system-monitor.interval": "5s",
        "distributed.worker.memory.monitor-interval": "1s",
        "distributed.scheduler.active-memory-manager.start": False,
        # Results leave the processes at once, so there is nothing to spill. A paused process, with
        # its caches full, would never resume.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.comm.timeouts.connect": f"{_CONNECT_TIMEOUT:g}s",
    }
    with dask.config.set(settings), contextlib.ExitStack() as stack:
        if scheduler is None:
            with start_without_interrupt():
                cluster = stack.enter_context(
                    LocalCluster(
                        n_workers=jobs,
                        threads_per_worker=1,
                        host="127.0.0.1",
                        dashboard_address="127.0.0.1:0",
                        memory_limit=_compute_memory_limit(jobs),
                        silence_logs=logging.CRITICAL,
                    )
                )
            yield stack.enter_context(Client(cluster, set_as_default=False)), cluster
            return
        try:
            client = Client(scheduler, timeout=_CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                "no scheduler answers there",
                field="scheduler",
                expected="tcp://HOST:PORT of a Dask scheduler",
                got=scheduler,
            ) from error
        yield stack.enter_context(client), None


def _compute_memory_limit(jobs: int) -> int:
    """Return the memory of a process after which it is restarted [bytes]."""
    from distributed.system import MEMORY_LIMIT

    return max(int(MEMORY_LIMIT) // jobs, _MIN_MEMORY)


def run_with_time_limit(function: Function, task: Any, limit: float | None) -> Any:
    """Return the result of a task; after `limit` [s], SIGALRM ends this process."""
    # Nothing handles the signal, which kills the process even in compiled code.
    signal.setitimer(signal.ITIMER_REAL, limit or 0.0)
    try:
        return function(task)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


@cache
def exit_with_parent(parent: int) -> None:
    """Exit soon after the parent process was killed."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
