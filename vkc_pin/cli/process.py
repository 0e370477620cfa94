"""Runs `vkc-pin` as a process, and handles Ctrl-C and outputs that are closed or full.

Heavy modules are imported after the handler of Ctrl-C is installed.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn, TextIO

from vkc_pin.errors import BuildError
from vkc_pin.utils.optional_imports import explain_unfit_libraries

# exit codes
_MISUSE = 2
_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; `vkc-pin --help` lists them.

    Args:
        argv: Arguments. Default: those of the process. In this case, Ctrl-C ends the process
            silently unless the command handles it, and output that cannot be printed is dropped.
    """
    if argv is not None:
        from vkc_pin.cli.commands import run

        return run(argv)
    # Background processes of scripts ignore Ctrl-C.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _exit_at_once)
    _open_closed_streams()
    sys.stdout, printed = _make_tolerant(sys.stdout, 1)
    sys.stderr, _ = _make_tolerant(sys.stderr, 2)
    warnings.formatwarning = _format_warning
    try:
        with explain_unfit_libraries():
            from vkc_pin.cli.commands import run
        code = run(sys.argv[1:])
    except BuildError as error:
        sys.stderr.write(f"vkc-pin: {error}\n")
        code = _MISUSE
    except SystemExit as stop:  # --help, or invalid arguments
        code = int(stop.code or 0)
    if signal.getsignal(signal.SIGINT) is _exit_at_once:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # everything is done
    sys.stdout.flush()
    if printed.error is not None and printed.error.errno != errno.EPIPE:
        sys.stderr.write(f"vkc-pin: cannot print: {printed.error.strerror}\n")
        code = code or _MISUSE
    sys.stderr.flush()
    return code


def _format_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """Return the text of a warning; those about the user's files name no line of code."""
    where = "" if category is UserWarning else f"{filename}:{lineno}: {category.__name__}: "
    return f"vkc-pin: {where}{message}\n"


def _exit_at_once(number: int, frame: object) -> NoReturn:
    """Exit without exceptions, which imports may swallow; there is nothing to clean up."""
    os._exit(_INTERRUPTED)


def _open_closed_streams() -> None:
    """Open closed standard streams on the null device, so that no other file takes their number."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # The new file has the lowest free number.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115


class _TolerantFile(io.FileIO):
    """An output that drops data after its first error, `error`."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write, or drop the data."""
        if self.error is None:
            try:
                return super().write(data)
            except OSError as error:
                self.error = error
        return len(data)


def _make_tolerant(stream: TextIO | None, number: int) -> tuple[TextIO, _TolerantFile]:
    """Return a text stream like `stream` to which writing never fails, and its raw file."""
    raw = _TolerantFile(number, "w", closefd=False)
    if not isinstance(stream, io.TextIOWrapper):
        stream = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    tolerant = io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors="backslashreplace",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
    return tolerant, raw
