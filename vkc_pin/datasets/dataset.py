"""Manages the folder of a dataset: its files, its episodes, and its shards."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, Field, model_validator

from vkc_pin.datasets.diversity import DuplicateFinder
from vkc_pin.datasets.episode import Episode, get_work_file
from vkc_pin.datasets.formats.hdf5 import read_episodes, read_numbers, read_scene, write_shard
from vkc_pin.datasets.recipe import Recipe, load_recipe
from vkc_pin.errors import InputError
from vkc_pin.world.files.documents import Document, parse_document, read_text
from vkc_pin.world.files.fields import Count, Finite, Measured, Text, make_validation_error
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.writing import check_name, write_atomically

EPISODES_A_SHARD = 100
"""Episodes in one shard; the last one of each robot may have fewer."""
FOLDERS = ("lerobot", "robots", "scenes", "shards", "work")
"""Folders in that of a dataset."""
_FILES = ("README.md", "episodes.csv", "failures.csv", "journal.jsonl", "recipe.yaml")
MEMBERS = (*FOLDERS, *_FILES)
"""Files and folders in that of a dataset, but for its page of statistics."""
_COLUMNS = (
    "number",
    "task",
    "robot",
    "room",
    "object",
    "kind",
    "attachment",
    "joint",
    "goal",
    "variant",
    "status",
    "reason",
    "duration",
    "base_path_length",
    "arm_path_length",
    "clearance",
    "waypoints",
    "scene",
    "seconds",
    "planning_time",
)
# Fields that the record of an episode has, and that of a failure may lack.
_REQUIRED = ("task", "robot", "room", "object", "kind", "goal", "scene", "way", "duration")


class _AttemptSchema(BaseModel):
    """The record of an attempt: the fields that are used; there are others for statistics."""

    number: Count
    success: Annotated[bool, Field(strict=True)]
    status: Text
    reason: Text = ""
    task: Text | None = None
    robot: Text | None = None
    room: Text | None = None
    object: Text | None = None
    kind: Text | None = None
    attachment: Text | None = None
    joint: Text | None = None
    goal: Finite | list[Finite] | None = None
    variant: Count | None = None
    scene: Text | None = None
    start: list[Finite] | None = None
    way: list[list[Finite]] | None = None
    waypoints: Count | None = None
    duration: Measured | None = None
    base_path_length: Measured | None = None
    arm_path_length: Measured | None = None
    clearance: Finite | None = None
    seconds: Measured | None = None
    planning_time: Measured | None = None
    cpu_time: Measured | None = None

    @model_validator(mode="after")
    def _check_success(self) -> Self:
        for name in _REQUIRED:
            if self.success and getattr(self, name) is None:
                raise make_validation_error(f"{name} is missing", "that of an episode")
        if self.way is not None:
            lengths = {len(row) for row in self.way}
            if len(lengths) != 1:
                raise make_validation_error("`way` is no table", "rows of equal length")
        return self


def check_attempt(key: str, records: list[dict[str, Any]]) -> None:
    """Check the record of an attempt in a journal.

    Raises:
        InputError: There is not one record, its number is not its key, or a field is invalid.
    """
    if len(records) != 1:
        raise InputError("wrong number", field="records", expected="one", got=len(records))
    if records[0].get("success"):
        for name in ("robot", "scene"):
            check_name(records[0].get(name), name)
    record = parse_document(Document(records[0]), _AttemptSchema)
    if str(record.number) != key:
        expected = f"{key}, as the line's key"
        raise InputError("another number", field="number", expected=expected, got=record.number)


def read_intact_numbers(file: Path) -> list[int]:
    """Return the numbers of the episodes in a shard or work file; none if there is no valid file.

    A damaged file counts as removed: its episodes are made again. A warning names it.
    """
    if not file.exists():
        return []
    try:
        return read_numbers(file)
    except InputError as error:
        warnings.warn(f"{error}; its episodes are made again", stacklevel=2)
        return []


def has_intact_scene(scenes: Path, name: str) -> bool:
    """Return whether a folder of scenes has the file of a scene, and it is not damaged.

    A damaged file counts as removed: the episodes in the scene are made again. A warning names it.
    """
    if not (scenes / f"{name}.json").exists():
        return False
    try:
        read_scene(scenes, name)
    except InputError as error:
        warnings.warn(f"{error}; its episodes are made again", stacklevel=2)
        return False
    return True


@dataclass(frozen=True)
class Dataset:
    """A folder of episodes.

    Attributes:
        folder: The folder.
        recipe: Recipe of its episodes.
    """

    folder: Path
    recipe: Recipe

    @classmethod
    def open(cls, folder: str | Path) -> Dataset:
        """Open the dataset in a folder.

        Raises:
            InputError: The folder holds no dataset.
        """
        path = check_path(folder, "folder", "a folder that `vkc-pin generate` has written")
        if not (path / "recipe.yaml").is_file():
            raise InputError(
                "the folder holds no dataset",
                file=path,
                expected="a folder that `vkc-pin generate` has written",
            )
        return cls(path, load_recipe(path / "recipe.yaml", find_files=False))

    @property
    def shards(self) -> list[Path]:
        """Shards, by robot and number."""
        return sorted((self.folder / "shards").glob("*/shard-*.hdf5"))

    def numbers(self) -> list[int]:
        """Return the numbers of all episodes, shard by shard."""
        return [number for shard in self.shards for number in read_numbers(shard)]

    @property
    def robots(self) -> list[str]:
        """Names of the robots that have episodes."""
        return sorted({shard.parent.name for shard in self.shards})

    def episodes(self, robot: str | None = None) -> Iterator[Episode]:
        """Yield all episodes, or those of a robot, shard by shard, reading one at a time.

        Raises:
            InputError: A file is damaged.
        """
        for shard in self.shards:
            if robot in (None, shard.parent.name):
                yield from read_episodes(shard, self.folder / "scenes")


class Register:
    """Accepts or rejects attempts in the order of their numbers, and writes shards.

    Attempts finish in any order. Their acceptance depends only on those of lower numbers, so that
    neither the number of processes nor interruptions affect the dataset.

    Attributes:
        accepted: Table rows of the episodes, in order.
        failures: Table rows of failed attempts and near-duplicates, in order.
    """

    def __init__(self, dataset: Dataset, wanted: int) -> None:
        self.dataset = dataset
        self.wanted = wanted
        self.accepted: list[Mapping[str, Any]] = []
        self.failures: list[Mapping[str, Any]] = []
        self._shards: dict[Path, list[Mapping[str, Any]]] = {}  # folder → rows of its episodes
        self._pending: dict[int, Mapping[str, Any]] = {}
        self._next = 0
        self._duplicates = DuplicateFinder()

    @property
    def full(self) -> bool:
        """Whether all requested episodes are accepted."""
        return len(self.accepted) >= self.wanted

    @property
    def decided(self) -> int:
        """Number of attempts that were accepted or rejected."""
        return self._next

    def add(self, record: Mapping[str, Any]) -> None:
        """Add the record of a finished attempt."""
        self._pending[int(record["number"])] = record
        while self._next in self._pending and not self.full:
            self._decide(self._pending.pop(self._next))
            self._next += 1

    def _decide(self, record: Mapping[str, Any]) -> None:
        if not record["success"]:
            self.failures.append(_select_columns(record))
            return
        duplicate = self._duplicates.find_duplicate(record)
        if duplicate is not None:
            reason = f"nearly the same motion as that of episode {duplicate}"
            rejected = {**record, "status": "duplicate", "reason": reason}
            self.failures.append(_select_columns(rejected))
            return
        name = check_name(record.get("robot"), "robot", file=self.dataset.folder / "journal.jsonl")
        folder = self.dataset.folder / "shards" / name
        row = _select_columns(record)
        self.accepted.append(row)
        rows = self._shards.setdefault(folder, [])
        rows.append(row)
        if len(rows) % EPISODES_A_SHARD == 0:
            self._write(folder, len(rows) // EPISODES_A_SHARD - 1)

    def finish(self) -> None:
        """Write incomplete shards and the tables."""
        for folder, rows in self._shards.items():
            if len(rows) % EPISODES_A_SHARD:
                self._write(folder, len(rows) // EPISODES_A_SHARD)
        write_table(self.dataset.folder / "episodes.csv", self.accepted)
        write_table(self.dataset.folder / "failures.csv", self.failures)

    def _write(self, folder: Path, k: int) -> None:
        """Write shard `k` of a folder and its scenes, unless they exist.

        The work files of a full shard are deleted.
        """
        first = k * EPISODES_A_SHARD
        rows = self._shards[folder][first : first + EPISODES_A_SHARD]
        numbers = [int(row["number"]) for row in rows]
        scenes = self.dataset.folder / "scenes"
        names = {row["scene"] for row in rows}
        lost = {name for name in names if not has_intact_scene(scenes, name)}
        for name in lost:  # a damaged file would stay
            (scenes / f"{name}.json").unlink(missing_ok=True)
        path = folder / f"shard-{k:05d}.hdf5"
        files = [get_work_file(self.dataset.folder, number) for number in numbers]
        existing = read_intact_numbers(path)
        if existing != numbers or lost:
            parts = list[tuple[Path, int]]()
            for file, number, row in zip(files, numbers, rows, strict=True):
                # Episodes whose work file was removed may be in the shard that is replaced.
                # A lost scene is in the work file, too.
                is_in_shard = number in existing and row["scene"] not in lost
                parts.append((path, existing.index(number)) if is_in_shard else (file, 0))
            write_shard(path, parts, scenes)
        if len(numbers) == EPISODES_A_SHARD:
            for file in files:
                file.unlink(missing_ok=True)


def _select_columns(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a record that tables contain, to save memory."""
    return {name: record[name] for name in _COLUMNS if name in record}


def write_table(path: Path, records: Sequence[Mapping[str, Any]]) -> Path:
    """Write records as a CSV table; return the path."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return write_atomically(path, buffer.getvalue().encode())


def read_table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table of `write_table`; none if there is no such file.

    Raises:
        InputError: The file is no such table.
    """
    if not path.is_file():
        return []
    expected = "the columns and whole numbers that `generate` writes"
    try:
        table = csv.DictReader(io.StringIO(read_text(path, "CSV")), strict=True)
        rows = list(table)
    except csv.Error as error:
        raise InputError("not a CSV table", file=path, got=str(error)) from error
    if tuple(table.fieldnames or ()) != _COLUMNS:
        raise InputError("wrong columns", file=path, expected=expected, got=table.fieldnames)
    for line, row in enumerate(rows, start=2):
        # csv has None for cells that are missing, and as the key of those that are too many.
        is_whole = None not in row and None not in row.values()
        if not is_whole or not re.fullmatch(r"\d{1,18}", row["number"], re.ASCII):
            raise InputError("an invalid row", file=path, line=line, expected=expected)
    return rows
