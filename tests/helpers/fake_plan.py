"""Makes a plan without planning, for tests of plots: base, arm and door move independently."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.validation.report import Report, Violation
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

HINGE = 1.2
VIOLATION = Violation(
    "penetration",
    "forearm_link – sofa",
    waypoint=9,
    time=4.0,
    amount=0.03,
    unit="m",
    detail="overlap by 30 mm",
)


@dataclass(frozen=True, eq=False)
class PlanWithMetrics(Plan):
    """A plan with arbitrary metrics, for tests of records."""

    replaced: Mapping[str, float] = field(default_factory=dict)

    @property
    def metrics(self) -> dict[str, float]:
        return {**super().metrics, **self.replaced}


def replace_metrics(plan: Plan, metrics: Mapping[str, float], **changes: Any) -> Plan:
    """Return a plan with other metrics and fields."""
    fields = {name: value for name, value in vars(plan).items() if name != "replaced"}
    return PlanWithMetrics(**{**fields, **changes}, replaced=metrics)


def make_fake_plan(scene: Scene | None = None) -> Plan:
    """Return a plan of 6 s in two phases, with a collision of forearm and sofa at 4 s."""
    scene = load_scene("door") if scene is None else scene
    robot = scene.robot.coordinates.names
    # The last is the virtual joint of a grasp.
    names = (*robot, "door.hinge", "door.knob", "door.handle_free")
    # Times are not evenly spaced.
    times = np.concatenate([np.linspace(0.0, 3.0, 7), 3.0 + np.geomspace(0.1, 3.0, 7)])
    fraction = np.linspace(0.0, 1.0, len(times))
    start = np.concatenate([scene.start, np.zeros(3)])
    end = start + np.concatenate(
        [[2.3, -0.5, -3.9], 0.8 * np.ones(len(robot) - 3), [HINGE, 0.6, 0.3]]
    )
    positions = start + np.outer(fraction**2, end - start)
    phases = (
        PhaseSpan("reach door.handle", 0, 6),
        PhaseSpan("move door.hinge", 6, len(times) - 1, (Hold("door", "handle"),)),
    )
    return Plan(
        scene=scene,
        steps=(Actuate("door", {"hinge": HINGE}),),
        options=Options(),
        trajectory=Trajectory(names, times, positions, phases, len(robot)),
        report=Report((VIOLATION,), -0.03, states=100, notes=("go to: found no path",)),
        status="rejected",
    )
