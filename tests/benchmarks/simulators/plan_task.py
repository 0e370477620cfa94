"""Plans a task of an environment from the files that the script of the environment exports.

Run it from a checkout, with a robot that `vkc-pin import-robot` made:

    python -m tests.benchmarks.simulators.plan_task robosuite_door FOLDER ROBOT
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import mujoco

import vkc_pin as vkc
from vkc_pin.world.task.steps import Step

from .exchange import Motion, read_state, write_motion


@dataclass(frozen=True)
class Task:
    """A task of an environment.

    Attributes:
        steps: The planned steps.
        joints: Name of a joint of the robot → its name in the model.
        rate: The environment's actions per second [Hz].
        slower: Duration of the executed motion over that of the planned one. The environments'
            servos have no feed-forward: they follow late.
        objects: Bodies that are objects. Default: all that move.
        options: Clearances of attachments and motions.
    """

    steps: Sequence[Step]
    joints: Mapping[str, str]
    rate: float
    slower: float
    objects: Literal["auto"] | Sequence[str] = "auto"
    options: vkc.Options = field(default_factory=vkc.Options)


TASKS = {
    # The latch is clear of the frame from 1.4 rad on; the handle lags behind the hand, as it slips.
    # The environment asks for 0.3 rad of the hinge, which allows 0.4. Its gripper action moves the
    # fingers, which have other joints there. Servos are late by 2 ζ / ω = 0.12 s, up to 0.7 rad.
    "robosuite_door": Task(
        steps=(
            vkc.Actuate("Door_frame", {"Door_latch_joint": 1.55}, attachment="Door_latch_bar"),
            vkc.Actuate("Door_frame", {"Door_hinge": 0.38}),
        ),
        joints={f"panda_joint{k}": f"robot0_joint{k}" for k in range(1, 8)},
        rate=20.0,
        slower=4.0,
    ),
    "kinder_drawer": Task(
        steps=(vkc.Actuate("kitchen_island", {"kitchen_island_drawer_s0c0_joint": 0.3}),),
        joints={
            "base_x": "robot_joint_x",
            "base_y": "robot_joint_y",
            "base_yaw": "robot_joint_th",
            **{f"joint_{k}": f"robot_joint_{k}" for k in range(1, 8)},
        },
        rate=10.0,
        slower=4.0,
        objects=("kitchen_island_drawer_s0c0",),
    ),
    # The environment asks for less than 0.3 m from 0.37 m.
    "franka_kitchen": Task(
        steps=(vkc.Actuate("slide", {"slide_cabinet": 0.37}),),
        joints={f"robot_panda0_joint{k}": f"robot:panda0_joint{k}" for k in range(1, 8)},
        rate=12.5,
        slower=4.0,
        objects=("slidelink",),
    ),
    # Handle and front are 16 mm apart. The environment asks for 0.14 m.
    "libero_drawer": Task(
        steps=(vkc.Actuate("wooden_cabinet_1_base", {"wooden_cabinet_1_top_level": -0.155}),),
        joints={f"panda_joint{k}": f"robot0_joint{k}" for k in range(1, 8)},
        rate=20.0,
        slower=4.0,
        objects=("wooden_cabinet_1_base",),
        options=vkc.Options(dist_safe=0.003, grasp_clearance=0.002),
    ),
}


def plan_reset(task: Task, folder: Path, robot: str) -> dict[str, object]:
    """Plan a task from a reset, write the motion, and return figures."""
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] = read_state(folder)
    begin = time.perf_counter()
    scene = vkc.scene_from_mujoco(
        model,
        data,
        robot=robot,
        joints=task.joints,
        objects=task.objects,
        options=task.options,
    )
    scene_time = time.perf_counter() - begin
    begin = time.perf_counter()
    plan = vkc.plan(scene, task.steps, options=task.options)
    plan_time = time.perf_counter() - begin
    (folder / "report.txt").write_text(plan.summary())
    result = {
        "folder": folder.name,
        "planned": plan.success,
        "scene_time": round(scene_time, 2),
        "plan_time": round(plan_time, 2),
    }
    if plan.success:
        rate = task.rate * task.slower
        motion = plan.to_mujoco(model, rate, data=data, joints=task.joints)
        names = [name for name in motion.moved if model.joint(name).qposadr.size]
        write_motion(folder, Motion(names, motion.positions(names), motion.holding))
    else:
        print(plan.summary())
    return result


def main() -> None:
    """Run the command line."""
    name, folder, robot = sys.argv[1:]
    warnings.simplefilter("ignore")
    results = []
    for place in sorted(path.parent for path in Path(folder).glob("*/model.xml")):
        results.append(plan_reset(TASKS[name], place, robot))
        print(json.dumps(results[-1]), flush=True)
    Path(folder, "plans.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
