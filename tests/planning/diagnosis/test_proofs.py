"""Tests that only infeasible tasks are proven infeasible, also by swept volumes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_box
from helpers.drives import make_hall
from helpers.small_problems import SHORT, load_door_scene, make_program
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.planning.base_paths.base_path import shortest_path
from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.planning.diagnosis.proofs import PROVEN, find_proofs, find_swept_collisions
from vkc_pin.planning.initialization.base_routes import collect_grid_shapes
from vkc_pin.world.task.steps import Step


def find_hall_proofs(obstacles: Sequence[dict[str, Any]], *steps: vkc.steps.Step) -> list[str]:
    return find_proofs(make_program(make_hall(obstacles=obstacles), list(steps), options=SHORT))


@pytest.mark.parametrize("x", [0.0, 4.0], ids=["start", "goal"])
def test_all_sides_of_a_ring_are_named(x: float) -> None:
    sides = {"north": (0, 1), "south": (0, -1), "east": (1, 0), "west": (-1, 0)}
    ring = [
        describe_box(name, (0.1 if u else 2.0, 0.1 if v else 2.0, 1.0), (x + u, v, 0.5))
        for name, (u, v) in sides.items()
    ]
    (line,) = find_hall_proofs(ring, vkc.GoTo(4.0, 0.0))
    assert line.endswith("cut off by north, south, east, west")


@pytest.mark.parametrize("width", [0.3, 0.62, 0.68, 0.85])  # the base is 0.67 m wide
def test_gap_too_narrow_for_the_base_is_proven(width: float) -> None:
    length = 6.0 - width / 2
    walls = [
        describe_box(name, (0.1, length, 1.0), (1.2, side * (width + length) / 2, 0.5))
        for name, side in (("left", 1), ("right", -1))
    ]
    lines = find_hall_proofs(walls, vkc.GoTo(3.0, 0.0))
    assert bool(lines) == (width < 0.67)
    assert all(line.endswith("cut off by left, right") for line in lines)


@pytest.mark.parametrize(
    ("wall", "step"),
    [
        (
            describe_box("fence", (0.1, 12.0, 0.6), (1.2, 0.0, 0.3)),
            vkc.Reach((1.8, 0.0, 1.0, 0.0, np.pi / 2, 0.0)),
        ),
        (describe_box("beam", (0.1, 12.0, 0.3), (1.2, 0.0, 1.5)), vkc.GoTo(3.0, 0.0)),
    ],
    ids=["arm reaches across", "base passes under"],
)
def test_passable_wall_proves_nothing(wall: dict[str, Any], step: vkc.steps.Step) -> None:
    assert find_hall_proofs([wall], step) == []


@pytest.mark.parametrize("height", [0.42, 0.47])
def test_wall_that_the_arm_mount_hits_separates_the_goal(height: float) -> None:
    """The base passes under a shorter wall at the arena's edge, with the mount beside the wall."""
    longer, shorter = (
        describe_box("beam", (0.1, y, 1.0), (1.2, 0.0, 0.5 + height)) for y in (13.0, 12.0)
    )
    (line,) = find_hall_proofs([longer], vkc.GoTo(3.0, 0.0))
    assert line.endswith("cut off by beam")
    assert find_hall_proofs([shorter], vkc.GoTo(3.0, 0.0)) == []


def test_goal_in_reach_from_outside_the_arena_is_proven_infeasible() -> None:
    (line,) = find_hall_proofs([], vkc.Reach((8.0, 0.0, 0.8, np.pi / 2, 0.0, 0.0)))
    assert line.startswith("reach with tool: ")
    assert line.endswith(PROVEN + "the goal is in reach from outside the arena alone")


