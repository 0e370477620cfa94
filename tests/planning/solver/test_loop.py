from __future__ import annotations

import dataclasses
import itertools
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.drives import hall, moved, through
from helpers.small_problems import door_scene, program_of

import vkc_pin as vkc
from vkc_pin.planning.initialization.methods import initialize
from vkc_pin.planning.nlp.merit import GROWTH, TOLERANCE, Infeasibility, Merit
from vkc_pin.planning.nlp.timing import Timing
from vkc_pin.planning.solver import loop as solver
from vkc_pin.planning.solver import trust_region
from vkc_pin.planning.solver.loop import Solution, solve
from vkc_pin.planning.solver.segment_planes import find_segment_contacts
from vkc_pin.planning.solver.tunnelling import Crossing
from vkc_pin.utils.budget import Budget

FEW = vkc.Options(reach_waypoints=20, max_outer=12)
PILLAR = {
    "name": "pillar",
    "type": "cylinder",
    "radius": 0.15,
    "length": 1.6,
    "position": [1.6, 0.05, 0.8],
}


@cache
def round_a_pillar() -> vkc.TrajectoryProblem:
    return program_of(hall(obstacles=[PILLAR]), [vkc.GoTo(3.2, 0.0, 0.0)], options=FEW)


def straight(problem: vkc.TrajectoryProblem, x: float, y: float = 0.0) -> np.ndarray:
    scene = problem.scene
    return through(
        scene, scene.start, moved(scene.start, x=x, y=y), steps=problem.segments
    ).positions[1:]


@cache
def solved() -> Solution:
    return solve(round_a_pillar(), straight(round_a_pillar(), 3.2))


@cache
def hard() -> Solution:
    """Return a solution from a stationary guess, without the progress test: steps are rejected."""
    options = vkc.Options(reach_waypoints=15, turn_waypoints=4, move_waypoints=12, max_outer=10)
    problem = program_of(door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=options)
    (seed,) = initialize(problem, "stationary", 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "PROGRESS", np.inf)
        return solve(problem, seed.z)


def feasible(problem: vkc.TrajectoryProblem, solution: Solution) -> None:
    """Check all constraints at the waypoints, and collisions between them."""
    z = solution.z
    assert np.all((z >= problem.lower - 1e-6) & (z <= problem.upper + 1e-6))
    assert problem.evaluate_contacts(z, reach=0.1).compute_violation() < 1e-3
    assert problem.pose_error(z) < 1e-3
    first, second = problem.rates(z)
    still = problem.timing_for(problem.still)
    assert dataclasses.replace(still, dt=solution.dt).compute_violation(first, second) < 1e-3
    assert problem.drift(z) < 1.0
    path = problem.waypoints(z)
    states = np.concatenate(
        [(1 - s) * path[:-1] + s * path[1:] for s in np.linspace(0.0, 1.0, 12)[1:-1]]
    )
    between = problem.contacts.evaluate(states, np.tile(np.arange(1, len(path)), 10), reach=0.0)
    assert len(between.waypoint) == 0, between.distance.min()


def test_solver_avoids_an_obstacle() -> None:
    problem = round_a_pillar()
    assert problem.evaluate_contacts(straight(problem, 3.2), reach=0.0).compute_clearance() < -0.1
    assert solved().converged
    assert solved().status == "converged"
    feasible(problem, solved())


def test_rounds_iterations_and_times_are_recorded() -> None:
    for solution in (solved(), hard()):
        assert solution.rounds == len(solution.history)
        assert solution.iterations == solution.history[-1].iterations
        assert set(solution.timings) == {"coal", "casadi", "ipopt"}
        assert all(value > 0.0 for value in solution.timings.values())


@pytest.mark.parametrize("solution", [solved, hard], ids=["pillar", "door"])
def test_history_is_monotonic(solution) -> None:  # type: ignore[no-untyped-def]
    history = solution().history
    assert all(
        0.0 <= row.time < 1000.0 for row in history
    )  # since the solver began, not since the machine did
    assert [row.round for row in history] == list(range(1, len(history) + 1))
    for name in ("iterations", "time", "penalty"):
        assert np.all(np.diff([getattr(row, name) for row in history]) >= 0), name
    for row in history:
        assert row.step <= row.radius * (1 + 1e-6)  # the trust region holds
        assert row.shortfall >= 0.0
        assert row.objective >= 0.0


