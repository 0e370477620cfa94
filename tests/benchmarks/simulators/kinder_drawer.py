"""Exports resets of KinDER's kitchen, and opens a drawer of its island in them.

This script runs where KinDER is installed (kindergarden==0.2.5), without vkc_pin:

    python -m tests.benchmarks.simulators.kinder_drawer export FOLDER 0 20
    python -m tests.benchmarks.simulators.kinder_drawer execute FOLDER 0 20
    python -m tests.benchmarks.simulators.kinder_drawer film FOLDER 0 FILE.webp

After `export`, `plan_task.py` runs where vkc_pin is, for the robot `tidybot.xml` of KinDER.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import gymnasium
import kinder
import mujoco
import numpy as np

from .exchange import read_motion, run, write_state

kinder.register_all_environments()
# Registering has changed them.
os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = "egl"

RATE = 10  # [Hz] of actions
CLOSE = 10  # actions for which the hand waits while the gripper closes
SETTLE = 20  # actions for which it waits before, and at the end
FILMED = 3  # actions for each picture of a film
FASTER = 4.0  # speed of a film
DRAWER = "kitchen_island_drawer_s0c0_joint"
OPENED = 0.25  # [m] of 0.6
ROBOT_JOINTS = [
    "robot_joint_x",
    "robot_joint_y",
    "robot_joint_th",
    *(f"robot_joint_{k}" for k in range(1, 8)),
]


def make_environment(seed: int) -> tuple[Any, Any, Any]:
    """Return the environment after a reset, with its model and data."""
    environment: Any = gymnasium.make("kinder/SweepIntoDrawer3D-o5-v0")
    environment.reset(seed=seed)
    robot = environment.unwrapped._object_centric_env._robot_env
    robot.act_delta = False  # absolute positions
    return environment, robot.sim.model.mj_model, robot.sim.data.mj_data


def export(folder: Path, seed: int) -> None:
    """Write model and state of a reset."""
    _, model, data = make_environment(seed)
    mujoco.mj_saveLastXML(str(folder / "model.xml"), model)
    write_state(folder, data.qpos)


def execute(folder: Path, seed: int, states: list[np.ndarray] | None = None) -> dict[str, object]:
    """Execute the motion of a reset, append `qpos` after each action, and return how it went."""
    environment, model, data = make_environment(seed)
    motion = read_motion(folder, data.qpos)
    positions = motion.get_positions(ROBOT_JOINTS)
    velocities = np.gradient(positions, 1.0 / RATE, axis=0)[:, 3:]
    still = np.zeros(velocities.shape[1])
    rows = [model.joint(name).qposadr[0] for name in ROBOT_JOINTS]
    errors = []
    for sample, moves, is_closed in motion.iterate_actions(SETTLE, CLOSE):
        target = positions[sample]
        velocity = velocities[sample] if moves else still
        environment.unwrapped.step(np.concatenate([target, [float(is_closed)], velocity]))
        errors.append(np.abs(data.qpos[rows] - target))
        if states is not None:
            states.append(data.qpos.copy())
    drawer = float(data.qpos[model.joint(DRAWER).qposadr[0]])
    largest = np.max(errors, axis=0)
    return {
        "success": drawer > OPENED,
        "drawer": drawer,
        "planned": motion.get_end(DRAWER),
        "largest_base_error": float(largest[:3].max()),
        "largest_arm_error": float(largest[3:].max()),
        "duration": len(errors) / RATE,
    }


def film(folder: Path, seed: int, file: str) -> None:
    """Write a film of the motion of a reset, four times as fast as it is executed."""
    from PIL import Image

    states = list[np.ndarray]()
    print(execute(folder, seed, states))
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.9, 0.1, 0.5]
    camera.distance, camera.azimuth, camera.elevation = 2.3, 215.0, -20.0
    _, model, data = make_environment(seed)
    renderer = mujoco.Renderer(model, 320, 480)
    pictures = []
    for qpos in states[::FILMED]:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera)
        pictures.append(Image.fromarray(renderer.render()))
    duration = 1000.0 * FILMED / RATE / FASTER  # [ms]
    others = pictures[1:]
    pictures[0].save(
        file, save_all=True, append_images=others, duration=duration, loop=0, quality=60
    )


if __name__ == "__main__":
    if sys.argv[1] == "film":
        parent, number, file = sys.argv[2:]
        film(Path(parent) / f"{int(number):03d}", int(number), file)
    else:
        run(export, execute)
