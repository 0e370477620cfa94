"""Opens every object with every robot, from random starts."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS
from vkc_pin.benchmarks.harness.record import trial
from vkc_pin.benchmarks.harness.runner import Execution
from vkc_pin.benchmarks.robot_object_matrix.given import (
    parse_requests,
    prepare_object,
    prepare_robot,
)
from vkc_pin.benchmarks.robot_object_matrix.matrix import chart, format_results
from vkc_pin.benchmarks.robot_object_matrix.pairs import OBJECTS, ROBOTS, SHARE, get_kind, make_pair
from vkc_pin.planning.planner import plan
from vkc_pin.world.models.robot_file import load_robot

__all__ = ["run"]


def run(
    *,
    out: str | Path,
    starts: int = 5,
    seed: int = 0,
    robots: Sequence[str] = ROBOTS,
    objects: Sequence[str] = OBJECTS,
    **execution: Unpack[Execution],
) -> dict[str, Any]:
    """Run the experiment in the folder `out`; see `runner.run`.

    Args:
        out: Folder; see `runner.run`. Robots and objects are imported into its subfolders.
        starts: Number of random starts per combination, at least 1.
        seed: Random seed of starts and planning.
        robots: Names and files for `load_robot`, or MJCF files; "default" stands for `ROBOTS`.
            See `given.parse_requests`.
        objects: `<kind>_<seed>` of `random_object`, names in scenes/objects, descriptions, or URDF,
            MJCF and SDF files; "default" stands for `OBJECTS`.

    Returns:
        See `runner.run`. An unreachable combination has one record of status "unreachable" or
        "no hand", with the reason in `because`.
    """
    runner.check_positive(starts=starts)
    runner.check_folder(out)
    chosen = [parse_requests(robots, "robots", ROBOTS), parse_requests(objects, "objects", OBJECTS)]
    object_files = {one.called: prepare_object(one, Path(out) / "objects") for one in chosen[1]}
    ready = {one.called: prepare_robot(one, Path(out) / "robots") for one in chosen[0]}
    settings = {
        "benchmark": "anything",
        "seed": seed,
        "starts": starts,
        "share": SHARE,
        "robots": list(ready),
        **LIMITS,
    }
    specs = [
        {
            "key": f"{robot}/{name}",
            "robot": robot,
            "object": name,
            "files": [file, path],
            "starts": starts,
            "seed": seed,
        }
        for robot, file in ready.items()
        for name, path in object_files.items()
    ]
    result = runner.run(
        specs, _records, out, settings=settings, format_results=format_results, **execution
    )
    chart(result["trials"], Path(out) / "success.png")
    return result


def _records(spec: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a record of every start, or one if the object is unreachable."""
    seed, (file, object_file) = spec["seed"], spec["files"]
    about: dict[str, Any] = {
        "robot": spec["robot"],
        "object": spec["object"],
        "kind": get_kind(spec["object"]),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings about a robot would repeat for every object
        began = time.perf_counter()
        robot = load_robot(file)
        about["load_time"] = time.perf_counter() - began
        began = time.perf_counter()
        found = make_pair(robot, file, object_file, seed=seed)
        about["look_time"] = time.perf_counter() - began
        if found.scene is None or found.step is None:
            status = "no hand" if found.scene is None else "unreachable"
            out_of_reach = {
                "success": False,
                "status": status,
                "seed": seed,
                "because": found.because,
            }
            return [{**about, **out_of_reach}]
        ((joint, goal),) = found.step.joints.items()
        about |= {"joint": joint, "goal": goal}
        records = []
        for number in range(spec["starts"]):
            scene = found.scene.sample_start(np.random.default_rng([7, seed, number]))
            one = plan(scene, [found.step], seed=seed, **LIMITS)
            because = "; ".join(one.report.notes)
            taken = one.trajectory.phases[-1].held.get(found.step.object, "")
            records.append(
                trial(
                    one,
                    method="VKC",
                    seed=seed,
                    number=number,
                    **about,
                    attachment=taken,
                    because=because,
                )
            )
    return records
