from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from helpers.carrying import describe_table, make_room
from helpers.drives import make_hall
from helpers.expected_errors import expect_error

import vkc_pin as vkc
from vkc_pin.world.task.terms import (
    ROUNDING,
    Formula,
    check_terms_active,
    term_from_dict,
    term_to_dict,
    trace_terms,
)

FRAMES, COORDINATES = ("tool", "cup.cup"), ("elbow_joint", "door.hinge")
DT = 0.25


def make_state() -> vkc.State:
    return vkc.State(FRAMES, COORDINATES)


def sample_inputs(formula: Formula, count: int = 5) -> np.ndarray:
    """Return random inputs, shape (count, 2·state_size + 1), with time step DT."""
    inputs = np.random.default_rng(0).normal(size=(count, 2 * formula.state_size + 1))
    inputs[:, -1] = DT
    return inputs


def test_state_returns_the_named_quantities() -> None:
    s = make_state()
    turn = s.rotation("cup.cup")
    parts = [turn[0, 1], turn[1, 0], s.position("cup.cup"), s.velocity("tool")]
    formula = s.make_formula(ca.vertcat(*parts, s.coordinate("door.hinge"), s.rate("elbow_joint")))
    assert formula.frames == ("cup.cup", "tool")
    assert formula.coordinates == ("door.hinge", "elbow_joint")
    assert (formula.state_size, formula.rows) == (26, 10)
    assert formula.uses_previous
    assert formula.uses_time_step
    x = sample_inputs(formula)
    rates = (x[:, :26] - x[:, 26:52]) / DT
    rotation = x[:, :9].reshape(5, 3, 3).swapaxes(1, 2)  # by columns
    expected = np.column_stack(
        [rotation[:, 0, 1], rotation[:, 1, 0], x[:, 9:12], rates[:, 21:24], x[:, 24], rates[:, 25]]
    )
    np.testing.assert_allclose(formula.evaluate(x), expected, atol=1e-12)


@pytest.mark.parametrize(
    "expression",
    [
        lambda x, y: ca.if_else(x > 0.2, ca.exp(y), -ca.fabs(x)) + ca.fmax(x, y) ** 3,
        lambda x, y: ca.atan2(y, x) / (2.0 + ca.cos(y)) - ca.tanh(x) * 1.5,
        lambda x, y: ca.vertcat(
            x * y, 7.0, ca.fmin(x, 0.1), ca.sign(y) + ca.floor(x), -x, x**2, 1 / (3 + y)
        ),
        lambda x, y: (
            ca.logic_or(x > 0, y > 0) * x
            + ca.sqrt(x**2 + y**2 + 1)
            + ca.log(2 + x**2)
            + ca.acos(0.3 * ca.sin(y))
        ),
    ],
)
def test_formula_evaluates_the_expression(expression) -> None:  # type: ignore[no-untyped-def]
    s = make_state()
    formula = s.make_formula(expression(s.coordinate("elbow_joint"), s.coordinate("door.hinge")))
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    direct = ca.Function("direct", [x, y], [expression(x, y)])
    inputs = sample_inputs(formula, 20)
    expected = [np.asarray(direct(row[0], row[1])).ravel() for row in inputs]
    np.testing.assert_allclose(formula.evaluate(inputs), expected, atol=2 * ROUNDING)


def test_square_roots_are_differentiable_at_zero() -> None:
    s = make_state()
    formula = s.make_formula(ca.norm_2(s.velocity("tool")))
    x = ca.SX.sym("x", 25)
    value = formula.function(x)
    derivatives = ca.Function("d", [x], [value, ca.jacobian(value, x), ca.hessian(value, x)[0]])
    at_rest = np.r_[np.ones(24), DT]
    found = [np.asarray(part.full()) for part in derivatives(at_rest)]
    assert all(np.isfinite(part).all() for part in found)
    assert 0.0 <= found[0].item() <= 1e-4
    moving = at_rest.copy()
    moving[9] += 0.5 * DT
    assert float(formula.function(moving)) == pytest.approx(0.5, abs=2e-8)


PERSON = np.array([1.0, 2.0, 1.0])
SHORT = vkc.Options(reach_waypoints=3)


def make_upright(**fields: Any) -> vkc.Constraint:
    return vkc.Constraint(
        "upright", lambda s: s.rotation("stick.stick")[2, 2], **{"lower": 0.98, **fields}
    )


