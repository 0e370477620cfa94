"""Lists the collision pairs of a phase with their margins."""

from __future__ import annotations

import numpy as np

from helpers.small_problems import get_margins
from vkc_pin.planning.nlp.problem import TrajectoryProblem


def list_pair_margins(
    problem: TrajectoryProblem, phase: int, *, waypoint: int | None = None
) -> dict[tuple[str, str], list[float]]:
    """Return (link, link or obstacle) → margins of their pairs at a waypoint, or unreduced."""
    part = problem.contacts.phases[phase]
    found = dict[tuple[str, str], list[float]]()
    margins = part.margins
    pairs = np.arange(len(part.pairs))
    if waypoint is not None:
        margins = get_margins(part, pairs, np.full(len(pairs), waypoint))
    for (first, second), margin in zip(part.pairs.tolist(), margins.tolist(), strict=True):
        found.setdefault((part.labels[first], part.labels[second]), []).append(margin)
    return found
