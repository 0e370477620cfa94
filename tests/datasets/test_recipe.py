from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.datasets import SMALL

from vkc_pin.datasets.recipe import (
    CAMERAS,
    GoalSchema,
    KeepOutSchema,
    RecipeSchema,
    RobotEntry,
    RoomsSchema,
    SpeedSchema,
    StartSchema,
    TracedSchema,
    UprightSchema,
    get_robot_name,
    load_recipe,
)
from vkc_pin.errors import InputError

TERM = {"type": "speed", "frame": "base", "most": 0.3}
FILMED = {"simulate": True, "cameras": [*CAMERAS]}


def write_recipe(folder: Path, text: str) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_packaged_recipe_is_loaded() -> None:
    assert load_recipe("home").fields.name == "home"


def test_recipe_document_round_trips(tmp_path: Path) -> None:
    changes = {**FILMED, "options": {"dist_safe": 0.03}, "goal": {"share": [0.2, 0.3]}}
    recipe = load_recipe({**SMALL, **changes})
    file = write_recipe(tmp_path, yaml.safe_dump(recipe.document))
    reloaded = load_recipe(file)
    assert reloaded.digest == recipe.digest
    assert reloaded.document == recipe.document
    assert reloaded.options.dist_safe == 0.03
    assert reloaded.cameras == recipe.cameras


@pytest.mark.parametrize(
    ("change", "other", "same"),
    [
        ({"name": "other"}, {}, True),
        ({"license": "MIT"}, {}, True),
        ({"max_evaluations": 7}, {}, False),
        ({"rate": 12}, {}, False),
        ({"variants": 2}, {}, False),
        ({"terms": [TERM]}, {}, False),
        ({"simulate": True, "cameras": []}, {"simulate": True}, True),
        (FILMED, {"simulate": True}, False),
        ({**FILMED, "cameras": [{**CAMERAS[0], "fov": 61.0}, CAMERAS[1]]}, FILMED, False),
    ],
)
def test_digest_depends_only_on_fields_that_determine_episodes(
    change: dict[str, Any], other: dict[str, Any], same: bool
) -> None:
    digests = [load_recipe({**SMALL, **fields}).digest for fields in (change, other)]
    assert (digests[0] == digests[1]) == same


@pytest.mark.parametrize(
    ("text", "field", "message"),
    [
        ("robots: [husky_ur5]", "robots[0]", "did you mean 'husky_ur5e'"),
        ("objects: [random_ovens]", "objects[0]", "did you mean 'random_oven'"),
        ("tasks: [drive-opn]", "tasks[0]", "did you mean 'drive-open'"),
        ("carried: [cups]", "carried[0]", "did you mean 'cup'"),
        ("scenes: [dor]\ntasks: [drive-open]", "scenes", "did you mean 'door'"),
        ("scenes: [missing.yaml]\ntasks: [drive-open]", "scenes[0]", "missing.yaml"),
        ("scenes: [door]\ntasks: [fetch-place]", "tasks", "fetch-place"),
        ("max_evaluation: 3", "max_evaluation", "did you mean 'max_evaluations'"),
        ("options: {dist_saf: 0.1}", "options.dist_saf", "did you mean 'dist_safe'"),
        ("options: {dist_safe: -1}", "options.dist_safe", "dist_safe"),
        ("max_evaluations: 0", "max_evaluations", "out of range"),
        ("variants: 1000000000", "variants", "out of range"),
        ("rate: 1.0e-9", "rate", "out of range"),
        ("rooms: {episodes: 100000}", "rooms.episodes", "out of range"),
        ("rooms: {first: 10000000000}", "rooms.first", "out of range"),
        ("rooms: {count: 0}", "rooms.count", "out of range"),
        ("rooms: {clutter: [0.0, 1.5]}", "rooms", "clutter"),
        ("robots: []", "robots", "robots"),
        ("goal: {share: [0.5, 0.4]}", "goal.share", "share"),
        ("goal: {edge: [-0.1, 0.2]}", "goal.edge[0]", "out of range"),
        ("start: {distance: [-2, 5]}", "start.distance[0]", "out of range"),
        ("robots: [missing/robot.yaml]", "robots[0]", "missing/robot.yaml"),
        *(
            (f"terms: [{{{entry}}}]", f"terms[0]{field}", message)
            for entry, field, message in (
                ("type: uprigt", ".type", "did you mean 'upright'"),
                ("type: speed, frame: hand", ".most", "missing"),
                ("type: speed, most: -1", ".most", "out of range"),
                ("type: speed, most: .nan", ".most", "finite"),
                ("type: speed, most: 1, frme: hand", ".frme", "did you mean 'frame'"),
                ("type: upright, axis: [0, 0, 0]", ".axis", "no direction"),
                ("type: keep-out, position: [0, 0], size: [1, 1, 1]", ".position", "3 values"),
                (
                    "type: keep-out, position: [0, 0, 0], size: [1, 1, 0]",
                    ".size[2]",
                    "out of range",
                ),
                ("type: speed, most: 1, tasks: [drive-opn]", ".tasks[0]", "mean 'drive-open'"),
                (
                    "type: traced, traced: {term: Constraint, name: x, expression: import os}",
                    "",
                    "not a saved term",
                ),
                ("type: python, expression: os.getcwd()", ".type", "traced"),
            )
        ),
    ],
)
def test_invalid_fields_are_rejected(tmp_path: Path, text: str, field: str, message: str) -> None:
    file = write_recipe(tmp_path, f"name: small\n{text}\n")
    with pytest.raises(InputError) as caught:
        load_recipe(file)
    lines = (2, 2 + text.count("\n"))
    assert (caught.value.file, caught.value.field) == (file, field)
    assert caught.value.line in lines
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fov": 180.0}, "fov"),
        ({"target": CAMERAS[0]["position"]}, "is undefined"),
        ({"name": CAMERAS[1]["name"]}, "two cameras of one name"),
        ({"wdth": 64}, "did you mean 'width'"),
    ],
)
def test_invalid_cameras_are_rejected(changes: dict[str, Any], message: str) -> None:
    cameras = [{**CAMERAS[0], **changes}, CAMERAS[1]]
    with pytest.raises(InputError, match=message):
        load_recipe({**SMALL, **FILMED, "cameras": cameras})


@pytest.mark.parametrize(
    ("entry", "expected"),
    [("panda", "panda"), ("/a/b/panda/robot.yaml", "panda"), ("/a/arm.urdf", "arm")],
)
def test_robot_name_is_derived_from_the_entry(entry: str, expected: str) -> None:
    assert get_robot_name(entry) == expected


def test_every_field_is_documented(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/datasets.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```yaml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert load_recipe(write_recipe(tmp_path, block)).fields.name == "home"
    schemas = (RecipeSchema, RoomsSchema, StartSchema, GoalSchema, RobotEntry)
    for schema in (*schemas, UprightSchema, SpeedSchema, KeepOutSchema, TracedSchema):
        assert [name for name in schema.model_fields if f"`{name}`" not in page] == [], schema
