"""A program set up at an iterate, as rounds of the solver do, and its rows and costs at that iterate for any shares."""

from __future__ import annotations

import numpy as np

from helpers.small_problems import random_configurations
from vkc_pin.planning.nlp.merit import Merit, compute_shortfalls, measure_infeasibility
from vkc_pin.planning.nlp.problem import TrajectoryProblem

QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes"}
CLEARANCE, REST = 31.0, 17.0  # weights


class Relaxed:
    """What is missing at an iterate is taken there, with limits on rates, at the times of a motion that stands still."""

    def __init__(self, problem: TrajectoryProblem, z: np.ndarray) -> None:
        p, t = problem, problem.transcription
        self.problem, self.z = problem, z
        self.timing = p.timing_for(p.still)  # so that a wild motion is too fast
        contacts = p.evaluate_contacts(z, reach=p.options.contact_reach, nearest=t.slots)
        self.slack = compute_shortfalls(contacts, t.segments, t.slots)
        self.found = measure_infeasibility(p, z, self.timing, contacts, rates=True)
        self.merit = Merit(REST)
        self.merit.weights["clearance"] = CLEARANCE
        self._planes = p.contacts.compute_planes(z, contacts, slots=t.slots)
        solver = t.solver(rates=True, options=QUIET).function
        self._cost, self._rows = (solver.get_function(name) for name in ("nlp_grad_f", "nlp_jac_g"))
        self.lower, self.upper = p.row_bounds(self.timing)

    def _parameters(self, *, relaxed: bool) -> np.ndarray:
        p, f = self.problem, self.found
        given = {
            "weights": p.motion_cost.weights(*p.rates(self.z)),
            "penalty": CLEARANCE,
            "dt": self.timing.dt,
        }
        given["gears"] = p.rolling.compute_gears(p.waypoints(self.z))
        if not relaxed:
            vector = p.transcription.parameter_vector(
                p.start, *self._planes, p.target_matrix(), **given
            )
            return np.concatenate([vector, np.zeros(len(f.rate_excess))])
        given |= {
            "pose_offsets": f.pose_offsets,
            "excess": f.excess,
            "relaxation_weights": self.merit.compute_penalty(f, clearance=False),
        }
        vector = p.transcription.parameter_vector(
            p.start, *self._planes, p.target_matrix(), **given
        )
        return np.concatenate([vector, f.rate_excess])

    def rows(self, shares: np.ndarray | float, *, relaxed: bool = True) -> np.ndarray:
        """Return the rows at the iterate; not relaxed: with nothing for shares to take away."""
        x = self.problem.transcription.pack(self.z, self.slack, shares)
        return np.asarray(self._rows(x, self._parameters(relaxed=relaxed))[0]).ravel()

    def cost(self, shares: np.ndarray | float) -> float:
        """Return the program's objective at the iterate."""
        x = self.problem.transcription.pack(self.z, self.slack, shares)
        return float(self._cost(x, self._parameters(relaxed=True))[0])

    def of_squares(self) -> float:
        """Return what the way costs in the quadratic function that stands for it in the program."""
        given = self.problem.rates(self.z)
        return float(
            sum(
                np.sum(w * part**2)
                for w, part in zip(self.problem.motion_cost.weights(*given), given, strict=True)
            )
        )

    def missing(self, values: np.ndarray) -> np.ndarray:
        """Return by how much rows are outside their bounds."""
        return np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)


def iterates(problem: TrajectoryProblem, count: int = 3) -> list[np.ndarray]:
    """Return z_1..z_N, shape (N, n): random ones within limits, one far outside them, and one that stands still."""
    rng = np.random.default_rng(20)
    lower, upper = problem.chain.lower, problem.chain.upper
    inside = [random_configurations(lower, upper, problem.segments, rng) for _ in range(count)]
    return [*inside, rng.normal(scale=10.0, size=problem.still.shape), problem.still]


def check_relaxation(problem: TrajectoryProblem, z: np.ndarray) -> dict[str, float]:
    """Check the program set up at an iterate; return how much of each kind is missing there.

    With shares of 1 it is feasible and costs what the merit function says, with shares of 0 it asks
    for everything, and in between for as much of it.
    """
    t, at = problem.transcription, Relaxed(problem, z)
    raw, still, share = (
        at.rows(0.0),
        at.missing(at.rows(1.0)),
        np.random.default_rng(21).uniform(0.1, 0.9, t.segments),
    )
    assert np.isfinite(raw).all()
    assert still.max() < 1e-8 * max(1.0, np.abs(raw).max())
    own = problem.term_evaluator.compute_cost(z, at.timing.dt)
    expected = at.of_squares() + own + at.merit.compute_penalty(at.found, clearance=True).sum()
    np.testing.assert_allclose(at.cost(1.0), expected, rtol=1e-9)
    np.testing.assert_array_equal(raw, at.rows(0.0, relaxed=False))
    np.testing.assert_array_equal(raw, at.rows(1.0, relaxed=False))
    # Rows of planes have slacks of their own.
    between, firm = at.rows(share), t.first_relaxed_row
    np.testing.assert_array_equal(between[t.slot_rows], raw[t.slot_rows])
    owners = np.concatenate([t.row_waypoints, t.rate_waypoints])
    np.testing.assert_allclose(
        at.missing(between)[firm:],
        (1.0 - share[owners]) * at.missing(raw)[firm:],
        rtol=1e-7,
        atol=1e-9,
    )
    for rows_at in t.pose_rows:
        for waypoint, rows in rows_at.items():
            np.testing.assert_allclose(
                between[rows[:3]], (1.0 - share[waypoint - 1]) * raw[rows[:3]], rtol=0.0, atol=1e-9
            )
    return {kind: float(amount.sum()) for kind, amount in at.found.amounts.items()}
