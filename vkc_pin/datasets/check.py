"""Validates every episode of a dataset again from its files."""

from __future__ import annotations

import contextlib
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.datasets.dataset import MEMBERS, Dataset, read_table
from vkc_pin.datasets.diversity import (
    DuplicateFinder,
    compute_winding_numbers,
    sample_coarse_trajectory,
)
from vkc_pin.datasets.episode import Episode, compute_scene_name, sample_times
from vkc_pin.datasets.formats.hdf5 import Shard, open_shard, read_episodes, read_numbers
from vkc_pin.datasets.formats.lerobot import find_differences
from vkc_pin.datasets.problems import describe_problem, resolve_episode_terms
from vkc_pin.datasets.recipe import Recipe, load_recipe
from vkc_pin.datasets.statistics import make_statistics_page
from vkc_pin.errors import InputError, VkcError, format_value
from vkc_pin.simulation.cameras import Images, render_images
from vkc_pin.simulation.execution import simulate
from vkc_pin.utils.arguments import check_integer, is_number
from vkc_pin.utils.arrays import Bools, Ints
from vkc_pin.utils.parallel import CrashedTask, run_tasks
from vkc_pin.validation.validate import validate
from vkc_pin.world.files.writing import check_inside, check_writable, write_atomically

_LISTED = 20  # problems in the text
_PICTURES = 10  # episodes on the statistics page
_RENDERED = 3  # episodes of which the first, middle and last images are rendered again
_COLOUR_TOLERANCE, _DEPTH_TOLERANCE = 16, 10  # of a pixel: of 255 levels, and [mm]
_PIXEL_TOLERANCE = 0.02  # share of an image's pixels that may differ, as with another renderer
_TOLERANCE = 1e-5  # of metrics, as on another machine; relative, and [m] or [s]


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
        pixels: Which camera images were rendered again and compared, or why none; empty without
            cameras.
    """

    folder: Path
    episodes: int
    refused: Mapping[int, str]
    problems: tuple[str, ...]
    records: tuple[Mapping[str, Any], ...]
    page: Path | None = None
    pixels: str = ""

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
        if self.pixels:
            found.append(f"  {self.pixels}")
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
    are read from the shards, and the independent validation checks both. Everything else that a
    learner reads is made again from scene, steps and trajectory, and compared: samples, masks and
    descriptions in the shards, LeRobot's layout, and episodes.csv. Camera images have the right
    sizes, and in LeRobot's layout the pixels of the shards; those of three episodes, which depend
    on `seed`, are rendered again if OpenGL is available.

    Args:
        folder: The dataset.
        jobs: Processes on this machine.
        page: File of the page; defaults to `statistics.html` in the folder.
        seed: Random seed of the ten episodes that are shown, three of them with images compared.
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
    _check_page(target, dataset)
    shards = dataset.shards
    recipe = dataset.recipe.document
    tasks = (
        (str(k), (str(shard), str(dataset.folder / "scenes"), recipe))
        for k, shard in enumerate(shards)
    )
    found: dict[int, tuple[list[dict[str, Any]], list[str]]] = {}
    with tqdm(total=len(shards), unit="shard", disable=not progress) as bar:
        for key, result in run_tasks(check_shard, tasks, jobs=jobs):
            found[int(key)] = (
                ([], [f"{shards[int(key)]}: {result.reason}"])
                if isinstance(result, CrashedTask)
                else result
            )
            bar.update()
    records = [record for k in sorted(found) for record in found[k][0]]
    problems = [text for k in sorted(found) for text in found[k][1]]
    problems += _check_lerobot_folders(dataset, jobs)
    failures: list[dict[str, str]] = []
    with _collect_errors(problems, "episodes.csv"):
        problems += _check_consistency(dataset, records)
    with _collect_errors(problems, "failures.csv"):
        failures = read_table(dataset.folder / "failures.csv")
    refused = {record["number"]: record["refused"] for record in records if record["refused"]}
    valid = [record["number"] for record in records if not record["refused"]]
    chosen = np.random.default_rng(seed).permutation(len(valid))[:_PICTURES]
    intact_shards = [shard for k, shard in enumerate(shards) if not found[k][1]]
    shown_episodes = _read_selected(dataset, intact_shards, {valid[k] for k in chosen})
    pixels, differences = _compare_pixels(
        dataset.recipe, shown_episodes, [valid[k] for k in chosen[:_RENDERED]]
    )
    # An unreadable episode fails the checks of both layouts for the same reason.
    reported = set(refused.values())
    problems = [text for text in dict.fromkeys([*problems, *differences]) if text not in reported]
    text = make_statistics_page(
        dataset.recipe, records, failures, shown_episodes, refused, problems
    )
    write_atomically(target, text.encode())
    return DatasetCheck(
        dataset.folder, len(records), refused, tuple(problems), tuple(records), target, pixels
    )


def _check_page(page: Path, dataset: Dataset) -> None:
    """Check that a page can be written, and is no other file of the dataset."""
    place, folder = check_writable(page, field="page"), dataset.folder.resolve()
    if place.is_relative_to(folder) and place.relative_to(folder).parts[0] in MEMBERS:
        expected = "statistics.html, or a file elsewhere"
        raise InputError("a file of the dataset", file=page, field="page", expected=expected)


def check_shard(
    task: tuple[str, str, Mapping[str, Any]],
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return records of a shard's episodes, and problems of its file.

    Args:
        task: The shard, the folder of its scenes, and its recipe's document.
    """
    path, scenes, recipe = Path(task[0]), Path(task[1]), load_recipe(task[2], find_files=False)
    records, problems = list[dict[str, Any]](), list[str]()
    name = f"{path.parent.name}/{path.name}"  # for messages
    with _collect_errors(problems, name), open_shard(path, scenes) as shard:
        for k in range(len(shard)):
            with _collect_errors(problems, name):
                records.append(_check_episode(shard, k, recipe, path.parent.name))
        found = shard.find_shard_differences(path.parent.name, recipe)
        problems += [f"{name}: {difference}" for difference in found]
    return records, problems


