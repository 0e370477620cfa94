from __future__ import annotations

from pathlib import Path

import pytest
from helpers.datasets import SMALL

from vkc_pin.datasets.episode import run_attempts
from vkc_pin.datasets.formats.hdf5 import make_parts, read_episodes, read_numbers, write_shard
from vkc_pin.datasets.recipe import load_recipe

pytest.importorskip("h5py")


@pytest.mark.long
def test_parts_of_attempts_form_a_shard(tmp_path: Path) -> None:
    document = load_recipe({**SMALL, "tasks": ["given-open"]}).document
    parts, attempts = make_parts((document, [0, 1], {})), run_attempts((document, [0, 1], {}))
    assert [record["success"] for record, _ in parts] == [True, True]
    for (record, data), (expected, _) in zip(parts, attempts, strict=True):
        assert {key: record[key] for key in ("number", "way", "scene", "evaluations")} == {
            key: expected[key] for key in ("number", "way", "scene", "evaluations")
        }
        (tmp_path / f"{record['number']}.hdf5").write_bytes(data)
    shard = write_shard(
        tmp_path / "shard.hdf5",
        [(tmp_path / f"{number}.hdf5", 0) for number in (1, 0)],
        tmp_path / "scenes",
    )
    assert read_numbers(shard) == [1, 0]
    assert all(episode.validate().ok for episode in read_episodes(shard, tmp_path / "scenes"))


def test_failures_have_no_data(tmp_path: Path) -> None:
    document = load_recipe(
        {**SMALL, "tasks": ["drive-open"], "start": {"distance": [90.0, 91.0]}}
    ).document
    ((record, data),) = make_parts((document, [0], {}))
    assert (record["success"], data) == (False, b"")
