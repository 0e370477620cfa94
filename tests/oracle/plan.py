"""Reads a saved plan: an .npz with JSON `about`, `times`, `positions` and an optional curve."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

__all__ = ["ROOT", "Hold", "NotJudged", "Phase", "SavedPlan", "Violation", "read_plan", "read_yaml"]

ROOT = Path(__file__).resolve().parents[2]


class NotJudged(Exception):
    """The oracle cannot judge this kind of plan."""


@dataclass(frozen=True)
class Violation:
    """A violation: rule, subject, time [s], amount and detail."""

    rule: str
    subject: str
    time: float
    amount: float
    detail: str

    def __str__(self) -> str:
        return (
            f"{self.rule} {self.subject} at {self.time:.2f} s by {self.amount:.3g}: {self.detail}"
        )


@dataclass(frozen=True)
class Hold:
    """An object grasped at an attachment, by the tool or by a frame "<object>.<link>".

    A `measured` grasp has the deviation that the start of the scene states.
    """

    object: str
    attachment: str
    by: str | None
    measured: bool = False


@dataclass(frozen=True)
class Phase:
    """A phase from waypoint `first` to `last`, with the gripper's `opening` [m]; None: at rest."""

    name: str
    first: int
    last: int
    holds: tuple[Hold, ...]
    opening: float | None


_PARTS = 8  # of a cubic between samples


@dataclass(frozen=True)
class Curve:
    """Cubics between knots, from the positions and velocities at the knots."""

    times: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray

    def sample_times(self, parts: int) -> np.ndarray:
        """Return equidistant times in every cubic, including its ends, shape (C, parts + 1)."""
        return self.times[:-1, None] + np.diff(self.times)[:, None] * np.linspace(
            0.0, 1.0, parts + 1
        )

    def evaluate(
        self, times: np.ndarray, order: int, cubics: np.ndarray | None = None
    ) -> np.ndarray:
        """Return positions (0), velocities (1) or accelerations (2) at times [s]."""
        k = (
            np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
            if cubics is None
            else cubics
        )
        h, since = np.diff(self.times)[k][:, None], (times - self.times[k])[:, None]
        p = self.positions[k]
        v = self.velocities[k]
        step = self.positions[k + 1] - self.positions[k]
        c2 = (3.0 * step / h - 2.0 * v - self.velocities[k + 1]) / h
        c3 = (v + self.velocities[k + 1] - 2.0 * step / h) / h**2
        if order == 0:
            return p + since * (v + since * (c2 + since * c3))
        return (
            v + since * (2.0 * c2 + 3.0 * since * c3) if order == 1 else 2.0 * c2 + 6.0 * since * c3
        )


@dataclass(frozen=True)
class SavedPlan:
    """A saved plan; `violations` are those of its own report, by constraint and subject."""

    scene: dict[str, Any]
    folder: Path
    steps: list[dict[str, Any]]
    options: dict[str, Any]
    names: list[str]
    times: np.ndarray
    positions: np.ndarray
    curve: Curve | None
    robot_size: int
    phases: list[Phase]
    status: str
    violations: list[str]
    terms: int

    @property
    def success(self) -> bool:
        return self.status == "success" and not self.violations

    def evaluate(self, times: np.ndarray) -> np.ndarray:
        """Return all coordinates at times [s]."""
        if self.curve is not None:
            return self.curve.evaluate(times, 0)
        return np.stack(
            [np.interp(times, self.times, column) for column in self.positions.T], axis=1
        )

    def sample_coordinates(self) -> np.ndarray:
        """Return the coordinates at the waypoints and at samples between them."""
        if self.curve is None:
            return self.positions
        times = np.concatenate([self.curve.sample_times(_PARTS).ravel(), self.times])
        return self.evaluate(np.sort(times))

    def find_index(self, name: str) -> int | None:
        return self.names.index(name) if name in self.names else None


def sort_holds(
    held: dict[str, str], by: dict[str, str], measured: Collection[str]
) -> tuple[Hold, ...]:
    """Return grasps in an order in which every holder precedes its objects."""
    holds: list[Hold] = []
    remaining = dict(held)
    while remaining:
        ready = [name for name in remaining if by.get(name, "").partition(".")[0] not in remaining]
        if not ready:
            raise ValueError(f"objects hold each other: {remaining}")
        holds += [Hold(name, remaining.pop(name), by.get(name), name in measured) for name in ready]
    return tuple(holds)


def read_plan(path: Path) -> SavedPlan:
    """Return the plan in a file."""
    with np.load(path, allow_pickle=False) as archive:
        metadata = json.loads(str(archive["about"]))
        times, positions = np.array(archive["times"]), np.array(archive["positions"])
        knots = ("knot_times", "knot_positions", "knot_rates")
        curve = Curve(*(np.array(archive[name]) for name in knots)) if knots[0] in archive else None
    location = metadata["folder"]
    if "package" in location:
        folder = ROOT / location["package"]
    else:
        beside = path.resolve().parent / location["relative"]
        folder = beside if beside.is_dir() else Path(location["absolute"])
    motion = metadata["trajectory"]
    start_grasps = (metadata["scene"]["start"].get("held") or {}).items()
    holds = []
    measured = {
        name for name, hold in start_grasps if isinstance(hold, dict) and "measured" in hold
    }
    for p in motion["phases"]:
        measured &= (p.get("deviation") or {}).keys()
        holds.append(sort_holds(p["held"], p.get("by") or {}, measured))
    pairs = zip(motion["phases"], holds, strict=True)
    phases = [Phase(p["name"], p["first"], p["last"], held, p.get("opening")) for p, held in pairs]
    return SavedPlan(
        scene=metadata["scene"],
        folder=folder,
        steps=metadata["steps"],
        options=metadata["options"],
        names=motion["names"],
        times=times,
        positions=positions,
        curve=curve,
        robot_size=motion["robot_size"],
        phases=phases,
        status=metadata["status"],
        violations=[
            f"{v['constraint']} {v['subject']}" for v in metadata["validation"]["violations"]
        ],
        terms=len(metadata.get("terms", ())),
    )


def read_yaml(path: Path) -> Any:
    """Return the contents of a YAML file."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the faster one, if it is compiled
    return yaml.load(path.read_text(encoding="utf-8"), Loader=loader)
