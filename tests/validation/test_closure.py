"""Tests that the drift of grasps is bounded, also between samples."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.executions import plan_drawer
from helpers.judging import replace_object
from helpers.small_problems import make_full_scene
from helpers.telescopes import write_telescope

import vkc_pin as vkc
from vkc_pin import PhaseSpan, Plan, Trajectory, validate
from vkc_pin.validation.closure import (
    RESOLUTION,
    find_drift,
)
from vkc_pin.validation.samples import Samples
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.trajectory.curve import Curve

LIMITS = (vkc.Tolerances().closure_position, vkc.Tolerances().closure_angle)


@pytest.fixture(scope="module")
def plan() -> Plan:
    return plan_drawer()


def bend(trajectory: Trajectory, column: int, by: float) -> Trajectory:
    """Insert two knots into a phase with a grasp; a coordinate deviates by `by` between them."""
    curve = trajectory.curve
    assert curve is not None
    held = next(phase for phase in trajectory.phases if phase.held)
    begin, end = (float(trajectory.times[k]) for k in (held.first, held.last))
    inside = (curve.times[:-1] > begin + 1e-6) & (curve.times[1:] < end - 1e-6)
    lengths = curve.compute_max_rates()[0].max(axis=1) * np.diff(curve.times)
    k = int(np.flatnonzero(inside)[np.argmin(lengths[inside])])
    span = curve.times[k + 1] - curve.times[k]
    times = curve.times[k] + span * np.array([0.25, 0.75])
    rates = curve.velocity(times)
    rates[:, column] += np.array([4.0, -4.0]) * by / (span / 2.0)
    rows = (
        np.insert(old, k + 1, new, axis=0)
        for old, new in ((curve.positions, curve.at(times)), (curve.rates, rates))
    )
    return dataclasses.replace(trajectory, curve=Curve(np.insert(curve.times, k + 1, times), *rows))


def find_grasp_phase(samples: Samples) -> tuple[vkc.PhaseSpan, vkc.Hold]:
    phase = next(phase for phase in samples.trajectory.phases if phase.held)
    return phase, phase.holds[0]


@pytest.mark.parametrize(("by", "ok"), [(9e-4, True), (1.1e-3, False), (3e-3, False)])
def test_drift_between_two_samples_is_found(plan: Plan, by: float, ok: bool) -> None:
    trajectory = bend(plan.trajectory, 0, by)  # base x moves the hand by the same amount
    samples, times = Samples(plan.scene, trajectory), plan.trajectory.times
    report = validate(plan.scene, plan.steps, trajectory)
    found = [one for one in report.violations if one.constraint == "closure"]
    assert (not found) == ok, report
    assert report.closure_error == pytest.approx(by, abs=3e-4)  # drift of the planned motion
    for one in found:
        assert one.subject.startswith("drawer.")
        assert one.amount == pytest.approx(by - LIMITS[0], abs=3e-4)
        moments = np.linspace(*times[one.waypoint : one.waypoint + 2], 2001)
        errors = samples.compute_grasp_errors_at(find_grasp_phase(samples)[1], moments)
        assert one.amount + LIMITS[0] <= errors[:, 0].max() + RESOLUTION


@pytest.mark.parametrize("seed", range(2))
def test_largest_drift_agrees_with_a_fine_grid(plan: Plan, seed: int) -> None:
    """All coordinates follow random cubics around a grasp; the tolerance is 0."""
    rng, names, times = np.random.default_rng(seed), plan.trajectory.names, np.array([0.0, 0.7])
    phase, hold = find_grasp_phase(Samples(plan.scene, plan.trajectory))
    grasp = plan.trajectory.positions[phase.first]
    changes, rates = rng.uniform(-0.2, 0.2, (2, 2, len(names)))
    positions = grasp + np.abs(changes)
    span = dataclasses.replace(phase, first=0, last=1)
    curve, size = Curve(times, positions, rates), plan.trajectory.robot_size
    samples = Samples(plan.scene, Trajectory(names, times, positions, (span,), size, curve))
    drift = find_drift(samples, span, hold, (0.0, 0.0))
    moments = np.linspace(*times, 5001)
    fine = samples.compute_grasp_errors_at(hold, moments).max(axis=0)
    np.testing.assert_allclose(drift.measured, fine, rtol=0.0, atol=5e-6)
    assert (fine <= drift.bound + RESOLUTION).all()


@pytest.mark.parametrize("attachment", ["rail", "sleeve", "socket", "wheel", "face"])
def test_drift_of_grasps_with_freedoms_agrees_with_a_fine_grid(attachment: str) -> None:
    scene = make_full_scene()
    coordinates = scene.objects["cabinet"].object.attachments[attachment].coordinates
    names = (*scene.robot.coordinates.names, "cabinet.swing", "cabinet.slide")
    names += tuple(f"cabinet.{suffix}" for suffix in coordinates)
    rng, times = np.random.default_rng(3), np.array([0.0, 0.5])
    positions, rates = rng.uniform(-0.3, 0.3, (2, 2, len(names)))
    span = vkc.PhaseSpan("all", 0, 1, (vkc.Hold("cabinet", attachment),))
    size, curve = len(scene.start), Curve(times, positions, rates)
    samples = Samples(scene, Trajectory(names, times, positions, (span,), size, curve))
    drift = find_drift(samples, span, span.holds[0], (0.0, 0.0))
    fine = samples.compute_grasp_errors_at(span.holds[0], np.linspace(*times, 5001))
    np.testing.assert_allclose(drift.measured, fine.max(axis=0), rtol=0.0, atol=5e-6)


FAR = 5.0  # [m] a lever arm that is longer than all others together
BOOM = """<robot name="boom">
<link name="base"/><link name="arm"/><link name="mast"/><link name="tip"/>
<joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="9" effort="9"/></joint>
<joint name="extend" type="prismatic"><parent link="arm"/><child link="mast"/>
  <origin xyz="{joint} 0 0"/>
  <axis xyz="1 0 0"/><limit lower="-9" upper="9" velocity="9" effort="9"/></joint>
