"""Tests that coordinates of coupled joints have the tightest limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.telescopes import format_joint, format_link, write_telescope

import vkc_pin as vkc


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
    parts = [format_link(f"l{k}", "0.1 0.1 0.1", f"0 0 {k}") for k in range(3)]
    parts += [format_joint("one", kinds[0], "l0", "l1", limits=first, velocity=0.4)]
    parts += [
        format_joint(
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


def test_default_limits_apply_to_the_fastest_joint(tmp_path: Path) -> None:
    couplings = (
        "out_2: {joint: out_1, multiplier: 0.5}, "
        "out_3: {joint: out_1, multiplier: -2.0, offset: 0.15}"
    )
    file = write_telescope(tmp_path, couplings=couplings).parent / "robot.urdf"
    file.write_text(file.read_text().replace('velocity="0.5" ', ""))
    robot = vkc.load_robot(tmp_path)
    assert (robot.velocity[4], robot.acceleration[4]) == (0.05, 0.7)


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
