"""Tests that the subproblem minimizes the merit model in the trust region."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from helpers.carrying import describe_box
from helpers.drives import make_hall
from helpers.small_problems import load_door_scene, make_program
from helpers.straight_drives import make_straight_drive

import vkc_pin as vkc
from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.merit import Infeasibility, Merit, measure_infeasibility
from vkc_pin.planning.nlp.timing import Timing
from vkc_pin.planning.solver.solution import Solution
from vkc_pin.planning.solver.subproblem import Step, Subproblem

SHORT = vkc.Options(reach_waypoints=8, turn_waypoints=4, move_waypoints=6)


class Iterate(NamedTuple):
    """An iterate and the inputs of its subproblem."""

    problem: vkc.TrajectoryProblem
    z: np.ndarray
    timing: Timing
    contacts: Contacts
    found: Infeasibility
    merit: Merit

    def solve(
        self, radius: float, *, rates: bool = False, subproblem: Subproblem | None = None
    ) -> Step:
        radii = np.full(self.problem.segments, radius)
        subproblem = subproblem or Subproblem(self.problem, Solution(self.z, self.timing.dt))
        return subproblem.solve(
            self.z, self.contacts, self.found, self.merit, self.timing, radii, rates=rates
        )


def make_iterate(
    problem: vkc.TrajectoryProblem, z: np.ndarray, *, rates: bool = False, weight: float = 200.0
) -> Iterate:
    z = problem.clip(z)
    timing, o = problem.timing_for(z), problem.options
    contacts = problem.evaluate_contacts(z, reach=o.contact_reach, nearest=o.contact_slots)
    found = measure_infeasibility(problem, z, timing, contacts, rates=rates)
    return Iterate(problem, z, timing, contacts, found, Merit(weight))


def make_case(kind: str, *, rates: bool = False) -> Iterate:
    """Return a door that has not been reached yet, or a straight drive in an empty hall."""
    if kind == "door":
        problem = make_program(
            load_door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=SHORT
        )
        return make_iterate(problem, problem.still, rates=rates)
    return make_iterate(*make_straight_drive(make_hall(), SHORT, x=1.0), rates=rates)


@pytest.mark.parametrize("kind", ["door", "drive"])
@pytest.mark.parametrize("rates", [False, True])
@pytest.mark.parametrize("size", [1e-3, 1e-2, 0.05, 0.5])
def test_predicted_reduction_is_achieved_within_the_region(
    kind: str, rates: bool, size: float
) -> None:
    """Without close obstacles the model is exact up to Ipopt's tolerance."""
    iterate = make_case(kind, rates=rates)
    p, step = iterate.problem, iterate.solve(size, rates=rates)
    assert np.all(np.abs(step.z - iterate.z) <= size * (1 + 1e-6))
    assert np.all((step.z >= p.lower - 1e-6) & (step.z <= p.upper + 1e-6))
    assert np.all((step.relaxation >= 0.0) & (step.relaxation <= 1.0))
    assert (step.slack >= 0.0).all()
    o = p.options
    contacts = p.evaluate_contacts(step.z, reach=o.contact_reach, nearest=o.contact_slots)
    found = measure_infeasibility(p, step.z, iterate.timing, contacts, rates=rates)
    before, after = (p.objective(z, iterate.timing.dt) for z in (iterate.z, step.z))
    others = iterate.merit.compute_penalty(iterate.found, clearance=False)
    predicted = before + iterate.merit.compute_penalty(iterate.found, clearance=True).sum() - after
    predicted -= (iterate.merit.weights["clearance"] * step.slack + others * step.relaxation).sum()
    assert predicted >= -1e-3
    left = others @ step.relaxation
    penalty = iterate.merit.compute_penalty(found, clearance=False).sum()
    assert penalty <= left + 1e-2 * max(1.0, left)
    if kind == "drive":
        assert not step.relaxation.any()
        assert step.succeeded
    else:
        assert predicted > 20.0 * size
        # linear models are accurate for small steps, also far from the goals
        gain = others.sum() - penalty
        assert rates or size > 0.01 or left == pytest.approx(penalty, abs=0.02 * gain)
        assert not step.relaxation[others == 0.0].any()
        assert size > 0.1 or (step.relaxation > 0.5).any(), "a small step must leave a relaxation"


def test_multipliers_warm_start_the_next_round() -> None:
    iterate = make_case("drive")
    solution = Solution(iterate.z, iterate.timing.dt)
    subproblem = Subproblem(iterate.problem, solution)
    counts = []
    for reset in (False, False, True):
        if reset:
            subproblem.reset_multipliers()
        before = solution.iterations
        iterate.solve(0.1, subproblem=subproblem)
        counts.append(solution.iterations - before)
    assert 0 < counts[1] <= counts[0] == counts[2]
    assert all(time > 0.0 for time in solution.timings.values())


@pytest.mark.parametrize("is_violated", [False, True])
def test_only_planes_violated_at_the_iterate_have_slack(is_violated: bool) -> None:
    """Beyond the margin of the box, the penalty weight has no effect."""
    obstacle = describe_box("box", [0.2, 0.2, 1.0], [1.6 if is_violated else 1.85, 0.0, 0.5])
    problem, drive = make_straight_drive(make_hall(obstacles=[obstacle]), SHORT, x=1.2)
    iterate = make_iterate(problem, drive if is_violated else problem.still, weight=1e-3)
    assert bool(iterate.found.amounts["clearance"].any()) == is_violated
    step = iterate.solve(2.0)
    assert bool((step.slack > 1e-3).any()) == is_violated
    assert is_violated or not step.slack.any()
