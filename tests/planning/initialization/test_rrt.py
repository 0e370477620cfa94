"""Tests of RRT paths of base and arm: a narrow gate, a pole, no path."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
from helpers.drives import hall
from helpers.gates import GOAL, TIGHT, at, gated
from helpers.small_problems import program_of
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as some

import vkc_pin as vkc
from vkc_pin.planning.initialization import rrt as trees
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.rrt import connect, resample_path
from vkc_pin.utils.budget import Budget, BudgetExhaustedError
from vkc_pin.utils.optional_imports import import_compiled

SIZE = 9  # x, y and yaw of the base, six joints of the arm
METRE = np.array([2.0, 2.0, *np.ones(SIZE - 2)])  # how much each coordinate counts
GRAZE = 1.0  # share of the margins that may be missing
# [m] that may hide between two configurations that are looked at, 0.15 rad apart; 0.011 is the
# worst of 60 ways
HIDDEN = 0.02
SEEDS = st.integers(0, 2**32 - 1)


@cache
def gate() -> tuple[vkc.TrajectoryProblem, np.ndarray, np.ndarray]:
    """Return a problem that needs a folded arm, a guide path, and postures."""
    problem = gated(TIGHT)
    routes = BaseRoutes(problem)
    guide = routes.find_guide_path(0, problem.start[:3], np.array(GOAL), 80)
    assert guide is not None
    return problem, guide, np.array([problem.start[3:], routes.get_folded_arm(0)])


def through(
    seed: int, ends: np.ndarray | None = None, *, tries: int = trees.MAX_EXTENSIONS
) -> np.ndarray | None:
    problem, guide, arms = gate()
    ends = at(problem, GOAL)[None] if ends is None else ends
    return connect(
        problem,
        0,
        problem.start,
        ends,
        poses=guide,
        arms=arms,
        rng=np.random.default_rng(seed),
        tries=tries,
    )


def length(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0) * METRE, axis=1).sum())


def finely(path: np.ndarray, apart: float = 0.02) -> np.ndarray:
    """Return configurations on the straight pieces of a path, at most so far apart [rad]."""
    rows = [path[:1]]
    for a, b in itertools.pairwise(path):
        count = max(1, int(np.ceil(np.abs((b - a) * METRE).max() / apart)))
        rows.append(a + np.arange(1, count + 1)[:, None] / count * (b - a))
    return np.vstack(rows)


def missing(problem: vkc.TrajectoryProblem, rows: np.ndarray) -> np.ndarray:
    """Return the shortfall of the robot over all pairs, shape (B,) [m]."""
    z = np.tile(problem.start, (len(rows), 1))
    z[:, : rows.shape[1]] = rows
    return problem.contacts.evaluate(z, np.ones(len(z), int), reach=0.1).compute_shortfall(len(z))


def test_finer_search_finds_collisions_that_a_coarse_one_misses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    worst = []
    for steps in ((3.0, 3.0), (3.0, 0.04)):
        monkeypatch.setattr(trees, "_STEP_SIZES", steps)
        path = through(3)
        assert path is not None
        worst.append(missing(gate()[0], finely(path)).max())
    margin = gate()[0].options.dist_safe
    assert worst[1] < margin + 0.005
    assert worst[0] > margin + 0.02


def test_needless_joint_motion_is_removed() -> None:
    """A needless turn of the wrist is straightened."""
    problem, guide, arms = gate()
    first = problem.start[:SIZE]
    middle, last = first.copy(), first.copy()
    middle[-1] += 2.0
    last[-1] += 0.4
    search = trees._Search(problem, 0, problem.start, guide, arms, np.random.default_rng(0), 0.04)
    path = np.array([first, middle, last])
    straight = search.straighten(path)
    np.testing.assert_array_equal(straight[0], first)
    np.testing.assert_allclose(straight[-1], last, atol=1e-12)
    assert np.abs(np.diff(straight[:, -1])).sum() == pytest.approx(0.4, abs=1e-6)
    assert search.is_free(straight)


@settings(max_examples=4, deadline=None)
@given(SEEDS)
def test_straightened_paths_are_free_and_no_longer(seed: int) -> None:
    problem, guide, arms = gate()
    path = through(seed)
    assert path is not None
    search = trees._Search(
        problem, 0, problem.start, guide, arms, np.random.default_rng(seed), 0.04
    )
    again = search.straighten(path)
    assert length(again) <= length(path) + 1e-9
    np.testing.assert_allclose(again[[0, -1]], path[[0, -1]], atol=1e-12)
    is_a_way(problem, again)


@pytest.mark.parametrize(
    ("there", "back", "far"),
    [(1.0, 0.0, False), (1.2, 0.2, False), (2.0, 1.5, True), (3.0, 0.0, False)],
)
def test_arm_detour_exceeds_a_third_of_the_path(there: float, back: float, far: bool) -> None:
    """A shoulder turns back and forth in one of two phases."""
    problem = program_of(hall(), [vkc.GoTo(0.5, 0.0), vkc.GoTo(1.0, 0.0)])
    z, middle = np.tile(problem.start, (problem.segments, 1)), int(problem.ends[0])
    z[:, 0] = np.linspace(0.0, 1.0, len(z))
    turn = problem.segments - middle
    z[middle:, 3] += np.interp(
        np.arange(1, turn + 1), [0, turn // 2, turn], [0.0, there, there - back]
    )
    assert trees.has_arm_detour(problem, z) == far


@pytest.mark.parametrize("finer", [True, False])
def test_paths_in_collision_between_checks_are_rejected(
    monkeypatch: pytest.MonkeyPatch, finer: bool
) -> None:
    straight = np.array([gate()[0].start, at(gate()[0], GOAL)])

    def run(search: trees._Search, ends: np.ndarray, most: int) -> np.ndarray | None:
        return straight if search.step == trees._STEP_SIZES[0] or finer else None

    monkeypatch.setattr(trees._Search, "run", run)
    path = through(0)
    assert (path is not None) == finer


@pytest.mark.parametrize(("detour", "passes"), [(0.3, 1), (0.35, 3)])
def test_detours_are_straightened_as_long_as_that_pays_off(
    monkeypatch: pytest.MonkeyPatch, detour: float, passes: int
) -> None:
    """Shortcuts shorten a path as a whole and in two passes, then stop."""
    problem, guide, arms = gate()
    search = trees._Search(problem, 0, problem.start, guide, arms, np.random.default_rng(0), 0.04)
    asked: list[int] = []

    def evened(path: np.ndarray, times: int) -> np.ndarray:
        asked.append(times)
        return path[0] + (0.9 if len(asked) <= 3 else 1.0) * (path - path[0])

    monkeypatch.setattr(search, "_shorten_partially", evened)
    monkeypatch.setattr(trees, "_compute_detour", lambda path, metric: detour)
    path = np.tile(problem.start[:SIZE], (2, 1))
    path[1, 3] += 1.0
    search.straighten(path)
    assert asked == [0, *[trees._SHORTCUT_ROUNDS] * passes]


def test_detour_is_the_excess_share_of_the_arm() -> None:
    problem, metric = gate()[0], gate()[0].chain.metric[:SIZE]
    path = np.tile(problem.start[:SIZE], (3, 1))
    path[1:, 0] += [0.5, 0.0]
    path[1:, 4] += [0.3, 0.1]
    driven, turned = problem.chain.metric[[0, 4]]  # what a metre and a radian count
    assert trees._compute_detour(path, metric) == pytest.approx(
        0.4 * turned / (1.0 * driven + 0.5 * turned)
    )
    assert trees._compute_detour(path[[0, 2]], metric) == pytest.approx(0.0)
    assert trees._compute_detour(path[:1], metric) == 0.0


def is_a_way(problem: vkc.TrajectoryProblem, path: np.ndarray) -> None:
    short, allowed = missing(problem, finely(path)), GRAZE * problem.options.dist_safe
    assert short.max() <= allowed + HIDDEN
    assert np.mean(short > allowed + 1e-6) < 0.1
    limits = np.array([problem.limits(name) for name in problem.chain.names[: path.shape[1]]])
    assert np.all((path >= limits[:, 0]) & (path <= limits[:, 1]))


# --- what is found
# ------------------------------------------------------------


@settings(max_examples=8, deadline=None)
@given(SEEDS)
def test_path_leads_through_the_gate(seed: int) -> None:
    problem, _, _ = gate()
    straight = np.array([problem.start, at(problem, GOAL)])
    assert missing(problem, finely(straight)).max() > 0.1, (
        "the arm at home does not hit the gate: choose a narrower one"
    )
    path = through(seed)
    assert path is not None
    np.testing.assert_array_equal(path[[0, -1]], straight)
    is_a_way(problem, path)
    inside = (
        np.abs(finely(path)[:, 0] + 0.3 - 2.0) < 0.1
    )  # the arm at home is at the front, from 0.2 to 0.45
    assert np.abs(finely(path)[inside][:, 3:] - problem.start[3:]).max(axis=1).min() > 0.2, (
        "the arm is not at home there"
    )


@settings(max_examples=4, deadline=None)
@given(SEEDS, st.integers(1, 3))
def test_path_ends_at_a_reachable_end(seed: int, free: int) -> None:
    problem, _, arms = gate()
    ends = np.tile(at(problem, (2.0, 1.5, 0.0)), (4, 1))  # in the wall
    ends[:free, :3] = GOAL
    ends[:free, 3:] = arms[np.arange(free) % 2]
    path = through(seed, np.random.default_rng(seed).permutation(ends))
    assert path is not None
    assert any(np.array_equal(path[-1], end) for end in ends[:free])
    is_a_way(problem, path)


@pytest.mark.parametrize(
    "pose", [(2.0, 1.5, 0.0), (4.0, 0.5, 0.0)], ids=["in the wall", "behind a wall without a gate"]
)
def test_walled_in_goal_has_no_path(pose: tuple[float, float, float]) -> None:
    problem = gated(0.0)
    poses, arms = np.array([problem.start[:3], pose]), problem.start[None, 3:]
    for seed in range(2):
        rng = np.random.default_rng(seed)
        assert (
            connect(
                problem,
                0,
                problem.start,
                at(problem, pose)[None],
                poses=poses,
                arms=arms,
                rng=rng,
                tries=400,
            )
            is None
        )


def test_least_violating_end_is_tried() -> None:
    """A goal slightly within the margin is reached; one in the wall is not."""
    problem, _, arms = gate()
    there, allowed = (
        np.array([*at(problem, (1.895 - 0.49, 1.5, np.pi / 2))[:3], *arms[1]]),
        GRAZE * problem.options.dist_safe,
    )
    towards = np.tile(there, (241, 1))
    towards[:, 0] += np.linspace(-0.3, 0.3, 241)
    short = missing(problem, towards)
    near = towards[int(np.argmax(short > allowed))]
    assert allowed < missing(problem, near[None])[0] < allowed + 3e-3
    ends, poses = np.array([towards[-1], near]), np.array([problem.start[:3], near[:3]])
    path = connect(
        problem, 0, problem.start, ends, poses=poses, arms=arms, rng=np.random.default_rng(0)
    )
    assert path is not None
    np.testing.assert_array_equal(path[[0, -1]], [problem.start, near])
    assert missing(problem, finely(path)).max() <= allowed + HIDDEN


def test_path_to_the_start_stays_there() -> None:
    problem, guide, arms = gate()
    ends, rng = problem.start[None], np.random.default_rng(0)
    path = connect(problem, 0, problem.start, ends, poses=guide, arms=arms, rng=rng)
    assert path is not None
    np.testing.assert_array_equal(path, np.tile(problem.start, (len(path), 1)))
    np.testing.assert_array_equal(
        resample_path(path, 5, problem.chain.metric[: path.shape[1]]),
        np.tile(problem.start, (5, 1)),
    )


def test_free_path_is_straight() -> None:
    """The straight line is tried before sampling."""
    problem = program_of(hall(), [vkc.GoTo(2.0, 1.0, 0.5)])
    end = at(problem, (2.0, 1.0, 0.5))
    end[3:] += 0.3
    path = connect(
        problem,
        0,
        problem.start,
        end[None],
        poses=end[None, :3],
        arms=end[None, 3:],
        rng=np.random.default_rng(0),
    )
    assert path is not None
    np.testing.assert_array_equal(path[[0, -1]], [problem.start, end])
    assert length(path) == pytest.approx(length(np.array([problem.start, end])), rel=1e-9)


def test_arm_on_a_fixed_base_avoids_a_pole() -> None:
    pole = {
        "name": "pole",
        "type": "cylinder",
        "radius": 0.05,
        "length": 1.2,
        "position": [0.37, 0.25, 1.7],
    }  # from the ceiling
    problem = program_of(
        hall(base="fixed", obstacles=[pole]), [vkc.Reach((0.6, 0.35, 0.9, 0.0, np.pi / 2, 0.0))]
    )
    first, last = problem.start.copy(), problem.start.copy()
    first[3:6], last[3:6] = (0.57, -1.2, -1.2), (2.57, -1.2, -1.2)
    assert missing(problem, np.array([first, last])).max() == 0.0
    assert missing(problem, finely(np.array([first, last]))).max() > 0.05, (
        "the pole is not in the way"
    )
    arms = np.array([first[3:], last[3:]])
    path = connect(
        problem,
        0,
        first,
        last[None],
        poses=first[None, :3],
        arms=arms,
        rng=np.random.default_rng(0),
    )
    assert path is not None
    np.testing.assert_array_equal(path[[0, -1]], [first, last])
    np.testing.assert_array_equal(path[:, :3], np.tile(first[:3], (len(path), 1)))
    is_a_way(problem, path)


def test_equal_random_seeds_give_equal_paths() -> None:
    one, same, other = through(3), through(3), through(4)
    assert one is not None
    assert same is not None
    assert other is not None
    np.testing.assert_array_equal(one, same)
    assert one.shape != other.shape or not np.array_equal(one, other)


def test_shortcuts_do_not_lengthen_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    """The trees are the same, since they grow before."""
    for seed in range(3):
        short = through(seed)
        with monkeypatch.context() as patch:
            patch.setattr(trees._Search, "_shorten", lambda _, path: path)
            plain = through(seed)
        assert short is not None
        assert plain is not None
        np.testing.assert_array_equal(short[[0, -1]], plain[[0, -1]])
        assert np.abs(np.diff(plain, axis=0)).max(axis=1).min() > 0.0, (
            "it stops where the trees meet"
        )
        assert length(short) <= length(plain) + 1e-9
        if seed == 0:
            assert length(short) < 0.9 * length(plain)


# --- parts of the way that are free
# ------------------------------------------------------------


def search(seed: int = 0) -> trees._Search:
    problem, guide, arms = gate()
    return trees._Search(
        problem, 0, problem.start, guide, arms, np.random.default_rng(seed), trees._STEP_SIZES[0]
    )


def test_free_share_ends_before_the_first_collision() -> None:
    problem, guide, arms = gate()
    finder, rng, shares = search(), np.random.default_rng(5), []
    for _ in range(60):
        a, b = (
            np.concatenate([guide[rng.integers(len(guide)), :3], arms[rng.integers(len(arms))]])
            for _ in range(2)
        )
        b = b + 0.3 * rng.normal(size=SIZE)
        count = max(1, int(np.ceil(np.abs((b - a) * finder.weights).max() / finder.step)))
        rows = a + np.arange(1, count + 1)[:, None] / count * (b - a)
        blocked = np.flatnonzero(missing(problem, rows) > finder.allowed)
        shares.append(blocked[0] / count if len(blocked) else 1.0)
        assert finder.compute_free_share(a, b) == shares[-1]
    assert (min(shares), max(shares)) == (0.0, 1.0)
    assert len(set(shares)) > 5


def test_runs_are_free_sections_with_each_arm() -> None:
    """Sections are maximal, and free half-way between their rows."""
    problem, guide, arms = gate()
    allowed = GRAZE * problem.options.dist_safe + 1e-9
    through_gate, all_ = [], search().free_runs
    for arm in arms:
        rows = np.column_stack([guide, np.tile(arm, (len(guide), 1))])
        free, between = (
            missing(problem, rows) <= allowed,
            missing(problem, (rows[1:] + rows[:-1]) / 2) <= allowed,
        )
        own = [run for run in all_ if np.array_equal(run[0, 3:], arm)]
        covered = np.zeros(len(rows), int)
        for run in own:
            (begin,) = np.flatnonzero((rows == run[0]).all(axis=1))
            end = begin + len(run)
            np.testing.assert_array_equal(run, rows[begin:end])
            assert free[begin:end].all()
            assert between[begin : end - 1].all()
            assert begin == 0 or not (free[begin - 1] and between[begin - 1])
            assert end == len(rows) or not (free[end] and between[end - 1])
            covered[begin:end] += 1
        np.testing.assert_array_equal(covered, free.astype(int))
        through_gate.append(any(run[0, 0] < 1.0 and run[-1, 0] > 3.0 for run in own))
    assert through_gate == [False, True], "the arm has to be folded"
    assert sum(map(len, all_)) < 2 * len(guide)


def raw(one: trees._Search, ends: np.ndarray, tries: int) -> np.ndarray:
    """Return the path of the trees before shortcuts."""
    return np.asarray(one._trees.run(one.first[None, :SIZE], ends, tries))


def test_tree_that_reaches_a_run_adds_all_of_it() -> None:
    """Only the run leads through the gate."""
    problem, _, _ = gate()
    for seed in range(3):
        one = search(seed)
        run = max(one.free_runs, key=len)
        one.free_runs, one.poses, one.arms = [run], problem.start[None, :3], problem.start[None, 3:]
        end = run[-1].copy()
        end[3:] += 0.05
        path = raw(one, end[None], 200)
        rows = [
            int(np.flatnonzero((path == row).all(axis=1))[0])
            for row in run
            if (path == row).all(axis=1).any()
        ]
        assert len(rows) > len(run) / 3
        assert np.all(np.diff(rows) == 1), "they follow each other as on the run"
        is_a_way(problem, path)


def test_tree_that_is_blocked_does_not_add_a_run() -> None:
    problem, _, arms = gate()
    one = search()
    one.free_runs = [np.tile(np.append([2.0, 1.5, 0.0], arms[0]), (3, 1))]  # in the wall
    path = raw(one, at(problem, GOAL)[None], trees.MAX_EXTENSIONS)
    assert len(path)
    assert not (path == one.free_runs[0][0]).all(axis=1).any()
    is_a_way(problem, path)


@pytest.mark.parametrize("found", [True, False])
def test_free_runs_alone_lead_through_the_gate(found: bool) -> None:
    """No sample leads through the gate."""
    problem, _, _ = gate()
    for seed in range(3):
        one = search(seed)
        one.free_runs = one.free_runs if found else []
        one.poses, one.arms = problem.start[None, :3], problem.start[None, 3:]
        path = raw(one, at(problem, GOAL)[None], 60)
        assert (len(path) > 0) == found
        if found:
            is_a_way(problem, path)


def test_collision_checks_count_as_evaluations() -> None:
    problem, _, _ = gate()
    with Budget().activate() as budget:
        through(0)
        whole = budget.evaluations
        one = search()
        assert one._trees
        before = budget.evaluations
        assert one.is_free(np.array([problem.start, problem.start + 0.01 * np.eye(SIZE)[3]]))
        assert budget.evaluations == before + 1
    assert whole > 500
    with Budget(effort=whole // 2).activate(), pytest.raises(BudgetExhaustedError):
        through(0)


def test_compiled_trees_reject_invalid_arguments() -> None:
    one = search()
    rows = np.zeros((2, SIZE))
    for call in (
        lambda: one._trees.run(rows[:, 1:], rows, 1),
        lambda: one._trees.run(rows, rows, 1),
        lambda: one._trees.run(rows[:1], rows[:0], 1),
        lambda: one._trees.along(rows[:1]),
        lambda: one._trees.along(rows[:, :3]),
        lambda: one._trees.evened(rows[:0], 0, 0.0),
    ):
        with pytest.raises(ValueError, match=r"robot's coordinates|one configuration|two ends"):
            call()
    trees_of = import_compiled("vkc_pin.planning.initialization._trees").Trees
    good = [
        one.weights,
        one.lower,
        one.upper,
        one.poses[:2],
        one.arms,
        np.concatenate(one.free_runs),
        [len(run) for run in one.free_runs],
    ]

    def made(**changed: object) -> None:
        parts = {f"part{k}": value for k, value in enumerate(good)} | changed
        rows = [
            np.ascontiguousarray(value, np.int64 if name == "part6" else float)
            for name, value in parts.items()
        ]
        trees_of(one._lines, *rows, 0.1, 0.4, 7)

    made()
    for number, wrong in enumerate(
        (one.weights[1:], one.lower[1:], one.upper[1:], one.poses[:0], one.arms[:, 1:], rows[:, 1:])
    ):
        with pytest.raises(ValueError, match="of the robot's coordinates"):
            made(**{f"part{number}": wrong})
    with pytest.raises(ValueError, match="as long as is said"):
        made(part6=[10**6])


def test_lines_reject_invalid_arguments() -> None:
    one, contacts = search(), gate()[0].contacts
    how = {"weights": one.weights, "step": 0.1, "reach": 0.0, "allowed": 0.0}
    with pytest.raises(ValueError, match="more coordinates move"):
        contacts.make_line_checker(one.first, one.waypoint, **how | {"weights": np.ones(40)})
    with pytest.raises(ValueError, match="no step"):
        contacts.make_line_checker(one.first, one.waypoint, **how | {"step": 0.0})
    with pytest.raises(IndexError, match="no such coordinate"):
        contacts.make_line_checker(one.first[:-1], one.waypoint, **how)


# --- spread
# ------------------------------------------------------------

PATHS = st.integers(1, 6).flatmap(
    lambda count: some.arrays(
        np.float64, (count, SIZE), elements=st.floats(-5.0, 5.0, allow_subnormal=False)
    )
)


def walk(path: np.ndarray, far: float) -> np.ndarray:
    """Return the point after a given length of a path [rad]."""
    for a, b in itertools.pairwise(path):
        piece = length(np.array([a, b]))
        if far <= piece:
            return np.asarray(a + (far / piece if piece > 0.0 else 0.0) * (b - a))
        far -= piece
    return np.asarray(path[-1])


@settings(max_examples=60, deadline=None)
@given(PATHS, st.integers(1, 30))
def test_resampled_path_reaches_the_end(path: np.ndarray, steps: int) -> None:
    rows = resample_path(path, steps, METRE)
    assert rows.shape == (steps, SIZE)
    np.testing.assert_allclose(rows[-1], path[-1], rtol=0.0, atol=1e-9)
    share = np.arange(1, steps + 1) / steps
    passed = length(path) * (3 * share**2 - 2 * share**3)
    assert np.all(np.diff(passed) > -1e-9)
    np.testing.assert_allclose(rows, [walk(path, far) for far in passed], rtol=0.0, atol=1e-5)


def test_resampled_path_is_slow_at_both_ends() -> None:
    path = np.zeros((3, SIZE))
    path[1:, 0], path[2, 4] = (
        1.0,
        2.0,
    )  # a metre of the base counts as much as two radians of the arm
    rows = np.vstack([path[:1], resample_path(path, 20, METRE)])
    steps = np.linalg.norm(np.diff(rows, axis=0) * METRE, axis=1)
    assert max(steps[0], steps[-1]) < 0.15 * steps.max()
    np.testing.assert_allclose(rows[10], path[1], atol=1e-9)
