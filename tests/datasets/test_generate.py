from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from helpers.datasets import SMALL

from vkc_pin.datasets import dataset as datasets
from vkc_pin.datasets import generate as module
from vkc_pin.datasets.dataset import Dataset, Register
from vkc_pin.datasets.episode import Made
from vkc_pin.datasets.generate import generate
from vkc_pin.datasets.recipes.recipe import load_recipe
from vkc_pin.errors import InputError, UnknownNameError, VkcError

pytest.importorskip("h5py")
EPISODES = 5


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return generate(SMALL, EPISODES, tmp_path_factory.mktemp("made") / "out")


def contents(folder: Path) -> dict[str, bytes]:
    """Return what a dataset is, without what making it took."""
    kept = [*folder.glob("shards/*/*"), *folder.glob("scenes/*"), folder / "recipe.yaml"]
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in kept}


def test_the_first_numbers_that_succeed(made: Dataset) -> None:
    numbers = made.numbers()
    lines = [
        json.loads(line) for line in (made.folder / "journal.jsonl").read_text().splitlines()[1:]
    ]
    tried = {line["key"]: line["records"][0]["success"] for line in lines if "session" not in line}
    good = sorted(int(key) for key, success in tried.items() if success)
    assert sorted(numbers) == good[:EPISODES]
    assert len(set(numbers)) == EPISODES
    for name in ("README.md", "episodes.csv", "failures.csv", "recipe.yaml"):
        assert (made.folder / name).is_file()
    assert len((made.folder / "episodes.csv").read_text().splitlines()) == 1 + EPISODES


def test_every_episode_is_valid_and_what_it_says(made: Dataset) -> None:
    starts = set()
    for episode in made.episodes():
        report = episode.validate()
        assert report.ok, report.lines()
        assert report.contradictions(episode.claimed) == []
        goal = episode.trajectory.column(f"{episode.about['object']}.{episode.about['joint']}")[-1]
        assert goal == pytest.approx(episode.about["goal"], abs=1e-3)
        assert episode.trajectory.phases[0].held  # the grasp is given
        starts.add(tuple(episode.trajectory.positions[0][:2]))
    assert len(starts) == EPISODES


def test_processes_make_no_difference(made: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    other = generate(SMALL, EPISODES, tmp_path / "out", jobs=2)
    assert contents(other.folder) == contents(made.folder)


def test_adding_to_a_dataset(made: Dataset, tmp_path: Path) -> None:
    """What was made is not made again, and becomes what it would have been at once."""
    generate(SMALL, 2, tmp_path / "out")
    before = (tmp_path / "out/journal.jsonl").read_text()
    more = generate(SMALL, EPISODES, tmp_path / "out")
    assert contents(more.folder) == contents(made.folder)
    assert (tmp_path / "out/journal.jsonl").read_text().startswith(before)


def test_a_finished_one_is_left_as_it_is(made: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {file: file.read_bytes() for file in made.folder.rglob("*") if file.is_file()}
    monkeypatch.setattr(module, "run_tasks", None)  # nothing is run
    generate(SMALL, EPISODES, made.folder)
    assert {file: file.read_bytes() for file in made.folder.rglob("*") if file.is_file()} == before
    with pytest.raises(InputError, match="more episodes"):
        generate(SMALL, EPISODES - 1, made.folder)


@pytest.mark.parametrize("removed", ["work/*", "shards/*/*", "*/*"])
def test_what_somebody_has_removed_is_made_again(
    made: Dataset, tmp_path: Path, removed: str
) -> None:
    generate(SMALL, 3, tmp_path / "out")
    for file in (tmp_path / "out").glob(removed):
        shutil.rmtree(file) if file.is_dir() else file.unlink()
    assert contents(generate(SMALL, EPISODES, tmp_path / "out").folder) == contents(made.folder)


@pytest.mark.parametrize("kind", ["SIGINT", "SIGKILL"])
def test_a_stop_loses_and_doubles_nothing(made: Dataset, tmp_path: Path, kind: str) -> None:
    script = (
        f"import sys, vkc_pin as vkc; vkc.datasets.generate({SMALL!r}, {EPISODES}, sys.argv[1])"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path / "out")],
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        stderr=subprocess.PIPE,
        text=True,
    )
    file, deadline = tmp_path / "out/journal.jsonl", time.monotonic() + 120.0
    while not (file.exists() and file.read_bytes().count(b"\n") >= 4):
        assert time.monotonic() < deadline
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.01)
    os.kill(process.pid, getattr(signal, kind))
    process.communicate(timeout=60)
    assert contents(generate(SMALL, EPISODES, tmp_path / "out").folder) == contents(made.folder)


