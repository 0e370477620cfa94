"""check_dataset(): every episode of a dataset validated again, from its files alone."""

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
from vkc_pin.utils.arguments import whole
from vkc_pin.utils.parallel.engine import Died, clustered, results
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.writing import check_inside, check_writable, write_atomically

__all__ = ["DatasetCheck", "check_dataset"]

_SHOWN = 20  # problems that the text names
_PICTURES = 10  # episodes on the page of statistics


@dataclass(frozen=True)
class DatasetCheck:
    """What a check of a dataset found.

    Attributes:
        folder: Whose.
        episodes: How many there are.
        refused: Number of an episode → what the validation says against it.
        problems: What else is wrong, a line each: damaged files, numbers that occur twice,
            near-duplicates.
        records: What is known of every episode, see `statistics`.
        page: The page of statistics.
    """

    folder: Path
    episodes: int
    refused: Mapping[int, str]
    problems: tuple[str, ...]
    records: tuple[Mapping[str, Any], ...]
    page: Path | None = None

    @property
    def ok(self) -> bool:
        """Whether there is nothing against any episode."""
        return not self.refused and not self.problems

    def lines(self) -> list[str]:
        """Return it as lines of text."""
        sure = self.episodes - len(self.refused)
        found = [f"{self.folder}: {sure} of {self.episodes} episodes are valid"]
        told = [f"episode {number}: {text}" for number, text in self.refused.items()]
        told += self.problems
        found += [f"  - {line}" for line in told[:_SHOWN]]
        found += [f"  ... and {len(told) - _SHOWN} more"] if len(told) > _SHOWN else []
        wound = Counter(tuple(sorted(record["winding"])) != () for record in self.records)
        if self.records:
            found.append(
                f"  paths of the base that go round something: {wound[True]} of {len(self.records)}"
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

    Nothing is taken from planning: scenes are built anew from the files by their content, motions
    are read from the shards, and the independent validation looks at both.

    Args:
        folder: The dataset.
        jobs: Processes on this machine.
        page: The file of the page; None: `statistics.html` in the folder.
        seed: Of which ten episodes are drawn.
        progress: Show a progress bar.

    Raises:
        InputError: There is no dataset, or the page cannot be written.
    """
    from tqdm import tqdm

    jobs, seed = whole(jobs, "jobs", low=1, high=4096), whole(seed, "seed", low=0)
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
        for key, result in results(check_shard, tasks, jobs=jobs, dask=clustered()):
            found[int(key)] = (
                ([], [f"{shards[int(key)]}: {result.reason}"])
                if isinstance(result, Died)
                else result
            )
            bar.update()
    records = [record for k in sorted(found) for record in found[k][0]]
    problems = [text for k in sorted(found) for text in found[k][1]]
    problems += _together(dataset, records)
    refused = {record["number"]: record["refused"] for record in records if record["refused"]}
    failures = _table(dataset.folder / "failures.csv")
    chosen = np.random.default_rng(seed).permutation(len(records))[:_PICTURES]
    whole_ones = [shard for k, shard in enumerate(shards) if not found[k][1]]
    pictured = _named(dataset, whole_ones, {records[k]["number"] for k in chosen})
    text = make_statistics_page(dataset.recipe, records, failures, pictured, refused, problems)
    write_atomically(target, text.encode())
    return DatasetCheck(
        dataset.folder, len(records), refused, tuple(problems), tuple(records), target
    )


def check_shard(
    task: tuple[str, str, Mapping[str, Any]],
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return what is known of the episodes of a shard, by its scenes' folder and its recipe, and what is wrong with the file."""
    shard, scenes, recipe = Path(task[0]), Path(task[1]), load_recipe(task[2])
    records: list[dict[str, Any]] = []
    try:
        for episode in read_episodes(shard, scenes):
            records.append(_looked_at(episode, recipe))
    except (VkcError, OSError) as error:
        return records, [f"{shard.name}: {error}"]
    return records, []


def _looked_at(episode: Episode, recipe: Recipe) -> dict[str, Any]:
    """Return what is known of an episode; "refused" says what the validation says against it, "" if nothing."""
    about = dict(episode.about)
    motion = episode.trajectory
    refused, winding, start = "", {}, motion.positions[0]
    try:
        scene = episode.scene()
        report = episode.validate()
        said = [str(violation) for violation in report.violations] + report.contradictions(
            episode.claimed
        )
        if episode.terms != resolve_episode_terms(recipe, scene, about):
            said.append("its own terms are not those of the recipe")
        refused, winding = "; ".join(said[:3]), compute_winding_numbers(scene, motion)
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


def _together(dataset: Dataset, records: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what is wrong with the episodes as a whole."""
    counts = Counter(record["number"] for record in records)
    yield from (
        f"episode {number} is there {count} times" for number, count in counts.items() if count > 1
    )
    seen = DuplicateFinder()
    for record in sorted(records, key=lambda record: int(record["number"])):
        twin = seen.find_duplicate(record)
        if twin is not None and twin != record["number"]:
            yield f"episode {record['number']} is nearly the same as {twin}"
    table = {int(row["number"]) for row in _table(dataset.folder / "episodes.csv")}
    if table != set(counts):
        yield f"episodes.csv names {len(table)} episodes, the shards have {len(counts)}"


def _table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table that generating has written."""
    if not path.is_file():
        return []
    try:
        return list(csv.DictReader(io.StringIO(read_text(path, "CSV"))))
    except csv.Error as error:
        raise InputError("not a table", file=path, got=str(error)) from error


def _named(dataset: Dataset, shards: Iterable[Path], numbers: set[int]) -> list[Episode]:
    """Return the episodes of some numbers, reading only the shards that have them."""
    shards = (shard for shard in shards if numbers & set(read_numbers(shard)))
    every = itertools.chain.from_iterable(
        read_episodes(shard, dataset.folder / "scenes") for shard in shards
    )
    return [episode for episode in every if episode.number in numbers]
