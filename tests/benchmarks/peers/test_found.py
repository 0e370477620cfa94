"""What planners hand in is judged by the validation, whatever they say of it."""

from __future__ import annotations

import numpy as np

from vkc_pin.benchmarks.peers.found import judged
from vkc_pin.benchmarks.peers.tasks import ends, given, problem_of


def test_a_path_through_a_wall_is_rejected() -> None:
    own = given("door", 18, 0)
    problem = problem_of(own)
    (goal, *_) = ends(problem, np.random.default_rng(0), 1)
    straight = problem.start + np.linspace(0.0, 1.0, 31)[:, None] * (goal - problem.start)
    result = judged(own, problem, straight, "found", name="nobody", seed=0)
    assert not result.success
    assert result.status == "rejected"
    assert "closure" in {violation.constraint for violation in result.report.violations}
    assert judged(own, problem, None, "timed out", name="nobody", seed=0).status == "timed out"
