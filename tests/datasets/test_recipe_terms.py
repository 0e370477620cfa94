"""Tests the terms of recipes: their values, episodes that satisfy them, and error messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.datasets import SMALL
from helpers.shards import Change, change_demo, set_description

import vkc_pin as vkc
from vkc_pin.datasets.check import check_dataset
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generation import generate
from vkc_pin.datasets.problems import resolve_episode_terms
from vkc_pin.datasets.recipe import (
    load_recipe,
)
from vkc_pin.errors import InputError

pytest.importorskip("h5py")
SPEED_LIMIT = {"type": "speed", "frame": "base", "most": 0.3}
RECIPE: dict[str, Any] = {**SMALL, "terms": [SPEED_LIMIT]}


def make_limit(function: Callable[[Any], Any], **more: Any) -> vkc.Constraint:
    return vkc.Constraint("low", function, upper=2.5, **more)


def make_height_limit(frame: str = "hand") -> vkc.Constraint:
    return make_limit(lambda s: s.position(frame)[2])


def test_terms_agree_with_numpy() -> None:
    rng = np.random.default_rng(3)
    axis = np.array([1.0, 2.0, -0.5])
    entries = [
        {"type": "upright", "frame": "object", "axis": axis.tolist(), "angle": 0.3, "held": True},
        {"type": "speed", "frame": "hand", "most": 0.4},
        {"type": "keep-out", "frame": "base", "position": [1.0, -0.5, 0.2], "size": [2, 0.6, 1]},
    ]
    terms = upright, speed, keep_out = load_recipe({**SMALL, "terms": entries}).terms
    assert [(term.name, term.holding) for term in terms] == [
        ("upright object", "object"),
        ("speed hand", None),
        ("keep-out base", None),
    ]
    for _ in range(50):
        now, before, dt = pin.SE3.Random(), pin.SE3.Random(), float(rng.uniform(0.01, 0.5))
        now.translation, before.translation = rng.uniform(-2.0, 2.0, (2, 3))
        poses = [[*one.rotation.T.ravel(), *one.translation] for one in (now, before)]
        row = np.array([[*poses[0], *poses[1], dt]])
        tilt = math.acos(float((now.rotation @ axis)[2] / np.linalg.norm(axis)))
        assert (upright.formula.evaluate(row)[0, 0] >= upright.lower) == (tilt <= 0.3)
        expected = np.linalg.norm(now.translation - before.translation) / dt
        assert speed.formula.evaluate(row)[0, 0] == pytest.approx(expected, rel=1e-6)
        inside = np.all(np.abs(now.translation - [1.0, -0.5, 0.2]) < [1.0, 0.3, 0.5])
        assert (keep_out.formula.evaluate(row)[0, 0] < 0.0) == inside


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return generate(RECIPE, 3, tmp_path_factory.mktemp("made") / "out", terms=[make_height_limit()])


@pytest.mark.long
def test_episodes_satisfy_their_terms(dataset: Dataset) -> None:
    assert [entry.type for entry in dataset.recipe.fields.terms] == ["speed", "traced"]
    for episode in dataset.episodes():
        assert [term.name for term in episode.terms] == ["speed base", "low"]
        assert [term.formula.frames for term in episode.terms] == [
            ("base",),
            (episode.scene().robot.tool_frame,),
        ]
        assert episode.validate().ok
        times = episode.trajectory.times
        fine = np.linspace(times[0], times[-1], 2000)
        speeds = np.linalg.norm(episode.trajectory.velocity(fine)[:, :2], axis=1)
        assert speeds.max() < 0.3 + 1e-2
    assert check_dataset(dataset.folder).ok


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (set_description("terms", 0, "upper", value=0.01), "speed base"),
        (set_description("terms", value=[]), "terms differ from those of the recipe"),
    ],
)
def test_violated_and_missing_terms_are_reported(
    copy: Path, shard: Path, change: Change, reason: str
) -> None:
    number = change_demo(shard, change, 1)
    found = check_dataset(copy)
    assert list(found.refused) == [number]
    assert reason in found.refused[number]


def test_dataset_keeps_its_terms(dataset: Dataset) -> None:
    assert load_recipe(dataset.recipe.document).digest == dataset.recipe.digest
    assert load_recipe(dataset.folder / "recipe.yaml").terms == dataset.recipe.terms
    with pytest.raises(InputError, match="run otherwise"):
        generate(RECIPE, 3, dataset.folder)
    again = generate(RECIPE, 3, dataset.folder, terms=[make_height_limit()])
    assert again.numbers() == dataset.numbers()


def test_terms_apply_only_to_their_tasks(dataset: Dataset) -> None:
    tasks, limit = ["given-open", "drive-open"], {**SPEED_LIMIT, "tasks": ["drive-open"]}
    recipe = load_recipe({**SMALL, "tasks": tasks, "terms": [limit]})
    episode = next(dataset.episodes())
    counts = [
        len(resolve_episode_terms(recipe, episode.scene(), {**episode.about, "task": task}))
        for task in tasks
    ]
    assert counts == [0, 1]


@pytest.mark.parametrize(
    ("terms", "text"),
    [
        ([make_height_limit("hnd")], "did you mean 'hand'"),
        ([make_limit(lambda s: s.coordinate("elbow"))], "coordinate of husky_ur5e"),
        ([make_limit(lambda s: s.position("hand")[2], during="reach")], "are not known yet"),
        ([make_height_limit(), make_height_limit()], "two terms share a name"),
        (["low"], "a list of Constraint and Cost"),
        (3, "not a list"),
    ],
)
def test_invalid_terms_write_no_files(tmp_path: Path, terms: Any, text: str) -> None:
    with pytest.raises(InputError) as caught:
        generate(SMALL, 1, tmp_path / "out", terms=terms)
    assert text in str(caught.value)
    assert not (tmp_path / "out").exists()
