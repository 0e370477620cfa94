"""Parses numbers of command lines, and reports interrupted commands."""

from __future__ import annotations

import argparse
import functools
import shlex
import sys
from collections.abc import Sequence

EXIT_OK = 0
EXIT_INTERRUPTED = 130


def parse_natural(text: str, least: int = 0) -> int:
    """Parse a whole number of at least `least`."""
    if not text.isdigit() or int(text) < least:
        raise argparse.ArgumentTypeError(
            f"expected a whole number of at least {least}, got {text!r}"
        )
    return int(text)


parse_positive = functools.partial(parse_natural, least=1)
"""Parses a whole number of at least 1."""


def report_interruption(command: Sequence[str], stop: KeyboardInterrupt) -> int:
    """Print how to resume an interrupted command; return its exit code.

    Args:
        command: Program and arguments.
        stop: The interruption; its text is also printed.
    """
    detail = f"; {stop}" if str(stop) else ""
    again = shlex.join(command)
    sys.stderr.write(f"\nvkc-pin: stopped{detail}. The same command resumes it:\n{again}\n")
    return EXIT_INTERRUPTED
