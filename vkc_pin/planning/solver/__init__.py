"""Ipopt inside the loop of witness planes, and what comes out."""

from vkc_pin.planning.solver.loop import solve

__all__ = ["solve"]
