from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from helpers.datasets import SMALL

from tests.episodes.__main__ import main
from tests.episodes.judged import VERDICTS, judge_dataset
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generation import generate

h5py = pytest.importorskip("h5py")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return generate(SMALL, 2, tmp_path_factory.mktemp("judged") / "out")


def test_each_episode_is_judged_once(dataset: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(dataset.folder)]) == 0
    assert "2 plans" in capsys.readouterr().out
    saved = (dataset.folder / VERDICTS).read_text(encoding="utf-8")
    assert [len(json.loads(line)["verdicts"]) for line in saved.splitlines()] == [2]
    assert [verdict.found for verdict in judge_dataset(dataset.folder)] == [[], []]
    assert (dataset.folder / VERDICTS).read_text(encoding="utf-8") == saved, (
        "no episode is judged twice"
    )


def test_changed_motion_is_judged_invalid(dataset: Dataset, tmp_path: Path) -> None:
    shutil.copytree(dataset.folder, tmp_path / "copy")
    (tmp_path / "copy" / VERDICTS).unlink(missing_ok=True)
    (shard,) = Dataset.open(tmp_path / "copy").shards
    with h5py.File(shard, "r+") as file:
        positions = file["data/demo_1/motion/knot_positions"]
        positions[len(positions) // 2, 4] += 0.4
    good, changed = judge_dataset(tmp_path / "copy")
    assert not good.found
    assert {one.rule for one in changed.found} & {
        "velocity",
        "acceleration",
        "closure",
        "collision",
        "apart",
        "penetration",
    }
    assert main([str(tmp_path / "copy")]) == 1
