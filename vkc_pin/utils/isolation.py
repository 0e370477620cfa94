"""Runs parsers of other programs in a child process with limits of time, memory and file size.

Files from strangers make such parsers wait for pipes, expand without end, or crash. Here this ends
in an `InputError` and not in the death of the calling process.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from vkc_pin.errors import InputError
from vkc_pin.utils.parallel import exit_with_parent, run_with_time_limit
from vkc_pin.utils.system import limit_resource

T = TypeVar("T")
TIME_VARIABLE = "VKC_PIN_PARSE_SECONDS"
"""Environment variable with the wall-clock time of one call [s]."""
MEMORY_VARIABLE = "VKC_PIN_PARSE_MEMORY"
"""Environment variable with the memory of the child process [GB]."""
_DEFAULTS = {TIME_VARIABLE: 60.0, MEMORY_VARIABLE: 4.0}
_MAX_FILE_SIZE = 2**24  # [bytes] of a file that the child writes; it has no reason to write any
_MAX_RESULT_SIZE = 2**30  # [bytes]
_OUT_OF_MEMORY = 99  # exit code
_SCRIPT = (
    "import sys; sys.path[:] = sys.argv[2:]; from vkc_pin.utils.isolation import serve; serve()"
)


def run_isolated(
    function: Callable[..., T],
    *arguments: Any,
    program: str,
    file: str | Path | None = None,
) -> T:
    """Return the result of a function that runs in a child process; see `submit_isolated`."""
    return submit_isolated(function, *arguments, program=program, file=file)()


def submit_isolated(
    function: Callable[..., T],
    *arguments: Any,
    program: str,
    file: str | Path | None = None,
) -> Callable[[], T]:
    """Start a function in the child process of this thread, and return one that waits for it.

    A program that embeds Python calls the function itself, without limits.

    Args:
        function: Function of a module.
        *arguments: Its arguments. They, its result and its exceptions must be picklable.
        program: Name of the program that parses, for messages: "MuJoCo".
        file: File that is parsed, for messages.

    Raises:
        InputError: The program crashes or exceeds a limit.
    """
    if not has_python():
        return functools.partial(function, *arguments)
    child = _get_child()
    seconds = _read_limit(TIME_VARIABLE)
    child.submit((function, arguments, seconds))
    return functools.partial(child.receive, program, file, seconds)


def has_python() -> bool:
    """Return whether the executable is Python and not a program that embeds it."""
    return "python" in Path(sys.executable or "").name.lower()


class _Child:
    """A child process. It serves all calls of a thread, and starts anew after a failure."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self._process: subprocess.Popen[bytes] | None = None
        self._memory = 0.0  # limit of the process [GB]
        self._is_busy = False

    def submit(self, call: tuple[Any, ...]) -> None:
        memory = _read_limit(MEMORY_VARIABLE)
        # A process ends at Ctrl-C, and is busy if nobody fetched the result of its last call.
        is_ended = self._process is not None and self._process.poll() is not None
        if self._is_busy or is_ended or memory != self._memory:
            self.close()
        if self._process is None:
            self._process = _start_process(memory)
            self._memory = memory
            self._end = weakref.finalize(self, _end_process, self._process, self.owner)
        assert self._process.stdin is not None
        self._is_busy = True
        with contextlib.suppress(BrokenPipeError):  # `receive` reports the reason
            self._process.stdin.write(pickle.dumps(call))
            self._process.stdin.flush()

    def receive(self, program: str, file: str | Path | None, seconds: float) -> Any:
        process = self._process
        assert process is not None
        assert process.stdout is not None
        try:
            is_result, answer = pickle.load(process.stdout)
        except (EOFError, pickle.UnpicklingError):
            code = process.wait()
            raise _explain_end(code, program, file, seconds, self._memory) from None
        else:
            self._is_busy = False
        finally:
            if self._is_busy:  # also after KeyboardInterrupt
                self.close()
        if not is_result:
            raise answer
        return answer

    def close(self) -> None:
        if self._process is not None:
            self._end()
        self._process = None
        self._is_busy = False


