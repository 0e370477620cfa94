"""The parts of the check of goals: who is in the hand when, what is missing of it, and whose turn it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.validation import goals
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Release, Step, Touch

STICK, DOOR = Hold("stick", "grip"), Hold("door", "handle")
BALL = Hold("ball", "pull", STICK, "tip")
GO = GoTo(0.0, 0.0)
PUT = (0.0, 0.0, 0.0)


def samples_of(*holds: Hold, phases: Sequence[Sequence[str]] = ()) -> Any:
    """Return a motion in a scene with these holds; in each of its phases some things are held."""
    objects = {
        name: SimpleNamespace(object=SimpleNamespace(free=name != "door"))
        for name in ("stick", "ball", "cup", "door")
    }
    spans = [
        SimpleNamespace(
            name=f"phase {k}",
            first=10 * k,
            last=10 * (k + 1),
            held=dict.fromkeys(held, "grip"),
            holds=(),
        )
        for k, held in enumerate(phases)
    ]
    scene = SimpleNamespace(
        objects=objects, holds=holds, held={hold.object: hold.attachment for hold in holds}
    )
    times = 0.5 * np.arange(10.0 * len(spans) + 1)
    return SimpleNamespace(scene=scene, trajectory=SimpleNamespace(phases=spans, times=times))


# --- who is in the hand
# -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("holds", "steps", "expected"),
    [
        ([], [GO], ["", ""]),
        ([STICK, DOOR], [GO], ["stick", "stick"]),  # a door stays where it is
        ([], [Grasp("stick"), GO, Grasp("door")], ["", "stick", "stick", "stick"]),
        (
            [STICK],
            [Grasp("ball", by="stick.tip"), Place("stick", PUT)],
            ["stick", "stick ball", ""],
        ),
        ([STICK, BALL], [Release("ball")], ["stick ball", "stick"]),
        ([STICK, BALL], [Place("stick", PUT)], ["stick ball", ""]),
        ([STICK, BALL], [Release()], ["stick ball", ""]),
        (
            [STICK, BALL],
            [Grasp("cup", by="ball.ball"), Release("stick")],
            ["stick ball", "stick ball cup", ""],
        ),
        ([STICK], [Grasp("cup"), Release("stick")], ["stick", "stick cup", "cup"]),
        (
            [],
            [Touch("cup.rim", PUT), Touch("tool", PUT), Touch("door.panel", PUT)],
            ["", "cup", "cup", "cup"],
        ),
        ([STICK], [Touch("ball.ball", PUT), Release("stick")], ["stick", "stick ball", "ball"]),
        ([], [Actuate("cup", {"lid": 1.0}), Place("cup", PUT), Release("door")], ["", "", "", ""]),
        (
            [STICK, BALL],
            [Grasp("ball"), Release("stick")],
            ["stick ball", "stick ball", ""],
        ),  # it is held as it was
    ],
)
def test_what_steps_want_in_the_hand(
    holds: list[Hold], steps: list[Step], expected: list[str]
) -> None:
    found = goals._find_grasped_objects(samples_of(*holds), steps)
    assert [sorted(names) for names in found] == [sorted(names.split()) for names in expected]


@pytest.mark.parametrize(
    ("end", "step", "missing"),
    [
        (0, GO, ["cup"]),  # before anything begins: what the scene holds, and the first phase
        (1, GO, ["cup", "stick"]),
        (2, GO, ["ball", "stick"]),
        (3, GO, ["ball", "stick"]),
        (4, GO, ["ball", "cup", "stick"]),
        (4, Grasp("cup"), ["ball", "stick"]),  # taken hold of as the motion ends
        (1, Grasp("cup"), ["cup", "stick"]),
        (4, Place("cup", PUT), ["ball", "cup", "stick"]),
    ],
)
def test_what_should_be_in_the_hand_and_is_not(end: int, step: Step, missing: list[str]) -> None:
    """After `end` phases: in the one before, or in the one that follows."""
    samples = samples_of(STICK, phases=[["ball"], [], ["cup"], []])
    found = goals._find_missing_grasps(
        samples, [GO, step], [{"door"}, set(), {"stick", "ball", "cup"}], 1, end
    )
    assert [miss.subject for miss in found] == missing
    assert all((miss.amount, miss.unit) == (1.0, "holds") for miss in found)


# --- whose turn it is
# -------------------------------------------------------------------------------------------------


def ordered(
    monkeypatch: pytest.MonkeyPatch,
    moved: Sequence[Mapping[str, float]],
    hands: Sequence[str],
    holds: Sequence[str],
    steps: Sequence[Step] | None = None,
) -> list[tuple[Any, ...]]:
    """Return what is said of the order; `holds` says of each step with "x" at the start of which phases it holds."""
    samples = samples_of(phases=[[]] * len(moved))
    monkeypatch.setattr(
        goals,
        "_measure_joint_motion",
        lambda _, k: {name: (by, "m") for name, by in moved[k].items() if name != "ball"},
    )
    monkeypatch.setattr(
        goals,
        "_measure_transport",
        lambda _, k, named: {n: (by, "m") for n, by in moved[k].items() if n == "ball"},
    )
    table = [[mark == "x" for mark in row] for row in holds]
    found = goals._check_order(
        samples, steps or [GO] * len(holds), [set(names.split()) for names in hands], table
    )
    return [
        (one.constraint, one.subject, one.waypoint, one.time, one.amount, one.unit) for one in found
    ]


def test_each_step_in_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    hands = ["", "stick", "stick", ""]
    moved = [{}, {"stick": 0.1}, {"stick": 0.2}]
    assert ordered(monkeypatch, moved, hands, [".x..", "..x.", "...x"]) == []
    assert ordered(monkeypatch, moved, hands, ["xxxx", "xxxx", "xxxx"]) == []  # as soon as they may
    assert ordered(monkeypatch, [{}] * 3, ["", "", "", ""], [".x..", "...x", "...x"]) == []


def test_what_moves_before_its_turn_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where, by how much, and whose turn it was."""
    hands = ["", "", "stick", "stick"]
    early = [{}, {"stick": 0.25}, {}]
    assert ordered(monkeypatch, early, hands, ["..x.", "...x", "...x"]) == [
        ("order", "stick", 10, 5.0, 0.25, "m")
    ]
    assert ordered(monkeypatch, early, hands, [".x..", "...x", "...x"]) == []
    own = [{"stick": 0.1, "ball": 0.5}, {}, {}]
    assert ordered(monkeypatch, own, ["stick", "stick", "", ""], ["...x", "...x", "...x"]) == [
        ("order", "ball", 0, 0.0, 0.5, "m")
    ]


