"""Tests other planners on a reach and on a drawer that is grasped at the start."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from tests.benchmarks.peers.found import Clock, Peer, compute_clearances, validate_path
from tests.benchmarks.peers.run import PEERS
from tests.benchmarks.peers.tasks import build_program, make_problem


def find_peer(name: str) -> Peer:
    plan_by_peer, module, _ = PEERS[name]
    if find_spec(module) is None:
        pytest.skip(f'needs {module}: pip install "vkc-pin[peers]"')
    return plan_by_peer


@pytest.mark.parametrize("task", ["reach", "drawer"])
@pytest.mark.parametrize("name", PEERS)
def test_peer_finds_a_valid_path(name: str, task: str) -> None:
    plan_by_peer = find_peer(name)
    peer_problem = make_problem(task, 18, 0)
    problem = build_program(peer_problem)

    def accept(path: np.ndarray) -> bool:
        return validate_path(peer_problem, problem, path, "", name="", seed=0).success

    found = plan_by_peer(peer_problem, problem, 0, Clock(60.0), accept)
    assert found.path is not None, (found.status, found.about)
    assert np.array_equal(found.path[0], problem.start)
    result = validate_path(peer_problem, problem, found.path, found.status, name="peer", seed=0)
    assert result.success, result.report
    distances = compute_clearances(problem, result.trajectory).values()
    assert all(distance is None or distance > 0.0 for distance in distances)


@pytest.mark.parametrize("name", PEERS)
def test_peer_ends_at_its_time_limit(name: str) -> None:
    plan_by_peer = find_peer(name)
    peer_problem = make_problem("door", 20270430, 1)
    problem = build_program(peer_problem)
    clock = Clock(1.5)
    plan_by_peer(peer_problem, problem, 0, clock, lambda path: False)
    assert clock.wall < 20.0
