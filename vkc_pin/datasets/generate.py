"""generate(): episodes of a recipe on any number of processes, kept as they come, in a folder that is a dataset at the end."""

from __future__ import annotations

import contextlib
import itertools
import sys
import time
import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import yaml
from tqdm import tqdm

from vkc_pin.datasets.dataset import Dataset, Register
from vkc_pin.datasets.episode import Made, get_work_file
from vkc_pin.datasets.formats import hdf5
from vkc_pin.datasets.formats import lerobot as lerobot_layout
from vkc_pin.datasets.formats.card import make_card
from vkc_pin.datasets.formats.parts import make_parts
from vkc_pin.datasets.recipes.recipe import CAMERAS, Recipe, load_recipe
from vkc_pin.datasets.recipes.terms import make_entries
from vkc_pin.datasets.robots import check_frames, prepare_robots
from vkc_pin.errors import InputError, VkcError
from vkc_pin.simulation.physics import import_mujoco
from vkc_pin.utils.arguments import flag, whole
from vkc_pin.utils.parallel.engine import Died, needs_dask, results
from vkc_pin.utils.parallel.journal import Journal
from vkc_pin.utils.parallel.machine import process_name, versions
from vkc_pin.world.files.resources import file_path
from vkc_pin.world.files.writing import (
    check_links,
    check_replaceable,
    check_writable,
    write_atomically,
)
from vkc_pin.world.task.terms import Term

__all__ = ["generate"]

_PATIENCE = 4  # attempts for each episode that is asked for, before there is no point
_LEAST = 40  # attempts that are made in any case
_WATCHED = 3.0  # times the limit of planning by the clock, after which the process is ended


