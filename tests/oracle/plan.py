"""Reads a saved plan: an .npz with JSON `about`, `times`, `positions`, and optionally a curve."""

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
    """The plan is of a kind that cannot be judged here."""


@dataclass(frozen=True)
class Violation:
    """A violation: rule, subject, time [s] and amount."""

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
    """An object held at an attachment, by the tool or by a frame "<object>.<link>".

    It is `measured` while it is held as the scene's start says.
    """

    object: str
    attachment: str
    by: str | None
    measured: bool = False


@dataclass(frozen=True)
class Phase:
    """A phase from waypoint `first` to `last`; `opening` of the gripper [m], None: at rest."""

    name: str
    first: int
    last: int
    holds: tuple[Hold, ...]
    opening: float | None


_FINE = 8  # parts of a cubic that are looked at


@dataclass(frozen=True)
class Curve:
    """Cubics between knots, by positions and velocities there."""

    times: np.ndarray
    positions: np.ndarray
    rates: np.ndarray

    def inside(self, parts: int) -> np.ndarray:
        """Return times in every cubic, with both ends."""
        return self.times[:-1, None] + np.diff(self.times)[:, None] * np.linspace(
            0.0, 1.0, parts + 1
        )

    def derivative(
        self, moments: np.ndarray, order: int, number: np.ndarray | None = None
    ) -> np.ndarray:
        """Return values (0), velocities (1) or accelerations (2) of the cubics at some times."""
        k = (
            np.clip(np.searchsorted(self.times, moments, side="right") - 1, 0, len(self.times) - 2)
            if number is None
            else number
        )
        h, since = np.diff(self.times)[k][:, None], (moments - self.times[k])[:, None]
        p, v, step = self.positions[k], self.rates[k], self.positions[k + 1] - self.positions[k]
        c2 = (3.0 * step / h - 2.0 * v - self.rates[k + 1]) / h
        c3 = (v + self.rates[k + 1] - 2.0 * step / h) / h**2
        if order == 0:
            return p + since * (v + since * (c2 + since * c3))
        return (
            v + since * (2.0 * c2 + 3.0 * since * c3) if order == 1 else 2.0 * c2 + 6.0 * since * c3
        )


@dataclass(frozen=True)
class SavedPlan:
    """A plan's file; `says` is its own verdict: violated constraints by name and subject."""

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
    says: list[str]
    terms: int

    @property
    def success(self) -> bool:
        return self.status == "success" and not self.says

    def evaluate(self, moments: np.ndarray) -> np.ndarray:
        """Return all coordinates at some times."""
        if self.curve is not None:
            return self.curve.derivative(moments, 0)
        return np.stack(
            [np.interp(moments, self.times, column) for column in self.positions.T], axis=1
        )

    def fine(self) -> np.ndarray:
        """Return the coordinates at the waypoints and at samples between them."""
        if self.curve is None:
            return self.positions
        return self.evaluate(np.concatenate([self.curve.inside(_FINE).ravel(), self.times]))

    def index(self, name: str) -> int | None:
        return self.names.index(name) if name in self.names else None


def sort_holds(
    held: dict[str, str], by: dict[str, str], measured: Collection[str]
) -> tuple[Hold, ...]:
    """Return holds, each after the one that it hangs on."""
    found: list[Hold] = []
    left = dict(held)
    while left:
        ready = [name for name in left if by.get(name, "").partition(".")[0] not in left]
        if not ready:
            raise ValueError(f"objects hold each other: {left}")
        found += [Hold(name, left.pop(name), by.get(name), name in measured) for name in ready]
    return tuple(found)


def read_plan(path: Path) -> SavedPlan:
    """Return the contents of a plan's file."""
    with np.load(path, allow_pickle=False) as archive:
        about = json.loads(str(archive["about"]))
        times, positions = np.array(archive["times"]), np.array(archive["positions"])
        knots = ("knot_times", "knot_positions", "knot_rates")
        curve = Curve(*(np.array(archive[name]) for name in knots)) if knots[0] in archive else None
    where = about["folder"]
    if "package" in where:
        folder = ROOT / where["package"]
    else:
        beside = path.resolve().parent / where["relative"]
        folder = beside if beside.is_dir() else Path(where["absolute"])
    motion = about["trajectory"]
    said = (about["scene"]["start"].get("held") or {}).items()
    holds, measured = (
        [],
        {name for name, hold in said if isinstance(hold, dict) and "measured" in hold},
    )
    for p in motion["phases"]:
        measured &= (p.get("deviation") or {}).keys()
        holds.append(sort_holds(p["held"], p.get("by") or {}, measured))
    both = zip(motion["phases"], holds, strict=True)
    phases = [Phase(p["name"], p["first"], p["last"], held, p.get("opening")) for p, held in both]
    return SavedPlan(
        scene=about["scene"],
        folder=folder,
        steps=about["steps"],
        options=about["options"],
        names=motion["names"],
        times=times,
        positions=positions,
        curve=curve,
        robot_size=motion["robot_size"],
        phases=phases,
        status=about["status"],
        says=[f"{v['constraint']} {v['subject']}" for v in about["validation"]["violations"]],
        terms=len(about.get("terms", ())),
    )


def read_yaml(path: Path) -> Any:
    """Return the contents of a YAML file."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same in C, where it is compiled
    return yaml.load(path.read_text(encoding="utf-8"), Loader=loader)
