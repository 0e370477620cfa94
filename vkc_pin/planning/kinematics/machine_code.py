"""Compiles CasADi functions in the background, and keeps them in a folder of the user.

Until a library is available, or without a compiler, functions are interpreted. What that
costs: docs/decisions/0008.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import BinaryIO

import casadi as ca
import numpy as np

from vkc_pin.utils.disk_cache import (
    TEMPORARY_PREFIX,
    find_cache_folder,
    is_private,
    write_private_file,
)
from vkc_pin.utils.isolation import has_python
from vkc_pin.utils.system import find_libc_version

BUILD = ".build-"
"""Start of the names of folders in which libraries are compiled."""

# maximum number and size of libraries and records; a waypoint's functions take 0.1 MB
_MAX_FILES = 256
_MAX_BYTES = 512 * 2**20
_MAX_JOBS = 64  # maximum number of pending jobs
# [s] after which a failed compilation is retried and the files of dead processes are removed
_RETRY_DELAY = 86400.0
# Names of the files and folders that the package creates here. No others are removed or executed.
_RANDOM_SUFFIX = "[a-z0-9_]{8}"  # suffix of names by `tempfile`
_FILE_PATTERN = re.compile(
    rf"[0-9a-f]{{40}}\.(?:so|json|job|failed)|{re.escape(TEMPORARY_PREFIX)}{_RANDOM_SUFFIX}"
)
_BUILD_PATTERN = re.compile(re.escape(BUILD) + _RANDOM_SUFFIX)
_DIGEST_SIZE = hashlib.sha256().digest_size  # bytes appended to a library; loaders ignore them
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
os.nice(int(sys.argv[3]))
sys.path[:] = sys.argv[4:]
from vkc_pin.planning.kinematics.machine_code import compile_jobs
compile_jobs(sys.argv[1], int(sys.argv[2]))
"""
_NICENESS = 19  # of compilers: planning goes first
_LOAD_LOCK = threading.Lock()


