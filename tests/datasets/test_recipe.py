from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from vkc_pin.datasets.recipe import (
    GoalSchema,
    RecipeSchema,
    RobotEntry,
    RoomsSchema,
    StartSchema,
    load_recipe,
)
from vkc_pin.errors import InputError, UnknownNameError

SMALL: dict[str, Any] = {
    "name": "small",
    "objects": ["random_oven"],
    "rooms": {"count": 2, "objects": 1},
}


def write_recipe(folder: Path, text: str) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_packaged_recipe_is_loaded() -> None:
    recipe = load_recipe("home")
    assert recipe.fields.rooms.count == 50
    assert set(recipe.fields.tasks) == {"given-open", "drive-open", "fetch-place"}
    assert len(recipe.fields.objects) >= 6
    assert len(recipe.fields.robots) >= 3


def test_recipe_document_round_trips(tmp_path: Path) -> None:
    recipe = load_recipe({**SMALL, "options": {"dist_safe": 0.03}, "goal": {"share": [0.2, 0.3]}})
    file = write_recipe(tmp_path, yaml.safe_dump(recipe.document))
    reloaded = load_recipe(file)
    assert reloaded.digest == recipe.digest
    assert reloaded.document == recipe.document
    assert reloaded.options.dist_safe == 0.03


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({"name": "other"}, True),
        ({"license": "MIT"}, True),
        ({"max_evaluations": 7}, False),
        ({"rate": 12}, False),
        ({"variants": 2}, False),
    ],
)
def test_digest_depends_only_on_fields_that_determine_episodes(
    change: dict[str, Any], same: bool
) -> None:
    assert (load_recipe({**SMALL, **change}).digest == load_recipe(SMALL).digest) == same


@pytest.mark.parametrize(
    ("line", "field", "message"),
    [
        ("robots: [husky_ur5]", "robots[0]", "did you mean 'husky_ur5e'"),
        ("objects: [random_ovens]", "objects[0]", "did you mean 'random_oven'"),
        ("tasks: [drive-opn]", "tasks[0]", "did you mean 'drive-open'"),
        ("carried: [cups]", "carried[0]", "did you mean 'cup'"),
        ("scenes: [dor]\ntasks: [drive-open]", "scenes", "did you mean 'door'"),
        ("max_evaluation: 3", "max_evaluation", "did you mean 'max_evaluations'"),
        ("options: {dist_saf: 0.1}", "options.dist_saf", "did you mean 'dist_safe'"),
    ],
)
def test_unknown_names_are_rejected(tmp_path: Path, line: str, field: str, message: str) -> None:
    file = write_recipe(tmp_path, f"name: small\n{line}\n")
    with pytest.raises(UnknownNameError) as caught:
        load_recipe(file)
    assert caught.value.file == file
    assert caught.value.line == 2
    assert caught.value.field == field
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("line", "field"),
    [
        ("max_evaluations: 0", "max_evaluations"),
        ("variants: -1", "variants"),
        ("variants: 1000000000", "variants"),
        ("rate: 1.0e-9", "rate"),
        ("rate: 5000", "rate"),
        ("rooms: {episodes: 100000}", "rooms.episodes"),
        ("rooms: {first: 10000000000}", "rooms.first"),
        ("robots: []", "robots"),
        ("goal: {share: [0.5, 0.4]}", "goal.share"),
        ("goal: {share: [0.0, 0.4]}", "goal.share"),
        ("rooms: {clutter: [0.0, 1.5]}", "rooms"),
        ("rooms: {count: 0}", "rooms.count"),
        ("options: {dist_safe: -1}", "options.dist_safe"),
        ("scenes: [door]", "tasks"),
        ("scenes: [missing.yaml]\ntasks: [drive-open]", "scenes[0]"),
    ],
)
def test_invalid_values_are_rejected(tmp_path: Path, line: str, field: str) -> None:
    file = write_recipe(tmp_path, f"name: small\n{line}\n")
    with pytest.raises(InputError) as caught:
        load_recipe(file)
    assert str(caught.value.file) == str(file)
    assert caught.value.field == field


def test_every_field_is_documented(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/datasets.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```yaml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert load_recipe(write_recipe(tmp_path, block)).fields.name == "home"
    for schema in (RecipeSchema, RoomsSchema, StartSchema, GoalSchema, RobotEntry):
        assert [name for name in schema.model_fields if f"`{name}`" not in page] == [], (
            schema.__name__
        )
