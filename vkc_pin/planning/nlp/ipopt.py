"""Runs Ipopt on a program with given derivatives, and stops it when the budget is exhausted."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.budget import BudgetExhaustedError, record_evaluations

_MEMORY_INDEX = 1  # CasADi reserves memory 0 of a function; the buffer gets the next one
# [bytes] per nonzero of Jacobian or Hessian, in program and solver together, measured on the door
BYTES_PER_ENTRY = 600


class Monitor(ca.Callback):
    """CasADi iteration callback that records `waypoints` evaluations per iteration."""

    def __init__(self, variables: int, rows: int, parameters: int, waypoints: int) -> None:
        ca.Callback.__init__(self)
        self._waypoints = waypoints
        self._sizes = {"f": 1, "lam_p": parameters, "g": rows, "lam_g": rows}
        self._sizes |= {"x": variables, "lam_x": variables}
        self.construct("monitor", {})

    def get_n_in(self) -> int:
        """Return the number of inputs, which are the outputs of nlpsol."""
        return int(ca.nlpsol_n_out())

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the sparsity of input `i`."""
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: list[ca.DM]) -> list[int]:
        """Return [1] (stop) if the budget is exhausted, otherwise [0]."""
        try:
            record_evaluations(self._waypoints)
        except BudgetExhaustedError:
            return [1]
        return [0]


class Ipopt:
    """An Ipopt solver with the arrays that it reads and writes.

    CasADi converts arguments and results number by number, 0.1 ms per thousand numbers. The arrays
    are therefore shared with it once.

    Attributes:
        nbytes: Estimated size in memory [bytes].
        stats: CasADi's statistics of the last call; its times accumulate over all calls.
        evaluation_time: Time spent in the program's functions during the last call [s].
    """

    def __init__(self, function: ca.Function, monitor: Monitor, nbytes: int) -> None:
        self.function = function
        self.monitor = monitor
        self.nbytes = nbytes
        self._buffer, self._run = function.buffer()
        self.stats: dict[str, Any] = {}
        self.evaluation_time = 0.0
        self._total = 0.0  # [s], evaluation time of all calls
        self._inputs = dict[str, Floats]()
        for i in range(function.n_in()):
            values = np.zeros(function.nnz_in(i))
            self._inputs[function.name_in(i)] = values
            self._buffer.set_arg(i, values.data)
        self._outputs = dict[str, Floats]()
        for i in range(function.n_out()):
            values = np.zeros(function.nnz_out(i))
            self._outputs[function.name_out(i)] = values
            self._buffer.set_res(i, values.data)

    def __call__(self, **values_by_name: Floats) -> dict[str, Floats]:
        """Run the solver; return CasADi's outputs by name. Inputs that are not given are zero."""
        for name, values in self._inputs.items():
            values[:] = values_by_name.get(name, 0.0)
        self._run()
        self.stats = dict(self.function.stats(_MEMORY_INDEX))
        total = sum(value for key, value in self.stats.items() if key.startswith("t_wall_nlp_"))
        self.evaluation_time = total - self._total
        self._total = total
        return {name: values.copy() for name, values in self._outputs.items()}


def make_ipopt(
    x: ca.MX,
    parameters: ca.MX,
    objective: tuple[ca.MX, ca.MX],
    rows: tuple[ca.MX, ca.MX],
    lagrangian: tuple[ca.MX, ca.MX, ca.MX],
    options: dict[str, Any],
    *,
    waypoints: int,
) -> Ipopt:
    """Return an Ipopt solver of min f(x) subject to bounds on g(x).

    Args:
        x: Variables.
        parameters: Parameters.
        objective: f and its gradient.
        rows: g and its Jacobian.
        lagrangian: Symbols of the weight σ of f and of the multipliers λ, and the upper triangle of
            the Hessian of σ·f + λᵀ·g.
        options: Options of CasADi's nlpsol.
        waypoints: Evaluations recorded per iteration.
    """
    weight, multipliers, hessian = lagrangian
    inputs = [x, parameters]
    names = ["x", "p"]
    monitor = Monitor(x.numel(), multipliers.numel(), parameters.numel(), waypoints)
    defaults = {
        "grad_f": ca.Function("nlp_grad_f", inputs, list(objective), names, ["f", "grad_f_x"]),
        "jac_g": ca.Function("nlp_jac_g", inputs, list(rows), names, ["g", "jac_g_x"]),
        "hess_lag": ca.Function(
            "nlp_hess_l",
            [*inputs, weight, multipliers],
            [hessian],
            [*names, "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        ),
        "iteration_callback": monitor,
        "print_time": False,
        "record_time": True,
        "calc_lam_p": False,
        "no_nlp_grad": True,
        "inputs_check": False,  # it warns of more equations than variables, as in a phase at rest
    }
    record_evaluations()
    f, _ = objective
    g, jacobian = rows
    program = {"x": x, "p": parameters, "f": f, "g": g}
    all_options = {**defaults, **options}
    solver = ca.nlpsol("trajectory", "ipopt", program, all_options)
    nbytes = BYTES_PER_ENTRY * (jacobian.nnz() + hessian.nnz())
    return Ipopt(solver, monitor, nbytes)
