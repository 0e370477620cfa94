"""Caches keep what was used last, within bounds, and planners lend each plan one of its own."""

from __future__ import annotations

import platform
import resource
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.utils.cache import Cache, CacheInfo


def sized(nbytes: int) -> Any:
    return SimpleNamespace(nbytes=nbytes)


@given(st.lists(st.integers(0, 9)), st.integers(1, 5))
def test_the_last_used_are_kept(asked: list[int], entries: int) -> None:
    cache, kept, built = Cache(max_entries=entries), list[int](), list[int]()
    for key in asked:

        def build(key: int = key) -> Any:
            built.append(key)
            return sized(key)

        before = len(built)
        assert cache.get(("number", key), build).nbytes == key
        assert (len(built) > before) == (key not in kept)
        kept = [*(other for other in kept if other != key), key][-entries:]
    info = cache.info()
    assert info.entries == len(kept)
    assert info.nbytes == sum(kept)
    assert info.misses == len(built)
    assert info.hits == len(asked) - len(built)


def test_what_begins_alike_can_be_dropped() -> None:
    cache = Cache()
    for key in [
        ("program", 1),
        ("solver", 1, "a"),
        ("solver", 1, "b"),
        ("solver", 2, "a"),
        "solver",
    ]:
        cache.get(key, lambda: sized(1))
    cache.evict("solver", 1)
    assert list(cache._objects) == [("program", 1), ("solver", 2, "a"), "solver"]


@given(st.lists(st.integers(0, 100), min_size=1, unique=True), st.integers(0, 300))
def test_trimming_lets_go_of_the_oldest_until_it_fits(sizes: list[int], nbytes: int) -> None:
    cache = Cache(max_nbytes=nbytes)
    for size in sizes:
        cache.get(size, lambda size=size: sized(size))
    cache.trim()
    left = cache.info()
    expected = next(
        sizes[k:] for k in range(len(sizes)) if sum(sizes[k:]) <= nbytes or k == len(sizes) - 1
    )
    assert (left.entries, left.nbytes) == (len(expected), sum(expected))


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc",
    reason="other C libraries give memory back by themselves, or never",
)
def test_trimming_gives_memory_back() -> None:
    """Also what lies between blocks that are still in use: otherwise a process grows with every structure that it meets."""
    cache, between = Cache(max_nbytes=1.0), []
    for key in range(20):
        blocks = []
        for _ in range(100):
            blocks.append(np.ones(7500))  # 60 kB: too small for pages of their own
            between.append(np.ones(30))
        cache.get(key, lambda blocks=blocks: SimpleNamespace(nbytes=6_000_000, blocks=blocks))
    del blocks
    before = resident()
    cache.trim()
    assert cache.info().entries == 1
    assert before - resident() > 0.8 * 19 * 6.0
    assert len(between) == 2000


def resident() -> float:
    """Return how much memory this process has [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def test_what_failed_to_be_built_is_not_kept() -> None:
    cache = Cache()
    with pytest.raises(ZeroDivisionError):
        cache.get("bad", lambda: 1 // 0)
    assert cache.info().entries == 0
    assert cache.get("bad", lambda: sized(3)).nbytes == 3


def test_the_time_of_parts_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(100))
    monkeypatch.setattr("vkc_pin.utils.cache.time.perf_counter", lambda: float(next(clock)))
    cache = Cache()
    cache.get("whole", lambda: (cache.get("part", lambda: sized(1)), sized(2))[1])
    assert (
        cache.build_time == 2.0
    )  # the clock is looked at when either begins, and when the whole ends


def test_a_planner_lends_each_a_cache_of_its_own() -> None:
    planner, met, seen = vkc.Planner(), threading.Barrier(2, timeout=30), list[Cache]()

    def borrow() -> None:
        with planner.acquire() as cache:
            seen.append(cache)
            cache.get(threading.get_ident(), lambda: sized(5))
            met.wait()

    threads = [threading.Thread(target=borrow) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(map(id, seen))) == 2
    assert planner.info() == CacheInfo(entries=2, nbytes=10, hits=0, misses=2)
    with planner.acquire() as again:
        assert any(again is cache for cache in seen)
    assert planner.info().entries == 2


def test_a_planner_stays_within_its_bounds() -> None:
    planner = vkc.Planner(entries=2, megabytes=1e-5)  # ten bytes
    with planner.acquire() as first, planner.acquire() as second:
        for cache in (first, second):
            for key in range(3):
                cache.get(key, lambda: sized(4))
    assert planner.info().entries == 2
    assert planner.info().nbytes == 8
    with planner.acquire() as cache:
        cache.get("large", lambda: sized(9))
    assert (planner.info().entries, planner.info().nbytes) == (1, 9)
    planner.clear()
    assert planner.info() == CacheInfo()
    assert repr(planner) == "<Planner: 0 of 2 entries, 0.0 of 1e-05 MB>"


def test_a_plan_that_raises_gives_its_cache_back() -> None:
    planner = vkc.Planner()
    with planner.acquire() as cache:
        cache.get("kept", lambda: sized(1))
    with pytest.raises(ZeroDivisionError), planner.acquire() as again:
        again.get("bad", lambda: sized(1 // 0))
    assert again is cache
    assert planner.info().entries == 1


@pytest.mark.parametrize(
    "wrong",
    [{"entries": 0}, {"entries": 2.5}, {"entries": True}, {"megabytes": 0}, {"megabytes": "1"}],
)
def test_misuse(wrong: dict[str, Any]) -> None:
    with pytest.raises(vkc.InputError, match=next(iter(wrong))):
        vkc.Planner(**wrong)
