"""Exports resets of KinDER's kitchen, and opens a drawer of its island in them.

This script runs where KinDER is installed (kindergarden==0.2.5), without vkc_pin:

    python kinder_drawer.py export FOLDER 0 20
    python kinder_drawer.py execute FOLDER 0 20
    python kinder_drawer.py film FOLDER 0 FILE.webp

After `export`, `plan_task.py` runs where vkc_pin is, for the robot `tidybot.xml` of KinDER.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import kinder
import mujoco
import numpy as np

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
    folder.mkdir(parents=True, exist_ok=True)
    mujoco.mj_saveLastXML(str(folder / "model.xml"), model)
    np.savez(folder / "state.npz", qpos=data.qpos)


def execute(
    folder: Path, seed: int, watch: Callable[[Any, Any], None] | None = None
) -> dict[str, object]:
    """Execute the motion of a reset, and return how it went; `watch` sees the simulation."""
    if not (folder / "motion.npz").is_file():
        return {"seed": seed, "success": False, "reason": "no plan"}
    environment, model, data = make_environment(seed)
    if not np.array_equal(np.load(folder / "state.npz")["qpos"], data.qpos):
        raise SystemExit(f"{folder}: the reset is another one")
    motion = np.load(folder / "motion.npz")
    names = [str(name) for name in motion["names"]]
    positions = motion["positions"][:, [names.index(name) for name in ROBOT_JOINTS]]
    velocities = np.gradient(positions, 1.0 / RATE, axis=0)[:, 3:]
    rows = [model.joint(name).qposadr[0] for name in ROBOT_JOINTS]
    errors = []

    def act(target: np.ndarray, velocity: np.ndarray, closed: bool) -> None:
        action = np.concatenate([target, [float(closed)], velocity])
        environment.unwrapped.step(action)
        errors.append(np.abs(data.qpos[rows] - target))
        if watch is not None:
            watch(model, data)

    still = np.zeros(7)
    was_holding = False
    for target, velocity, holds in zip(positions, velocities, motion["holding"], strict=True):
        if holds and not was_holding:
            for number in range(SETTLE + CLOSE):
                act(target, still, closed=number >= SETTLE)
        act(target, velocity, closed=bool(holds))
        was_holding = holds
    for _ in range(SETTLE):
        act(positions[-1], still, closed=bool(was_holding))
    drawer = float(data.qpos[model.joint(DRAWER).qposadr[0]])
    largest = np.max(errors, axis=0)
    return {
        "seed": seed,
        "success": drawer > OPENED,
        "drawer": drawer,
        "planned": float(motion["positions"][-1, names.index(DRAWER)]),
        "largest_base_error": float(largest[:3].max()),
        "largest_arm_error": float(largest[3:].max()),
        "duration": len(errors) / RATE,
    }


def film(folder: Path, seed: int, file: str) -> None:
    """Write a film of the motion of a reset, four times as fast as it is executed."""
    from PIL import Image

    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.9, 0.1, 0.5]
    camera.distance, camera.azimuth, camera.elevation = 2.3, 215.0, -20.0
    pictures = list[Image.Image]()
    renderers = list[Any]()
    count = 0

    def watch(model: Any, data: Any) -> None:
        nonlocal count
        count += 1
        if count % FILMED:
            return
        if not renderers:
            renderers.append(mujoco.Renderer(model, 320, 480))
        renderers[0].update_scene(data, camera)
        pictures.append(Image.fromarray(renderers[0].render()))

    print(execute(folder, seed, watch))
    duration = 1000.0 * FILMED / RATE / FASTER  # [ms]
    others = pictures[1:]
    pictures[0].save(
        file, save_all=True, append_images=others, duration=duration, loop=0, quality=60
    )


def main() -> None:
    """Run the command line."""
    if sys.argv[1] == "film":
        parent, number, file = sys.argv[2:]
        film(Path(parent) / f"{int(number):03d}", int(number), file)
        return
    command, folder, first, last = sys.argv[1:]
    results = []
    for seed in range(int(first), int(last)):
        place = Path(folder) / f"{seed:03d}"
        if command == "export":
            export(place, seed)
        else:
            results.append(execute(place, seed))
            print(json.dumps(results[-1]), flush=True)
    if results:
        count = sum(bool(result["success"]) for result in results)
        print(f"{count} of {len(results)} drawers opened")
        (Path(folder) / "results.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
