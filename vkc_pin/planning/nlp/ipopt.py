"""Ipopt on a program whose derivatives are given, stopped between two of its iterations when the budget is at its end."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import SpentError, spend

__all__ = ["ENTRY", "Ipopt", "Monitor", "ipopt"]

_MEMORY = 1  # CasADi keeps memory 0 of a function to itself, and the buffer has the next one
# [bytes] that an entry of Jacobian or Hessian takes, in a program and in a solver, measured at the
# door
ENTRY = 600


class Monitor(ca.Callback):
    """CasADi's iteration callback.

    Args:
        variables: Number of variables of the program.
        rows: Of rows.
        parameters: Of parameters.
        waypoints: Units of effort of an iteration.
    """

    def __init__(self, variables: int, rows: int, parameters: int, waypoints: int) -> None:
        ca.Callback.__init__(self)
        self._waypoints = waypoints
        self._sizes = {
            "x": variables,
            "f": 1,
            "g": rows,
            "lam_x": variables,
            "lam_g": rows,
            "lam_p": parameters,
        }
        self.construct("monitor", {})

    def get_n_in(self) -> int:
        """Return the number of inputs: what nlpsol puts out."""
        return int(ca.nlpsol_n_out())

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the shape of an input."""
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: list[ca.DM]) -> list[int]:
        """Return [1] when the budget is at its end."""
        try:
            spend(self._waypoints)
        except SpentError:
            return [1]
        return [0]


class Ipopt:
    """A solver, with the arrays that it reads and writes.

    What CasADi is handed, and hands out, it converts number by number, which takes 0.1 ms for a
    thousand of them; so arrays are shared with it once.

    Args:
        function: The solver.
        monitor: What stops it.
        nbytes: How much memory it takes.

    Attributes:
        stats: CasADi's statistics of the last call; its times are those of all calls.
        evaluating: How long the program's functions took in the last call [s].
    """

    def __init__(self, function: ca.Function, monitor: Monitor, nbytes: int) -> None:
        self.function, self.monitor, self.nbytes = function, monitor, nbytes
        self._buffer, self._run = function.buffer()
        self.stats: dict[str, Any] = {}
        self.evaluating = self._total = 0.0
        self._given = {
            function.name_in(i): np.zeros(function.nnz_in(i)) for i in range(function.n_in())
        }
        self._found = {
            function.name_out(i): np.zeros(function.nnz_out(i)) for i in range(function.n_out())
        }
        for i, values in enumerate(self._given.values()):
            self._buffer.set_arg(i, values.data)
        for i, values in enumerate(self._found.values()):
            self._buffer.set_res(i, values.data)

    def __call__(self, **given: Floats) -> dict[str, Floats]:
        """Return what CasADi's solver returns, by name; what is not given is 0."""
        for name, values in self._given.items():
            values[:] = given.get(name, 0.0)
        self._run()
        self.stats = dict(self.function.stats(_MEMORY))
        total = sum(value for key, value in self.stats.items() if key.startswith("t_wall_nlp_"))
        self.evaluating, self._total = total - self._total, total
        return {name: values.copy() for name, values in self._found.items()}


def ipopt(
    x: ca.MX,
    parameters: ca.MX,
    objective: tuple[ca.MX, ca.MX],
    rows: tuple[ca.MX, ca.MX],
    lagrangian: tuple[ca.MX, ca.MX, ca.MX],
    options: dict[str, Any],
    *,
    waypoints: int,
) -> Ipopt:
    """Return Ipopt on min f(x) subject to bounds on g(x).

    Args:
        x: The variables.
        parameters: The parameters.
        objective: f and its gradient.
        rows: g and its Jacobian.
        lagrangian: Symbols of the weight σ of f and of the multipliers λ, and the upper triangle of
            the Hessian of σ·f + λᵀ·g.
        options: For CasADi's nlpsol.
        waypoints: Units of effort of an iteration.
    """
    weight, multipliers, hessian = lagrangian
    given, (f, g) = [x, parameters], (objective[0], rows[0])
    functions = {
        "grad_f": ca.Function("nlp_grad_f", given, list(objective), ["x", "p"], ["f", "grad_f_x"]),
        "jac_g": ca.Function("nlp_jac_g", given, list(rows), ["x", "p"], ["g", "jac_g_x"]),
        "hess_lag": ca.Function(
            "nlp_hess_l",
            [*given, weight, multipliers],
            [hessian],
            ["x", "p", "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        ),
    }
    quiet = {"print_time": False, "record_time": True, "calc_lam_p": False, "no_nlp_grad": True}
    monitor = Monitor(x.numel(), g.numel(), parameters.numel(), waypoints)
    callback = {"iteration_callback": monitor}
    spend()
    program = {"x": x, "p": parameters, "f": f, "g": g}
    solver = ca.nlpsol(
        "trajectory", "ipopt", program, {**quiet, **functions, **callback, **options}
    )
    return Ipopt(solver, monitor, ENTRY * (rows[1].nnz() + hessian.nnz()))
