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
from vkc_pin.errors import InputError
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.dynamics import Resistance, TorqueLimits, compute_torque_limits
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot import Robot

TAIL = "attachments: []\n"
REAL = st.floats(-1e3, 1e3)


def add_dynamics(attributes: str) -> str:
    return URDF.replace('<axis xyz="0 0 1"/>', f'<axis xyz="0 0 1"/><dynamics {attributes}/>')


def test_resistance_is_zero_by_default() -> None:
    item = load_object_text(URDF, f"urdf: thing.urdf\n{TAIL}")
    assert item.resistance == {"hinge": Resistance(), "knob": Resistance()}
    assert Resistance().force(0.7, -0.3) == 0.0


def test_the_description_overrides_the_urdf_per_value() -> None:
    urdf = add_dynamics('friction="2" damping="0.5"')
    plain = load_object_text(urdf, f"urdf: thing.urdf\n{TAIL}").resistance["hinge"]
    assert plain == Resistance(friction=2.0, damping=0.5)
    text = (
        f"urdf: thing.urdf\njoints: {{hinge: {{friction: 0, stiffness: 4, springref: -2}}}}\n{TAIL}"
    )
    assert load_object_text(urdf, text).resistance["hinge"] == Resistance(
        friction=0.0, damping=0.5, stiffness=4.0, springref=-2.0
    )


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
    ("fields", "field", "problem"),
    [
        ("friction: -1", "joints.hinge.friction", "friction"),
        ("damping: fast", "joints.hinge.damping", "damping"),
        ("stiffness: .nan", "joints.hinge.stiffness", "stiffness"),
        ("springref: 1.0", "joints.hinge.springref", "springref without stiffness"),
    ],
)
def test_invalid_values_raise_with_their_line(fields: str, field: str, problem: str) -> None:
    with expect_error(problem, field=field, line=4):
        load_object_text(URDF, f"urdf: thing.urdf\njoints:\n  hinge:\n    {fields}\n{TAIL}")


@pytest.mark.parametrize(
    "attributes", ['friction="-1"', 'damping="much"', 'damping="1 2"', 'friction="inf"']
)
def test_invalid_urdf_dynamics_raise_with_their_line(attributes: str) -> None:
    with pytest.raises(InputError) as caught:
        load_object_text(
            add_dynamics(attributes).replace("<link", "\n<link"), f"urdf: thing.urdf\n{TAIL}"
        )
    assert caught.value.line == 4
    assert caught.value.field == f"hinge: dynamics {attributes.partition('=')[0]}"
    assert str(caught.value.file).endswith("thing.urdf")


BOX = '<collision><origin xyz="0 0 0.2"/><geometry><box size="0.2 0.4 0.6"/></geometry></collision>'


def load_block(contents: str, more: str = "mass: 6.0") -> ArticulatedObject:
    urdf = f'<robot name="t"><link name="block">{contents}</link></robot>'
    return load_object_text(urdf, f"urdf: thing.urdf\nfree: true\n{more}\nattachments: []\n")


