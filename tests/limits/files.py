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
    """A motion of cubics: times (K,) [s], positions and velocities (K, n), coordinate names."""

    names: list[str]
    times: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray


@dataclass(frozen=True)
class Limits:
    """Limits of a coordinate, in SI units. Default: infinite."""

    low: float = -math.inf
    high: float = math.inf
    velocity: float = math.inf
    acceleration: float = math.inf
    jerk: float = math.inf


def read_npz(path: Path) -> tuple[Motion, dict[str, Any]]:
    """Return the motion and the metadata of a saved plan."""
    with np.load(path, allow_pickle=False) as archive:
        metadata = json.loads(str(archive["about"]))
        knots = [
            np.array(archive[name], float)
            for name in ("knot_times", "knot_positions", "knot_rates")
        ]
    return Motion(metadata["trajectory"]["names"], *knots), metadata


def read_csv(path: Path) -> Motion:
    """Return the motion in an exported table with one line per knot."""
    with path.open(encoding="utf-8", newline="") as file:
        head, *lines = list(csv.reader(file))
    titles = [cell.rpartition(" [")[0] for cell in head]
    velocity_columns = {
        cell.removesuffix(" velocity"): k
        for k, cell in enumerate(titles)
        if cell.endswith(" velocity")
    }
    names = [cell for cell in titles if cell in velocity_columns]
    rows = np.array(
        [[float(cell) for cell in line[: max(velocity_columns.values()) + 1]] for line in lines]
    )
    columns = [titles.index(name) for name in names]
    return Motion(
        names,
        rows[:, titles.index("time")],
        rows[:, columns],
        rows[:, [velocity_columns[name] for name in names]],
    )


def read_limits(metadata: dict[str, Any], plan: Path) -> dict[str, Limits]:
    """Return the limits of all coordinates of a plan's scene."""
    scene, location = metadata["scene"], metadata["folder"]
    folder = ROOT / location["package"] if "package" in location else Path(location["absolute"])
    if "relative" in location and (beside := plan.resolve().parent / location["relative"]).is_dir():
        folder = beside
    limits = _read_robot(scene, folder)
    for item in scene.get("objects") or ():
        limits |= _read_object(item, folder)
    jerk_time = metadata["options"].get("jerk_time", 0.0)
    return (
        {
            name: replace(limit, jerk=limit.acceleration / jerk_time)
            for name, limit in limits.items()
        }
        if jerk_time
        else limits
    )


def _read_robot(scene: dict[str, Any], folder: Path) -> dict[str, Limits]:
    robot_name = scene["robot"] if isinstance(scene["robot"], str) else scene["robot"]["name"]
    file = ROOT / "robots" / robot_name / "robot.yaml"
    if not file.is_file():
        file = folder / robot_name
    description = yaml.safe_load(file.read_text(encoding="utf-8"))
    base, joints, arena = (
        description.get("base") or {},
        description.get("joints") or {},
        scene.get("arena") or {},
    )
    ranges = base.get("position", ((-20.0, 20.0), (-20.0, 20.0)))
    velocities, accelerations = (
        base.get("velocity", (1.0, 1.0, 2.0)),
        base.get("acceleration", (3.0, 3.0, 6.0)),
    )
    limits = {"base_yaw": Limits(velocity=velocities[2], acceleration=accelerations[2])}
    for k, axis in enumerate("xy"):
        low, high = arena.get(axis, ranges[k])
        limits[f"base_{axis}"] = Limits(
            max(low, ranges[k][0]), min(high, ranges[k][1]), velocities[k], accelerations[k]
        )
    for name, limit in _read_urdf(
        (file.parent / description["urdf"]).read_text(encoding="utf-8")
    ).items():
        settings = joints.get(name, {})
        velocity = settings.get(
            "velocity", limit.velocity if math.isfinite(limit.velocity) else math.pi
        )
        limits[name] = Limits(limit.low, limit.high, velocity, settings.get("acceleration", 1.4))
    return limits


def _read_object(item: dict[str, Any], folder: Path) -> dict[str, Limits]:
    kind = item["type"]
    if isinstance(kind, str):
        is_path = kind.endswith((".yaml", ".yml")) or "/" in kind
        file = folder / kind if is_path else ROOT / "scenes" / "objects" / f"{kind}.yaml"
        description, folder = yaml.safe_load(file.read_text(encoding="utf-8")), file.parent
    else:
        description = kind
    text = (
        description["urdf"]
        if description["urdf"].lstrip().startswith("<")
        else (folder / description["urdf"]).read_text(encoding="utf-8")
    )
    limits, joints = dict[str, Limits](), description.get("joints") or {}
    for name, limit in _read_urdf(text).items():
        settings = joints.get(name, {})
        velocity = settings.get(
            "velocity", limit.velocity if math.isfinite(limit.velocity) else 1.0
        )
        limits[f"{item['name']}.{name}"] = Limits(
            limit.low, limit.high, velocity, settings.get("acceleration", 2.0)
        )
    for entry in description.get("attachments") or ():
        limits |= {
            f"{item['name']}.{name}": Limits(*bounds)
            for name, bounds in _read_freedoms(entry).items()
        }
    return limits


def _read_freedoms(entry: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """Return the lower and upper limits of an attachment's freedoms, by name."""
    name, joint = entry["name"], entry.get("joint", "fixed")
    if "freedoms" in entry:
        return {
            f"{name}_{freedom['name']}": tuple(freedom["limits"]) for freedom in entry["freedoms"]
        }
    if joint == "spherical":
        return {f"{name}_{axis}": tuple(entry.get("limits", (-math.pi, math.pi))) for axis in "xyz"}
    if joint == "cylindrical":
        return {f"{name}_slide": tuple(entry["limits"]), f"{name}_turn": tuple(entry["turn"])}
    return {} if joint == "fixed" else {name: tuple(entry["limits"])}


def _read_urdf(text: str) -> dict[str, Limits]:
    """Return the limits of a URDF's movable joints."""
    limits = {}
    for joint in ElementTree.fromstring(text).findall("joint"):
        if joint.get("type") not in ("revolute", "prismatic", "continuous"):
            continue
        limit = joint.find("limit")
        values = {} if limit is None else {key: float(value) for key, value in limit.attrib.items()}
        low, high = values.get("lower", 0.0), values.get("upper", 0.0)
        if joint.get("type") == "continuous":
            low, high = -math.inf, math.inf
        limits[joint.attrib["name"]] = Limits(low, high, values.get("velocity", math.inf))
    return limits
