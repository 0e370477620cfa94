"""Tests that the document of a changed scene describes the same scene."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pinocchio as pin
from helpers.carrying import room, table
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.scene.scene import Scene

FREE = ("stick", "ball")
angles = st.floats(-np.pi, np.pi)
lengths = st.floats(-2.0, 2.0)


@cache
def full() -> Scene:
    """Return a scene with a stick, a ball, and a door whose description gives its yaw."""
    scene = room(table(), objects=FREE)
    door = {"name": "door", "type": "door", "position": [3.0, 1.0, 0.0], "yaw": 0.7}
    return Scene.from_document(
        {**scene.document, "objects": [*scene.document["objects"], door]}, scene.folder
    )


def started(draw: st.DrawFn, scene: Scene) -> Scene:
    arm = draw(st.none() | st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
    return scene.with_start(base=draw(st.none() | st.tuples(lengths, lengths, angles)), arm=arm)


def opened(draw: st.DrawFn, scene: Scene) -> Scene:
    return scene.with_state("door", {"hinge": draw(st.floats(0.0, 1.2))})


def put(draw: st.DrawFn, scene: Scene) -> Scene:
    """Return the scene with something put anywhere, upside down and upright too."""
    turn = pin.rpy.rpyToMatrix(
        *draw(st.tuples(angles, st.sampled_from([0.0, np.pi / 2]) | angles, angles))
    )
    return scene.with_placement(
        draw(st.sampled_from([*FREE, "door"])),
        pin.SE3(turn, np.array(draw(st.tuples(*[lengths] * 3)))),
    )


def holding(draw: st.DrawFn, scene: Scene) -> Scene:
    values = draw(st.none() | st.tuples(st.floats(-0.09, 0.09), st.floats(-1.0, 1.0)))
    at = {} if values is None else {"stick": values}
    both = {"stick": "grip", "ball": "pull"}
    held, by = draw(
        st.sampled_from(
            [({}, {}), ({"stick": "grip"}, {}), (both, {}), (both, {"ball": "stick.tip"})]
        )
    )
    return scene.with_held(held, by=by, at={name: row for name, row in at.items() if name in held})


@st.composite
def changed(draw: st.DrawFn) -> Scene:
    scene = full()
    for change in draw(st.lists(st.sampled_from([started, opened, put, holding]), max_size=6)):
        scene = change(draw, scene)
    return scene


@settings(max_examples=60, deadline=None)
@given(scene=changed())
def test_a_changed_scene_comes_back(scene: Scene) -> None:
    again = Scene.from_document(json.loads(json.dumps(scene.document)), scene.folder)
    assert [(hold, hold.at) for hold in again.holds] == [(hold, hold.at) for hold in scene.holds]
    np.testing.assert_array_equal(again.start, scene.start)
    for name, placed in scene.objects.items():
        np.testing.assert_array_equal(again.objects[name].state, placed.state)
        atol = (
            0.0
            if name in scene.held or placed.placement == full().objects[name].placement
            else 1e-12
        )
        where = again.objects[name].placement.homogeneous
        np.testing.assert_allclose(where, placed.placement.homogeneous, rtol=0.0, atol=atol)
    assert again.document == scene.document


def test_unmoved_objects_keep_their_description() -> None:
    entries = {
        entry["name"]: entry
        for entry in full().with_start(base=[1.0, 0.0, 0.0]).document["objects"]
    }
    assert entries["door"]["yaw"] == 0.7
    moved = full().with_placement("door", pin.SE3(np.eye(3), np.array([3.0, 1.0, 0.0])))
    entries = {entry["name"]: entry for entry in moved.document["objects"]}
    assert ("yaw" in entries["door"], entries["door"]["rpy"]) == (False, [0.0, 0.0, 0.0])


def test_a_document_may_be_changed() -> None:
    scene = full()
    scene.document["start"]["base"][0] = 9.0
    scene.document["objects"].clear()
    assert len(scene.document["objects"]) == 3
    assert scene.document["start"]["base"][0] == scene.start[0]
