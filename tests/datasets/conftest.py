"""Provides a dataset that the tests share and must not modify."""

from __future__ import annotations

import pytest
from helpers.datasets import SMALL

from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generation import generate


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Return a dataset of four episodes in both layouts."""
    pytest.importorskip("h5py")
    pytest.importorskip("pyarrow")
    return generate(SMALL, 4, tmp_path_factory.mktemp("made") / "out", lerobot=True)