def test_rejection_shrinks_the_trust_region() -> None:
    """All waypoints share one radius, and the straight path crosses two walls."""
    walls = [
        {
            "name": f"wall_{k}",
            "type": "box",
            "size": [0.1, 3.0, 1.0],
            "position": [1.5 + 1.2 * k, (-1.0) ** k, 0.5],
        }
        for k in range(2)
    ]
    problem = program_of(
        hall(obstacles=walls), [vkc.GoTo(4.2, 0.0, 0.0)], options=vkc.Options(reach_waypoints=14)
    )
    history = solve(problem, straight(problem, 4.2)).history
    rejected = [(row, after) for row, after in itertools.pairwise(history) if not row.accepted]
    assert rejected, "nothing was rejected: choose a harder problem"
    for row, after in rejected:
        assert after.radius < row.radius or after.penalty > row.penalty


def test_trust_region_continues_with_given_radii() -> None:
    given = np.linspace(0.01, 0.3, 40)
    region = trust_region.TrustRegion(40, 10, given)
    np.testing.assert_array_equal(region.radius, given)
    region.limit()
    np.testing.assert_array_equal(region.radius, np.minimum(given, trust_region.SETTLE_RADIUS))
    region.reset()
    np.testing.assert_array_equal(given, np.linspace(0.01, 0.3, 40))  # it is another's


def blank_trial(segments: int) -> trust_region.Trial:
    """Return a trial with steps of 0.3 and no other fields."""
    fields = dict.fromkeys(field.name for field in dataclasses.fields(trust_region.Trial))
    return trust_region.Trial(**{**fields, "step": np.full(segments, 0.3)})  # type: ignore[arg-type]


def test_solution_continues_with_the_radius_of_another() -> None:
    problem, seed = round_a_pillar(), straight(round_a_pillar(), 3.2)
    first = solve(problem, seed, rounds=3)
    assert first.history[0].radius == trust_region.FIRST_RADIUS
    assert first.radius is not None
    assert first.radius.shape == (problem.segments,)
    assert len(np.unique(first.radius)) > 1, "one radius for all: choose a harder problem"
    assert Solution(seed, problem.timing_for(seed).dt).radius is None
    for radius in (first.radius, np.linspace(0.02, 0.1, problem.segments)):
        kept = radius.copy()
        second = solve(problem, first.z, rounds=1, radius=radius)
        assert second.history[0].radius == radius.max()
        assert np.all(np.abs(second.z - first.z).max(axis=1) <= radius * (1 + 1e-6))
        np.testing.assert_array_equal(radius, kept)


def make_infeasibility(clearance: float, other: float = 0.0) -> Infeasibility:
    amounts = {kind: np.zeros(40) for kind in Merit(1.0).weights}
    amounts["clearance"][:], amounts["poses"][:] = clearance, other
    return Infeasibility(amounts, np.zeros((40, 0, 7)), np.zeros(0), np.zeros(0))


class Scripted:
    """Fake loop whose rounds have given results and acceptance."""

    def __init__(
        self,
        *rounds: tuple[float, float, bool],
        drift: float = 0.0,
        done: bool = False,
        step: float | None = None,
        other: float = 0.0,
    ) -> None:
        self.step, self.other, self.crossed, self.crossings = (
            step,
            other,
            list[Crossing](),
            list[Crossing](),
        )
        self.problem, self.z, self.is_done = (
            SimpleNamespace(drift=lambda _: drift),
            np.zeros((40, 1)),
            done,
        )
        self.solution = Solution(np.zeros((40, 1)), np.full(40, 0.25))
        self.merit, self.found = Merit(200.0), make_infeasibility(0.5, other)
        self.objective, self.rounds, self.radii = 10.0, iter(rounds), list[np.ndarray]()

    def try_step(self, radius: np.ndarray) -> trust_region.Trial:
        self.radii.append(radius.copy())
        objective, shortfall, self.taken = next(self.rounds)
        found = make_infeasibility(shortfall, self.other)
        contacts = SimpleNamespace(
            compute_clearance=lambda: -shortfall,
            compute_violation=lambda: shortfall,
        )
        return dataclasses.replace(
            blank_trial(40),
            z=np.zeros((40, 1)),
            objective=objective,
            infeasibility=found,
            predicted_penalty=self.merit.compute_penalty(
                found, clearance=True
            ),  # just what came: nobody narrows the trust region
            pose_error=0.0,
            step=blank_trial(40).step if self.step is None else self.step * radius,
            contacts=contacts,  # type: ignore[arg-type]
        )

    def is_acceptable(self, _: trust_region.Trial, *penalties: np.ndarray) -> bool:
        return self.taken

    def compute_penalties(self, trial: trust_region.Trial) -> tuple[np.ndarray, np.ndarray]:
        return solver._Loop.compute_penalties(
            self, dataclasses.replace(trial, crossings=self.crossed)
        )  # type: ignore[arg-type]

    def accept(self, trial: trust_region.Trial) -> None:
        self.objective, self.found = trial.objective, trial.infeasibility

    def has_converged(self, _: trust_region.Trial) -> bool:
        return self.is_done

    def raise_penalties(self) -> bool:
        return self.merit.increase_weights(self.found, 1e-3)


