"""Stops Ipopt between two of its iterations when time is up."""

from __future__ import annotations

import time

import casadi as ca
import numpy as np

__all__ = ["Monitor"]


class Monitor(ca.Callback):
    """CasADi's iteration callback; `deadline` can be set before every solve.

    Attributes:
        deadline: Value of `time.perf_counter()` at which to stop.
    """

    def __init__(self, variables: int, rows: int, parameters: int) -> None:
        ca.Callback.__init__(self)
        self.deadline = np.inf
        self._sizes = {"x": variables, "f": 1, "g": rows, "lam_x": variables, "lam_g": rows, "lam_p": parameters}
        self.construct("monitor", {})

    def get_n_in(self) -> int:
        """Return the number of inputs: what nlpsol puts out."""
        return int(ca.nlpsol_n_out())

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the shape of an input."""
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: list[ca.DM]) -> list[int]:
        """Return [1] when time is up."""
        return [int(time.perf_counter() > self.deadline)]
