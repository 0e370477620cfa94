"""Tests the terms of recipes: their values, episodes that satisfy them, and error messages."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.datasets import SMALL

import vkc_pin as vkc
from vkc_pin.datasets.check import check_dataset
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generation import generate
from vkc_pin.datasets.problems import resolve_episode_terms
from vkc_pin.datasets.recipe import (
    KeepOutSchema,
    SpeedSchema,
    TracedSchema,
    UprightSchema,
    load_recipe,
)
from vkc_pin.errors import InputError

h5py = pytest.importorskip("h5py")
SPEED_LIMIT = {"type": "speed", "frame": "base", "most": 0.3}
RECIPE: dict[str, Any] = {**SMALL, "terms": [SPEED_LIMIT]}


def make_height_limit(frame: str = "hand") -> vkc.Constraint:
    return vkc.Constraint("low", lambda s: s.position(frame)[2], upper=2.5)


def make_recipe(*terms: dict[str, Any]) -> Any:
    return load_recipe({**SMALL, "terms": list(terms)})


def flatten_inputs(now: pin.SE3, before: pin.SE3, dt: float) -> np.ndarray:
    columns = [np.concatenate([one.rotation.T.ravel(), one.translation]) for one in (now, before)]
    return np.concatenate([*columns, [dt]])[None]


def test_terms_agree_with_numpy() -> None:
    rng = np.random.default_rng(3)
    axis = np.array([1.0, 2.0, -0.5])
    upright, speed, keep_out = make_recipe(
        {"type": "upright", "frame": "object", "axis": axis.tolist(), "angle": 0.3, "held": True},
        {"type": "speed", "frame": "hand", "most": 0.4},
        {
            "type": "keep-out",
            "frame": "base",
            "position": [1.0, -0.5, 0.2],
            "size": [2.0, 0.6, 1.0],
        },
    ).terms
    assert [term.name for term in (upright, speed, keep_out)] == [
        "upright object",
        "speed hand",
        "keep-out base",
    ]
    assert [term.holding for term in (upright, speed, keep_out)] == ["object", None, None]
    for _ in range(50):
        now, before, dt = pin.SE3.Random(), pin.SE3.Random(), float(rng.uniform(0.01, 0.5))
        now.translation, before.translation = rng.uniform(-2.0, 2.0, (2, 3))
        row = flatten_inputs(now, before, dt)
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


@pytest.fixture
def copy(dataset: Dataset, tmp_path: Path) -> Path:
    shutil.copytree(dataset.folder, tmp_path / "copy")
    return tmp_path / "copy"


def change_metadata(folder: Path, change: Any) -> int:
    """Modify the metadata of an episode and return its number."""
    with h5py.File(Dataset.open(folder).shards[0], "r+") as file:
        group = file["data/demo_1"]
        metadata = json.loads(group.attrs["episode"])
        change(metadata)
        group.attrs["episode"] = json.dumps(metadata)
        return int(group.attrs["number"])


def test_violated_term_is_reported(copy: Path) -> None:
    def tighten(metadata: Any) -> None:
        metadata["terms"][0]["upper"] = 0.01

    number = change_metadata(copy, tighten)
    found = check_dataset(copy)
    assert list(found.refused) == [number]
    assert "speed base" in found.refused[number]


def test_terms_that_differ_from_the_recipe_are_reported(copy: Path) -> None:
    number = change_metadata(copy, lambda metadata: metadata.pop("terms"))
    found = check_dataset(copy)
    assert list(found.refused) == [number]
    assert "terms differ from those of the recipe" in found.refused[number]


def test_digest_depends_on_terms(dataset: Dataset) -> None:
    plain, slow = load_recipe(SMALL), load_recipe(RECIPE)
    assert len({plain.digest, slow.digest, dataset.recipe.digest}) == 3
    assert load_recipe(dataset.recipe.document).digest == dataset.recipe.digest
    assert load_recipe(dataset.folder / "recipe.yaml").terms == dataset.recipe.terms
    with pytest.raises(InputError, match="run otherwise"):
        generate(RECIPE, 3, dataset.folder)
    assert (
        generate(RECIPE, 3, dataset.folder, terms=[make_height_limit()]).numbers()
        == dataset.numbers()
    )


def test_terms_apply_only_to_their_tasks(dataset: Dataset) -> None:
    recipe = load_recipe(
        {
            **SMALL,
            "tasks": ["given-open", "drive-open"],
            "terms": [{**SPEED_LIMIT, "tasks": ["drive-open"]}],
        }
    )
    episode = next(dataset.episodes())
    found = [
        resolve_episode_terms(recipe, episode.scene(), {**episode.about, "task": task})
        for task in ("given-open", "drive-open")
    ]
    assert [len(terms) for terms in found] == [0, 1]


@pytest.mark.parametrize(
    ("entry", "field", "text"),
    [
        ("{type: uprigt}", "terms[0].type", "did you mean 'upright'"),
        ("{type: speed, frame: hand}", "terms[0].most", "missing"),
        ("{type: speed, most: -1}", "terms[0].most", "out of range"),
        ("{type: speed, most: .nan}", "terms[0].most", "finite"),
        ("{type: speed, most: 1, frme: hand}", "terms[0].frme", "did you mean 'frame'"),
        ("{type: upright, axis: [0, 0, 0]}", "terms[0].axis", "no direction"),
        ("{type: upright, angle: 4}", "terms[0].angle", "out of range"),
        ("{type: keep-out, position: [0, 0], size: [1, 1, 1]}", "terms[0].position", "3 values"),
        (
            "{type: keep-out, position: [0, 0, 0], size: [1, 1, 0]}",
            "terms[0].size[2]",
            "out of range",
        ),
        (
            "{type: speed, most: 1, tasks: [drive-opn]}",
            "terms[0].tasks[0]",
            "did you mean 'drive-open'",
        ),
        (
            "{type: traced, traced: {term: Constraint, name: x, expression: import os}}",
            "terms[0]",
            "not a saved term",
        ),
        ("{type: python, expression: os.getcwd()}", "terms[0].type", "traced"),
    ],
)
def test_invalid_terms_are_rejected(tmp_path: Path, entry: str, field: str, text: str) -> None:
    file = tmp_path / "recipe.yaml"
    file.write_text(f"name: small\nterms:\n  - {entry}\n", encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_recipe(file)
    assert (caught.value.file, caught.value.line, caught.value.field) == (file, 3, field)
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("terms", "text"),
    [
        ([make_height_limit("hnd")], "did you mean 'hand'"),
        (
            [vkc.Constraint("x", lambda s: s.coordinate("elbow"), upper=1.0)],
            "coordinate of husky_ur5e",
        ),
        (
            [vkc.Constraint("x", lambda s: s.position("hand")[2], upper=1.0, during="reach")],
            "phases are not known yet",
        ),
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


def test_every_field_is_documented() -> None:
    page = (Path(__file__).parents[2] / "docs/datasets.md").read_text(encoding="utf-8")
    for schema in (UprightSchema, SpeedSchema, KeepOutSchema, TracedSchema):
        assert [name for name in schema.model_fields if f"`{name}`" not in page] == [], (
            schema.__name__
        )
