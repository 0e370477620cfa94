"""Other planners solve a reach and a drawer that is grasped at the start."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from vkc_pin.benchmarks.peers.found import Clock, clearances, judged
from vkc_pin.benchmarks.peers.run import PEERS
from vkc_pin.benchmarks.peers.tasks import given, problem_of


@pytest.mark.parametrize("task", ["reach", "drawer"])
@pytest.mark.parametrize("name", PEERS)
def test_peer_finds_a_valid_path(name: str, task: str) -> None:
    plan_by_peer, module, _ = PEERS[name]
    if find_spec(module) is None:
        pytest.skip(f'needs {module}: pip install "vkc-pin[peers]"')
    own = given(task, 18, 0)
    problem = problem_of(own)

    def accept(path: np.ndarray) -> bool:
        return judged(own, problem, path, "", name="", seed=0).success

    found = plan_by_peer(own, problem, 0, Clock(60.0), accept)
    assert found.path is not None, (found.status, found.about)
    assert np.array_equal(found.path[0], problem.start)
    result = judged(own, problem, found.path, found.status, name="peer", seed=0)
    assert result.success, result.report
    distances = clearances(problem, result.trajectory).values()
    assert all(distance is None or distance > 0.0 for distance in distances)
