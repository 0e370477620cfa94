"""Tests of the arguments for Ipopt and of its results, with a fake Ipopt."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.merit import TOLERANCE, Infeasibility, Merit
from vkc_pin.planning.solver import subproblem as module
from vkc_pin.planning.solver.solution import Solution
from vkc_pin.planning.solver.subproblem import Step, Subproblem

N, n, SLOTS = 3, 2, 2
Z = np.array([[0.0, 0.5], [0.1, 0.6], [0.2, 0.7]])
LOWER, UPPER = np.array([-0.05, -5.0]), np.array([5.0, 0.65])


class Ipopt:
    """Fake Ipopt that records its arguments and returns identifiable numbers."""

    evaluation_time = 0.001

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []
        self.how: list[dict[str, Any]] = []
        self.stats = {"iter_count": 11, "success": True}
        self.answer = np.array(
            [[1.0, 2.0, 0.25, 0.5, 0.75], [3.0, 4.0, -0.5, 0.25, 1.5], [5.0, 6.0, 0.0, 0.0, -0.5]]
        )

    def __call__(self, **arguments: Any) -> dict[str, Any]:
        self.asked.append(arguments)
        return {
            "x": self.answer.ravel(),
            "lam_x": f"x{len(self.asked)}",
            "lam_g": f"g{len(self.asked)}",
        }


class Made:
    """Fake program of plain numbers."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ipopt, self.noted = Ipopt(), dict[str, Any]()
        transcription = SimpleNamespace(
            slots=SLOTS,
            segments=N,
            n=n,
            width=n + SLOTS + 1,
            pack=self.pack,
            solver=self.solver,
            parameter_vector=self.parameters,
        )
        problem: Any = SimpleNamespace(
            transcription=transcription,
            options=SimpleNamespace(max_iterations=77),
            lower=LOWER,
            upper=UPPER,
            start="start",
            target_matrix=lambda: "targets",
            contacts=SimpleNamespace(compute_planes=lambda z, at, slots: ("planes", "offsets")),
            row_bounds=lambda timing: (
                f"low {timing and timing.dt}",
                f"high {timing and timing.dt}",
            ),
            rates=lambda z: ("first", "second"),
            motion_cost=SimpleNamespace(weights=lambda *rates: ("weights", *rates)),
            rolling=SimpleNamespace(compute_gears=lambda path: ("gears", path)),
            waypoints=lambda z: "path",
        )
        monkeypatch.setattr(
            module,
            "make_linear_solver_options",
            lambda: {"ipopt.linear_solver": "own"},
        )
        self.solution = Solution(Z, np.ones(N))
        self.subproblem = Subproblem(problem, self.solution)

    def pack(self, z: Any, slack: Any = 0.0, shares: Any = 0.0) -> Any:
        return (z, slack, shares)

    def solver(self, *, rates: bool, options: dict[str, Any]) -> Ipopt:
        self.ipopt.how.append({"rates": rates, **options})
        return self.ipopt

    def parameters(self, *given: Any, **named: Any) -> np.ndarray:
        self.noted = {"given": given, **named}
        return np.array([1.0, 2.0])

    def solve(
        self,
        *,
        poses: list[float],
        rates: bool = False,
        short: list[tuple[int, float]] | None = None,
    ) -> Step:
        """Solve a round with given violations of poses and clearances."""
        rows = {kind: np.zeros(N) for kind in Merit(1.0).weights}
        rows["poses"], rows["clearance"] = np.array(poses), np.full(N, 0.5)
        found = Infeasibility(rows, np.full((N, 1, 7), 0.5), np.array([0.25]), np.array([8.0, 9.0]))
        pairs = short or []
        at = np.array([row for row, _ in pairs], int)
        missing, vectors = np.array([by for _, by in pairs]), np.zeros((len(pairs), 3))
        near = Contacts(
            at,
            np.zeros((len(pairs), 2), int),
            0.02 - missing,
            np.full(len(pairs), 0.02),
            vectors,
            vectors,
            vectors,
        )
        merit = Merit(3.0)
        merit.weights["clearance"] = 7.0
        timing: Any = SimpleNamespace(dt="dt")
        return self.subproblem.solve(
            Z, near, found, merit, timing, np.array([0.2, 0.1, 0.3]), rates=rates
        )


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Made:
    return Made(monkeypatch)


def test_waypoints_stay_within_region_and_limits(made: Made) -> None:
    made.solve(poses=[0.0, 0.0, 0.0])
    (asked,) = made.ipopt.asked
    lower, upper = asked["lbx"], asked["ubx"]
    np.testing.assert_allclose(lower[0], [[-0.05, 0.3], [0.0, 0.5], [-0.05, 0.4]])
    np.testing.assert_allclose(upper[0], [[0.2, 0.65], [0.2, 0.65], [0.5, 0.65]])
    assert lower[1:] == (0.0, 0.0)


