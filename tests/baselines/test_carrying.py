"""The baselines carry a cup from table to table, and drive on with the arm as it is: where they succeed, and why they do not."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import box
from helpers.drawers import drawer_scene, handle, holding, off, open_scene
from helpers.drives import hall
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.baselines import BASELINES, attempt, plan_separately
from vkc_pin.baselines import postures as poses
from vkc_pin.baselines.attempt import Attempt
from vkc_pin.baselines.following import FailedError
from vkc_pin.baselines.postures import postures
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.world.trajectory.world_model import World

OPTIONS = vkc.Options(reach_waypoints=20, move_waypoints=15)
CUP, THERE = (
    (1.5, 0.1, 0.501),
    (-0.2, 1.7, 0.701),
)  # on a table before the robot, and on one to its left
CARRY = vkc.Place("cup", THERE)
CARRIED = [
    "go to",
    "reach cup.side",
    "go to",
    "go to",
    "place cup",
    "let go",
]  # drive, reach, draw back, drive, put down
PULL = vkc.Actuate("drawer", {"slide": 0.15})


def room(*more: dict[str, Any], arm: np.ndarray | None = None) -> vkc.Scene:
    """Return a hall with two tables, and a cup on one of them."""
    tables = [
        box("table", [0.6, 0.8, 0.02], [1.7, 0.1, 0.49]),
        box("other", [0.8, 0.6, 0.02], [-0.2, 1.9, 0.69]),
    ]
    scene = hall(obstacles=[*tables, *more])
    cup = {"name": "cup", "type": "cup", "position": list(CUP), "yaw": 0.4}
    scene = vkc.Scene.from_document({**scene.document, "objects": [cup]}, scene.folder)
    return scene if arm is None else scene.with_start(arm=arm)


def plan(scene: vkc.Scene, *steps: vkc.Step, **arguments: Any) -> vkc.Plan:
    return plan_separately(scene, steps, **{"options": OPTIONS, "retries": 1, **arguments})


@cache
def carried(method: str = "B1") -> vkc.Plan:
    return plan(room(), CARRY, method=method)


@cache
def pulled_and_gone() -> vkc.Plan:
    return plan(open_scene(), PULL, vkc.GoTo(-1.0, 1.0))


def names(found: vkc.Plan) -> list[str]:
    return [phase.name for phase in found.trajectory.phases]


def rows(found: vkc.Plan, phase: int) -> np.ndarray:
    """Return the waypoints of a phase, the robot's columns."""
    span = found.trajectory.phases[phase]
    return np.array(
        found.trajectory.positions[span.first : span.last + 1, : found.trajectory.robot_size]
    )


def stands(found: vkc.Plan, waypoint: int, name: str = "cup") -> pin.SE3:
    """Return where an object is at a waypoint, by validation's own tree."""
    world = World(found.scene)
    return world.get_placement(name, world.compute_positions(found.trajectory)[waypoint])


# --- carrying
# ----------------------------------------------------------------------------------------------------------


def test_a_cup_is_carried_from_table_to_table() -> None:
    found = carried()
    assert found.success, found.summary()
    assert vkc.validate(found.scene, found.steps, found.trajectory, found.options).ok
    assert names(found) == CARRIED
    assert [dict(phase.held) for phase in found.trajectory.phases] == [
        {},
        {},
        *[{"cup": "side"}] * 3,
        {},
    ]
    end = stands(found, -1)
    np.testing.assert_allclose(end.translation, THERE, atol=1e-3)
    assert end.rotation[2, 2] > np.cos(1e-3), "it stands upright"


def test_base_and_arm_move_one_after_the_other() -> None:
    found = carried()
    for drives in (0, 3):
        arm = rows(found, drives)[:, 3:]
        assert np.ptp(rows(found, drives)[:, :2], axis=0).max() > 0.3
        np.testing.assert_array_equal(arm, np.tile(arm[0], (len(arm), 1)))
    for moves in (1, 2, 4):
        base = rows(found, moves)[:, :3]
        assert np.ptp(rows(found, moves)[:, 3:], axis=0).max() > 0.05
        np.testing.assert_allclose(base, np.tile(base[0], (len(base), 1)), atol=1e-12)