def test_where_it_could_be_the_turn_of_several_it_is_the_last_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Both may be it; the first moves the door, the second the cup: not both at once."""
    steps: list[Step] = [Actuate("door", {"hinge": 1.0}), Place("cup", PUT)]
    found = ordered(monkeypatch, [{"door": 0.25, "cup": 0.5}], ["", "", ""], ["xx", ".x"], steps)
    assert found == [("order", "door", 0, 0.0, 0.25, "m")]


@pytest.mark.parametrize(
    ("steps", "right"),
    [
        ([GO, Actuate("door", {"hinge": 1.0})], True),
        ([GO, Place("door", PUT)], True),
        ([GO, Grasp("door")], False),
        (
            [Actuate("door", {"hinge": 1.0}), GO],
            True,
        ),  # it was still the first one's turn, whose goal holds again
    ],
)
def test_a_step_moves_what_it_is_about(
    steps: list[Step], right: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the second phase, which is the second step's unless it is the first one's still."""
    found = ordered(monkeypatch, [{}, {"door": 0.3}], ["", "", ""], [".xx", "..x"], steps)
    assert found == ([] if right else [("order", "door", 10, 5.0, 0.3, "m")])


def test_a_step_that_is_undone_before_the_next_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds after the first phase, is undone while it is still its turn, and never holds again."""
    hands = ["stick", "stick", "", ""]
    moved = [{}, {"stick": 0.1}, {"stick": 0.1}]
    assert ordered(monkeypatch, moved, hands, ["....", ".x..", "...x"]) == [
        ("order", "step 1", 30, 15.0, 1.0, "steps")
    ]
    assert ordered(monkeypatch, moved, hands, [".x..", "....", "...x"]) == [
        ("order", "step 2", 30, 15.0, 1.0, "steps")
    ]
    assert ordered(monkeypatch, moved, hands, [".x..", "...x", "...x"]) == []


def test_what_goes_forth_and_back_can_still_be_whose_turn_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Both may be it as long as nothing moves that only one of them may move."""
    hands = ["", "stick", ""]
    assert ordered(monkeypatch, [{}, {"stick": 0.1}, {}], hands, ["x...", "...x"]) == []
    only_first = [Actuate("door", {"hinge": 1.0}), GO]
    found = ordered(
        monkeypatch, [{"door": 0.1}, {"door": 0.1}], ["", "", ""], ["xx.", "..x"], only_first
    )
    assert found == [("order", "step 1", 20, 10.0, 1.0, "steps")]


# --- what moves
# -------------------------------------------------------------------------------------------------------


