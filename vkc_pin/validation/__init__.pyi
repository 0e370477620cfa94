from .remaining import RemainingCheck

__all__ = ["RemainingCheck"]