_LOCAL = threading.local()


def _get_child() -> _Child:
    """Return the child process of this thread; a fork must not use that of its parent."""
    child: _Child | None = getattr(_LOCAL, "child", None)
    if child is None or child.owner != os.getpid():
        child = _Child()
        _LOCAL.child = child
    return child


def _end_process(process: subprocess.Popen[bytes], owner: int) -> None:
    if owner == os.getpid():
        process.kill()
        with contextlib.suppress(BrokenPipeError), process:
            pass  # closes its streams and waits


def _start_process(memory: float) -> subprocess.Popen[bytes]:
    # -P: the current folder is no place to import from.
    command = [sys.executable, "-P", "-c", _SCRIPT, str(memory)]
    command += map(os.path.abspath, sys.path)
    environment = dict(os.environ)
    environment["OPENBLAS_NUM_THREADS"] = "1"  # it reserves memory for each thread
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd="/",  # where programs cannot leave files such as MUJOCO_LOG.TXT
        env=environment,
    )


def _explain_end(
    code: int, program: str, file: str | Path | None, seconds: float, memory: float
) -> BaseException:
    """Return the error for an exit code of the process; negative ones are signals."""
    if code == -signal.SIGINT:
        return KeyboardInterrupt()
    if code == -signal.SIGALRM:
        expected = f"at most {seconds:g} s ({TIME_VARIABLE})"
        return InputError(f"{program} does not finish in time", file=file, expected=expected)
    if code in (-signal.SIGKILL, _OUT_OF_MEMORY):
        expected = f"at most {memory:g} GB ({MEMORY_VARIABLE})"
        return InputError(f"{program} needs too much memory", file=file, expected=expected)
    got = f"exit code {code}"
    with contextlib.suppress(ValueError):
        got = signal.strsignal(-code) or got
    return InputError(f"{program} crashes", file=file, expected="a valid file", got=got)


def _read_limit(name: str) -> float:
    text = os.environ.get(name, "")
    try:
        limit = float(text or _DEFAULTS[name])
    except ValueError:
        limit = math.nan
    if not 0.0 < limit < 1e6:
        expected = "a number above 0 and below a million"
        raise InputError("wrong environment variable", field=name, expected=expected, got=text)
    return limit


def serve() -> None:
    """Answer the calls of the parent process until it closes standard input."""
    # The parser may write to its standard streams, which therefore lead nowhere.
    answers = os.fdopen(os.dup(1), "wb")
    requests = os.fdopen(os.dup(0), "rb")
    null = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(null, stream)
    exit_with_parent(os.getppid())
    for number in (signal.SIGINT, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)
    _limit_resources(int(float(sys.argv[1]) * 1e9))
    while True:
        try:
            function, arguments, seconds = pickle.load(requests)
        except EOFError:
            return
        answers.write(_call(function, arguments, seconds))
        answers.flush()


def _call(function: Callable[..., Any], arguments: tuple[Any, ...], seconds: float) -> bytes:
    """Return the pickled result or exception of a call."""
    try:
        result = run_with_time_limit(lambda _: function(*arguments), None, seconds)
        data = pickle.dumps((True, result))
    except MemoryError:
        os._exit(_OUT_OF_MEMORY)
    except BaseException as error:
        return _pickle_error(error)
    if len(data) > _MAX_RESULT_SIZE:
        os._exit(_OUT_OF_MEMORY)
    return data


def _pickle_error(error: BaseException) -> bytes:
    try:
        data = pickle.dumps((False, error))
        pickle.loads(data)
    except Exception:  # exceptions of other packages may fail in any manner
        return pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))
    return data


def _limit_resources(memory: int) -> None:
    limits = {"RLIMIT_DATA": memory, "RLIMIT_FSIZE": _MAX_FILE_SIZE, "RLIMIT_CORE": 0}
    for name, limit in limits.items():
        limit_resource(name, limit)
