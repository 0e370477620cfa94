from __future__ import annotations

import os

import numpy as np

from vkc_pin.utils.system import count_cores, measure_peak_memory, measure_resident_memory


def test_memory_is_in_megabytes() -> None:
    before = measure_resident_memory()
    block = np.ones(2**24)  # 128 MB
    now = measure_resident_memory()
    assert 100.0 < now - before < 160.0
    assert now - 16.0 < measure_peak_memory() < now + 4000.0
    assert block.nbytes == 2**27


def test_cores_are_those_of_this_process() -> None:
    assert 1 <= count_cores() <= (os.cpu_count() or 1)
