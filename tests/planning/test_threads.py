"""Tests that concurrent threads with shared and own planners give the same plans."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

PROGRAM = """
import collections, faulthandler, sys, threading
faulthandler.enable()
import vkc_pin as vkc

scene, shared = vkc.load_scene("drawer"), vkc.Planner()
found, raised = [], []

def work(number):
    for turn in range(3):
        kind = (number + turn) % 3
        options = vkc.Options(reach_waypoints=10 + kind, move_waypoints=8, turn_waypoints=3)
        planner, limit = (None, shared, vkc.Planner())[kind], (None, 300.0)[turn % 2]
        more = {"options": options, "planner": planner, "time_limit": limit}
        try:
            plan = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.3})], **more)
            found.append((kind, plan.status, plan.trajectory.positions.tobytes()))
        except BaseException as error:
            raised.append(repr(error))

threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert not raised, raised
assert len(found) == 24
assert len(set(found)) == 3, [item[:2] for item in set(found)]
print("done")
"""


@pytest.mark.long
def test_eight_threads_with_shared_and_own_planners_give_the_same_plans() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, "done\n"), done.stderr
