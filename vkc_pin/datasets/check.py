"""Validates every episode of a dataset again from its files."""

from __future__ import annotations

import csv
import io
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.diversity import (
    DuplicateFinder,
    compute_winding_numbers,
    sample_coarse_trajectory,
)
from vkc_pin.datasets.episode import Episode, compute_scene_name
from vkc_pin.datasets.formats.hdf5 import read_episodes, read_numbers
from vkc_pin.datasets.problems import resolve_episode_terms
from vkc_pin.datasets.recipes.recipe import Recipe, load_recipe
from vkc_pin.datasets.statistics import make_statistics_page
from vkc_pin.errors import InputError, VkcError
from vkc_pin.utils.arguments import check_integer
from vkc_pin.utils.parallel.engine import CrashedTask, is_dask_installed, run_tasks
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.writing import check_inside, check_writable, write_atomically

__all__ = ["DatasetCheck", "check_dataset"]

_LISTED = 20  # problems in the text
_PICTURES = 10  # episodes on the statistics page


@dataclass(frozen=True)
class DatasetCheck:
    """Result of the check of a dataset.

    Attributes:
        folder: Folder of the dataset.
        episodes: Number of episodes.
        refused: Maps the number of each invalid episode to the reason.
        problems: Other problems, one line each: damaged files, repeated numbers, near-duplicates.
        records: A record of every episode, see `statistics`.
        page: The statistics page.
    """

    folder: Path
    episodes: int
    refused: Mapping[int, str]
    problems: tuple[str, ...]
    records: tuple[Mapping[str, Any], ...]
    page: Path | None = None

    @property
    def ok(self) -> bool:
        """Whether no episode is invalid and there is no other problem."""
        return not self.refused and not self.problems

    def lines(self) -> list[str]:
        """Return the result as lines of text."""
        valid = self.episodes - len(self.refused)
        found = [f"{self.folder}: {valid} of {self.episodes} episodes are valid"]
        problems = [f"episode {number}: {text}" for number, text in self.refused.items()]
        problems += self.problems
        found += [f"  - {line}" for line in problems[:_LISTED]]
        found += [f"  ... and {len(problems) - _LISTED} more"] if len(problems) > _LISTED else []
        winding = Counter(tuple(sorted(record["winding"])) != () for record in self.records)
        if self.records:
            found.append(
                f"  base paths that wind around an obstacle: {winding[True]} of {len(self.records)}"
            )
        if self.page is not None:
            found.append(f"  statistics: {self.page}")
        return found

    def __str__(self) -> str:
        return "\n".join(self.lines())


def check_dataset(
    folder: str | Path,
    *,
    jobs: int = 1,
    page: str | Path | None = None,
    seed: int = 0,
    progress: bool = False,
) -> DatasetCheck:
    """Validate every episode of a dataset again, and write a page of statistics.

    The check is independent of planning: scenes are built from their files by content, trajectories
    are read from the shards, and the independent validation checks both.

    Args:
        folder: The dataset.
        jobs: Processes on this machine.
        page: File of the page; defaults to `statistics.html` in the folder.
        seed: Random seed of the ten episodes that are shown.
        progress: Whether to show a progress bar.

    Raises:
        InputError: There is no dataset, or the page cannot be written.
    """
    from tqdm import tqdm

    jobs, seed = check_integer(jobs, "jobs", low=1, high=4096), check_integer(seed, "seed", low=0)
    dataset = Dataset.open(folder)
    target = dataset.folder / "statistics.html" if page is None else Path(page)
    if page is None:
        check_inside(target, dataset.folder)
    check_writable(target, field="page")
    shards = dataset.shards
    recipe = dataset.recipe.document
    tasks = (
        (str(k), (str(shard), str(dataset.folder / "scenes"), recipe))
        for k, shard in enumerate(shards)
    )
    found: dict[int, tuple[list[dict[str, Any]], list[str]]] = {}
    with tqdm(total=len(shards), unit="shard", disable=not progress) as bar:
        for key, result in run_tasks(check_shard, tasks, jobs=jobs, dask=is_dask_installed()):
            found[int(key)] = (
                ([], [f"{shards[int(key)]}: {result.reason}"])
                if isinstance(result, CrashedTask)
                else result
            )
            bar.update()
    records = [record for k in sorted(found) for record in found[k][0]]
    problems = [text for k in sorted(found) for text in found[k][1]]
    problems += _check_consistency(dataset, records)
    refused = {record["number"]: record["refused"] for record in records if record["refused"]}
    failures = _read_table(dataset.folder / "failures.csv")
    chosen = np.random.default_rng(seed).permutation(len(records))[:_PICTURES]
    intact_shards = [shard for k, shard in enumerate(shards) if not found[k][1]]
    shown_episodes = _read_selected(dataset, intact_shards, {records[k]["number"] for k in chosen})
    text = make_statistics_page(
        dataset.recipe, records, failures, shown_episodes, refused, problems
    )
    write_atomically(target, text.encode())
    return DatasetCheck(
        dataset.folder, len(records), refused, tuple(problems), tuple(records), target
    )


