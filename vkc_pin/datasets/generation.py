"""Generates episodes of a recipe in parallel processes and writes them as a dataset."""

from __future__ import annotations

import contextlib
import functools
import itertools
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import yaml
from tqdm import tqdm

from vkc_pin.datasets.dataset import (
    FOLDERS,
    Dataset,
    Register,
    check_attempt,
    has_intact_scene,
    read_intact_numbers,
)
from vkc_pin.datasets.episode import get_work_file
from vkc_pin.datasets.formats import lerobot as lerobot_layout
from vkc_pin.datasets.formats.card import make_card
from vkc_pin.datasets.formats.hdf5 import Made, make_parts
from vkc_pin.datasets.formats.hdf5_reader import require_h5py
from vkc_pin.datasets.recipe import CAMERAS, Recipe, load_recipe, make_entries
from vkc_pin.datasets.robots import check_frames, prepare_robots
from vkc_pin.errors import InputError, VkcError
from vkc_pin.simulation.physics import import_mujoco
from vkc_pin.utils.arguments import check_bool, check_integer
from vkc_pin.utils.journal import Journal
from vkc_pin.utils.parallel import CrashedTask, check_processes, run_tasks
from vkc_pin.utils.system import find_versions, identify_process
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.writing import (
    check_links,
    check_replaceable,
    check_writable,
    is_leftover,
    remove_leftovers,
    write_atomically,
)
from vkc_pin.world.task.terms import Term

_MAX_ATTEMPTS_PER_EPISODE = 4  # attempts per requested episode, after which generation fails
_MAX_AHEAD = 10  # attempts that are started, as a multiple of those after which generation fails
_MIN_ATTEMPTS = 40  # attempts before generation may fail
_WATCHDOG = 3.0  # multiple of the planning time limit after which a process is terminated


