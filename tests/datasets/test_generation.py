from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.datasets import SMALL
from helpers.door_closers import replace_object_fields
from helpers.shards import change_demo

from vkc_pin.datasets.dataset import Dataset, Register
from vkc_pin.datasets.generation import generate
from vkc_pin.datasets.recipe import load_recipe
from vkc_pin.errors import InputError, UnknownNameError, VkcError
from vkc_pin.world.scene.scene import load_scene

pytest.importorskip("h5py")
EPISODES = 4


def read_contents(folder: Path) -> dict[str, bytes]:
    """Return the contents of shards, scenes and recipe, without records of the run."""
    files = [*folder.glob("shards/*/*"), *folder.glob("scenes/*"), folder / "recipe.yaml"]
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


def test_dataset_contains_the_first_successful_attempts(dataset: Dataset) -> None:
    numbers = dataset.numbers()
    journal = (dataset.folder / "journal.jsonl").read_text().splitlines()[1:]
    lines = [line for line in map(json.loads, journal) if "session" not in line]
    successful = sorted(int(line["key"]) for line in lines if line["records"][0]["success"])
    assert sorted(numbers) == successful[:EPISODES]
    assert len(set(numbers)) == EPISODES
    for name in ("README.md", "episodes.csv", "failures.csv", "recipe.yaml"):
        assert (dataset.folder / name).is_file()
    assert len((dataset.folder / "episodes.csv").read_text().splitlines()) == 1 + EPISODES


def test_episodes_are_valid_and_reach_their_goals(dataset: Dataset) -> None:
    starts = set()
    for episode in dataset.episodes():
        report = episode.validate()
        assert report.ok, report.lines()
        assert report.contradictions(episode.claimed) == []
        goal = episode.trajectory.column(f"{episode.about['object']}.{episode.about['joint']}")[-1]
        assert goal == pytest.approx(episode.about["goal"], abs=1e-3)
        assert episode.trajectory.phases[0].held  # grasped from the start
        starts.add(tuple(episode.trajectory.positions[0][:2]))
    assert len(starts) == EPISODES


