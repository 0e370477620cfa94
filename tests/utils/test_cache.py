"""Tests that caches keep the most recent objects within limits, one cache per plan."""

from __future__ import annotations

import platform
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.utils.cache import Cache, CacheInfo
from vkc_pin.utils.system import measure_resident_memory


def make_sized(nbytes: int) -> Any:
    return SimpleNamespace(nbytes=nbytes)


@given(st.lists(st.integers(0, 9)), st.integers(1, 5))
def test_the_most_recent_objects_are_kept(keys: list[int], max_entries: int) -> None:
    cache, expected, built = Cache(max_entries=max_entries), list[int](), list[int]()
    for key in keys:

        def build(key: int = key) -> Any:
            built.append(key)
            return make_sized(key)

        before = len(built)
        assert cache.get(("number", key), build).nbytes == key
        assert (len(built) > before) == (key not in expected)
        expected = [*(other for other in expected if other != key), key][-max_entries:]
    assert cache.info() == CacheInfo(
        entries=len(expected), nbytes=sum(expected), hits=len(keys) - len(built), misses=len(built)
    )


def test_objects_are_evicted_by_the_prefix_of_their_key() -> None:
    cache, keys = Cache(), [("solver", 1, "a"), ("solver", 1), ("solver", 2, "a"), "solver"]
    for key in keys:
        cache.get(key, lambda: make_sized(1))
    cache.evict("solver", 1)
    assert cache.info().entries == 2
    for key in keys[2:]:
        cache.get(key, lambda: 1 // 0)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps freed memory")
def test_trimming_releases_memory() -> None:
    """Memory between blocks in use is released too; otherwise the process would keep growing."""
    cache, between = Cache(max_nbytes=1.0), []
    for key in range(20):
        blocks = []
        for _ in range(100):
            blocks.append(np.ones(7500))  # 60 kB: too small for pages of their own
            between.append(np.ones(30))
        cache.get(key, lambda blocks=blocks: SimpleNamespace(nbytes=6_000_000, blocks=blocks))
    del blocks
    before = measure_resident_memory()
    cache.trim()
    assert cache.info().entries == 1
    assert before - measure_resident_memory() > 0.8 * 19 * 5.7
    assert len(between) == 2000


def test_build_time_includes_parts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(100))
    monkeypatch.setattr("vkc_pin.utils.cache.time.perf_counter", lambda: float(next(clock)))
    cache = Cache()
    cache.get("whole", lambda: (cache.get("part", lambda: make_sized(1)), make_sized(2))[1])
    assert cache.build_time == 2.0  # from reading 0 to 2; reading 1 is that of the part


def test_each_thread_acquires_its_own_cache() -> None:
    planner, barrier, caches = vkc.Planner(), threading.Barrier(2, timeout=30), list[Cache]()

    def acquire() -> None:
        with planner.acquire() as cache:
            caches.append(cache)
            cache.get(threading.get_ident(), lambda: make_sized(5))
            barrier.wait()

    threads = [threading.Thread(target=acquire) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(map(id, caches))) == 2
    assert planner.info() == CacheInfo(entries=2, nbytes=10, hits=0, misses=2)
    with pytest.raises(ZeroDivisionError), planner.acquire() as reused:
        reused.get("bad", lambda: make_sized(1 // 0))
    assert any(reused is cache for cache in caches)
    assert planner.info().entries == 2


@given(st.lists(st.integers(0, 100), min_size=1, unique=True), st.integers(0, 300))
def test_trimming_evicts_the_oldest_until_the_rest_fits(sizes: list[int], nbytes: int) -> None:
    cache = Cache(max_nbytes=nbytes)
    for size in sizes:
        cache.get(size, lambda size=size: make_sized(size))
    cache.trim()
    left = cache.info()
    expected = next(
        sizes[k:] for k in range(len(sizes)) if sum(sizes[k:]) <= nbytes or k == len(sizes) - 1
    )
    assert (left.entries, left.nbytes) == (len(expected), sum(expected))


def test_planners_keep_their_limits() -> None:
    planner = vkc.Planner(entries=2, megabytes=1e-5)  # ten bytes
    with planner.acquire() as first, planner.acquire() as second:
        for cache in (first, second):
            for key in range(3):
                cache.get(key, lambda: make_sized(4))
    assert planner.info().entries == 2
    assert planner.info().nbytes == 8
    with planner.acquire() as cache:
        cache.get("large", lambda: make_sized(9))
    assert (planner.info().entries, planner.info().nbytes) == (1, 9)
    planner.clear()
    assert planner.info() == CacheInfo()


@pytest.mark.parametrize(
    "wrong",
    [{"entries": 0}, {"entries": 2.5}, {"entries": True}, {"megabytes": 0}, {"megabytes": "1"}],
)
def test_invalid_limits_raise(wrong: dict[str, Any]) -> None:
    with pytest.raises(vkc.InputError, match=next(iter(wrong))):
        vkc.Planner(**wrong)
