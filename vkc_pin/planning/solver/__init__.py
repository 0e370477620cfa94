"""Solves trajectory problems with Ipopt in a loop over witness planes."""

from vkc_pin.planning.solver.loop import solve

__all__ = ["solve"]