@pytest.mark.long
def test_jobs_do_not_affect_the_dataset(dataset: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    other = generate(SMALL, EPISODES, tmp_path / "out", jobs=2)
    assert read_contents(other.folder) == read_contents(dataset.folder)


def test_finished_dataset_is_left_unchanged(dataset: Dataset) -> None:
    files = [file for file in dataset.folder.rglob("*") if file.is_file()]
    before = [file.read_bytes() for file in files]
    generate(SMALL, EPISODES, dataset.folder, lerobot=True)
    assert sorted(file for file in dataset.folder.rglob("*") if file.is_file()) == sorted(files)
    assert [file.read_bytes() for file in files] == before
    with pytest.raises(InputError, match="more episodes"):
        generate({**SMALL, "name": "other"}, EPISODES - 1, dataset.folder)
    assert [file.read_bytes() for file in files] == before


def test_leftovers_of_killed_runs_are_removed(dataset: Dataset, copy: Path) -> None:
    leftovers = [copy / name / f".vkc-pin-{'0' * 16}" for name in (".", "work", "lerobot")]
    for leftover in leftovers[:2]:
        leftover.write_text("{")
    (leftovers[2] / "husky_ur5e").mkdir(parents=True)
    (leftovers[2] / "husky_ur5e/info.json").write_text("{")
    generate(SMALL, EPISODES, copy, lerobot=True)
    assert not any(leftover.exists() for leftover in leftovers)
    assert read_contents(copy) == read_contents(dataset.folder)


@pytest.mark.long
def test_lerobot_layout_is_extended_with_its_dataset(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    for episodes, lerobot in ((1, True), (2, False)):
        generate(SMALL, episodes, tmp_path / "out", lerobot=lerobot)
    info = json.loads((tmp_path / "out/lerobot/husky_ur5e/meta/info.json").read_text())
    assert info["total_episodes"] == 2


@pytest.mark.parametrize(
    "removed", ["shards/*/*", "scenes/*", pytest.param("work/*", marks=pytest.mark.long)]
)
def test_dataset_is_extended_and_removed_files_are_recreated(
    dataset: Dataset, tmp_path: Path, removed: str
) -> None:
    generate(SMALL, 3, tmp_path / "out")
    before = (tmp_path / "out/journal.jsonl").read_text()
    for file in (tmp_path / "out").glob(removed):
        shutil.rmtree(file) if file.is_dir() else file.unlink()
    extended = generate(SMALL, EPISODES, tmp_path / "out").folder
    assert read_contents(extended) == read_contents(dataset.folder)
    assert (extended / "journal.jsonl").read_text().startswith(before)


@pytest.mark.filterwarnings("ignore:.*made again")
@pytest.mark.long
def test_damaged_files_are_recreated(dataset: Dataset, copy: Path, shard: Path) -> None:
    work_files = sorted((copy / "work").iterdir())
    for file, data in zip(work_files, (b"", b"x", work_files[2].read_bytes()[:2000]), strict=False):
        file.write_bytes(data)
    shard.write_bytes(shard.read_bytes()[:-100])
    next((copy / "scenes").iterdir()).write_text("{")
    with pytest.warns(UserWarning, match="damaged one .*; its episodes are made again"):
        generate(SMALL, EPISODES, copy, lerobot=True)
    assert read_contents(copy) == read_contents(dataset.folder)
    change_demo(shard, lambda demo: demo.pop("motion"), 2)  # then read from the work files
    generate(SMALL, EPISODES, copy, lerobot=True)
    assert read_contents(copy) == read_contents(dataset.folder)
    for file in [*copy.glob("work/*"), next(copy.glob("scenes/*"))]:
        file.unlink()
    generate(SMALL, EPISODES, copy, lerobot=True)
    assert read_contents(copy) == read_contents(dataset.folder)


def set_field(*path: Any, value: Any) -> Callable[[str], str]:
    """Return a function that sets a field of a line, or removes it if the value is `...`."""

    def change(line: str) -> str:
        data = inner = json.loads(line)
        for name in path[:-1]:
            inner = inner[name]
        if value is ...:
            del inner[path[-1]]
        else:
            inner[path[-1]] = value
        return json.dumps(data)

    return change


def repeat_record(line: str) -> str:
    data = json.loads(line)
    return json.dumps({**data, "records": 2 * data["records"]})


JOURNAL_DAMAGES: list[Callable[[str], str]] = [
    *(set_field("key", value=value) for value in ("abc", "01", "-1", None, "9" * 5000, 1)),
    *(set_field("records", value=value) for value in ([], [3], [{}], {"number": 1})),
    *(set_field("records", 0, "number", value=value) for value in (0, 1.5)),
    repeat_record,
    set_field("records", 0, "success", value="yes"),
    set_field("records", 0, "status", value=...),
    *(
        set_field("records", 0, "way", value=value)
        for value in ("x", [], [[0.0], [0.0, 1.0]], [[None]], ...)
    ),
    *(set_field("records", 0, "duration", value=value) for value in (-1.0, float("nan"))),
    set_field("records", 0, "scene", value=3),
    set_field("records", 0, "goal", value={"x": 1}),
    set_field("memory_mb", value="much"),
    set_field("seconds", value=...),
    set_field("process", value=3),
    *(lambda _, text=text: text for text in ("[" * 100_000, "{}", '"x"', "\x00", '{"session": 3}')),
]


@pytest.mark.parametrize("change", JOURNAL_DAMAGES)
def test_error_names_a_damaged_journal_line(
    dataset: Dataset, tmp_path: Path, change: Callable[[str], str]
) -> None:
    file = tmp_path / "out" / "journal.jsonl"
    file.parent.mkdir()
    lines = (dataset.folder / "journal.jsonl").read_text().splitlines()
    lines[3] = change(lines[3])
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError) as caught:
        generate(SMALL, EPISODES, file.parent)
    assert (caught.value.file, caught.value.line) == (file, 4)
    assert sorted(path.name for path in file.parent.iterdir()) == ["journal.jsonl"]


@pytest.mark.parametrize("name", ["work", "shards", "scenes", "robots", "lerobot"])
def test_error_names_a_file_in_place_of_a_folder(
    dataset: Dataset, tmp_path: Path, name: str
) -> None:
    shutil.copy(dataset.folder / "journal.jsonl", tmp_path)
    (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match="this is no folder") as caught:
        generate(SMALL, EPISODES, tmp_path)
    assert caught.value.file == tmp_path / name


@pytest.mark.long
def test_killed_generation_is_resumed(dataset: Dataset, tmp_path: Path) -> None:
    script = (
        f"from vkc_pin.datasets.generation import generate; generate({SMALL!r}, {EPISODES}, 'out')"
    )
    command = [sys.executable, "-c", script]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    file, deadline = tmp_path / "out/journal.jsonl", time.monotonic() + 120.0
    while not (file.exists() and file.read_bytes().count(b"\n") >= 4):
        assert time.monotonic() < deadline
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.01)
    process.kill()
    process.communicate(timeout=60)
    assert read_contents(generate(SMALL, EPISODES, tmp_path / "out").folder) == read_contents(
        dataset.folder
    )


