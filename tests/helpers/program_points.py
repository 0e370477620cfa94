"""Makes random points at which tests compare a nonlinear program with its definition."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pinocchio as pin

from helpers.small_problems import sample_configurations
from vkc_pin.planning.nlp.problem import TrajectoryProblem

QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes"}
PENALTY = 7.0


@dataclass
class ProgramPoint:
    """Variables and parameters of a program, all random except start and targets."""

    problem: TrajectoryProblem
    z: np.ndarray  # (N, n)
    slack: np.ndarray  # (N, K)
    relaxation: np.ndarray  # (N,)
    planes: np.ndarray  # (N, K, 12·joints)
    offsets: np.ndarray  # (N, K)
    pose_offsets: np.ndarray  # (N, poses, 7)
    excess: np.ndarray  # (rows that do not come from waypoint functions,)
    rate_excess: np.ndarray  # (rate rows,)
    relaxation_weights: np.ndarray  # (N,)
    weights: tuple[np.ndarray, np.ndarray]  # of squared steps (N, n) and of their squared changes
    dt: np.ndarray  # (N,)
    gears: np.ndarray  # (N,)

    @property
    def x(self) -> np.ndarray:
        return self.problem.transcription.pack(self.z, self.slack, self.relaxation)

    @property
    def path(self) -> np.ndarray:
        return self.problem.waypoints(self.z)

    @property
    def penalties(self) -> float:
        """The penalty of slacks and relaxation variables."""
        return float(PENALTY * self.slack.sum() + self.relaxation_weights @ self.relaxation)

    @property
    def parameters(self) -> np.ndarray:
        p = self.problem
        values = p.parameters_at(self.z, self.dt)
        values |= {"gears": self.gears, "planes": self.planes}
        values |= dict(zip(("step_weights", "change_weights"), self.weights, strict=True))
        vector = p.transcription.parameter_vector(
            offsets=self.offsets,
            penalty=PENALTY,
            pose_offsets=self.pose_offsets,
            excess=self.excess,
            relaxation_weights=self.relaxation_weights,
            **values,
        )
        return np.concatenate([vector, self.rate_excess])

    def relax_target(self, waypoint: int, number: int) -> pin.SE3:
        """Return the relaxed target of a pose at a waypoint, computed by Pinocchio."""
        target = self.problem.targets[number]
        offsets = self.pose_offsets[waypoint - 1, number]
        e = self.relaxation[waypoint - 1]
        turn = pin.exp3(e * offsets[6] * offsets[3:6])
        return pin.SE3(target.rotation @ turn, target.translation + e * offsets[:3])

    def functions(self) -> list[ca.Function]:
        """Return Ipopt's functions, with rate rows: (f, ∇f), (g, ∂g) and triu ∇²L."""
        solver = self.problem.transcription.solver(rates=True, options=QUIET).function
        return [solver.get_function(name) for name in ("nlp_grad_f", "nlp_jac_g", "nlp_hess_l")]

    def cost(self) -> float:
        return float(self.functions()[0](self.x, self.parameters)[0])

    def rows(self) -> np.ndarray:
        return np.asarray(self.functions()[1](self.x, self.parameters)[0]).ravel()

    def check_derivatives(self) -> None:
        """Compare gradient, Jacobian and Hessian with finite differences in random directions.

        Nonzeros missing in a sparsity pattern show up as differences, too.
        """
        objective, constraints, lagrangian = self.functions()
        rng = np.random.default_rng(3)
        parameters = self.parameters
        weight = 0.7
        h = 1e-6
        multipliers = rng.normal(size=constraints.size1_out(0))

        def evaluate(x: np.ndarray) -> tuple[ca.DM, np.ndarray, np.ndarray]:
            f, gradient = objective(x, parameters)
            g, jacobian = constraints(x, parameters)
            slopes = weight * gradient + jacobian.T @ multipliers
            return ca.vertcat(gradient.T, jacobian), ca.vertcat(f, g).full(), slopes.full()

        x = self.x
        jacobian = evaluate(x)[0]
        upper = lagrangian(x, parameters, weight, multipliers)
        assert upper.sparsity().is_triu()
        hessian = upper + ca.triu(upper, False).T
        for direction in rng.normal(size=(4, len(x))):
            ahead, behind = (evaluate(x + side * h * direction) for side in (1.0, -1.0))
            for matrix, k in ((jacobian, 1), (hessian, 2)):
                expected = (ahead[k] - behind[k]) / (2.0 * h)
                atol = 1e-7 * max(1.0, np.abs(expected).max())
                found = (matrix @ direction).full()
                np.testing.assert_allclose(found, expected, rtol=1e-5, atol=atol)


def make_random_point(p: TrajectoryProblem, seed: int = 0) -> ProgramPoint:
    """Return a point with relaxation variables between 0 and 1, and random excess."""
    rng = np.random.default_rng(seed)
    t = p.transcription
    N = t.segments
    K = t.slots
    poses = len(p.pose_goals)
    axes = rng.normal(size=(N, poses, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    turns = rng.uniform(0.0, np.pi, (N, poses, 1))
    return ProgramPoint(
        problem=p,
        z=sample_configurations(p.chain.lower, p.chain.upper, N, rng),
        slack=rng.uniform(0.0, 1.0, (N, K)),
        relaxation=rng.uniform(0.05, 0.95, N),
        planes=rng.normal(size=(N, K, 12 * (p.chain.model.njoints - 1))),
        offsets=rng.normal(size=(N, K)),
        pose_offsets=np.concatenate([rng.normal(size=axes.shape), axes, turns], axis=2),
        excess=rng.normal(size=t.rows - t.first_relaxed_row),
        rate_excess=rng.normal(size=t.rate_matrix.size1()),
        relaxation_weights=rng.uniform(0.0, 50.0, N),
        weights=tuple(rng.uniform(0.1, 3.0, part.shape) for part in p.rates(p.still, np.ones(N))),
        dt=rng.uniform(0.1, 0.4, N),
        gears=np.where(np.arange(N) % 2, 1.0, -1.0),
    )
