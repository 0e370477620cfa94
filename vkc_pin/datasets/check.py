"""Validates every episode of a dataset again from its files."""

from __future__ import annotations

import contextlib
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
from vkc_pin.validation.sights import compute_visibility
from vkc_pin.validation.validate import validate
from vkc_pin.world.files.writing import check_inside, check_writable, write_atomically
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

# problems in the text
_LISTED = 20
# episodes on the statistics page
_PICTURES = 10
# episodes of which the first, middle and last images are rendered again
_RENDERED = 3
# of a pixel: of 255 levels, and [mm]
_COLOUR_TOLERANCE = 16
_DEPTH_TOLERANCE = 10
# fraction of an image's pixels that may differ, as with another renderer
_PIXEL_TOLERANCE = 0.02
# of metrics, as on another machine; relative, and [m] or [s]
_TOLERANCE = 1e-5
# reasons that an episode is invalid, in its record
_MAX_REASONS = 3


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
        lines = [f"{self.folder}: {valid} of {self.episodes} episodes are valid"]
        problems = [f"episode {number}: {text}" for number, text in self.refused.items()]
        problems += self.problems
        lines += [f"  - {line}" for line in problems[:_LISTED]]
        if len(problems) > _LISTED:
            lines.append(f"  ... and {len(problems) - _LISTED} more")
        if self.records:
            count = sum(1 for record in self.records if record["winding"])
            lines.append(
                f"  base paths that wind around an obstacle: {count} of {len(self.records)}"
            )
        if self.pixels:
            lines.append(f"  {self.pixels}")
        if self.page is not None:
            lines.append(f"  statistics: {self.page}")
        return lines

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
    jobs = check_integer(jobs, "jobs", low=1, high=4096)
    seed = check_integer(seed, "seed", low=0)
    dataset = Dataset.open(folder)
    target = dataset.folder / "statistics.html" if page is None else Path(page)
    if page is None:
        check_inside(target, dataset.folder)
    _check_page(target, dataset)
    records: list[dict[str, Any]] = []
    problems: list[str] = []
    intact_shards: list[Path] = []
    checks = _check_shards(dataset, jobs, progress=progress)
    for shard, (shard_records, shard_problems) in zip(dataset.shards, checks, strict=True):
        records += shard_records
        problems += shard_problems
        if not shard_problems:
            intact_shards.append(shard)
    problems += _check_lerobot_folders(dataset, jobs)
    failures: list[dict[str, str]] = []
    with _collect_errors(problems, "episodes.csv"):
        problems += _check_consistency(dataset, records)
    with _collect_errors(problems, "failures.csv"):
        failures = read_table(dataset.folder / "failures.csv")
    refused = {record["number"]: record["refused"] for record in records if record["refused"]}
    valid = [record["number"] for record in records if not record["refused"]]
    order = np.random.default_rng(seed).permutation(len(valid))
    chosen = [valid[k] for k in order[:_PICTURES]]
    shown_episodes = _read_by_number(dataset, intact_shards, set(chosen))
    pixels, differences = _compare_pixels(dataset.recipe, shown_episodes, chosen[:_RENDERED])
    # An unreadable episode fails the checks of both layouts for the same reason.
    reported = set(refused.values())
    different = dict.fromkeys([*problems, *differences])
    problems = [text for text in different if text not in reported]
    text = make_statistics_page(
        dataset.recipe, records, failures, shown_episodes, refused, problems
    )
    write_atomically(target, text.encode())
    return DatasetCheck(
        dataset.folder, len(records), refused, tuple(problems), tuple(records), target, pixels
    )


_ShardCheck = tuple[list[dict[str, Any]], list[str]]
"""Records of a shard's episodes, and problems of its file."""


