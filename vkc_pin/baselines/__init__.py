"""Planners that treat base and arm one after the other: what the virtual kinematic chain is compared with."""

from vkc_pin.baselines.separate import BASELINES, RETRIES, plan_separately

__all__ = ["BASELINES", "RETRIES", "plan_separately"]
