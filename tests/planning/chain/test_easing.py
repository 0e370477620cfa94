"""Tests temporarily reduced margins: lifting, placing and touching."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    STICK,
    TOP,
    above,
    box,
    lifted,
    moved_base,
    reaching,
    room,
    table,
    tool_at,
)
from helpers.riding import cup, plates, scene_of
from helpers.small_problems import SHORT, program_of

from vkc_pin.planning.chain.easing import REDUCED_MARGIN_RATIO
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.scene.contact_rules import CONTACT_WINDOW
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Step, Touch

GAP = 4e-3  # [m] of what the stick lies on
NEAR = SHORT.steps(CONTACT_WINDOW)
LONG = dataclasses.replace(SHORT, reach_waypoints=2 * NEAR + 3)
N = LONG.reach_waypoints
ASIDE = lifted(STICK, [0.0, 0.5, 0.0])


def problem(scene: Scene, *steps: Step) -> TrajectoryProblem:
    return program_of(scene, steps, options=LONG)


def margins(p: TrajectoryProblem, phase: int) -> dict[tuple[str, str], np.ndarray]:
    """Return links → the smallest reduced margin of their pairs at each waypoint of a phase.

    Those of the hand are `test_contacts`' business.
    """
    part, first = p.contacts.phases[phase], int(p.contacts.first_waypoint[phase])
    waypoints = range(first, first + p.task.phases[phase].segments + 1)
    found: dict[tuple[str, str], np.ndarray] = {}
    for k, pair in enumerate(part.pairs.tolist()):
        row = part.margins_at(np.full(len(waypoints), k), np.array(waypoints))
        assert k in part.reduced_margins or (row == part.margins[k]).all()
        if k in part.reduced_margins and part.labels[pair[0]] not in p.scene.robot.touch_links:
            key = (part.labels[pair[0]], part.labels[pair[1]])
            found[key] = np.minimum(found.get(key, np.inf), row)
    return found


def only_near(
    row: np.ndarray, margin: float, *, begin: bool = False, end: bool = False, within: float = 1e-6
) -> None:
    """Assert that a margin holds near the begin or the end, and dist_safe elsewhere."""
    expected = np.full(N + 1, LONG.dist_safe)
    if begin:
        expected[: NEAR + 1] = margin
    if end:
        expected[-NEAR - 1 :] = margin
    np.testing.assert_allclose(row, expected, rtol=0.0, atol=within)


def test_margins_are_not_reduced_without_need() -> None:
    p = problem(room(table(gap=GAP)), GoTo(0.0, 1.0))
    assert margins(p, 0) == {}
    far = problem(room(table(gap=0.03)), Place("stick", ASIDE))
    assert [margins(far, phase) for phase in (0, 1)] == [{}, {}]  # further than dist_safe anyway


def test_what_is_lifted_may_be_close_to_what_it_lay_on_and_what_is_lowered_to_what_it_will() -> (
    None
):
    p = problem(room(table(gap=GAP)), Place("stick", ASIDE), GoTo(0.0, 1.0))
    assert [phase.name for phase in p.task.phases] == ["reach stick.grip", "place stick", "go to"]
    assert margins(p, 0) == {}
    assert margins(p, 2) == {}
    found = margins(p, 1)
    assert set(found) == {("stick.stick", "table")}
    only_near(found["stick.stick", "table"], REDUCED_MARGIN_RATIO * GAP, begin=True, end=True)


def test_the_margin_is_half_the_distance_of_that_shape() -> None:
    """Only the discs are close, as they lie lower; a wall at the tip has its own distance."""
    wall = box("wall", [0.3, 0.02, 0.3], [0.8, 0.25 + 0.01 + 0.01, TOP + 0.1])
    p = problem(room(table(gap=GAP), wall), Place("stick", ASIDE))
    part, first = p.contacts.phases[1], int(p.contacts.first_waypoint[1])
    eased = {
        (part.shapes[i].name, part.labels[j]): [*part.reduced_margins[k]]
        for k, (i, j) in enumerate(part.pairs.tolist())
        if k in part.reduced_margins
    }
    assert set(eased) >= {
        ("stick.stick_1", "table"),
        ("stick.stick_2", "table"),
        ("stick.tip_1", "wall"),
    }
    assert not {name for name, label in eased if label == "table"} - {
        "stick.stick_1",
        "stick.stick_2",
    }
    ((begin, end, margin),) = eased["stick.tip_1", "wall"]  # at the other end the wall is far away
    assert (begin, end) == (first, first + NEAR)
    assert margin == pytest.approx(REDUCED_MARGIN_RATIO * 0.01, abs=1e-6)


def test_how_long_it_may_be_close_does_not_hang_on_the_number_of_waypoints() -> None:
    """Twice as many waypoints, half as far apart in time: the same seconds at either end."""
    steps, spans = [Place("stick", ASIDE)], []
    for options in (
        LONG,
        dataclasses.replace(LONG, dt=LONG.dt / 2, reach_waypoints=2 * LONG.reach_waypoints),
    ):
        p = program_of(room(table(gap=GAP)), steps, options=options)
        first = int(p.contacts.first_waypoint[1])
        moments = [
            moment for eased in p.contacts.phases[1].reduced_margins.values() for moment in eased
        ]
        spans.append(
            {
                ((begin - first) * options.dt, (end - first) * options.dt)
                for begin, end, _ in moments
            }
        )
    assert (
        spans[0] == spans[1] == {(0.0, CONTACT_WINDOW), (N * LONG.dt - CONTACT_WINDOW, N * LONG.dt)}
    )


@pytest.mark.parametrize("gap", [0.0, -1e-3])
def test_what_rests_on_or_in_something_may_be_as_close_as_that(gap: float) -> None:
    p = problem(room(table(gap=gap)), Place("stick", ASIDE))
    found = margins(p, 1)["stick.stick", "table"]
    np.testing.assert_allclose(
        found[: NEAR + 1], gap, rtol=0.0, atol=1e-6
    )  # it stands there, but may not be put there
    only_near(np.append(np.zeros(NEAR + 1), found[NEAR + 1 :]), 0.0, begin=True, end=True)


def test_what_is_put_down_elsewhere_is_eased_there_alone() -> None:
    other = box("other", [0.5, 0.6, 0.02], [0.8, 1.0, TOP - GAP - 0.01])
    small = box("table", [0.5, 0.7, 0.02], [0.8, 0.0, TOP - GAP - 0.01])
    p = problem(room(small, other), Place("stick", lifted(STICK, [0.0, 1.0, 0.0])))
    found = margins(p, 1)
    assert set(found) == {("stick.stick", "table"), ("stick.stick", "other")}
    only_near(found["stick.stick", "table"], REDUCED_MARGIN_RATIO * GAP, begin=True)
    only_near(found["stick.stick", "other"], REDUCED_MARGIN_RATIO * GAP, end=True)


def test_taken_again_it_is_eased_where_it_was_put() -> None:
    p = problem(room(table(gap=GAP)), Place("stick", ASIDE), Grasp("stick"), GoTo(0.0, 0.0))
    assert [phase.name for phase in p.task.phases] == [
        "reach stick.grip",
        "place stick",
        "reach stick.grip",
        "go to",
    ]
    only_near(margins(p, 3)["stick.stick", "table"], REDUCED_MARGIN_RATIO * GAP, begin=True)


@pytest.mark.parametrize(
    ("gap", "margin"), [(GAP, REDUCED_MARGIN_RATIO * GAP), (0.0, 0.0), (-1e-3, -1e-3)]
)
def test_what_is_in_the_hand_at_the_start_may_leave_what_it_lies_on(
    gap: float, margin: float
) -> None:
    """So a step that is planned on its own begins as well as in the middle of a chore."""
    scene, row = room(table(gap=gap)), reaching(tool_at(STICK), above(STICK))
    held = scene.with_start(base=row[:3], arm=row[3:]).with_held({"stick": "grip"})
    found = margins(problem(held, GoTo(0.0, 1.0), GoTo(0.0, 0.0)), 0)
    assert set(found) == {("stick.stick", "table")}
    only_near(found["stick.stick", "table"], margin, begin=True)
    assert margins(problem(held, GoTo(0.0, 1.0), GoTo(0.0, 0.0)), 1) == {}
    raised = held.with_start(base=moved_base(row, x=-0.1)[:3], arm=above(STICK)[3:])
    assert margins(problem(raised, GoTo(0.0, 1.0)), 0) == {}


def test_taken_again_it_stands_in_nothing() -> None:
    """An object may leave an initial penetration once; later placements are collision-free."""
    p = problem(room(table(gap=-1e-3)), Place("stick", ASIDE), Grasp("stick"), GoTo(0.0, 0.0))
    only_near(margins(p, 3)["stick.stick", "table"], 0.0, begin=True)


def test_what_rides_is_eased_from_what_is_beside_it_where_the_ride_begins_alone() -> None:
    options = dataclasses.replace(LONG, move_waypoints=N)
    p = program_of(plates(cups=1, wall=0.01), [Actuate("plate", {"slide": 0.3})], options=options)
    (number,) = (k for k, phase in enumerate(p.task.phases) if phase.supported)
    row = margins(p, number)["cup.cup", "wall"]
    assert row[0] == pytest.approx(REDUCED_MARGIN_RATIO * 0.01, abs=1e-4)
    assert row[-1] == LONG.dist_safe


def test_what_rides_on_something_carried_is_eased_from_what_is_beside_it_where_that_is_lifted() -> (
    None
):
    """A cup on a tray is 1 cm in front of a wall; there is none where the tray is placed."""
    things = [
        {"name": "tray", "type": "tray.yaml", "position": [0.8, 0.0, 0.7]},
        cup(at=(0.82, 0.05, 0.72)),
    ]
    p = problem(
        scene_of(things, [box("wall", [0.02, 0.02, 0.05], [0.875, 0.05, 0.78])]),
        Place("tray", (-0.5, -1.5, 0.7)),
    )
    (number,) = (k for k, phase in enumerate(p.task.phases) if phase.supported)
    only_near(
        margins(p, number)["cup.cup", "wall"], REDUCED_MARGIN_RATIO * 0.01, begin=True, within=1e-4
    )


def test_in_a_short_phase_both_ends_must_be_possible() -> None:
    """The object is lifted and placed within a few waypoints and finally rests on the table."""
    options = dataclasses.replace(SHORT, reach_waypoints=NEAR)
    p = program_of(
        room(table(gap=GAP)), [Place("stick", lifted(STICK, [0.0, 0.5, -GAP]))], options=options
    )
    np.testing.assert_allclose(margins(p, 1)["stick.stick", "table"], np.zeros(NEAR + 1), atol=1e-6)


def test_margin_from_the_floor_is_reduced() -> None:
    low = pin.SE3(np.eye(3), np.array([0.8, 0.0, 0.051]))
    p = problem(room(), Place("stick", low))
    found = margins(p, 1)
    assert set(found) == {("stick.stick", FLOOR)}
    only_near(found["stick.stick", FLOOR], REDUCED_MARGIN_RATIO * 1e-3, end=True)


def tip_at_a_wall(gap: float, *steps: Step) -> tuple[TrajectoryProblem, np.ndarray]:
    """Return the problem of touching a point `gap` before a wall and then `steps`; the point."""
    point = np.array([0.8, 0.7, 0.75])
    scene = room(box("wall", [0.3, 0.1, 0.3], point + np.array([0.0, gap + 0.05, 0.0]))).with_held(
        {"stick": "grip"}
    )
    return problem(scene, Touch("stick.tip", point), *steps), point


@pytest.mark.parametrize(("gap", "margin"), [(0.0, 0.0), (0.006, 0.003), (-0.01, 0.0)])
def test_a_tip_may_be_close_to_what_is_at_its_target_before_and_after(
    gap: float, margin: float
) -> None:
    p, _ = tip_at_a_wall(gap, GoTo(0.0, 0.0), GoTo(0.0, 1.0))
    for phase, where in ((0, {"end": True}), (1, {"begin": True})):
        found = margins(p, phase)
        assert set(found) == {("stick.tip", "wall")}
        only_near(
            found["stick.tip", "wall"], margin, **where, within=6e-5
        )  # a point has a size here, 0.1 mm
    assert margins(p, 2) == {}


def test_target_in_the_air_reduces_no_margin() -> None:
    p, _ = tip_at_a_wall(0.021, GoTo(0.0, 0.0))
    assert [margins(p, phase) for phase in (0, 1)] == [{}, {}]


def test_reaching_a_pose_is_no_touch() -> None:
    scene = room(table(gap=GAP)).with_held({"stick": "grip"})
    reach = Touch("forearm_link", (0.8, 0.0, TOP))
    found = margins(problem(scene, reach), 0)
    assert {first for first, _ in found} == {"forearm_link"}
    assert margins(problem(scene, Reach(pin.SE3(np.eye(3), np.array([0.8, 0.0, TOP])))), 0) == {}


def resting(steps: Sequence[Step]) -> tuple[TrajectoryProblem, np.ndarray]:
    """Return a problem on the table and a motion that lifts and places the stick."""
    scene = room(table(gap=GAP))
    p = problem(scene, *steps)
    up, down = np.array(scene.start), reaching(tool_at(STICK), above(STICK))
    there, over = moved_base(down, y=0.5), moved_base(up, y=0.5)
    rows = [*np.linspace(up, down, N + 1)[1:]]
    knots = np.array([down, up, over, there])
    share = np.linspace(0.0, 3.0, N + 1)[1:]
    rows += list(np.array([np.interp(share, np.arange(4.0), column) for column in knots.T]).T)
    z = np.zeros((p.segments, p.chain.size))
    z[:, :9] = rows
    return p, z


def test_a_motion_that_lifts_and_lowers_keeps_its_margins() -> None:
    """The solver sees no shortfall where the stick lies, only its usual margin elsewhere."""
    p, z = resting([Place("stick", ASIDE)])
    contacts = p.evaluate_contacts(z, reach=0.05)
    part = p.contacts.phases[1]
    labels = np.array(part.labels)
    lies = {}
    for waypoint, pair, distance, margin in zip(
        contacts.waypoint, contacts.pair, contacts.distance, contacts.margin, strict=True
    ):
        if waypoint >= N and {labels[pair[0]], labels[pair[1]]} == {"stick.stick", "table"}:
            lies[int(waypoint) + 1] = min(
                lies.get(int(waypoint) + 1, (np.inf, 0.0)), (float(distance), float(margin))
            )
    assert lies[2 * N] == (
        pytest.approx(GAP, abs=1e-6),
        pytest.approx(REDUCED_MARGIN_RATIO * GAP, abs=1e-7),
    )
    assert all(distance >= margin for distance, margin in lies.values())
