"""Finds the pairs of links that may be close, and when: as few as the rules allow.

- The hand's touch links and the grasped link, from shortly before the grasp until shortly after the
  release. To the object's other links, they keep the attachment's clearance during this time.
- An object that another object's link holds, and this link, during the same time.
- A free object and its support, when the object is lifted or put down.
- The link that a `Touch` moves to a target, and the shapes at the target, around this time.
- A supported object and its moving support.
- Pairs that are close by construction; see `neighbours`.
- A free object and the shapes that it overlaps at the start, while it is lifted for the first time.

"Shortly" is one second, or four waypoints if they take longer, because the planner relaxes margins
over four waypoints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .goals import End, find_misses, find_touched
from .plan import Hold
from .stage import Solid, Stage, World
from .supports import compute_distance

__all__ = ["CLEARANCE_SLACK", "Exemption", "find_exemptions"]

SHORTLY, WAYPOINTS = 1.0, 4  # [s], and at least as many waypoints
CLEARANCE_SLACK = 1e-3  # [m] tolerance of the clearance at a waypoint


@dataclass(frozen=True)
class Exemption:
    """Two groups of links that may be close during a time interval.

    Attributes:
        first, second: Labels of the links.
        begin, end: Interval [s].
        min_distance: Least distance at waypoints [m].
        depth: Largest penetration [m].
    """

    first: frozenset[str]
    second: frozenset[str]
    begin: float
    end: float
    min_distance: float = -np.inf
    depth: float = 0.0

    def includes(self, one: str, other: str) -> bool:
        return (one in self.first and other in self.second) or (
            other in self.first and one in self.second
        )

    def applies(self, one: str, other: str, time: float, distance: float) -> bool:
        return (
            self.includes(one, other)
            and self.begin - 1e-9 <= time <= self.end + 1e-9
            and distance >= self.min_distance - CLEARANCE_SLACK
        )


class _Clock:
    """Times shortly before and after waypoints."""

    def __init__(self, world: World) -> None:
        self.times = world.plan.times
        self.resting = world.is_resting

    def find_begin(self, waypoint: int) -> float:
        return float(min(self.times[waypoint] - SHORTLY, self.times[max(waypoint - WAYPOINTS, 0)]))

    def find_end(self, waypoint: int) -> float:
        while waypoint < len(self.resting) and self.resting[waypoint]:  # the hand opens or closes
            waypoint += 1
        return float(
            max(
                self.times[waypoint] + SHORTLY,
                self.times[min(waypoint + WAYPOINTS, len(self.times) - 1)],
            )
        )


def find_exemptions(world: World, stages: list[Stage]) -> list[Exemption]:
    """Return all exemptions of a motion."""
    clock = _Clock(world)
    exemptions = [
        *_exempt_grasps(world, stages, clock),
        *_exempt_supports(world, stages, clock),
        *_exempt_touches(world, stages, clock),
    ]
    for stage in stages:
        for name, (owner, link) in stage.supports.items():
            links = frozenset(
                f"{name}.{object_link}" for object_link in world.objects[name].tree.urdf.links
            )
            exemptions.append(
                Exemption(links, frozenset({f"{owner}.{link}"}), stage.times[0], stage.times[-1])
            )
    return exemptions


def _exempt_grasps(world: World, stages: list[Stage], clock: _Clock) -> Iterator[Exemption]:
    plan = world.plan
    spans: list[tuple[Hold, float, float]] = []
    for number, phase in enumerate(plan.phases):
        before = set(world.held if number == 0 else plan.phases[number - 1].holds)
        after = (
            set(plan.phases[number + 1].holds)
            if number + 1 < len(plan.phases)
            else set(phase.holds)
        )
        for hold in phase.holds:
            begin = (
                float(plan.times[phase.first]) if hold in before else clock.find_begin(phase.first)
            )
            end = float(plan.times[phase.last]) if hold in after else clock.find_end(phase.last)
            spans.append((hold, begin, end))
    spans += [(hold, -np.inf, clock.find_end(0)) for hold in world.held]
    for step in plan.steps:
        if step["step"] == "Grasp":  # the motion may end when the hand closes, or let go at once
            grasp = world.objects[step["object"]].get_grasp(step["attachment"])
            hold = Hold(step["object"], grasp.name, step["by"])
            for number, phase in enumerate(plan.phases, start=1):
                if not find_misses(world, step, End(world, stages, number)):
                    begin, end = clock.find_begin(phase.last), clock.find_end(phase.last)
                    spans.append((hold, begin, end))
    for hold, begin, end in spans:
        obj = world.objects[hold.object]
        grasp = world.get_grasp(hold)
        holder = frozenset({hold.by}) if hold.by else frozenset(world.robot.touch_links)
        grasped = frozenset({f"{hold.object}.{grasp.link}"})
        distance = _compute_start_distance(stages[0], holder, grasped) if hold.measured else np.inf
        yield Exemption(holder, grasped, begin, end, depth=max(0.0, -distance))
        other_links = frozenset(
            f"{hold.object}.{link}" for link in obj.tree.urdf.links if link != grasp.link
        )
        clearance = plan.options["grasp_clearance"] if grasp.clearance is None else grasp.clearance
        distance = (
            _compute_start_distance(stages[0], holder, other_links) if hold.measured else np.inf
        )
        yield Exemption(
            holder,
            other_links,
            begin,
            end,
            min_distance=min(clearance, distance),
            depth=max(0.0, -distance),
        )


def _compute_start_distance(stage: Stage, holder: frozenset[str], others: frozenset[str]) -> float:
    """Return the distance between two groups of links at the start of a stage [m]."""
    holder_parts, other_parts = (
        [part for part in stage.solids if part.label in labels] for labels in (holder, others)
    )
    return min(
        (
            compute_distance(one.shape.solid, one.poses, other.shape.solid, other.poses, 0)
            for one in holder_parts
            for other in other_parts
        ),
        default=np.inf,
    )


def _exempt_supports(world: World, stages: list[Stage], clock: _Clock) -> Iterator[Exemption]:
    carried: set[str] = set()  # objects grasped at the start are lifted there
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
            for adjacent, row, waypoint in (
                (before, 0, stage.phase.first),
                (after, len(stage.times) - 1, stage.phase.last),
            ):
                if name not in adjacent:
                    parts = [part for part in stage.solids if part.owner == name]
                    others = [part for part in stage.solids if part.owner not in (name, "robot")]
                    supports = frozenset(
                        other.label
                        for other in others
                        for part in parts
                        if _is_close(world, part, other, row)
                    )
                    labels = frozenset(part.label for part in parts)
                    yield Exemption(
                        labels, supports, clock.find_begin(waypoint), clock.find_end(waypoint)
                    )
                    if row == 0 and name not in carried:
                        for part in parts:
                            for other in others:
                                distance = compute_distance(
                                    part.shape.solid, part.poses, other.shape.solid, other.poses, 0
                                )
                                if distance < 0.0:
                                    pair = frozenset({part.label}), frozenset({other.label})
                                    yield Exemption(
                                        *pair,
                                        clock.find_begin(waypoint),
                                        clock.find_end(waypoint),
                                        depth=-distance,
                                    )
        carried |= now


def _is_close(world: World, one: Solid, other: Solid, row: int) -> bool:
    return (
        compute_distance(one.shape.solid, one.poses, other.shape.solid, other.poses, row)
        < world.plan.options["dist_safe"]
    )


def _exempt_touches(world: World, stages: list[Stage], clock: _Clock) -> Iterator[Exemption]:
    for stage in stages:
        for links, touched in find_touched(world, stage):
            waypoint = stage.phase.last
            yield Exemption(
                frozenset(links),
                frozenset(touched),
                clock.find_begin(waypoint),
                clock.find_end(waypoint),
            )
