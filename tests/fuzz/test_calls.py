"""Tests public functions with one or two odd arguments."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fuzz.bounds import PLANNING_SECONDS, expect_result_or_error, take_share
from fuzz.calls import list_calls
from fuzz.changes import change_data
from fuzz.values import VALUES, Endless, Hostile, make_pose, nest

PICTURES = ("Plan.plot", "Plan.to_html", "animate", "show", "to_html")  # they take longest
HUGE = 10**5000  # more than a float can be

PAST_FAILURES: list[tuple[str, dict[str, Any]]] = [
    ("Actuate", {"joints": {"slide": HUGE}}),  # OverflowError
    ("Constraint", {"lower": np.array(["2020-01-01"] * 3, "datetime64[D]")}),  # TypeError
    ("Cost", {"weight": HUGE}),  # OverflowError
    ("Freedom.motion", {"value": "x"}),  # TypeError
    ("Grasp", {"object": {}}),  # TypeError
    ("Options", {"dt": HUGE}),  # OverflowError
    ("Options", {"objective": np.zeros(3)}),  # ValueError
    ("Plan.load", {"path": None}),  # TypeError
    ("Plan.load", {"path": "x" * 10_000}),  # OSError
    ("Plan.plot", {"path": 7}),  # TypeError
    ("Plan.save", {"path": "\x00"}),  # ValueError
    ("Reach", {"pose": np.ones(3) * 1j}),  # ComplexWarning
    ("RoomSettings", {"objects": [{"x": 1}]}),  # TypeError
    ("RoomSettings", {"width": (1 + 2j, 7.0)}),  # TypeError
    ("Scene.from_document", {"document": None}),  # TypeError
    ("Scene.from_document", {"document": {"a\ud800b": "husky_ur5e"}}),  # UnicodeEncodeError
    ("Scene.from_document", {"document": {"robot": "husky_ur5e", "objects": Endless()}}),  # crash
    ("Scene.sample_start", {"rng": None}),  # AttributeError
    ("Scene.start_clearance", {"reach": HUGE}),  # OverflowError
    ("Scene.with_held", {"at": Endless()}),  # no end
    ("Scene.with_held", {"held": Endless()}),  # no end
    ("Scene.with_held holds", {"held": ["x", "y", "z"]}),  # AttributeError
    ("Scene.with_placement", {"placement": None}),  # ArgumentError of Boost
    ("Scene.with_placement", {"placement": make_pose(math.nan)}),  # accepted
    ("Scene.with_start", {"arm": [1 + 2j, 0.0, 0.0, 0.0, 0.0, 0.0]}),  # TypeError
    ("Scene.with_start", {"base": ["x", "y", "z"]}),  # ValueError
    ("Scene.with_state", {"name": {"x": 1}}),  # TypeError
    ("Scene.with_state", {"values": {"slide": None}}),  # TypeError
    ("Trajectory.at", {"time": ["x", "y", "z"]}),  # ValueError
    ("Trajectory.from_dict", {"data": None}),  # TypeError
    ("Trajectory.from_ros", {"like": "x"}),  # AttributeError
    ("Trajectory", {"names": 1}),  # TypeError
    ("Trajectory", {"robot_size": "x"}),  # TypeError
    ("Trajectory.to_csv", {"joints": None}),  # TypeError
    ("Trajectory.to_csv", {"units": {"base_x": "a\ud800b"}}),  # UnicodeEncodeError
    ("Trajectory.to_ros", {"joints": np.zeros((0, 3))}),  # ZeroDivisionError
    ("Trajectory.to_ros", {"rate": 1e5}),  # no end
    ("Trajectory.to_ros", {"stamp": math.nan}),  # ValueError
    ("animate", {"viewer": "x"}),  # AttributeError
    ("build", {"cache": 0.5}),  # AttributeError
    ("consolidate holds", {"holds": [10**30]}),  # AttributeError
    ("consolidate", {"holds": ["x", "y", "z"]}),  # AttributeError
    ("frame_jacobian", {"frame": ["x", "y", "z"]}),  # TypeError
    ("frame_placements", {"frames": None}),  # TypeError
    ("invert", {"state": ["x", "y", "z"]}),  # ValueError
    ("load_object", {"name_or_path": Path("a\ud800b.yaml")}),  # UnicodeEncodeError
    ("load_robot", {"base": []}),  # TypeError
    ("load_robot", {"home": ["x", "y", "z"]}),  # TypeError
    ("load_robot", {"locked_joints": {"elbow_joint": HUGE}}),  # OverflowError
    ("load_robot", {"packages": {"x": None}}),  # TypeError
    ("load_scene", {"name_or_path": Hostile()}),  # RuntimeError
    ("load_scene", {"name_or_path": Path("x" * 10_000)}),  # OSError
    ("load_scene", {"name_or_path": Path("\x00")}),  # ValueError
    ("plan", {"callback": 0.5}),  # TypeError after planning
    ("plan", {"initialization": []}),  # TypeError
    ("plan", {"perturbation": 1e300}),  # ValueError in validation
    ("plan", {"perturbation": 1e5}),  # no end in validation
    ("plan", {"planner": "x"}),  # AttributeError
    ("plan", {"time_limit": np.zeros(3)}),  # ValueError
    ("plan", {"progress": nest(5000)}),  # RecursionError
    ("plan", {"steps": [None]}),  # AttributeError
    ("plan_window", {"steps": None}),  # TypeError
    ("plot_joints", {"plan": None}),  # AttributeError
    ("rnea", {"model": None}),  # AttributeError
    ("to_html", {"frames": "x"}),  # AttributeError
    ("validate", {"trajectory": None}),  # AttributeError
]
"""Name of a call, and an argument that once raised an error of another library, or never ended."""


@st.composite
def odd_calls(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    """Return the name of a call, and one or two odd arguments."""
    others = [name for name in list_calls() if name not in PICTURES]
    name = draw(st.sampled_from((*PICTURES, *others * 4)))
    valid = list_calls()[name].keywords
    chosen = st.lists(st.sampled_from(list(valid)), min_size=1, max_size=2, unique=True)
    changes = {}
    for parameter in draw(chosen):
        argument = valid[parameter]
        values = VALUES | st.builds(nest, st.just(5000))
        if isinstance(argument, tuple | np.ndarray):
            argument = list(argument)
        if isinstance(argument, dict | list) and argument:
            values |= change_data(argument, VALUES, most=1)
        if parameter == "callback":  # errors of callables pass through
            values = values.filter(lambda value: not callable(value))
        changes[parameter] = draw(values)
    return name, changes


@take_share(0.25)
@given(odd_calls())
def test_odd_arguments_yield_a_result_or_an_error(call: tuple[str, dict[str, Any]]) -> None:
    name, changes = call
    with expect_result_or_error(PLANNING_SECONDS):
        list_calls()[name](**changes)


@pytest.mark.parametrize(
    ("name", "changes"),
    PAST_FAILURES,
    ids=[f"{name}-{'-'.join(changes)}" for name, changes in PAST_FAILURES],
)
def test_past_failures_of_calls_yield_a_result_or_an_error(
    name: str, changes: dict[str, Any]
) -> None:
    assert changes.keys() <= list_calls()[name].keywords.keys()
    with expect_result_or_error(PLANNING_SECONDS):
        list_calls()[name](**changes)


@pytest.mark.long
def test_valid_arguments_yield_a_result() -> None:
    for call in list_calls().values():
        call()
