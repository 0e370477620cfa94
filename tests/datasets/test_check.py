from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from vkc_pin.cli import main
from vkc_pin.datasets.check import check_dataset
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.episode import compute_scene_name
from vkc_pin.errors import InputError

h5py = pytest.importorskip("h5py")


@pytest.fixture
def copy(made: Dataset, tmp_path: Path) -> Path:
    shutil.copytree(made.folder, tmp_path / "copy")
    return tmp_path / "copy"


def get_shard(folder: Path) -> Path:
    return Dataset.open(folder).shards[0]


def test_valid_dataset_passes(copy: Path) -> None:
    found = check_dataset(copy)
    assert found.ok, found.lines()
    assert found.episodes == len(found.records) == 4
    assert "4 of 4 episodes are valid" in str(found)


def test_changed_motion_is_invalid(copy: Path) -> None:
    with h5py.File(get_shard(copy), "r+") as file:
        group = file["data/demo_2"]
        positions = group["motion/knot_positions"]
        positions[len(positions) // 2, 4] += 0.4
        number = int(group.attrs["number"])
    found = check_dataset(copy)
    assert not found.ok
    assert list(found.refused) == [number]
    assert str(number) in str(found)


def test_added_obstacle_makes_the_episode_invalid(copy: Path) -> None:
    """The check builds the scenes from the files: it does not believe what planning saw."""
    episode = next(Dataset.open(copy).episodes())
    middle = episode.trajectory.at(episode.trajectory.times[-1] / 2.0)
    document = json.loads(json.dumps(episode.document))
    box = {
        "name": "block",
        "type": "box",
        "size": [0.3, 0.3, 1.0],
        "position": [float(middle[0]), float(middle[1]), 0.5],
    }
    document["obstacles"].append(box)
    (copy / "scenes" / f"{compute_scene_name(document)}.json").write_text(json.dumps(document))
    with h5py.File(get_shard(copy), "r+") as file:
        file["data/demo_0"].attrs["scene"] = compute_scene_name(document)
    found = check_dataset(copy)
    assert list(found.refused) == [episode.number]
    assert "block" in found.refused[episode.number]


def test_repeated_episode_is_a_problem(copy: Path) -> None:
    with h5py.File(get_shard(copy), "r+") as file:
        numbers = [int(file[f"data/demo_{k}"].attrs["number"]) for k in range(4)]
        del file["data/demo_3"]
        file.copy("data/demo_1", "data/demo_3")
    found = check_dataset(copy)
    assert f"episode {numbers[1]} occurs 2 times" in found.problems
    assert any("episodes.csv" in problem for problem in found.problems)


def test_page_shows_statistics_and_pictures(copy: Path, tmp_path: Path) -> None:
    found = check_dataset(copy, page=tmp_path / "page.html", seed=3)
    assert found.page == tmp_path / "page.html"
    text = found.page.read_text(encoding="utf-8")
    for words in (
        "4 episodes",
        "given-open",
        "husky_ur5e",
        "Coverage",
        "Homotopy classes",
        "All of them are valid",
    ):
        assert words in text, words
    assert text.count("<figure>") == 4
    assert text.count("<svg") == 5
    assert "<script" not in text
    assert 'src="http' not in text
    assert text == check_dataset(copy, page=tmp_path / "again.html", seed=3).page.read_text(
        encoding="utf-8"
    )  # type: ignore[union-attr]


@pytest.mark.long
def test_jobs_do_not_affect_the_check(copy: Path) -> None:
    one, two = check_dataset(copy), check_dataset(copy, jobs=2)
    assert one.records == two.records


def test_other_folder_is_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the folder holds no dataset"):
        check_dataset(tmp_path)


def test_command_prints_the_result(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "check", str(copy), "--quiet"]) == 0
    assert "4 of 4 episodes are valid" in capsys.readouterr().out
    get_shard(copy).write_bytes(b"no")
    assert main(["dataset", "check", str(copy), "--quiet"]) == 1
    assert "not an HDF5 file" in capsys.readouterr().out
