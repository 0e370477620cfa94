"""SimulationResult: what came of a motion in physics."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.simulation.contacts import Contact
from vkc_pin.simulation.goals import Miss
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.replay import page
from vkc_pin.simulation.servos import Servo
from vkc_pin.simulation.snapshots import film, strip
from vkc_pin.simulation.welds import Grip
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step, step_to_dict
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["SimulationResult", "Tracking"]

GOAL = {"m": 0.01, "rad": 0.02}
"""Within which a goal counts as reached."""
DEPTH = 1e-3
"""Of a contact that the plan does not have, up to which it does no harm [m]."""
_LISTED = 8  # contacts that a report names
_TOLD = 4  # motors, those that work hardest


@dataclass(frozen=True)
class Tracking:
    """How well the servos follow, and with what force.

    Attributes:
        arm: Largest and root mean square error of an arm's joint [rad]; of sliding ones [m] at a
            metre a radian.
        base: The same of the base's position on the floor [m].
        heading: The same of its heading [rad].
        worst: The joint of the arm's largest error, and when that was [s].
        efforts: Coordinate → the largest force of its motor, [N·m] or [N].
        shares: Coordinate → the same as a share of its limit, for those that have one.
    """

    arm: tuple[float, float]
    base: tuple[float, float]
    heading: tuple[float, float]
    worst: tuple[str, float]
    efforts: dict[str, float]
    shares: dict[str, float]

    @classmethod
    def of(
        cls, times: Floats, errors: Floats, efforts: Floats, servos: Sequence[Servo], size: int
    ) -> Tracking:
        """Return it of errors and efforts at times, shape (K, servos) each; what comes after `size` coordinates are fingers."""

        def both(values: Floats) -> tuple[float, float]:
            return float(np.abs(values).max(initial=0.0)), float(
                np.sqrt(np.mean(np.square(values)))
            ) if values.size else 0.0

        names = [servo.coordinate for servo in servos]
        peaks = np.abs(efforts).max(axis=0)
        arm = errors[:, 3:size]
        at = np.unravel_index(int(np.argmax(np.abs(arm))), arm.shape) if arm.size else (0, 0)
        return cls(
            arm=both(arm),
            base=both(np.hypot(errors[:, 0], errors[:, 1])),
            heading=both(errors[:, 2]),
            worst=(names[3 + int(at[1])] if arm.size else "", float(times[int(at[0])])),
            efforts=dict(zip(names, peaks.tolist(), strict=True)),
            shares={
                s.coordinate: float(p / s.limit)
                for s, p in zip(servos, peaks, strict=True)
                if np.isfinite(s.limit)
            },
        )


@dataclass(frozen=True, eq=False)
class SimulationResult:
    """What came of a motion in physics.

    Attributes:
        scene: Where it happened.
        steps: What was asked for.
        planned: The motion that was followed.
        trajectory: The motion that came of it, every 20 ms, with the same coordinates; freedoms of
            grasps as planned.
        rows: The same of everything, carried objects with their placements, shape (K, n); see
            `world.trajectory.world_model.World`.
        misses: How far everything that was asked for is from where it should be.
        tracking: How well the servos follow.
        grips: What was held, and how hard it pulled.
        contacts: What touched though the plan has it apart.
        physics: What was assumed.
        notes: What else had to be assumed, a line each.
        diverged: When the computation broke down [s]; None: it did not.
    """

    scene: Scene
    steps: tuple[Step, ...]
    planned: Trajectory
    trajectory: Trajectory
    rows: Floats = field(repr=False)
    misses: tuple[Miss, ...]
    tracking: Tracking
    grips: tuple[Grip, ...]
    contacts: tuple[Contact, ...]
    physics: Physics
    notes: tuple[str, ...] = ()
    diverged: float | None = None

    @property
    def reached(self) -> bool:
        """Whether everything is where it should be, within 10 mm and 0.02 rad."""
        return all(miss.amount <= GOAL[miss.unit] for miss in self.misses)

    @property
    def ok(self) -> bool:
        """Whether that is so, no hand lost its hold, and nothing was hit by more than 1 mm."""
        return self.reached and not self.problems()

    def problems(self) -> list[str]:
        """Return what went wrong, a line each."""
        found = (
            []
            if self.diverged is None
            else [f"the computation broke down at {self.diverged:.2f} s"]
        )
        found += [str(miss) for miss in self.misses if miss.amount > GOAL[miss.unit]]
        found += [
            f"{grip.what} was pulled out of the hand at {grip.broken:.2f} s"
            for grip in self.grips
            if grip.broken is not None
        ]
        return found + [str(contact) for contact in self.contacts if contact.depth > DEPTH]

    def report(self) -> str:
        """Return what came of it, for people."""
        t, problems = self.tracking, self.problems()
        head = "ok" if self.ok else f"FAILED, {len(problems)} problem(s)"
        degrees = [np.degrees(value) for value in (*t.arm, *t.heading)]
        lines = [
            f"{self.scene.name} in physics: {head} — "
            + ", ".join(phase.name for phase in self.planned.phases),
            *(f"  goal        {miss}" for miss in self.misses),
            f"  tracking    arm within {degrees[0]:.2f}° ({degrees[1]:.3f}° rms; worst {t.worst[0]} at {t.worst[1]:.2f} s), "
            f"base within {1e3 * t.base[0]:.1f} mm ({1e3 * t.base[1]:.2f} mm rms), heading within {degrees[2]:.2f}°",
        ]
        for grip in self.grips:
            broken = (
                "" if grip.broken is None else f", PULLED OUT OF THE HAND at {grip.broken:.2f} s"
            )
            force = f"{grip.force:.0f} N and {grip.torque:.1f} N·m at most"
            slip = f", slips by {1e3 * grip.slip:.1f} mm" if grip.slip else ""
            lines.append(
                f"  grasp       {grip.what}, {grip.begin:.1f} to {grip.end:.1f} s: {force}{slip}{broken}"
            )
        shares = sorted(t.shares.items(), key=lambda item: -item[1])
        if shares:
            told = ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in shares[:_TOLD])
            lines.append(f"  motors      at most {told} of their limits")
        lines.append(
            f"  contacts    {len(self.contacts)} that the plan does not have"
            if self.contacts
            else "  contacts    as planned"
        )
        lines += [f"  - {contact}" for contact in self.contacts[:_LISTED]]
        lines += (
            [f"  ... and {len(self.contacts) - _LISTED} more"]
            if len(self.contacts) > _LISTED
            else []
        )
        lines += [f"  note        {note}" for note in self.notes]
        lines += [f"  because     {problem}" for problem in problems]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data, e.g. for JSON."""
        return {
            "scene": self.scene.name,
            "steps": [step_to_dict(step) for step in self.steps],
            "ok": self.ok,
            "problems": self.problems(),
            "misses": [miss.to_dict() for miss in self.misses],
            "tracking": asdict(self.tracking),
            "grips": [grip.to_dict() for grip in self.grips],
            "contacts": [contact.to_dict() for contact in self.contacts],
            "physics": asdict(self.physics),
            "notes": list(self.notes),
            "diverged": self.diverged,
            "trajectory": self.trajectory.to_dict(),
        }

    def to_json(self, path: str | Path) -> Path:
        """Write `to_dict` as JSON, whole or not at all; return the path."""
        return write_atomically(path, (json.dumps(self.to_dict(), indent=1) + "\n").encode("utf-8"))

    def to_html(self, path: str | Path) -> Path:
        """Write one self-contained page with what happened, and what was planned as a ghost beside it; return its path."""
        notes = [(str(contact), contact.time) for contact in self.contacts if contact.depth > DEPTH]
        notes += [
            (f"{grip.what} is pulled out of the hand", grip.broken)
            for grip in self.grips
            if grip.broken is not None
        ]
        return page(
            self,
            path,
            headline=f"{self.scene.name} in physics: {'ok' if self.ok else 'FAILED'}",
            notes=notes,
        )

    def plot(self, path: str | Path, *, count: int = 6) -> Path:
        """Write a picture (.png) of `count` snapshots; return its path. See `snapshots.strip`."""
        return strip(self, path, count=count)

    def to_mp4(self, path: str | Path, *, rate: float = 25.0) -> Path:
        """Write a video of what happened; return its path. Needs ffmpeg; see `snapshots.film`."""
        return film(self, path, rate=rate)

    def __repr__(self) -> str:
        return f"<SimulationResult {self.scene.name}: {'ok' if self.ok else 'FAILED'}, {len(self.contacts)} contacts>"
