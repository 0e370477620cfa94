"""When the hand rests, how long what was in contact may be close, and what lasts: with motions that are numbers alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.options import Options
from vkc_pin.validation import contact_windows as touching
from vkc_pin.validation.contact_windows import Window, _WindowFinder, check_gripper, check_pushes
from vkc_pin.validation.goals import MOTION_TOLERANCE
from vkc_pin.validation.report import Violation
from vkc_pin.world.scene.clearance_exemptions import ClearanceExemption
from vkc_pin.world.scene.contact_rules import CONTACT_DEPTH
from vkc_pin.world.scene.hold import Hold

STICK, DOOR = Hold("stick", "grip"), Hold("door", "handle")
BALL = Hold("ball", "pull", STICK, "tip")


def span(first: int, last: int, *holds: Hold, opening: float | None = None) -> Any:
    return SimpleNamespace(first=first, last=last, holds=holds, opening=opening)


def rests(
    way: list[float],
    phases: list[Any],
    *,
    held: tuple[Hold, ...] = (),
    times: list[float] | None = None,
    bulge: tuple[int, float] | None = None,
    gripper: Any = None,
    openings: dict[str, float | None] | None = None,
    monkeypatch: pytest.MonkeyPatch | None = None,
) -> list[Violation]:
    """Return what is said of a robot of two coordinates, one of which goes this way, and of a door that always moves.

    `bulge` lets it leave and come back between a waypoint and the next.
    """
    positions = np.column_stack([way, np.zeros(len(way)), np.arange(len(way))])
    low, high = np.minimum(positions[:-1], positions[1:]), np.maximum(positions[:-1], positions[1:])
    if bulge is not None:
        (high if bulge[1] > 0 else low)[bulge[0], 1] += bulge[1]
    trajectory = SimpleNamespace(
        times=np.arange(float(len(way))) if times is None else np.array(times),
        positions=positions,
        robot_size=2,
        phases=phases,
        ranges=lambda: (low, high),
    )
    scene = SimpleNamespace(holds=held, robot=SimpleNamespace(gripper=gripper))
    if monkeypatch is not None:
        monkeypatch.setattr(
            touching, "compute_grasp_opening", lambda _, hold: (openings or {})[str(hold)]
        )
    samples: Any = SimpleNamespace(scene=scene, trajectory=trajectory)
    return list(check_gripper(samples, Options(grasp_time=2.0)))


@pytest.mark.parametrize(
    ("way", "rest"),
    [
        ([0, 1, 2, 2, 2, 3, 4], 2.0),  # from waypoint 2 to 4: grasped at 3
        ([0, 1, 2, 2, 3, 4, 5], 1.0),
        ([0, 1, 2, 3, 4, 5, 6], 0.0),
        ([0, 1, 2, 3, 3, 3, 4], 2.0),
        ([3, 3, 3, 3, 4, 5, 6], 3.0),  # from the very begin
        ([0, 1, 2, 3, 3, 3, 3], 3.0),  # up to the very end
        ([3, 3, 3, 3, 3, 3, 3], 6.0),
        ([2, 2, 3, 3, 4, 4, 4], 1.0),  # other rests do not count
    ],
)
def test_how_long_the_robot_stands_where_it_takes_something(way: list[float], rest: float) -> None:
    """However the door moves meanwhile."""
    found = rests(way, [span(0, 3), span(3, 6, DOOR)])
    if rest >= 2.0:
        assert found == []
        return
    (one,) = found
    assert (one.constraint, one.subject, one.waypoint, one.time, one.unit) == (
        "dwell",
        "door.handle",
        3,
        3.0,
        "s",
    )
    assert one.amount == pytest.approx(2.0 - rest)
    assert one.detail == f"the robot rests for {rest:.2f} s, 2 s are required"


@pytest.mark.parametrize(("late", "told"), [(0.9e-6, False), (1.5e-6, True)])
def test_a_millionth_of_a_second_less_is_all_right(late: float, told: bool) -> None:
    times = [0.0, 1.0, 2.0, 3.0, 4.0 - late, 5.0, 6.0]
    assert bool(rests([0, 1, 2, 2, 2, 3, 4], [span(0, 3), span(3, 6, DOOR)], times=times)) == told


@pytest.mark.parametrize(("by", "told"), [(0.9, False), (1.5, True), (-0.9, False), (-1.5, True)])
@pytest.mark.parametrize("piece", [2, 3])
def test_what_leaves_and_comes_back_does_not_rest(piece: int, by: float, told: bool) -> None:
    """By more than what counts as motion, of any coordinate."""
    found = rests(
        [0, 1, 2, 2, 2, 3, 4], [span(0, 3), span(3, 6, DOOR)], bulge=(piece, by * MOTION_TOLERANCE)
    )
    assert bool(found) == told


def test_each_time_something_is_taken_or_let_go_of() -> None:
    phases = [
        span(0, 1),
        span(1, 2, STICK),
        span(2, 3, STICK, BALL),
        span(3, 4, STICK),
        span(4, 5),
        span(5, 6),
    ]
    found = rests([0, 1, 2, 3, 4, 5, 6], phases)
    assert [(one.subject, one.waypoint) for one in found] == [
        ("stick.grip", 1),
        ("ball.pull by stick.tip", 2),
        ("ball.pull by stick.tip", 3),
        ("stick.grip", 4),
    ]
    found = rests([0, 1, 2, 3, 4, 5, 6], [span(0, 6)], held=(STICK, DOOR))
    assert [(one.subject, one.waypoint) for one in found] == [("door.handle, stick.grip", 0)]
    assert rests([0, 1, 2, 3, 4, 5, 6], [span(0, 3, STICK), span(3, 6, STICK)], held=(STICK,)) == []


@pytest.mark.parametrize(
    ("way", "rest"),
    [
        ([0, 1, 2, 3, 3, 3, 4], 2.0),
        ([0, 1, 3, 3, 3, 4, 5], 1.0),
        ([0, 3, 3, 3, 4, 5, 6], 0.0),
        ([0, 1, 2, 3, 3, 3, 3], 3.0),
    ],
)
def test_fingers_move_from_where_a_phase_begins(way: list[float], rest: float) -> None:
    """What it stood still before does not count."""
    found = rests(way, [span(0, 3, opening=0.05), span(3, 6, opening=0.02)])
    assert [(one.constraint, one.subject, one.amount) for one in found] == (
        [] if rest >= 2.0 else [("dwell", "gripper", pytest.approx(2.0 - rest))]
    )
    assert rests(way, [span(0, 3, opening=0.05), span(3, 6, opening=0.05)]) == []


def test_the_first_opening_is_there_from_the_start() -> None:
    assert rests([0, 1, 2, 3, 4, 5, 6], [span(0, 3, opening=0.05), span(3, 6, opening=0.05)]) == []


GRIPPER = SimpleNamespace(rest_opening=0.08)


def told(
    openings: list[float | None], *holds: tuple[Hold, ...], monkeypatch: pytest.MonkeyPatch
) -> list[tuple[Any, ...]]:
    phases = [
        span(k, k + 1, *hold, opening=opening)
        for k, (hold, opening) in enumerate(zip(holds, openings, strict=True))
    ]
    asked = {"stick.grip": 0.03, "door.handle": None}
    way = [0.0] * (len(phases) + 1)
    times = 10.0 * np.arange(len(way))
    found = rests(
        way,
        phases,
        held=holds[0],
        times=times.tolist(),
        gripper=GRIPPER,
        openings=asked,
        monkeypatch=monkeypatch,
    )
    assert {one.constraint for one in found} <= {"opening"}
    return [
        (one.subject, one.waypoint, one.time, pytest.approx(one.amount), one.unit) for one in found
    ]


def test_the_gripper_is_as_far_open_as_the_next_thing_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the phase before, and while it is held; what is held through it does not matter, and afterwards nothing is asked."""
    right = [0.05, 0.03, 0.03, 0.07]
    assert told(right, (), (), (STICK, BALL), (), monkeypatch=monkeypatch) == []
    assert told([0.03, 0.04, 0.05, 0.03], (), (), (STICK,), (), monkeypatch=monkeypatch) == [
        ("stick.grip", 1, 10.0, pytest.approx(0.01), "m"),
        ("stick.grip", 2, 20.0, pytest.approx(0.02), "m"),
    ]
    assert told([None, 0.08], (), (DOOR,), monkeypatch=monkeypatch) == []  # at rest
    assert told([0.05], (DOOR,), monkeypatch=monkeypatch) == [
        ("door.handle", 0, 0.0, pytest.approx(0.03), "m")
    ]
    assert told([0.03, 0.03], (STICK,), (DOOR,), monkeypatch=monkeypatch) == [
        ("door.handle", 1, 10.0, pytest.approx(0.05), "m")
    ]  # what it has, not what it takes next


