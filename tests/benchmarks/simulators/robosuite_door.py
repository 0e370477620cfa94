"""Exports resets of robosuite's Door, and executes motions in them.

This script runs where robosuite is installed (robosuite==1.5.2, mujoco==3.3.7), without vkc_pin:

    python -m tests.benchmarks.simulators.robosuite_door export FOLDER 0 20
    python -m tests.benchmarks.simulators.robosuite_door execute FOLDER 0 20

Between both, `plan_door.py` runs where vkc_pin is installed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import robosuite
from robosuite.controllers import load_composite_controller_config

from .exchange import read_motion, run, write_state

RATE = 20  # [Hz] of actions
# [1/s²] Stiffness of the joints, the largest that the controller's limits allow.
STIFFNESS = 300.0
CLOSE = 12  # actions for which the hand waits while the gripper closes
OPEN = -1.0  # action of the gripper
SHUT = 1.0
SETTLE = 20  # actions for which it waits before, and at the end
ROBOT_JOINTS = [f"robot0_joint{k}" for k in range(1, 8)]


def make_environment(seed: int) -> Any:
    """Return the environment with absolute joint positions as actions."""
    config = load_composite_controller_config(controller="BASIC")
    arm = config["body_parts"]["right"]
    arm.update(type="JOINT_POSITION", input_type="absolute", kp=STIFFNESS, damping_ratio=1.0)
    for name in ("input_ref_frame", "uncouple_pos_ori"):
        arm.pop(name, None)
    return robosuite.make(
        "Door",
        robots="Panda",
        controller_configs=config,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        control_freq=RATE,
        ignore_done=True,
        seed=seed,
    )


def export(folder: Path, seed: int) -> None:
    """Write model and state of a reset."""
    environment = make_environment(seed)
    environment.reset()
    (folder / "model.xml").write_text(environment.sim.model.get_xml())
    write_state(folder, environment.sim.data._data.qpos)


def execute(folder: Path, seed: int) -> dict[str, object]:
    """Execute the motion of a reset, and return how it went."""
    environment = make_environment(seed)
    environment.reset()
    sim = environment.sim
    motion = read_motion(folder, sim.data._data.qpos)
    positions = motion.get_positions(ROBOT_JOINTS)
    errors = []
    for sample, _, is_closed in motion.iterate_actions(SETTLE, CLOSE):
        target = positions[sample]
        environment.step(np.append(target, SHUT if is_closed else OPEN))
        now = [sim.data.get_joint_qpos(name) for name in ROBOT_JOINTS]
        errors.append(float(np.abs(np.array(now) - target).max()))
    return {
        "success": bool(environment._check_success()),
        "hinge": float(sim.data.get_joint_qpos("Door_hinge")),
        "latch": float(sim.data.get_joint_qpos("Door_latch_joint")),
        "planned": motion.get_end("Door_hinge"),
        "largest_error": max(errors),
        "duration": len(errors) / RATE,
    }


if __name__ == "__main__":
    run(export, execute)
