"""How finely a motion is looked at, and how far a hand is from its grasp."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import full_scene, with_objects
from helpers.telescopes import coupled_scene
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vkc_pin.errors import InputError
from vkc_pin.validation.samples import ANGLE_STEP, LENGTH_STEP, MAX_SAMPLES, Samples
from vkc_pin.world.scene.hold import Hold, make_holds
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

VIRTUAL = {
    "grip": (),
    "rail": ("rail",),
    "bar": ("bar",),
    "ball": ("ball_z", "ball_y", "ball_x"),
    "sleeve": ("sleeve_turn", "sleeve_slide"),
    "socket": ("socket_z", "socket_y", "socket_x"),
}


def motion(scene: Scene, seed: int, *, grasp: str = "grip", number: int = 5) -> Trajectory:
    rng = np.random.default_rng(seed)
    objects = [
        f"{name}.{joint}"
        for name, placed in scene.objects.items()
        for joint in placed.object.coordinates.names
    ]
    names = (
        *scene.robot.coordinates.names,
        *objects,
        *(f"cabinet.{name}" for name in VIRTUAL[grasp]),
    )
    positions = rng.uniform(-1.0, 1.0, (number, len(names))) * rng.choice(
        [0.0, 0.01, 1.0], len(names)
    )
    phases = (PhaseSpan("all", 0, number - 1, (Hold("cabinet", grasp),)),)
    return Trajectory(
        names, np.cumsum(rng.uniform(0.1, 2.0, number)), positions, phases, len(scene.start)
    )


def test_joints_that_follow_others_are_seen_as_often(tmp_path: Path) -> None:
    """One of them turns by 3 rad as another turns by 1."""
    scene = coupled_scene(tmp_path)
    rows = np.tile(scene.start, (3, 1))
    rows[1:, 3:] += [[0.4, 0.0, 0.0], [0.4, 0.1, 0.9]]
    names, phases = scene.robot.coordinates.names, (PhaseSpan("all", 0, 2, ()),)
    samples = Samples(
        scene, Trajectory(names, np.array([0.0, 1.0, 2.0]), rows, phases, len(scene.start))
    )
    steps = np.abs(np.diff(samples.z, axis=0)).max(axis=0)
    goes = {
        str(samples.world.model.names[m.joint]): abs(m.factor) * steps[m.coordinate]
        for m in samples.world.coordinates.moves
    }
    assert goes["roll_joint"] == pytest.approx(ANGLE_STEP, rel=0.05)
    assert goes["pitch_joint"] <= ANGLE_STEP
    assert goes["lift"] == pytest.approx(LENGTH_STEP, rel=0.05)


@pytest.mark.parametrize("jump", [1e4, 1e9])
def test_a_motion_that_jumps_is_seen_at_its_waypoints(jump: float) -> None:
    scene = full_scene()
    trajectory = motion(scene, 0)
    positions = trajectory.positions.copy()
    positions[2:, 1] += jump
    samples = Samples(scene, dataclasses.replace(trajectory, positions=positions))
    assert samples.required_count == pytest.approx(jump / LENGTH_STEP, rel=1e-2)
    assert samples.required_count > MAX_SAMPLES
    np.testing.assert_array_equal(samples.times, trajectory.times)
    np.testing.assert_array_equal(samples.waypoint_rows, np.arange(len(trajectory.times)))


def test_a_motion_beyond_all_measure_is_refused() -> None:
    scene = full_scene()
    trajectory = motion(scene, 0)
    positions = trajectory.positions.copy()
    positions[2, 1] = 1e300
    with pytest.raises(InputError, match="out of range") as caught:
        Samples(scene, dataclasses.replace(trajectory, positions=positions))
    assert caught.value.field == "trajectory.positions[2, 1]"


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(VIRTUAL)))
def test_samples_are_dense(seed: int, grasp: str) -> None:
    trajectory = motion(full_scene(), seed, grasp=grasp)
    samples = Samples(full_scene(), trajectory)
    steps = np.abs(np.diff(trajectory.at(samples.times), axis=0))
    of_objects = ("drawer.slide", "cabinet.slide", "cabinet.rail", "cabinet.sleeve_slide")
    lengths = np.array([name in ("base_x", "base_y", *of_objects) for name in trajectory.names])
    assert steps[:, lengths].max(initial=0.0) <= LENGTH_STEP * (1 + 1e-6)
    assert steps[:, ~lengths].max(initial=0.0) <= ANGLE_STEP * (1 + 1e-6)
    assert np.linalg.norm(steps[:, :2], axis=1).max() <= LENGTH_STEP * (1 + 1e-6)
    assert (LENGTH_STEP, ANGLE_STEP) == (5e-3, 1e-2)
    np.testing.assert_allclose(samples.times[samples.waypoint_rows], trajectory.times, atol=1e-12)
    np.testing.assert_allclose(
        samples.z[samples.waypoint_rows], samples.world.compute_positions(trajectory), atol=1e-9
    )
    assert (np.diff(samples.times) > 0).all()
    assert [samples.find_waypoint(int(row)) for row in samples.waypoint_rows] == list(
        range(len(trajectory.times))
    )
    assert all(
        samples.find_waypoint(int(row) - 1) == t for t, row in enumerate(samples.waypoint_rows[1:])
    )
    assert [samples.get_unit(name) == "m" for name in trajectory.names] == lengths.tolist()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(VIRTUAL)))
def test_grasp_errors(seed: int, grasp: str) -> None:
    """The cabinet is put where the hand has it: tool = base · link · placement · J(v) · offset. Then it is put elsewhere."""
    scene = full_scene()
    trajectory, rng = motion(scene, seed, grasp=grasp, number=2), np.random.default_rng(seed)
    robot, placed = scene.robot, scene.objects["cabinet"]
    attachment, z = placed.object.attachments[grasp], trajectory.positions[0]
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z[: len(scene.start)]))
    tool = data.oMf[robot.model.getFrameId(robot.tool_frame)]
    value = {name: trajectory.column(f"cabinet.{name}")[0] for name in VIRTUAL[grasp]}
    freedom = pin.SE3.Identity()
    if attachment.joint in ("prismatic", "cylindrical"):
        freedom.translation = attachment.freedoms[0].axis * value.get(
            "rail", value.get("sleeve_slide", 0.0)
        )
    if attachment.joint in ("revolute", "cylindrical"):
        turn = attachment.freedoms[-1].axis * value.get("bar", value.get("sleeve_turn", 0.0))
        freedom.rotation = Rotation.from_rotvec(turn).as_matrix()
    elif attachment.joint == "spherical":
        freedom.rotation = Rotation.from_euler(
            "XYZ", [value[f"{grasp}_{axis}"] for axis in "xyz"]
        ).as_matrix()
    freedom.translation = freedom.translation - attachment.standoff * freedom.rotation[:, 2]
    state = np.array(
        [trajectory.column(f"cabinet.{joint}")[0] for joint in placed.object.coordinates.names]
    )
    hand = placed.object.link_placement(attachment.link, state) * attachment.placement * freedom
    here = with_objects(
        scene, {"cabinet": dataclasses.replace(placed, placement=tool * hand.inverse())}
    )
    np.testing.assert_allclose(
        Samples(here, trajectory).compute_grasp_errors("cabinet", grasp, np.array([0])),
        0.0,
        atol=1e-7,
    )
    shift, turn = rng.normal(size=3), rng.uniform(-1.0, 1.0, 3)
    off = tool * pin.SE3(pin.exp3(turn), shift)
    there = with_objects(
        scene, {"cabinet": dataclasses.replace(placed, placement=off * hand.inverse())}
    )
    (errors,) = Samples(there, trajectory).compute_grasp_errors("cabinet", grasp, np.array([0]))
    assert errors[0] == pytest.approx(np.linalg.norm(shift))
    assert errors[1] == pytest.approx(np.linalg.norm(turn))


def test_what_a_hand_moves() -> None:
    samples = Samples(full_scene(), motion(full_scene(), 0))
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
