"""Defines results of commands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass
class Result:
    """Exit code and outputs of a command."""

    code: int
    out: str
    err: str


RunCommand = Callable[[str], Result]
"""Runs a command, given as words separated by spaces."""
