"""The arm follows, waypoint by waypoint: closed, free, from the waypoint before; and why it cannot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from helpers.drawers import SHORT, handle, holding, off, spare, with_boxes
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.baselines import following as module
from vkc_pin.baselines.following import SEEDS, Followed, follow
from vkc_pin.baselines.refining import CLEAR
from vkc_pin.planning.initialization.keyframes import KeyframeSampler, sample_smoothstep
from vkc_pin.planning.nlp.merit import TOLERANCE

STILL = 0.0
ROUNDING = 1e-6  # [m]
CLOSED = np.sqrt(3.0) * TOLERANCE  # [m]: it holds for each coordinate
GOAL = 0.3  # [m]


def pulling(lamp: float | None = None, attachment: str = "handle") -> vkc.TrajectoryProblem:
    """Return the problem of pulling the drawer, with a lamp above the wrist whose bottom is so high [m]."""
    scene = holding(attachment=attachment)
    if lamp is not None:
        scene = with_boxes(scene, lamp=([0.3, 0.3, 0.1], [1.44, 0.0, lamp + 0.05]))
    return program_of(scene, [vkc.Actuate("drawer", {"slide": GOAL})], options=SHORT)


def base(problem: vkc.TrajectoryProblem, *change: float) -> np.ndarray:
    """Return a straight way of the base: by how much x, y and yaw change."""
    share = np.arange(1, problem.segments + 1)[:, None] / problem.segments
    return np.asarray(problem.start[:3] + share * np.array(change or (0.0, 0.0, 0.0)))


def followed(
    problem: vkc.TrajectoryProblem, way: np.ndarray, *, refine: bool = False, seed: int = 0
) -> Followed:
    return follow(problem, way, np.random.default_rng(seed), refine=refine)


def check(problem: vkc.TrajectoryProblem, rows: np.ndarray) -> None:
    """The hand is at the handle, and nothing collides."""
    slide = problem.chain.index("drawer.slide")
    for row in rows:
        tilt = row[slide - 1] if len(row) == 11 else 0.0
        assert off(problem.scene, row, handle(row[slide], tilt=tilt)) < CLOSED
        assert spare(problem.scene, row, slide=row[slide], held=True) >= -CLEAR - ROUNDING
        assert np.all(
            (row >= problem.lower.min(axis=0) - STILL) & (row <= problem.upper.max(axis=0) + STILL)
        )


@pytest.mark.parametrize("refine", [False, True], ids=["B1", "B2"])
@pytest.mark.parametrize("change", [(-0.25, 0.0, 0.0), (0.0, -0.3, 0.2)], ids=["back", "aside"])
def test_it_follows_to_the_end(change: Sequence[float], refine: bool) -> None:
    problem = pulling()
    way = base(problem, *change)
    found = followed(problem, way, refine=refine)
    assert (found.cause, found.share) == ("", 1.0)
    check(problem, found.z)
    np.testing.assert_allclose(found.z[:, :3], way, rtol=0.0, atol=STILL)
    np.testing.assert_allclose(found.z[:, -1], GOAL * sample_smoothstep(8), rtol=0.0, atol=STILL)
    assert np.abs(np.diff(problem.waypoints(found.z)[:, 3:9], axis=0)).max() < 0.6, (
        "from the waypoint before"
    )


def test_every_arm_is_looked_for_from_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = pulling()
    way, given = base(problem, -0.25, 0.0, 0.0), []
    at = module._Arm.at

    def seen(self: module._Arm, z: np.ndarray, waypoint: int) -> tuple[np.ndarray, str]:
        given.append((z.copy(), waypoint))
        return at(self, z, waypoint)

    monkeypatch.setattr(module._Arm, "at", seen)
    found = followed(problem, way)
    assert [waypoint for _, waypoint in given] == [1, 2, 3, 4, 5, 6, 7, 8]
    rows = np.array([z for z, _ in given])
    np.testing.assert_array_equal(rows[:, 3:9], problem.waypoints(found.z)[:-1, 3:9])
    np.testing.assert_array_equal(rows[:, :3], way)
    np.testing.assert_allclose(rows[:, 9], GOAL * sample_smoothstep(8))


def test_the_same_numbers_give_the_same_motion() -> None:
    problem = pulling(0.92)  # where random arms are needed
    way = base(problem)
    np.testing.assert_array_equal(followed(problem, way).z, followed(problem, way).z)
    assert not np.array_equal(followed(problem, way).z, followed(problem, way, seed=1).z)


def test_out_of_reach() -> None:
    problem = pulling()
    way = base(problem, -0.6, 0.0, 0.0)
    found = followed(problem, way)
    assert found.cause == "no inverse kinematics"
    done = round(8 * found.share)
    assert found.share == done / 8
    assert 0 < done < 8
    assert found.z.shape == (8, problem.chain.size)
    check(problem, found.z[:done])
    np.testing.assert_allclose(found.z[:done, :3], way[:done], rtol=0.0, atol=STILL)
    # From there on all stands still, in what was not at the handle.
    np.testing.assert_array_equal(found.z[done:], np.tile(found.z[done], (8 - done, 1)))
    assert off(problem.scene, found.z[done], handle(found.z[done, -1])) > 1e-3


def test_out_of_reach_at_once() -> None:
    problem = pulling()
    found = followed(problem, np.tile(problem.start[:3] - [2.0, 0.0, 0.0], (8, 1)))
    assert (found.cause, found.share) == ("no inverse kinematics", 0.0)
    assert np.ptp(found.z, axis=0).max() == 0.0


@pytest.mark.parametrize(("refine", "least"), [(False, 0.5), (True, 0.5)], ids=["B1", "B2"])
def test_collision(refine: bool, least: float) -> None:
    """At the end, the lamp is so low that the drawer itself would touch it."""
    problem = pulling(0.9)
    found = followed(problem, base(problem), refine=refine)
    assert found.cause == "collision"
    done = round(8 * found.share)
    assert least <= found.share < 1.0
    check(problem, found.z[:done])
    wrong = found.z[done]
    assert off(problem.scene, wrong, handle(wrong[-1])) < CLOSED, "the chain is closed all the same"
    assert spare(problem.scene, wrong, slide=wrong[-1], held=True) < -1e-3
    np.testing.assert_array_equal(found.z[done:], np.tile(wrong, (8 - done, 1)))


def test_where_the_arm_as_it_was_collides_other_arms_are_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = pulling(0.92)
    found = followed(problem, base(problem))
    assert (found.cause, found.share) == ("", 1.0)
    check(problem, found.z)
    monkeypatch.setattr(module, "SEEDS", 0)
    alone = followed(problem, base(problem))
    assert alone.cause == "collision"
    assert alone.share < 1.0


def test_b2_moves_the_object_off_its_time_law_b1_does_not() -> None:
    problem = pulling(0.94, "handle_free")
    law = GOAL * sample_smoothstep(8)
    plain, refined = (followed(problem, base(problem), refine=refine) for refine in (False, True))
    assert (plain.cause, refined.cause) == ("", "")
    check(problem, plain.z)
    check(problem, refined.z)
    np.testing.assert_allclose(plain.z[:, -1], law, rtol=0.0, atol=STILL)
    assert np.abs(refined.z[:, -1] - law).max() > 0.005
    assert refined.z[-1, -1] == pytest.approx(GOAL, abs=STILL)
    np.testing.assert_allclose(refined.z[:, :3], base(problem), rtol=0.0, atol=STILL)


# --- which of the candidates is taken
# ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "others", "taken"),
    [
        ((5.0, ""), [(1.0, "")], (5.0, "")),  # what the waypoint before leads to, if it is any good
        ((0.0, "collision"), [(3.0, ""), (1.0, ""), (2.0, "")], (1.0, "")),
        (
            (3.0, "collision"),
            [(2.0, "no inverse kinematics"), (4.0, "collision")],
            (3.0, "collision"),
        ),
        (
            (1.0, "no inverse kinematics"),
            [(4.0, "collision"), (5.0, "collision")],
            (4.0, "collision"),
        ),
        (
            (2.0, "no inverse kinematics"),
            [(3.0, "no inverse kinematics")],
            (2.0, "no inverse kinematics"),
        ),
        (
            (3.0, "no inverse kinematics"),
            [(-2.0, "no inverse kinematics")],
            (-2.0, "no inverse kinematics"),
        ),
        ((0.0, "collision"), [], (0.0, "collision")),
    ],
)
def test_the_nearest_of_the_best_kind_is_taken(
    first: tuple[float, str],
    others: list[tuple[float, str]],
    taken: tuple[float, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = pulling()
    arm = module._Arm(problem, KeyframeSampler(problem, np.random.default_rng(0)), refine=False)
    answers = iter([first, *others])

    def candidate(z: np.ndarray, waypoint: int) -> tuple[np.ndarray, str]:
        distance, cause = next(answers)
        return problem.start + distance, cause

    monkeypatch.setattr(arm, "_candidate", candidate)
    monkeypatch.setattr(arm, "_seeds", lambda z: np.tile(z, (len(others), 1)))
    z, cause = arm.at(problem.start, 1)
    assert cause == taken[1]
    np.testing.assert_allclose(z, problem.start + taken[0])


def test_random_arms_are_within_limits_and_nothing_else_changes() -> None:
    problem = pulling(attachment="handle_free")
    problem.chain.upper[5] = problem.start[5] + 0.05
    arm = module._Arm(problem, KeyframeSampler(problem, np.random.default_rng(0)), refine=False)
    seeds = np.vstack([arm._seeds(problem.start) for _ in range(10)])
    assert len(seeds) == 10 * SEEDS
    assert np.all((seeds >= problem.chain.lower) & (seeds <= problem.chain.upper))
    np.testing.assert_array_equal(
        seeds[:, [0, 1, 2, 10]], np.tile(problem.start[[0, 1, 2, 10]], (len(seeds), 1))
    )
    apart = np.abs(seeds - problem.start)[:, 3:10]
    assert apart.max(axis=0)[:6].min() > 1.0
    assert apart.max(axis=0)[6] > 0.3, "the hand tilts about the bar"
    # Half of them are near where the arm is, the others anywhere.
    near, anywhere = (
        apart.reshape(10, SEEDS, 7)[:, part].mean()
        for part in (slice(SEEDS // 2), slice(SEEDS // 2, None))
    )
    assert near < 0.7 * anywhere


def test_what_falls_short_by_rounding_is_no_collision(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refinement ends on the margin, a hair to one side of it or the other."""
    problem = program_of(holding(), [vkc.Actuate("drawer", {"slide": 0.3})], options=SHORT)
    arm = module._Arm(problem, KeyframeSampler(problem, np.random.default_rng(0)), refine=True)
    monkeypatch.setattr(arm.knots, "compute_shortfall", lambda z, waypoint: np.full(len(z), 1e-7))
    assert arm._candidate(problem.start, 1)[1] == ""