def generate(  # noqa: PLR0913 - keyword options of a public call
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
    """Generate a dataset of episodes, each a scene with a validated trajectory, or continue one.

    The recipe and a number determine an episode; the dataset consists of the first `episodes`
    numbers, from 0, that succeed. All others are in failures.csv with their reasons. Neither `jobs`
    nor interruptions affect the contents of shards and scenes. Every finished attempt is in the
    journal at once; the same call continues an interrupted run, and with more `episodes` extends
    it.

    Args:
        recipe: Name or path of a recipe, or the contents of such a file.
        episodes: Number of episodes, at least 1.
        out: Output folder, created if necessary.
        jobs: Processes on this machine; more than 1 run with Dask (the extra `cluster`), and are
            restarted when they die.
        scheduler: Address of a Dask scheduler whose workers are used instead, "tcp://host:8786".
        variants: Trajectories for each problem, instead of the recipe's number.
        simulate: Whether episodes must also succeed in simulation (the extra `sim`), instead of the
            recipe's choice.
        cameras: Record images of cameras on the robot in simulated episodes: those of the recipe,
            or one above the base and one beside the fingers. Recipes with cameras record images
            anyway.
        terms: Additional constraints and costs for all trajectories, which become part of the
            recipe. Frames are "base", "hand", "object" (the grasped link), or those of all robots
            of the recipe; `holding="object"` means while it is grasped.
        lerobot: Whether to write LeRobot's layout as well. A dataset that has it gets it anyway.
        progress: Whether to show a progress bar.

    Raises:
        UnknownNameError: The recipe refers to an unknown name.
        InputError: The recipe is invalid, `out` holds other files, or a dependency is not
            installed; nothing is written then.
        VkcError: Hardly any attempt succeeds; or there are cameras, and OpenGL is not available
            without a display.
        KeyboardInterrupt: Ctrl-C was pressed; the same call continues the run.
    """
    wanted = check_integer(episodes, "episodes", low=1, high=10**9)
    jobs = check_integer(jobs, "jobs", low=1, high=4096)
    loaded = _load_recipe(recipe, terms, variants=variants, simulate=simulate, cameras=cameras)
    folder = check_path(out, "out", "a folder")
    lerobot = check_bool(lerobot, "lerobot") or (folder / "lerobot").is_dir()
    if lerobot:
        lerobot_layout.require_pyarrow(loaded.fields.rate)
    check_processes(jobs, scheduler)
    with _open_journal(folder, loaded) as journal:
        remove_leftovers(folder)
        if (folder / "lerobot").is_dir():
            for robot in (folder / "lerobot").iterdir():
                check_replaceable(robot)
        dataset = Dataset(folder, loaded)
        existing = set[int]()
        for shard in dataset.shards:
            existing.update(read_intact_numbers(shard))
        if len(existing) > wanted:
            raise InputError(
                "the dataset already has more episodes",
                file=folder,
                field="episodes",
                expected=f"at least {len(existing)}",
                got=wanted,
            )
        _prepare_folder(folder, loaded)
        register = Register(dataset, wanted)
        for key in _find_lost(dataset, journal, existing):
            del journal.lines[key]  # they are generated again
        for key in sorted(journal.lines, key=int):
            register.add(_get_record(journal, key))
        if not register.full:
            _run_attempts(dataset, register, journal, jobs, scheduler, progress)
        register.finish()
        _write_card(dataset, register)
        if lerobot:
            _write_lerobot(dataset)
    return dataset


def _load_recipe(
    recipe: str | Path | Mapping[str, Any] | Recipe,
    terms: Sequence[Term],
    *,
    cameras: bool,
    **changes: Any,
) -> Recipe:
    """Return the recipe with changes; check that its robots and dependencies are available."""
    loaded = load_recipe(recipe, **changes)
    if check_bool(cameras, "cameras") and not loaded.fields.cameras:
        loaded = load_recipe(loaded, cameras=CAMERAS)
    entries = make_entries(terms)
    if entries:
        loaded = load_recipe(loaded, terms=[*loaded.document["terms"], *entries])
    require_h5py()
    if loaded.fields.simulate:
        import_mujoco()
    check_frames(loaded)
    return loaded


@contextlib.contextmanager
def _open_journal(folder: Path, recipe: Recipe) -> Iterator[Journal]:
    """Open the journal of a folder; refuse folders with other files before anything is written."""
    file = folder / "journal.jsonl"
    if folder.exists() and not folder.is_dir():
        raise InputError("`out` is not a folder", file=folder, field="out")
    has_others = folder.is_dir() and not all(map(is_leftover, folder.iterdir()))
    if has_others and not file.is_file():
        expected = "a new or empty folder, or one with episodes of this recipe"
        raise InputError(
            "the folder holds other files", file=folder, field="out", expected=expected
        )
    if folder.is_dir():
        check_links(folder)
        for name in FOLDERS:
            if (folder / name).exists() and not (folder / name).is_dir():
                raise InputError("this is no folder", file=folder / name, expected="a folder")
    check_writable(file)
    folder.mkdir(parents=True, exist_ok=True)
    header = {"settings": {"recipe": recipe.digest}, "versions": find_versions()}
    with file.open("a+b") as stream:
        yield Journal(file, stream, header, "episodes", check_attempt)


def _prepare_folder(folder: Path, recipe: Recipe) -> None:
    """Write the files that a dataset has from the start."""
    (folder / "work").mkdir(exist_ok=True)
    write_atomically(
        folder / "recipe.yaml",
        yaml.safe_dump(recipe.document, sort_keys=False, allow_unicode=True).encode(),
    )


def _get_record(journal: Journal, key: str) -> dict[str, Any]:
    """Return the record of an attempt in the journal."""
    (record,) = journal.lines[key]
    return record


def _find_lost(dataset: Dataset, journal: Journal, existing: Set[int]) -> list[str]:
    """Return successful episodes of the journal that neither work file nor shard and scene hold."""
    is_intact = functools.cache(functools.partial(has_intact_scene, dataset.folder / "scenes"))
    found = list[str]()
    for key in journal.lines:
        record = _get_record(journal, key)
        number = int(key)
        if not record["success"]:
            continue
        if number in existing and is_intact(record["scene"]):
            continue
        if read_intact_numbers(get_work_file(dataset.folder, number)) != [number]:
            found.append(key)
    return found


def _run_attempts(
    dataset: Dataset,
    register: Register,
    journal: Journal,
    jobs: int,
    scheduler: str | None,
    progress: bool,
) -> None:
    """Run attempts in the order of their numbers until there are enough episodes."""
    fields = dataset.recipe.fields
    size = fields.rooms.episodes * fields.variants
    clock = _Clock()
    retried = deque[int]()
    robots = prepare_robots(dataset.recipe, dataset.folder / "robots")
    journal.append({"session": {"jobs": jobs}})
    bar = tqdm(
        total=register.wanted,
        initial=len(register.accepted),
        unit="episode",
        smoothing=0.05,
        disable=not progress,
    )
    outcomes = run_tasks(
        make_parts,
        _iterate_tasks(dataset, register, journal, clock, retried, robots),
        jobs=jobs,
        scheduler=scheduler,
        limit=_WATCHDOG * size * fields.time_limit,
        tell=functools.partial(tqdm.write, file=sys.stderr) if progress else None,
    )
    try:
        with bar, contextlib.closing(outcomes) as lines:
            for key, result in lines:
                numbers = [int(number) for number in key.split(",")]
                if isinstance(result, CrashedTask):
                    if len(numbers) > 1:
                        # Each is run alone, to find the one that ended the process.
                        retried.extend(numbers)
                        continue
                    result = [_make_failure(numbers[0], result)]
                for record, data in result:
                    if record["status"] == "interrupted":
                        raise KeyboardInterrupt
                    _save(dataset, journal, record, data, clock)
                    register.add(record)
                bar.update(len(register.accepted) - bar.n)
                bar.set_postfix(failed=len(register.failures), refresh=False)
                if register.full:
                    break
    except KeyboardInterrupt:
        text = f"{len(register.accepted)} of {register.wanted} episodes are in {dataset.folder}"
        raise KeyboardInterrupt(text) from None
    if not register.full:
        raise _make_shortage_error(dataset, register)


def _iterate_tasks(
    dataset: Dataset,
    register: Register,
    journal: Journal,
    clock: _Clock,
    retried: deque[int],
    robots: Mapping[str, str],
) -> Iterator[tuple[str, Any]]:
    """Yield keys and tasks of blocks of attempts until there are enough; `retried` come first."""
    document = dataset.recipe.document
    fields = dataset.recipe.fields
    max_attempts = max(_MIN_ATTEMPTS, _MAX_ATTEMPTS_PER_EPISODE * register.wanted)
    size = fields.rooms.episodes * fields.variants
    clock.start()  # the processes are running now
    for block in itertools.count():
        while retried:
            number = retried.popleft()
            yield str(number), (document, [number], robots)
        if register.full or register.decided >= max_attempts:
            return
        if block * size >= _MAX_AHEAD * max_attempts:  # none is decided: a result is missing
            return
        numbers = range(block * size, (block + 1) * size)
        missing = [number for number in numbers if str(number) not in journal.lines]
        if missing:
            yield ",".join(map(str, missing)), (document, missing, robots)


def _make_shortage_error(dataset: Dataset, register: Register) -> VkcError:
    reasons = dict.fromkeys(str(record["reason"]) for record in register.failures[-200:])
    counts = f"{register.decided} attempts gave {len(register.accepted)} of {register.wanted}"
    latest = "; ".join(reasons)[:500]
    return VkcError(f"{counts} episodes, kept in {dataset.folder}; the latest failures: {latest}")


class _Clock:
    """Measures wall time, and this process's CPU time outside of its own attempts."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        self._start_time = time.perf_counter()
        self._start_cpu_time = time.process_time()

    def subtract(self, record: Mapping[str, Any]) -> None:
        """Subtract the CPU time of an attempt that this process ran."""
        if record.get("process") == identify_process():
            self._start_cpu_time += float(record["cpu_time"])

    @property
    def now(self) -> dict[str, float]:
        """Wall and client times, as in the journal [s]."""
        seconds = time.perf_counter() - self._start_time
        client = time.process_time() - self._start_cpu_time
        return {"seconds": round(seconds, 3), "client_seconds": round(client, 4)}


def _save(
    dataset: Dataset, journal: Journal, record: dict[str, Any], data: bytes, clock: _Clock
) -> None:
    """Save an attempt: first the episode, then the journal line that refers to it."""
    if data:
        write_atomically(get_work_file(dataset.folder, record["number"]), data)
    clock.subtract(record)
    line: dict[str, Any] = {"key": str(record["number"]), "records": [record], "memory_mb": 0.0}
    for name in ("memory_mb", "resident_mb", "process"):
        if name in record:
            line[name] = record.pop(name)
    journal.append({**line, **clock.now})


def _make_failure(number: int, outcome: CrashedTask) -> Made:
    return {"number": number, "success": False, "status": "died", "reason": outcome.reason}, b""


def _write_card(dataset: Dataset, register: Register) -> None:
    recipe = dataset.recipe
    about = {
        "name": recipe.fields.name,
        "license": recipe.fields.license,
        "digest": recipe.digest,
        "rate": recipe.fields.rate,
        "versions": find_versions(),
        "recipe": yaml.safe_dump(recipe.document, sort_keys=False, allow_unicode=True),
    }
    card = make_card(about, register.accepted, register.failures)
    write_atomically(dataset.folder / "README.md", card.encode())


def _write_lerobot(dataset: Dataset) -> None:
    """Write the episodes of every robot in LeRobot's layout."""
    for robot in dataset.robots:
        lerobot_layout.write_lerobot(
            dataset.folder / "lerobot" / robot,
            dataset.episodes(robot),
            dataset.recipe.fields.rate,
        )
