"""Imports robots from their makers' files and lets them reach random poses."""

from __future__ import annotations

import subprocess
import sys
import time
import warnings
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, VkcError
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.record import Record, distribution, trial
from vkc_pin.experiments.harness.runner import LIMITS, Execution, describe_limit
from vkc_pin.experiments.harness.tables import (
    JUDGED,
    format_decimal,
    format_table,
    join_sections,
    select,
)
from vkc_pin.importing.robots.rest_configuration import Clearances
from vkc_pin.importing.robots.robot_import import import_robot
from vkc_pin.options import Options
from vkc_pin.planning.prepare import plan
from vkc_pin.world.files.srdf import read_srdf
from vkc_pin.world.files.writing import check_name
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import list_robots, load_robot
from vkc_pin.world.models.self_collisions import set_collision_pairs
from vkc_pin.world.scene.scene import load_scene
from vkc_pin.world.task.steps import Reach

_AWAY = 1.0  # [m] from the start, along x and along y, that the base drives at most
# configurations for each pose: some of an arm folded tightly are free in one of a hundred
_TRIES = 20_000
ROBOTS = (
    *(
        "tiago",
        "tiago_no_hand",
        "tiago_dual",
        "tiago_pro",
        "pr2",
        "baxter",
        "centauro",
        "anymal-kinova",
        "b1-z1",
    ),
    *("panda", "panda_collision", "xarm7", "kinova", "z1", "so100", "so101", "talos_left_arm"),
    *(
        "ur3",
        "ur3_joint_limited",
        "ur3_gripper",
        "ur5",
        "ur5_joint_limited",
        "ur5_gripper",
        "ur10",
        "ur10_joint_limited",
    ),
)
"""The mobile manipulators and the arms of example-robot-data."""
_FORMATS = (".urdf", ".xacro", ".xml", ".mjcf")
_NOT_IMPORTED = ("not imported", "hardly free")
_HEAD = (
    *(
        "robot",
        "base",
        "planned joints",
        "pairs",
        "import [s]",
        "load again [s]",
        "clearance at home [mm]",
        "reached",
    ),
    *("time, median [s]", "95th percentile [s]"),
)
_LOAD = """
import sys, time, warnings
warnings.simplefilter("ignore")
from vkc_pin.world.models.robot_file import load_robot
began = time.process_time()
load_robot(sys.argv[1])
print(time.process_time() - began)
"""


def sample_reachable_poses(robot: Robot, name: str, number: int, *, seed: int = 0) -> list[pin.SE3]:
    """Sample tool poses of random configurations in which the robot keeps its default margins.

    The base moves up to 1 m along x and y; unlimited joints stay within ±π.

    Args:
        robot: Robot with collision pairs.
        name: Name, which determines the random numbers together with `seed`.
        number: Number of poses.
        seed: Random seed.

    Raises:
        VkcError: Hardly any configuration is free.
    """
    rng = np.random.default_rng([11, seed, zlib.crc32(name.encode())])
    low = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
    high = np.where(np.isfinite(robot.upper), robot.upper, np.pi)
    low[:3] = (-_AWAY, -_AWAY, -np.pi)
    high[:3] = (_AWAY, _AWAY, np.pi)
    clearances = Clearances(robot)
    data = robot.model.createData()
    frame = robot.model.getFrameId(robot.tool_frame)
    poses = list[pin.SE3]()
    for _ in range(number * _TRIES):
        if len(poses) == number:
            return poses
        z = rng.uniform(low, high)
        clearances.place(z[3:])
        if clearances.is_free():
            pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
            pose = data.oMf[frame]
            if pose.translation[2] > Options().dist_safe:
                poses.append(pose.copy())
    raise VkcError(
        f"{name}: only {len(poses)} of {number * _TRIES} random configurations are free of "
        "collision"
    )


