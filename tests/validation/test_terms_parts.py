"""Where own constraints are looked at, and what their formulas are given."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.drives import hall, moved, of_rows

import vkc_pin as vkc
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.terms import INTERMEDIATE_FACTOR, _compute_inputs, _find_rows, check_terms
from vkc_pin.world.task.formula import Formula
from vkc_pin.world.task.terms import trace_terms


def looked_at(
    way: list[float], phases: list[tuple[int, int, bool]], each: int = 3
) -> tuple[list[int], list[int]]:
    """Return the waypoints and the samples between them at which a term is asked about; `each` samples a step."""
    spans = [
        SimpleNamespace(first=first, last=last, name=f"{active}", held={})
        for first, last, active in phases
    ]
    positions = np.column_stack([way, np.zeros(len(way))])
    trajectory = SimpleNamespace(
        times=np.arange(float(len(way))), phases=spans, positions=positions
    )
    samples: Any = SimpleNamespace(trajectory=trajectory, waypoint_rows=each * np.arange(len(way)))
    term: Any = SimpleNamespace(is_active=lambda name, held: name == "True")
    at, between = _find_rows(samples, term)
    assert not (at % each).any()
    return (at // each).tolist(), between.tolist()


def test_a_term_holds_after_the_first_waypoint_of_its_phases() -> None:
    assert looked_at([0, 1, 2, 3], [(0, 3, True)]) == ([1, 2, 3], [4, 5, 7, 8])
    assert looked_at([0, 1, 2, 3], [(0, 3, False)]) == ([], [])
    assert looked_at([0, 1, 2, 3, 4], [(0, 2, False), (2, 4, True)]) == ([3, 4], [10, 11])
    assert looked_at([0, 1, 2, 3, 4], [(0, 2, True), (2, 4, False)]) == ([1, 2], [4, 5])
    assert looked_at([0, 1, 2, 3, 4], [(0, 2, True), (2, 4, True)]) == (
        [1, 2, 3, 4],
        [4, 5, 7, 8, 10, 11],
    )


def test_while_the_robot_still_stands_nothing_is_asked() -> None:
    """Unless it was asked about before; at its last waypoint it is, but for what stands from the start to the end."""
    assert looked_at([0, 1, 1, 1, 2], [(0, 1, False), (1, 4, True)]) == ([4], [])
    assert looked_at([0, 1, 1, 1, 2], [(0, 1, True), (1, 4, True)]) == (
        [1, 2, 3, 4],
        [4, 5, 7, 8, 10, 11],
    )
    assert looked_at([0, 1, 1, 1], [(0, 1, False), (1, 3, True)]) == ([3], [])
    assert looked_at([0, 0, 0], [(0, 2, True)]) == ([], [])
    assert looked_at([0, 0, 1, 0, 0], [(0, 4, True)]) == (
        [2, 3, 4],
        [7, 8, 10, 11],
    )  # back where it began
    assert looked_at([0, 0, 0, 1], [(0, 1, True), (1, 3, True)]) == ([3], [])
    assert looked_at([0, 0, 0.5, 0.5], [(0, 3, True)], each=2) == ([2, 3], [5])


@pytest.mark.parametrize("moving", [False, True])
def test_formulas_are_given_frames_coordinates_and_the_last_steps(moving: bool) -> None:
    """Rotations by columns, translations, coordinates: now, a step before, and how long the step is."""
    scene = hall()
    rows = np.array([moved(scene.start, x=x, yaw=2.0 * x) for x in (0.0, 0.02, 0.06, 0.07)])
    motion = of_rows(scene, rows)
    motion = vkc.Trajectory(
        motion.names, np.array([1.0, 1.5, 3.5, 4.0]), rows, motion.phases, motion.robot_size
    )
    samples = Samples(scene, motion)

    def expression(s: Any) -> Any:
        value = (
            s.position("tool")[0]
            + s.position("forearm_link")[1]
            + s.coordinate("base_x")
            + s.coordinate("base_yaw")
        )
        return value + s.rate("base_x") if moving else value

    (term,) = trace_terms(scene, [vkc.Constraint("any", expression, upper=0.0)])
    formula = term.formula
    assert formula.uses_previous == moving
    asked = np.sort(np.append(samples.waypoint_rows[1:], samples.waypoint_rows[1:] - 1))
    inputs = _compute_inputs(samples, formula, asked)
    half = formula.state_size
    assert inputs.shape == (len(asked), 2 * half + 1)
    model, data = samples.world.model, samples.world.model.createData()

    def expected(time: float) -> np.ndarray:
        z = samples.world.compute_positions(motion, np.array([time]))
        pin.framesForwardKinematics(model, data, samples.world.coordinates.q(z)[0])
        parts = [
            np.append(data.oMf[f].rotation.T.ravel(), data.oMf[f].translation)
            for f in map(model.getFrameId, formula.frames)
        ]
        return np.concatenate(
            [*parts, [z[0, samples.world.coordinates.index(name)] for name in formula.coordinates]]
        )

    assert len(formula.frames) == 2
    assert len(formula.coordinates) == 2
    for row, numbers in zip(asked, inputs, strict=True):
        time = samples.times[row]
        step = {True: 0.5, False: 2.0}[bool(time <= 1.5 or time > 3.5)]
        assert numbers[-1] == step
        np.testing.assert_allclose(numbers[:half], expected(time), atol=1e-12)
        before = max(time - step, 1.0) if moving else time
        np.testing.assert_allclose(numbers[half:-1], expected(before), atol=1e-9)


@pytest.mark.parametrize(
    ("lower", "upper", "detail", "amount"),
    [
        (1.5, np.inf, "0.02 is less than 1.5 by 1.48", 1.48),
        (-np.inf, 0.5, "1 is more than 0.5 by 0.5", 0.5),
        (0.6, 0.7, "0.02 is less than 0.6 by 0.58", 0.58),  # the worse of two sides
        (0.3, 0.5, "1 is more than 0.5 by 0.5", 0.5),
    ],
)
def test_by_how_much_and_on_which_side(
    lower: float, upper: float, detail: str, amount: float
) -> None:
    scene = hall()
    motion = of_rows(scene, np.array([moved(scene.start, x=x) for x in (0.0, 0.02, 1.0)]))
    given = vkc.Constraint("x", lambda s: s.coordinate("base_x"), lower=lower, upper=upper)
    found = [
        one
        for one in check_terms(Samples(scene, motion), trace_terms(scene, [given]))
        if "between" not in one.detail
    ]
    assert [(one.detail, one.subject, one.unit) for one in found] == [(detail, "x", "")]
    assert found[0].amount == pytest.approx(amount)
    assert found[0].waypoint == (1 if "less" in detail else 2)
    assert found[0].time == motion.times[found[0].waypoint]


def test_between_waypoints_ten_times_as_much_is_all_right() -> None:
    """A bump of the formula half-way of a step, 1e-3 times some number high."""
    assert INTERMEDIATE_FACTOR == 10.0
    scene = hall()
    motion = of_rows(scene, np.array([moved(scene.start, x=x) for x in (0.0, 1.0, 2.0, 3.0)]))
    samples = Samples(scene, motion)
    for height, told in ((9.0, False), (11.0, True), (25.0, True)):
        import casadi as ca

        bump = vkc.Constraint(
            "bump",
            lambda s, h=height: (
                1e-3 * h * ca.fmax(0.0, 1.0 - 4.0 * ca.fabs(s.coordinate("base_x") - 1.5))
            ),
            upper=0.0,
        )
        found = check_terms(samples, trace_terms(scene, [bump]))
        assert len(found) == told
        if told:
            assert (found[0].waypoint, found[0].time) == (1, pytest.approx(0.375))
            assert found[0].amount == pytest.approx(1e-3 * height)
            assert found[0].detail.endswith(" between waypoints")


def test_what_is_never_asked_about_is_not_worked_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A constraint of a phase that there is not; those that follow it are looked at."""
    scene = hall()
    motion = of_rows(scene, np.array([moved(scene.start, x=x) for x in (0.0, 0.5, 1.0)]))
    never = vkc.Constraint("never", lambda s: s.coordinate("base_x"), upper=0.5, during="another")
    always = vkc.Constraint("always", lambda s: s.coordinate("base_x"), upper=0.5)
    terms, asked, values = trace_terms(scene, [never, always]), list[int](), Formula.evaluate

    def counted(formula: Formula, inputs: np.ndarray) -> np.ndarray:
        asked.append(len(inputs))
        return values(formula, inputs)

    monkeypatch.setattr(Formula, "evaluate", counted)
    assert {one.subject for one in check_terms(Samples(scene, motion), terms)} == {"always"}
    assert len(asked) == 1
    assert asked[0] > 0
