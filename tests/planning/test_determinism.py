"""The same call gives the same bits, whatever was planned before, in whatever thread or process, and whatever was kept."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks import initialization

ROOT = Path(__file__).resolve().parents[2]
BASE = [-0.03, 0.09, -1.19]
SCRIPT = "from test_determinism import digest, door, stick; print(digest({}()))"


def digest(plan: vkc.Plan) -> str:
    """Return a hash of a motion's times and positions, to the last bit."""
    assert plan.success, plan.summary()
    motion = plan.trajectory
    data = [
        " ".join(motion.names).encode(),
        np.ascontiguousarray(motion.times),
        np.ascontiguousarray(motion.positions),
    ]
    return hashlib.sha256(b"".join(bytes(part) for part in data)).hexdigest()


def door(planner: vkc.Planner | None = None) -> vkc.Plan:
    """Return the whole task at the door."""
    scene = vkc.load_scene("door").with_start(base=BASE)
    return vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2})], planner=planner)


def stick(planner: vkc.Planner | None = None) -> vkc.Plan:
    """Return a task of two steps, with a tool."""
    scene = vkc.load_scene("init_2")
    return vkc.plan(
        scene, [vkc.Grasp("stick"), vkc.Touch("stick.tip", initialization.TARGET)], planner=planner
    )


def elsewhere(task: str, **variables: str) -> str:
    """Return the digest of a task in a process of its own, with environment variables."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(task)],
        cwd=Path(__file__).parent,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture(scope="module")
def fresh() -> dict[str, str]:
    """Return what comes out in fresh processes."""
    return {task: elsewhere(task) for task in ("door", "stick")}


@pytest.mark.long
def test_after_a_hundred_other_plans(fresh: dict[str, str]) -> None:
    planner = vkc.Planner()
    scene = vkc.load_scene("door")
    for number in range(100):  # of three structures, from as many starts
        there = scene.sample_start(np.random.default_rng(number))
        options = vkc.Options(reach_waypoints=10 + 5 * (number % 3), max_restarts=1, max_outer=4)
        vkc.plan(there, [vkc.GoTo(*BASE[:2])], options=options, planner=planner)
    assert planner.info().hits > 0
    for _ in range(2):
        assert digest(door(planner)) == fresh["door"]
        assert digest(stick(planner)) == fresh["stick"]
    assert digest(door(planner)) == fresh["door"]


def test_with_hardly_any_room_to_keep_anything(fresh: dict[str, str]) -> None:
    planner = vkc.Planner(entries=1, megabytes=1e-3)
    assert digest(door(planner)) == fresh["door"]
    assert planner.info().entries <= 1
    assert digest(door(planner)) == fresh["door"]


def test_in_threads_that_plan_at_once(fresh: dict[str, str]) -> None:
    planner = vkc.Planner()
    found: dict[int, str] = {}

    def work(number: int) -> None:
        found[number] = digest((door, stick)[number % 2](planner))

    for _ in range(2):  # the second time with what the first left
        found.clear()
        threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert found == {0: fresh["door"], 1: fresh["stick"], 2: fresh["door"], 3: fresh["stick"]}


@pytest.mark.parametrize("number", ["1", "2"])
def test_whatever_the_number_of_threads_of_libraries(fresh: dict[str, str], number: str) -> None:
    """Of BLAS, OpenMP and MUMPS, which sum in another order then."""
    variables = dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), number
    )
    assert elsewhere("stick", **variables) == fresh["stick"]


@pytest.mark.long
def test_on_one_process_or_two(tmp_path: Path) -> None:
    records = []
    for jobs in (1, 2):
        out = tmp_path / str(jobs)
        result = initialization.run(
            starts=2,
            repeats=1,
            seed=3,
            out=out,
            jobs=jobs,
            scenes=("init_1",),
            methods=("astar",),
            progress=False,
        )
        records.append(
            [{key: trial[key] for key in trial if "time" not in key} for trial in result["trials"]]
        )
    assert json.dumps(records[0]) == json.dumps(records[1])