def check_shard(
    task: tuple[str, str, Mapping[str, Any]],
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return records of a shard's episodes, and problems of its file.

    Args:
        task: The shard, the folder of its scenes, and its recipe's document.
    """
    shard, scenes, recipe = Path(task[0]), Path(task[1]), load_recipe(task[2])
    records: list[dict[str, Any]] = []
    try:
        for episode in read_episodes(shard, scenes):
            records.append(_check_episode(episode, recipe))
    except (VkcError, OSError) as error:
        return records, [f"{shard.name}: {error}"]
    return records, []


def _check_episode(episode: Episode, recipe: Recipe) -> dict[str, Any]:
    """Return the record of an episode; "refused" is the reason if it is invalid, else ""."""
    about = dict(episode.about)
    motion = episode.trajectory
    refused, winding, start = "", {}, motion.positions[0]
    try:
        scene = episode.scene()
        report = episode.validate()
        reasons = [str(violation) for violation in report.violations] + report.contradictions(
            episode.claimed
        )
        if episode.terms != resolve_episode_terms(recipe, scene, about):
            reasons.append("its terms differ from those of the recipe")
        refused, winding = "; ".join(reasons[:3]), compute_winding_numbers(scene, motion)
        start = scene.start
    except VkcError as error:
        refused = str(error)
    return {
        **{key: value for key, value in about.items() if key != "metrics"},
        **about.get("metrics", {}),
        "number": episode.number,
        "scene": compute_scene_name(episode.document),
        "start": np.asarray(start).round(4).tolist(),
        "way": sample_coarse_trajectory(motion),
        "winding": sorted(winding.items()),
        "refused": refused,
    }


def _check_consistency(dataset: Dataset, records: list[dict[str, Any]]) -> Iterator[str]:
    """Yield problems of the episodes as a whole."""
    counts = Counter(record["number"] for record in records)
    yield from (
        f"episode {number} occurs {count} times" for number, count in counts.items() if count > 1
    )
    finder = DuplicateFinder()
    for record in sorted(records, key=lambda record: int(record["number"])):
        duplicate = finder.find_duplicate(record)
        if duplicate is not None and duplicate != record["number"]:
            yield f"episode {record['number']} is nearly the same as {duplicate}"
    table = {int(row["number"]) for row in _read_table(dataset.folder / "episodes.csv")}
    if table != set(counts):
        yield f"episodes.csv names {len(table)} episodes, the shards have {len(counts)}"


def _read_table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table that `generate` wrote."""
    if not path.is_file():
        return []
    try:
        return list(csv.DictReader(io.StringIO(read_text(path, "CSV"))))
    except csv.Error as error:
        raise InputError("the file is not a CSV table", file=path, got=str(error)) from error


def _read_selected(dataset: Dataset, shards: Iterable[Path], numbers: set[int]) -> list[Episode]:
    """Return the episodes with some numbers, from the shards that contain them."""
    shards = (shard for shard in shards if numbers & set(read_numbers(shard)))
    every = itertools.chain.from_iterable(
        read_episodes(shard, dataset.folder / "scenes") for shard in shards
    )
    return [episode for episode in every if episode.number in numbers]
