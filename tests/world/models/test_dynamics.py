"""Tests resistances of joints, masses of objects, and torque limits of robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from helpers.expected_errors import expect_error
from helpers.objects import URDF, load_object_text
from hypothesis import given
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.world.models.dynamics import Resistance, TorqueLimits, compute_torque_limits

TAIL = "attachments: []\n"
REAL = st.floats(-1e3, 1e3)


def add_dynamics(attributes: str) -> str:
    return URDF.replace('<axis xyz="0 0 1"/>', f'<axis xyz="0 0 1"/><dynamics {attributes}/>')


def test_the_description_overrides_the_urdf_per_value() -> None:
    urdf = add_dynamics('friction="2" damping="0.5"')
    for joints, expected in (
        ("{}", Resistance(friction=2.0, damping=0.5)),
        (
            "{hinge: {friction: 0, stiffness: 4, springref: -2}}",
            Resistance(friction=0.0, damping=0.5, stiffness=4.0, springref=-2.0),
        ),
    ):
        item = load_object_text(urdf, f"urdf: thing.urdf\njoints: {joints}\n{TAIL}")
        assert item.resistance == {"hinge": expected, "knob": Resistance()}


@given(
    REAL,
    REAL,
    st.builds(
        Resistance,
        friction=REAL.map(abs),
        damping=REAL.map(abs),
        stiffness=REAL.map(abs),
        springref=REAL,
    ),
)
def test_friction_and_damping_dissipate_and_springs_store_energy(
    position: float, velocity: float, resistance: Resistance
) -> None:
    passive = Resistance(stiffness=resistance.stiffness, springref=resistance.springref)
    dissipated = (
        resistance.force(position, velocity) - passive.force(position, velocity)
    ) * velocity
    assert dissipated == pytest.approx(
        resistance.friction * abs(velocity) + resistance.damping * velocity**2, rel=1e-6, abs=1e-6
    )
    step = 1e-3
    energy = [
        resistance.stiffness / 2.0 * (position + sign * step - resistance.springref) ** 2
        for sign in (-1.0, 1.0)
    ]
    gradient = (energy[1] - energy[0]) / (2.0 * step)
    assert passive.force(position, velocity) == pytest.approx(gradient, rel=1e-6, abs=1e-3)


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ("friction: -1", "friction"),
        ("damping: fast", "damping"),
        ("stiffness: .nan", "stiffness"),
        ("springref: 1.0", "springref without stiffness"),
    ],
)
def test_invalid_values_raise_with_their_line(fields: str, problem: str) -> None:
    with expect_error(problem, field=f"joints.hinge.{fields.partition(':')[0]}", line=4):
        load_object_text(URDF, f"urdf: thing.urdf\njoints:\n  hinge:\n    {fields}\n{TAIL}")


@pytest.mark.parametrize(
    "attributes", ['friction="-1"', 'damping="much"', 'damping="1 2"', 'friction="inf"']
)
def test_invalid_urdf_dynamics_raise_with_their_line(attributes: str) -> None:
    urdf = add_dynamics(attributes).replace("<link", "\n<link")
    field = f"hinge: dynamics {attributes.partition('=')[0]}"
    with expect_error(r"thing\.urdf:4: ", line=4, field=field):
        load_object_text(urdf, f"urdf: thing.urdf\n{TAIL}")


BOX = '<collision><origin xyz="0 0 0.2"/><geometry><box size="0.2 0.4 0.6"/></geometry></collision>'


def load_block(contents: str, more: str = "mass: 6.0") -> vkc.ArticulatedObject:
    urdf = f'<robot name="t"><link name="block">{contents}</link></robot>'
    return load_object_text(urdf, f"urdf: thing.urdf\nfree: true\n{more}\n{TAIL}")


def test_masses_of_the_urdf_are_scaled_uniformly() -> None:
    plain = vkc.load_object("broom")
    heavy = vkc.load_object(
        {"urdf": "broom.urdf", "free": True, "mass": 6.5, "attachments": []},
        folder="scenes/objects",
    )
    assert plain.mass == pytest.approx(0.65)
    assert heavy.mass == pytest.approx(6.5)
    for before, after in zip(plain.model.inertias, heavy.model.inertias, strict=True):
        np.testing.assert_allclose(after.lever, before.lever)
        np.testing.assert_allclose(after.inertia, 10.0 * np.asarray(before.inertia), rtol=1e-12)


def test_without_masses_shapes_are_solids() -> None:
    (inertia,) = load_block(BOX).model.inertias
    np.testing.assert_allclose(inertia.lever, [0.0, 0.0, 0.2], atol=1e-12)
    expected = pin.Inertia.FromBox(6.0, 0.2, 0.4, 0.6).inertia
    np.testing.assert_allclose(inertia.inertia, expected, atol=1e-9)
    (inertia,) = load_block("").model.inertias  # without shapes, the mass is at the origin
    assert inertia.mass == 6.0
    assert not np.asarray(inertia.lever).any()


def test_mass_is_zero_by_default_and_may_be_zero() -> None:
    inertial = '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
    for contents, more, mass in (
        (BOX, "", 0.0),
        (BOX + inertial, "", 2.0),
        (BOX + inertial, "mass: 0", 0.0),
    ):
        assert load_block(contents, more).mass == mass


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        ("free: true\nmass: -1.0", "mass"),
        ("free: true\nmass: heavy", "mass"),
        ("free: true\nmass: .inf", "mass"),
        ("free: false\nmass: 3", "applies to free objects only"),
    ],
)
def test_invalid_masses_raise(more: str, problem: str) -> None:
    urdf = '<robot name="t"><link name="a"/></robot>'
    with expect_error(problem, field="mass", line=3):
        load_object_text(urdf, f"urdf: thing.urdf\n{more}\n{TAIL}")


def compute_limits(robot: vkc.Robot, model: pin.Model) -> TorqueLimits:
    return compute_torque_limits(model, robot.coordinates, robot.lower, robot.upper)


def test_limits_are_unknown_without_masses(husky: vkc.Robot) -> None:
    model = pin.Model(husky.model)
    for joint in range(2, model.njoints):
        model.inertias[joint] = pin.Inertia.Zero()
    found = compute_limits(husky, model)
    assert not found.is_known
    assert found.notes == ("the URDF states no masses of the arm",)


def replace_limit(robot: vkc.Robot, index: int, limit: float) -> TorqueLimits:
    """Return the torque limits of a robot whose URDF states another effort of a joint."""
    model = pin.Model(robot.model)
    limits = np.array(model.effortLimit)
    limits[index] = limit
    model.effortLimit = limits
    return compute_limits(robot, model)


@pytest.mark.parametrize("stated", [0.0, np.inf, np.finfo(float).max])
def test_joints_without_effort_limit_are_noted(husky: vkc.Robot, stated: float) -> None:
    found = replace_limit(husky, 5, stated)
    assert np.isinf(found.limits[5])
    assert np.isfinite(found.limits[[3, 4, 6, 7, 8]]).all()
    assert found.notes == ("the URDF states no effort of elbow_joint",)


def test_limits_that_cannot_hold_the_arm_are_discarded(husky: vkc.Robot) -> None:
    outstretched = husky.coordinates.q(np.zeros(9))
    torques = pin.computeGeneralizedGravity(husky.model, husky.model.createData(), outstretched)
    gravity = abs(torques[4])
    found = replace_limit(husky, 4, 0.5 * gravity)
    assert np.isinf(found.limits[4])
    (note,) = found.notes
    assert "shoulder_lift_joint" in note
    assert "cannot hold the arm" in note
    assert replace_limit(husky, 4, 1.2 * gravity).limits[4] == pytest.approx(1.2 * gravity)


def load_robot_with_effort(folder: Path, effort: object) -> vkc.Robot:
    source = vkc.load_robot("husky_ur5e").urdf.parent
    description = yaml.safe_load((source / "robot.yaml").read_text())
    description["urdf"] = str(source / description["urdf"])
    description["srdf"] = str(next(source.glob("*.srdf")))
    description["joints"] = {**description.get("joints", {}), "elbow_joint": {"effort": effort}}
    (folder / "robot.yaml").write_text(yaml.safe_dump(description))
    return vkc.load_robot(folder / "robot.yaml")


@pytest.mark.parametrize(("effort", "limit"), [(90.0, 90.0), (0, np.inf)])
def test_robot_yaml_overrides_the_urdf(tmp_path: Path, effort: float, limit: float) -> None:
    limits = load_robot_with_effort(tmp_path, effort).torque_limits.limits
    assert limits.tolist() == [np.inf] * 3 + [150.0, 150.0, limit] + [28.0] * 3


@pytest.mark.parametrize("effort", [-1.0, "strong", float("nan")])
def test_invalid_effort_limits_raise(tmp_path: Path, effort: object) -> None:
    with expect_error(field="joints.elbow_joint.effort"):
        load_robot_with_effort(tmp_path, effort)
