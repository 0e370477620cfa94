from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.datasets import SMALL

from vkc_pin.datasets.episode import compute_scene_name, pack, run_attempt, unpack
from vkc_pin.datasets.recipes.recipe import load_recipe
from vkc_pin.planning.planner import plan
from vkc_pin.world.scene.scene import load_scene
from vkc_pin.world.task.steps import Actuate

DOCUMENT = load_recipe(SMALL).document


def test_packed_episode_is_read_back() -> None:
    """All that was planned is there again, to 1e-9 at every moment."""
    found = plan(load_scene("drawer"), [Actuate("drawer", {"slide": 0.2})])
    data, record = pack(7, {"robot": "husky_ur5e", "task": "drive-open"}, found)
    again = unpack(data)
    motion, was = again.trajectory, found.trajectory
    times = np.linspace(was.times[0], was.times[-1], 500)
    assert np.abs(motion.at(times) - was.at(times)).max() <= 1e-9
    assert np.array_equal(motion.times, was.times)
    assert motion.phases == was.phases
    assert again.steps == found.steps
    assert again.options == found.options
    report = again.validate()
    assert report.ok
    assert report.contradictions(again.claimed) == []
    assert record["scene"] == compute_scene_name(again.document)
    assert len(data) <= 40_000


def test_attempts_are_determined_by_their_number() -> None:
    record, data = run_attempt(DOCUMENT, 0, {})
    again, same = run_attempt(DOCUMENT, 0, {})
    assert record["success"]
    assert data == same
    times = {name for name in record if name.endswith("_time")} | {
        "seconds",
        "memory_mb",
        "resident_mb",
    }
    assert {k: v for k, v in record.items() if k not in times} == {
        k: v for k, v in again.items() if k not in times
    }
    json.dumps(record)


def test_scene_name_is_a_digest() -> None:
    found = unpack(run_attempt(DOCUMENT, 0, {})[1])
    assert "start" not in found.document
    name = compute_scene_name(found.document)
    assert name == compute_scene_name(json.loads(json.dumps(found.document)))
    assert name != compute_scene_name({**found.document, "floor": False})


def test_failed_plan_has_a_reason() -> None:
    record, data = run_attempt({**DOCUMENT, "max_evaluations": 1}, 0, {})
    assert (record["success"], data) == (False, b"")
    assert record["status"] == "evaluation limit"
    assert record["reason"]


def test_simulation_decides_success() -> None:
    pytest.importorskip("mujoco")
    record, _ = run_attempt({**DOCUMENT, "simulate": True}, 0, {})
    assert record["simulated"]
    assert record["success"] == (record["status"] == "success")