def run(
    *,
    out: str | Path,
    goals: int = 20,
    seed: int = 0,
    robots: Sequence[str] = ROBOTS,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder; see `runner.run`. Robots are imported into its subfolder.
        goals: Number of poses per robot, at least 1.
        seed: Random seed of poses, importing and planning.
        robots: Names of example-robot-data, or URDF, xacro and MJCF files.

    Returns:
        See `runner.run`. A robot that cannot be imported has one record of status "not imported",
        one that is hardly ever free of collision one of status "hardly free".
    """
    runner.check_positive(goals=goals)
    files = _files(robots)
    settings = {
        "benchmark": "robots",
        "seed": seed,
        "goals": goals,
        "robots": list(files),
        **LIMITS,
    }
    specs = [
        {
            "key": name,
            "robot": name,
            "file": str(file),
            "out": str(out),
            "goals": goals,
            "seed": seed,
        }
        for name, file in files.items()
    ]
    return runner.run(
        specs, _records, out, settings=settings, format_results=format_results, **execution
    )


def format_results(result: Mapping[str, Any]) -> str:
    """Return the tables of a result in Markdown."""
    about = result["meta"]
    records = result["trials"]
    failed = [
        [r["robot"], str(r["status"]), r.get("because") or "; ".join(r.get("violations", ())[:1])]
        for r in records
        if not r["success"]
    ]
    rows = [_row(name, select(records, robot=name)) for name in about["robots"]]
    section = ["## What failed", format_table(("robot", "status", "because"), failed, text=3)]
    return join_sections(
        about,
        "# Robots",
        "Robots are imported from their makers' files alone; each then reaches, on the base that "
        "the import assumes, "
        f"{about['goals']} random poses of free configurations, seed {about['seed']}, "
        f"{describe_limit(about)} each. {JUDGED} Importing, and loading again in a new process, "
        "are in "
        "processor time. Clearance at home is the least distance between links that are not "
        "neighbours, and of the arm to the floor.",
        format_table(_HEAD, rows, text=2),
        *(section if failed else []),
    )


def _row(name: str, own: Sequence[Record]) -> list[str]:
    first = own[0]
    if first["status"] == "error" or "import_time" not in first:
        return [name, *["–"] * (len(_HEAD) - 1)]
    good = sum(bool(record["success"]) for record in own)
    reached = "–" if first["status"] in _NOT_IMPORTED else f"{good}/{len(own)}"
    times = map(format_decimal, distribution(own, "planning_time"))
    loads = (format_decimal(first[field]) for field in ("import_time", "load_time"))
    # None means that nothing could come close.
    room = "–" if first["home_room"] is None else f"{1e3 * first['home_room']:.0f}"
    counts = [str(first["joints"]), str(first["pairs"])]
    return [name, first["base"], *counts, *loads, room, reached, *times]


def _files(robots: Sequence[str]) -> dict[str, Path]:
    """Return name → file of each robot; files of one name are prefixed by their folders."""
    known = list_robots()
    found = list[tuple[str, Path]]()
    for robot in map(str, robots):
        path = Path(robot)
        if path.suffix.lower() in _FORMATS:
            if not path.is_file():
                raise InputError(
                    "there is no such file",
                    file=path,
                    field="robots",
                    expected="a URDF, xacro or MJCF file",
                )
            found.append((path.name.split(".")[0], path.resolve()))
        else:
            names = {name: file for name, file in known.items() if file.suffix == ".urdf"}
            found += [(name, names[name]) for name in runner.select_names("robot", [robot], names)]
    stems = [name for name, _ in found]
    named = {
        name if stems.count(name) == 1 else f"{file.parent.name}_{name}": file
        for name, file in found
    }
    if not named or len(named) < len(found):
        raise InputError(
            "not a choice",
            field="robots",
            expected="names or files, each once",
            got=" ".join(stems) or "none",
        )
    return named


def _records(spec: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a record of every pose, or one if the robot is unusable."""
    seed = spec["seed"]
    name = spec["robot"]
    folder = Path(spec["out"]) / "robots" / check_name(name, "robots")
    about: dict[str, Any] = {"robot": name}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # findings of the import are in its report
        try:
            began = time.process_time()
            imported = import_robot(spec["file"], folder, seed=seed, force=True)
            about["import_time"] = time.process_time() - began
        except InputError as error:
            # The text is the same wherever packages are.
            because = str(error).replace(str(Path(spec["file"]).parent), "").lstrip("/")
            return [
                {
                    **about,
                    "success": False,
                    "status": "not imported",
                    "seed": seed,
                    "because": because,
                }
            ]
        scene = load_scene(folder / "scene.yaml")
        about |= {"base": scene.robot.base, **_facts(imported.robot, folder)}
        try:
            poses = sample_reachable_poses(imported.robot, name, spec["goals"], seed=seed)
        except VkcError as error:
            return [
                {
                    **about,
                    "success": False,
                    "status": "hardly free",
                    "seed": seed,
                    "because": str(error),
                }
            ]
        records = []
        for number, pose in enumerate(poses):
            one = plan(scene, [Reach(pose)], seed=seed, **LIMITS)
            because = "; ".join(one.report.notes)
            records.append(
                trial(one, method="VKC", seed=seed, number=number, **about, because=because)
            )
    return records


def _facts(robot: Robot, folder: Path) -> dict[str, Any]:
    """Measure an imported robot."""
    said = subprocess.run(
        [sys.executable, "-c", _LOAD, str(folder)], capture_output=True, text=True, check=True
    )
    every = load_robot(folder, pairs="all")
    (srdf,) = folder.glob("*.srdf")
    allowed = read_srdf(srdf, every.file.root).allowed
    look = Clearances(set_collision_pairs(every, allowed))
    look.place(robot.home)  # also of pairs that loading exempts since they overlap there
    links = {
        tuple(sorted((robot.link_of(pair.first), robot.link_of(pair.second))))
        for pair in robot.collision.collisionPairs
    }
    return {
        "load_time": float(said.stdout),
        "joints": len(robot.home),
        "pairs": len(links),
        "home_room": look.least(),
    }
