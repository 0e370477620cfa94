from __future__ import annotations

import numpy as np
import pytest
from helpers.small_problems import SHORT, door_scene, program_of
from numpy.typing import NDArray

import vkc_pin as vkc
from vkc_pin.planning.initialization.beam_search import BeamSearch, _Mode
from vkc_pin.planning.initialization.keyframes import KeyframeSampler


def beam(seed: int = 0) -> BeamSearch:
    problem = program_of(door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=SHORT)
    return BeamSearch(KeyframeSampler(problem, np.random.default_rng(seed)))


def test_path_cost_equals_the_objective_in_radians_of_the_arm() -> None:
    search = beam()
    metre = 1.0 / np.sqrt(0.025)
    start = search.problem.start[None]
    for column, expected in ((0, metre), (1, metre), (2, 1.0), (3, 1.0)):
        moved = start.copy()
        moved[0, column] -= 0.5
        assert search._compute_path_cost(start, moved, 0)[0] == pytest.approx(
            0.5 * expected, rel=1e-12
        )
    moved = start.copy()
    moved[0, :2] += [0.3, 0.4]
    assert search._compute_path_cost(start, moved, 0)[0] == pytest.approx(0.5 * metre, rel=1e-12)
    lever = search.problem.chain.robot.lever
    assert search.sampler.weights[:3].tolist() == [
        1 / lever,
        1 / lever,
        1.0,
    ]  # inverse kinematics, and the baselines


class Ways:
    """Routes twice as long as straight lines."""

    def compute_distances(
        self, phase: int, first: NDArray[np.float64], last: NDArray[np.float64], *, folded: bool
    ) -> NDArray[np.float64]:
        return np.asarray(2.0 * np.linalg.norm(last[:, :2] - first[:, :2], axis=1))


def test_path_cost_uses_route_lengths() -> None:
    search = beam()
    search.routes = Ways()  # type: ignore[assignment]
    start = search.problem.start[None]
    moved = start.copy()
    moved[0, :2] += [0.3, 0.4]
    assert search._compute_path_cost(start, moved, 0)[0] == pytest.approx(
        2 * 0.5 / np.sqrt(0.025), rel=1e-12
    )


def scattered(monkeypatch: pytest.MonkeyPatch, share: float) -> int:
    """Return the number of batches if a share of the grasps is free."""
    search, draws = beam(), list[str]()
    knot = search.sampler.sample

    def counted(
        before: NDArray[np.float64], waypoint: int, how: str
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        draws.append(how)
        z, _ = knot(before, waypoint, how)
        return z, np.ones(len(z), bool)

    def depth(z: NDArray[np.float64], waypoint: int) -> NDArray[np.float64]:
        return np.where(np.arange(len(z)) < share * len(z), 0.0, 0.1)

    monkeypatch.setattr(search.sampler, "sample", counted)
    monkeypatch.setattr(search.sampler, "compute_shortfall", depth)
    grasp = int(search.problem.ends[0])
    search._sample_continuations(
        search.problem.start[None, None],
        np.zeros(1),
        grasp,
        0,
        _Mode(thorough=False, backwards=False),
    )
    return draws.count("scatter")


@pytest.mark.parametrize(
    ("holding", "free", "pushed"),
    [
        (False, 0, True),
        (False, 59, True),
        (False, 60, False),
        (True, 0, True),
        (True, 23, True),
        (True, 24, False),
    ],
)
def test_no_configurations_are_pushed_if_enough_are_free(
    monkeypatch: pytest.MonkeyPatch, holding: bool, free: int, pushed: bool
) -> None:
    """In closed phases a few are sufficient, since there are many keyframes."""
    search, called = beam(), list[int]()

    def clear(z: NDArray[np.float64], waypoint: int) -> NDArray[np.float64]:
        called.append(len(z))
        return z

    monkeypatch.setattr(search.sampler, "push_clear", clear)
    z, bad = np.tile(search.problem.start, (96, 1)), np.where(np.arange(96) < free, 0.0, 50.0)
    paths, parents = search.problem.start[None, None], np.zeros(96, int)
    knot = int(search.problem.ends[-1 if holding else 0])
    _, after, _ = search._add_pushed(paths, np.zeros(1), parents, z, bad, knot, 2 if holding else 0)
    assert bool(called) == pushed
    assert len(after) == 96 + sum(called)


@pytest.mark.parametrize(("share", "least", "most"), [(1.0, 1, 2), (0.25, 3, 4), (0.0, 6, 6)])
def test_grasps_are_sampled_until_enough_are_free(
    monkeypatch: pytest.MonkeyPatch, share: float, least: int, most: int
) -> None:
    assert least <= scattered(monkeypatch, share) <= most