class Libraries:
    """A folder with libraries `KEY.so`, requests `KEY.job` and failure marks `KEY.failed`.

    A library ends in a digest, so that a truncated one, which could crash the process, is never
    loaded. Any number of processes may use the folder at once. Operations that fail raise OSError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def open_default(cls) -> Libraries | None:
        """Return this user's folder, created if necessary.

        Returns None if there is none, or if other users might have written to it.
        """
        path = find_cache_folder()
        return None if path is None else cls(path)

    def exists(self, key: str) -> bool:
        """Return whether a file of the library exists."""
        return (self.path / f"{key}.so").is_file()

    def find(self, key: str) -> Path | None:
        """Return the path of a valid library, or None; a damaged one is removed."""
        path = self.path / f"{key}.so"
        try:
            with _open(path) as stream:
                status = os.fstat(stream.fileno())
                if not stat.S_ISREG(status.st_mode) or not is_private(status):
                    return None
                data = stream.read()
        except OSError:
            return None
        if hashlib.sha256(data[:-_DIGEST_SIZE]).digest() != data[-_DIGEST_SIZE:]:
            self.remove(f"{key}.so")
            return None
        with contextlib.suppress(OSError):
            os.utime(path)  # time of last use
        return path

    def request(self, key: str, job: bytes) -> bool:
        """Request the compilation of a library; return whether it is pending now."""
        if self.has_failed(key):
            return False
        pending = self.list_jobs()
        if key in pending:
            return True
        if len(pending) >= _MAX_JOBS:
            return False
        self._write(f"{key}.job", job)
        return True

    def list_jobs(self) -> list[str]:
        """Return the keys of pending jobs."""
        keys = []
        for path in self.path.glob("*.job"):
            is_own = _FILE_PATTERN.fullmatch(path.name)
            if is_own and path.is_file() and not path.is_symlink():
                keys.append(path.stem)
        return sorted(keys)

    def read_job(self, key: str) -> bytes:
        """Return the contents of a pending job."""
        path = self.path / f"{key}.job"
        with _open(path) as stream:
            if not is_private(os.fstat(stream.fileno())):
                raise PermissionError(f"others may have written {path}")
            return stream.read()

    def has_failed(self, key: str) -> bool:
        """Return whether a compilation failed within the last day."""
        with contextlib.suppress(OSError):
            return time.time() - (self.path / f"{key}.failed").stat().st_mtime < _RETRY_DELAY
        return False

    def mark_attempt(self, key: str) -> None:
        """Mark a compilation as failed until `publish` is called, as it may crash the process."""
        self._write(f"{key}.failed", b"")

    def publish(self, key: str, library: bytes) -> None:
        """Store a library."""
        self._write(f"{key}.so", library + hashlib.sha256(library).digest())
        self.remove(f"{key}.failed")

    def remove(self, name: str) -> None:
        """Remove a file if it exists."""
        with contextlib.suppress(OSError):
            (self.path / name).unlink()

    def evict(self) -> None:
        """Remove the least recently used files beyond the limits, and files of dead processes.

        Only regular files and build folders with names that the package creates are removed.
        """
        libraries = []
        now = time.time()
        for path in self.path.iterdir():
            with contextlib.suppress(OSError):
                status = path.lstat()
                is_old = now - status.st_mtime > _RETRY_DELAY
                is_own_file = stat.S_ISREG(status.st_mode) and _FILE_PATTERN.fullmatch(path.name)
                is_own_folder = stat.S_ISDIR(status.st_mode) and _BUILD_PATTERN.fullmatch(path.name)
                if is_own_file and path.suffix in (".so", ".json"):
                    libraries.append((status.st_mtime, status.st_size, path))
                elif is_own_file and is_old:
                    path.unlink()
                elif is_own_folder and is_old:
                    shutil.rmtree(path)  # does not follow symbolic links
        size = 0
        for count, (_, nbytes, path) in enumerate(sorted(libraries, reverse=True)):
            size += nbytes
            if count >= _MAX_FILES or size > _MAX_BYTES:
                self.remove(path.name)

    def lock(self) -> int | None:
        """Return a handle of the compiler lock, to be closed, or None if another process holds it.

        A process that inherits the handle holds the lock too, as long as either has it open.
        """
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        handle = os.open(self.path / "lock", flags, 0o600)
        try:
            if self.acquire(handle):
                return handle
        except OSError:
            os.close(handle)
            raise
        os.close(handle)
        return None

    def acquire(self, handle: int) -> bool:
        """Try to acquire the lock; return whether that succeeded."""
        import fcntl

        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def unlock(self, handle: int) -> None:
        """Release the lock."""
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_UN)

    def _write(self, name: str, data: bytes) -> None:
        write_private_file(self.path / name, data)


def _open(path: Path) -> BinaryIO:
    """Open a file, but no symbolic link, for reading."""
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb")


class MachineCode:
    """Functions that are compiled together; not thread-safe."""

    def __init__(self, *functions: ca.Function) -> None:
        self._interpreted = functions
        self._functions = functions
        self._key = ""  # name of the library, once it has been computed
        self._is_final = False

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
            folder = Libraries.open_default()
            compiler = find_compiler()
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
                path = folder.find(self._key)
                if path is not None:
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
    deadline = time.monotonic() + timeout
    folder = Libraries.open_default()
    if folder is None:
        return False
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        while jobs := folder.list_jobs():
            remaining = deadline - time.monotonic()
            process = _start_worker_if_idle(folder)
            has_died = process is not None and process.wait(max(remaining, 0.0))
            if has_died and not any(folder.has_failed(key) for key in jobs):
                return False  # it cannot start; if one library kills it, the next one continues
            if remaining < 0.0 or not has_python():
                return False
            time.sleep(0.02)  # another process may be compiling
        return True
    return False


def compile_jobs(path: str, lock: int) -> None:
    """Compile the jobs of a folder until none is left; `lock` is that of `Libraries.lock`."""
    folder = Libraries(Path(path))
    finished = set[str]()
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
        library = Path(build) / "functions.so"
        code = ca.CodeGenerator("functions.c")
        for function in functions:
            code.add(function)
        code.generate(f"{build}/")
        command = [*compiler, *_FLAGS, "functions.c", "-o", library.name, "-lm"]
        process = _start_process(command, Path(build))
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
        for function, loaded_function in zip(functions, loaded, strict=True):
            if not _is_identical(function, loaded_function, samples):
                return ()
        return loaded
    except RuntimeError:  # not a library for this machine, or different functions
        return ()


def _is_identical(one: ca.Function, other: ca.Function, samples: int) -> bool:
    """Return whether two functions have equal signatures and bitwise equal results at samples."""
    if one.n_in() != other.n_in() or _list_sparsities(one) != _list_sparsities(other):
        return False
    random = np.random.default_rng(0)
    for _ in range(samples):
        inputs = []
        for i in range(one.n_in()):
            values = random.uniform(-2.0, 2.0, one.nnz_in(i))
            inputs.append(ca.DM(one.sparsity_in(i), values))
        for result, other_result in zip(one.call(inputs), other.call(inputs), strict=True):
            a = np.array(result.nonzeros())
            b = np.array(other_result.nonzeros())
            differs = a.view(np.int64) != b.view(np.int64)
            are_nan = np.isnan(a) & np.isnan(b)
            if differs[~are_nan].any():
                return False
    return True


def _list_sparsities(function: ca.Function) -> list[ca.Sparsity]:
    """Return the sparsities of inputs and outputs."""
    sparsities = [function.sparsity_in(i) for i in range(function.n_in())]
    sparsities += [function.sparsity_out(i) for i in range(function.n_out())]
    return sparsities


def find_compiler() -> tuple[str, ...] | None:
    """Return the command of the C compiler with its full path, or None."""
    try:
        name, *options = shlex.split(os.environ.get("CC", "")) or ["cc"]
    except ValueError:
        return None
    found = shutil.which(name)
    if not found:
        return None
    return (found, *options)


def _compute_key(compiler: tuple[str, ...], texts: list[str]) -> str:
    """Return the key of a library: a digest of functions, compiler and platform."""
    executable = Path(compiler[0])
    status = executable.stat()
    resolved = str(executable.resolve())
    toolchain = (*compiler, resolved, status.st_size, status.st_mtime_ns, *_FLAGS)
    machine = (platform.system(), platform.machine(), find_libc_version())
    environment = json.dumps([toolchain, ca.CasadiMeta.version(), machine])
    digest = hashlib.sha256(environment.encode())
    for text in texts:
        digest.update(hashlib.sha256(text.encode()).digest())
    return digest.hexdigest()[:40]


def _start_worker_if_idle(folder: Libraries) -> subprocess.Popen[bytes] | None:
    """Start a background process that compiles all jobs, unless one is running.

    It outlives this process, and ends when no job is left.
    """
    if not has_python():
        return None
    lock = folder.lock()
    if lock is None:
        return None
    try:  # the process inherits the lock
        # Where there is such a command, Python itself starts with low priority.
        nice = ["nice", "-n", str(_NICENESS)] if shutil.which("nice") else []
        arguments = [str(folder.path), str(lock), str(_NICENESS)]
        arguments += map(os.path.abspath, sys.path)  # the worker imports from the same folders
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
