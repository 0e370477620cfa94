"""Tests models with mimic joints against models with independent joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
from helpers.telescopes import format_joint, format_link, write_telescope
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning import kinematics as cpin
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.couplings import find_followers, tighten_coupled_limits
from vkc_pin.world.models.robot_model import (
    build_full_model,
    build_planned_model,
    compute_rest_positions,
    make_configuration,
)

KINDS = ("revolute", "prismatic", "continuous")


def make_random_robot(rng: np.random.Generator) -> tuple[str, str]:
    """Return a URDF of a random tree with random couplings, and its tool link."""
    count = int(rng.integers(3, 8))
    parts, order = [format_link("l0", "0.1 0.1 0.1")], rng.permutation(count)
    leaders = {
        int(one): int(other)
        for k, one in enumerate(order)
        for other in order[:k]
        if rng.random() < 0.3
    }
    for k in range(count):
        numbers = {
            "multiplier": rng.uniform(0.3, 2.0) * rng.choice([-1, 1]),
            "offset": rng.uniform(-0.3, 0.3),
        }
        attributes = " ".join(f'{key}="{value}"' for key, value in numbers.items())
        inside = f'<mimic joint="j{leaders[k]}" {attributes}/>' if k in leaders else ""
        above = f"l{k if rng.random() < 0.7 else rng.integers(0, k + 1)}"
        at, axis = (" ".join(map(str, rng.normal(size=3))) for _ in range(2))
        kind = str(rng.choice(KINDS))
        parts += [
            format_link(f"l{k + 1}", "0.1 0.1 0.1", at),
            format_joint(f"j{k}", kind, above, f"l{k + 1}", at, axis, (-5.0, 5.0), inside=inside),
        ]
    return f'<robot name="robot">{"".join(parts)}</robot>', f"l{count}"


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_kinematics_match_independent_joints(seed: int) -> None:
    """Compares placements and Jacobians with finite differences of independent joints."""
    rng = np.random.default_rng(seed)
    text, tool = make_random_robot(rng)
    file = read_urdf(Path("robot.urdf"), text=text)
    single = build_full_model(file)
    full = tighten_coupled_limits(single, file, tool)
    rest = compute_rest_positions(full, file, {})
    model, followers = build_planned_model(full, file, tool, rest, {}), find_followers(file.root)
    coordinates = Coordinates(model)
    z = rng.uniform(-1.0, 1.0, coordinates.size)

    def make_full_configuration(z: np.ndarray) -> np.ndarray:
        values = dict(zip(coordinates.names, z, strict=True))
        at = {**rest, **{name: value for name, value in values.items() if name in rest}}
        at |= {
            name: coupling.factor * at[coupling.leader] + coupling.offset
            for name, coupling in followers.items()
        }
        q = make_configuration(single, at)
        q[:4] = z[0], z[1], np.cos(z[2]), np.sin(z[2])
        return q

    data, single_data = model.createData(), single.createData()
    pin.framesForwardKinematics(model, data, coordinates.q(z))
    pin.framesForwardKinematics(single, single_data, make_full_configuration(z))
    for frame in (frame for frame in single.frames if frame.type == pin.FrameType.BODY):
        ours = data.oMf[model.getFrameId(frame.name, pin.FrameType.BODY)]
        expected = single_data.oMf[single.getFrameId(frame.name, pin.FrameType.BODY)]
        np.testing.assert_allclose(ours.homogeneous, expected.homogeneous, atol=1e-9)

    differences = []
    for step in 1e-6 * np.eye(coordinates.size)[2:]:  # x and y in z are in the world frame
        ends = []
        for at in (z + step, z - step):
            pin.framesForwardKinematics(single, single_data, make_full_configuration(at))
            ends.append(single_data.oMf[single.getFrameId(tool, pin.FrameType.BODY)].copy())
        turn = pin.log3(ends[0].rotation @ ends[1].rotation.T)
        move = ends[0].translation - ends[1].translation
        differences.append(np.concatenate([move, turn]) / 2e-6)
    jacobian = np.array(cpin.frame_jacobian(model, tool)(coordinates.q(z)))
    np.testing.assert_allclose(jacobian[:, 2:], np.transpose(differences), atol=1e-6)


def test_dynamics_include_followers(tmp_path: Path) -> None:
    robot = vkc.load_robot(write_telescope(tmp_path))
    model, rng = pin.Model(robot.model), np.random.default_rng(0)
    for j in range(1, model.njoints):
        model.inertias[j] = pin.Inertia.Random()
    z, v, a = rng.uniform(-0.5, 0.5, (3, model.nv))
    q, data = robot.coordinates.q(z), model.createData()
    torques, expected = cpin.rnea(model)(q, v, a), pin.rnea(model, data, q, v, a)
    np.testing.assert_allclose(np.array(torques).ravel(), expected, atol=1e-9)
    center, expected = cpin.center_of_mass(model)(q), pin.centerOfMass(model, data, q)
    np.testing.assert_allclose(np.array(center).ravel(), expected, atol=1e-9)


def test_leaders_may_be_on_another_branch(tmp_path: Path) -> None:
    """As in a palletizer, the follower is on the path to the tool, its leader is not."""
    parts = [
        format_link("root", "0.1 0.1 0.1"),
        format_link("a", "0.1 0.1 0.1"),
        format_link("b", "0.1 0.1 0.1", "0 0 1"),
    ]
    parts += [
        format_joint(
            "follower", "revolute", "root", "a", inside='<mimic joint="leader" multiplier="-1"/>'
        )
    ]
    parts += [format_joint("leader", "revolute", "root", "b")]
    file = tmp_path / "robot.urdf"
    file.write_text(f'<robot name="robot">{"".join(parts)}</robot>')
    robot = vkc.load_robot(file, tool_frame="a", pairs="all")
    assert robot.coordinates.names[3:] == ("leader",)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q([0.0, 0.0, 0.0, 0.4]))
    for name, angle in (("a", -0.4), ("b", 0.4)):
        np.testing.assert_allclose(
            data.oMf[robot.model.getFrameId(name)].rotation,
            pin.utils.rotate("z", angle),
            atol=1e-12,
        )
