"""What may touch what, and when: the least that is right.

- The hand's touch links and the link that is grasped, from shortly before the grasp until shortly
  after letting go. From the object's other links they keep the attachment's clearance then.
- What is held through something, and the link that holds it, for as long.
- A free object and what it stands on, where it is lifted and put down.
- The link that a `Touch` brings somewhere and what is there, around the moment when it is.
- What rides on something, and that.
- What is built close to something; see `neighbours`.
- A free object and what it stands in at the start, while it is lifted for the first time.

Shortly is a second, or four waypoints where these take longer: the program's margins are eased over
four waypoints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .goals import find_touched
from .plan import Hold
from .riding import compute_distance
from .stage import Solid, Stage, World

__all__ = ["SHORT", "Licence", "find_licences"]

SHORTLY, WAYPOINTS = 1.0, 4  # [s], and at least as many waypoints
SHORT = 1e-3  # [m] that clearance at a waypoint may fall short


@dataclass(frozen=True)
class Licence:
    """Two groups of links, by label, that may be close from one time to another [s].

    Attributes:
        ones, others: The groups.
        begin, end: The times.
        least: How close at waypoints [m].
        depth: By how much they may overlap [m].
    """

    ones: frozenset[str]
    others: frozenset[str]
    begin: float
    end: float
    least: float = -np.inf
    depth: float = 0.0

    def names(self, one: str, other: str) -> bool:
        return (one in self.ones and other in self.others) or (
            other in self.ones and one in self.others
        )

    def covers(self, one: str, other: str, time: float, apart: float) -> bool:
        return (
            self.names(one, other)
            and self.begin - 1e-9 <= time <= self.end + 1e-9
            and apart >= self.least - SHORT
        )


class _Clock:
    def __init__(self, world: World) -> None:
        self.times = world.plan.times
        self.still = world.is_resting

    def before(self, waypoint: int) -> float:
        return float(min(self.times[waypoint] - SHORTLY, self.times[max(waypoint - WAYPOINTS, 0)]))

    def after(self, waypoint: int) -> float:
        while waypoint < len(self.still) and self.still[waypoint]:  # the hand opens or closes
            waypoint += 1
        return float(
            max(
                self.times[waypoint] + SHORTLY,
                self.times[min(waypoint + WAYPOINTS, len(self.times) - 1)],
            )
        )


def find_licences(world: World, stages: list[Stage]) -> list[Licence]:
    """Return all licences of a motion."""
    clock = _Clock(world)
    found = [
        *_license_grasps(world, stages, clock),
        *_license_supports(world, stages, clock),
        *_license_touches(world, stages, clock),
    ]
    for stage in stages:
        for name, (owner, link) in stage.riding.items():
            ours = frozenset(f"{name}.{own}" for own in world.objects[name].tree.urdf.links)
            found.append(
                Licence(ours, frozenset({f"{owner}.{link}"}), stage.times[0], stage.times[-1])
            )
    return found


def _license_grasps(world: World, stages: list[Stage], clock: _Clock) -> Iterator[Licence]:
    plan = world.plan
    last = len(plan.times) - 1
    spans: list[tuple[Hold, float, float]] = []
    for number, phase in enumerate(plan.phases):
        before = set(world.held if number == 0 else plan.phases[number - 1].holds)
        after = (
            set(plan.phases[number + 1].holds)
            if number + 1 < len(plan.phases)
            else set(phase.holds)
        )
        for hold in phase.holds:
            begin = float(plan.times[phase.first]) if hold in before else clock.before(phase.first)
            end = float(plan.times[phase.last]) if hold in after else clock.after(phase.last)
            spans.append((hold, begin, end))
    spans += [(hold, -np.inf, clock.after(0)) for hold in world.held]
    for step in plan.steps:
        if step["step"] == "Grasp":  # the motion may end where the hand closes
            grasp = world.objects[step["object"]].grasp(step["attachment"])
            spans.append((Hold(step["object"], grasp.name, step["by"]), clock.before(last), np.inf))
    for hold, begin, end in spans:
        obj = world.objects[hold.object]
        grasp = world.grasp(hold)
        ours = frozenset({hold.by}) if hold.by else frozenset(world.robot.touch)
        held = frozenset({f"{hold.object}.{grasp.link}"})
        near = _measure_hand(stages[0], ours, held) if hold.measured else np.inf
        yield Licence(ours, held, begin, end, depth=max(0.0, -near))
        others = frozenset(
            f"{hold.object}.{link}" for link in obj.tree.urdf.links if link != grasp.link
        )
        least = plan.options["grasp_clearance"] if grasp.clearance is None else grasp.clearance
        near = _measure_hand(stages[0], ours, others) if hold.measured else np.inf
        yield Licence(ours, others, begin, end, least=min(least, near), depth=max(0.0, -near))


def _measure_hand(stage: Stage, ours: frozenset[str], others: frozenset[str]) -> float:
    """Return the distance of links at the start of a stage [m]."""
    ones, those = (
        [part for part in stage.solids if part.label in labels] for labels in (ours, others)
    )
    return min(
        (
            compute_distance(one.shape.solid, one.at, other.shape.solid, other.at, 0)
            for one in ones
            for other in those
        ),
        default=np.inf,
    )


def _license_supports(world: World, stages: list[Stage], clock: _Clock) -> Iterator[Licence]:
    carried: set[str] = set()  # what is in the hand at the start is lifted there
    for number, stage in enumerate(stages):
        before = {hold.object for hold in stages[number - 1].phase.holds} if number else set()
        now = {hold.object for hold in stage.phase.holds}
        after = (
            {hold.object for hold in stages[number + 1].phase.holds}
            if number + 1 < len(stages)
            else now
        )
        for name in now:
            if not world.objects[name].free:
                continue
            for there, row, waypoint in (
                (before, 0, stage.phase.first),
                (after, len(stage.times) - 1, stage.phase.last),
            ):
                if name not in there:
                    ours = [part for part in stage.solids if part.owner == name]
                    others = [part for part in stage.solids if part.owner not in (name, "robot")]
                    near = frozenset(
                        other.label
                        for other in others
                        for part in ours
                        if _is_close(world, part, other, row)
                    )
                    labels = frozenset(part.label for part in ours)
                    yield Licence(labels, near, clock.before(waypoint), clock.after(waypoint))
                    if row == 0 and name not in carried:
                        for part in ours:
                            for other in others:
                                apart = compute_distance(
                                    part.shape.solid, part.at, other.shape.solid, other.at, 0
                                )
                                if apart < 0.0:
                                    pair = frozenset({part.label}), frozenset({other.label})
                                    yield Licence(
                                        *pair,
                                        clock.before(waypoint),
                                        clock.after(waypoint),
                                        depth=-apart,
                                    )
        carried |= now


def _is_close(world: World, one: Solid, other: Solid, row: int) -> bool:
    return (
        compute_distance(one.shape.solid, one.at, other.shape.solid, other.at, row)
        < world.plan.options["dist_safe"]
    )


def _license_touches(world: World, stages: list[Stage], clock: _Clock) -> Iterator[Licence]:
    for stage in stages:
        for links, near in find_touched(world, stage):
            waypoint = stage.phase.last
            yield Licence(
                frozenset(links), frozenset(near), clock.before(waypoint), clock.after(waypoint)
            )
