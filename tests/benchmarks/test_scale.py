"""Tests planning time against the number of obstacles or segments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.experiments import run_benchmark

import vkc_pin as vkc
from tests.benchmarks import scale
from tests.benchmarks.scale import make_crowded_scene, make_refined_options
from vkc_pin.experiments.harness.record import describe_environment


def test_larger_sets_of_obstacles_contain_the_smaller_ones() -> None:
    few, some, many = (make_crowded_scene(count) for count in (10, 30, 300))
    assert [len(scene.obstacle_names) for scene in (few, some, many)] == [10, 30, 300]
    assert some.obstacle_names[:10] == few.obstacle_names
    assert many.document["obstacles"][:30] == some.document["obstacles"]
    assert many.start_clearance() == some.start_clearance()
    assert make_crowded_scene(30, seed=1).document["obstacles"] != some.document["obstacles"]
    assert set(few.obstacle_labels) >= {"wall_west", "wall_above_door", "hall_wall"}


def test_starts_are_shared_and_collision_free_for_all_obstacles() -> None:
    trials = scale.specify(starts=3, seed=4, counts=(30, 100))
    assert [(t["number"], t["obstacles"]) for t in trials] == [
        (n, count) for n in range(3) for count in (30, 100)
    ]
    bases = [t["base"] for t in trials]
    assert bases[::2] == bases[1::2]
    assert len({tuple(base) for base in bases}) == 3
    others = scale.specify(starts=2, seed=4, counts=(10,))
    assert [t["base"] for t in others] == bases[:4:2]
    assert scale.specify(starts=1, seed=5, counts=(10,))[0]["base"] != bases[0]
    for base in bases[::2]:
        assert make_crowded_scene(1000).with_start(base=base).start_clearance() >= 0.03


@pytest.mark.long
@pytest.mark.parametrize(("of", "counts"), [("obstacles", (30, 60)), ("segments", (40, 80))])
def test_planning_times_are_tabulated_by_count(
    of: str, counts: tuple[int, int], tmp_path: Path
) -> None:
    arguments = f"scale --starts 1 --of {of} --counts {counts[1]} {counts[0]}"
    table, trials = run_benchmark(arguments, tmp_path)
    assert [t[of] for t in trials] == list(counts)
    usual = scale.AXES[of].usual
    (reference,) = [t["planning_time"] for t in trials if t[of] == usual]
    for t in trials:
        assert t["success"], t["violations"]
        assert t["base_path_length"] > 1.5 - t["start"][0], (
            "the door is at x = 2.5 m, the arm 1 m long"
        )
        time = t["planning_time"]
        assert f"| {t[of]} | 1 of 1 | {time:.2f} | {time:.2f} | {time / reference:.2f} |" in table
    assert f"ratio to {usual}" in table
    assert (tmp_path / "scale.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("segments", [4, 20, 76, 320])
def test_refined_options_divide_the_same_time(segments: int) -> None:
    refined = make_refined_options(segments)
    usual = vkc.Options()
    parts, shares = (
        np.array([one.reach_waypoints, one.turn_waypoints, one.move_waypoints])
        for one in (refined, usual)
    )
    assert parts.sum() == segments
    assert refined.dt * segments == pytest.approx(usual.dt * shares.sum())
    if segments >= 20:
        np.testing.assert_allclose(parts / segments, shares / shares.sum(), atol=0.05)
    assert (refined == usual) == (segments == 76)


def test_errors_have_no_planning_time() -> None:
    meta = describe_environment(of="obstacles", counts=[12], starts=1, seed=0, time_limit=1.0)
    error = {"obstacles": 12, "number": 0, "success": False, "status": "error"}
    text = scale.format_results({"meta": meta, "trials": [error]})
    assert f"| 12 | 0 of 1 |{' – |' * 9}" in text
