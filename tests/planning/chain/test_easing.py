"""Tests margins that are temporarily reduced for lifting, placing and touching."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    STICK,
    TOP,
    compute_grasp_pose,
    describe_box,
    describe_table,
    lift,
    make_room,
    move_base,
    solve_above,
    solve_reach,
)
from helpers.small_problems import SHORT, get_margins, make_program
from helpers.supports import describe_cup, make_plate_scene, make_scene

from vkc_pin.planning.chain.collision_pairs import REDUCED_MARGIN_RATIO
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.scene.contact_rules import CONTACT_WINDOW
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Step, Touch

GAP = 4e-3  # [m] between the stick and its support
NEAR = SHORT.steps(CONTACT_WINDOW)
LONG = dataclasses.replace(SHORT, reach_waypoints=2 * NEAR + 3)
N = LONG.reach_waypoints
ASIDE = lift(STICK, [0.0, 0.5, 0.0])


def make_problem(scene: Scene, *steps: Step) -> TrajectoryProblem:
    return make_program(scene, steps, options=LONG)


def compute_margins(p: TrajectoryProblem, phase: int) -> dict[tuple[str, str], np.ndarray]:
    """Return links → smallest reduced margin at each waypoint of a phase, without the hand."""
    part, first = p.contacts.phases[phase], int(p.contacts.first_waypoint[phase])
    waypoints = range(first, first + p.task.phases[phase].segments + 1)
    found: dict[tuple[str, str], np.ndarray] = {}
    for k, pair in enumerate(part.pairs.tolist()):
        row = get_margins(part, np.full(len(waypoints), k), np.array(waypoints))
        assert k in part.reduced_margins or (row == part.margins[k]).all()
        if k in part.reduced_margins and part.labels[pair[0]] not in p.scene.robot.touch_links:
            key = (part.labels[pair[0]], part.labels[pair[1]])
            found[key] = np.minimum(found.get(key, np.inf), row)
    return found


def assert_reduced(
    row: np.ndarray,
    margin: float,
    *,
    begin: bool = False,
    end: bool = False,
    tolerance: float = 1e-6,
) -> None:
    """Assert that a margin applies near begin or end, and dist_safe elsewhere."""
    expected = np.full(N + 1, LONG.dist_safe)
    if begin:
        expected[: NEAR + 1] = margin
    if end:
        expected[-NEAR - 1 :] = margin
    np.testing.assert_allclose(row, expected, rtol=0.0, atol=tolerance)


def test_margins_are_not_reduced_without_need() -> None:
    p = make_problem(make_room(describe_table(gap=GAP)), GoTo(0.0, 1.0))
    assert compute_margins(p, 0) == {}
    far = make_problem(make_room(describe_table(gap=0.03)), Place("stick", ASIDE))
    assert [compute_margins(far, phase) for phase in (0, 1)] == [{}, {}]


def test_margins_are_reduced_where_objects_are_lifted_and_placed() -> None:
    """An object that is placed elsewhere and lifted again has reduced margins there, too."""
    steps = [Place("stick", ASIDE), Grasp("stick"), GoTo(0.0, 1.0)]
    p = make_problem(make_room(describe_table(gap=GAP)), *steps)
    names = ["reach stick.grip", "place stick", "reach stick.grip", "go to"]
    assert [phase.name for phase in p.task.phases] == names
    assert [compute_margins(p, phase) for phase in (0, 2)] == [{}, {}]
    for phase, windows in ((1, {"begin": True, "end": True}), (3, {"begin": True})):
        found = compute_margins(p, phase)
        assert set(found) == {("stick.stick", "table")}
        assert_reduced(found["stick.stick", "table"], REDUCED_MARGIN_RATIO * GAP, **windows)


def test_margin_is_half_the_distance_of_each_shape() -> None:
    wall = describe_box("wall", [0.3, 0.02, 0.3], [0.8, 0.25 + 0.01 + 0.01, TOP + 0.1])
    p = make_problem(make_room(describe_table(gap=GAP), wall), Place("stick", ASIDE))
    part, first = p.contacts.phases[1], int(p.contacts.first_waypoint[1])
    reduced = {
        (part.shapes[i].name, part.labels[j]): [*part.reduced_margins[k]]
        for k, (i, j) in enumerate(part.pairs.tolist())
        if k in part.reduced_margins
    }
    assert set(reduced) >= {
        ("stick.stick_1", "table"),
        ("stick.stick_2", "table"),
        ("stick.tip_1", "wall"),
    }
    assert not {name for name, label in reduced if label == "table"} - {
        "stick.stick_1",
        "stick.stick_2",
    }
    ((begin, end, margin),) = reduced["stick.tip_1", "wall"]  # the wall is far from the other end
    assert (begin, end) == (first, first + NEAR)
    assert margin == pytest.approx(REDUCED_MARGIN_RATIO * 0.01, abs=1e-6)


def test_duration_of_reduced_margins_does_not_depend_on_the_time_step() -> None:
    fine = dataclasses.replace(LONG, dt=LONG.dt / 2, reach_waypoints=2 * N)
    for options in (LONG, fine):
        p = make_program(
            make_room(describe_table(gap=GAP)), [Place("stick", ASIDE)], options=options
        )
        first, reduced = p.contacts.first_waypoint[1], p.contacts.phases[1].reduced_margins
        spans = {(begin - first, end - first) for row in reduced.values() for begin, end, _ in row}
        assert {(begin * options.dt, end * options.dt) for begin, end in spans} == {
            (0.0, CONTACT_WINDOW),
            (N * LONG.dt - CONTACT_WINDOW, N * LONG.dt),
        }


@pytest.mark.parametrize("gap", [0.0, -1e-3])
def test_initial_penetration_may_be_left_but_not_entered(gap: float) -> None:
    p = make_problem(
        make_room(describe_table(gap=gap)), Place("stick", ASIDE), Grasp("stick"), GoTo(0.0, 0.0)
    )
    found = compute_margins(p, 1)["stick.stick", "table"]
    np.testing.assert_allclose(found[: NEAR + 1], gap, rtol=0.0, atol=1e-6)
    assert_reduced(np.append(np.zeros(NEAR + 1), found[NEAR + 1 :]), 0.0, begin=True, end=True)
    assert_reduced(compute_margins(p, 3)["stick.stick", "table"], 0.0, begin=True)


def test_margins_are_reduced_to_the_object_below_only() -> None:
    other = describe_box("other", [0.5, 0.6, 0.02], [0.8, 1.0, TOP - GAP - 0.01])
    small = describe_box("table", [0.5, 0.7, 0.02], [0.8, 0.0, TOP - GAP - 0.01])
    p = make_problem(make_room(small, other), Place("stick", lift(STICK, [0.0, 1.0, 0.0])))
    found = compute_margins(p, 1)
    assert set(found) == {("stick.stick", "table"), ("stick.stick", "other")}
    assert_reduced(found["stick.stick", "table"], REDUCED_MARGIN_RATIO * GAP, begin=True)
    assert_reduced(found["stick.stick", "other"], REDUCED_MARGIN_RATIO * GAP, end=True)


@pytest.mark.parametrize(
    ("gap", "margin"), [(GAP, REDUCED_MARGIN_RATIO * GAP), (0.0, 0.0), (-1e-3, -1e-3)]
)
def test_object_grasped_at_the_start_may_leave_its_support(gap: float, margin: float) -> None:
    scene, row = (
        make_room(describe_table(gap=gap)),
        solve_reach(compute_grasp_pose(STICK), solve_above(STICK)),
    )
    held = scene.with_start(base=row[:3], arm=row[3:]).with_held({"stick": "grip"})
    found = compute_margins(make_problem(held, GoTo(0.0, 1.0), GoTo(0.0, 0.0)), 0)
    assert set(found) == {("stick.stick", "table")}
    assert_reduced(found["stick.stick", "table"], margin, begin=True)
    assert compute_margins(make_problem(held, GoTo(0.0, 1.0), GoTo(0.0, 0.0)), 1) == {}
    raised = held.with_start(base=move_base(row, x=-0.1)[:3], arm=solve_above(STICK)[3:])
    assert compute_margins(make_problem(raised, GoTo(0.0, 1.0)), 0) == {}


def test_margins_of_supported_objects_are_reduced_where_transport_begins() -> None:
    options = dataclasses.replace(LONG, move_waypoints=N)
    p = make_program(
        make_plate_scene(cups=1, wall=0.01), [Actuate("plate", {"slide": 0.3})], options=options
    )
    (number,) = (k for k, phase in enumerate(p.task.phases) if phase.supported)
    row = compute_margins(p, number)["cup.cup", "wall"]
    assert row[0] == pytest.approx(REDUCED_MARGIN_RATIO * 0.01, abs=1e-4)
    assert row[-1] == LONG.dist_safe


def test_margins_of_objects_on_a_tray_are_reduced_where_it_is_lifted() -> None:
    """A cup on a tray is 1 cm in front of a wall. The tray is placed away from the wall."""
    objects = [
        {"name": "tray", "type": "tray.yaml", "position": [0.8, 0.0, 0.7]},
        describe_cup(at=(0.82, 0.05, 0.72)),
    ]
    p = make_problem(
        make_scene(objects, [describe_box("wall", [0.02, 0.02, 0.05], [0.875, 0.05, 0.78])]),
        Place("tray", (-0.5, -1.5, 0.7)),
    )
    (number,) = (k for k, phase in enumerate(p.task.phases) if phase.supported)
    assert_reduced(
        compute_margins(p, number)["cup.cup", "wall"],
        REDUCED_MARGIN_RATIO * 0.01,
        begin=True,
        tolerance=1e-4,
    )


def test_short_phases_begin_and_end_with_reduced_margins() -> None:
    options = dataclasses.replace(SHORT, reach_waypoints=NEAR)
    p = make_program(
        make_room(describe_table(gap=GAP)),
        [Place("stick", lift(STICK, [0.0, 0.5, -GAP]))],
        options=options,
    )
    np.testing.assert_allclose(
        compute_margins(p, 1)["stick.stick", "table"], np.zeros(NEAR + 1), atol=1e-6
    )


def test_margins_to_the_floor_are_reduced() -> None:
    low = pin.SE3(np.eye(3), np.array([0.8, 0.0, 0.051]))
    p = make_problem(make_room(), Place("stick", low))
    found = compute_margins(p, 1)
    assert set(found) == {("stick.stick", FLOOR)}
    assert_reduced(found["stick.stick", FLOOR], REDUCED_MARGIN_RATIO * 1e-3, end=True)


@pytest.mark.parametrize(
    ("gap", "margin"), [(0.0, 0.0), (0.006, 0.003), (-0.01, 0.0), (0.03, None)]
)
def test_margins_are_reduced_before_and_after_a_touch(gap: float, margin: float | None) -> None:
    point = np.array([0.8, 0.7, 0.75])
    wall = describe_box("wall", [0.3, 0.1, 0.3], point + np.array([0.0, gap + 0.05, 0.0]))
    scene = make_room(wall).with_held({"stick": "grip"})
    p = make_problem(scene, Touch("stick.tip", point), GoTo(0.0, 0.0), GoTo(0.0, 1.0))
    for phase, windows in ((0, {"end": True}), (1, {"begin": True}), (2, {})):
        found = compute_margins(p, phase)
        assert set(found) == ({("stick.tip", "wall")} if windows and margin is not None else set())
        for row in found.values():  # a point has a size of 0.1 mm here
            assert_reduced(row, margin or 0.0, **windows, tolerance=6e-5)


def test_margins_are_reduced_for_touches_but_not_for_poses() -> None:
    scene = make_room(describe_table(gap=GAP)).with_held({"stick": "grip"})
    touch = Touch("forearm_link", (0.8, 0.0, TOP))
    found = compute_margins(make_problem(scene, touch), 0)
    assert {first for first, _ in found} == {"forearm_link"}
    assert (
        compute_margins(
            make_problem(scene, Reach(pin.SE3(np.eye(3), np.array([0.8, 0.0, TOP])))), 0
        )
        == {}
    )