def scripted(*rounds: tuple[float, float, bool], **how: Any) -> Scripted:
    loop = Scripted(*rounds, **how)
    region = trust_region.TrustRegion(40, 10)
    solver._iterate(loop, region, None, len(rounds))  # type: ignore[arg-type]
    loop.radii.append(region.radius)
    return loop


@pytest.mark.parametrize(
    ("objective", "shortfall", "accepted", "small"),
    [
        (8.1, 0.009, True, True),
        (8.1, 0.011, True, False),  # it is far from free
        (10.0, 0.0, True, True),
        (14.0, 0.009, True, True),
        (8.1, 0.009, False, False),
    ],
)
def test_radius_is_limited_near_feasibility(
    objective: float, shortfall: float, accepted: bool, small: bool
) -> None:
    """Steps are small, so that the planes are accurate."""
    _, after = scripted((objective, shortfall, accepted)).radii
    assert bool((after <= trust_region.SETTLE_RADIUS).all()) == small
    assert small or (after > trust_region.SETTLE_RADIUS).all()
    _, after = scripted(
        (objective, shortfall, accepted), other=0.01
    ).radii  # first to where all else holds
    assert (after > trust_region.SETTLE_RADIUS).all()


def test_grasp_between_obstacles_is_freed_with_small_steps() -> None:
    scene = vkc.load_scene("init_2").sample_start(np.random.default_rng(5))
    problem = program_of(scene, [vkc.Grasp("stick")])
    seed = next(initialize(problem, "astar", 0)).z
    solution, small = solve(problem, seed), 0
    for row, after in itertools.pairwise(solution.history):
        nearly = (
            trust_region.CLEARANCE_TOLERANCE <= row.shortfall < solver.NEARLY_FEASIBLE
        )  # and not yet free
        if row.accepted and nearly and row.pose_error < TOLERANCE:
            assert after.radius <= trust_region.SETTLE_RADIUS
            assert after.step <= trust_region.SETTLE_RADIUS * (1 + 1e-6)
            small += 1
    assert small, "it never gets there: choose another problem"
    assert solution.converged
    feasible(problem, solution)


@pytest.mark.parametrize(
    ("rounds", "expected"),
    [
        ([(10.0, 0.11, True)] * 20, 6),  # the first took away nearly all
        ([(10.0, 0.0, False)] * 20, 5),  # what counts is where it is, not where it might have gone
        ([(10.0, 0.5 * 0.92**k, True) for k in range(1, 20)], 19),  # a third in five rounds
        ([(10.0, 0.5 * 0.94**k, True) for k in range(1, 20)], 5),
        (
            [(10.0, 0.02, True)] + [(9.0, 0.11, True)] * 20,
            7,
        ),  # counted anew where more is missing and the motion is shorter
        ([(10.0, 1e-3, True)] * 20, 6),  # however little it is
    ],
)
def test_loop_ends_without_progress(rounds: list[tuple[float, float, bool]], expected: int) -> None:
    loop = scripted(*rounds)
    assert loop.solution.rounds == expected
    assert loop.solution.status == "not converged"


