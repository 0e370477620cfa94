from __future__ import annotations

import types

import numpy as np
import pytest

from vkc_pin import compiled
from vkc_pin.driving.grid import BaseGrid
from vkc_pin.driving.path import shortest_path
from vkc_pin.errors import BuildError


def a_path() -> object:
    grid = BaseGrid([], [], [], (-2.0, 2.0, -2.0, 2.0), 0.0, cells=9)
    return shortest_path(grid, [-1.0, -1.0, 0.0], np.array([[1.0, 1.0, 0.5]]))


def test_a_module_is_imported() -> None:
    assert compiled.compiled_module("vkc_pin.driving._driving").Paths


def test_a_module_that_is_missing_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> types.ModuleType:
        raise ImportError(f"no {name}")

    with monkeypatch.context() as patch:
        patch.setattr(compiled, "import_module", missing)
        with pytest.raises(BuildError, match=r"_driving cannot be imported \(no .*compiler.*pip install"):
            a_path()
    assert a_path() is not None
