"""What does not hold at a motion, and what that costs: the exact ℓ1 merit function."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.drives import hall
from helpers.small_problems import door_scene, program_of

import vkc_pin as vkc
from vkc_pin.planning.nlp.merit import (
    GROWTH,
    Infeasibility,
    Merit,
    compute_shortfalls,
    measure_infeasibility,
)
from vkc_pin.planning.solver.loop import _Loop
from vkc_pin.planning.solver.trust_region import Trial

KINDS = tuple(Merit(1.0).weights)
SHORT = vkc.Options(reach_waypoints=8, turn_waypoints=4, move_waypoints=6)
TALL = vkc.Constraint("tall", lambda s: s.position("tool")[2], lower=2.0)
PILLAR = {
    "name": "pillar",
    "type": "cylinder",
    "radius": 0.15,
    "length": 1.6,
    "position": [0.9, 0.0, 0.8],
}


@cache
def problem(kind: str) -> vkc.TrajectoryProblem:
    if kind == "door":
        return program_of(door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=SHORT)
    scene = hall(base="differential", obstacles=[PILLAR])
    return program_of(scene, [vkc.GoTo(1.2, 0.4)], options=SHORT, terms=[TALL])


def look(kind: str, z: np.ndarray, *, rates: bool = True) -> Infeasibility:
    p = problem(kind)
    contacts = p.evaluate_contacts(
        z, reach=p.options.contact_reach, nearest=p.options.contact_slots
    )
    return measure_infeasibility(p, z, p.timing_for(p.still), contacts, rates=rates)


def wild(kind: str, seed: int, size: float = 0.3) -> np.ndarray:
    p = problem(kind)
    return p.clip(p.still + np.random.default_rng(seed).normal(0.0, size, p.still.shape))


def test_nothing_is_missing_where_everything_holds() -> None:
    p = program_of(hall(), [vkc.GoTo(0.0, 0.0, 0.0)], options=SHORT)
    contacts = p.evaluate_contacts(p.still, reach=0.1)
    found = measure_infeasibility(p, p.still, p.timing_for(p.still), contacts, rates=True)
    assert (found.total, found.max_violation) == (0.0, 0.0)
    assert set(found.amounts) == set(KINDS)


@pytest.mark.parametrize("seed", range(3))
def test_amounts_are_what_is_missing(seed: int) -> None:
    """Each kind worked out in another way."""
    p, z = problem("drive"), wild("drive", seed)
    found, timing = look("drive", z), p.timing_for(p.still)
    _, aside, _ = p.rolling.compute_steps(p.waypoints(z))
    fast = (
        np.maximum(p.rolling.compute_min_times(p.waypoints(z)) - timing.dt, 0.0)
        * p.rolling.wheel_speed
    )  # of the faster wheel
    assert (found.amounts["rolling"] >= np.abs(aside) + fast - 1e-9).all()
    still = look("drive", z, rates=False).amounts["rolling"]
    np.testing.assert_allclose(still, np.abs(aside), atol=1e-12)
    assert found.amounts["terms"].max() == pytest.approx(
        p.term_evaluator.compute_violation(z, timing.dt)
    )
    first, second = p.rates(z)
    over = (
        np.maximum(np.abs(first) - timing.velocity, 0.0).sum()
        + np.maximum(np.abs(second) - timing.acceleration, 0.0).sum()
    )
    assert found.amounts["rates"].sum() == pytest.approx(over)
    door = look("door", wild("door", seed), rates=False)
    assert not door.rate_excess.size
    worst = problem("door").pose_error(wild("door", seed))
    assert worst / 2 < door.amounts["poses"].max()
    assert door.total == pytest.approx(sum(amount.sum() for amount in door.amounts.values()))


def test_shortfalls_are_of_the_pairs_that_have_planes() -> None:
    p, z = problem("drive"), wild("drive", 0)
    contacts = p.evaluate_contacts(z, reach=p.options.contact_reach)
    found = compute_shortfalls(contacts, p.segments, 2)
    for row in range(p.segments):
        mine = np.flatnonzero(contacts.waypoint == row)[:2]
        expected = np.maximum(contacts.margin[mine] - contacts.distance[mine], 0.0)
        np.testing.assert_allclose(found[row, : len(mine)], expected)
        assert not found[row, len(mine) :].any()


@pytest.mark.parametrize("kind", ["drive", "door"])
@pytest.mark.parametrize("seed", range(4))
def test_its_directional_derivative_is_that_of_finite_differences(kind: str, seed: int) -> None:
    """Of f, clearance and poses by gradients; the others are tested with their rows."""
    p, rng = problem(kind), np.random.default_rng(seed)
    z, along = wild(kind, seed, 0.1), rng.normal(size=p.still.shape)
    along *= (p.lower < z) & (z < p.upper)
    weights, dt = {"clearance": 3.0, "poses": 5.0}, p.timing_for(p.still).dt

    def merit(step: float) -> float:
        found = look(kind, z + step * along, rates=False)
        cost = sum(weight * found.amounts[name].sum() for name, weight in weights.items())
        return p.objective(z + step * along, dt) + cost

    t = p.transcription
    steps, directions = p.rates(z), p.rates(z + along)
    weights_of_f = p.motion_cost.weights(*steps)  # a quadratic function with the slope of f
    slope = sum(
        2 * np.sum(w * a * (b - a)) for w, a, b in zip(weights_of_f, steps, directions, strict=True)
    )
    contacts = p.evaluate_contacts(z, reach=p.options.contact_reach, nearest=t.slots)
    short = contacts.margin > contacts.distance
    falls = np.einsum(
        "cj,cj->c", p.contacts.compute_gradients(z, contacts), along[contacts.waypoint]
    )
    slope -= weights["clearance"] * falls[short].sum()
    for goal, solver in zip(p.pose_goals, t.pose_solvers, strict=True):
        at = np.array(goal.row.waypoints, int) - 1
        residual, jacobian = solver.evaluate(z[at], goal.target)
        change = np.einsum("bij,bj->bi", jacobian, along[at])
        distance, turn = (
            np.linalg.norm(residual[:, :3], axis=1),
            np.linalg.norm(residual[:, 3:], axis=1),
        )
        slope += (
            weights["poses"]
            * (np.einsum("bi,bi->b", residual[:, :3], change[:, :3]) / distance).sum()
        )
        half = np.sqrt(1.0 - (turn / 2) ** 2)
        slope += (
            weights["poses"]
            * (np.einsum("bi,bi->b", residual[:, 3:], change[:, 3:]) / turn / half).sum()
        )
    assert short.any() or kind == "door"
    assert (merit(1e-6) - merit(-1e-6)) / 2e-6 == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_step_that_increases_any_violation_is_rejected(kind: str) -> None:
    """However much shorter the motion gets."""
    p = problem("drive")
    loop = _Loop(p, p.still, 200.0)
    loop.begin()
    amounts = {name: np.full(p.segments, 0.01) for name in KINDS}
    loop.found = Infeasibility(
        amounts, loop.found.pose_offsets, loop.found.excess, loop.found.rate_excess
    )
    loop.objective = 5.0
    fields = dict.fromkeys(Trial.__dataclass_fields__)
    for change, expected in ((0.01, False), (-0.01, True)):
        after = {**amounts, kind: np.full(p.segments, 0.01 + change)}
        found = Infeasibility(
            after, loop.found.pose_offsets, loop.found.excess, loop.found.rate_excess
        )
        predicted_penalty = (
            loop.merit.compute_penalty(loop.found, clearance=True) - 2.0
        )  # as much as this kind is worth
        trial = Trial(
            **{
                **fields,
                "objective": 0.0,
                "infeasibility": found,
                "predicted_penalty": predicted_penalty,
            }
        )  # type: ignore[arg-type]
        assert loop.is_acceptable(trial, *loop.compute_penalties(trial)) == expected


def test_weights_of_violated_kinds_increase() -> None:
    merit, amounts = Merit(200.0), {kind: np.zeros(3) for kind in KINDS}
    amounts["terms"][1] = 0.01
    found = Infeasibility(amounts, np.zeros((3, 0, 7)), np.zeros(0), np.zeros(0))
    assert merit.increase_weights(found, 1e-3)
    assert merit.weights == {**dict.fromkeys(KINDS, 200.0), "terms": GROWTH * 200.0}
    assert merit.compute_penalty(found, clearance=False) == pytest.approx(
        [0.0, GROWTH * 200.0 * 0.01, 0.0]
    )
    assert merit.increase_weights(found, 1e-3)
    assert merit.weights["terms"] == GROWTH**2 * 200.0
    assert not Merit(200.0).increase_weights(found, 0.1)
