"""Provides a dataset that the tests share and must not modify, and copies of it."""

from __future__ import annotations

import shutil
from pathlib import Path

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


@pytest.fixture
def copy(dataset: Dataset, tmp_path: Path) -> Path:
    """Return the folder of a copy of the dataset."""
    return Path(shutil.copytree(dataset.folder, tmp_path / "copy"))


@pytest.fixture
def shard(copy: Path) -> Path:
    """Return the only shard of a copy of the dataset."""
    return Dataset.open(copy).shards[0]
