"""Tests prepared tasks, and plans that start from an earlier motion."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError

OPEN = vkc.Actuate("door", {"hinge": 1.2})


@cache
def prepare_door() -> tuple[vkc.PreparedTask, vkc.Plan]:
    prepared = vkc.prepare(vkc.load_scene("door"), [OPEN])
    plan = prepared.solve()
    assert plan.success, plan.summary()
    return prepared, plan


def move_door(scene: vkc.Scene, dx: float, turn: float) -> vkc.Scene:
    at = scene.objects["door"].placement
    rotation = at.rotation @ pin.utils.rotate("z", turn)
    shifted = at.translation + np.array([dx, 0.0, 0.0])
    return scene.with_placement("door", pin.SE3(rotation, shifted))


def test_prepared_task_gives_the_plan_of_plan() -> None:
    _, found = prepare_door()
    expected = vkc.plan(vkc.load_scene("door"), [OPEN])
    np.testing.assert_array_equal(found.trajectory.positions, expected.trajectory.positions)


@pytest.mark.parametrize(("dx", "turn"), [(0.03, 0.05), (-0.04, -0.08), (0.0, 0.0)])
def test_search_starts_from_an_earlier_plan_or_motion(dx: float, turn: float) -> None:
    prepared, before = prepare_door()
    scene = move_door(prepared.scene, dx, turn)
    plans = [prepared.solve(scene=scene, guess=guess) for guess in (before, before.trajectory)]
    for plan in plans:
        assert plan.success, plan.summary()
        assert plan.initialization == "given"
    one, other = (plan.trajectory.positions for plan in plans)
    np.testing.assert_array_equal(one, other)


def test_usual_search_follows_a_guess_that_leads_nowhere() -> None:
    """The guess drives, the steps open a door: no phase is the same."""
    prepared, usual = prepare_door()
    driving = vkc.plan(prepared.scene, [vkc.GoTo(0.0, 0.3)])
    blocked = dataclasses.replace(driving.trajectory)
    plan = prepared.solve(guess=blocked)
    assert plan.success, plan.summary()
    assert plan.initialization in ("given", usual.initialization)


def test_steps_are_checked_when_they_are_prepared() -> None:
    scene = vkc.load_scene("door")
    with pytest.raises(UnknownNameError, match="hinge"):
        vkc.prepare(scene, [vkc.Actuate("door", {"hinj": 1.0})])
    with pytest.raises(InputError, match="window"):
        vkc.prepare(scene, [OPEN], window=2, simultaneous=False)
    with pytest.raises(InputError, match="steps"):
        vkc.prepare(scene, [])


def test_guess_must_be_a_plan_or_a_motion() -> None:
    prepared, _ = prepare_door()
    with pytest.raises(InputError, match=r"guess.*a Plan or a Trajectory"):
        prepared.solve(guess="before")  # type: ignore[arg-type]


def test_scene_must_have_the_object_of_the_steps() -> None:
    prepared, _ = prepare_door()
    with pytest.raises(UnknownNameError, match="door"):
        prepared.solve(scene=vkc.load_scene("drawer"))


def test_failure_without_explanation_stands_still() -> None:
    prepared, _ = prepare_door()
    plan = prepared.solve(max_evaluations=300, explain=False)
    assert (plan.success, plan.status) == (False, "evaluation limit")
    assert not np.ptp(plan.trajectory.positions, axis=0).any()