def test_failing_phase_is_named() -> None:
    fence = describe_box("fence", (0.1, 12.0, 1.0), (1.2, 0.0, 0.5))
    steps = [vkc.Reach((0.5, 0.4, 1.0, 0.0, np.pi / 2, 0.0)), vkc.GoTo(3.0, 0.0)]
    (line,) = find_hall_proofs([fence], *steps)
    assert line.startswith("go to: ")
    assert find_hall_proofs([fence], steps[0]) == []


def test_closed_door_is_named_unless_opened() -> None:
    steps = [vkc.Actuate("door", {"hinge": 1.4}), vkc.GoTo(4.0, 0.0)]
    blocked, opened = (
        find_proofs(make_program(vkc.load_scene("door"), own, options=SHORT))
        for own in (steps[1:], steps)
    )
    (line,) = blocked
    assert "door.panel" in line
    assert line.endswith("; door is closed meanwhile")
    assert opened == []


@settings(max_examples=16, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_existing_path_disproves_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-5.0, 5.0, (70, 2))
    places = places[np.hypot(*places.T) > 1.5]
    obstacles = [
        {
            **describe_box(f"box_{k}", (*rng.uniform(0.1, 1.6, 2), 1.0), (*at, 0.5)),
            "rpy": [0.0, 0.0, rng.uniform(-np.pi, np.pi)],
        }
        for k, at in enumerate(places)
    ]
    x, y = rng.uniform(-5.0, 5.0, 2).tolist()
    own = make_program(make_hall(obstacles=obstacles), [vkc.GoTo(x, y)], options=SHORT)
    z = own.start.copy()
    z[:3] = 0.0
    moving, standing = collect_grid_shapes(own, 0, z)
    base = [shape for joint, shape in moving if joint <= 1]
    grid = BaseGrid(base, [], standing, own.scene.arena, 0.0)
    goals = np.array([(x, y, yaw) for yaw in np.linspace(0.0, 2 * np.pi, 16, endpoint=False)])
    if shortest_path(grid, own.start[:3].tolist(), goals) is not None:
        assert find_proofs(own) == []


@pytest.mark.parametrize(
    ("name", "owner"),
    [
        ("corridor_door", "door"),
        ("aisle_drawer", "drawer"),
        ("household", "door"),
        ("fetch", "cabinet"),
    ],
)
def test_nothing_is_proven_for_packaged_scenes(name: str, owner: str) -> None:
    grasp = vkc.Grasp(owner)
    assert find_proofs(make_program(vkc.load_scene(name), [grasp], options=SHORT)) == []


POST = (3.2, 0.14, 0.25)  # in the leaf at 1.14 rad
SIZE = (0.08, 0.1, 0.5)  # [m]
OPTIONS = vkc.Options(reach_waypoints=4, turn_waypoints=3, move_waypoints=6)
SLIDING_BAR = """<robot name="bar"><link name="base"/>
<link name="bar"><collision><geometry><box size="0.08 0.1 0.5"/></geometry></collision></link>
<joint name="up" type="prismatic"><parent link="base"/><child link="bar"/><origin xyz="0 0 0.25"/>
<axis xyz="0 0 1"/><limit lower="0" upper="2" effort="1" velocity="1"/></joint></robot>"""


def explain(
    hinge: float,
    at: Sequence[float] = POST,
    *,
    object_type: str | dict[str, Any] | None = None,
    state: float = 0.0,
    size: Sequence[float] = SIZE,
    allow: Sequence[Any] = (),
    before: Sequence[Step] = (),
) -> list[str]:
    """Explain why the door cannot be opened with a box or an object of some type in the room.

    `before` are steps that come first.
    """
    scene = load_door_scene().with_state("door", {"hinge": state})
    post: dict[str, Any] = {"name": "post", "position": list(at)}
    kind = "obstacles" if object_type is None else "objects"
    post |= {"type": "box", "size": list(size)} if object_type is None else {"type": object_type}
    document = {**scene.document, kind: [*scene.document[kind], post], "allow": list(allow)}
    scene = vkc.Scene.from_document(document, scene.folder)
    steps = [*before, vkc.Actuate("door", {"hinge": hinge})]
    return find_swept_collisions(make_program(scene, steps, options=OPTIONS))


