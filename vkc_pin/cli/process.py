"""The command `vkc-pin` as a process of its own: Ctrl-C, closed and full outputs. What it does is in `commands`.

It imports nothing of weight until Ctrl-C is taken care of.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
from collections.abc import Sequence
from typing import Any, NoReturn, TextIO

__all__ = ["main"]

_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; `vkc-pin --help` lists them.

    Args:
        argv: The command's words; nothing else is then changed in this process. None: those that
            the process was started with, which belongs to the command: Ctrl-C ends it at once and
            without a word, unless the command has a better idea, and what cannot be printed is no
            reason not to go on.
    """
    if argv is not None:
        from vkc_pin.cli.commands import run

        return run(argv)
    if (
        signal.getsignal(signal.SIGINT) is signal.default_int_handler
    ):  # else it is ignored, as behind "&" in scripts
        signal.signal(signal.SIGINT, _leave)
    _open_all()
    sys.stdout, printed = _forgiving(sys.stdout, 1)
    sys.stderr, _ = _forgiving(sys.stderr, 2)
    from vkc_pin.cli.commands import EXIT_MISUSE, run

    try:
        code = run(sys.argv[1:])
    except SystemExit as stop:  # of --help, or of words that make no sense
        code = int(stop.code or 0)
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done
    sys.stdout.flush()
    if printed.error is not None and printed.error.errno != errno.EPIPE:
        sys.stderr.write(f"vkc-pin: cannot print: {printed.error.strerror}\n")
        code = code or EXIT_MISUSE
    sys.stderr.flush()
    return code


def _leave(number: int, frame: object) -> NoReturn:
    """End at once: whatever is being imported or computed has nothing to clean up, and may swallow exceptions."""
    os._exit(_INTERRUPTED)


def _open_all() -> None:
    """Open what was closed of standard input, output and error on nothing, lest the next file that is opened takes its place."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(
                os.open(os.devnull, os.O_RDWR), True
            )  # the lowest number that is free
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115


class _Forgiving(io.FileIO):
    """An output that takes all it is given, whether or not it gets anywhere; `error` is the first reason why not."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write, or do as if."""
        if self.error is None:
            try:
                return super().write(data)
            except OSError as error:
                self.error = error
        return len(data)


def _forgiving(stream: TextIO | None, number: int) -> tuple[TextIO, _Forgiving]:
    """Return a text stream like `stream` on the file of that number which writing to never fails, and its raw file."""
    raw = _Forgiving(number, "w", closefd=False)
    like = (
        stream
        if isinstance(stream, io.TextIOWrapper)
        else io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    )
    how: dict[str, Any] = {
        name: getattr(like, name) for name in ("encoding", "line_buffering", "write_through")
    }
    return io.TextIOWrapper(io.BufferedWriter(raw), errors="backslashreplace", **how), raw
