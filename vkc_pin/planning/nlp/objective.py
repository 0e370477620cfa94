"""What a motion costs: the length of its way, or the squares of eq. 1; and the quadratic function that touches it at a motion."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints

__all__ = ["Effort", "changed_at"]

# [m] and [rad] ways of a coordinate in a phase that are shorter count as squares: a length has a
# slope at 0 then
STILL = 0.03


def changed_at(stops: Sequence[int], segments: int) -> list[int]:
    """Return the step, counted from 0, that every change of the step belongs to: that before it, or the first of a motion.

    Args:
        stops: Waypoints inside the motion at which it comes to rest, as it does at start and end.
        segments: Number of steps.
    """
    runs = itertools.pairwise([0, *stops, segments])
    return [max(waypoint, 1) - 1 for begin, end in runs for waypoint in range(begin, end + 1)]


class Effort:
    """The cost f of the steps δz_1..δz_N of a motion and their changes δδz, see `sparse.differences`.

    As squares it is eq. 1: Σ_t ‖δz_t‖²_W + κ·Σ_t ‖δδz_t‖²_W. As a length it is

        f = Σ_p Σ_g [ √(ε_g² + m_p·E_pg) − ε_g ],

    where E_pg are the same two sums over phase p, of m_p steps, and the coordinates g alone: x and
    y of the base are one g, every other coordinate is one of its own. At even speed √(m_p·E_pg) is
    how long the way of g is, so that slow motion is not cheap, and a phase not the dearer the fewer
    steps it has. It is a sum of norms, but for ε, and convex.

    Args:
        metric: The diagonal of W, shape (n,), [1/m²] and [1/rad²].
        smoothing: κ.
        ends: The last waypoint of every phase, shape (P,).
        stops: Waypoints inside the motion at which it comes to rest, as it does at start and end.
        length: Whether it is a length; otherwise it is a sum of squares.
    """

    def __init__(
        self, metric: Floats, smoothing: float, ends: Ints, stops: Sequence[int], *, length: bool
    ) -> None:
        self.metric, self.smoothing, self.length = metric, smoothing, length
        self._counts = np.diff(ends, prepend=0)
        phase = np.repeat(np.arange(len(self._counts)), self._counts)
        self._phases = (
            phase,
            phase[changed_at(stops, len(phase))],
        )  # of the steps, and of their changes

    def value(self, steps: Floats, changes: Floats) -> float:
        """Return f.

        Args:
            steps: Shape (N, n).
            changes: Shape (N + 1 + number of stops, n).
        """
        energies = self._energies(steps, changes)
        if not self.length:
            return float(energies.sum())
        still = self._still
        return float(
            (np.sqrt(still**2 + self._counts[:, None] * energies) - still)[:, self._own].sum()
        )

    def weights(self, steps: Floats, changes: Floats) -> tuple[Floats, Floats]:
        """Return the weights of squared steps, shape (N, n), and of squared changes, in a quadratic function that stands for f.

        It has the value and slope of f at the steps given, up to a constant, and nowhere lies below
        f: √q ≤ (q/√q̄ + √q̄)/2 (reweighted least squares; Hunter and Lange, A tutorial on MM
        algorithms, 2004).

        Args:
            steps: Shape (N, n).
            changes: Shape (N + 1 + number of stops, n).
        """
        share = np.ones((len(self._counts), len(self.metric)))
        if self.length:
            counts = self._counts[:, None]
            share = counts / (
                2.0 * np.sqrt(self._still**2 + counts * self._energies(steps, changes))
            )
        of_steps, of_changes = (share[phase] * self.metric for phase in self._phases)
        return of_steps, self.smoothing * of_changes

    @property
    def _still(self) -> Floats:
        """ε of the group of every coordinate, shape (n,)."""
        return STILL * np.sqrt(self.metric)

    @property
    def _own(self) -> Ints:
        """One coordinate of every group: x stands for x and y."""
        return np.delete(np.arange(len(self.metric)), 1)

    def _energies(self, steps: Floats, changes: Floats) -> Floats:
        """Return E_pg for every coordinate's g, shape (P, n); of squares for every coordinate's own."""
        found = np.zeros((len(self._counts), len(self.metric)))
        np.add.at(found, self._phases[0], self.metric * steps**2)
        np.add.at(found, self._phases[1], self.smoothing * self.metric * changes**2)
        if self.length:
            found[:, :2] = found[:, :2].sum(axis=1, keepdims=True)
        return found
