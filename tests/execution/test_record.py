"""Tests the record of an execution."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import meshcat
import numpy as np
import pytest

import vkc_pin as vkc
from docs.pictures.closed_loop import SPEED, execute_beside_person
from vkc_pin.execution import Cycle, ExecutionResult
from vkc_pin.visualization.drawing import Drawing
from vkc_pin.visualization.viewer import Recorder


@cache
def execute_beside_a_person() -> ExecutionResult:
    result = execute_beside_person()
    assert result.success, result.summary()
    return result


def test_every_decision_is_recorded() -> None:
    result = execute_beside_a_person()
    counts = result.count_decisions()
    assert sum(counts.values()) == len(result.cycles)
    assert {name: len(times) for name, times in result.latencies.items()} == counts
    lines = result.summary().splitlines()
    assert len(lines) == 1 + len(result.cycles) - counts["go on"]
    assert all(cycle.reason for cycle in result.cycles if cycle.decision != "go on")
    times = [cycle.time for cycle in result.cycles]
    assert times == sorted(times)


def test_motion_is_what_was_sent() -> None:
    result = execute_beside_a_person()
    motion = result.motion
    begin = result.plans[0][0]
    assert motion.times[-1] == pytest.approx(result.cycles[-1].time - begin, abs=1e-6)
    ends = [start for start, _ in result.plans[1:]]
    ends.append(result.cycles[-1].time)
    for (start, plan), end in zip(result.plans, ends, strict=True):
        for time in np.linspace(start, end, 9)[1:-1]:
            sent = plan.trajectory.at(time - start)[:9]
            np.testing.assert_allclose(motion.at(time - begin)[:9], sent, atol=1e-9)
    assert motion.column("door.hinge")[-1] == pytest.approx(1.2, abs=1e-3)


def test_execution_is_shown(tmp_path: Path) -> None:
    result = execute_beside_a_person()
    page = result.to_html(tmp_path / "page.html")
    assert page.stat().st_size > 100_000
    result.plot(tmp_path / "plot.png")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    assert isinstance(result.executed, vkc.Plan)


def test_page_moves_the_person_as_it_was_seen() -> None:
    result = execute_beside_a_person()
    executed = result.executed
    ((name, (times, displacements)),) = result._compute_displacements(executed.scene).items()
    assert name == "stool"
    assert (np.diff(times) > 0.0).all()
    number = executed.scene.obstacle_visual_labels.index(name)
    place = executed.scene.obstacle_visual[number].placement
    along = [(displacement * place).translation[1] for displacement in displacements]
    seen = times + result.plans[0][0]
    np.testing.assert_allclose(along[1:], SPEED * seen[1:] - 2.5, atol=1e-9)
    recorder = Recorder()
    viewer = meshcat.Visualizer(window=recorder)
    moving = {name: (times, displacements)}
    Drawing(viewer, executed.scene, executed.trajectory, moving=moving).draw()
    (movie,) = [one for one in recorder.commands if one["type"] == "set_animation"]
    (clip,) = [one["clip"] for one in movie["animations"] if "room/stool" in one["path"]]
    (shifts,) = [track for track in clip["tracks"] if track["name"] == ".position"]
    keys = shifts["keys"]
    assert len(keys) == len(times)
    assert keys[-1]["time"] == pytest.approx(times[-1])
    np.testing.assert_allclose(keys[-1]["value"], displacements[-1].translation)


def test_motion_jumps_to_where_the_robot_was_measured() -> None:
    """A motion that is planned from a measured state begins beside the one before."""
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Configure({"base_x": -0.5})])
    takeover = 0.4 * float(plan.trajectory.times[-1])
    measured = plan.scene_at(takeover).start + np.array([0.01, *np.zeros(8)])
    rest = vkc.replan(plan, takeover, state=measured)
    assert plan.success
    assert rest.success
    end = takeover + float(rest.trajectory.times[-1])
    cycle = Cycle(end, float(rest.trajectory.times[-1]), 0.01, "go on", "")
    result = ExecutionResult(plan, True, "", (cycle,), ((0.0, plan), (takeover, rest)), 0)
    motion = result.motion
    np.testing.assert_allclose(motion.at(takeover)[:9], plan.trajectory.at(takeover)[:9], atol=1e-9)
    np.testing.assert_allclose(motion.at(takeover + 1e-3)[:9], measured, atol=1e-9)
    assert motion.times[-1] == pytest.approx(end, abs=2e-3)
