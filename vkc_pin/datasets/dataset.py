"""A dataset's folder: what is where, what belongs to it, and shards that are written when they are full."""

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
from vkc_pin.world.files.resources import file_path
from vkc_pin.world.files.writing import check_name, write_atomically

__all__ = ["EPISODES_A_SHARD", "Dataset", "Register", "write_table"]

EPISODES_A_SHARD = 100
"""Episodes in one file; the last of each robot has fewer."""
_COLUMNS = (
    *(
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
    ),
    *(
        "duration",
        "base_effort",
        "arm_effort",
        "clearance",
        "waypoints",
        "scene",
        "seconds",
        "planning_time",
    ),
)


@dataclass(frozen=True)
class Dataset:
    """A folder of episodes.

    Attributes:
        folder: Where it is.
        recipe: What its episodes are like.
    """

    folder: Path
    recipe: Recipe

    @classmethod
    def open(cls, folder: str | Path) -> Dataset:
        """Return the dataset in a folder.

        Raises:
            InputError: There is none.
        """
        path = file_path(folder, "folder", "a folder that `vkc-pin generate` has written")
        if not (path / "recipe.yaml").is_file():
            raise InputError(
                "there is no dataset",
                file=path,
                expected="a folder that `vkc-pin generate` has written",
            )
        return cls(path, load_recipe(path / "recipe.yaml"))

    @property
    def shards(self) -> list[Path]:
        """Its shards, by robot and number."""
        return sorted((self.folder / "shards").glob("*/shard-*.hdf5"))

    def numbers(self) -> list[int]:
        """Return the numbers of all episodes, shard after shard."""
        return [number for shard in self.shards for number in read_numbers(shard)]

    def episodes(self) -> Iterator[Episode]:
        """Yield all episodes, shard after shard, read one at a time.

        Raises:
            InputError: A file is damaged.
        """
        for shard in self.shards:
            yield from read_episodes(shard, self.folder / "scenes")


class Register:
    """Decides, in the order of their numbers, which attempts are episodes of a dataset, and puts these into shards.

    Attempts end in any order; what they become depends on those of lower numbers alone, so that
    neither the number of processes nor any stop makes a difference.

    Attributes:
        accepted: Of the records of the episodes what tables have, in order.
        failures: The same of attempts that are none, in order; near-duplicates among them.
    """

    def __init__(self, dataset: Dataset, wanted: int) -> None:
        self.dataset, self.wanted = dataset, wanted
        self.accepted: list[Mapping[str, Any]] = []
        self.failures: list[Mapping[str, Any]] = []
        self._shards: dict[Path, list[int]] = {}  # folder of a robot's shards → its episodes
        self._early: dict[int, Mapping[str, Any]] = {}
        self._next, self._seen = 0, DuplicateFinder()

    @property
    def full(self) -> bool:
        """Whether there are as many episodes as were asked for."""
        return len(self.accepted) >= self.wanted

    @property
    def decided(self) -> int:
        """How many attempts are decided about."""
        return self._next

    def add(self, record: Mapping[str, Any]) -> None:
        """Take note of what came of an attempt."""
        self._early[int(record["number"])] = record
        while self._next in self._early and not self.full:
            self._decide(self._early.pop(self._next))
            self._next += 1

    def _decide(self, record: Mapping[str, Any]) -> None:
        if not record["success"]:
            self.failures.append(_row(record))
            return
        twin = self._seen.find_duplicate(record)
        if twin is not None:
            reason = f"nearly the same motion as that of episode {twin}"
            self.failures.append(_row({**record, "status": "duplicate", "reason": reason}))
            return
        name = check_name(record.get("robot"), "robot", file=self.dataset.folder / "journal.jsonl")
        folder = self.dataset.folder / "shards" / name
        self.accepted.append(_row(record))
        own = self._shards.setdefault(folder, [])
        own.append(int(record["number"]))
        if len(own) % EPISODES_A_SHARD == 0:
            self._write(folder, len(own) // EPISODES_A_SHARD - 1)

    def finish(self) -> None:
        """Write the shards that are not full, and the tables."""
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
        there = read_numbers(path) if path.is_file() else []
        if there != numbers:
            # What somebody has removed of the files may be in the shard that is replaced.
            parts = [
                (file, 0) if file.is_file() or number not in there else (path, there.index(number))
                for file, number in zip(files, numbers, strict=True)
            ]
            write_shard(path, parts, self.dataset.folder / "scenes")
        if len(numbers) == EPISODES_A_SHARD:
            for file in files:
                file.unlink(missing_ok=True)


def _row(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return what tables have of a record: the rest, most of it, would stay in memory for nothing."""
    return {name: record[name] for name in _COLUMNS if name in record}


def write_table(path: Path, records: Sequence[Mapping[str, Any]]) -> Path:
    """Write records as a table with a line each; return the path."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(_COLUMNS)
    writer.writerows([record.get(name, "") for name in _COLUMNS] for record in records)
    return write_atomically(path, buffer.getvalue().encode())
