"""Exports resets of FrankaKitchen, and opens its slide cabinet in them.

This script runs where gymnasium-robotics is installed (gymnasium-robotics==1.4.2, mujoco==3.3.7),
without vkc_pin:

    python -m tests.benchmarks.simulators.franka_kitchen export FOLDER 0 20
    python -m tests.benchmarks.simulators.franka_kitchen execute FOLDER 0 20

Between both, `plan_task.py` runs where vkc_pin is installed, for the arm `chain.xml` of the
environment.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np

from .exchange import read_motion, run, write_state

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
    assets = Path(gymnasium_robotics.__file__).parent / "envs" / "assets" / "kitchen_franka"
    spec = mujoco.MjSpec.from_file(str(assets / "kitchen_assets" / "kitchen_env_model.xml"))
    spec.compile()
    spec.meshdir = str(assets / "kitchen_assets" / spec.meshdir)
    spec.texturedir = str(assets / "kitchen_assets" / spec.texturedir)
    (folder / "model.xml").write_text(spec.to_xml())
    write_state(folder, kitchen.data.qpos)


def execute(folder: Path, seed: int) -> dict[str, object]:
    """Execute the motion of a reset, and return how it went."""
    kitchen = Kitchen(seed)
    motion = read_motion(folder, kitchen.data.qpos)
    positions = motion.get_positions(ROBOT_JOINTS)
    errors = []
    for sample, _, is_closed in motion.iterate_actions(SETTLE, CLOSE):
        errors.append(kitchen.act(positions[sample], 0.0 if is_closed else OPEN))
    return {
        "success": kitchen.is_done(),
        "cabinet": float(kitchen.data.qpos[kitchen.model.joint(JOINT).qposadr[0]]),
        "planned": motion.get_end(JOINT),
        "largest_error": max(errors),
        "duration": len(errors) / RATE,
    }


if __name__ == "__main__":
    run(export, execute)
