from .remaining import RemainingCheck
from .sights import compute_visibility

__all__ = ["RemainingCheck", "compute_visibility"]
