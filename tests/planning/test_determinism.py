"""Tests that plans are equal bit for bit in any thread or process and with any cache."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.experiments import initialization

BASE = [-0.03, 0.09, -1.19]
SCRIPT = "from test_determinism import *; print(compute_hash(plan_{}()))"


def compute_hash(plan: vkc.Plan) -> str:
    """Return a hash of a motion's times and positions."""
    assert plan.success, plan.summary()
    motion = plan.trajectory
    data = [
        " ".join(motion.names).encode(),
        np.ascontiguousarray(motion.times),
        np.ascontiguousarray(motion.positions),
    ]
    return hashlib.sha256(b"".join(bytes(part) for part in data)).hexdigest()


def plan_door(planner: vkc.Planner | None = None) -> vkc.Plan:
    scene = vkc.load_scene("door").with_start(base=BASE)
    return vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2})], planner=planner)


def plan_stick(planner: vkc.Planner | None = None) -> vkc.Plan:
    scene = vkc.load_scene("init_2")
    return vkc.plan(
        scene, [vkc.Grasp("stick"), vkc.Touch("stick.tip", initialization.TARGET)], planner=planner
    )


@cache
def hash_in_process(task: str) -> str:
    """Return the hash of a task in a fresh process."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(task)],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.long
def test_plan_is_the_same_after_a_hundred_other_plans() -> None:
    planner = vkc.Planner()
    scene = vkc.load_scene("door")
    for number in range(100):  # three problem sizes, a hundred starts
        start = scene.sample_start(np.random.default_rng(number))
        options = vkc.Options(reach_waypoints=10 + 5 * (number % 3), max_restarts=1, max_outer=4)
        vkc.plan(start, [vkc.GoTo(*BASE[:2])], options=options, planner=planner)
    assert planner.info().hits > 0
    for _ in range(2):
        assert compute_hash(plan_door(planner)) == hash_in_process("door")
        assert compute_hash(plan_stick(planner)) == hash_in_process("stick")
    assert compute_hash(plan_door(planner)) == hash_in_process("door")


@pytest.mark.long
def test_plan_is_the_same_with_a_tiny_cache() -> None:
    planner = vkc.Planner(entries=1, megabytes=1e-3)
    assert compute_hash(plan_door(planner)) == hash_in_process("door")
    assert planner.info().entries <= 1
    assert compute_hash(plan_door(planner)) == hash_in_process("door")
