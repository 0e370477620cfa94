"""Tests that validation alone decides on the paths of other planners."""

from __future__ import annotations

import numpy as np

from tests.benchmarks.peers.found import validate_path
from tests.benchmarks.peers.tasks import build_program, make_problem, sample_goals


def test_path_through_a_wall_is_rejected() -> None:
    peer_problem = make_problem("door", 18, 0)
    problem = build_program(peer_problem)
    (goal, *_) = sample_goals(problem, np.random.default_rng(0), 1)
    straight = problem.start + np.linspace(0.0, 1.0, 31)[:, None] * (goal - problem.start)
    result = validate_path(peer_problem, problem, straight, "found", name="nobody", seed=0)
    assert not result.success
    assert result.status == "rejected"
    assert "closure" in {violation.constraint for violation in result.report.violations}
    assert (
        validate_path(peer_problem, problem, None, "timed out", name="nobody", seed=0).status
        == "timed out"
    )
