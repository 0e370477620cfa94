from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.shards import (
    Change,
    bend_motion,
    change_demo,
    replace_array,
    set_array,
    set_attribute,
    set_description,
)

from vkc_pin.cli import main
from vkc_pin.datasets.check import check_dataset, check_lerobot, check_shard
from vkc_pin.datasets.dataset import Dataset, read_table
from vkc_pin.datasets.episode import compute_scene_name
from vkc_pin.errors import InputError

h5py = pytest.importorskip("h5py")


def test_changed_motion_is_invalid(copy: Path, shard: Path) -> None:
    number = change_demo(shard, bend_motion, 2)
    found = check_dataset(copy)
    assert not found.ok
    assert list(found.refused) == [number]
    assert str(number) in str(found)


def replace_first_scene(folder: Path, document: dict[str, Any]) -> None:
    """Replace the scene of the first episode."""
    name = compute_scene_name(document)
    (folder / "scenes" / f"{name}.json").write_text(json.dumps(document))
    change_demo(Dataset.open(folder).shards[0], set_attribute("scene", name))


@pytest.mark.long
def test_added_obstacle_makes_the_episode_invalid(copy: Path) -> None:
    """The check builds the scene from its file and does not rely on the planner."""
    episode = next(Dataset.open(copy).episodes())
    middle = episode.trajectory.at(episode.trajectory.times[-1] / 2.0)
    box = {"name": "block", "type": "box", "size": [0.3, 0.3, 1.0]}
    box["position"] = [*middle[:2].tolist(), 0.5]
    document = {**episode.document, "obstacles": [*episode.document["obstacles"], box]}
    replace_first_scene(copy, document)
    found = check_dataset(copy)
    assert list(found.refused) == [episode.number]
    assert "block" in found.refused[episode.number]


def test_episode_without_a_scene_is_reported_once(copy: Path) -> None:
    episode = next(Dataset.open(copy).episodes())
    replace_first_scene(copy, {**episode.document, "robot": {"name": "missing.yaml"}})
    found = check_dataset(copy)
    assert list(found.refused) == [episode.number]
    assert "missing.yaml" in found.refused[episode.number]
    assert not found.problems


def test_unreadable_episode_is_reported_once(copy: Path, shard: Path) -> None:
    change_demo(shard, lambda demo: demo.pop("motion"), 1)
    found = [text for text in check_dataset(copy).problems if "demo_1/motion: missing" in text]
    assert len(found) == 1


def test_repeated_episode_is_reported(copy: Path, shard: Path) -> None:
    with h5py.File(shard, "r+") as file:
        number = int(file["data/demo_1"].attrs["number"])
        del file["data/demo_3"]
        file.copy("data/demo_1", "data/demo_3")
    found = check_dataset(copy)
    assert f"episode {number} occurs 2 times" in found.problems
    assert any("episodes.csv" in problem for problem in found.problems)


DEMO_CHANGES = [
    (set_array("actions", np.nan, (3, 2)), "actions[3, 2] is nan"),
    (set_array("states", 1e-3, (0, 5)), "states[0, 5] is 0.001"),
    (set_array("obs/base_pose", np.inf, (1, 0)), "obs/base_pose[1, 0] is inf"),
    (set_array("obs/holding", 0.5, (2, 0)), "obs/holding[2, 0] is 0.5"),
    (set_array("obs/gripper", -1.0, (-1, 0)), "obs/gripper["),
    (set_array("rewards", 1.0), "rewards[0] is 1"),
    (set_array("dones", 1, 4), "dones[4] is 1"),
    (lambda demo: demo["obs"].move("arm_position", "x"), "obs: there is no member of data/demo_"),
    (lambda demo: demo.pop("states"), "states: missing"),
    (lambda demo: demo.create_dataset("next", data=[1.0]), "there is no member of data/demo_"),
    (replace_array("actions", lambda a: a[:-1]), "actions: wrong shape"),
    (replace_array("obs/gripper", lambda a: a[:, 0]), "gripper: wrong shape"),
    (set_attribute("num_samples", 1), "num_samples is 1, not"),
    (set_attribute("task", "drive-open"), "task is 'drive-open', not 'given-open'"),
    (set_description("about", "task", value="drive-open"), "about.task is 'drive-open'"),
    (set_description("about", "robot", value="tiago"), "about.robot is 'tiago', not 'husky_ur5e'"),
    (set_description("about", "goal", value=3.0), "about.goal is 3.0, not"),
    (set_description("about", "instruction", value="x"), "about.instruction is 'x', not None"),
    (set_description("about", "metrics", value={"duration": 1.0}), "about.metrics.duration is 1.0"),
    (set_description("about", "metrics", value=[]), "about.metrics are []"),
    (set_description("validation", "clearance", value=9.0), "clearance 9 m instead of"),
    (set_description("steps", value=[]), "steps of no task"),
]
"""Modifications of a demo, each with part of the expected message."""