<joint name="pin" type="fixed"><parent link="mast"/><child link="tip"/>
  <origin xyz="{link} 0 0"/></joint>
</robot>"""


def grasp_boom(
    values: dict[str, float], *, robot: str = "husky_ur5e", by: vkc.Hold | None = None
) -> tuple[vkc.Scene, vkc.Hold]:
    """Return a scene whose robot grasps a boom exactly, and the hold. In a hand, it is level.

    Args:
        values: Values of joints and freedoms, and lengths [m] along the boom: "joint", "link",
            "grip" and, to the axis of a freedom, "through".
        robot: Name or file of the robot.
        by: Hold of a stick whose tip grasps the boom. Default: the hand grasps it.
    """
    document: dict[str, Any] = {"robot": robot, "start": {"base": [0.0, 0.0, 0.0]}}
    document["arena"] = {"x": [-3.0, 3.0], "y": [-3.0, 3.0]}
    tool = vkc.Scene.from_document(document).tool_placement().rotation
    lengths = {name: values.get(name, 0.0) for name in ("joint", "link", "grip", "through")}
    along, up = tool[0].tolist(), tool[2].tolist()  # axes of the boom in the tool's frame
    through = [lengths["through"] * entry for entry in along]
    freedoms: list[dict[str, Any]] = [
        {"name": "turn", "turn": up, "limits": [-1, 1]},
        {"name": "slide", "slide": along, "limits": [-9, 9]},
        {"name": "spin", "turn": up, "limits": [-4, 4], "through": through},
    ]
    grip = {"name": "grip", "link": "tip", "position": [lengths["grip"], 0.0, 0.0]}
    grip |= {"approach": tool[:, 2].tolist(), "closing": tool[:, 0].tolist(), "freedoms": freedoms}
    boom = {"urdf": BOOM.format(**lengths), "attachments": [grip]}
    document["objects"] = [{"name": "boom", "type": boom, "position": [0.0, 0.0, 0.0]}]
    if by is not None:
        document["objects"].append({"name": "stick", "type": "stick", "position": [0.0, 0.0, 1.0]})
    scene = vkc.Scene.from_document(document).with_held({"stick": "grip"} if by else {})
    item = scene.objects["boom"].object
    attachment = item.attachments["grip"]
    state, freedom = (
        [values.get(name, 0.0) for name in names]
        for names in (("hinge", "extend"), ("turn", "slide", "spin"))
    )
    grasped = item.link_placement("tip", state) * attachment.tool(freedom)
    hand = scene.objects["stick"].link_placement("tip") if by else scene.tool_placement()
    there = hand * compute_hand_frame(scene.robot, attachment) * grasped.inverse()
    hold = vkc.Hold("boom", "grip", by, "tip" if by else None)
    return replace_object(scene, "boom", placement=there), hold


@pytest.mark.parametrize(
    ("bump", "values"),
    [
        ("boom.hinge", {"joint": FAR}),
        ("boom.hinge", {"link": FAR}),
        ("boom.hinge", {"grip": FAR}),
        ("boom.hinge", {"extend": FAR}),
        ("boom.hinge", {"slide": FAR}),
        ("boom.hinge", {"through": FAR, "spin": np.pi}),
        ("boom.extend", {}),
        ("boom.grip_turn", {"slide": FAR}),
        ("boom.grip_turn", {"through": FAR, "spin": np.pi}),
        ("boom.grip_slide", {}),
        ("boom.grip_spin", {"through": FAR}),
        ("base_x", {}),
        ("base_yaw", {}),
        ("wrist_3_joint", {}),
        ("lift", {}),  # of a robot with a wrist that turns five times as fast
        ("stick.grip_turn", {}),  # the tip of a stick grasps the boom
        ("stick.grip_slide", {}),
    ],
    ids=str,
)
def test_drift_between_exact_grasps_is_found(
    bump: str, values: dict[str, float], tmp_path: Path
) -> None:
    """One coordinate follows a parabola; the grasp is exact at the only two samples."""
    robot, by = "husky_ur5e", None
    if bump == "lift":
        couplings = "roll_joint: {joint: lift, multiplier: 5.0}"
        robot = str(write_telescope(tmp_path, couplings=couplings))
    elif bump.startswith("stick."):
        by = vkc.Hold("stick", "grip")
    scene, hold = grasp_boom(values, robot=robot, by=by)
    items = ("hinge", "extend", "grip_turn", "grip_slide", "grip_spin")
    row = [*scene.start, *(values.get(name.removeprefix("grip_"), 0.0) for name in items)]
    names = (*scene.robot.coordinates.names, *(f"boom.{name}" for name in items))
    if by is not None:
        names, row = (*names, "stick.grip_slide", "stick.grip_turn"), [*row, 0.0, 0.0]
    height, times = 1.5e-4, np.array([0.0, 0.5])
    rows, rates = np.tile(row, (2, 1)), np.zeros((2, len(row)))
    rates[:, names.index(bump)] = np.array([4.0, -4.0]) * height / times[1]
    span = PhaseSpan("all", 0, 1, (hold,) if by is None else (by, hold))
    curve = Curve(times, rows, rates)
    motion = Trajectory(names, times, rows, (span,), len(scene.start), curve)
    expected = check_drift_is_found(Samples(scene, motion), hold)
    assert expected.max() >= 0.99 * height


def check_drift_is_found(samples: Samples, hold: vkc.Hold) -> np.ndarray:
    """Check the drift of a grasp that is exact at the only two samples; return it."""
    (span,), times = samples.trajectory.phases, samples.times
    assert len(times) == 2
    np.testing.assert_allclose(samples.compute_grasp_errors(hold, np.arange(2)), 0.0, atol=1e-8)
    expected = samples.compute_grasp_errors_at(hold, times.mean(keepdims=True))[0]
    for kind in np.flatnonzero(expected > 5.0 * RESOLUTION).tolist():
        limits = [1e3, 1e3]
        limits[kind] = 0.99 * expected[kind]
        drift = find_drift(samples, span, hold, (limits[0], limits[1]))
        assert drift.measured[kind] == pytest.approx(expected[kind], abs=RESOLUTION)
        assert drift.bound[kind] > limits[kind]
    return expected


def test_drift_of_a_constant_turn_is_found() -> None:
    """The boom's end moves along an arc, and the hand along its chord at the same heading."""
    radius, turn = 0.5, 9e-3
    scene, hold = grasp_boom({"joint": radius})
    angles = np.array([-0.5, 0.5]) * turn
    change = radius * np.column_stack([np.cos(angles) - 1.0, np.sin(angles), 0.0 * angles])
    rows = np.tile([*scene.start, *np.zeros(5)], (2, 1))
    rows[:, :2] += (change @ scene.objects["boom"].placement.rotation.T)[:, :2]
    robot = len(scene.start)
    rows[:, robot], rows[:, robot + 2] = angles, -angles
    names = [*scene.robot.coordinates.names, "boom.hinge", "boom.extend"]
    names += [f"boom.grip_{name}" for name in ("turn", "slide", "spin")]
    span = PhaseSpan("all", 0, 1, (hold,))
    motion = Trajectory(tuple(names), np.array([0.0, 0.5]), rows, (span,), robot)
    expected = check_drift_is_found(Samples(scene, motion), hold)
    assert expected[0] == pytest.approx(radius * turn**2 / 8.0, rel=0.01)