def make_terms() -> list[vkc.Constraint | vkc.Cost]:
    slow = vkc.Constraint(
        "slow",
        lambda s: (
            ca.norm_2(s.velocity("tool")) - 0.2 - 0.5 * ca.norm_2(PERSON - s.position("tool"))
        ),
        upper=0.0,
    )
    within = vkc.Constraint(
        "within",
        lambda s: s.position("tool"),
        lower=[-1, -2, 0],
        upper=[1, 2, np.inf],
        tolerance=1e-2,
    )
    return [
        slow,
        within,
        vkc.Cost(
            "elbow", lambda s: (s.coordinate("elbow_joint") - 1.5) ** 2, weight=0.1, holding="stick"
        ),
    ]


def test_terms_survive_a_round_trip_through_data() -> None:
    scene = make_room(describe_table())
    found = trace_terms(scene, make_terms())
    assert [term.name for term in found] == ["slow", "within", "elbow"]
    assert [term.formula.uses_time_step for term in found] == [True, False, False]
    for term in found:
        again = term_from_dict(json.loads(json.dumps(term_to_dict(term))))
        assert (again, hash(again)) == (term, hash(term))
    assert trace_terms(scene, found) == found == trace_terms(scene, make_terms())
    (other,) = trace_terms(scene, [make_upright()])
    assert other.formula != found[1].formula
    assert trace_terms(scene, []) == ()


@pytest.mark.parametrize(
    ("bounds", "expected"),
    [
        ({"lower": None, "upper": 0.0}, [[-np.inf] * 3, [0.0] * 3]),
        ({"upper": 1}, [[0.98] * 3, [1.0] * 3]),
        ({"lower": [-1, -2, 0], "upper": [1, 2, np.inf]}, [[-1, -2, 0], [1, 2, np.inf]]),
    ],
)
def test_bounds_are_extended_to_all_rows(bounds: dict[str, Any], expected: Any) -> None:
    np.testing.assert_array_equal(make_upright(**bounds).compute_bounds(3), expected)


@pytest.mark.parametrize(
    ("limits", "active"),
    [
        ({}, [True, True, True]),
        ({"during": "place stick"}, [True, False, False]),
        ({"holding": "stick"}, [False, True, False]),
        ({"during": ["place stick", "go to"], "holding": "stick"}, [False, True, False]),
        ({"during": ["go to"]}, [False, True, True]),
    ],
)
def test_terms_are_active_in_their_phases_and_holds(
    limits: dict[str, Any], active: list[bool]
) -> None:
    term = make_upright(**limits)
    when = (("place stick", ()), ("go to", ("stick",)), ("go to", ()))
    assert [term.is_active(phase, held) for phase, held in when] == active


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"lower": None}, r"terms\['upright'\]\.lower, upper: no bound"),
        ({"lower": [0.0, -np.inf]}, "no bound"),
        ({"lower": np.inf}, r"\.lower: no such bound"),
        ({"lower": [[0.0]]}, r"\.lower: no such bound"),
        ({"lower": "low"}, r"\.lower: not a number"),
        ({"upper": 0.9}, "lower is more than upper"),
        ({"lower": [0, 3], "upper": [1, 2]}, "lower is more than upper"),
        ({"lower": [0, 0], "upper": [1, 2, 3]}, "wrong number of bounds"),
        ({"tolerance": 0.0}, r"\.tolerance: out of range"),
        ({"during": []}, r"\.during: not phases"),
        ({"holding": 3}, r"\.holding: not an object"),
    ],
)
def test_errors_name_the_invalid_field(fields: dict[str, Any], message: str) -> None:
    with expect_error(message):
        make_upright(**fields)


def test_names_expressions_and_weights_are_checked() -> None:
    with expect_error(r"Cost\.name: not a name"):
        vkc.Cost("", lambda s: s.coordinate("base_x"))
    with expect_error(r"terms\['far'\]\.expression: not a function"):
        vkc.Constraint("far", 3.0, lower=0.0)  # type: ignore[arg-type]
    for weight in (0.0, np.inf, "much"):
        with expect_error(r"terms\['far'\]\.weight: out of range"):
            vkc.Cost("far", lambda s: s.coordinate("base_x"), weight=weight)  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        vkc.Cost("far", lambda s: s.coordinate("base_x"), 0.1)  # type: ignore[misc]


