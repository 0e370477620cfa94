"""Exports resets of robosuite's Door, and executes motions in them.

This script runs where robosuite is installed (robosuite==1.5.2, mujoco==3.3.7), without vkc_pin:

    python robosuite_door.py export FOLDER 0 20
    python robosuite_door.py execute FOLDER 0 20

Between both, `plan_door.py` runs where vkc_pin is installed.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import robosuite
from robosuite.controllers import load_composite_controller_config

RATE = 20  # [Hz] of actions
# [1/s²] Stiffness of the joints, the largest that the controller's limits allow.
STIFFNESS = 300.0
CLOSE = 12  # actions for which the hand waits while the gripper closes
OPEN = -1.0  # action of the gripper
SHUT = 1.0
SETTLE = 20  # actions after the motion
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
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(environment.sim.model.get_xml())
    np.savez(folder / "state.npz", qpos=environment.sim.data._data.qpos)


def execute(folder: Path, seed: int) -> dict[str, object]:
    """Execute the motion of a reset, and return how it went."""
    if not (folder / "motion.npz").is_file():
        return {"seed": seed, "success": False, "reason": "no plan"}
    environment = make_environment(seed)
    environment.reset()
    sim = environment.sim
    state = np.load(folder / "state.npz")["qpos"]
    if not np.array_equal(state, sim.data._data.qpos):
        raise SystemExit(f"{folder}: the reset is another one")
    motion = np.load(folder / "motion.npz")
    names = [str(name) for name in motion["names"]]
    columns = [names.index(name) for name in ROBOT_JOINTS]
    positions = motion["positions"][:, columns]
    holding = motion["holding"]
    was_holding = False
    errors = []

    def act(target: np.ndarray, gripper: float) -> None:
        environment.step(np.append(target, gripper))
        now = [sim.data.get_joint_qpos(name) for name in ROBOT_JOINTS]
        errors.append(float(np.abs(np.array(now) - target).max()))

    for target, holds in zip(positions, holding, strict=True):
        if holds and not was_holding:
            for _ in range(SETTLE):
                act(target, OPEN)
            for _ in range(CLOSE):
                act(target, SHUT)
        act(target, SHUT if holds else OPEN)
        was_holding = holds
    for _ in range(SETTLE):
        act(positions[-1], SHUT)
    return {
        "seed": seed,
        "success": bool(environment._check_success()),
        "hinge": float(sim.data.get_joint_qpos("Door_hinge")),
        "latch": float(sim.data.get_joint_qpos("Door_latch_joint")),
        "planned": float(motion["positions"][-1, names.index("Door_hinge")]),
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
        print(f"{count} of {len(results)} doors opened")
        (Path(folder) / "results.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