# --- pushes
# -----------------------------------------------------------------------------------------------------------


def pushed(
    hands: list[float], links: list[float], monkeypatch: pytest.MonkeyPatch, contact: str = "push"
) -> list[tuple[Any, ...]]:
    """Return what is said of a hand at these places along z, and a link there, which is pushed along its z axis."""
    placed = {"tool": hands, "door.panel": links}

    def placements(rows: np.ndarray, frame: str) -> list[pin.SE3]:
        assert rows.tolist() == list(range(10, 10 + len(hands)))
        return [pin.SE3(np.eye(3), np.array([0.0, 0.0, z])) for z in placed[frame]]

    attachment = SimpleNamespace(
        contact=contact, link="panel", placement=pin.SE3.Identity(), offset=pin.SE3.Identity()
    )
    objects = {"door": SimpleNamespace(object=SimpleNamespace(attachments={"handle": attachment}))}
    monkeypatch.setattr(touching, "compute_hand_frame", lambda robot, given: pin.SE3.Identity())
    samples: Any = SimpleNamespace(
        scene=SimpleNamespace(robot=SimpleNamespace(tool_frame="tool"), objects=objects),
        trajectory=SimpleNamespace(phases=[span(1, 2, DOOR)]),
        get_rows=lambda phase: np.arange(10, 10 + len(hands)),
        compute_placements=placements,
        find_waypoint=lambda row: row // 10,
        times=0.5 * np.arange(30),
    )
    found = check_pushes(samples)
    return [
        (one.constraint, one.subject, one.waypoint, one.time, pytest.approx(one.amount), one.unit)
        for one in found
    ]