def moving(**columns: list[float]) -> Any:
    """Return a motion of two phases of two steps each, of coordinates of objects, all of them driven by the hand."""
    names = tuple(name.replace("__", ".") for name in columns)
    phases = [
        SimpleNamespace(first=0, last=2, holds=(), held={}),
        SimpleNamespace(first=2, last=4, holds=(DOOR,), held={}),
    ]
    positions = np.array(list(columns.values())).T
    trajectory = SimpleNamespace(names=names, positions=positions, phases=phases)
    driven = {name for name in names if name != "base_x"}
    units = {name: "m" if name.endswith("slide") else "rad" for name in names}
    return SimpleNamespace(
        trajectory=trajectory,
        find_driven_coordinates=lambda holds: driven if holds else set(),
        get_unit=units.__getitem__,
    )


def test_what_the_hand_moves_in_a_phase_and_by_how_much() -> None:
    samples = moving(
        base_x=[0.0, 1.0, 2.0, 3.0, 4.0],
        door__hinge=[9.0, 0.0, 0.1, 0.5, 0.2],
        door__knob=[0.0, 0.0, 0.0, 0.0, 0.3],
        drawer__slide=[0.0, 0.0, 1.0, 1.0, 1.25],
        cup__lid=[0.0, 0.0, 1.0, 1.0, 1.0 + 0.9e-5],
    )
    assert goals._measure_joint_motion(samples, 0) == {}
    assert goals._measure_joint_motion(samples, 1) == {
        "door": (pytest.approx(0.4), "rad"),
        "drawer": (0.25, "m"),
    }
    assert goals.MOTION_TOLERANCE == 1e-5  # [m] or [rad]: less is no motion, as the pages say
    just = moving(cup__lid=[0.0, 0.0, 1.0, 1.0, 1.0 + 1.2e-5])
    assert goals._measure_joint_motion(just, 1).keys() == {"cup"}


def test_how_far_what_is_carried_goes() -> None:
    """Along its way, not from end to end; what no step names says nothing."""
    z = np.zeros((5, 8))
    z[:, 1:4] = [
        [0.0, 0.0, 0.0],
        [3.0, 4.0, 0.0],
        [3.0, 4.0, 2.0],
        [3.0, 4.0, 0.0],
        [9.0, 9.0, 9.0],
    ]
    z[:, 4] = [0.0, 5.0, 6.0, 7.0, 8.0]
    world = SimpleNamespace(get_placement_columns=lambda owner: [1, 2, 3, 4, 5, 6, 7])
    phases = [SimpleNamespace(held={"stick": "grip", "door": "handle"})]
    samples: Any = SimpleNamespace(
        z=z,
        world=world,
        get_rows=lambda phase: np.arange(4),
        trajectory=SimpleNamespace(phases=phases),
    )
    assert goals._measure_transport(samples, 0, {"stick", "cup"}) == {"stick": (9.0, "m")}
    assert goals._measure_transport(samples, 0, {"cup"}) == {}


# --- angles
# -----------------------------------------------------------------------------------------------------------