@contextlib.contextmanager
def _collect_errors(problems: list[str], name: str) -> Iterator[None]:
    """Add errors to problems, so that one file or episode does not end the check of others."""
    try:
        yield
    except VkcError as error:
        problems.append(str(error))
    except Exception as error:  # whatever a file of others contains
        problems.append(f"{name}: {type(error).__name__}: {error}")


def _check_episode(shard: Shard, k: int, recipe: Recipe, robot: str) -> dict[str, Any]:
    """Return the record of an episode; "refused" is the reason if it is invalid, else ""."""
    episode = shard.read(k)
    motion, reasons = episode.trajectory, list[str]()
    winding: dict[str, int] = {}
    start, fields = motion.positions[0], ("task", "room", "object", "kind", "attachment")
    about: dict[str, Any] = {**dict.fromkeys(fields, ""), "goal": []}
    with _collect_errors(reasons, "episode"):
        scene = episode.scene()
        start, winding = scene.start, compute_winding_numbers(scene, motion)
        about = describe_problem(scene, episode.steps)
        about["variant"] = episode.number % recipe.fields.variants
        report = validate(scene, episode.steps, motion, episode.options, episode.terms)
        reasons += [str(violation) for violation in report.violations]
        reasons += report.contradictions(episode.claimed)
        reasons += _find_false_claims(
            episode.about,
            {**about, "robot": robot},
            {**motion.metrics(), **report.measures()},
        )
        if episode.document["robot"]["name"] != robot:
            got = format_value(episode.document["robot"]["name"])
            reasons.append(f"its scene is for the robot {got}, not {robot}")
        if episode.terms != resolve_episode_terms(recipe, scene, about):
            reasons.append("its terms differ from those of the recipe")
        reasons += shard.find_differences(k, episode, scene.robot, recipe.fields.rate)
    clearance = episode.claimed.clearance
    return {
        **about,
        **motion.metrics(),
        **({"clearance": clearance} if np.isfinite(clearance) else {}),
        "robot": robot,
        "number": episode.number,
        "scene": compute_scene_name(episode.document),
        "start": np.asarray(start).round(4).tolist(),
        "waypoints": len(motion.times),
        "way": sample_coarse_trajectory(motion),
        "winding": sorted(winding.items()),
        "refused": "; ".join(reasons[:3]),
    }


