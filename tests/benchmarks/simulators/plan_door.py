"""Plans robosuite's Door from the files that `robosuite_door.py` exports.

Run it from a checkout, with a robot that `vkc-pin import-robot` made of the Panda's URDF:

    python -m tests.benchmarks.simulators.plan_door FOLDER ROBOT
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from pathlib import Path

import mujoco
import numpy as np

import vkc_pin as vkc

RATE = 20.0  # [Hz] of the environment's actions
# The environment's servos have no feed-forward: they follow late by 2 ζ / ω = 0.12 s, up to 0.7 rad
# at full speed. The motion is executed at a quarter of its speed.
SLOWER = 4.0
# [rad] The latch is clear of the frame from 1.4 on; the handle lags behind the hand, as it slips.
LATCH = 1.55
HINGE = 0.38  # [rad]; the environment asks for 0.3, the joint allows 0.4
# The environment's gripper action moves the fingers, which have other joints there.
JOINTS = {f"panda_joint{k}": f"robot0_joint{k}" for k in range(1, 8)}


def plan_door(folder: Path, robot: str) -> dict[str, object]:
    """Plan the door of a reset, write the motion, and return figures."""
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] = np.load(folder / "state.npz")["qpos"]
    begin = time.perf_counter()
    scene = vkc.scene_from_mujoco(model, data, robot=robot, joints=JOINTS)
    scene_time = time.perf_counter() - begin
    steps = [
        vkc.Actuate("Door_frame", {"Door_latch_joint": LATCH}, attachment="Door_latch_bar"),
        vkc.Actuate("Door_frame", {"Door_hinge": HINGE}),
    ]
    begin = time.perf_counter()
    plan = vkc.plan(scene, steps)
    plan_time = time.perf_counter() - begin
    (folder / "report.txt").write_text(plan.summary())
    result = {
        "folder": folder.name,
        "planned": plan.success,
        "scene_time": round(scene_time, 2),
        "plan_time": round(plan_time, 2),
    }
    if plan.success:
        motion = plan.to_mujoco(model, RATE * SLOWER, data=data, joints=JOINTS)
        names = [name for name in motion.moved if model.joint(name).qposadr.size]
        np.savez(
            folder / "motion.npz",
            times=SLOWER * motion.times,
            names=names,
            positions=motion.positions(names),
            holding=motion.holding,
        )
    else:
        print(plan.summary())
    return result


def main() -> None:
    """Run the command line."""
    folder, robot = sys.argv[1:]
    warnings.simplefilter("ignore")
    results = []
    for place in sorted(path.parent for path in Path(folder).glob("*/model.xml")):
        results.append(plan_door(place, robot))
        print(json.dumps(results[-1]), flush=True)
    Path(folder, "plans.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