def test_only_violated_planes_have_slack(made: Made) -> None:
    made.solve(poses=[0.0, 0.0, 0.0], short=[(0, 0.01), (0, -0.01), (0, 0.5), (2, 0.0), (2, 0.004)])
    (asked,) = made.ipopt.asked
    short = np.array([[0.01, 0.0], [0.0, 0.0], [0.0, 0.004]])
    np.testing.assert_allclose(asked["x0"][1], short)
    np.testing.assert_array_equal(asked["ubx"][1], np.where(short > 0.0, np.inf, 0.0))
    np.testing.assert_array_equal(asked["x0"][0], Z)


@pytest.mark.parametrize(
    ("poses", "shares"),
    [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([0.0, 0.9 * TOLERANCE, 0.0], [0.0, 0.0, 0.0]),
        ([0.0, 1.5 * TOLERANCE, 0.0], [0.0, 1.0, 0.0]),
        ([0.01, 0.0, 1e-9], [1.0, 0.0, 1.0]),  # one waypoint that is far off lets all be
    ],
)
def test_relaxation_is_active_where_other_constraints_are_violated(
    made: Made, poses: list[float], shares: list[float]
) -> None:
    made.solve(poses=poses)
    (asked,) = made.ipopt.asked
    np.testing.assert_array_equal(asked["x0"][2], shares)
    np.testing.assert_array_equal(asked["ubx"][2], shares)
    np.testing.assert_allclose(made.noted["relaxation_weights"], 3.0 * np.array(poses))


def test_rate_limits_are_rows_on_request(made: Made) -> None:
    for rates in (False, True):
        made.solve(poses=[0.0, 0.0, 0.0], rates=rates)
        asked = made.ipopt.asked[-1]
        assert (asked["lbg"], asked["ubg"]) == (
            ("low dt", "high dt") if rates else ("low None", "high None")
        )
        assert made.ipopt.how[-1]["rates"] == rates
        assert asked["p"].tolist() == [1.0, 2.0, 8.0, 9.0]


def test_parameters_of_the_program(made: Made) -> None:
    made.solve(poses=[0.0, 0.0, 0.0])
    noted = made.noted
    assert noted["given"] == ("start", "planes", "offsets", "targets")
    assert (noted["weights"], noted["penalty"], noted["dt"]) == (
        ("weights", "first", "second"),
        7.0,
        "dt",
    )
    assert noted["gears"] == ("gears", "path")
    assert (noted["pose_offsets"].shape, noted["excess"].tolist()) == ((N, 1, 7), [0.25])


def test_multipliers_are_reused_only_between_exact_rounds(made: Made) -> None:
    """The tolerance is rough if infeasible; the start is warm after an exact round."""
    exact, far = [0.0, 0.0, 0.0], [0.0, 0.01, 0.0]
    kinds = {1e-2: "cold", 1e-3: "warm", 1.0: "rough"}
    for poses, kind, before in (
        (exact, "cold", None),
        (exact, "warm", 1),
        (exact, "warm", 2),
        (far, "rough", None),
        (exact, "warm", 4),
        (far, "rough", None),
        (far, "rough", None),
    ):
        made.solve(poses=poses)
        how, asked = made.ipopt.how[-1], made.ipopt.asked[-1]
        assert kinds[how["ipopt.mu_init"]] == kind
        assert how["ipopt.linear_solver"] == "own"
        assert how["ipopt.print_level"] == 0  # it says nothing, not even of errors
        assert how["ipopt.max_iter"] == (40 if kind == "rough" else 77)
        assert (asked.get("lam_x0"), asked.get("lam_g0")) == (
            (f"x{before}", f"g{before}") if before else (None, None)
        )
    made.subproblem.reset_multipliers()
    made.solve(poses=exact)
    assert "lam_x0" not in made.ipopt.asked[-1]
    assert kinds[made.ipopt.how[-1]["ipopt.mu_init"]] == "cold"


@pytest.mark.parametrize("success", [True, False])
def test_solution_is_converted_to_a_step(made: Made, success: bool) -> None:
    """Slacks are summed, and slack and relaxation are clipped."""
    made.ipopt.stats = {"iter_count": 11, "success": success}
    step = made.solve(poses=[0.0, 0.0, 0.0])
    np.testing.assert_array_equal(step.z, [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    np.testing.assert_array_equal(step.slack, [0.75, 0.0, 0.0])
    np.testing.assert_array_equal(step.relaxation, [0.75, 1.0, 0.0])
    assert step.succeeded is success


def test_iterations_and_times_add_up(made: Made) -> None:
    made.solution.timings.update(coal=1.0, casadi=2.0, ipopt=3.0)
    for count in (1, 2):
        made.solve(poses=[0.0, 0.0, 0.0])
        assert made.solution.iterations == 11 * count
        assert made.solution.timings["casadi"] == pytest.approx(2.0 + 0.001 * count)
    assert 1.0 < made.solution.timings["coal"] < 1.1
    assert 2.9 < made.solution.timings["ipopt"] < 3.1