def test_both_methods_carry_alike() -> None:
    """There is nothing to follow, so nothing that B2 would refine."""
    first, second = (carried(method).trajectory for method in BASELINES)
    np.testing.assert_array_equal(first.positions, second.positions)


def only(monkeypatch: pytest.MonkeyPatch, index: int) -> None:
    """Leave the arm one way to be held while the base drives."""
    monkeypatch.setattr(attempt, "postures", lambda problem: list(postures(problem))[index:][:1])


def test_with_the_arm_at_home_the_cup_is_turned_over_and_stands_upright_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As it stood before the plan; not as the hand has turned it when it is put down."""
    only(monkeypatch, -2)
    found = plan(room(), CARRY)
    assert found.success, found.summary()
    np.testing.assert_allclose(rows(found, 3)[0, 3:], found.scene.robot.home, atol=1e-6)
    on_the_way = stands(found, found.trajectory.phases[3].first)
    assert on_the_way.rotation[2, 2] < 0.9
    assert stands(found, -1).rotation[2, 2] > np.cos(1e-3)


def test_what_is_held_at_the_start_is_carried_on() -> None:
    before = carried()
    span = before.trajectory.phases[3]
    row = before.trajectory.positions[span.first]
    at = [
        float(row[before.trajectory.names.index(f"cup.side_{name}")]) for name in ("slide", "turn")
    ]
    scene = room().with_start(base=row[:3], arm=row[3:9])
    attachment = scene.objects["cup"].object.attachments["side"]
    values = dict(zip(("slide", "turn"), at, strict=True))
    held = scene.with_held(
        {"cup": "side"},
        at={"cup": [values[name.removeprefix("side_")] for name in attachment.coordinates]},
    )
    found = plan(held, CARRY)
    assert found.success, found.summary()
    assert names(found) == ["go to", "place cup", "let go"]


def test_no_room_to_put_it_down(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(poses, "TRIES", 1000)
    found = plan(room(box("crate", [0.3, 0.3, 0.3], [THERE[0], THERE[1], 0.85])), CARRY)
    assert (found.success, found.status) == (False, "no base pose")
    assert names(found) == CARRIED[:2]
    assert "goal" in {v.constraint for v in found.report.violations}


def test_where_one_way_to_hold_the_arm_leads_nowhere_the_next_is_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From where the hand has closed, and what was done with the first is forgotten."""
    drive, driven = Attempt._drive, list[np.ndarray]()

    def only_at_home(self: Attempt, goals: np.ndarray) -> None:
        driven.append(self.scene.start.copy())
        if np.abs(self.scene.start[3:] - self.scene.robot.home).max() > 1e-6:
            raise FailedError("no base path")
        drive(self, goals)

    monkeypatch.setattr(Attempt, "_drive", only_at_home)
    monkeypatch.setattr(attempt, "_ENDS", 2)
    found = plan(room(), CARRY)
    assert found.success, found.summary()
    assert names(found) == CARRIED
    assert len(driven) == 4, "to the cup; twice with the arm a little drawn back; at home"
    np.testing.assert_allclose(driven[1], driven[2])
    np.testing.assert_allclose(driven[3][:3], driven[1][:3], atol=1e-9)


# --- driving on
# --------------------------------------------------------------------------------------------------------


def test_it_drives_on_when_the_drawer_is_open() -> None:
    found = pulled_and_gone()
    assert found.success, found.summary()
    assert names(found)[:3] == ["go to", "reach drawer.handle", "move drawer.slide"]
    assert set(names(found)[3:]) == {"go to"}
    last = found.trajectory.positions[-1]
    np.testing.assert_allclose(last[:2], [-1.0, 1.0], atol=1e-3)
    assert found.trajectory.column("drawer.slide")[-1] == pytest.approx(0.15, abs=1e-3)
    arm = rows(found, len(names(found)) - 1)[:, 3:]
    np.testing.assert_array_equal(arm, np.tile(arm[0], (len(arm), 1)))


