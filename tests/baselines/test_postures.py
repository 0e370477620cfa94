"""Where the base may stand: configurations are what they should be, free of collision, and the nearest come first."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.drawers import SHORT, changed, drawer_scene, handle, holding, off, spare, with_boxes
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.baselines import postures as module
from vkc_pin.baselines.postures import base_poses
from vkc_pin.planning.initialization.keyframes import SAMPLE_COUNT, KeyframeSampler


def reaching(scene: vkc.Scene, attachment: str = "handle") -> vkc.TrajectoryProblem:
    return program_of(scene, [vkc.Grasp("drawer", attachment)], options=SHORT)


@cache
def pulling() -> vkc.TrajectoryProblem:
    return program_of(holding(), [vkc.Actuate("drawer", {"slide": 0.3})], options=SHORT)


def found(
    problem: vkc.TrajectoryProblem, waypoint: int | None = None, *, seed: int = 0, near: Any = None
) -> np.ndarray:
    near = problem.start if near is None else near
    return base_poses(
        problem,
        problem.segments if waypoint is None else waypoint,
        near,
        np.random.default_rng(seed),
    )


def far(rows: np.ndarray, near: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Return how far rows are from `near`: a metre of the base counts as what moves the hand by a metre."""
    lever = 0.3249  # [m/rad] of this arm
    counts = [1.0 / lever if name in ("base_x", "base_y") else 1.0 for name in names]
    return np.array(
        [sum(c * abs(a - b) for c, a, b in zip(counts, row, near, strict=True)) for row in rows]
    )


@pytest.mark.parametrize("seed", range(2))
def test_from_where_the_arm_reaches_the_handle(seed: int) -> None:
    scene, problem = drawer_scene(), reaching(drawer_scene())
    rows = found(problem, seed=seed)
    assert rows.shape == (module.ENOUGH, problem.chain.size)
    assert max(off(scene, row, handle()) for row in rows) < 1e-4 * np.sqrt(3)
    assert min(spare(scene, row) for row in rows) >= -1e-6
    assert np.all((rows >= problem.lower[-1]) & (rows <= problem.upper[-1]))
    assert np.all(rows[:, -1] == 0.0), "the drawer is still shut"
    assert np.ptp(rows[:, 0]) > 0.3, "they are from all over"
    assert np.ptp(rows[:, 1]) > 0.3


def test_from_where_it_reaches_the_handle_when_all_is_done() -> None:
    problem = pulling()
    rows = found(problem)
    assert len(rows) > 10
    assert max(off(problem.scene, row, handle(0.3)) for row in rows) < 1e-4 * np.sqrt(3)
    assert min(spare(problem.scene, row, slide=0.3, held=True) for row in rows) >= -1e-6
    assert np.all(rows[:, -1] == 0.3)


def test_half_way() -> None:
    """The drawer is where its time law has it by then."""
    problem = pulling()
    half = problem.segments // 2
    rows = found(problem, half)
    assert len(rows) > 10
    assert max(off(problem.scene, row, handle(0.15)) for row in rows) < 1e-4 * np.sqrt(3)
    assert min(spare(problem.scene, row, slide=0.15, held=True) for row in rows) >= -1e-6


def test_the_nearest_come_first() -> None:
    problem = reaching(drawer_scene(), "handle_free")
    near = problem.start.copy()
    near[:3] = [0.8, -0.6, 0.3]
    for rows, from_there in ((found(problem), problem.start), (found(problem, near=near), near)):
        distances = far(rows, from_there, problem.chain.names)
        assert np.all(np.diff(distances) >= 0.0)
        assert distances[-1] > distances[0] + 1.0
    assert not np.array_equal(found(problem)[0], found(problem, near=near)[0])


def test_enough_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ENOUGH", 7)
    assert len(found(reaching(drawer_scene()))) == 7


def test_the_same_numbers_give_the_same_poses() -> None:
    problem = reaching(drawer_scene())
    np.testing.assert_array_equal(found(problem), found(problem))
    assert not np.array_equal(found(problem), found(problem, seed=1))


def out_of_reach() -> vkc.Scene:
    scene = drawer_scene()
    return changed(scene, objects=[{**scene.document["objects"][0], "position": [1.93, 0.0, 2.0]}])


def behind_a_board() -> vkc.Scene:
    """A board before the cabinet, so close that no hand fits between."""
    return with_boxes(drawer_scene(), board=([0.02, 1.0, 1.2], [1.7, 0.0, 0.6]))


@pytest.mark.parametrize(
    "scene", [out_of_reach(), behind_a_board()], ids=["out of reach", "always in collision"]
)
def test_nothing_is_reached(scene: vkc.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """And so many seeds are tried as are allowed, rounded up to whole lots."""
    problem, lots = reaching(scene), []
    knot = KeyframeSampler.sample

    def counted(
        self: KeyframeSampler, before: np.ndarray, waypoint: int, how: str
    ) -> tuple[np.ndarray, np.ndarray]:
        lots.append((len(before), how))
        return knot(self, before, waypoint, how)

    monkeypatch.setattr(module, "TRIES", 5 * SAMPLE_COUNT + 1)
    monkeypatch.setattr(KeyframeSampler, "sample", counted)
    assert found(problem).shape == (0, problem.chain.size)
    assert lots == [(SAMPLE_COUNT, "scatter")] * 6