def generate(
    recipe: str | Path | Mapping[str, Any] | Recipe,
    episodes: int,
    out: str | Path,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    variants: int | None = None,
    simulate: bool | None = None,
    cameras: bool = False,
    terms: Sequence[Term] = (),
    lerobot: bool = False,
    progress: bool = False,
) -> Dataset:
    """Make a dataset of episodes, each a scene with a motion that the independent validation accepts; or go on making it.

    The recipe and a number determine an episode; the dataset consists of the first `episodes`
    numbers, from 0, that become one. The rest is in failures.csv with its reason. Neither `jobs`
    nor stops make a difference to what is in shards and scenes. Every attempt that ends is in the
    journal at once; the same call goes on where one was stopped, and with more `episodes` adds
    some.

    Args:
        recipe: The name or path of a recipe, or what such a file says.
        episodes: How many, at least 1.
        out: The folder, made if need be.
        jobs: Processes on this machine; more than 1 are Dask's (the extra `cluster`), started anew
            when they die.
        scheduler: Address of a Dask scheduler whose workers are used instead, "tcp://host:8786".
        variants: Motions for each problem, instead of the recipe's number.
        simulate: Whether only episodes count that physics confirms (the extra `sim`), instead of
            what the recipe says.
        cameras: Keep what cameras on the robot see of it as well: those of the recipe, or one above
            the base and one beside the fingers. Only of what is simulated. Recipes that name
            cameras need not be asked.
        terms: Own constraints and costs that every motion keeps to, beside those of the recipe,
            whose part they become. Frames are "base", "hand", "object" (the link that the hand
            takes hold of), or those of every robot of the recipe; `holding="object"` is while it is
            held.
        lerobot: Write LeRobot's layout as well.
        progress: Show a progress bar with the time left.

    Raises:
        UnknownNameError: The recipe names something that does not exist.
        InputError: The recipe is wrong, `out` holds something else, or what is needed is not
            installed; nothing is written then.
        VkcError: Hardly any attempt becomes an episode; or there are cameras, and no OpenGL without
            a screen.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    wanted, jobs = whole(episodes, "episodes", low=1), whole(jobs, "jobs", low=1, high=4096)
    made = load_recipe(recipe, variants=variants, simulate=simulate)
    if flag(cameras, "cameras") and not made.fields.cameras:
        made = load_recipe(made, cameras=CAMERAS)
    if own := make_entries(terms):
        made = load_recipe(made, terms=[*made.document["terms"], *own])
    hdf5.require_h5py()
    if flag(lerobot, "lerobot"):
        lerobot_layout.require_pyarrow(made.fields.rate)
    if made.fields.simulate:
        import_mujoco()
    check_frames(made)
    if jobs > 1 or scheduler is not None:
        needs_dask(scheduler)
    folder = file_path(out, "out", "a folder")
    with _journal(folder, made) as journal:
        if lerobot and (folder / "lerobot").is_dir():
            for robot in (folder / "lerobot").iterdir():
                check_replaceable(robot)
        _at_work(folder, made)
        dataset = Dataset(folder, made)
        numbers = dataset.numbers()
        if (there := len(numbers)) > wanted:
            raise InputError(
                "there are more episodes already",
                file=folder,
                field="episodes",
                expected=f"at least {there}",
                got=wanted,
            )
        register = Register(dataset, wanted)
        for key in _lost(dataset, journal, set(numbers)):
            del journal.lines[key]  # a number is all that it takes to make them again
        for key in sorted(journal.lines, key=int):
            register.add(_kept(journal, key))
        if not register.full:
            _run(dataset, register, journal, jobs, scheduler, progress)
        register.finish()
        _describe(dataset, register)
        if lerobot:
            _as_lerobot(dataset)
    return dataset


@contextlib.contextmanager
def _journal(folder: Path, recipe: Recipe) -> Iterator[Journal]:
    """Lend the journal of a folder; refuse a folder that has something else, before anything is written."""
    file = folder / "journal.jsonl"
    if folder.exists() and not folder.is_dir():
        raise InputError("this is no folder", file=folder, field="out")
    if folder.is_dir() and not file.is_file() and any(folder.iterdir()):
        expected = "a new or empty folder, or one with episodes of this recipe"
        raise InputError(
            "there is something else in this folder", file=folder, field="out", expected=expected
        )
    if folder.is_dir():
        check_links(folder)
    check_writable(file)
    folder.mkdir(parents=True, exist_ok=True)
    header = {"settings": {"recipe": recipe.digest}, "versions": versions()}
    with file.open("a+b") as stream:
        yield Journal(file, stream, header, "episodes")


def _at_work(folder: Path, recipe: Recipe) -> None:
    """Write what the folder has from the first moment on."""
    (folder / "work").mkdir(exist_ok=True)
    write_atomically(
        folder / "recipe.yaml",
        yaml.safe_dump(recipe.document, sort_keys=False, allow_unicode=True).encode(),
    )


def _kept(journal: Journal, key: str) -> dict[str, Any]:
    (record,) = journal.lines[key]
    return record


def _lost(dataset: Dataset, journal: Journal, there: Set[int]) -> list[str]:
    """Return which episodes somebody has removed: the journal says that they succeeded, and neither shard nor file has them."""
    good = [
        key for key in journal.lines if int(key) not in there and _kept(journal, key)["success"]
    ]
    return [key for key in good if not get_work_file(dataset.folder, int(key)).is_file()]


def _run(
    dataset: Dataset,
    register: Register,
    journal: Journal,
    jobs: int,
    scheduler: str | None,
    progress: bool,
) -> None:
    """Make attempts, lowest numbers first, until there are enough episodes."""
    document, fields = dataset.recipe.document, dataset.recipe.fields
    clock, most = _Clock(), max(_LEAST, _PATIENCE * register.wanted)
    size, again = fields.rooms.episodes * fields.variants, deque[int]()
    robots = prepare_robots(dataset.recipe, dataset.folder / "robots")

    def tasks() -> Iterator[tuple[str, Any]]:
        clock.start()  # processes are there now
        for block in itertools.count():
            while again:
                number = again.popleft()
                yield str(number), (document, [number], robots)
            if register.full or register.decided >= most:
                return
            numbers = range(block * size, (block + 1) * size)
            left = [number for number in numbers if str(number) not in journal.lines]
            if left:
                yield ",".join(map(str, left)), (document, left, robots)

    journal.append({"session": {"jobs": jobs}})
    bar = tqdm(
        total=register.wanted,
        initial=len(register.accepted),
        unit="episode",
        smoothing=0.05,
        disable=not progress,
    )
    found = results(
        make_parts,
        tasks(),
        jobs=jobs,
        scheduler=scheduler,
        dask=True,
        limit=_WATCHED * size * fields.time_limit,
        tell=(lambda line: tqdm.write(line, file=sys.stderr)) if progress else None,
    )
    try:
        with bar, contextlib.closing(found) as lines:
            for key, result in lines:
                numbers = [int(number) for number in key.split(",")]
                if (
                    isinstance(result, Died) and len(numbers) > 1
                ):  # which of them it was shows when they are alone
                    again.extend(numbers)
                    continue
                for record, data in (
                    [_died(numbers[0], result)] if isinstance(result, Died) else result
                ):
                    if record["status"] == "interrupted":
                        raise KeyboardInterrupt
                    _keep(dataset, journal, record, data, clock)
                    register.add(record)
                bar.update(len(register.accepted) - bar.n)
                bar.set_postfix(failed=len(register.failures), refresh=False)
                if register.full:
                    break
    except KeyboardInterrupt:
        text = f"{len(register.accepted)} of {register.wanted} episodes are made and kept in {dataset.folder}"
        raise KeyboardInterrupt(text) from None
    if not register.full:
        reasons = "; ".join(
            dict.fromkeys(str(record["reason"]) for record in register.failures[-200:])
        )[:500]
        problem = f"{register.decided} attempts gave {len(register.accepted)} episodes of {register.wanted}"
        raise VkcError(
            f"{problem}, which are kept in {dataset.folder}; the last ones failed because: {reasons}"
        )


class _Clock:
    """The time since some moment, and what of its processor time this process did not spend on attempts of its own."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        self._began, self._worked = time.perf_counter(), time.process_time()

    def attempted(self, record: Mapping[str, Any]) -> None:
        """Take note of an attempt, perhaps of this process."""
        if record.get("process") == process_name():
            self._worked += float(record["cpu_time"])

    @property
    def now(self) -> dict[str, float]:
        """Both times, as the journal has them [s]."""
        seconds, client = time.perf_counter() - self._began, time.process_time() - self._worked
        return {"seconds": round(seconds, 3), "client_seconds": round(client, 4)}