def test_foreign_folders_and_different_recipes_are_rejected(
    dataset: Dataset, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.tex").write_text("x")
    with pytest.raises(InputError, match="the folder holds other files"):
        generate(SMALL, 1, tmp_path / "mine")
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["thesis.tex"]
    with pytest.raises(InputError, match="episodes"):
        generate(SMALL, 0, tmp_path / "new")
    with pytest.raises(InputError, match="run otherwise") as caught:
        generate({**SMALL, "max_evaluations": 7}, EPISODES, dataset.folder)
    assert caught.value.field == "recipe"
    with pytest.raises(UnknownNameError, match="did you mean 'random_oven'"):
        generate({**SMALL, "objects": ["random_ovens"]}, 1, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_generation_without_success_raises(tmp_path: Path) -> None:
    far = {**SMALL, "tasks": ["drive-open"], "start": {"distance": [90.0, 91.0]}}
    with pytest.raises(VkcError, match=r"attempts gave 0 of 1 episodes.*no free start"):
        generate(far, 1, tmp_path / "out")


def test_attempts_that_fail_in_physics_are_kept_with_their_reason(tmp_path: Path) -> None:
    """The first drawer resists more than the hand can hold, which plans do not consider."""
    pytest.importorskip("mujoco")
    stiff = replace_object_fields(
        load_scene("drawer"), "drawer", joints={"slide": {"friction": 282.0}}
    )
    file = tmp_path / "stiff.yaml"
    file.write_text(yaml.safe_dump(stiff.document), encoding="utf-8")
    recipe = {"name": "physics", "tasks": ["drive-open"], "scenes": [str(file), "drawer"]}
    recipe |= {"rooms": {"episodes": 1}, "simulate": True}
    out = generate(recipe, 1, tmp_path / "out").folder
    (failed,) = csv.DictReader((out / "failures.csv").open(encoding="utf-8"))
    assert (failed["number"], failed["status"]) == ("0", "physics")
    assert re.match(r"step 1: drawer.slide misses its goal by \d+\.\d mm at", failed["reason"])
    assert re.search(r"; drawer\.handle\w* was pulled out of the hand at", failed["reason"])
    records = [
        record
        for line in (out / "journal.jsonl").read_text(encoding="utf-8").splitlines()
        for record in json.loads(line).get("records", ())
    ]
    assert [(one["number"], one["success"], one["simulated"]) for one in records] == [
        (0, False, True),
        (1, True, True),
    ]
    assert records[0]["reason"] == failed["reason"]
    assert records[0]["evaluations"] > 0  # as planned, before physics
    assert Dataset.open(out).numbers() == [1]
    assert sorted(file.name for file in (out / "work").iterdir()) == ["00000001.hdf5"]


def make_record(number: int) -> dict[str, Any]:
    """Return a record of an attempt; each path is shared by four attempts, and some fail."""
    success, at = number % 3 != 1, float(number // 4)
    return {
        **{"number": number, "success": success, "status": "success" if success else "x"},
        **{"reason": "", "robot": "a", "scene": "s", "task": "t", "object": "o", "goal": 0.0},
        "way": [[at, 0.0], [at, 1.0]],
    }


def test_accepted_episodes_do_not_depend_on_the_order(tmp_path: Path) -> None:
    found = []
    for order in (range(12), reversed(range(12)), (5, 0, 11, 3, 1, 2, 9, 10, 4, 8, 7, 6)):
        register = Register(Dataset(tmp_path, load_recipe(SMALL)), 3)
        for k in order:
            register.add(make_record(k))
        found.append(
            (
                [one["number"] for one in register.accepted],
                [(one["number"], one["status"]) for one in register.failures],
            )
        )
    assert found[0] == found[1] == found[2]
    assert found[0][0] == [0, 5, 8]
    assert (2, "duplicate") in found[0][1]
    assert (1, "x") in found[0][1]
    # Registered records do not keep their coarse trajectories.
    assert not any("way" in one for one in (*register.accepted, *register.failures))
