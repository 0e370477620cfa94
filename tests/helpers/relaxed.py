"""Sets up a program at an iterate as the solver does, and evaluates it at any relaxation."""

from __future__ import annotations

import numpy as np

from helpers.small_problems import sample_configurations
from vkc_pin.planning.nlp.merit import Merit, compute_shortfalls, measure_infeasibility
from vkc_pin.planning.nlp.problem import TrajectoryProblem

QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes"}
# Weights
CLEARANCE = 31.0
REST = 17.0


class RelaxedProgram:
    """A program, with rate rows, set up at an iterate with the timing of the stationary motion."""

    def __init__(self, problem: TrajectoryProblem, z: np.ndarray) -> None:
        p = problem
        t = problem.transcription
        self.problem = problem
        self.z = z
        self.timing = p.timing_for(p.still)  # other motions are too fast
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
        p = self.problem
        f = self.found
        planes, offsets = self._planes
        values = {"planes": planes, "offsets": offsets, "penalty": CLEARANCE}
        values |= p.parameters_at(self.z, self.timing.dt)
        rate_excess = np.zeros(len(f.rate_excess))
        if relaxed:
            values |= {"pose_offsets": f.pose_offsets, "excess": f.excess}
            values["relaxation_weights"] = self.merit.compute_penalty(f, clearance=False)
            rate_excess = f.rate_excess
        return np.concatenate([p.transcription.parameter_vector(**values), rate_excess])

    def rows(self, relaxations: np.ndarray | float, *, relaxed: bool = True) -> np.ndarray:
        """Return the rows at the iterate; unless `relaxed`, no excess is subtracted."""
        x = self.problem.transcription.pack(self.z, self.slack, relaxations)
        return np.asarray(self._rows(x, self._parameters(relaxed=relaxed))[0]).ravel()

    def cost(self, relaxations: np.ndarray | float) -> float:
        """Return the program's objective at the iterate."""
        x = self.problem.transcription.pack(self.z, self.slack, relaxations)
        return float(self._cost(x, self._parameters(relaxed=True))[0])

    def quadratic_cost(self) -> float:
        """Return the motion cost according to the quadratic model in the program."""
        rates = self.problem.rates(self.z, self.timing.dt)
        return float(
            sum(
                np.sum(w * part**2)
                for w, part in zip(self.problem.motion_cost.weights(*rates), rates, strict=True)
            )
        )

    def violations(self, values: np.ndarray) -> np.ndarray:
        """Return the bound violations of rows."""
        return np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)


def make_iterates(problem: TrajectoryProblem, count: int = 3) -> list[np.ndarray]:
    """Return z_1..z_N, shape (N, n): random, some outside the limits, or constant."""
    rng = np.random.default_rng(20)
    lower = problem.chain.lower
    upper = problem.chain.upper
    inside = [sample_configurations(lower, upper, problem.segments, rng) for _ in range(count)]
    return [*inside, rng.normal(scale=10.0, size=problem.still.shape), problem.still]


def check_relaxation(problem: TrajectoryProblem, z: np.ndarray) -> dict[str, float]:
    """Check the program set up at an iterate; return the violation of each kind there.

    With relaxation variables of 1 the program is feasible and its cost is the merit; with 0 it is
    exact. In between, violations are proportional.
    """
    t = problem.transcription
    at = RelaxedProgram(problem, z)
    raw = at.rows(0.0)
    residual = at.violations(at.rows(1.0))
    fractions = np.random.default_rng(21).uniform(0.1, 0.9, t.segments)
    assert np.isfinite(raw).all()
    assert residual.max() < 1e-8 * max(1.0, np.abs(raw).max())
    terms = problem.term_evaluator.compute_cost(z, at.timing.dt)
    expected = (
        at.quadratic_cost() + terms + at.merit.compute_penalty(at.found, clearance=True).sum()
    )
    np.testing.assert_allclose(at.cost(1.0), expected, rtol=1e-9)
    np.testing.assert_array_equal(raw, at.rows(0.0, relaxed=False))
    np.testing.assert_array_equal(raw, at.rows(1.0, relaxed=False))
    # Rows of planes have slacks of their own.
    between = at.rows(fractions)
    firm = t.first_relaxed_row
    np.testing.assert_array_equal(between[t.slot_rows], raw[t.slot_rows])
    owners = np.concatenate([t.row_waypoints, t.rate_waypoints])
    np.testing.assert_allclose(
        at.violations(between)[firm:],
        (1.0 - fractions[owners]) * at.violations(raw)[firm:],
        rtol=1e-7,
        atol=1e-9,
    )
    for rows_at in t.pose_rows:
        for waypoint, rows in rows_at.items():
            np.testing.assert_allclose(
                between[rows[:3]],
                (1.0 - fractions[waypoint - 1]) * raw[rows[:3]],
                rtol=0.0,
                atol=1e-9,
            )
    return {kind: float(amount.sum()) for kind, amount in at.found.amounts.items()}