def _keep(
    dataset: Dataset, journal: Journal, record: dict[str, Any], data: bytes, clock: _Clock
) -> None:
    """Write an attempt down: first the episode, then the line that says that it is there."""
    if data:
        write_atomically(get_work_file(dataset.folder, record["number"]), data)
    clock.attempted(record)
    memory: dict[str, Any] = {
        name: record.pop(name) for name in ("memory_mb", "resident_mb", "process") if name in record
    }
    journal.append(
        {"key": str(record["number"]), "records": [record], "memory_mb": 0.0, **memory, **clock.now}
    )


def _died(number: int, died: Died) -> Made:
    return {"number": number, "success": False, "status": "died", "reason": died.reason}, b""


def _describe(dataset: Dataset, register: Register) -> None:
    """Write the data card."""
    recipe = dataset.recipe
    about = {
        "name": recipe.fields.name,
        "license": recipe.fields.license,
        "digest": recipe.digest,
        "rate": recipe.fields.rate,
        "versions": versions(),
        "recipe": yaml.safe_dump(recipe.document, sort_keys=False, allow_unicode=True),
    }
    write_atomically(
        dataset.folder / "README.md",
        make_card(about, register.accepted, register.failures).encode(),
    )


def _as_lerobot(dataset: Dataset) -> None:
    """Write every robot's episodes in LeRobot's layout."""
    for shards in sorted((dataset.folder / "shards").iterdir()):
        own = (
            episode
            for shard in sorted(shards.glob("*.hdf5"))
            for episode in hdf5.read_episodes(shard, dataset.folder / "scenes")
        )
        first = next(own)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            robot = first.scene().robot
        lerobot_layout.write_lerobot(
            dataset.folder / "lerobot" / shards.name,
            itertools.chain([first], own),
            robot,
            dataset.recipe.fields.rate,
        )