@pytest.mark.parametrize("first", range(0, len(DEMO_CHANGES), 4))
def test_modified_samples_and_metadata_are_reported(copy: Path, shard: Path, first: int) -> None:
    changes = DEMO_CHANGES[first : first + 4]
    numbers = [change_demo(shard, change, k) for k, (change, _) in enumerate(changes)]
    records, problems = check_copy(copy)
    reasons = {record["number"]: record["refused"] for record in records}
    for number, (_, expected) in zip(numbers, changes, strict=True):
        found = [*problems, reasons.get(number, "")]
        assert any(expected in text for text in found), (expected, found)
    assert len(records) + sum(f"demo_{k}" in text for text in problems for k in range(4)) == 4


def check_copy(copy: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Check the shard of a copy, and return its records and problems."""
    dataset = Dataset.open(copy)
    return check_shard((str(dataset.shards[0]), str(copy / "scenes"), dataset.recipe.document))


def test_samples_of_another_episode_are_rejected(copy: Path, shard: Path) -> None:
    with h5py.File(shard, "r+") as file:
        for part in ("obs", "actions", "states", "rewards", "dones"):
            file.move(f"data/demo_0/{part}", "data/x")
            file.move(f"data/demo_1/{part}", f"data/demo_0/{part}")
            file.move("data/x", f"data/demo_1/{part}")
    found = check_dataset(copy)
    texts = [*found.refused.values(), *found.problems]
    assert sum("obs/base_pose" in text for text in texts) == 2


def swap_demos(file: Any) -> None:
    file.move("data/demo_0", "x")
    file.move("data/demo_1", "data/demo_0")
    file.move("x", "data/demo_1")


def set_mask(file: Any) -> None:
    del file["mask/train"]
    file["mask/train"] = np.array(["demo_0", "demo_0"], "S")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (swap_demos, "not in order"),
        (lambda file: set_attribute("total", 1)(file["data"]), "total is 1"),
        (lambda file: set_attribute("env_args", "{}")(file["data"]), "env_args is {}"),
        (lambda file: set_attribute("options", '{"dt": 0.1}')(file["data"]), "options is"),
        (lambda file: file.pop("mask"), "mask: missing"),
        (lambda file: file.pop("mask/valid"), "mask/valid: missing"),
        (set_mask, "mask/train is ['demo_0', 'demo_0']"),
        (lambda file: file.create_group("mask/test"), "there is no member of mask 'test'"),
        (lambda file: file.create_group("extra"), "there is no member of a shard 'extra'"),
    ],
)
def test_modified_shard_metadata_is_reported(
    copy: Path, shard: Path, change: Change, expected: str
) -> None:
    assert check_copy(copy)[1] == []
    with h5py.File(shard, "r+") as file:
        change(file)
    assert expected in "".join(check_copy(copy)[1])


@pytest.mark.long
def test_damaged_files_do_not_abort_the_check(copy: Path, shard: Path) -> None:
    other = copy / "shards" / "tiago" / "shard-00000.hdf5"
    other.parent.mkdir()
    other.write_bytes(shard.read_bytes()[:5000])
    (copy / "episodes.csv").write_bytes(b"number\n\xff\n")
    (copy / "failures.csv").write_text("number,task\nx\n")
    found = check_dataset(copy)
    assert (found.episodes, dict(found.refused)) == (4, {})
    for text in ("shard-00000.hdf5: not an HDF5 file", "episodes.csv", "failures.csv"):
        assert any(text in problem for problem in found.problems), text
    assert any(problem.startswith("lerobot/tiago: missing") for problem in found.problems)


def test_modified_episode_table_is_reported(copy: Path) -> None:
    with (copy / "episodes.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    changes = {"task": "fetch-place", "goal": "9", "duration": "nan", "scene": "0"}
    for row, (column, value) in zip(rows, changes.items(), strict=True):
        row[column] = value
    with (copy / "episodes.csv").open("w", newline="") as stream:
        table = csv.DictWriter(stream, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    shutil.rmtree(copy / "lerobot")
    found = check_dataset(copy)
    assert not found.refused
    for column, problem in zip(changes, found.problems, strict=True):
        assert problem.startswith(f"episodes.csv: {column} of episode ")


def test_damaged_table_error_names_the_file(dataset: Dataset, tmp_path: Path) -> None:
    header = (dataset.folder / "episodes.csv").read_text().splitlines()[0]
    file = tmp_path / "table.csv"
    file.write_text(header)
    assert read_table(file) == []
    for text in ("", "number\n1\n", '"', "\x00", f"{header}\n1\n", f"{header}\nx{',' * 20}\n"):
        file.write_text(text)
        with pytest.raises(InputError) as caught:
            read_table(file)
        assert caught.value.file == file


FRAMES = "data/chunk-000/file-000.parquet"


def change_column(name: str, value: Any) -> Callable[[Path], None]:
    """Return a function that modifies a column in the first frame of the second episode."""
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")

    def change(folder: Path) -> None:
        file = folder / FRAMES
        with parquet.ParquetFile(file) as opened:
            tables = [opened.read_row_group(k) for k in range(opened.num_row_groups)]
        rows = tables[1].to_pylist()
        if isinstance(rows[0][name], list):
            rows[0][name][0] = value
        else:
            rows[0][name] = value
        tables[1] = arrow.Table.from_pylist(rows, schema=tables[1].schema)
        with parquet.ParquetWriter(file, tables[0].schema) as writer:
            for table in tables:
                writer.write_table(table)

    return change


def change_json(name: str, field: str, value: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        file = folder / "meta" / name
        file.write_text(json.dumps({**json.loads(file.read_text()), field: value}))

    return change


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (change_column("action", 7.0), "row group 1: action: 7.0, not"),
        (change_column("observation.state", float("nan")), "observation.state: nan, not"),
        (change_column("task_index", 1), "task_index: 1, not 0"),
        (change_column("episode_index", 0), "episode_index: 0, not 1"),
        (change_json("info.json", "fps", 5), "info.json: 5, not 10"),
        (change_json("stats.json", "action", {}), "stats.json: the fields [], not"),
        (lambda folder: (folder / "meta/tasks.parquet").unlink(), "there is no such file"),
        (lambda folder: (folder / FRAMES).write_bytes(b"x"), "damaged"),
        (
            lambda folder: shutil.copy(folder / "meta/tasks.parquet", folder / FRAMES),
            "other columns or sizes",
        ),
        (lambda folder: (folder / "data/more.parquet").write_bytes(b"x"), "an unknown file"),
    ],
)
def test_modified_lerobot_files_are_reported(
    copy: Path, change: Callable[[Path], None], expected: str
) -> None:
    change(copy / "lerobot" / "husky_ur5e")
    found = check_lerobot((str(copy), "husky_ur5e"))
    assert any(expected in problem for problem in found), found


def rewrite_as_older(folder: Path, *, but: str = "") -> None:
    """Remove what older files lack: quantiles, but of a feature, and descriptions of columns."""
    parquet = pytest.importorskip("pyarrow.parquet")
    names = ("q01", "q10", "q50", "q90", "q99")
    file = folder / FRAMES
    with parquet.ParquetFile(file) as opened:
        tables = [opened.read_row_group(k) for k in range(opened.num_row_groups)]
    with parquet.ParquetWriter(file, tables[0].schema.remove_metadata()) as writer:
        for table in tables:
            writer.write_table(table.replace_schema_metadata(None))
    file = folder / "meta/episodes/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    is_new = [name.endswith(names) and name != f"stats/{but}/q50" for name in table.column_names]
    old = [name for name, new in zip(table.column_names, is_new, strict=True) if not new]
    parquet.write_table(table.select(old), file)
    file = folder / "meta/stats.json"
    stats = json.loads(file.read_text())
    for feature, own in stats.items():
        for name in names:
            if feature != but:
                del own[name]
    file.write_text(json.dumps(stats))


def test_older_lerobot_files_pass(copy: Path) -> None:
    rewrite_as_older(copy / "lerobot" / "husky_ur5e")
    assert check_lerobot((str(copy), "husky_ur5e")) == []


def test_quantiles_of_some_features_only_are_reported(copy: Path) -> None:
    rewrite_as_older(copy / "lerobot" / "husky_ur5e", but="action")
    problems = check_lerobot((str(copy), "husky_ur5e"))
    assert any("other columns" in problem for problem in problems), problems


def describe_columns_wrongly(folder: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    file = folder / FRAMES
    with parquet.ParquetFile(file) as opened:
        tables = [opened.read_row_group(k) for k in range(opened.num_row_groups)]
    wrong = {"huggingface": '{"info": {"features": {}}}'}
    tables = [table.replace_schema_metadata(wrong) for table in tables]
    with parquet.ParquetWriter(file, tables[0].schema) as writer:
        for table in tables:
            writer.write_table(table)


def change_quantile(folder: Path, bins: float = 5.0) -> None:
    file = folder / "meta/stats.json"
    stats = json.loads(file.read_text())
    own = stats["observation.state"]
    own["q99"][0] += bins / 5000.0 * np.max(np.subtract(own["max"], own["min"]))
    file.write_text(json.dumps(stats))


def test_quantiles_of_another_machine_pass(copy: Path) -> None:
    """A value that is rounded differently may be in the next bin of a histogram."""
    change_quantile(copy / "lerobot" / "husky_ur5e", 1.0)
    assert check_lerobot((str(copy), "husky_ur5e")) == []


@pytest.mark.parametrize(
    ("change", "expected"),
    [(describe_columns_wrongly, "huggingface: the fields"), (change_quantile, "stats.json: ")],
)
def test_wrong_descriptions_and_quantiles_are_reported(
    copy: Path, change: Callable[[Path], None], expected: str
) -> None:
    change(copy / "lerobot" / "husky_ur5e")
    problems = check_lerobot((str(copy), "husky_ur5e"))
    assert any(expected in problem for problem in problems), problems


def test_valid_dataset_passes_and_its_page_reports_success(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = check_dataset(copy, page=tmp_path / "page.html", seed=3)
    assert found.ok, found.lines()
    assert found.episodes == len(found.records) == 4
    assert "4 of 4 episodes are valid" in str(found)
    assert found.page == tmp_path / "page.html"
    text = found.page.read_text(encoding="utf-8")
    for words in ("4 episodes", "given-open", "husky_ur5e", "Coverage", "All of them are valid"):
        assert words in text, words
    assert text.count("<figure>") == 4
    assert text.count("<svg") == 5
    assert "<script" not in text
    assert 'src="http' not in text
    second_page = tmp_path / "again.html"
    command = ["dataset", "check", str(copy), "--quiet", "--html", str(second_page), "--seed", "3"]
    assert main(command) == 0
    assert "4 of 4 episodes are valid" in capsys.readouterr().out
    assert second_page.read_text(encoding="utf-8") == text


@pytest.mark.long
def test_jobs_do_not_affect_the_check(copy: Path) -> None:
    serial, parallel = check_dataset(copy), check_dataset(copy, jobs=2)
    assert serial.records == parallel.records


@pytest.mark.parametrize("name", ["recipe.yaml", "shards/husky_ur5e/shard-00000.hdf5"])
def test_page_does_not_replace_files_of_the_dataset(dataset: Dataset, name: str) -> None:
    before = (dataset.folder / name).read_bytes()
    with pytest.raises(InputError, match="page: a file of the dataset"):
        check_dataset(dataset.folder, page=dataset.folder / name)
    assert (dataset.folder / name).read_bytes() == before


def test_folder_without_a_dataset_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the folder holds no dataset"):
        check_dataset(tmp_path)


def test_command_prints_problems(
    copy: Path, shard: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shard.write_bytes(b"no")
    assert main(["dataset", "check", str(copy), "--quiet"]) == 1
    assert "not an HDF5 file" in capsys.readouterr().out
