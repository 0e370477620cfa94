"""Tests the possible goals of a scene, and random tasks, whose plans the oracle judges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc


def test_goals_lists_every_joint_and_free_object_once() -> None:
    home = vkc.load_scene("household")
    steps = {
        (step.object, *getattr(step, "joints", ())): step
        for step in vkc.procedural.goals(home, share=0.5)
    }
    assert {key for key in steps if len(key) == 2} == {
        *(("door", "hinge"), ("drawer", "slide"), ("dishwasher", "rack"), ("dishwasher", "door")),
        *(("refrigerator", "hinge"), ("cabinet", "hinge")),
    }
    grasped = {step.object for step in steps.values() if isinstance(step, vkc.Grasp)}
    assert grasped == {name for name, placed in home.objects.items() if placed.object.free}
    assert steps["refrigerator", "hinge"] == vkc.Actuate(
        "refrigerator", {"hinge": 1.0}, "handle_free"
    )


def test_continuous_joints_move_by_a_fraction_of_a_revolution() -> None:
    description = vkc.procedural.random_object("valve", 0)
    urdf = description["urdf"].replace('type="revolute"', 'type="continuous"')
    entry = {"name": "valve", "type": {**description, "urdf": urdf}, "position": [2.0, 0.0, 0.0]}
    scene = vkc.Scene.from_document(
        {"robot": "husky_ur5e", "start": {"base": [0, 0, 0]}, "objects": [entry]}
    )
    (step,) = vkc.procedural.goals(scene, share=0.25)
    assert isinstance(step, vkc.Actuate)
    assert step.joints["turn"] == pytest.approx(np.pi / 2, abs=1e-3)


def test_goals_stay_within_joint_limits() -> None:
    scene = vkc.load_scene("corridor_door")
    door = scene.objects["door"].object
    (step,) = vkc.procedural.goals(scene, share=0.5)
    assert isinstance(step, vkc.Actuate)
    assert step.joints["hinge"] == door.upper[door.coordinates.index("hinge")] == np.pi / 2.0, (
        "1.571, the rounded value, would exceed the limit"
    )


@pytest.mark.parametrize("share", [0.0, 1.1, "half"])
def test_invalid_shares_are_rejected(share: object) -> None:
    with pytest.raises(vkc.InputError) as caught:
        vkc.procedural.goals(vkc.load_scene("drawer"), share=share)  # type: ignore[arg-type]
    assert caught.value.field == "share"


def test_random_tasks_are_reproducible() -> None:
    (room, steps), (same, again), (other, _) = (
        vkc.procedural.random_task(seed) for seed in (3, 3, 4)
    )
    assert (room.document, steps) == (same.document, again)
    assert room.document != other.document
    kinds = tuple(f"random_{placed.object.name}" for placed in room.objects.values())
    assert vkc.procedural.random_room(3, objects=kinds).document == room.document


def test_random_tasks_accept_room_settings() -> None:
    room, (step,) = vkc.procedural.random_task(
        2, clutter=0.0, objects=("drawer",), carried=("cup",)
    )
    assert list(room.objects) == ["drawer", "cup"]
    assert step.object in room.objects  # type: ignore[union-attr]
    with pytest.raises(vkc.InputError, match="no step is possible"):
        vkc.procedural.random_task(2, clutter=0.0, objects=())


@pytest.mark.parametrize(
    "kind", ["drawers", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("door", "valve"))]
)
def test_random_tasks_are_planned(kind: str, tmp_path: Path) -> None:
    """Plan in a furnished room; the saved plan contains the object's description."""
    room, steps = vkc.procedural.random_task(11, objects=(f"random_{kind}",), clutter=0.3)
    plan = vkc.plan(room, steps)
    assert plan.success, plan.validation
    (step,) = steps
    assert isinstance(step, vkc.Actuate)
    (joint, value), *_ = step.joints.items()
    assert plan.trajectory.positions[
        -1, plan.trajectory.names.index(f"{kind}.{joint}")
    ] == pytest.approx(value, abs=1e-3)
    loaded = vkc.Plan.load(plan.save(tmp_path / "plan.npz"))
    assert loaded.scene.document == room.document
    assert loaded.success
    assert loaded.scene.objects[kind].object.model == room.objects[kind].object.model
