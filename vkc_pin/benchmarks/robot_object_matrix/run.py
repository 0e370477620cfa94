"""Opens every object with every robot, from random starts, where the shapes say that the hand can take hold."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.benchmarks.harness import runner
from vkc_pin.benchmarks.harness.limits import LIMITS
from vkc_pin.benchmarks.harness.record import trial
from vkc_pin.benchmarks.robot_object_matrix.given import parsed, ready_object, ready_robot
from vkc_pin.benchmarks.robot_object_matrix.matrix import chart, report
from vkc_pin.benchmarks.robot_object_matrix.pairs import OBJECTS, ROBOTS, SHARE, kind_of, pair
from vkc_pin.errors import InputError
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
    jobs: int = 1,
    scheduler: str | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run the experiment, or what is left of it, and write results.json, results.csv, table.md and success.png to `out`.

    Args:
        out: The folder; if it has trials of the same settings already, they are not run again.
        starts: How many random starts of each robot at each object, at least 1.
        seed: Of the starts and of planning.
        robots: What `load_robot` takes, or MJCF files, each as such or as "name=..."; "default"
            stands for `ROBOTS`. Those without a description of their hand are imported into
            `out`/robots first, once.
        objects: `<kind>_<seed>` of `random_object`, names in scenes/objects, paths of descriptions,
            or of URDF, MJCF and SDF files, each as such or as "name=..."; "...#link" is that link
            of a file alone, "default" stands for `OBJECTS`. Files are imported into `out`/objects
            first, once.
        jobs: Number of processes.
        scheduler: Address of a Dask scheduler whose workers run the trials instead, see
            `engine.results`.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": ..., "trials": [...]}; see `runner.run`. A combination that is out of reach has one
        record, of status "unreachable", or "no hand" where the robot is to blame, whose `because`
        says why.

    Raises:
        InputError: No starts, the same robot or object twice, or `out` has trials of other
            settings.
        UnknownNameError: There is no such robot or object.
        KeyboardInterrupt: Ctrl-C was pressed; the same call goes on from there.
    """
    if starts < 1:
        raise InputError("out of range", field="starts", expected="at least 1", got=starts)
    runner.check_folder(out)
    chosen = [parsed(robots, "robots", ROBOTS), parsed(objects, "objects", OBJECTS)]
    things = {one.called: ready_object(one, Path(out) / "objects") for one in chosen[1]}
    ready = {one.called: ready_robot(one, Path(out) / "robots") for one in chosen[0]}
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
            "key": f"{robot}/{thing}",
            "robot": robot,
            "object": thing,
            "files": [file, path],
            "starts": starts,
            "seed": seed,
        }
        for robot, file in ready.items()
        for thing, path in things.items()
    ]
    result = runner.run(
        specs,
        _records,
        out,
        settings=settings,
        report=report,
        jobs=jobs,
        scheduler=scheduler,
        progress=progress,
    )
    chart(result["trials"], Path(out) / "success.png")
    return result


def _records(spec: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a record of every start; a single one where the hand can take hold nowhere."""
    seed, (file, thing) = spec["seed"], spec["files"]
    about: dict[str, Any] = {
        "robot": spec["robot"],
        "object": spec["object"],
        "kind": kind_of(spec["object"]),
    }
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # what is said of a robot would be said again of every object
        began = time.perf_counter()
        robot = load_robot(file)
        about["load_time"] = time.perf_counter() - began
        began = time.perf_counter()
        found = pair(robot, file, thing, seed=seed)
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