@pytest.mark.parametrize(("drift", "converged"), [(0.95, True), (1.05, False)])
def test_drifting_motion_ends_the_loop_without_convergence(drift: float, converged: bool) -> None:
    """No round can repair drift, so the loop has not converged."""
    solution = scripted((8.0, 0.0, True), (1.0, 0.0, True), drift=drift, done=True).solution
    assert (solution.rounds, solution.converged) == (
        1,
        converged,
    )  # nothing holds the step back any more
    assert solution.status == ("converged" if converged else "not converged")


@pytest.mark.parametrize(
    ("objectives", "step", "expected"),
    [
        ([8.0, 7.0, 6.8, 5.0], 1.0, 3),  # the third is hardly better
        ([8.0, 7.0, 6.0, 5.0], 1.0, 4),
        ([8.0, 9.0, 6.0], 1.0, 2),
        ([8.0, 7.0, 6.0, 5.0], 0.98, 4),  # Ipopt ends a little inside its bounds
        ([8.0, 7.0, 6.0], 0.85, 1),  # nothing held it back
    ],
)
def test_feasible_motion_is_improved_as_long_as_worthwhile(
    objectives: list[float], step: float, expected: int
) -> None:
    rounds = [(objective, 0.0, True) for objective in objectives]
    solution = scripted(*rounds, done=True, step=step).solution
    assert (solution.rounds, solution.converged) == (expected, True)


