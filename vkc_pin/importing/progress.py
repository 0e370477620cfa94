"""Logs the progress of imports that take long."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")
_LOGGER = logging.getLogger(__name__)
_PATIENCE = 2.0  # [s] before the first and between all progress lines
_TRIANGLE_TIME = 4e-4  # [s] to cut a triangle, before any part of an import has been timed


class ImportProgress:
    """Logs the part at work, and the time left, every few seconds and before a long part.

    The time left is that of the parts so far for as many triangles: most of it goes into cutting
    meshes. Copies of a mesh count once.

    Args:
        work: Work of each part, in triangles to cut.
    """

    def __init__(self, work: Sequence[float]) -> None:
        self._work = list(work)
        self._done = 0
        self._began = time.perf_counter()
        self._shown = self._began

    def follow(self, parts: Iterable[T]) -> Iterator[T]:
        """Yield the next parts, which have a `name`, and count them."""
        for part in parts:
            self.begin(getattr(part, "name", ""))
            yield part
            self._done += 1

    def begin(self, name: str) -> None:
        """Log that a part begins if the last line was long ago, or will be when it ends."""
        now = time.perf_counter()
        done_work = sum(self._work[: self._done])
        pace = (now - self._began) / done_work if self._done else _TRIANGLE_TIME
        end = now + pace * self._work[self._done]
        if end - self._shown > _PATIENCE:
            self._shown = now
            seconds = pace * sum(self._work[self._done :])
            number = f"part {self._done + 1} of {len(self._work)}"
            _LOGGER.info("%s: %s, about %.0f s left", name, number, seconds)