@pytest.mark.parametrize("yaw", [None, 2.0, -2.0])
def test_it_drives(yaw: float | None) -> None:
    found = plan(open_scene(), vkc.GoTo(-1.0, 1.0, yaw))
    assert found.success, found.summary()
    assert names(found) == ["go to"]
    assert np.ptp(found.trajectory.positions[:, 3:9], axis=0).max() == 0.0
    np.testing.assert_allclose(found.trajectory.positions[-1, :2], [-1.0, 1.0], atol=1e-3)
    if yaw is None:  # an omnidirectional base need not turn
        assert np.ptp(found.trajectory.positions[:, 2]) < 0.1
    else:
        assert np.cos(found.trajectory.positions[-1, 2] - yaw) == pytest.approx(1.0)


def test_no_way_there() -> None:
    scene = open_scene(box("wall", [0.1, 4.6, 2.4], [0.15, 0.0, 1.2]))
    found = plan(scene, vkc.GoTo(1.0, 0.0))
    assert (found.success, found.status) == (False, "no base path")
    assert np.ptp(found.trajectory.positions[:, :3], axis=0).max() == 0.0, "it stands at its start"


# --- how the arm is held
# -----------------------------------------------------------------------------------------------


def stay(scene: vkc.Scene) -> vkc.TrajectoryProblem:
    return program_of(scene, [vkc.GoTo(*scene.start[:3].tolist())], options=OPTIONS)


def folded(scene: vkc.Scene) -> np.ndarray:
    """Return the arm of the second baseline posture of an arm at home: as narrow as it becomes."""
    return BaseRoutes(stay(scene)).get_folded_arm(0)


def test_an_arm_at_home_stays_there_or_is_folded() -> None:
    scene = drawer_scene()
    first, second = postures(stay(scene))
    assert len(first) == 0
    np.testing.assert_allclose(second, [[*scene.start[:3], *folded(scene)]], atol=1e-12)
    assert np.abs(second[0, 3:] - scene.robot.home).max() > 0.5


def test_another_arm_may_stay_or_go_home_and_be_folded() -> None:
    scene = open_scene().with_start(arm=np.array([0.0, -1.2, 1.0, 0.2, 1.5, 0.0]))
    first, second, third = postures(stay(scene))
    assert len(first) == 0
    np.testing.assert_allclose(second, [[*scene.start[:3], *scene.robot.home]], atol=1e-12)
    np.testing.assert_allclose(third, [*second, [*scene.start[:3], *folded(scene)]], atol=1e-12)


def test_a_hand_goes_straight_back_from_what_it_lets_go_of() -> None:
    scene = holding(open_scene())
    *_, back, home, compact = postures(stay(scene))
    np.testing.assert_allclose(compact[:-1], home, atol=1e-12)
    assert len(back) == 1
    away = pin.SE3(np.eye(3), np.array([-vkc.Options().approach, 0.0, 0.0])) * handle()
    assert off(scene, back[0], away) < 1e-3
    np.testing.assert_allclose(back[0, :3], scene.start[:3], atol=1e-12)
    np.testing.assert_allclose(home[:-1], back, atol=1e-12)
    np.testing.assert_allclose(home[-1, 3:9], scene.robot.home, atol=1e-12)


def test_what_was_taken_is_lifted_first() -> None:
    found = carried()
    row = found.trajectory.positions[found.trajectory.phases[1].last]
    lifted = found.trajectory.positions[found.trajectory.phases[2].last]
    assert np.abs(lifted[:3] - row[:3]).max() < 1e-9
    low, high = (stands(found, found.trajectory.phases[k].last) for k in (1, 2))
    np.testing.assert_allclose(
        high.translation - low.translation, [0.0, 0.0, vkc.Options().approach], atol=2e-3
    )