def raise_error(s: vkc.State) -> Any:
    raise ZeroDivisionError("mine")


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        (lambda s: 3.0, "it does not depend on the state"),
        (lambda s: 0 * s.coordinate("base_x"), "it does not depend on the state"),
        (lambda s: None, "not a CasADi expression"),
        (lambda s: s.rotation("tool"), "wrong shape"),
        (lambda s: s.coordinate("base_x") >= 1.0, "a comparison"),
        (lambda s: s.coordinate("base_x") + ca.SX.sym("mine"), "it has symbols of its own"),
        (
            lambda s: s.coordinate("base_x") if s.coordinate("base_y") > 0 else 0.0,
            "it cannot be evaluated",
        ),
        (raise_error, "it cannot be evaluated.*mine"),
    ],
)
def test_errors_name_the_invalid_expression(
    expression: Callable[[vkc.State], Any], message: str
) -> None:
    with expect_error(rf"(?s)^terms\['mine'\]\.expression: {message}"):
        trace_terms(make_hall(), [vkc.Constraint("mine", expression, lower=0.0)])


@pytest.mark.parametrize(
    ("term", "field", "nearest"),
    [
        (vkc.Cost("mine", lambda s: s.position("stick.tipp")), "expression", "stick.tip"),
        (vkc.Cost("mine", lambda s: s.velocity("tol")), "expression", "tool"),
        (vkc.Cost("mine", lambda s: s.coordinate("elbow_jiont")), "expression", "elbow_joint"),
        (make_upright(holding="stik"), "holding", "stick"),
    ],
)
def test_unknown_names_in_terms_are_rejected(term: Any, field: str, nearest: str) -> None:
    scene = make_room(describe_table())
    with expect_error(field=f"terms['{term.name}'].{field}", nearest=nearest):
        trace_terms(scene, [term])
    with expect_error("there is no frame 'stick"):  # another scene
        trace_terms(make_hall(), trace_terms(scene, [make_upright()]))


def test_unknown_phases_are_rejected() -> None:
    phases = [("reach stick.grip", ()), ("place stick", ("stick",))]
    check_terms_active(
        [make_upright(), make_upright(during="place stick"), make_upright(holding="stick")], phases
    )
    with expect_error(
        "there is no phase 'place stik'",
        nearest="place stick",
        choices=("reach stick.grip", "place stick"),
    ):
        check_terms_active([make_upright(during=["place stick", "place stik"])], phases)
    for wrong in (
        make_upright(holding="ball"),
        make_upright(holding="stick", during="reach stick.grip"),
    ):
        with expect_error("never held in these phases"):
            check_terms_active([wrong], phases)


@pytest.mark.parametrize("function", [vkc.plan, vkc.build])
@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ([make_upright(during="plaice stick")], "phase 'plaice stick'; did you mean 'place stick'"),
        ([vkc.Cost("far", lambda s: s.position("too")[0])], "there is no frame 'too'"),
        ([make_upright(lower=[0, 0])], "wrong number of bounds"),
        (make_upright(), "terms: not a list"),
        ([make_upright(), lambda s: 0], r"terms\[1\]: wrong type of entry"),
        ([make_upright(), make_upright(lower=0.5)], "two terms share a name"),
    ],
)
def test_invalid_terms_are_found_before_planning(
    function: Callable[..., Any], terms: Any, message: str
) -> None:
    steps = [vkc.Place("stick", (0.8, 0.5, 0.56)), vkc.GoTo(0.0, 0.0)]
    with expect_error(message):
        function(make_room(describe_table()), steps, options=SHORT, terms=terms)


@pytest.mark.parametrize(
    "wrong",
    [
        {"code": "rm"},
        {"code": [["open", [0], 0, 0.0]]},
        {"code": [["sin", [9], 0, 0.0]]},
        {"code": [["input", [99], 0, 0.0]]},
        {"rows": "many"},
        {"frames": []},
        *({"rows": rows} for rows in (0, -1, 2, 10**6, 10**9, 1e30, 10**400)),
        {"rows": 2, "code": [["const", [], 0, 1.0], *2 * [["output", [0], 0, 0.0]]]},
        {"code": [["const", [], 0, 1.0], ["output", [0], -1, 0.0]]},
    ],
)
def test_damaged_expressions_are_rejected(wrong: dict[str, Any]) -> None:
    (term,) = trace_terms(make_room(describe_table()), [make_upright()])
    data = term_to_dict(term)
    with expect_error("not a saved term"):
        term_from_dict({**data, "expression": {**data["expression"], **wrong}})
