"""Draws docs/images/closed_loop.png: somebody walks by while a door is opened.

Latencies are those of the machine that draws it. The robot's clock stands still while motions are
found, so that decisions are the same on every machine.
"""

from __future__ import annotations

import vkc_pin as vkc
from docs.pictures import IMAGES
from vkc_pin.execution import ExecutionResult, IdealRobot, execute

SPEED = 0.8  # of the person [m/s]


def execute_beside_person() -> ExecutionResult:
    """Execute the plan of a door while a cylinder crosses its path."""
    scene = vkc.load_scene("door")
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.2})])
    robot = IdealRobot(scene, is_simulated=True)
    crossing = float(plan.trajectory.at(2.0)[0])

    def observe(known: vkc.Scene) -> vkc.Scene:
        place = [crossing, SPEED * robot.time - 2.5, 0.3, 0.0, 0.0, 0.0]
        return known.with_obstacle("stool", place)

    # On a clock that stands still while motions are found, each cycle at rest is a search.
    return execute(plan, robot, observe=observe, rate=10.0, time_limit=60.0)


def make() -> None:
    """Write the picture."""
    execute_beside_person().plot(IMAGES / "closed_loop.png")