def _compare_pixels(
    recipe: Recipe, episodes: Iterable[Episode], numbers: Iterable[int]
) -> tuple[str, list[str]]:
    """Render the first, middle and last images of episodes again.

    Returns:
        What was compared, and the differences.
    """
    compared, problems, wanted = list[str](), list[str](), set(numbers)
    if not recipe.cameras:
        return "", []
    for episode in sorted(episodes, key=lambda episode: episode.number):
        stored = episode.images() if episode.number in wanted else None
        if stored is None:
            continue
        times = sample_times(episode.trajectory, recipe.fields.rate)
        samples = np.unique([0, len(times) // 2, len(times) - 1])
        try:
            executed = simulate(episode.scene(), episode.steps, episode.trajectory)
            images = render_images(executed, recipe.cameras, times[samples])
        except VkcError as error:  # no OpenGL on this machine
            return f"pixels not compared: {error}", problems
        found = _find_different_images(images, stored, samples)
        problems += [f"episode {episode.number}: {text}" for text in found]
        compared.append(f"{episode.number} (samples {', '.join(map(str, samples.tolist()))})")
    if not compared:
        return "pixels not compared: no valid episode has images", problems
    return f"pixels rendered again and compared: episode {', '.join(compared)}", problems


def _find_different_images(found: Images, stored: Images, samples: Ints) -> Iterator[str]:
    """Yield which of the stored images of some samples differ from those found there."""
    for name, pictures in found.pictures.items():
        if name not in stored.pictures:
            yield f"{name}: missing"
            continue
        for k, sample in enumerate(samples.tolist()):
            new, old = (
                _name_segments(images, pixels) if name.endswith("_segmentation") else pixels
                for images, pixels in (
                    (found, pictures[k]),
                    (stored, stored.pictures[name][sample]),
                )
            )
            share = float(_find_different_pixels(new, old).mean())
            if share > _PIXEL_TOLERANCE:
                yield (
                    f"{share:.0%} of the pixels of {name}[{sample}] differ from the images "
                    f"rendered again, {_PIXEL_TOLERANCE:.0%} may"
                )


def _find_different_pixels(new: Any, old: Any) -> Bools:
    """Return which pixels of an image differ by more than the tolerance, shape (H, W)."""
    if new.dtype.kind not in "iu":  # names of segments
        return np.asarray(new != old)
    difference = np.abs(new.astype(int) - old.astype(int))
    if difference.ndim == 3:
        return np.asarray(difference.max(axis=2) > _COLOUR_TOLERANCE)
    return np.asarray(difference > _DEPTH_TOLERANCE)


def _name_segments(images: Images, pixels: Any) -> Any:
    """Return the name of the body that each pixel shows; "?" for numbers without a name."""
    names = np.array([*images.segments, "?"])
    return names[np.minimum(pixels, len(images.segments))]


def _find_false_claims(
    claims: Mapping[str, Any], truth: Mapping[str, Any], metrics: Mapping[str, float]
) -> list[str]:
    """Return false values of an episode's `about`.

    Args:
        claims: See `Episode.about`.
        truth: True values.
        metrics: True metrics, of which the claims have some.
    """
    claims, claimed = dict(claims), claims.get("metrics")
    claims.pop("metrics", None)
    numbers = claimed if isinstance(claimed, dict) else {}
    found = [
        f"about.{name} is {format_value(claims.get(name))}, not {format_value(truth.get(name))}"
        for name in {**truth, **claims}
        if name not in claims or name not in truth or claims[name] != truth[name]
    ]
    if claimed is not numbers:
        found.append(f"about.metrics are {format_value(claimed)}")
    for name, value in numbers.items():
        known = metrics.get(name, value if name == "evaluations" else np.nan)
        if not is_number(value) or not abs(value - known) <= _TOLERANCE * max(1.0, abs(known)):
            got = format_value(value)
            found.append(f"about.metrics.{name} is {got}, not {format_value(known)}")
    return found


def check_lerobot(task: tuple[str, str]) -> list[str]:
    """Return problems of the episodes of a robot in LeRobot's layout.

    Args:
        task: The dataset, and the robot.
    """
    dataset, robot = Dataset.open(task[0]), task[1]
    problems: list[str] = []
    with _collect_errors(problems, f"lerobot/{robot}"):
        found = find_differences(
            dataset.folder / "lerobot" / robot, dataset.episodes(robot), dataset.recipe.fields.rate
        )
        problems += [f"lerobot/{robot}/{difference}" for difference in found]
    return problems


def _check_lerobot_folders(dataset: Dataset, jobs: int) -> Iterator[str]:
    """Yield problems of the episodes in LeRobot's layout, if there are any."""
    folder = dataset.folder / "lerobot"
    if not folder.exists():
        return
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    for name in sorted(names - set(dataset.robots)):
        yield f"lerobot/{name}: there are no episodes of this robot"
    for name in sorted(set(dataset.robots) - names):
        yield f"lerobot/{name}: missing"
    tasks = ((name, (str(dataset.folder), name)) for name in dataset.robots if name in names)
    found = dict(run_tasks(check_lerobot, tasks, jobs=jobs))
    for name in sorted(found):
        result = found[name]
        yield from [result.reason] if isinstance(result, CrashedTask) else result


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
    table = {int(row["number"]): row for row in read_table(dataset.folder / "episodes.csv")}
    if set(table) != set(counts):
        yield f"episodes.csv names {len(table)} episodes, {len(counts)} can be read"
    for record in records:
        if record["refused"]:  # reported already; an unreadable scene has no values to compare
            continue
        row = table.get(record["number"], {})
        for name in row:
            if name in record and not _is_cell_of(row[name], record[name]):
                got, expected = format_value(row[name]), format_value(record[name])
                yield f"episodes.csv: {name} of episode {record['number']} is {got}, not {expected}"


def _is_cell_of(text: str, value: Any) -> bool:
    """Return whether a cell of a table shows a value, up to the rounding of numbers."""
    if not isinstance(value, float):
        return text == str(value)
    try:
        return abs(float(text) - value) <= 2.0 * _TOLERANCE * max(1.0, abs(value))
    except ValueError:
        return False


def _read_selected(dataset: Dataset, shards: Iterable[Path], numbers: set[int]) -> list[Episode]:
    """Return the episodes with some numbers, from the shards that contain them."""
    shards = (shard for shard in shards if numbers & set(read_numbers(shard)))
    every = itertools.chain.from_iterable(
        read_episodes(shard, dataset.folder / "scenes") for shard in shards
    )
    return [episode for episode in every if episode.number in numbers]
