"""Why a stage of a baseline failed, and how far it came."""

from __future__ import annotations

from vkc_pin.motion.trajectory import Trajectory

__all__ = ["FailedError"]


class FailedError(Exception):
    """A stage failed.

    Attributes:
        cause: Why; what becomes the plan's status.
        parts: What was done before, and as much as there is of the stage.
        share: How much of the stage works.
    """

    def __init__(self, cause: str, last: Trajectory | None = None, share: float = 0.0) -> None:
        super().__init__(cause)
        self.cause, self.share = cause, share
        self.parts = [] if last is None else [last]

    @property
    def came(self) -> float:
        """How many stages it came through."""
        return len(self.parts) + self.share
