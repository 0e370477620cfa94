"""Plans base and arm separately, by the methods B1 and B2 of the paper."""

from vkc_pin.experiments.baselines.separate import BASELINES, RETRIES, plan_separately

__all__ = ["BASELINES", "RETRIES", "plan_separately"]
