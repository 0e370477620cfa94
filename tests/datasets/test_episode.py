from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.datasets import SMALL

from vkc_pin.datasets.episode import compute_scene_name, make_episode, run_attempt
from vkc_pin.datasets.recipe import load_recipe
from vkc_pin.planning.prepare import plan
from vkc_pin.world.scene.scene import load_scene
from vkc_pin.world.task.steps import Actuate

DOCUMENT = load_recipe(SMALL).document


def test_episode_has_the_plan_and_its_trajectory_to_1e_9() -> None:
    found = plan(load_scene("drawer"), [Actuate("drawer", {"slide": 0.2})])
    episode = make_episode(7, {"robot": "husky_ur5e", "task": "drive-open"}, found)
    rounded, original = episode.trajectory, found.trajectory
    times = np.linspace(original.times[0], original.times[-1], 500)
    assert np.abs(rounded.at(times) - original.at(times)).max() <= 1e-9
    assert np.array_equal(rounded.times, original.times)
    assert rounded.phases == original.phases
    assert episode.steps == found.steps
    assert episode.options == found.options
    report = episode.validate()
    assert report.ok
    assert report.contradictions(episode.claimed) == []


def test_attempts_are_determined_by_their_number() -> None:
    record, episode = run_attempt(DOCUMENT, 0, {})
    second_record, second = run_attempt(DOCUMENT, 0, {})
    assert record["success"]
    assert episode is not None
    assert second is not None
    assert record["scene"] == compute_scene_name(episode.document)
    assert episode.trajectory.to_dict() == second.trajectory.to_dict()
    measured = {name for name in record if name.endswith(("_time", "_mb"))} | {"seconds"}
    assert record.keys() == second_record.keys()
    for name in record.keys() - measured:
        assert record[name] == second_record[name]
    json.dumps(record)


def test_failed_plan_has_a_reason() -> None:
    record, episode = run_attempt({**DOCUMENT, "max_evaluations": 1}, 0, {})
    assert (record["success"], episode) == (False, None)
    assert record["status"] == "evaluation limit"
    assert record["reason"]


def test_simulated_attempt_has_a_consistent_status() -> None:
    pytest.importorskip("mujoco")
    record, _ = run_attempt({**DOCUMENT, "simulate": True}, 0, {})
    assert record["simulated"]
    assert record["success"] == (record["status"] == "success")
