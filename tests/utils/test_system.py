from __future__ import annotations

import numpy as np
import pytest

from vkc_pin.utils.arrays import find_unique_rows
from vkc_pin.utils.system import measure_peak_memory, measure_resident_memory


def test_memory_is_in_megabytes() -> None:
    before = measure_resident_memory()
    block = np.ones(2**24)  # 128 MB
    now = measure_resident_memory()
    assert 100.0 < now - before < 160.0
    assert now - 16.0 < measure_peak_memory() < now + 4000.0
    assert block.nbytes == 2**27


@pytest.mark.parametrize("shape", [(1, 3), (40, 2), (200, 3), (0, 3)])
@pytest.mark.parametrize("decimals", [0, 1])
def test_unique_rows_agree_with_numpy(shape: tuple[int, int], decimals: int) -> None:
    rows = np.random.default_rng(3).normal(size=shape).round(decimals)  # -0.0 equals 0.0
    first, group = find_unique_rows(rows)
    _, expected, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(first, expected)
    np.testing.assert_array_equal(group, inverse.reshape(-1))