def _check_shards(dataset: Dataset, jobs: int, *, progress: bool) -> list[_ShardCheck]:
    """Check all shards of a dataset."""
    from tqdm import tqdm

    shards = dataset.shards
    scenes = str(dataset.folder / "scenes")
    recipe = dataset.recipe.document
    tasks = ((str(k), (str(shard), scenes, recipe)) for k, shard in enumerate(shards))
    checks: dict[int, _ShardCheck] = {}
    with tqdm(total=len(shards), unit="shard", disable=not progress) as bar:
        for key, result in run_tasks(check_shard, tasks, jobs=jobs):
            k = int(key)
            if isinstance(result, CrashedTask):
                checks[k] = ([], [f"{shards[k]}: {result.reason}"])
            else:
                checks[k] = result
            bar.update()
    return [checks[k] for k in range(len(shards))]


def _check_page(page: Path, dataset: Dataset) -> None:
    """Check that a page can be written, and is no other file of the dataset."""
    place = check_writable(page, field="page")
    folder = dataset.folder.resolve()
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
    path = Path(task[0])
    scenes = Path(task[1])
    recipe = load_recipe(task[2], find_files=False)
    robot = path.parent.name
    name = f"{robot}/{path.name}"  # for messages
    records: list[dict[str, Any]] = []
    problems: list[str] = []
    with _collect_errors(problems, name), open_shard(path, scenes) as shard:
        for k in range(len(shard)):
            with _collect_errors(problems, name):
                records.append(_check_episode(shard, k, recipe, robot))
        differences = shard.find_shard_differences(robot, recipe)
        problems += [f"{name}: {difference}" for difference in differences]
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
    motion = episode.trajectory
    reasons: list[str] = []
    # Of an episode whose scene cannot be read:
    start = motion.positions[0]
    winding: dict[str, int] = {}
    seen: dict[str, float] = {}
    about: dict[str, Any] = {
        "task": "",
        "room": "",
        "object": "",
        "kind": "",
        "attachment": "",
        "goal": [],
    }
    with _collect_errors(reasons, "episode"):
        scene = episode.scene()
        start = scene.start
        winding = compute_winding_numbers(scene, motion)
        about = describe_problem(scene, episode.steps)
        seen = compute_seen_shares(recipe, scene, about, motion)
        about["variant"] = episode.number % recipe.fields.variants
        report = validate(scene, episode.steps, motion, episode.options, episode.terms)
        reasons += [str(violation) for violation in report.violations]
        reasons += report.contradictions(episode.claimed)
        truth = {**about, "robot": robot}
        metrics = {**motion.metrics(), **report.measures()}
        reasons += _find_false_claims(episode.about, truth, metrics)
        if episode.document["robot"]["name"] != robot:
            got = format_value(episode.document["robot"]["name"])
            reasons.append(f"its scene is for the robot {got}, not {robot}")
        if episode.terms != resolve_episode_terms(recipe, scene, about):
            reasons.append("its terms differ from those of the recipe")
        reasons += shard.find_differences(k, episode, scene.robot, recipe.fields.rate)
    record = {**about, **motion.metrics()}
    if np.isfinite(episode.claimed.clearance):
        record["clearance"] = episode.claimed.clearance
    record["robot"] = robot
    record["number"] = episode.number
    record["scene"] = compute_scene_name(episode.document)
    record["start"] = np.asarray(start).round(4).tolist()
    record["waypoints"] = len(motion.times)
    record["way"] = sample_coarse_trajectory(motion)
    record["seen"] = seen
    record["winding"] = sorted(winding.items())
    record["refused"] = "; ".join(reasons[:_MAX_REASONS])
    return record