def test_masses_of_the_urdf_are_scaled_uniformly() -> None:
    plain = load_object("broom")
    heavy = load_object(
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
    moments = 6.0 / 12.0 * np.array([0.4**2 + 0.6**2, 0.2**2 + 0.6**2, 0.2**2 + 0.4**2])
    np.testing.assert_allclose(inertia.inertia, np.diag(moments), atol=1e-9)


def test_without_shapes_the_mass_is_at_the_origin() -> None:
    (inertia,) = load_block("").model.inertias
    assert inertia.mass == 6.0
    assert not np.asarray(inertia.lever).any()


def test_mass_is_zero_by_default_and_may_be_zero() -> None:
    assert load_block(BOX, "").mass == 0.0
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    inertial = f'<inertial><mass value="2"/>{inertia}</inertial>'
    assert load_block(BOX + inertial, "").mass == 2.0
    assert load_block(BOX + inertial, "mass: 0").mass == 0.0


@pytest.mark.parametrize("value", ["-1.0", "heavy", ".inf"])
def test_invalid_masses_raise(value: str) -> None:
    with expect_error(field="mass", line=3):
        load_block("", f"mass: {value}")


def test_fixed_objects_cannot_have_a_mass() -> None:
    with expect_error("applies to free objects only", field="mass", line=2):
        load_object_text(
            '<robot name="t"><link name="a"/></robot>',
            "urdf: thing.urdf\nmass: 3\nattachments: []\n",
        )


@pytest.fixture(scope="module")
def husky() -> Robot:
    return vkc.load_robot("husky_ur5e")


def compute_limits(robot: Robot, model: pin.Model) -> TorqueLimits:
    return compute_torque_limits(model, robot.coordinates, robot.lower, robot.upper)


def test_limits_are_those_of_the_urdf(husky: Robot) -> None:
    assert husky.efforts.is_known
    assert husky.efforts.notes == ()
    np.testing.assert_array_equal(husky.efforts.limits, [np.inf] * 3 + [150.0] * 3 + [28.0] * 3)


def test_limits_are_unknown_without_masses(husky: Robot) -> None:
    model = pin.Model(husky.model)
    for joint in range(2, model.njoints):
        model.inertias[joint] = pin.Inertia.Zero()
    found = compute_limits(husky, model)
    assert not found.is_known
    assert found.notes == ("the URDF states no masses of the arm",)


@pytest.mark.parametrize("stated", [0.0, np.inf, np.finfo(float).max])
def test_joints_without_effort_limit_are_noted(husky: Robot, stated: float) -> None:
    model = pin.Model(husky.model)
    limits = np.array(model.effortLimit)
    limits[5] = stated
    model.effortLimit = limits
    found = compute_limits(husky, model)
    assert np.isinf(found.limits[5])
    assert np.isfinite(found.limits[[3, 4, 6, 7, 8]]).all()
    assert found.notes == ("the URDF states no effort of elbow_joint",)


def test_limits_that_cannot_hold_the_arm_are_discarded(husky: Robot) -> None:
    model, data = pin.Model(husky.model), husky.model.createData()
    outstretched = husky.coordinates.q(np.zeros(9))
    gravity = abs(pin.computeGeneralizedGravity(husky.model, data, outstretched)[4])
    limits = np.array(model.effortLimit)
    limits[4] = 0.5 * gravity
    model.effortLimit = limits
    found = compute_limits(husky, model)
    assert np.isinf(found.limits[4])
    assert len(found.notes) == 1
    assert "shoulder_lift_joint" in found.notes[0]
    assert "cannot hold the arm" in found.notes[0]
    limits[4] = 1.2 * gravity
    model.effortLimit = limits
    assert compute_limits(husky, model).limits[4] == pytest.approx(1.2 * gravity)


def write_robot(folder: Path, effort: object) -> Path:
    source = vkc.load_robot("husky_ur5e").urdf.parent
    description = yaml.safe_load((source / "robot.yaml").read_text(encoding="utf-8"))
    description["urdf"] = str(source / description["urdf"])
    description["srdf"] = str(next(source.glob("*.srdf")))
    description["joints"] = {**description.get("joints", {}), "elbow_joint": {"effort": effort}}
    (folder / "robot.yaml").write_text(yaml.safe_dump(description), encoding="utf-8")
    return folder / "robot.yaml"


@pytest.mark.parametrize(("effort", "limit"), [(90.0, 90.0), (0, np.inf)])
def test_robot_yaml_overrides_the_urdf(tmp_path: Path, effort: float, limit: float) -> None:
    robot = vkc.load_robot(write_robot(tmp_path, effort))
    assert robot.efforts.limits[5] == limit
    assert robot.efforts.limits[4] == 150.0


@pytest.mark.parametrize("effort", [-1.0, "strong", float("nan")])
def test_invalid_effort_limits_raise(tmp_path: Path, effort: object) -> None:
    with expect_error(field="joints.elbow_joint.effort"):
        vkc.load_robot(write_robot(tmp_path, effort))
