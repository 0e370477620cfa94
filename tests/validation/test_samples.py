"""Tests the density of samples, and limits, units and grasp errors of coordinates."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from helpers.drives import make_hall, make_trajectory, move_start
from helpers.robots import compute_placement
from helpers.small_problems import make_full_scene
from helpers.telescopes import write_coupled_scene
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vkc_pin import Hold, InputError, PhaseSpan, Trajectory
from vkc_pin.validation.samples import ANGLE_STEP, LENGTH_STEP, Samples
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import make_holds
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.world_model import World

GRASPS = sorted(make_full_scene().objects["cabinet"].object.attachments)


LENGTHS = {
    "base_x",
    "base_y",
    "drawer.slide",
    "cabinet.slide",
    "cabinet.rail",
    "cabinet.sleeve_slide",
    "cabinet.face_x",
    "cabinet.face_y",
}


def sample_motion(seed: int, *, grasp: str = "grip") -> Trajectory:
    """Return a random motion of all objects of the full scene, with a grasp of the cabinet."""
    scene, rng = make_full_scene(), np.random.default_rng(seed)
    attachment = scene.objects["cabinet"].object.attachments[grasp]
    names = (
        *World(scene).coordinates.names,
        *(f"cabinet.{name}" for name in attachment.coordinates),
    )
    positions = rng.uniform(-1.0, 1.0, (5, len(names))) * rng.choice([0.0, 0.01, 1.0], len(names))
    phases = (PhaseSpan("all", 0, 4, (Hold("cabinet", grasp),)),)
    return Trajectory(
        names, np.cumsum(rng.uniform(0.1, 2.0, 5)), positions, phases, len(scene.start)
    )


def test_samples_of_coupled_joints_are_dense(tmp_path: Path) -> None:
    scene = write_coupled_scene(tmp_path)
    rows = np.tile(scene.start, (3, 1))
    rows[1:, 3:] += [[0.4, 0.0, 0.0], [0.4, 0.1, 0.9]]
    samples = Samples(scene, make_trajectory(scene, rows, dt=1.0))
    steps = np.abs(np.diff(samples.z, axis=0)).max(axis=0)
    travel = {
        str(samples.world.model.names[m.joint]): abs(m.factor) * steps[m.coordinate]
        for m in samples.world.coordinates.moves
    }
    assert travel["roll_joint"] == pytest.approx(ANGLE_STEP, rel=0.05)
    assert travel["pitch_joint"] <= ANGLE_STEP
    assert travel["lift"] == pytest.approx(LENGTH_STEP, rel=0.05)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(GRASPS))
def test_samples_are_dense(seed: int, grasp: str) -> None:
    trajectory = sample_motion(seed, grasp=grasp)
    samples, rows = Samples(make_full_scene(), trajectory), np.arange(len(trajectory.times))
    steps = np.abs(np.diff(trajectory.at(samples.times), axis=0))
    lengths = np.array([name in LENGTHS for name in trajectory.names])
    assert [samples.get_unit(name) == "m" for name in trajectory.names] == lengths.tolist()
    assert steps[:, lengths].max(initial=0.0) <= LENGTH_STEP * (1 + 1e-6)
    assert steps[:, ~lengths].max(initial=0.0) <= ANGLE_STEP * (1 + 1e-6)
    assert np.linalg.norm(steps[:, :2], axis=1).max() <= LENGTH_STEP * (1 + 1e-6)
    np.testing.assert_allclose(samples.times[samples.waypoint_rows], trajectory.times, atol=1e-12)
    np.testing.assert_allclose(
        samples.z[samples.waypoint_rows], samples.world.compute_positions(trajectory), atol=1e-9
    )
    assert (np.diff(samples.times) > 0).all()
    at, before = (map(samples.find_waypoint, samples.waypoint_rows - k) for k in (0, 1))
    np.testing.assert_array_equal([*at], rows)
    np.testing.assert_array_equal([*before][1:], rows[:-1])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [1.0, 100.0])
def test_samples_of_a_curve_are_close_to_it(share: float, seed: int) -> None:
    """Between two samples, a curve deviates from its chord by at most a tenth of a step.

    Its coordinates move by about `share` of a step between two knots, and back.
    """
    motion, rng = sample_motion(seed), np.random.default_rng(seed)
    lengths = np.array([name in LENGTHS for name in motion.names])
    steps = np.where(lengths, LENGTH_STEP, ANGLE_STEP)
    rates = 0.1 * share * steps * rng.uniform(-1.0, 1.0, motion.positions.shape)
    rows, times = np.tile(motion.positions[0], (len(rates), 1)), 10.0 * motion.times
    curve = Curve(times, rows, rates)
    samples = Samples(
        make_full_scene(), dataclasses.replace(motion, times=times, positions=rows, curve=curve)
    )
    rows, spans = curve.at(samples.times), np.diff(samples.times)
    assert (np.abs(np.diff(rows, axis=0)) <= steps * (1 + 1e-6)).all()
    for at in (0.25, 0.5, 0.75):
        chord = (1.0 - at) * rows[:-1] + at * rows[1:]
        deviation = np.abs(curve.at(samples.times[:-1] + at * spans) - chord)
        assert (deviation <= 0.1 * steps * (1 + 1e-6)).all()


@pytest.mark.parametrize("grasp", GRASPS)
def test_grasp_errors_are_measured_from_the_frame_of_the_attachment(grasp: str) -> None:
    scene, trajectory = make_full_scene(), sample_motion(4, grasp=grasp)
    samples, placed = Samples(scene, trajectory), scene.objects["cabinet"]
    attachment, robot = placed.object.attachments[grasp], scene.robot
    hand, expected = compute_hand_frame(robot, attachment), []
    for row in trajectory.positions:
        value = dict(zip(trajectory.names, row, strict=True))
        state, freedoms = (
            [value[f"cabinet.{name}"] for name in names]
            for names in (placed.object.coordinates.names, attachment.coordinates)
        )
        link = placed.placement * placed.object.link_placement(attachment.link, state)
        grasped = link * attachment.tool(freedoms)
        tool = compute_placement(robot, robot.tool_frame, row[: len(scene.start)])
        error = grasped.actInv(tool * hand)
        turn = Rotation.from_matrix(error.rotation).magnitude()
        expected.append((np.linalg.norm(error.translation), turn))
    errors = samples.compute_grasp_errors(Hold("cabinet", grasp), samples.waypoint_rows)
    np.testing.assert_allclose(errors, expected, atol=1e-9)


def test_grasps_drive_the_joints_between_root_and_attachment() -> None:
    samples = Samples(make_full_scene(), sample_motion(0))
    assert samples.find_driven_coordinates(()) == set()
    assert samples.find_driven_coordinates(make_holds({"cabinet": "grip"})) == {
        "cabinet.swing",
        "cabinet.slide",
    }
    assert samples.find_driven_coordinates(make_holds({"door": "handle", "drawer": "handle"})) == {
        "door.hinge",
        "door.knob",
        "drawer.slide",
    }


def test_limits_of_the_base_include_the_arena() -> None:
    scene = dataclasses.replace(make_hall(), arena=(-5.0, 6.0, -7.0, 8.0))
    robot = scene.robot
    lower, upper = robot.lower.copy(), robot.upper.copy()
    lower[:3], upper[:3] = [-1.0, -9.0, -2.0], [9.0, 1.0, 3.0]
    robot = dataclasses.replace(robot, lower=lower, upper=upper)
    scene = dataclasses.replace(scene, robot=robot)
    samples = Samples(scene, make_trajectory(scene, np.tile(scene.start, (2, 1))))
    limits = np.array([samples.get_limits(name) for name in robot.coordinates.names])
    np.testing.assert_array_equal(limits[:2, :2], [(-1.0, 6.0), (-7.0, 1.0)])
    np.testing.assert_array_equal(limits[2:, 0], lower[2:])
    np.testing.assert_array_equal(limits[2:, 1], upper[2:])
    np.testing.assert_array_equal(limits[:, 2], robot.velocity)
    np.testing.assert_array_equal(limits[:, 3], robot.acceleration)


def test_number_of_samples_grows_with_the_step() -> None:
    scene, wrist = make_hall(), 8
    steps = [
        ({0: 0.05}, 10),
        ({0: -0.051}, 11),
        ({}, 1),
        ({0: 0.03, 1: 0.04}, 10),
        ({2: 0.1}, 10),
        ({wrist: -0.3}, 30),
        ({0: 0.01, wrist: 0.05}, 5),
        ({2: 1.01e-2}, 2),
    ]
    rows = [np.array(scene.start)]
    for step, _ in steps:
        rows.append(rows[-1].copy())
        for column, change in step.items():
            rows[-1][column] += change
    samples = Samples(scene, make_trajectory(scene, np.array(rows)))
    counts = np.array([count for _, count in steps])
    np.testing.assert_array_equal(np.diff(samples.waypoint_rows), counts)
    assert samples.required_count == counts.sum()
    np.testing.assert_allclose(np.diff(samples.times), np.repeat(0.25 / counts, counts))
    assert samples.get_rows(PhaseSpan("p", 1, 3)).tolist() == list(range(10, 23))


def test_number_of_samples_along_a_curve_follows_its_largest_speed() -> None:
    """Half a metre from rest to rest counts as 0.75 m at the largest speed; knots are samples."""
    scene = make_hall()
    rows = np.array([move_start(scene.start, x=x) for x in (0.0, 0.25, 0.5)])
    for knots, positions in (
        (np.array([0.0, 2.0]), rows[[0, 2]]),
        (np.array([0.0, 1.0, 2.0]), rows),
    ):
        curve = Curve(knots, positions, np.zeros_like(positions))
        motion = dataclasses.replace(make_trajectory(scene, rows[[0, 2]], dt=2.0), curve=curve)
        samples = Samples(scene, motion)
        assert np.diff(samples.waypoint_rows).tolist() == [150]
        assert set(knots.tolist()) <= set(samples.times.tolist())


def test_coordinates_out_of_range_are_refused() -> None:
    scene = make_hall()
    motion = make_trajectory(scene, np.array([scene.start, move_start(scene.start, y=-1.01e12)]))
    with pytest.raises(InputError) as caught:
        Samples(scene, motion)
    assert caught.value.field == "trajectory.positions[1, 1]"
