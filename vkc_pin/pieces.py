"""Pieces of motions: waypoints of phases, from which a problem that has these phases among its own can start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vkc_pin.initialization import Seed
from vkc_pin.problem import TrajectoryProblem
from vkc_pin.trajectory import filled

__all__ = ["Piece", "seed_of"]


@dataclass(frozen=True, eq=False)
class Piece:
    """Waypoints of phases that follow one another.

    Attributes:
        phases: The phases' names.
        names: Of the n coordinates.
        z: Their waypoints after the first, shape (N, n).
        seed: The name of the seed that led to them.
    """

    phases: tuple[str, ...]
    names: tuple[str, ...]
    z: NDArray[np.float64]
    seed: str


def seed_of(problem: TrajectoryProblem, pieces: Sequence[Piece]) -> Seed:
    """Return the waypoints of `pieces`, one after the other, as those of the whole problem."""
    chain = problem.chain
    z = np.full((problem.segments, chain.size), np.nan)
    begin = number = 0
    for piece in pieces:
        count = len(piece.phases)
        if piece.phases != tuple(phase.name for phase in problem.task.phases[number : number + count]):
            continue  # only to let go of something the robot stands still for a while; here that has no phase of its own
        number += count
        end = begin + len(piece.z)
        known = [k for k, name in enumerate(piece.names) if name in chain.names]  # the rest belongs to what is held no more
        z[begin:end, [chain.index(piece.names[k]) for k in known]] = piece.z[:, known]
        begin = end
    z = filled(z)
    z = np.where(np.isnan(z), problem.start, z)  # no piece moves it
    return Seed(", ".join(piece.seed for piece in pieces) + ", then all at once", z)