def test_obstacle_in_the_swept_volume_is_named() -> None:
    (line,) = explain(1.3)
    assert "no path for door.hinge, proven: between 0 and 1.3, at " in line
    assert "door.panel – post overlap by " in line
    worst, first = float(line.split(", at ")[1].split(",")[0]), float(line.split("first at ")[1])
    assert 1.0 < first < worst < 1.3
    assert explain(first - 0.01) == []


@pytest.mark.parametrize(
    ("hinge", "at", "state"),
    [(0.7, POST, 0.0), (1.3, (3.2, 0.14, 2.6), 0.0), (1.5, POST, 1.45)],
    ids=["ends before", "above the leaf", "begins beyond"],
)
def test_obstacle_elsewhere_proves_nothing(hinge: float, at: Sequence[float], state: float) -> None:
    assert explain(hinge, at, state=state) == []


BAR = {"urdf": SLIDING_BAR, "attachments": []}


@pytest.mark.parametrize(
    ("object_type", "height"),
    [("ball", 0.4), ("cabinet", 0.0), (BAR, 0.0)],
    ids=["ball", "cabinet", "sliding bar"],
)
def test_objects_that_nobody_moves_are_obstacles(object_type: Any, height: float) -> None:
    (line,) = explain(1.3, (3.2, 0.14, height), object_type=object_type)
    assert "door.panel – post." in line


def test_object_that_is_moved_before_proves_nothing() -> None:
    away = [vkc.Place("post", (0.0, 2.0, 0.04))]
    assert explain(1.3, (3.2, 0.14, 0.4), object_type="ball", before=away) == []


@cache
def transform_leaf(angle: float) -> pin.SE3:
    """Return the motion of the leaf from closed to an angle [rad]."""
    placed = load_door_scene().objects["door"]
    model = placed.object.model
    hinge = placed.placement * model.jointPlacements[model.getJointId("hinge")]
    turn = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, angle), np.zeros(3))
    return hinge * turn * hinge.inverse()


def test_goal_is_clipped_to_the_limit() -> None:
    assert explain(9.0, transform_leaf(0.86).act(np.array(POST))) == []
    assert explain(9.0, transform_leaf(0.2).act(np.array(POST))) != []


@pytest.mark.parametrize(
    ("link", "attachment", "angle"), [("lever", "handle", 0.1), ("panel", "push", 0.6)]
)
def test_link_of_two_joints_proves_nothing(link: str, attachment: str, angle: float) -> None:
    """The lever may turn away from an obstacle, unlike the leaf."""
    placed = load_door_scene().objects["door"]
    frame = placed.link_placement(link) * placed.object.attachments[attachment].placement
    at = transform_leaf(angle).act(frame.translation)
    assert bool(explain(1.3, at, size=(0.02, 0.02, 0.02))) == (link == "panel")


@pytest.mark.parametrize(("depth", "proven"), [(0.0005, False), (0.004, True)])
def test_small_overlap_proves_nothing(depth: float, proven: bool) -> None:
    """A slab of 0.1 m grazes the leaf's lower edge, which is 10 mm above the floor."""
    door = load_door_scene().objects["door"].placement
    x, y, _ = transform_leaf(0.6).act(door.act(np.array([0.0, -0.5, 0.0])))
    assert bool(explain(1.3, (x, y, depth - 0.04), size=(0.1, 0.1, 0.1))) == proven


@pytest.mark.parametrize(("margin", "proven"), [(-0.01, True), (-0.5, False), (None, False)])
def test_allowed_contact_proves_nothing(margin: float | None, proven: bool) -> None:
    pair = ["door.panel", "post"]
    allow: Any = pair if margin is None else {"pair": pair, "margin": margin}
    assert bool(explain(1.3, allow=[allow])) == proven