def compute_seen_shares(
    recipe: Recipe, scene: Scene, about: Mapping[str, Any], motion: Trajectory
) -> dict[str, float]:
    """Return camera → share of the samples until the grasp at which it sees the attachment.

    Empty if the object is grasped from the start.

    Args:
        recipe: Recipe with the cameras.
        scene: Scene of the episode.
        about: See `Episode.about`.
        motion: Motion of the episode.
    """
    name = about["object"]
    if not recipe.cameras or name in scene.held:
        return {}
    closing = float(motion.times[-1])
    for phase in motion.phases:
        if any(hold.object == name for hold in phase.holds):
            closing = float(motion.times[phase.first])
            break
    times = sample_times(motion, recipe.fields.rate)
    times = times[times <= closing]
    target = f"{name}.{about['attachment']}"
    shares = dict[str, float]()
    for camera in recipe.cameras:
        visible = compute_visibility(scene, motion, camera, target, times)
        shares[camera.name] = float(visible.mean())
    return shares


def _compare_pixels(
    recipe: Recipe, episodes: Iterable[Episode], numbers: Iterable[int]
) -> tuple[str, list[str]]:
    """Render the first, middle and last images of episodes again.

    Returns:
        A line about the comparison, and the differences.
    """
    if not recipe.cameras:
        return "", []
    wanted = set(numbers)
    compared: list[str] = []
    problems: list[str] = []
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
        differences = _find_different_images(images, stored, samples)
        problems += [f"episode {episode.number}: {text}" for text in differences]
        listed = ", ".join(str(sample) for sample in samples.tolist())
        compared.append(f"{episode.number} (samples {listed})")
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
            new: Any = pictures[k]
            old: Any = stored.pictures[name][sample]
            if name.endswith("_segmentation"):
                new = _name_segments(found, new)
                old = _name_segments(stored, old)
            fraction = float(_find_different_pixels(new, old).mean())
            if fraction > _PIXEL_TOLERANCE:
                yield (
                    f"{fraction:.0%} of the pixels of {name}[{sample}] differ from the images "
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
    claims = dict(claims)
    claimed_metrics = claims.pop("metrics", None)
    found: list[str] = []
    for name in {**truth, **claims}:
        if name in claims and name in truth and claims[name] == truth[name]:
            continue
        got = format_value(claims.get(name))
        found.append(f"about.{name} is {got}, not {format_value(truth.get(name))}")
    if not isinstance(claimed_metrics, dict):
        found.append(f"about.metrics are {format_value(claimed_metrics)}")
        return found
    for name, value in claimed_metrics.items():
        # The number of evaluations does not follow from the motion.
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
    folder, robot = task
    dataset = Dataset.open(folder)
    problems: list[str] = []
    with _collect_errors(problems, f"lerobot/{robot}"):
        path = dataset.folder / "lerobot" / robot
        differences = find_differences(path, dataset.episodes(robot), dataset.recipe.fields.rate)
        problems += [f"lerobot/{robot}/{difference}" for difference in differences]
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
        if isinstance(result, CrashedTask):
            yield result.reason
        else:
            yield from result


def _check_consistency(dataset: Dataset, records: list[dict[str, Any]]) -> Iterator[str]:
    """Yield problems of the episodes as a whole."""
    counts = Counter(record["number"] for record in records)
    for number, count in counts.items():
        if count > 1:
            yield f"episode {number} occurs {count} times"
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
            if name in record and not _shows_value(row[name], record[name]):
                cell = f"{name} of episode {record['number']}"
                got = format_value(row[name])
                yield f"episodes.csv: {cell} is {got}, not {format_value(record[name])}"


def _shows_value(text: str, value: Any) -> bool:
    """Return whether a cell of a table shows a value, up to the rounding of numbers."""
    if not isinstance(value, float):
        return text == str(value)
    try:
        return abs(float(text) - value) <= 2.0 * _TOLERANCE * max(1.0, abs(value))
    except ValueError:
        return False


def _read_by_number(dataset: Dataset, shards: Iterable[Path], numbers: set[int]) -> list[Episode]:
    """Return the episodes with some numbers, from the shards that contain them."""
    selected: list[Episode] = []
    for shard in shards:
        if numbers.isdisjoint(read_numbers(shard)):
            continue
        for episode in read_episodes(shard, dataset.folder / "scenes"):
            if episode.number in numbers:
                selected.append(episode)
    return selected
