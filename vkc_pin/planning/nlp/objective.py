"""Computes the cost of a motion (path length, or the squares of eq. 1) and a quadratic model."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints

# [m] and [rad]: shorter displacements of a coordinate in a phase count as squares, because the
# length is not differentiable at zero
SMOOTHING_LENGTH = 0.03


def find_change_steps(stops: Sequence[int], segments: int) -> list[int]:
    """Return the step (from 0) to which each change of the step belongs, shape (N + 1 + stops,).

    That is the step before the change, or the first step of a run between two stops.
    """
    steps = list[int]()
    for begin, end in itertools.pairwise([0, *stops, segments]):
        # The first change of a run is to its first step, from rest or from the start velocity.
        waypoints = range(begin, end + 1)
        steps += [max(waypoint, 1) - 1 for waypoint in waypoints]
    return steps


class MotionCost:
    """The cost f of the steps δz_1..δz_N of a motion and of their changes δδz.

    As a sum of squares it is eq. 1: Σ_t ‖δz_t‖²_W + κ·Σ_t ‖δδz_t‖²_W. As a path length it is

        f = Σ_p Σ_g [ √(ε_g² + m_p·E_pg) − ε_g ],

    where E_pg are the same two sums restricted to phase p, of m_p steps, and to the coordinate
    group g: x and y of the base form one group, every other coordinate is a group of its own. At
    constant speed √(m_p·E_pg) is the path length of g, so that slow motion is not cheap, and a
    phase with fewer steps does not cost more. Except for ε, f is a sum of norms; it is convex. See
    `sparse.Differences` for the changes.

    Args:
        metric: Diagonal of W, shape (n,), [1/m²] and [1/rad²].
        smoothing: κ.
        ends: Last waypoint of each phase, shape (P,).
        stops: Interior waypoints at which the motion is at rest.
        length: Whether the cost is the path length; otherwise it is the sum of squares.
    """

    def __init__(
        self, metric: Floats, smoothing: float, ends: Ints, stops: Sequence[int], *, length: bool
    ) -> None:
        self.metric = metric
        self.smoothing = smoothing
        self.length = length
        self._counts = np.diff(ends, prepend=0)  # m_p, steps of each phase
        self._phase_of_step = np.repeat(np.arange(len(self._counts)), self._counts)
        change_steps = find_change_steps(stops, len(self._phase_of_step))
        self._phase_of_change = self._phase_of_step[change_steps]

    def value(self, steps: Floats, changes: Floats) -> float:
        """Return f for steps δz, shape (N, n), and changes δδz, shape (N + 1 + stops, n)."""
        energies = self._compute_energies(steps, changes)
        if not self.length:
            return float(energies.sum())
        epsilon = self._smoothing_lengths
        lengths = np.sqrt(epsilon**2 + self._counts[:, None] * energies) - epsilon
        groups = np.delete(np.arange(len(self.metric)), 1)  # x represents x and y
        return float(lengths[:, groups].sum())

    def weights(self, steps: Floats, changes: Floats) -> tuple[Floats, Floats]:
        """Return the weights of a quadratic model of f, for squared steps and for squared changes.

        The model has the value (up to a constant) and the gradient of f at the given steps, and
        bounds f from above: √q ≤ (q/√q̄ + √q̄)/2 (iteratively reweighted least squares; Hunter and
        Lange, A tutorial on MM algorithms, 2004). With q = ε_g² + m_p·E_pg this is E_pg times

            m_p / (2·√(ε_g² + m_p·Ē_pg))

        plus a constant. The weights have the shapes of the arguments.
        """
        scale = np.ones((len(self._counts), len(self.metric)))
        if self.length:
            counts = self._counts[:, None]
            energies = self._compute_energies(steps, changes)
            scale = counts / (2.0 * np.sqrt(self._smoothing_lengths**2 + counts * energies))
        step_weights = scale[self._phase_of_step] * self.metric
        change_weights = scale[self._phase_of_change] * self.metric
        return step_weights, self.smoothing * change_weights

    @property
    def _smoothing_lengths(self) -> Floats:
        """ε of each coordinate's group, shape (n,)."""
        return SMOOTHING_LENGTH * np.sqrt(self.metric)

    def _compute_energies(self, steps: Floats, changes: Floats) -> Floats:
        """Return E_pg of each coordinate's group (for squares, of the coordinate), shape (P, n)."""
        energies = np.zeros((len(self._counts), len(self.metric)))
        np.add.at(energies, self._phase_of_step, self.metric * steps**2)
        np.add.at(energies, self._phase_of_change, self.smoothing * self.metric * changes**2)
        if self.length:
            energies[:, :2] = energies[:, :2].sum(axis=1, keepdims=True)
        return energies
