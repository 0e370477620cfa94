"""Compares the torques of the arm along a motion with the limits of its motors."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.validation.dynamics.bounds import find_limiting_constraints
from vkc_pin.validation.report import Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.dynamics.torques import MotionSamples, Torques, sample_curve

__all__ = ["TORQUE_TOLERANCE", "MotorLoads"]

# Relative excess over a limit. Torques are evaluated only at three times of every cubic.
TORQUE_TOLERANCE = 5e-3


class MotorLoads:
    """Motor torques at the ends and middle of every cubic, or at waypoints if there is no curve."""

    def __init__(self, samples: Samples) -> None:
        self.samples, self.trajectory = samples, samples.trajectory
        self._torques = Torques(samples.scene, samples.trajectory, samples.free_objects)

    @cached_property
    def moments(self) -> MotionSamples:
        """Times of the evaluation and the motion at these times."""
        trajectory, curve = self.trajectory, self.trajectory.curve
        if curve is not None:
            return sample_curve(curve)
        speeds = np.pad(trajectory.velocities(), ((1, 1), (0, 0)))
        pieces = np.minimum(np.arange(len(trajectory.times)), len(trajectory.times) - 2)
        return MotionSamples(
            trajectory.times,
            pieces,
            trajectory.positions,
            0.5 * (speeds[1:] + speeds[:-1]),
            trajectory.accelerations(),
        )

    @cached_property
    def waypoints(self) -> Ints:
        """Last waypoint at or before each time."""
        edges = (
            self.trajectory.times if self.trajectory.curve is None else self.trajectory.curve.times
        )
        before = np.searchsorted(self.trajectory.times, edges[:-1], side="right") - 1
        return np.asarray(before[self.moments.pieces])

    @cached_property
    def torques(self) -> Floats:
        """Torques at every time, shape (K, robot coordinates) [N·m], [N]."""
        return self._compute_torques(np.arange(len(self.moments.times)))

    @cached_property
    def torque_ratios(self) -> Floats:
        """|Torques| relative to their limits, shape (K, robot coordinates); 0 if unknown."""
        if not self._torques.torque_limits.is_known:
            return np.zeros((len(self.moments.times), self.trajectory.robot_size))
        return np.asarray(np.abs(self.torques) / self._torques.torque_limits.limits)

    def _compute_torques(self, rows: Ints, speed: float = 1.0) -> Floats:
        now, phases = self.moments, self._torques.phases_of(self.waypoints[rows])
        return self._torques.at(
            phases,
            now.positions[rows],
            speed * now.velocities[rows],
            speed**2 * now.accelerations[rows],
        )

    def find_violations(self) -> list[Violation]:
        """Return the worst violation of each joint's torque limit."""
        found = list[Violation]()
        for k in np.flatnonzero(self.torque_ratios.max(axis=0) > 1.0 + TORQUE_TOLERANCE).tolist():
            row = int(np.argmax(self.torque_ratios[:, k]))
            name, limit = self.trajectory.names[k], float(self._torques.torque_limits.limits[k])
            torque = abs(self.torques[row, k])
            unit = "N" if self.samples.get_unit(name) == "m" else "N·m"
            rest = abs(float(self._compute_torques(np.array([row]), 1e-2)[0, k]))
            why = f"{rest:.4g} {unit} {'even ' if rest > limit else ''}at rest"
            detail = f"{torque:.4g} {unit} exceeds the motor's {limit:.4g} {unit}, {why}"
            at, time = int(self.waypoints[row]), float(self.moments.times[row])
            found.append(
                self.samples.make_violation(
                    "torque", name, torque - limit, unit, detail, waypoint=at, time=time
                )
            )
        return found

    def summarize(self, jerk_time: float = 0.0) -> dict[str, Any]:
        """Return the fields of the report; `jerk_time` is that of `Options`."""
        remarks = [f"torques not checked: {note}" for note in self._torques.torque_limits.notes]
        if self._torques.massless_objects:
            remarks.append(
                "carried as massless, since no mass is given: "
                f"{', '.join(self._torques.massless_objects)}"
            )
        found = find_limiting_constraints(self.samples, self.moments, self.torque_ratios, jerk_time)
        return {
            "torque": float(self.torque_ratios.max(initial=0.0)),
            "bounds": found,
            "remarks": tuple(remarks),
        }
