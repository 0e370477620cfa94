from __future__ import annotations

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.benchmarks.problems.impossible import KINDS, impossible, run
from vkc_pin.errors import InputError

CERTAIN = (
    "closed wall",
    "fence round the start",
    "fence round the goal",
    "gap too narrow",
    "beam too low",
    "place taken",
)


@pytest.mark.parametrize(
    "kind", [*CERTAIN, "pose too high", "joint beyond its limit", "door shut between"]
)
def test_what_can_be_proven_is(kind: str) -> None:
    for seed in range(3):
        scene, steps = KINDS[kind](np.random.default_rng(seed))
        plan = vkc.plan(scene, steps)
        assert plan.status == "infeasible"
        assert plan.metrics["rounds"] <= vkc.Options().max_outer  # one seed at most is tried before
        assert kind == "joint beyond its limit" or any(
            "proven: " in note for note in plan.report.notes
        )


def test_problems_follow_from_their_numbers() -> None:
    for number in range(len(KINDS)):
        one, other = impossible(7, number), impossible(7, number)
        assert one[0].document == other[0].document
        assert one[1][0].__class__ is other[1][0].__class__


def test_no_problems(tmp_path: object) -> None:
    with pytest.raises(InputError, match="at least 1"):
        run(out=str(tmp_path), problems=0)
