"""Compares derivatives that are assembled by hand with CasADi's own, for drawn structures."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from hypothesis import event, given, settings
from hypothesis import strategies as st

from vkc_pin.planning.chain.kinematic_tree import KinematicTree
from vkc_pin.planning.chain.pose import ROW_BOUNDS, PoseRow
from vkc_pin.planning.nlp.term_rows import FrameLocation, TermLocation, TermRow, Tree, Value
from vkc_pin.planning.nlp.transcription import Transcription
from vkc_pin.planning.nlp.waypoint import Structure
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.task.terms import Formula, State
from vkc_pin.world.trajectory.wheels import OMNIDIRECTIONAL, RollingLimits

CACHE = Cache()
LOCAL = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.8, 0.5), np.array([0.2, -0.1, 0.3]))


@cache
def make_model(kind: str) -> pin.Model:
    """Return a base with an arm: a hinge, two slides in step, and a joint without limits."""
    model = pin.Model()
    parent = 0
    joints: list[Any] = [pin.JointModelPlanar()] if kind != "fixed" else []
    joints += [pin.JointModelRZ(), pin.JointModelPX(), pin.JointModelRUBY()]
    for number, joint in enumerate(joints):
        placement = LOCAL if number else pin.SE3.Identity()
        parent = model.addJoint(parent, joint, placement, f"j{number}")
    slide = model.joints[model.getJointId(f"j{len(joints) - 2}")]
    follower = pin.JointModelMimic(slide, 0.5, 0.1)
    model.addJoint(parent, follower, LOCAL, "follower")
    return model


@cache
def make_root(kind: str) -> pin.Model:
    """Return the model of `make_model` without its last two joints."""
    model = make_model(kind)
    root = pin.Model()
    for joint in range(1, model.njoints - 2):
        root.addJoint(
            model.parents[joint],
            model.joints[joint],
            model.jointPlacements[joint],
            model.names[joint],
        )
    return root


def trace(write: Callable[[State], Any]) -> Formula:
    state = State(None, None)
    return state.make_formula(write(state))


FORMULAS = {
    # one row; several rows; with the previous waypoint; with the time step; linear
    "one row": trace(lambda s: ca.sumsqr(s.position("a")) - ca.sin(s.coordinate("c"))),
    "position": trace(lambda s: s.position("a") * s.coordinate("c")),
    "velocity": trace(lambda s: s.velocity("a")),
    "rate": trace(lambda s: s.rate("c")),
    "axis": trace(lambda s: s.rotation("a")[:, 0] * s.position("a")[2] + s.velocity("a")),
    "coordinate": trace(lambda s: 2.0 * s.coordinate("c")),
}


@st.composite
def draw_term(draw: st.DrawFn, model: pin.Model, segments: int) -> TermRow:
    formula = FORMULAS[draw(st.sampled_from(sorted(FORMULAS)))]
    is_cost = formula.rows == 1 and draw(st.booleans())
    columns = st.none() | st.integers(0, Coordinates(model).size - 1)
    values = tuple(Value(draw(columns), 0.4) for _ in formula.coordinates)
    local = (*LOCAL.rotation.T.ravel().tolist(), *LOCAL.translation.tolist())
    tree = None
    joint = draw(st.integers(0, model.njoints - 1))
    if formula.frames and draw(st.booleans()):
        # an object in the world whose joints are coordinates of the chain, or constants
        door = pin.Model()
        door.addJoint(0, pin.JointModelRX(), LOCAL, "hinge")
        tree = Tree(door.saveToString(), local, (Value(draw(columns), 0.2),))
        joint = draw(st.integers(0, 1))
    is_fixed = joint == 0 or (tree is not None and tree.values[0].column is None)

    def locate(waypoint: int) -> tuple[FrameLocation, ...]:
        at = -1 if is_fixed else waypoint
        return tuple(FrameLocation(local, joint, at, tree) for _ in formula.frames)

    waypoints = draw(st.lists(st.integers(1, segments), min_size=1, unique=True))
    locations = [TermLocation(t, locate(t), locate(t - 1)) for t in sorted(waypoints)]
    # `term_locations` keeps the waypoints at which a term depends on a variable
    row = TermRow(formula, 0.7 if is_cost else None, values, ())
    kept = tuple(at for at in locations if max(row.kind(at)[0], default=0) > 0)
    return TermRow(formula, row.weight, values, kept)


@st.composite
def draw_structure(draw: st.DrawFn) -> Structure:
    base = draw(st.sampled_from(["fixed", "omnidirectional", "wheeled"]))
    model = make_model(base)
    # its last joint may be mounted: placed by an argument
    root = draw(st.sampled_from([model, make_root(base)]))
    segments = draw(st.integers(1, 4))
    poses = []
    for _ in range(draw(st.integers(0, 2))):
        joint = draw(st.integers(1, model.njoints - 1))
        waypoints = draw(st.lists(st.integers(1, segments), min_size=1, unique=True))
        kind = draw(st.sampled_from(sorted(ROW_BOUNDS)))
        shift = draw(st.none() | st.just((1, (0.1, -0.2, 0.3))))
        poses.append(PoseRow(joint, tuple(sorted(waypoints)), kind, shift))
    rolling = OMNIDIRECTIONAL
    if base == "wheeled":
        wheels = draw(st.sampled_from([{}, {"track": 0.5, "wheel_speed": 1.0}]))
        rolling = RollingLimits(turning_radius=draw(st.sampled_from([0.0, 0.8])), **wheels)
    span = st.tuples(st.integers(0, segments), st.integers(0, segments)).map(sorted)
    columns = st.integers(0, Coordinates(model).size - 1)
    clamped = draw(st.lists(st.tuples(columns, span), max_size=1))
    pushed = draw(st.lists(st.tuples(columns, span, st.sampled_from([1, -1])), max_size=1))
    terms = draw(st.lists(draw_term(model, segments), max_size=2))
    interior = range(1, segments)
    stops = draw(st.lists(st.sampled_from(interior), unique=True)) if interior else []
    return Structure(
        tree=KinematicTree(model, root),
        segments=segments,
        poses=tuple(poses),
        slots=draw(st.integers(0, 2)),
        stops=tuple(sorted(stops)),
        rolling=rolling,
        clamped=tuple((column, *ends) for column, ends in clamped),
        pushed=tuple((column, *ends, sign) for column, ends, sign in pushed),
        terms=tuple(term for term in terms if term.locations),
    )


@settings(max_examples=200, deadline=None, derandomize=True)
@given(draw_structure(), st.integers(0, 2**16))
def test_assembled_derivatives_equal_those_of_casadi(structure: Structure, seed: int) -> None:
    t = Transcription(structure, CACHE)
    event(f"rows of a step: {t.steps.rows if len(t.base_rows) else 0}")
    event(f"constraint rows: {min(t.rows, 2)}")
    weight = ca.MX.sym("weight")
    lagrangian = weight * t.f + ca.dot(t.multipliers, t.g)
    found = [t.gradient, t.jacobian, weight * t.objective_curvature + t.hessian]
    expected = [
        ca.gradient(t.f, t.x),
        ca.jacobian(t.g, t.x),
        ca.triu(ca.hessian(lagrangian, t.x)[0]),
    ]
    symbols = {**t.parameter_symbols, "x": t.x, "lam": t.multipliers, "weight": weight}
    compare = ca.Function("compare", list(symbols.values()), [*found, *expected])
    rng = np.random.default_rng(seed)
    values = {name: rng.uniform(0.2, 1.0, symbol.shape) for name, symbol in symbols.items()}
    values["mounts"] = structure.tree.mounts.T  # whose rotations are rotations
    point = list(values.values())
    matrices = [np.asarray(matrix) for matrix in compare(*point)]
    for one, other in zip(matrices[:3], matrices[3:], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
