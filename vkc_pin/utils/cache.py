"""Caches objects that planning builds once and uses again."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from vkc_pin.utils.budget import record_evaluations
from vkc_pin.utils.system import release_freed_memory

T = TypeVar("T")

_FIRST_CHECK_TIME = 2e-3  # [s]


@dataclass(frozen=True)
class CacheInfo:
    """Contents and use of a cache.

    Attributes:
        entries: Number of cached objects.
        nbytes: Their estimated size in memory [bytes].
        hits: Requests that found an object.
        misses: Requests that built one.
    """

    entries: int = 0
    nbytes: int = 0
    hits: int = 0
    misses: int = 0


class Cache:
    """Least-recently-used cache of objects that are determined by their key.

    One thread at a time may use it: cached objects may have buffers.

    Args:
        max_entries: Largest number of objects.
        max_nbytes: Largest memory [bytes], by the objects' own estimate `nbytes`. The object used
            last stays in any case.

    Attributes:
        build_time: Time spent on building so far [s].
        check_time: Time that the last validation took per waypoint [s], which tells how much time
            to reserve for the next; at first rather too much.
    """

    def __init__(self, *, max_entries: int = 512, max_nbytes: float = 2.0**30) -> None:
        self.max_entries = max_entries
        self.max_nbytes = max_nbytes
        self.build_time = 0.0
        self.check_time = _FIRST_CHECK_TIME
        self._objects: OrderedDict[Hashable, Any] = OrderedDict()
        self._hits = 0
        self._misses = 0
        self._depth = 0  # number of objects being built, each as a part of the one before

    def get(self, key: Hashable, build: Callable[[], T]) -> T:
        """Return the object of `key`, which is built if it is not cached.

        Args:
            key: Kind of object, then everything that it depends on.
            build: Builds the object; it may ask this cache for parts.

        Raises:
            BudgetExhaustedError: The object is not cached, and the budget is exhausted.
        """
        if key in self._objects:
            self._hits += 1
        else:
            record_evaluations()
            self._misses += 1
            began = time.perf_counter()
            self._depth += 1
            try:
                self._objects[key] = build()
            finally:
                self._depth -= 1
                # The time of the whole includes that of its parts.
                if self._depth == 0:
                    self.build_time += time.perf_counter() - began
        self._objects.move_to_end(key)
        value = cast(T, self._objects[key])
        while len(self._objects) > self.max_entries:
            self._objects.popitem(last=False)
        return value

    def evict(self, *prefix: Hashable) -> None:
        """Evict all objects whose key starts with `prefix`."""
        for key in list(self._objects):
            if isinstance(key, tuple) and key[: len(prefix)] == prefix:
                del self._objects[key]

    def trim(self) -> None:
        """Evict objects beyond `max_nbytes`, and release their memory: objects grow in use."""
        total = self.info().nbytes
        if total <= self.max_nbytes:
            return
        while total > self.max_nbytes and len(self._objects) > 1:
            _, oldest = self._objects.popitem(last=False)
            total -= int(oldest.nbytes)
        release_freed_memory()

    def info(self) -> CacheInfo:
        """Return the contents and use of the cache."""
        nbytes = sum(int(value.nbytes) for value in self._objects.values())
        return CacheInfo(len(self._objects), nbytes, self._hits, self._misses)
