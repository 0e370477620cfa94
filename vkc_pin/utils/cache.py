"""Cache: what planning builds once and can use again, kept as long as there is room."""

from __future__ import annotations

import contextlib
import ctypes
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from vkc_pin.utils.budget import spend

__all__ = ["Cache", "CacheInfo"]

T = TypeVar("T")


@dataclass(frozen=True)
class CacheInfo:
    """How full a cache is, and what it was good for.

    Attributes:
        entries: Number of objects kept.
        nbytes: Their size in memory, estimated [bytes].
        hits: How often something was there when it was asked for.
        misses: How often it had to be built.
    """

    entries: int = 0
    nbytes: int = 0
    hits: int = 0
    misses: int = 0


class Cache:
    """Keeps what was built, by key; what was used longest ago goes first.

    What is kept depends on its key alone, so that it makes no difference to a result whether it was
    there. For one thread at a time: what is kept may have buffers of its own.

    Args:
        entries: How many objects are kept at most.
        nbytes: How much memory they take at most [bytes], by each object's own estimate `nbytes`;
            the one that was used last is kept in any case.

    Attributes:
        building: Time spent on building so far [s].
    """

    def __init__(self, *, entries: int = 512, nbytes: float = 2.0**30) -> None:
        self.entries, self.nbytes, self.building = entries, nbytes, 0.0
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()
        self._hits = self._misses = self._depth = 0

    def get(self, key: Hashable, build: Callable[[], T]) -> T:
        """Return what is kept under `key`, built if it is not there.

        Args:
            key: All that the result depends on, after the name of its kind.
            build: Makes it; it may ask this cache for parts.

        Raises:
            SpentError: It is not there, and the budget is at its end.
        """
        if key in self._kept:
            self._hits += 1
        else:
            spend()
            self._misses += 1
            began, self._depth = time.perf_counter(), self._depth + 1
            try:
                self._kept[key] = build()
            finally:
                self._depth -= 1
                if not self._depth:  # parts are built within the time of the whole
                    self.building += time.perf_counter() - began
        self._kept.move_to_end(key)
        value = cast(T, self._kept[key])
        while len(self._kept) > self.entries:
            self._kept.popitem(last=False)
        return value

    def drop(self, *beginning: Hashable) -> None:
        """Let go of what is kept under keys that begin like this."""
        for key in [
            key
            for key in self._kept
            if isinstance(key, tuple) and key[: len(beginning)] == beginning
        ]:
            del self._kept[key]

    def trim(self) -> None:
        """Let go of what there is no room for, and give its memory back: objects grow while they are used."""
        total = self.info().nbytes
        if total <= self.nbytes:
            return
        while total > self.nbytes and len(self._kept) > 1:
            total -= int(self._kept.popitem(last=False)[1].nbytes)
        _give_back()

    def info(self) -> CacheInfo:
        """Return how full it is."""
        return CacheInfo(
            len(self._kept),
            sum(int(value.nbytes) for value in self._kept.values()),
            self._hits,
            self._misses,
        )


def _give_back() -> None:
    """Give freed memory back to the system: glibc keeps what lies between blocks that are in use, ever more of it."""
    with contextlib.suppress(
        AttributeError, OSError, TypeError
    ):  # other C libraries have no such call
        ctypes.CDLL(None).malloc_trim(0)
