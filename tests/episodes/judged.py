"""Judges the episodes of a dataset with the oracle, which reads only saved plans."""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path

from tests.oracle.judge import Verdict, judge
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.episode import Episode
from vkc_pin.datasets.formats.hdf5 import read_episodes
from vkc_pin.planning.plan import Plan

__all__ = ["judge_dataset", "save_episode"]

VERDICTS = "oracle.jsonl"
"""File in a dataset's folder with one line per shard."""


def judge_dataset(folder: Path, *, jobs: int = 1) -> list[Verdict]:
    """Judge the episodes of a dataset; each shard's verdicts are saved in its folder and reused."""
    dataset = Dataset.open(folder)
    known = _read_verdicts(folder / VERDICTS)
    remaining = [shard for shard in dataset.shards if _get_name(dataset, shard) not in known]
    with (
        ProcessPoolExecutor(jobs) as pool,
        (folder / VERDICTS).open("a", encoding="utf-8") as stream,
    ):
        for shard, verdicts in zip(
            remaining, pool.map(_judge_shard, [folder] * len(remaining), remaining), strict=True
        ):
            name = _get_name(dataset, shard)
            known[name] = verdicts
            entries = [{**asdict(verdict), "path": str(verdict.path)} for verdict in verdicts]
            stream.write(json.dumps({"shard": name, "verdicts": entries}) + "\n")
            stream.flush()
    return [verdict for shard in dataset.shards for verdict in known[_get_name(dataset, shard)]]


def save_episode(episode: Episode, path: Path) -> Path:
    """Write an episode as a plan with the verdict of the dataset."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plan = Plan(
            scene=episode.scene(),
            steps=episode.steps,
            options=episode.options,
            trajectory=episode.trajectory,
            report=episode.claimed,
            status="success",
            terms=episode.terms,
        )
        return plan.save(path)


def _judge_shard(folder: Path, shard: Path) -> list[Verdict]:
    return list(_iterate_verdicts(folder, shard))


def _iterate_verdicts(folder: Path, shard: Path) -> Iterator[Verdict]:
    with tempfile.TemporaryDirectory() as work:
        for episode in read_episodes(shard, folder / "scenes"):
            verdict = judge(save_episode(episode, Path(work) / f"{episode.number:06d}.npz"))
            verdict.path.unlink()
            yield replace(verdict, path=Path(shard.parent.name) / verdict.path.name)


def _get_name(dataset: Dataset, shard: Path) -> str:
    return shard.relative_to(dataset.folder).as_posix()


def _read_verdicts(file: Path) -> dict[str, list[Verdict]]:
    if not file.is_file():
        return {}
    entries = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return {
        entry["shard"]: [
            Verdict(**{**verdict, "path": Path(verdict["path"])}) for verdict in entry["verdicts"]
        ]
        for entry in entries
    }
