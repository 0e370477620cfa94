"""Compiles CasADi functions in the background; results equal the interpreter's bit for bit.

Until a library is available, or without a compiler, functions are interpreted. What that
costs: docs/decisions/0008.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import casadi as ca
import numpy as np

from vkc_pin.planning.kinematics.libraries import BUILD, Libraries
from vkc_pin.utils.isolation import has_python
from vkc_pin.utils.system import find_libc_version

__all__ = ["MachineCode", "compile_jobs", "find_compiler", "wait"]

# No fused multiply-add, the interpreter's own sine and cosine, and no instructions that another
# machine with the same home may lack: results are equal bit for bit. -O2 took 1.4 times as long to
# compile without making the code faster.
_FLAGS = [
    "-O1",
    "-ffp-contract=off",
    "-fno-builtin-sin",
    "-fno-builtin-cos",
    "-w",
    "-fPIC",
    "-shared",
]
_COMPILER_TIMEOUT = 600.0  # [s], timeout of the compiler, which takes 1 to 2 s on an idle processor
# Samples at which a library is compared with the interpreter before it is stored. Each time it is
# loaded, one sample is compared (1 ms).
_COMPARISON_SAMPLES = 20
_WORKER_SCRIPT = """
import os, sys
os.nice(19)
sys.path[:] = sys.argv[3:]
from vkc_pin.planning.kinematics.machine_code import compile_jobs
compile_jobs(sys.argv[1], int(sys.argv[2]))
"""
_NICE_COMMAND = ("nice", "-n", "19")  # if available, Python itself starts with low priority
_LOAD_LOCK = threading.Lock()


class MachineCode:
    """Functions that are compiled together; not thread-safe."""

    def __init__(self, *functions: ca.Function) -> None:
        self._interpreted = self._functions = functions
        self._key, self._is_final = "", False

    @property
    def functions(self) -> tuple[ca.Function, ...]:
        """The functions as of the last `try_load`: interpreted or compiled."""
        return self._functions

    @property
    def is_compiled(self) -> bool:
        """Whether the functions are machine code."""
        return self._functions is not self._interpreted

    def try_load(self) -> bool:
        """Load the library if it exists, or else request it; return whether it is loaded.

        The first call takes some milliseconds to compute the library's name; later calls are fast.
        """
        if self._is_final:
            return self.is_compiled
        # RuntimeError: from CasADi, or no thread can be started
        with contextlib.suppress(OSError, RuntimeError, ValueError):
            folder, compiler = Libraries.open_default(), find_compiler()
            if folder is None or compiler is None:
                return False
            if not self._key:
                texts = [function.serialize() for function in self._interpreted]
                self._key = _compute_key(compiler, texts)
                job = json.dumps([compiler, texts]).encode()
                if not folder.exists(self._key) and folder.request(self._key, job):
                    _start_worker_if_idle(folder)
            if folder.exists(self._key):
                self._is_final = True  # loading is attempted only once
                if (path := folder.find(self._key)) is not None:
                    self._functions = _load_library(path, self._interpreted) or self._functions
        return self.is_compiled


def wait(timeout: float = 600.0) -> bool:
    """Compile all pending functions, of this process and others, and wait until that is done.

    Plan once, then call this: subsequent plans of that kind start with machine code. It is meant
    for installations, benchmarks and tests.

    Args:
        timeout: Maximum time to wait [s].

    Returns:
        Whether no function is left to be compiled.
    """
    deadline, folder = time.monotonic() + timeout, Libraries.open_default()
    if folder is None:
        return False
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        while jobs := folder.list_jobs():
            remaining = deadline - time.monotonic()
            process = _start_worker_if_idle(folder)
            has_died = process is not None and process.wait(max(remaining, 0.0))
            if has_died and not any(map(folder.has_failed, jobs)):
                return False  # it cannot start; if one library kills it, the next one continues
            if remaining < 0.0 or not has_python():
                return False
            time.sleep(0.02)  # another process may be compiling
        return True
    return False


def compile_jobs(path: str, lock: int) -> None:
    """Compile the jobs of a folder until none is left; `lock` is that of `Libraries.lock`."""
    folder, finished = Libraries(Path(path)), set[str]()
    while keys := set(folder.list_jobs()) - finished:
        for key in sorted(keys):
            try:
                if not folder.exists(key) and not folder.has_failed(key):
                    _compile_job(folder, key)
            except Exception:  # the failure mark remains, and the next job is compiled
                continue
            finally:
                folder.remove(f"{key}.job")
        finished |= keys
        folder.evict()
        # Requests from now on start a worker themselves; earlier ones rely on this process.
        folder.unlock(lock)
        if not finished.issuperset(folder.list_jobs()) and not folder.acquire(lock):
            return


def _compile_job(folder: Libraries, key: str) -> None:
    """Compile one job, compare the result with the interpreter, and store it.

    The comparison runs in this process, since it may crash.
    """
    folder.mark_attempt(key)
    compiler, texts = json.loads(folder.read_job(key))
    functions = tuple(ca.Function.deserialize(text) for text in texts)
    with tempfile.TemporaryDirectory(dir=folder.path, prefix=BUILD) as build:
        library, code = Path(build) / "functions.so", ca.CodeGenerator("functions.c")
        for function in functions:
            code.add(function)
        code.generate(f"{build}/")
        process = _start_process(
            [*compiler, *_FLAGS, "functions.c", "-o", library.name, "-lm"], Path(build)
        )
        try:
            status = process.wait(_COMPILER_TIMEOUT)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # including its children
            process.wait()
        if status == 0 and _load_library(library, functions, _COMPARISON_SAMPLES):
            folder.publish(key, library.read_bytes())


def _load_library(
    path: Path, functions: tuple[ca.Function, ...], samples: int = 1
) -> tuple[ca.Function, ...]:
    """Return the functions of a library if they are identical to the given ones, otherwise ()."""
    try:
        with _LOAD_LOCK:
            loaded = tuple(ca.external(function.name(), str(path)) for function in functions)
        pairs = zip(functions, loaded, strict=True)
        return loaded if all(_is_identical(*pair, samples) for pair in pairs) else ()
    except RuntimeError:  # not a library for this machine, or different functions
        return ()


def _is_identical(one: ca.Function, other: ca.Function, samples: int) -> bool:
    """Return whether two functions have equal signatures and bitwise equal results at samples."""
    shapes = [
        [f.sparsity_in(i) for i in range(f.n_in())] + [f.sparsity_out(i) for i in range(f.n_out())]
        for f in (one, other)
    ]
    if one.n_in() != other.n_in() or shapes[0] != shapes[1]:
        return False
    random = np.random.default_rng(0)
    for _ in range(samples):
        inputs = [
            ca.DM(one.sparsity_in(i), random.uniform(-2.0, 2.0, one.nnz_in(i)))
            for i in range(one.n_in())
        ]
        for a, b in zip(one.call(inputs), other.call(inputs), strict=True):
            a, b = np.array(a.nonzeros()), np.array(b.nonzeros())
            if (a.view(np.int64) != b.view(np.int64))[~(np.isnan(a) & np.isnan(b))].any():
                return False
    return True


def find_compiler() -> tuple[str, ...] | None:
    """Return the command of the C compiler with its full path, or None."""
    try:
        name, *options = shlex.split(os.environ.get("CC", "")) or ["cc"]
    except ValueError:
        return None
    found = shutil.which(name)
    return (found, *options) if found else None


def _compute_key(compiler: tuple[str, ...], texts: list[str]) -> str:
    """Return the key of a library: a digest of functions, compiler and platform."""
    status = Path(compiler[0]).stat()
    machine = (platform.system(), platform.machine(), find_libc_version())
    resolved = str(Path(compiler[0]).resolve())
    toolchain = (*compiler, resolved, status.st_size, status.st_mtime_ns, *_FLAGS)
    digest = hashlib.sha256(json.dumps([toolchain, ca.CasadiMeta.version(), machine]).encode())
    for text in texts:
        digest.update(hashlib.sha256(text.encode()).digest())
    return digest.hexdigest()[:40]


def _start_worker_if_idle(folder: Libraries) -> subprocess.Popen[bytes] | None:
    """Start a background process that compiles all jobs, unless one is running.

    It outlives this process, and ends when no job is left.
    """
    if not has_python() or (lock := folder.lock()) is None:
        return None
    try:  # the process inherits the lock
        nice = _NICE_COMMAND if shutil.which(_NICE_COMMAND[0]) else ()
        arguments = (str(folder.path), str(lock), *map(os.path.abspath, sys.path))
        command = [*nice, sys.executable, "-P", "-c", _WORKER_SCRIPT, *arguments]
        process = _start_process(command, folder.path, lock)
    finally:
        os.close(lock)
    threading.Thread(target=process.wait, daemon=True).start()  # reaps the process
    return process


def _start_process(command: list[str], folder: Path, *handles: int) -> subprocess.Popen[bytes]:
    """Start a silent process in a process group of its own, so that Ctrl-C does not reach it."""
    # Not in a session of its own: there low priority would have no effect on Linux.
    null = subprocess.DEVNULL
    return subprocess.Popen(
        command, cwd=folder, process_group=0, stdin=null, stdout=null, stderr=null, pass_fds=handles
    )
