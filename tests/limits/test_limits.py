"""Tests that exported motions satisfy all limits at 1 kHz, and that violations are found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from limits.__main__ import main
from limits.check import check_motion
from limits.files import Motion, read_csv, read_limits, read_npz
from limits.plans import export_plans

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
    for path in plans:
        motion, metadata = read_npz(path)
        verdict = check_motion(motion, read_limits(metadata, path))
        assert max(verdict.velocity, verdict.acceleration) > 0.98
        assert verdict.samples > 2000


def test_exported_table_equals_the_saved_plan(plans: list[Path]) -> None:
    for path in plans:
        motion, table = read_npz(path)[0], read_csv(path.with_suffix(".csv"))
        assert table.names == motion.names
        for one, other in zip(vars(table).values(), vars(motion).values(), strict=True):
            if isinstance(one, np.ndarray):
                np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12)


def _speed_up(motion: Motion) -> Motion:
    return Motion(motion.names, 0.9 * motion.times, motion.positions, motion.velocities / 0.9)


def _exceed_position(motion: Motion) -> Motion:
    positions = motion.positions.copy()
    positions[:, motion.names.index("elbow_joint")] += 6.0
    return Motion(motion.names, motion.times, positions, motion.velocities)


def _add_kink(motion: Motion) -> Motion:
    velocities = motion.velocities.copy()
    velocities[len(velocities) // 2, 0] += 0.05
    return Motion(motion.names, motion.times, motion.positions, velocities)


def _end_moving(motion: Motion) -> Motion:
    velocities = motion.velocities.copy()
    velocities[-1, 1] = 0.01
    return Motion(motion.names, motion.times, motion.positions, velocities)


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
    plans: list[Path], change: Callable[[Motion], Motion], quantity: str
) -> None:
    motion, metadata = read_npz(plans[0])
    verdict = check_motion(change(motion), read_limits(metadata, plans[0]))
    assert quantity in {excess.quantity for excess in verdict.excesses}, [
        str(excess) for excess in verdict.excesses
    ]


def test_only_jerk_time_limits_jerk(plans: list[Path], tmp_path: Path) -> None:
    scene, options = vkc.load_scene("drawer"), vkc.Options(jerk_time=0.1)
    plan = vkc.plan(scene, [vkc.Actuate("drawer", {"slide": 0.3})], options=options)
    assert plan.success
    file = plan.save(tmp_path / "eased.npz")
    motion, metadata = read_npz(file)
    limits = read_limits(metadata, file)
    assert limits["elbow_joint"].jerk == pytest.approx(14.0)
    verdict = check_motion(motion, limits)
    assert not verdict.excesses, [str(excess) for excess in verdict.excesses]
    assert {excess.quantity for excess in check_motion(_speed_up(motion), limits).excesses} >= {
        "jerk"
    }
    plain, plain_metadata = read_npz(plans[0])
    jerk_limits = {
        name: replace(limit, jerk=10.0 * limit.acceleration)
        for name, limit in read_limits(plain_metadata, plans[0]).items()
    }
    assert "jerk" in {excess.quantity for excess in check_motion(plain, jerk_limits).excesses}