@pytest.mark.parametrize(
    ("episodes", "field"), [(0, "episodes"), (-3, "episodes"), (1.5, "episodes")]
)
def test_how_many(tmp_path: Path, episodes: Any, field: str) -> None:
    with pytest.raises(InputError) as caught:
        generate(SMALL, episodes, tmp_path / "out")
    assert caught.value.field == field
    assert not (tmp_path / "out").exists()


def test_nothing_is_written_into_what_is_something_else(made: Dataset, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.tex").write_text("x")
    with pytest.raises(InputError, match="the folder holds other files"):
        generate(SMALL, 1, tmp_path / "mine")
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["thesis.tex"]
    with pytest.raises(InputError, match="run otherwise") as caught:
        generate({**SMALL, "max_evaluations": 7}, EPISODES, made.folder)
    assert caught.value.field == "recipe"
    with pytest.raises(UnknownNameError, match="did you mean 'random_oven'"):
        generate({**SMALL, "objects": ["random_ovens"]}, 1, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_hopeless_recipes_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MIN_ATTEMPTS", 4)
    with pytest.raises(VkcError, match=r"4 attempts gave 0 of 1 episodes.*no free start"):
        generate(
            {**SMALL, "tasks": ["drive-open"], "start": {"distance": [90.0, 91.0]}},
            1,
            tmp_path / "out",
        )
    rows = (tmp_path / "out/journal.jsonl").read_text()
    assert rows.count("no problem") == 4


def record(
    number: int, *, success: bool = True, robot: str = "a", at: float = 0.0
) -> dict[str, Any]:
    about = {
        "robot": robot,
        "scene": "s",
        "task": "t",
        "object": "o",
        "goal": 0.0,
        "way": [[at, 0.0], [at, 1.0]],
    }
    return {
        "number": number,
        "success": success,
        "status": "success" if success else "x",
        "reason": "",
        **about,
    }


def test_what_is_accepted_does_not_depend_on_the_order(tmp_path: Path) -> None:
    records = [
        record(k, success=k % 3 != 1, at=float(k // 4)) for k in range(12)
    ]  # every fourth place is new
    found = []
    for order in (range(12), reversed(range(12)), (5, 0, 11, 3, 1, 2, 9, 10, 4, 8, 7, 6)):
        register = Register(Dataset(tmp_path, load_recipe(SMALL)), 3)
        for k in order:
            register.add(records[k])
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
    assert not any("way" in one for one in (*register.accepted, *register.failures)), (
        "most of a record is for nothing then"
    )


def test_full_shards_are_written_once_and_their_work_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: Dataset
) -> None:
    monkeypatch.setattr(datasets, "EPISODES_A_SHARD", 2)
    out = generate(SMALL, EPISODES, tmp_path / "out")
    assert [shard.name for shard in out.shards] == [
        "shard-00000.hdf5",
        "shard-00001.hdf5",
        "shard-00002.hdf5",
    ]
    assert sorted(out.numbers()) == sorted(made.numbers())
    left = {int(file.stem) for file in (out.folder / "work").glob("*.hdf5")}
    assert not left & set(out.numbers()[:4])
    assert set(out.numbers()[4:]) <= left


def test_a_block_that_takes_its_process_with_it_is_tried_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vkc_pin.utils.parallel.engine import CrashedTask

    asked: list[Sequence[int]] = []

    def results(function: Any, tasks: Any, **options: Any) -> Any:
        for key, (said, numbers, robots) in tasks:
            asked.append(list(numbers))
            yield key, CrashedTask("killed") if 1 in numbers else function((said, numbers, robots))

    monkeypatch.setattr(module, "run_tasks", lambda *a, **k: (line for line in results(*a, **k)))
    out = generate(SMALL, 2, tmp_path / "out")
    assert asked[:3] == [[0, 1], [0], [1]]
    assert 1 not in out.numbers()
    assert "killed" in (out.folder / "failures.csv").read_text()
    assert Made
