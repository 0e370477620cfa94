"""Limits of every coordinate, and how many samples a step of a given length has."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import STICK, Script, above, reaching, room, table, tool_at
from helpers.drives import hall, moved, of_rows
from helpers.small_problems import door_scene
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.validation import samples as module
from vkc_pin.validation.samples import Samples, _compute_angles
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory


def standing(scene: Scene) -> Samples:
    return Samples(scene, of_rows(scene, np.tile(scene.start, (2, 1))))


def narrow(base: str = "omni", **fields: object) -> Scene:
    """Return a hall that is no square."""
    scene = hall(base=base)
    return dataclasses.replace(scene, arena=(-5.0, 6.0, -7.0, 8.0), **fields)  # type: ignore[arg-type]


def test_the_base_stays_in_the_arena_and_within_its_own_limits() -> None:
    scene = narrow()
    robot, samples = scene.robot, standing(scene)
    assert samples.get_limits("base_x")[:2] == (-5.0, 6.0)
    assert samples.get_limits("base_y")[:2] == (-7.0, 8.0)
    for i, name in enumerate(robot.coordinates.names):
        assert samples.get_limits(name)[2:] == (robot.velocity[i], robot.acceleration[i])
        if i > 1:
            assert samples.get_limits(name)[:2] == (robot.lower[i], robot.upper[i])
    lower, upper = robot.lower.copy(), robot.upper.copy()
    lower[:3], upper[:3] = [-1.0, -9.0, -2.0], [9.0, 1.0, 3.0]
    tight = standing(
        dataclasses.replace(scene, robot=dataclasses.replace(robot, lower=lower, upper=upper))
    )
    assert [tight.get_limits(name)[:2] for name in robot.coordinates.names[:3]] == [
        (-1.0, 6.0),
        (-7.0, 1.0),
        (-2.0, 3.0),
    ]


def test_a_fixed_base_has_no_room_and_its_arm_all() -> None:
    scene = narrow("fixed").with_start(base=[1.0, -2.0, 0.5])
    samples = standing(scene)
    names = scene.robot.coordinates.names
    assert [samples.get_limits(name)[:2] for name in names[:3]] == [
        (1.0, 1.0),
        (-2.0, -2.0),
        (0.5, 0.5),
    ]
    for i, name in enumerate(names[3:], start=3):
        assert samples.get_limits(name)[:2] == (scene.robot.lower[i], scene.robot.upper[i])
        assert scene.robot.lower[i] < scene.robot.upper[i]


def test_joints_of_objects_and_what_a_hand_chooses_have_limits_of_their_own() -> None:
    scene = room(table())
    motion = (
        Script(scene)
        .go(reaching(tool_at(STICK), above(STICK)), steps=2)
        .take("stick")
        .wait()
        .motion()
    )
    samples = Samples(scene, motion)
    for freedom, name in zip(
        scene.objects["stick"].object.attachment("grip").freedoms, ("slide", "turn"), strict=True
    ):
        assert samples.get_limits(f"stick.grip_{name}") == (
            freedom.lower,
            freedom.upper,
            np.inf,
            np.inf,
        )
        assert samples.get_unit(f"stick.grip_{name}") == freedom.unit
    door = door_scene()
    item = door.objects["door"].object
    for joint in ("hinge", "knob"):
        i = item.coordinates.index(joint)
        expected = tuple(
            float(values[i])
            for values in (item.lower, item.upper, item.velocity, item.acceleration)
        )
        assert standing(door).get_limits(f"door.{joint}") == expected


def sampled(*steps: dict[str, float], **fields: object) -> list[int]:
    """Return how many samples each step has, of changes of x, y, yaw and the wrist."""
    scene = hall()
    rows = [np.array(scene.start)]
    for step in steps:
        rows.append(rows[-1].copy())
        for name, by in step.items():
            rows[-1][("x", "y", "yaw", "", "", "", "", "", "wrist").index(name)] += by
    motion = of_rows(scene, np.array(rows))
    samples = Samples(scene, motion)
    counts = np.diff(samples.waypoint_rows).tolist()
    assert samples.waypoint_rows[0] == 0
    assert len(samples.times) == sum(counts) + 1
    assert samples.required_count == sum(counts)
    np.testing.assert_allclose(
        np.diff(samples.times), np.repeat(0.25 / np.array(counts), counts), rtol=1e-9
    )
    return [int(count) for count in counts]


def test_a_step_has_as_many_samples_as_it_is_long() -> None:
    """No more, where it is a whole number of them; across the arena the base's way counts, not its parts."""
    assert sampled({"x": 0.05}, {"x": -0.051}, {}, {"y": 0.3}, {"x": 0.03, "y": 0.04}) == [
        10,
        11,
        1,
        60,
        10,
    ]
    assert sampled(
        {"yaw": 0.1}, {"wrist": -0.3}, {"x": 0.05, "wrist": 0.05}, {"x": 0.01, "wrist": 0.05}
    ) == [10, 30, 10, 5]
    assert sampled({"x": 1e-4}, {"yaw": 1e-2}, {"yaw": 1.01e-2}) == [1, 1, 2]