@pytest.mark.parametrize(("shortfall", "expected"), [(0.009, 2), (0.011, 3)])
def test_nearly_feasible_motion_is_the_reference_of_improvement(
    shortfall: float, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A nearly feasible motion is the reference, an infeasible one is not."""
    monkeypatch.setattr(
        Scripted, "has_converged", lambda _, trial: trial.contacts.compute_violation() == 0.0
    )
    solution = scripted(
        (8.0, shortfall, True), (7.9, 0.0, True), (7.8, 0.0, True), (5.0, 0.0, True), step=1.0
    ).solution
    assert (solution.rounds, solution.converged) == (expected, True)


@pytest.mark.parametrize(("done", "small"), [(True, False), (False, True)])
def test_feasible_motion_needs_no_small_steps(done: bool, small: bool) -> None:
    _, after, *_ = scripted((8.1, 0.0, True), (8.1, 0.0, True), done=done, step=1.0).radii
    assert bool((after <= trust_region.SETTLE_RADIUS).all()) == small


def test_penalties_are_raised_if_stalled_near_feasibility() -> None:
    """Weights are raised until the loop ends; far from feasibility it ends at once."""
    few = scripted(*[(10.0, 1.2e-3, True)] * 20, step=1e-4)
    assert few.merit.weights["clearance"] > GROWTH * 200.0  # more than once
    assert few.merit.weights["poses"] == 200.0
    assert any((radius == trust_region.FIRST_RADIUS).all() for radius in few.radii[2:])
    assert few.solution.rounds < 20
    much = scripted(*[(10.0, 0.5, True)] * 20, step=1e-4)
    assert much.merit.weights["clearance"] == 200.0
    assert much.solution.rounds == 1


def test_motions_far_from_feasible_end_early(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wall blocks the whole hall."""
    wall = {"name": "wall", "type": "box", "size": [1.0, 12.0, 2.0], "position": [2.0, 0.0, 1.0]}
    problem = program_of(hall(obstacles=[wall]), [vkc.GoTo(4.0, 0.0, 0.0)], options=FEW)
    seed = straight(problem, 4.0)
    solution = solve(problem, seed)
    assert (solution.status, solution.converged) == ("not converged", False)
    assert solution.rounds < FEW.max_outer
    assert (
        problem.evaluate_contacts(solution.z, reach=0.1).compute_violation()
        > solver.NEARLY_FEASIBLE
    )
    assert solve(problem, seed, rounds=2).rounds == 2


def test_crossings_shrink_the_trust_region() -> None:
    """The merit does not matter here."""
    loop = Scripted((1.0, 0.0, False))
    loop.crossed = [Crossing((3, 5), 12, 13)]
    region = trust_region.TrustRegion(40, 10)
    before = region.radius.copy()
    solver._iterate(loop, region, None, 1)  # type: ignore[arg-type]
    narrowed = region.radius < before
    assert narrowed.any()
    np.testing.assert_array_equal(narrowed, np.isin(region.block, region.block[11:14]))


def test_crossings_are_never_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A guess on the long path around a post must not jump through the post."""
    post = {
        "name": "post",
        "type": "cylinder",
        "radius": 0.02,
        "length": 1.6,
        "position": [1.6, -0.42, 0.8],
    }
    cheap = dataclasses.replace(FEW, penalty=1.0)  # of what overlaps
    problem = program_of(hall(obstacles=[post]), [vkc.GoTo(3.2, 0.0, 0.0)], options=cheap)
    bow = straight(problem, 3.2).copy()
    bow[:, 1] -= 1.3 * np.sin(np.linspace(0.0, np.pi, len(bow) + 1)[1:])
    assert problem.evaluate_contacts(bow, reach=0.02).compute_violation() == 0.0
    assert not find_segment_contacts(problem, bow).crossings
    seen: list[tuple[bool, bool]] = []
    judge = solver._Loop.is_acceptable

    def watch(loop, trial, *penalties):  # type: ignore[no-untyped-def]
        accepted = judge(loop, trial, *penalties)
        seen.append((bool(trial.crossings), accepted))
        return accepted

    monkeypatch.setattr(solver._Loop, "is_acceptable", watch)
    solution = solve(problem, bow)
    assert (True, True) not in seen
    assert solution.converged
    assert solution.z[:, 1].min() < -0.42  # still on the other side of the post
    feasible(problem, solution)
    monkeypatch.setattr(solver, "find_new_crossings", lambda *_: [])  # as if it did not matter
    seen.clear()
    solve(problem, bow)
    assert (True, True) in seen, "nothing was carried through: choose a harder problem"


def test_motion_to_the_start_is_stationary() -> None:
    """The objective is zero up to Ipopt's tolerance."""
    problem = program_of(hall(), [vkc.GoTo(0.0, 0.0, 0.0)], options=FEW)
    still = np.tile(problem.start, (problem.segments, 1))
    solution = solve(problem, still)
    assert solution.converged
    np.testing.assert_allclose(solution.z, still, atol=0.05)
    assert problem.objective(solution.z, solution.dt) <= 1e-3


def test_merit_decreases_with_accepted_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The merit decreases, and no prediction exceeds the merit of the iterate."""
    problem = round_a_pillar()
    merits: list[tuple[float, float, bool]] = []
    judge = solver._Loop.is_acceptable

    def watch(loop, trial, *penalties):  # type: ignore[no-untyped-def]
        before, after = (
            loop.merit.compute_penalty(found, clearance=True).sum()
            for found in (loop.found, trial.infeasibility)
        )
        accepted = judge(loop, trial, *penalties)
        merits.append((loop.objective + before, trial.objective + after, accepted))
        assert trial.predicted_penalty.min() > -1e-6
        assert trial.objective + trial.predicted_penalty.sum() <= (loop.objective + before) * (
            1.0 + 1e-4
        )
        return accepted

    monkeypatch.setattr(solver._Loop, "is_acceptable", watch)
    solve(problem, straight(problem, 3.2))
    assert any(accepted for _, _, accepted in merits)
    for before, after, accepted in merits:
        if accepted:
            assert after <= before + 1e-4 * max(1.0, abs(before))


@pytest.mark.parametrize("radius", [1e-3, 1e-2])
def test_prediction_is_accurate_for_small_steps(radius: float) -> None:
    """Linear models are accurate for small steps, also far from the goals."""
    options = vkc.Options(reach_waypoints=15, turn_waypoints=4, move_waypoints=12)
    problem = program_of(door_scene(), [vkc.Actuate("door", {"hinge": 1.2})], options=options)
    (seed,) = initialize(problem, "stationary", 0)
    loop = solver._Loop(problem, seed.z, options.penalty)
    loop.begin()
    trial = loop.try_step(np.full(problem.segments, radius))
    before, after = (penalties.sum() for penalties in loop.compute_penalties(trial))
    assert after < before
    assert trial.predicted_penalty.sum() == pytest.approx(after, abs=0.01 * (before - after))


def test_feasible_motion_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The feasible motion is returned if later rounds fail."""
    problem, seed = round_a_pillar(), straight(round_a_pillar(), 3.2)
    done = solver._Loop.has_converged
    kept: list[np.ndarray] = []

    def first_only(loop, trial):  # type: ignore[no-untyped-def]
        if kept or not done(loop, trial):
            return False
        kept.append(trial.z.copy())
        return True

    monkeypatch.setattr(solver, "MIN_IMPROVEMENT", -np.inf)  # never content with the first
    monkeypatch.setattr(solver._Loop, "has_converged", first_only)
    solution = solve(problem, seed)
    assert solution.converged
    np.testing.assert_array_equal(solution.z, kept[0])
    feasible(problem, solution)


def test_no_time() -> None:
    problem, seed = round_a_pillar(), straight(round_a_pillar(), 3.2)
    with Budget(seconds=0.0).activate():
        solution = solve(problem, seed)
    assert (solution.status, solution.converged, solution.rounds) == ("time limit", False, 0)
    np.testing.assert_array_equal(solution.z, problem.clip(seed))


def test_time_limit_returns_the_best_iterate() -> None:
    problem, seed = round_a_pillar(), straight(round_a_pillar(), 3.2)
    with Budget(seconds=1e-3).activate():
        solution = solve(problem, seed)
    assert solution.status == "time limit"
    assert solution.rounds <= 1
    assert np.isfinite(solution.z).all()


def test_evaluation_limit_is_deterministic() -> None:
    """The best iterate is returned; a sufficient budget changes nothing."""
    problem, seed = round_a_pillar(), straight(round_a_pillar(), 3.2)
    with Budget().activate() as budget:
        whole = solve(problem, seed)
    with Budget(max_evaluations=budget.evaluations).activate():
        same = solve(problem, seed)
    np.testing.assert_array_equal(same.z, whole.z)
    assert same.converged
    cut = []
    for _ in range(2):
        with Budget(max_evaluations=budget.evaluations // 2).activate():
            cut.append(solve(problem, seed))
    assert cut[0].status == "evaluation limit"
    assert 0 < cut[0].rounds < whole.rounds
    assert (cut[0].rounds, cut[0].iterations) == (cut[1].rounds, cut[1].iterations)
    np.testing.assert_array_equal(cut[0].z, cut[1].z)


def test_guesses_outside_the_bounds_are_clipped() -> None:
    problem = round_a_pillar()
    wild = straight(problem, 3.2) + 20.0
    with Budget(seconds=0.0).activate():
        solution = solve(problem, wild)
    assert np.all((solution.z >= problem.lower) & (solution.z <= problem.upper))


def test_velocity_limits_are_active_in_short_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The duration is limited."""
    options = vkc.Options(reach_waypoints=12, dt=0.25)  # 2.4 m in 3 s at no more than 1 m/s
    problem = program_of(hall(), [vkc.GoTo(2.4, 0.0, 0.0)], options=options)
    least = problem.timing_for(problem.still)
    monkeypatch.setattr(vkc.TrajectoryProblem, "timing_for", lambda self, z: least)
    monkeypatch.setattr(Timing, "stretch", lambda self, *pace: self)
    seed = straight(problem, 2.4)
    assert least.compute_violation(*problem.rates(seed)) > 0.05
    solution = solve(problem, seed)
    assert solution.converged
    first, _ = problem.rates(solution.z)
    assert np.abs(first[:, 0]).max() <= least.velocity[0, 0] * 1.001
    assert np.abs(first[:, 0]).max() > 0.95 * least.velocity[0, 0]
    feasible(problem, solution)


def test_long_paths_take_longer() -> None:
    options = vkc.Options(reach_waypoints=12, dt=0.25)
    problem = program_of(hall(), [vkc.GoTo(2.4, 0.0, 0.0)], options=options)
    solution = solve(problem, straight(problem, 2.4))
    assert solution.converged
    assert 3.0 < solution.dt.sum() < 6.0
    feasible(problem, solution)


def test_same_guess_gives_same_motion() -> None:
    again = solve(round_a_pillar(), straight(round_a_pillar(), 3.2))
    np.testing.assert_array_equal(again.z, solved().z)
    assert [row.objective for row in again.history] == [row.objective for row in solved().history]