def test_what_is_pushed_never_comes_back_with_the_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    there = [0.0, 0.1, 0.3, 0.3, 0.6]
    assert pushed(there, there, monkeypatch) == []
    back = [0.0, 0.1, 0.3, 0.25, 0.2, 0.6]
    assert pushed(back, back, monkeypatch) == [
        ("push", "door.handle", 1, 7.0, pytest.approx(0.1 - CONTACT_DEPTH), "m")
    ]
    assert pushed(back, back, monkeypatch, "grasp") == []
    assert pushed(back, [0.0] * 6, monkeypatch) == []  # the hand goes alone
    for slack, wrong in ((0.9, False), (1.1, True)):
        little = [0.0, 0.1, 0.1 - slack * CONTACT_DEPTH]
        assert bool(pushed(little, little, monkeypatch)) == wrong


def test_what_it_had_gone_back_counts_from_the_furthest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice by half of what is all right, and forward in between: together it is as far as before."""
    half = 0.6 * CONTACT_DEPTH
    ways = [0.0, 0.1, 0.1 - half, 0.1, 0.1 - half]
    assert pushed(ways, ways, monkeypatch) == []
    ways = [0.0, 0.1, 0.1 - half, 0.1 - 2 * half]
    assert pushed(ways, ways, monkeypatch) == [
        ("push", "door.handle", 1, 6.5, pytest.approx(2 * half - CONTACT_DEPTH), "m")
    ]


# --- how long
# ---------------------------------------------------------------------------------------------------------


def find_contact_windows(times: list[float], moving: list[bool], dt: float = 0.25) -> Any:
    """Return windows of a motion that moves in some of its steps."""
    made = object.__new__(_WindowFinder)
    made.options, made.steps = Options(dt=dt), np.array(moving)
    made.trajectory = SimpleNamespace(times=np.array(times), phases=[])  # type: ignore[assignment]
    return made


def test_what_was_in_contact_may_be_close_for_a_second_or_as_many_steps() -> None:
    even = [0.25 * k for k in range(21)]
    made = find_contact_windows(even, [True] * 20)
    assert [made._find_easing_end(at) for at in (0, 1, 10, 15, 16, 17, 20)] == [
        4,
        5,
        14,
        19,
        20,
        20,
        20,
    ]
    assert [made._find_easing_start(at) for at in (20, 19, 10, 5, 4, 3, 0)] == [
        16,
        15,
        6,
        1,
        0,
        0,
        0,
    ]
    slow = find_contact_windows(
        [1.0 * k for k in range(21)], [True] * 20
    )  # steps that take longer: four of them
    assert (slow._find_easing_end(5), slow._find_easing_start(15)) == (9, 11)
    quick = find_contact_windows(
        [0.125 * k for k in range(21)], [True] * 20
    )  # or shorter: a second
    assert (quick._find_easing_end(5), quick._find_easing_start(15)) == (13, 7)


def test_steps_in_which_nothing_moves_do_not_count() -> None:
    moving = [True, True, False, False, True, True, True, False, True, True]
    made = find_contact_windows([1.0 * k for k in range(11)], moving)
    assert (
        made._find_easing_end(0) == 6
    )  # of the steps up to 6, four move; the seventh would be one too many
    assert made._find_easing_end(1) == 8
    assert made._find_easing_start(10) == 5
    assert made._find_easing_start(9) == 2


def test_what_lasts_from_where_to_where() -> None:
    made = find_contact_windows([0.0], [])
    made.trajectory.phases = [SimpleNamespace(first=3 * k) for k in range(4)]
    runs = made._find_spans([{"a", "b"}, {"a"}, {"a", "c"}, {"c"}, {"b", "c"}])
    assert sorted(runs, key=str) == sorted(
        [("b", None, 0), ("a", None, 6), ("c", 3, None), ("b", 9, None)], key=str
    )
    assert list(made._find_spans([{"a"}, {"a"}])) == [("a", None, None)]
    assert list(made._find_spans([set(), set()])) == []


def test_pairs_are_of_the_smaller_and_the_larger() -> None:
    made = find_contact_windows([0.0], [])
    assert made._make_pairs([3, 1], [2]).tolist() == [[2, 3], [1, 2]]
    assert made._make_pairs([], [2]).shape == made._make_pairs([1], []).shape == (0, 2)
    made.labels, made.solids = (
        np.array(["stick.tip", "base", "stick.grip", "stick.x"]),
        SimpleNamespace(body_count=3),
    )
    assert made._get_shapes("stick") == [0, 2]  # what stands beyond is an obstacle of that name
    assert made._pair_links({"stick.tip", "base"}, {"stick.grip"}).tolist() == [[0, 2], [1, 2]]


def test_a_window_is_no_window_of_what_moves_as_one_unless_that_is_said() -> None:
    assert Window(np.zeros((0, 2), int), 0, 1, 0.0)[3:] == (0.0, CONTACT_DEPTH, False, False)


class Allowed(ClearanceExemption):
    """An allowance of two links that holds at some of the waypoints."""

    def __init__(self, holds: list[bool], margin: float) -> None:
        super().__init__("drawer.tray", "side", margin, margin)
        object.__setattr__(self, "at", holds)

    def is_active(self, names: Any, rows: np.ndarray) -> np.ndarray:
        at: Any = vars(self)["at"]
        assert len(rows) == len(at)
        return np.array(at)


@pytest.mark.parametrize(
    ("holds", "spans"),
    [
        ("xxxxx", [(0, 4)]),
        (".xx..", [(1, 2)]),
        ("x..xx", [(0, 0), (3, 4)]),
        (".....", []),
        ("....x", [(4, 4)]),
    ],
)
@pytest.mark.parametrize(
    ("margin", "contact", "together"),
    [
        (0.005, CONTACT_DEPTH, False),
        (-0.003, CONTACT_DEPTH + 0.003, False),
        (-0.5 * CONTACT_DEPTH, 1.5 * CONTACT_DEPTH, False),
        (-np.inf, np.inf, True),
    ],
)
def test_what_is_allowed_where_it_is(
    holds: str, spans: list[tuple[int, int]], margin: float, contact: float, together: bool
) -> None:
    """Up to the last waypoint in a row at which it is."""
    made = find_contact_windows([0.0], [True] * 4)
    made.labels = made.keys = np.array(["drawer.tray", "side"])
    made.samples = SimpleNamespace(
        z=np.zeros((9, 2)),
        waypoint_rows=np.arange(0, 9, 2),
        world=SimpleNamespace(coordinates=SimpleNamespace(names=())),
    )
    one: Any = Allowed([mark == "x" for mark in holds], margin)
    found = list(made._find_exemption_windows(one))
    assert [(window.first, window.last) for window in found] == spans
    for window in found:
        assert window.pairs.tolist() == [[0, 1]]
        assert window[3:] == (margin, contact, together, True)
    made.labels = np.array(["drawer.tray", "other"])
    assert list(made._find_exemption_windows(one)) == []