def test_along_a_curve_the_fastest_moment_of_each_cubic_counts() -> None:
    """Half a metre from rest to rest is 0.75 m at its largest speed; knots between waypoints are samples, too."""
    scene = hall()
    rows = np.array([scene.start, moved(scene.start, x=0.25), moved(scene.start, x=0.5)])
    rates = np.zeros_like(rows)
    ends = rows[[0, 2]]
    for knots, way, expected in (
        (np.array([0.0, 2.0]), ends, [150]),
        (np.array([0.0, 1.0, 2.0]), rows, [75 + 75]),
    ):
        curve = Curve(knots, way, rates[: len(knots)])
        motion = dataclasses.replace(of_rows(scene, ends, dt=2.0), curve=curve)
        samples = Samples(scene, motion)
        assert np.diff(samples.waypoint_rows).tolist() == expected
        assert set(knots.tolist()) <= set(samples.times.tolist())


@pytest.mark.parametrize(("most", "waypoints_alone"), [(20, False), (19, True)])
def test_what_is_longer_than_can_be_looked_at_is_seen_at_its_waypoints(
    most: int, waypoints_alone: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_SAMPLES", most)
    scene = hall()
    motion = of_rows(scene, np.array([moved(scene.start, x=x) for x in (0.0, 0.05, 0.1)]))
    samples = Samples(scene, motion)
    assert samples.required_count == 20
    assert len(samples.times) == (3 if waypoints_alone else 21)


@pytest.mark.parametrize(("size", "right"), [(0.99e12, True), (1.01e12, False)])
def test_beyond_all_measure(size: float, right: bool) -> None:
    scene = hall()
    motion = of_rows(scene, np.array([scene.start, moved(scene.start, y=-size)]))
    if right:
        assert Samples(scene, motion).required_count > 1e12
    else:
        with pytest.raises(InputError) as caught:
            Samples(scene, motion)
        assert caught.value.field == "trajectory.positions[1, 1]"


def test_robots_of_another_size_are_refused() -> None:
    """Their names may be the same, and the first of something else counted among them."""
    door = door_scene()
    robot = door.robot.coordinates.names
    rows = np.tile(np.append(door.start, 0.0), (2, 1))
    for size, right in ((9, True), (10, False)):
        motion = Trajectory(
            (*robot, "door.hinge"), np.arange(2.0), rows, (PhaseSpan("stand", 0, 1),), size
        )
        if right:
            assert len(Samples(door, motion).times) == 2
        else:
            with pytest.raises(InputError) as caught:
                Samples(door, motion)
            assert caught.value.field == "trajectory.names"


def test_frames_must_be_links_of_free_objects() -> None:
    samples = standing(room(table()))
    samples.check_frame("stick.tip", "by")
    for frame, kind in (("stik.tip", UnknownNameError), ("stick.tap", UnknownNameError)):
        with pytest.raises(kind) as caught:
            samples.check_frame(frame, "by")
        assert caught.value.field == "by"
    with pytest.raises(InputError, match="stands fixed"):
        standing(door_scene()).check_frame("door.panel", "by")


def test_waypoints_and_rows() -> None:
    scene = hall()
    motion = of_rows(scene, np.array([moved(scene.start, x=x) for x in (0.0, 0.015, 0.02, 0.04)]))
    samples = Samples(scene, motion)
    assert samples.waypoint_rows.tolist() == [0, 3, 4, 8]
    assert [samples.find_waypoint(row) for row in range(9)] == [0, 0, 0, 1, 2, 2, 2, 2, 3]
    assert samples.get_rows(PhaseSpan("p", 1, 2)).tolist() == [3, 4]
    assert samples.get_rows(PhaseSpan("p", 0, 3)).tolist() == list(range(9))


@given(
    st.sampled_from([0.0, 1e-9, 1e-4, 0.5, 1.5, 3.0, np.pi - 1e-4, np.pi - 1e-9, np.pi]),
    st.integers(0, 10**6),
)
def test_angles_are_as_exact_near_none_as_near_half_a_turn(angle: float, seed: int) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    turn = pin.AngleAxis(angle, axis / np.linalg.norm(axis)).toRotationMatrix()
    (found, none) = _compute_angles(np.array([turn, np.eye(3)]))
    assert found == pytest.approx(
        angle, abs=1e-12 + 1e-15 / max(np.sin(angle), 1e-3) if angle < 3.1 else 1e-9
    )
    assert none == 0.0
