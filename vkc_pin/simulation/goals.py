"""By how much an executed motion misses what its steps ask for, each at the time at which the plan has it done."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Step, Touch
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Miss", "missed"]

_DONE = 2e-3  # [m] or [rad] within which a plan has a step done


@dataclass(frozen=True)
class Miss:
    """How far something is from where a step wants it.

    Attributes:
        step: Which one, from 1.
        subject: The coordinate, frame or object.
        amount: By how much, in `unit`.
        unit: "m" or "rad".
        time: When [s].
    """

    step: int
    subject: str
    amount: float
    unit: str
    time: float

    def __str__(self) -> str:
        amount = f"{1e3 * self.amount:.1f} mm" if self.unit == "m" else f"{self.amount:.4f} rad"
        return f"step {self.step}: {self.subject} misses its goal by {amount} at {self.time:.2f} s"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data of it."""
        return asdict(self)


def missed(
    scene: Scene,
    steps: Sequence[Step],
    trajectory: Trajectory,
    world: World,
    times: Floats,
    rows: Floats,
) -> tuple[Miss, ...]:
    """Return how far everything that was asked for is from where it should be.

    Each step is looked at when the plan has it done first, after those before it; the last one at
    the end.

    Args:
        scene: The scene that was planned in.
        steps: What was asked for.
        trajectory: The plan.
        world: The tree of what happened.
        times: When it was looked at, shape (K,) [s].
        rows: Where everything was, shape (K, n).
    """
    planned = World(scene)
    edges = [0, *(phase.last for phase in trajectory.phases)]
    ends, start, found = planned.positions(trajectory, trajectory.times[edges]), 0, list[Miss]()

    def done(step: Step, k: int) -> bool:
        if isinstance(step, Grasp | Release):
            held = trajectory.phases[k].held
            return (
                (step.object in held) == isinstance(step, Grasp)
                if step.object is not None
                else not held
            )
        return all(amount <= _DONE for _, amount, _ in _misses(planned, step, ends[k], ends[k]))

    for number, step in enumerate(steps):
        last = len(ends) - 1
        start = (
            last
            if number == len(steps) - 1
            else next((k for k in range(start, last) if done(step, k)), last)
        )
        at = float(trajectory.times[edges[start]])
        row = len(times) - 1 if start == last else int(np.argmin(np.abs(times - at)))
        for subject, amount, unit in _misses(world, step, rows[row], ends[start]):
            found.append(Miss(number + 1, subject, amount, unit, float(times[row])))
    return tuple(found)


def _misses(
    world: World, step: Step, row: Floats, planned: Floats
) -> Iterator[tuple[str, float, str]]:
    """Yield how far each subject of a step is from its goal where the world is at `row`; `planned` is where the plan has it."""
    names, units = world.coordinates.names, world.coordinates.units
    if isinstance(step, Actuate):
        for joint, goal in step.joints.items():
            column = names.index(f"{step.object}.{joint}")
            yield names[column], abs(float(row[column]) - goal), units[column]
    elif isinstance(step, GoTo):
        yield "base", float(np.hypot(row[0] - step.x, row[1] - step.y)), "m"
        if step.yaw is not None:
            yield "base heading", float(abs(wrap_angle(row[2] - step.yaw))), "rad"
    elif isinstance(step, Grasp):
        scene = world.scene
        link = f"{step.object}.{scene.objects[step.object].object.attachment(step.attachment).link}"
        hand = step.by or scene.robot.tool_frame
        one, other = (
            _placement(world, at, link).actInv(_placement(world, at, hand)) for at in (row, planned)
        )
        yield (
            f"grasp of {step.object}",
            float(np.linalg.norm(one.translation - other.translation)),
            "m",
        )
    elif isinstance(step, Reach | Touch | Place):
        yield from _posed(world, step, row)


def _posed(
    world: World, step: Reach | Touch | Place, row: Floats
) -> Iterator[tuple[str, float, str]]:
    robot = world.scene.robot
    if isinstance(step, Place):
        frame = f"{step.object}.{world.scene.objects[step.object].object.base_link}"
    else:
        frame = step.frame or robot.tool_frame
    goal: Any = step.target if isinstance(step, Touch) else step.pose
    placement, posed = _placement(world, row, frame), isinstance(goal, pin.SE3)
    yield (
        frame,
        float(
            np.linalg.norm(
                placement.translation - (goal.translation if posed else np.asarray(goal))
            )
        ),
        "m",
    )
    if posed:
        yield frame, float(np.linalg.norm(pin.log3(goal.rotation.T @ placement.rotation))), "rad"
    elif isinstance(step, Place):  # as upright as it stood, at any heading
        upright = step.object in world.scene.held
        stands = (
            np.array([0.0, 0.0, 1.0])
            if upright
            else world.scene.objects[step.object].placement.rotation[2]
        )
        yield frame, float(np.arccos(np.clip(placement.rotation[2] @ stands, -1.0, 1.0))), "rad"


def _placement(world: World, row: Floats, frame: str) -> pin.SE3:
    data = world.model.createData()
    pin.forwardKinematics(world.model, data, world.coordinates.q(row))
    return pin.updateFramePlacement(world.model, data, world.model.getFrameId(frame)).copy()