@given(st.floats(0.0, np.pi - 1e-3), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_which_turns_count(tilt: float, heading: float, other: float) -> None:
    """All of them, those of the vertical alone, or none."""
    target = pin.SE3(pin.utils.rotate("z", heading), np.zeros(3))
    placed = pin.SE3(
        pin.utils.rotate("z", other) @ pin.utils.rotate("x", tilt) @ target.rotation, np.ones(3)
    )
    assert goals._compute_angle_error(placed, target, "all") == 0.0
    assert goals._compute_angle_error(placed, target, "heading") == pytest.approx(tilt, abs=1e-7)
    whole = pin.SE3(pin.utils.rotate("x", tilt) @ target.rotation, np.ones(3))
    assert goals._compute_angle_error(whole, target, "") == pytest.approx(tilt, abs=1e-6)


def test_of_several_attachments_the_one_that_is_nearest_in_its_worse_part() -> None:
    """Of those that are used, at the start or in a phase; of the first if none is."""
    errors = {"near": [0.02, 0.3], "far": [0.2, 0.1], "unused": [0.0, 0.0]}
    asked: list[tuple[Any, ...]] = []

    def grasp_errors(owner: str, name: str, rows: np.ndarray, by: str | None) -> np.ndarray:
        asked.append((owner, name, rows.tolist(), by))
        return np.array([errors[name], [9.0, 9.0]])

    thing = SimpleNamespace(
        object=SimpleNamespace(attachment=lambda: SimpleNamespace(name="unused"))
    )
    scene = SimpleNamespace(held={"stick": "near"}, objects={"stick": thing})
    phases = [SimpleNamespace(held={"cup": "rim"}), SimpleNamespace(held={"stick": "far"})]
    samples: Any = SimpleNamespace(
        scene=scene, trajectory=SimpleNamespace(phases=phases), compute_grasp_errors=grasp_errors
    )
    assert goals._find_closest_grasp(samples, Grasp("stick"), 7) == ("far", (0.2, 0.1))
    assert asked == [("stick", "near", [7], None), ("stick", "far", [7], None)]
    assert goals._find_closest_grasp(samples, Grasp("stick", "near", "cup.rim"), 7) == (
        "near",
        (0.02, 0.3),
    )
    assert asked[-1] == ("stick", "near", [7], "cup.rim")
    scene.held, phases[1].held = {}, {}
    assert goals._find_closest_grasp(samples, Grasp("stick"), 7) == ("unused", (0.0, 0.0))


# --- all of it
# --------------------------------------------------------------------------------------------------------


def checked(
    monkeypatch: pytest.MonkeyPatch,
    table: Sequence[Sequence[Sequence[float]]],
    dropped: Mapping[tuple[int, int], float] | None = None,
) -> tuple[list[tuple[Any, ...]], list[list[bool]]]:
    """Return what is said of steps, and which hold at the start of which phase; by how much each of them misses then."""
    samples = samples_of(phases=[[]] * (len(table[0]) - 1))
    steps: list[Any] = list(range(len(table)))
    held: list[list[list[bool]]] = []

    def misses(_: Any, step: int, k: int, options: Any) -> list[goals.GoalError]:
        return [
            goals.GoalError(f"x{i}", amount, "m", "") for i, amount in enumerate(table[step][k])
        ]

    def fallen(_: Any, __: Any, hands: Any, number: int, k: int) -> list[goals.GoalError]:
        assert hands == "hands"
        return [
            goals.GoalError("stick", amount, "holds", "")
            for at, amount in (dropped or {}).items()
            if at == (number, k)
        ]

    monkeypatch.setattr(goals, "_find_grasped_objects", lambda *_: "hands")
    monkeypatch.setattr(goals, "_compute_goal_errors", misses)
    monkeypatch.setattr(goals, "_find_missing_grasps", fallen)
    monkeypatch.setattr(goals, "_check_order", lambda _, __, hands, holds: held.append(holds) or [])
    found = goals.check_goals(samples, steps, None)  # type: ignore[arg-type]
    return [
        (one.constraint, one.subject, one.waypoint, one.time, one.amount) for one in found
    ], held[0] if held else []


def test_each_step_is_done_at_the_end_of_a_phase_after_those_before_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    yes, no = [], [0.5]
    assert checked(monkeypatch, [[no, yes, no], [no, no, yes]]) == (
        [],
        [[False, True, False], [False, False, True]],
    )
    assert checked(monkeypatch, [[yes, no, no], [no, no, yes]])[0] == []  # before anything begins
    assert checked(monkeypatch, [[no, no, yes], [yes, yes, yes]])[0] == []  # both with the last
    assert checked(monkeypatch, [[no, no, yes], [no, yes, no], [yes, yes, yes]])[0] == [
        ("goal", "x0", 20, 10.0, 0.5)
    ]
    assert (
        checked(monkeypatch, [[no, yes, yes], [yes, no, no], [yes, yes, yes]])[0] != []
    )  # too early
    assert checked(monkeypatch, [[no, yes, no], [no, yes, no], [no, no, yes]])[0] == []


def test_the_last_step_must_hold_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    assert checked(monkeypatch, [[[], [], [0.5]]])[0] == [("goal", "x0", 20, 10.0, 0.5)]
    assert checked(monkeypatch, [[[9.0], [9.0], []]])[0] == []


def test_where_it_came_nearest_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the worse of what is missing, and all of that; not before anything has begun."""
    missing = [[0.1], [0.9, 0.2], [0.5, 0.6], [0.7]]
    ended = [[1.0], [1.0], [1.0], []]
    assert checked(monkeypatch, [missing, ended])[0] == [
        ("goal", "x0", 20, 10.0, 0.5),
        ("goal", "x1", 20, 10.0, 0.6),
    ]


def test_what_is_not_in_the_hand_is_missing_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all steps that are not done, one after the other."""
    table: list[list[list[float]]] = [[[], [], []], [[], [], []]]
    assert checked(monkeypatch, table, {(1, 2): 1.0})[0] == [("goal", "stick", 20, 10.0, 1.0)]
    both = {(0, k): 1.0 for k in range(3)} | {(1, 2): 1.0}
    assert checked(monkeypatch, table, both)[0] == [
        ("goal", "stick", 10, 5.0, 1.0),
        ("goal", "stick", 20, 10.0, 1.0),
    ]
