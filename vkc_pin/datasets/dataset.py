"""Manages the folder of a dataset: its files, its episodes, and its shards."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vkc_pin.datasets.diversity import DuplicateFinder
from vkc_pin.datasets.episode import Episode, get_work_file
from vkc_pin.datasets.formats.hdf5 import read_episodes, read_numbers, write_shard
from vkc_pin.datasets.recipes.recipe import Recipe, load_recipe
from vkc_pin.errors import InputError
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.writing import check_name, write_atomically

__all__ = ["EPISODES_A_SHARD", "Dataset", "Register", "write_table"]

EPISODES_A_SHARD = 100
"""Episodes in one shard; the last one of each robot may have fewer."""
_COLUMNS = (
    *("number", "task", "robot", "room", "object", "kind", "attachment", "joint", "goal"),
    *("variant", "status", "reason", "duration", "base_path_length", "arm_path_length"),
    *("clearance", "waypoints", "scene", "seconds", "planning_time"),
)


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
        return cls(path, load_recipe(path / "recipe.yaml"))

    @property
    def shards(self) -> list[Path]:
        """Shards, by robot and number."""
        return sorted((self.folder / "shards").glob("*/shard-*.hdf5"))

    def numbers(self) -> list[int]:
        """Return the numbers of all episodes, shard by shard."""
        return [number for shard in self.shards for number in read_numbers(shard)]

    def episodes(self) -> Iterator[Episode]:
        """Yield all episodes, shard by shard, reading one at a time.

        Raises:
            InputError: A file is damaged.
        """
        for shard in self.shards:
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
        self.dataset, self.wanted = dataset, wanted
        self.accepted: list[Mapping[str, Any]] = []
        self.failures: list[Mapping[str, Any]] = []
        self._shards: dict[Path, list[int]] = {}  # folder of a robot's shards → its episodes
        self._pending: dict[int, Mapping[str, Any]] = {}
        self._next, self._duplicates = 0, DuplicateFinder()

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
            self.failures.append(_row(record))
            return
        duplicate = self._duplicates.find_duplicate(record)
        if duplicate is not None:
            reason = f"nearly the same motion as that of episode {duplicate}"
            self.failures.append(_row({**record, "status": "duplicate", "reason": reason}))
            return
        name = check_name(record.get("robot"), "robot", file=self.dataset.folder / "journal.jsonl")
        folder = self.dataset.folder / "shards" / name
        self.accepted.append(_row(record))
        numbers = self._shards.setdefault(folder, [])
        numbers.append(int(record["number"]))
        if len(numbers) % EPISODES_A_SHARD == 0:
            self._write(folder, len(numbers) // EPISODES_A_SHARD - 1)

    def finish(self) -> None:
        """Write incomplete shards and the tables."""
        for folder, numbers in self._shards.items():
            if len(numbers) % EPISODES_A_SHARD:
                self._write(folder, len(numbers) // EPISODES_A_SHARD)
        write_table(self.dataset.folder / "episodes.csv", self.accepted)
        write_table(self.dataset.folder / "failures.csv", self.failures)

    def _write(self, folder: Path, k: int) -> None:
        """Write shard `k` of a folder, unless it exists; delete the work files of a full one."""
        numbers = self._shards[folder][k * EPISODES_A_SHARD : (k + 1) * EPISODES_A_SHARD]
        path = folder / f"shard-{k:05d}.hdf5"
        files = [get_work_file(self.dataset.folder, number) for number in numbers]
        existing = read_numbers(path) if path.is_file() else []
        if existing != numbers:
            # Episodes whose work file was removed may be in the shard that is replaced.
            parts = [
                (file, 0)
                if file.is_file() or number not in existing
                else (path, existing.index(number))
                for file, number in zip(files, numbers, strict=True)
            ]
            write_shard(path, parts, self.dataset.folder / "scenes")
        if len(numbers) == EPISODES_A_SHARD:
            for file in files:
                file.unlink(missing_ok=True)


def _row(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a record that tables contain, to save memory."""
    return {name: record[name] for name in _COLUMNS if name in record}


def write_table(path: Path, records: Sequence[Mapping[str, Any]]) -> Path:
    """Write records as a CSV table; return the path."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return write_atomically(path, buffer.getvalue().encode())
