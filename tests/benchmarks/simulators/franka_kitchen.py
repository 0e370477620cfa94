"""Exports resets of FrankaKitchen, and opens its slide cabinet in them.

This script runs where gymnasium-robotics is installed (gymnasium-robotics==1.4.2, mujoco==3.3.7),
without vkc_pin:

    python franka_kitchen.py export FOLDER 0 20
    python franka_kitchen.py execute FOLDER 0 20

Between both, `plan_task.py` runs where vkc_pin is installed, for the arm `chain.xml` of the
environment.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np

gymnasium.register_envs(gymnasium_robotics)

RATE = 12.5  # [Hz] of actions
# The reset is outside of two limits of the joints.
FIRST = 25  # actions for which the arm moves within its limits, before the export
MARGIN = 0.02  # [rad] from the limits there
CLOSE = 12  # actions for which the hand waits while the gripper closes
SETTLE = 12  # actions for which it waits before, and at the end
OPEN = 0.04  # [m]
TASK = "slide cabinet"
JOINT = "slide_cabinet"
ROBOT_JOINTS = [f"robot:panda0_joint{k}" for k in range(1, 8)]


class Kitchen:
    """The environment after a reset, with an arm that stands within its limits."""

    def __init__(self, seed: int) -> None:
        environment: Any = gymnasium.make("FrankaKitchen-v1", tasks_to_complete=[TASK])
        environment.reset(seed=seed)
        self._environment = environment.unwrapped
        self._robot = self._environment.robot_env
        self.model = self._robot.model
        self.data = self._robot.data
        self._rows = [self.model.joint(name).qposadr[0] for name in ROBOT_JOINTS]
        low, high = self.model.jnt_range[[self.model.joint(n).id for n in ROBOT_JOINTS]].T
        inside = np.clip(self.read(), low + MARGIN, high - MARGIN)
        for _ in range(FIRST):
            self.act(inside, OPEN)

    def read(self) -> np.ndarray:
        """Return the positions of the arm [rad]."""
        return np.array(self.data.qpos[self._rows])

    def act(self, target: np.ndarray, opening: float) -> float:
        """Send positions to the actuators for one action; return the largest error [rad].

        The environment's own actions are velocities, under which the arm creeps.
        """
        self._robot.do_simulation(np.append(target, [opening] * 2), self._robot.frame_skip)
        return float(np.abs(self.read() - target).max())

    def is_done(self) -> bool:
        """Return whether the environment counts the task as completed."""
        observation = self._environment._get_obs(self._robot._get_obs())
        achieved = observation["achieved_goal"]
        reward = self._environment.compute_reward(achieved, self._environment.goal, {})
        return bool(reward > 0.0)


def export(folder: Path, seed: int) -> None:
    """Write model and state of a reset."""
    kitchen = Kitchen(seed)
    folder.mkdir(parents=True, exist_ok=True)
    assets = Path(gymnasium_robotics.__file__).parent / "envs" / "assets" / "kitchen_franka"
    spec = mujoco.MjSpec.from_file(str(assets / "kitchen_assets" / "kitchen_env_model.xml"))
    spec.compile()
    spec.meshdir = str(assets / "kitchen_assets" / spec.meshdir)
    spec.texturedir = str(assets / "kitchen_assets" / spec.texturedir)
    (folder / "model.xml").write_text(spec.to_xml())
    np.savez(folder / "state.npz", qpos=kitchen.data.qpos)


def execute(folder: Path, seed: int) -> dict[str, object]:
    """Execute the motion of a reset, and return how it went."""
    if not (folder / "motion.npz").is_file():
        return {"seed": seed, "success": False, "reason": "no plan"}
    kitchen = Kitchen(seed)
    if not np.array_equal(np.load(folder / "state.npz")["qpos"], kitchen.data.qpos):
        raise SystemExit(f"{folder}: the reset is another one")
    motion = np.load(folder / "motion.npz")
    names = [str(name) for name in motion["names"]]
    positions = motion["positions"][:, [names.index(name) for name in ROBOT_JOINTS]]
    errors = []
    was_holding = False
    for target, holds in zip(positions, motion["holding"], strict=True):
        if holds and not was_holding:
            for number in range(SETTLE + CLOSE):
                errors.append(kitchen.act(target, OPEN if number < SETTLE else 0.0))
        errors.append(kitchen.act(target, 0.0 if holds else OPEN))
        was_holding = holds
    for _ in range(SETTLE):
        errors.append(kitchen.act(positions[-1], 0.0))
    return {
        "seed": seed,
        "success": kitchen.is_done(),
        "cabinet": float(kitchen.data.qpos[kitchen.model.joint(JOINT).qposadr[0]]),
        "planned": float(motion["positions"][-1, names.index(JOINT)]),
        "largest_error": max(errors),
        "duration": len(errors) / RATE,
    }


def main() -> None:
    """Run the command line."""
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
        print(f"{count} of {len(results)} cabinets opened")
        (Path(folder) / "results.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
