"""Owns the caches of planning calls."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Iterator

from vkc_pin.utils.arguments import check_instance, check_integer, check_number
from vkc_pin.utils.cache import Cache, CacheInfo


class Planner:
    """Owns the caches of planning: symbolic programs with their solvers, kinematics, shape tables.

    Pass one as `planner=` to separate or to bound the caches of parts of a program; without one,
    all calls share the process's own. Cached values make no difference to a trajectory. Threads may
    plan with one planner at once: each call acquires a cache of its own and releases it at the end.

    Args:
        entries: Largest number of cached objects.
        megabytes: Largest memory of all caches, as estimated [MB]. Running calls may exceed it.
    """

    def __init__(self, *, entries: int = 512, megabytes: float = 128.0) -> None:
        self.entries = check_integer(entries, "entries", low=1)
        self.megabytes = check_number(megabytes, "megabytes", "more than 0", low=0.0, strict=True)
        self._idle: list[Cache] = []
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        info = self.info()
        entries = f"{info.entries} of {self.entries} entries"
        return f"<Planner: {entries}, {info.nbytes / 1e6:.1f} of {self.megabytes:g} MB>"

    def info(self) -> CacheInfo:
        """Return entries, memory, hits and misses of all caches that no call uses at present."""
        with self._lock:
            return self._total()

    def _total(self) -> CacheInfo:
        every = [dataclasses.astuple(cache.info()) for cache in self._idle]
        return CacheInfo(*(sum(column) for column in zip(*every, strict=True)))

    def clear(self) -> None:
        """Evict everything; running calls keep their caches."""
        with self._lock:
            self._idle.clear()

    @contextlib.contextmanager
    def acquire(self) -> Iterator[Cache]:
        """Acquire a cache for exclusive use, the most recently used one; evict at the end."""
        with self._lock:
            new = (
                None
                if self._idle
                else Cache(max_entries=self.entries, max_nbytes=1e6 * self.megabytes)
            )
            cache = self._idle.pop() if new is None else new
        try:
            yield cache
        finally:
            cache.trim()
            with self._lock:
                self._idle.append(cache)
                while len(self._idle) > 1:  # the least recently used go first
                    total = self._total()
                    if total.entries <= self.entries and total.nbytes <= 1e6 * self.megabytes:
                        break
                    del self._idle[0]


_shared = Planner()


def acquire_cache(planner: Planner | None) -> contextlib.AbstractContextManager[Cache]:
    """Acquire a cache of a planner, or of the process's own; see `Planner.acquire`."""
    return (_shared if planner is None else check_instance(planner, Planner, "planner")).acquire()
