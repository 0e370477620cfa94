"""Runs a function on many tasks, in this process, on others of this machine or on a cluster, and yields what comes of each.

Whoever calls keeps what comes: processes that work know no files. A task that is lost with its
process is run again.
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
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

from vkc_pin.errors import InputError, VkcError, format_value
from vkc_pin.utils.interrupt import handle_interrupt
from vkc_pin.utils.optional_imports import import_optional

__all__ = ["MAX_CRASHES", "CrashedTask", "is_dask_installed", "require_dask", "run_tasks"]

MAX_CRASHES = 4
"""How many processes a task may take with it on a cluster before it is given up."""
_ADDRESS = re.compile(r"[a-z]+://[^/\s]+:\d{1,5}")
_QUEUED_PER_WORKER = 2  # tasks that wait for each process, so that none waits for a task
_CONNECT_TIMEOUT = 20.0  # [s] to reach a scheduler
_CHECK_INTERVAL = (
    5.0  # [s] without a result after which it is looked whether all processes are there
)

_MIN_MEMORY = 2_000_000_000  # [bytes] of memory that a process may take, however many there are

Function = Callable[[Any], Any]


@dataclass(frozen=True)
class CrashedTask:
    """What comes of a task that no process survived.

    Attributes:
        reason: In words.
    """

    reason: str


def require_dask(scheduler: str | None) -> None:
    """Look for Dask, which runs tasks in other processes, and at the address of a scheduler.

    Args:
        scheduler: Address of the scheduler that is asked for, None for processes of this machine.

    Raises:
        InputError: It is not installed, or the address is none.
    """
    field = "jobs" if scheduler is None else "scheduler"
    if scheduler is not None and not (isinstance(scheduler, str) and _ADDRESS.fullmatch(scheduler)):
        raise InputError(
            "not an address",
            field=field,
            expected="such as tcp://HOST:8786",
            got=format_value(scheduler),
        )
    import_optional("distributed", "cluster", purpose="running in other processes", field=field)


def is_dask_installed() -> bool:
    """Return whether Dask is installed, which runs tasks on clusters (the extra `cluster`)."""
    try:
        import distributed  # noqa: F401
    except ImportError:
        return False
    return True


def run_tasks(
    function: Function,
    tasks: Iterable[tuple[str, Any]],
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    dask: bool = False,
    limit: float | None = None,
    tell: Callable[[str], object] | None = None,
) -> Generator[tuple[str, Any]]:
    """Yield the key of every task and what the function returns for it, in the order in which they end.

    Tasks are taken from their iterable when a process is about to be free, not before: what was
    yielded can decide about them. With one job and no scheduler all run in this process. Otherwise
    the function and the tasks must be such that other processes can read them. Processes leave
    Ctrl-C to this one.

    Args:
        function: What runs a task.
        tasks: Key and task, each.
        jobs: Number of processes on this machine, each with one thread of BLAS.
        scheduler: Address of a Dask scheduler ("tcp://host:8786") whose workers run the tasks;
            None: this machine.
        dask: Whether processes on this machine are Dask's, which are started anew when they die,
            and whose tasks are run again. Without it, a process that dies ends all.
        limit: Time of a task by the clock [s], after which its process is ended, whatever it does.
            In this process there is none.
        tell: Takes lines for people, such as where Dask's dashboard is.

    Yields:
        Key, and what came of the task; `Died` on a cluster if that took `DEATHS` processes with it.

    Raises:
        InputError: Dask is not installed though it is needed, or no scheduler answers.
        VkcError: A process died, without Dask.
    """
    if scheduler is not None or (dask and jobs > 1):
        yield from _run_on_cluster(function, tasks, jobs, scheduler, limit, tell)
    elif jobs > 1:
        yield from _run_in_processes(function, tasks, jobs, limit)
    else:
        for key, task in tasks:
            yield key, function(task)


def _run_in_processes(
    function: Function, tasks: Iterable[tuple[str, Any]], jobs: int, limit: float | None
) -> Generator[tuple[str, Any]]:
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import BrokenProcessPool

    # Batches of one: a batch comes back as a whole, and a stop would lose all of it.
    with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
        parallel = Parallel(return_as="generator_unordered", batch_size=1, max_nbytes=None)
        found = parallel(
            delayed(_run_in_child_process)(function, key, task, limit, os.getpid())
            for key, task in tasks
        )
    try:
        yield from found
    except BrokenProcessPool as error:
        problem = "a process died, perhaps for want of memory; the trials that were done are kept, and the same call goes on"
        raise VkcError(f"{problem} ({str(error).splitlines()[0]})") from error
    finally:
        with contextlib.suppress(
            KeyboardInterrupt
        ):  # this ends the other processes' tasks if some are still running
            found.close()


def _run_on_cluster(
    function: Function,
    tasks: Iterable[tuple[str, Any]],
    jobs: int,
    scheduler: str | None,
    limit: float | None,
    tell: Callable[[str], object] | None,
) -> Generator[tuple[str, Any]]:
    require_dask(scheduler)
    from distributed import Future, KilledWorker

    left = iter(tasks)
    with _open_client(jobs, scheduler) as (client, cluster), client.as_current():
        if tell is not None:
            tell(f"Dask's dashboard: {client.dashboard_link}")
        running: dict[str, tuple[str, Any, Future]] = {}
        ended: queue.SimpleQueue[Future] = (
            queue.SimpleQueue()
        )  # waiting for all that run would cost more the more there are
        suspects: list[
            tuple[str, Any]
        ] = []  # tried again with nothing beside them: another one may have killed the process
        alone = False

        def submit(key: str, task: Any) -> None:
            # results of the same name would be shared among clients
            name = f"vkc-{key}-{secrets.token_hex(4)}"
            future = client.submit(
                _run_with_time_limit, function, task, limit, key=name, pure=False
            )
            running[name] = key, task, future
            future.add_done_callback(ended.put)

        def feed() -> None:
            nonlocal alone
            if running and (alone or suspects):
                return
            alone = bool(suspects)
            if alone:
                submit(*suspects.pop())
                return
            room = _QUEUED_PER_WORKER * max(1, len(client.nthreads()) if scheduler else jobs) - len(
                running
            )
            for key, task in itertools.islice(left, max(0, room)):
                submit(key, task)

        feed()
        try:
            while running:
                try:
                    future = ended.get(timeout=_CHECK_INTERVAL)
                except queue.Empty:
                    if cluster is not None:
                        cluster.scale(
                            jobs
                            # a process that was killed while it started is not started anew otherwise
                        )
                    elif tell is not None and not client.nthreads():
                        tell(f"{scheduler} has no workers; waiting for some")
                        tell = None  # once
                    continue
                key, task, _ = running.pop(future.key)
                try:
                    result = future.result()
                except KilledWorker:
                    if alone:
                        late = "" if limit is None else f", or longer than {limit:g} s"
                        result = CrashedTask(
                            f"{MAX_CRASHES} processes died with it: out of memory, a crash{late}"
                        )
                    else:
                        suspects.append((key, task))
                        feed()
                        continue
                future.release()
                yield key, result
                feed()
        finally:
            client.cancel([future for *_, future in running.values()], force=True)


@contextlib.contextmanager
def _open_client(jobs: int, scheduler: str | None) -> Generator[tuple[Any, Any]]:
    """Lend a client of a scheduler, or of processes of this machine that end with it, and what these are the workers of."""
    import logging

    import dask
    from distributed import Client, LocalCluster

    settings = {
        "distributed.scheduler.allowed-failures": MAX_CRASHES // 2 - 1,  # and as many alone
        "distributed.logging.distributed": "error",
        "distributed.worker.multiprocessing-method": "spawn",
        # it keeps every second of the last hour, 150 kB each of stacks like ours
        "distributed.worker.profile.enabled": False,
        # Tasks take seconds. At Dask's own intervals, of 20 to 500 ms, looking whether all is well
        # took 4 % of a core.
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.tick.cycle": "10s",
        "distributed.admin.system-monitor.interval": "5s",
        "distributed.worker.memory.monitor-interval": "1s",
        # results leave the processes at once
        "distributed.scheduler.active-memory-manager.start": False,
        # So there is nothing to move to the disk; and a process that is paused, for what it keeps
        # of rooms and programs, never gets less, so that all would wait for it for ever.
        **{f"distributed.worker.memory.{what}": False for what in ("target", "spill", "pause")},
        "distributed.comm.timeouts.connect": f"{_CONNECT_TIMEOUT:g}s",
    }
    with dask.config.set(settings), contextlib.ExitStack() as stack:
        if scheduler is None:
            with handle_interrupt(signal.SIG_IGN):  # which processes inherit: Ctrl-C is this one's
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
    """Return how much memory each of some processes of this machine may take before it is ended and started anew [bytes]."""
    from distributed.system import MEMORY_LIMIT

    return max(int(MEMORY_LIMIT) // jobs, _MIN_MEMORY)


def _run_with_time_limit(function: Function, task: Any, limit: float | None) -> Any:
    """Run one task; end this process if it takes longer than a limit [s], be it in the middle of compiled code."""
    signal.setitimer(
        signal.ITIMER_REAL, limit or 0.0
    )  # nobody handles its signal, which ends the process then
    try:
        return function(task)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _run_in_child_process(
    function: Function, key: str, task: Any, limit: float | None, parent: int
) -> tuple[str, Any]:
    """Run one task in a process of its own, which leaves Ctrl-C, that reaches all processes, to `parent` and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _exit_with_parent(parent)
    return key, _run_with_time_limit(function, task, limit)


@cache
def _exit_with_parent(parent: int) -> None:
    """Let this process end soon after `parent` was killed, instead of working on for nobody."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
