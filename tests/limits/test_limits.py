"""Tests that exported motions satisfy all limits at 1 kHz, and that violations are found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from limits.__main__ import main
from limits.check import check_motion
from limits.files import Limits, Motion, read_csv, read_npz
from limits.plans import export_plans
from tests.oracle.plan import Curve

COUNT = 4


@pytest.fixture(scope="module")
def plans(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return plans of three tasks and of a random room, with exported tables."""
    return list(export_plans(tmp_path_factory.mktemp("plans"), COUNT))


def test_planned_motions_satisfy_all_limits(
    plans: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(plans) == COUNT
    assert main([str(path) for path in plans]) == 0, capsys.readouterr().out
    assert f"{COUNT} plans" in capsys.readouterr().out


def test_motions_reach_a_limit(plans: list[Path]) -> None:
    verdicts = [check_motion(*read_npz(path)) for path in plans]
    assert min(max(one.velocity, one.acceleration) for one in verdicts) > 0.98
    assert min(one.samples for one in verdicts) > 2000


def test_exported_table_equals_the_saved_plan(plans: list[Path]) -> None:
    for path in plans:
        motion, table = read_npz(path)[0], read_csv(path.with_suffix(".csv"))
        assert table.names == motion.names
        for one, other in zip(vars(table.curve).values(), vars(motion.curve).values(), strict=True):
            np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)


def _speed_up(names: list[str], curve: Curve) -> Curve:
    return replace(curve, times=0.9 * curve.times, velocities=curve.velocities / 0.9)


def _exceed_position(names: list[str], curve: Curve) -> Curve:
    return replace(curve, positions=curve.positions + 6.0 * (np.array(names) == "elbow_joint"))


def _add_kink(names: list[str], curve: Curve) -> Curve:
    velocities = curve.velocities.copy()
    velocities[len(velocities) // 2, 0] += 0.05
    return replace(curve, velocities=velocities)


def _end_moving(names: list[str], curve: Curve) -> Curve:
    velocities = curve.velocities.copy()
    velocities[-1, 1] = 0.01
    return replace(curve, velocities=velocities)


def find_violated_quantities(
    motion: Motion,
    limits: Mapping[str, Limits],
    change: Callable[[list[str], Curve], Curve] | None = None,
) -> set[str]:
    if change is not None:
        motion = replace(motion, curve=change(motion.names, motion.curve))
    return {excess.quantity for excess in check_motion(motion, limits).excesses}


@pytest.mark.parametrize(
    ("change", "quantity"),
    [
        (_speed_up, "acceleration"),
        (_exceed_position, "position"),
        (_add_kink, "acceleration"),
        (_end_moving, "rest"),
    ],
)
def test_violations_of_changed_motions_are_found(
    plans: list[Path], change: Callable[[list[str], Curve], Curve], quantity: str
) -> None:
    assert quantity in find_violated_quantities(*read_npz(plans[0]), change)


def test_only_jerk_time_limits_jerk(plans: list[Path], tmp_path: Path) -> None:
    scene, options = vkc.load_scene("drawer"), vkc.Options(jerk_time=0.1)
    plan = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.3})], options=options)
    assert plan.success
    motion, limits = read_npz(plan.save(tmp_path / "eased.npz"))
    assert limits["elbow_joint"].jerk == pytest.approx(14.0)
    assert find_violated_quantities(motion, limits) == set()
    assert "jerk" in find_violated_quantities(motion, limits, _speed_up)
    plain, plain_limits = read_npz(plans[0])
    limits = {
        name: replace(one, jerk=10.0 * one.acceleration) for name, one in plain_limits.items()
    }
    assert "jerk" in find_violated_quantities(plain, limits)
