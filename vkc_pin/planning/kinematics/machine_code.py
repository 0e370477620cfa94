"""CasADi functions as machine code: compiled in the background, kept on disk, and equal to the interpreted ones bit for bit.

Nothing waits for a compiler, and nothing fails for want of one: as long as there is no library, the
functions are those that were given.
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

__all__ = ["MachineCode", "wait", "work"]

# No contraction to fused multiplications and additions, the interpreter's own calls of sine and
# cosine, and nothing that another machine with the same home may lack: results are equal to the
# last bit. -O2 took 1.4 times as long to compile, for no gain.
_FLAGS = (
    "-O1",
    "-ffp-contract=off",
    "-fno-builtin-sin",
    "-fno-builtin-cos",
    "-w",
    "-fPIC",
    "-shared",
)
_LONGEST = 600.0  # [s] that a compiler may take; one that has a processor to itself takes 1 to 2
# at which a library is compared with the interpreter before it is kept; each time it is loaded, at
# one: 1 ms
_SAMPLES = 20
_WORKER = """
import os, sys
os.nice(19)
sys.path[:] = sys.argv[3:]
from vkc_pin.planning.kinematics.machine_code import work
work(sys.argv[1], int(sys.argv[2]))
"""
_NICE = ("nice", "-n", "19")  # where there is this command, Python itself starts with low priority
_LOADING = threading.Lock()


class MachineCode:
    """Functions that are compiled together; for one thread at a time, like what keeps it."""

    def __init__(self, *functions: ca.Function) -> None:
        self._given, self._loaded, self._key, self._over = functions, functions, "", False

    @property
    def functions(self) -> tuple[ca.Function, ...]:
        """The functions as they were when `look` was last called: those that were given, or compiled ones."""
        return self._loaded

    @property
    def compiled(self) -> bool:
        """Whether they are machine code."""
        return self._loaded is not self._given

    def look(self) -> bool:
        """Load the library if there is one, or else ask for it; return whether the functions are machine code now.

        The first time takes some milliseconds, to find out its name; after that this is quick.
        """
        if self._over:
            return self.compiled
        with contextlib.suppress(
            OSError, RuntimeError, ValueError
        ):  # RuntimeError: CasADi's, and no more threads
            if (folder := Libraries.here()) is None or (compiler := _compiler()) is None:
                return False
            if not self._key:
                texts = [function.serialize() for function in self._given]
                self._key = _key(compiler, texts)
                if not folder.exists(self._key) and folder.ask(
                    self._key, json.dumps([compiler, texts]).encode()
                ):
                    _start_if_idle(folder)
            if folder.exists(self._key):
                self._over = True  # tried once: nothing changes after that
                if (path := folder.find(self._key)) is not None and (
                    loaded := _load(path, self._given)
                ):
                    self._loaded = loaded
        return self.compiled


def wait(timeout: float = 600.0) -> bool:
    """Compile what was asked for so far, in this process or others, and wait until that is done.

    Plan once, then call this: the next plans of that kind begin with machine code. For
    installations, benchmarks and tests.

    Args:
        timeout: How long to wait at most [s].

    Returns:
        Whether nothing is left to be compiled.
    """
    deadline, folder = time.monotonic() + timeout, Libraries.here()
    if folder is None:
        return False
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        while jobs := folder.jobs():
            left = deadline - time.monotonic()
            process = _start_if_idle(folder)
            if (
                process is not None
                and process.wait(max(left, 0.0))
                and not any(map(folder.failed, jobs))
            ):
                # it does not even start; where it dies of a library, the next one goes on with the
                # others
                return False
            if left < 0.0 or not _python():
                return False
            time.sleep(0.02)  # somebody else may be at it
        return True
    return False


def work(path: str, lock: int) -> None:
    """Compile what was asked for in a folder, until nothing is left; what a background process runs.

    Args:
        path: The folder.
        lock: Handle of its lock, which this process has; see `Libraries.lock`.
    """
    folder, done = Libraries(Path(path)), set[str]()
    while keys := set(folder.jobs()) - done:
        for key in sorted(keys):
            try:
                if not folder.exists(key) and not folder.failed(key):
                    _compile(folder, key)
            except Exception:  # whatever it was: the mark stays, and the next one has its turn
                continue
            finally:
                folder.remove(f"{key}.job")
        done |= keys
        folder.tidy()
        folder.unlock(
            lock
        )  # whoever asks from now on sees to it, and whoever asked before relies on this process
        if not done.issuperset(folder.jobs()) and not folder.take(lock):
            return


def _compile(folder: Libraries, key: str) -> None:
    """Compile one job, compare the result with the interpreter here, where it may crash, and keep it."""
    folder.try_out(key)
    compiler, texts = json.loads(folder.job(key))
    functions = tuple(ca.Function.deserialize(text) for text in texts)
    with tempfile.TemporaryDirectory(dir=folder.path, prefix=BUILD) as build:
        library, code = Path(build) / "functions.so", ca.CodeGenerator("functions.c")
        for function in functions:
            code.add(function)
        code.generate(f"{build}/")
        process = _run([*compiler, *_FLAGS, "functions.c", "-o", library.name, "-lm"], Path(build))
        try:
            status = process.wait(_LONGEST)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # all that it started
            process.wait()
        if status == 0 and _load(library, functions, _SAMPLES):
            folder.publish(key, library.read_bytes())


def _load(path: Path, given: tuple[ca.Function, ...], samples: int = 1) -> tuple[ca.Function, ...]:
    """Return the functions in a library if they are the given ones, or none."""
    try:
        with _LOADING:
            loaded = tuple(ca.external(function.name(), str(path)) for function in given)
        return (
            loaded if all(_same(*pair, samples) for pair in zip(given, loaded, strict=True)) else ()
        )
    except RuntimeError:  # no library for this machine, or other functions
        return ()


def _same(one: ca.Function, other: ca.Function, samples: int) -> bool:
    """Whether two functions have the same inputs and outputs, and the same bits come out where they are looked at."""
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


def _compiler() -> tuple[str, ...] | None:
    """Return the command of the C compiler, with its full path."""
    try:
        name, *options = shlex.split(os.environ.get("CC", "")) or ["cc"]
    except ValueError:
        return None
    found = shutil.which(name)
    return (found, *options) if found else None


def _key(compiler: tuple[str, ...], texts: list[str]) -> str:
    """Return the name of the library of some functions: a digest of all that makes a difference to it."""
    status, libc = Path(compiler[0]).stat(), None
    with contextlib.suppress(OSError, ValueError):  # not GNU
        libc = os.confstr("CS_GNU_LIBC_VERSION")
    machine = (platform.system(), platform.machine(), libc)
    made_by = (
        *compiler,
        str(Path(compiler[0]).resolve()),
        status.st_size,
        status.st_mtime_ns,
        *_FLAGS,
    )
    digest = hashlib.sha256(json.dumps([made_by, ca.CasadiMeta.version(), machine]).encode())
    for text in texts:
        digest.update(hashlib.sha256(text.encode()).digest())
    return digest.hexdigest()[:40]


def _start_if_idle(folder: Libraries) -> subprocess.Popen[bytes] | None:
    """Start a process that compiles, unless one is at it; it outlives this one, and ends when nothing is left to be done."""
    if not _python() or (lock := folder.lock()) is None:
        return None
    try:  # the lock goes on to the process
        nice = _NICE if shutil.which(_NICE[0]) else ()
        command = [
            *nice,
            sys.executable,
            "-P",
            "-c",
            _WORKER,
            str(folder.path),
            str(lock),
            *map(os.path.abspath, sys.path),
        ]
        process = _run(command, folder.path, lock)
    finally:
        os.close(lock)
    threading.Thread(target=process.wait, daemon=True).start()  # so that it leaves no zombie
    return process


def _python() -> bool:
    """Whether there is a Python to start: a program with one in it is not started once more."""
    return "python" in Path(sys.executable or "").name.lower()


def _run(command: list[str], folder: Path, *handles: int) -> subprocess.Popen[bytes]:
    """Start a process that hears and says nothing, in a group of its own: Ctrl-C is not for it.

    Not in a session of its own: Linux shares processors out by session first, and lower priority
    would mean nothing in another.
    """
    no = subprocess.DEVNULL
    return subprocess.Popen(
        command, cwd=folder, process_group=0, stdin=no, stdout=no, stderr=no, pass_fds=handles
    )
