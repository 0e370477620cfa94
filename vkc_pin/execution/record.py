"""Records the decisions and motions of a closed loop."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import pinocchio as pin

from vkc_pin.planning.plan import Plan
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.splicing import MAX_GAP, concatenate_trajectories, extract_times
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Decision = Literal["go on", "replan", "brake", "wait", "stop"]
"""Decision of a cycle: nothing; a new motion; braking on the path; waiting at rest, since no motion
is found yet; or giving up."""


_SHORTEST = 1e-6  # [s] of a part of a motion
_JUMP = 1e-3  # [s] of a jump to the measured state
_STILL = 1e-9  # [m], [rad] of the displacement of an obstacle that does not move


@dataclass(frozen=True)
class Cycle:
    """What happened in one cycle.

    Attributes:
        time: Begin, on the robot's clock [s].
        motion_time: Time of the motion that was being executed [s].
        latency: Time from the measured state to the end of the cycle's work [s].
        decision: See `Decision`.
        reason: Why it was not "go on".
    """

    time: float
    motion_time: float
    latency: float
    decision: Decision
    reason: str = ""


@dataclass(frozen=True, eq=False)
class ExecutionResult:
    """The record of an execution.

    Attributes:
        plan: The plan that it began with.
        success: Whether the last motion carried out all steps, and the robot followed it.
        reason: Why it ended without success; else "".
        cycles: All cycles.
        plans: Begin on the robot's clock [s] and plan of all motions that were sent.
        late: Number of cycles, except those at rest, that took longer than their period.
        seen: Times on the robot's clock [s] at which obstacles had moved, and shapes of all
            obstacles then, as `Scene.obstacle_visual`.
    """

    plan: Plan
    success: bool
    reason: str
    cycles: tuple[Cycle, ...]
    plans: tuple[tuple[float, Plan], ...]
    late: int
    seen: tuple[tuple[float, tuple[pin.GeometryObject, ...]], ...] = ()

    def __repr__(self) -> str:
        verdict = "success" if self.success else f"FAILED: {self.reason}"
        counts = ", ".join(f"{n} × {name}" for name, n in self.count_decisions().items())
        return f"<ExecutionResult {verdict}; {counts}>"

    def count_decisions(self) -> dict[str, int]:
        """Return decision → number of cycles."""
        return dict(Counter(cycle.decision for cycle in self.cycles))

    @property
    def latencies(self) -> dict[str, list[float]]:
        """Decision → latencies of its cycles [s]."""
        found: dict[str, list[float]] = {}
        for cycle in self.cycles:
            found.setdefault(cycle.decision, []).append(cycle.latency)
        return found

    @property
    def motion(self) -> Trajectory:
        """The motion that was sent in all, up to the last cycle; it counts from its begin.

        Where a motion begins at the measured state, beside the one before, it jumps there within a
        millisecond.
        """
        parts = list[Trajectory]()
        ends = [begin for begin, _ in self.plans[1:]]
        ends.append(self.cycles[-1].time if self.cycles else np.inf)
        for (begin, plan), end in zip(self.plans, ends, strict=True):
            whole = plan.trajectory
            first = float(whole.times[0])
            last = min(first + end - begin, float(whole.times[-1]))
            if last - first > _SHORTEST:
                part = extract_times(whole, first, last)
                if parts and _has_gap(parts[-1], part):
                    parts.append(_jump(parts[-1], part))
                parts.append(part)
            rest = end - begin - (last - first)
            if parts and np.isfinite(rest) and rest > _SHORTEST:
                parts.append(_stand(parts[-1], rest))
        return concatenate_trajectories(parts, pause=0.0)

    def summary(self) -> str:
        """Return the decisions with their times and reasons, one a line."""
        lines = [repr(self)]
        for cycle in self.cycles:
            if cycle.decision != "go on":
                took = f"{1e3 * cycle.latency:.0f} ms"
                reason = f": {cycle.reason}" if cycle.reason else ""
                lines.append(f"  {cycle.time:7.2f} s  {cycle.decision} ({took}){reason}")
        return "\n".join(lines)

    @property
    def executed(self) -> Plan:
        """The motion as it was sent, in the world as it was known last, as a plan to be shown."""
        first, last = self.plan.scene, self.plans[-1][1]
        scene = last.scene.with_held(first.holds)
        scene = scene.with_start(base=first.start[:3], arm=first.start[3:], velocity={})
        for name, placed in first.objects.items():
            joints = zip(placed.object.coordinates.names, placed.state.tolist(), strict=True)
            state = dict(joints)
            scene = scene.with_state(name, state) if state else scene
        return replace(last, scene=scene, steps=self.plan.steps, trajectory=self.motion)

    def to_html(self, path: str | Path) -> Path:
        """Write a page that plays `executed`, with obstacles where they were seen."""
        from vkc_pin.visualization.viewer import to_html

        executed = self.executed
        return to_html(executed, path, moving=self._compute_displacements(executed.scene))

    def _compute_displacements(self, scene: Scene) -> dict[str, tuple[Floats, list[pin.SE3]]]:
        """Return obstacle that moved → times of `motion` and displacements from a scene's place."""
        begin = self.plans[0][0]
        placements = dict[str, dict[float, pin.SE3]]()  # by shape and time
        for clock, shapes in self.seen:
            for shape in shapes:
                # Of several before the begin, and of several at once, the last one counts.
                time = max(clock - begin, 0.0)
                placements.setdefault(shape.name, {})[time] = shape.placement
        moved = dict[str, tuple[Floats, list[pin.SE3]]]()
        for name, shape in zip(scene.obstacle_visual_labels, scene.obstacle_visual, strict=True):
            own = placements.get(shape.name, {})
            displacements = [placement * shape.placement.inverse() for placement in own.values()]
            if any(not displacement.isIdentity(_STILL) for displacement in displacements):
                moved[name] = (np.array(list(own)), displacements)
        return moved

    def plot(self, path: str | Path | None = None) -> Figure:
        """Plot a top view of `executed`, and the latencies and decisions of all cycles.

        Args:
            path: Picture to write (.png, .svg or .pdf). Default: none.
        """
        from vkc_pin.visualization.plots.style import COLOURS, new_figure, save_figure, use_style
        from vkc_pin.visualization.plots.top_view import draw_top_view

        with use_style():
            figure = new_figure(10.0, 4.2)
            parts: Any = figure.subfigures(1, 2)
            left, right = parts
            executed = self.executed
            draw_top_view(left, World(executed.scene), executed.trajectory, columns=3)
            axes: Any = right.subplots()
            for decision, colour in zip(get_args(Decision), COLOURS, strict=False):
                cycles = [cycle for cycle in self.cycles if cycle.decision == decision]
                if cycles:
                    times = [cycle.time for cycle in cycles]
                    latencies = [1e3 * cycle.latency for cycle in cycles]
                    axes.plot(times, latencies, "o", color=colour, markersize=3, label=decision)
            axes.set_yscale("log")
            axes.set_xlabel("time [s]")
            axes.set_ylabel("latency [ms]")
            axes.legend(loc="upper right")
        return save_figure(figure, path)


def _has_gap(before: Trajectory, after: Trajectory) -> bool:
    """Return whether a motion of the robot does not begin where another ends."""
    size = before.robot_size
    gap = after.positions[0, :size] - before.positions[-1, :size]
    return bool(np.abs(gap).max() > MAX_GAP)


def _jump(before: Trajectory, after: Trajectory) -> Trajectory:
    """Return a motion of the robot from where one ends to where another begins."""
    size = before.robot_size
    positions = np.array([before.positions[-1, :size], after.positions[0, :size]])
    phase = after.phases[0]
    span = PhaseSpan(phase.name, 0, 1, phase.holds, phase.opening)
    return Trajectory(before.names[:size], np.array([0.0, _JUMP]), positions, (span,), size)


def _stand(before: Trajectory, duration: float) -> Trajectory:
    """Return a motion that stands still where another ends."""
    last = before.positions[-1]
    phase = before.phases[-1]
    span = PhaseSpan("stand still", 0, 1, phase.holds, phase.opening)
    times = np.array([0.0, duration])
    return Trajectory(before.names, times, np.array([last, last]), (span,), before.robot_size)
