"""Reads exported motions, and the limits of their coordinates from URDF and YAML files."""

from __future__ import annotations

import csv
import json
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

__all__ = ["Limits", "Motion", "read_csv", "read_limits", "read_npz"]

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Motion:
    """Cubics in time: times (K,) [s], positions and velocities (K, n), names of coordinates."""

    names: list[str]
    times: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray


@dataclass(frozen=True)
class Limits:
    """Limits of a coordinate, SI units; infinite if not given."""

    low: float = -math.inf
    high: float = math.inf
    velocity: float = math.inf
    acceleration: float = math.inf
    jerk: float = math.inf


def read_npz(path: Path) -> tuple[Motion, dict[str, Any]]:
    """Return the motion and the metadata of a saved plan."""
    with np.load(path, allow_pickle=False) as archive:
        about = json.loads(str(archive["about"]))
        knots = [
            np.array(archive[name], float)
            for name in ("knot_times", "knot_positions", "knot_rates")
        ]
    return Motion(about["trajectory"]["names"], *knots), about


def read_csv(path: Path) -> Motion:
    """Return the motion in an exported table, a line a knot."""
    with path.open(encoding="utf-8", newline="") as file:
        head, *lines = list(csv.reader(file))
    plain = [cell.rpartition(" [")[0] for cell in head]
    speeds = {
        cell.removesuffix(" velocity"): k
        for k, cell in enumerate(plain)
        if cell.endswith(" velocity")
    }
    names = [cell for cell in plain if cell in speeds]
    rows = np.array([[float(cell) for cell in line[: max(speeds.values()) + 1]] for line in lines])
    columns = [plain.index(name) for name in names]
    return Motion(
        names,
        rows[:, plain.index("time")],
        rows[:, columns],
        rows[:, [speeds[name] for name in names]],
    )


def read_limits(about: dict[str, Any], plan: Path) -> dict[str, Limits]:
    """Return the limits of every coordinate that a plan's scene can have."""
    scene, where = about["scene"], about["folder"]
    folder = ROOT / where["package"] if "package" in where else Path(where["absolute"])
    if "relative" in where and (beside := plan.resolve().parent / where["relative"]).is_dir():
        folder = beside
    found = _read_robot(scene, folder)
    for item in scene.get("objects") or ():
        found |= _read_object(item, folder)
    grows = about["options"].get("jerk_time", 0.0)
    return (
        {name: replace(own, jerk=own.acceleration / grows) for name, own in found.items()}
        if grows
        else found
    )


def _read_robot(scene: dict[str, Any], folder: Path) -> dict[str, Limits]:
    named = scene["robot"] if isinstance(scene["robot"], str) else scene["robot"]["name"]
    file = ROOT / "robots" / named / "robot.yaml"
    if not file.is_file():
        file = folder / named
    own = yaml.safe_load(file.read_text(encoding="utf-8"))
    base, joints, arena = own.get("base") or {}, own.get("joints") or {}, scene.get("arena") or {}
    spans = base.get("position", ((-20.0, 20.0), (-20.0, 20.0)))
    speeds, strengths = (
        base.get("velocity", (1.0, 1.0, 2.0)),
        base.get("acceleration", (3.0, 3.0, 6.0)),
    )
    found = {"base_yaw": Limits(velocity=speeds[2], acceleration=strengths[2])}
    for k, axis in enumerate("xy"):
        low, high = arena.get(axis, spans[k])
        found[f"base_{axis}"] = Limits(
            max(low, spans[k][0]), min(high, spans[k][1]), speeds[k], strengths[k]
        )
    for name, limit in _read_urdf((file.parent / own["urdf"]).read_text(encoding="utf-8")).items():
        said = joints.get(name, {})
        velocity = said.get(
            "velocity", limit.velocity if math.isfinite(limit.velocity) else math.pi
        )
        found[name] = Limits(limit.low, limit.high, velocity, said.get("acceleration", 1.4))
    return found


def _read_object(item: dict[str, Any], folder: Path) -> dict[str, Limits]:
    kind = item["type"]
    if isinstance(kind, str):
        given = kind.endswith((".yaml", ".yml")) or "/" in kind
        file = folder / kind if given else ROOT / "scenes" / "objects" / f"{kind}.yaml"
        own, folder = yaml.safe_load(file.read_text(encoding="utf-8")), file.parent
    else:
        own = kind
    text = (
        own["urdf"]
        if own["urdf"].lstrip().startswith("<")
        else (folder / own["urdf"]).read_text(encoding="utf-8")
    )
    found, joints = dict[str, Limits](), own.get("joints") or {}
    for name, limit in _read_urdf(text).items():
        said = joints.get(name, {})
        velocity = said.get("velocity", limit.velocity if math.isfinite(limit.velocity) else 1.0)
        found[f"{item['name']}.{name}"] = Limits(
            limit.low, limit.high, velocity, said.get("acceleration", 2.0)
        )
    for entry in own.get("attachments") or ():
        found |= {
            f"{item['name']}.{name}": Limits(*span) for name, span in _read_freedoms(entry).items()
        }
    return found


def _read_freedoms(entry: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """Return name → lower and upper limit of an attachment's freedoms."""
    name, joint = entry["name"], entry.get("joint", "fixed")
    if "freedoms" in entry:
        return {f"{name}_{own['name']}": tuple(own["limits"]) for own in entry["freedoms"]}
    if joint == "spherical":
        return {f"{name}_{axis}": tuple(entry.get("limits", (-math.pi, math.pi))) for axis in "xyz"}
    if joint == "cylindrical":
        return {f"{name}_slide": tuple(entry["limits"]), f"{name}_turn": tuple(entry["turn"])}
    return {} if joint == "fixed" else {name: tuple(entry["limits"])}


def _read_urdf(text: str) -> dict[str, Limits]:
    """Return the limits of a URDF's movable joints."""
    found = {}
    for joint in ElementTree.fromstring(text).findall("joint"):
        if joint.get("type") not in ("revolute", "prismatic", "continuous"):
            continue
        said = joint.find("limit")
        values = {} if said is None else {key: float(value) for key, value in said.attrib.items()}
        low, high = values.get("lower", 0.0), values.get("upper", 0.0)
        if joint.get("type") == "continuous":
            low, high = -math.inf, math.inf
        found[joint.attrib["name"]] = Limits(low, high, values.get("velocity", math.inf))
    return found
