"""Tests that coordinates of coupled joints have the tightest limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.telescopes import joint, link, write_telescope
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.couplings.limits import apply_robot_limits, tighten_coupled_limits
from vkc_pin.world.models.robot_model import (
    build_full_model,
    build_planned_model,
    compute_rest_positions,
)
from vkc_pin.world.models.robot_schema import RobotSchema


def make_coupled_robot(
    tmp_path: Path,
    inside: str,
    *,
    first: tuple[float, float] = (-1.0, 1.0),
    second: tuple[float, float] = (-1.0, 1.0),
    kinds: tuple[str, str] = ("revolute", "revolute"),
    yaml: str = "",
) -> vkc.Robot:
    """Return a robot with two joints, of which the second follows the first."""
    parts = [link(f"l{k}", "0.1 0.1 0.1", f"0 0 {k}") for k in range(3)]
    parts += [joint("one", kinds[0], "l0", "l1", limits=first, velocity=0.4)]
    parts += [
        joint(
            "two",
            kinds[1],
            "l1",
            "l2",
            limits=second,
            velocity=0.6,
            inside=f'<mimic joint="one" {inside}/>',
        )
    ]
    (tmp_path / "robot.urdf").write_text(f'<robot name="robot">{"".join(parts)}</robot>')
    (tmp_path / "robot.yaml").write_text(f"urdf: robot.urdf\ntool_frame: l2\n{yaml}")
    return vkc.load_robot(tmp_path, pairs="all")


@pytest.mark.parametrize(
    ("inside", "second", "limits", "velocity"),
    [
        ('multiplier="1"', (-1.0, 1.0), (-1.0, 1.0), 0.4),
        ('multiplier="2"', (-1.0, 1.0), (-0.5, 0.5), 0.3),
        ('multiplier="-2" offset="0.4"', (-1.0, 1.0), (-0.3, 0.7), 0.3),
        ('multiplier="0.5"', (-0.1, 3.0), (-0.2, 1.0), 0.4),
        ('multiplier="-0.5"', (0.1, 0.2), (-0.4, -0.2), 0.4),
        ('multiplier="0" offset="0.3"', (-1.0, 1.0), (-1.0, 1.0), 0.4),
    ],
)
def test_the_tightest_limits_apply(
    tmp_path: Path,
    inside: str,
    second: tuple[float, float],
    limits: tuple[float, float],
    velocity: float,
) -> None:
    robot = make_coupled_robot(tmp_path, inside, second=second)
    assert robot.coordinates.names[3:] == ("one",)
    np.testing.assert_allclose(
        [robot.lower[3], robot.upper[3], robot.velocity[3]], [*limits, velocity], rtol=1e-12
    )
    assert robot.lower[3] <= robot.home[0] <= robot.upper[3]


def test_home_respects_the_limits_of_followers(tmp_path: Path) -> None:
    """0 is within the limits of the leader, but not of the follower."""
    assert make_coupled_robot(tmp_path, 'multiplier="1"', second=(0.2, 0.6)).home[
        0
    ] == pytest.approx(0.4)


def test_robot_yaml_limits_any_coupled_joint(tmp_path: Path) -> None:
    robot = make_coupled_robot(
        tmp_path,
        'multiplier="2"',
        yaml="joints: {one: {acceleration: 3.0}, two: {velocity: 0.1, acceleration: 4.0}}\n",
    )
    assert (robot.velocity[3], robot.acceleration[3]) == (0.05, 2.0)


def test_default_velocity_and_acceleration_limits(tmp_path: Path) -> None:
    text = write_telescope(tmp_path).parent / "robot.urdf"
    text.write_text(text.read_text().replace('velocity="0.5" ', ""))
    robot = vkc.load_robot(tmp_path)
    assert (robot.velocity[4], robot.acceleration[4]) == (np.pi, 1.4)


def test_default_limits_apply_to_the_fastest_joint(tmp_path: Path) -> None:
    couplings = (
        "out_2: {joint: out_1, multiplier: 0.5}, "
        "out_3: {joint: out_1, multiplier: -2.0, offset: 0.15}"
    )
    file = write_telescope(tmp_path, couplings=couplings).parent / "robot.urdf"
    file.write_text(file.read_text().replace('velocity="0.5" ', ""))
    robot = vkc.load_robot(tmp_path)
    assert (robot.velocity[4], robot.acceleration[4]) == (np.pi / 2.0, 0.7)


@pytest.mark.parametrize(
    ("kinds", "limits"),
    [(("continuous", "revolute"), (-0.5, 0.5)), (("continuous", "continuous"), (-np.inf, np.inf))],
)
def test_continuous_leaders_become_revolute(
    tmp_path: Path, kinds: tuple[str, str], limits: tuple[float, float]
) -> None:
    """A full turn of the leader changes the position of a follower with another factor."""
    robot = make_coupled_robot(tmp_path, 'multiplier="2"', kinds=kinds)
    assert (robot.lower[3], robot.upper[3]) == limits
    z = np.array([0.0, 0.0, 0.0, 2.0 * np.pi / 2.0])
    np.testing.assert_allclose(robot.coordinates.z(robot.coordinates.q(z)), z)
    assert robot.model.joints[2].nq == 1


def test_incompatible_limits_raise(tmp_path: Path) -> None:
    with pytest.raises(
        vkc.InputError,
        match=r"one: no position satisfies the limits of its follower 'two'.*2 to 3.*-1 to 1",
    ):
        make_coupled_robot(tmp_path, 'multiplier="1"', second=(2.0, 3.0))


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_limits_of_coordinates_are_tight_for_all_joints(seed: int) -> None:
    """No joint exceeds its limits, and at each limit of a coordinate one joint attains its own."""
    rng = np.random.default_rng(seed)
    parts, bounds, speeds = [link("l0", "0.1 0.1 0.1")], {}, {}
    for k in range(4):
        bounds[f"j{k}"], speeds[f"j{k}"] = (
            (-rng.uniform(0.5, 2.0), rng.uniform(0.5, 2.0)),
            rng.uniform(0.1, 2.0),
        )
        factor, offset = rng.uniform(0.2, 3.0) * rng.choice([-1.0, 1.0]), rng.uniform(-0.05, 0.05)
        inside = f'<mimic joint="j0" multiplier="{factor}" offset="{offset}"/>' if k else ""
        kind = ("revolute", "prismatic")[k % 2]
        moved = joint(
            f"j{k}",
            kind,
            f"l{k}",
            f"l{k + 1}",
            limits=bounds[f"j{k}"],
            velocity=speeds[f"j{k}"],
            inside=inside,
        )
        parts += [link(f"l{k + 1}"), moved]
    file = read_urdf(Path("robot.urdf"), text=f'<robot name="robot">{"".join(parts)}</robot>')
    full = tighten_coupled_limits(build_full_model(file), file, "l4")
    model = build_planned_model(full, file, "l4", compute_rest_positions(full, file, {}), {})
    coordinates, lower, upper, velocity, _ = apply_robot_limits(
        full, model, RobotSchema(urdf="robot.urdf"), "omni"
    )
    assert coordinates.names[3:] == ("j0",)
    reached = []
    for move in Coordinates(model).moves[3:]:
        name = str(model.names[move.joint])
        ends = sorted(move.factor * np.array([lower[3], upper[3]]) + move.offset)
        low, high = bounds[name]
        assert low - 1e-9 <= ends[0]
        assert ends[1] <= high + 1e-9
        assert abs(move.factor) * velocity[3] <= speeds[name] + 1e-9
        reached.append(
            (
                min(ends[0] - low, high - ends[1]) < 1e-9,
                abs(abs(move.factor) * velocity[3] - speeds[name]) < 1e-9,
            )
        )
    assert all(any(column) for column in zip(*reached, strict=True))
