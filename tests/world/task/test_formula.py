from __future__ import annotations

import json

import casadi as ca
import numpy as np
import pytest

from vkc_pin.world.task.terms import ROUNDING, Formula, State

FRAMES, COORDINATES = ("tool", "cup.cup"), ("elbow_joint", "door.hinge")
DT = 0.25


def make_state() -> State:
    return State(FRAMES, COORDINATES)


def sample_inputs(formula: Formula, count: int = 5) -> np.ndarray:
    """Return random inputs, shape (count, 2·state_size + 1), with time step DT."""
    inputs = np.random.default_rng(0).normal(size=(count, 2 * formula.state_size + 1))
    inputs[:, -1] = DT
    return inputs


def test_state_returns_the_named_quantities() -> None:
    s = make_state()
    parts = [
        s.rotation("cup.cup")[0, 1],
        s.rotation("cup.cup")[1, 0],
        s.position("cup.cup"),
        s.velocity("tool"),
    ]
    formula = s.make_formula(ca.vertcat(*parts, s.coordinate("door.hinge"), s.rate("elbow_joint")))
    assert formula.frames == ("cup.cup", "tool")
    assert formula.coordinates == ("door.hinge", "elbow_joint")
    assert (formula.state_size, formula.rows, formula.uses_previous, formula.uses_time_step) == (
        26,
        10,
        True,
        True,
    )
    x = sample_inputs(formula)
    before = x[:, 26:]
    rotation = x[:, :9].reshape(5, 3, 3).swapaxes(1, 2)  # by columns
    expected = [
        rotation[:, 0, 1],
        rotation[:, 1, 0],
        *x[:, 9:12].T,
        *((x[:, 21:24] - before[:, 21:24]) / DT).T,
    ]
    expected += [x[:, 24], (x[:, 25] - before[:, 25]) / DT]
    np.testing.assert_allclose(formula.evaluate(x), np.stack(expected, axis=1), atol=1e-12)


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


def test_equal_formulas_compare_equal_and_survive_json() -> None:
    def make_formula(limit: float) -> Formula:
        s = make_state()
        return s.make_formula(ca.sumsqr(s.velocity("tool")) - limit)

    assert make_formula(0.5) == make_formula(0.5)
    assert hash(make_formula(0.5)) == hash(make_formula(0.5))
    assert make_formula(0.5) != make_formula(0.6)
    formula = make_formula(0.1)  # not a binary fraction
    code = tuple(
        (name, tuple(read), to, value)
        for name, read, to, value in json.loads(json.dumps(formula.code))
    )
    assert Formula(formula.frames, formula.coordinates, formula.rows, code) == formula


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
