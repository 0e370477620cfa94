"""Tests the scenes of the second experiment: a door in a corridor, a drawer in a narrow aisle."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.planning.chain.inverse_kinematics import PoseSolver
from vkc_pin.planning.chain.pose import PoseRow
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import compute_clearance, get_link_name, list_placed_shapes
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene, load_scene

SCENES = ("corridor_door", "aisle_drawer")
GOALS = {"corridor_door": ("door", {"hinge": 1.5}), "aisle_drawer": ("drawer", {"slide": 0.6})}
RELEASED = {
    "corridor_door": {"knob": 0.52},
    "aisle_drawer": {},
}  # so far is the lever turned while the door moves
HELD = {"corridor_door": "lever", "aisle_drawer": "tray"}
BLOCKS, WALLS = ("block_left", "block_right"), ("wall_north_left", "wall_north_right")
DIST_SAFE = 0.02  # [m]

Shapes = list[tuple[coal.CollisionGeometry, pin.SE3]]


@cache
def scene(name: str) -> Scene:
    return load_scene(name)


def thing(name: str, **state: float) -> PlacedObject:
    """The scene's door or drawer at some state."""
    return scene(name).objects[GOALS[name][0]].with_state(state)


def standing(name: str, *names: str) -> Shapes:
    """Shapes of some obstacles."""
    found = [shape for shape in scene(name).obstacles if shape.name in names]
    assert len(found) == len(names)
    return list_placed_shapes(found)


def parts(placed: PlacedObject, *links: str) -> Shapes:
    """Shapes of some of an object's links."""
    found = [shape for shape in make_world_shapes(placed) if get_link_name(shape.name) in links]
    assert found
    return list_placed_shapes(found)


def bounds(shapes: Iterable[tuple[coal.CollisionGeometry, pin.SE3]]) -> np.ndarray:
    """Lowest and highest x, y, z of shapes that stand along the axes, shape (2, 3)."""
    lows, highs = [], []
    for shape, placement in shapes:
        reach = np.abs(placement.rotation) @ half_extents(shape)
        lows.append(placement.translation - reach)
        highs.append(placement.translation + reach)
    return np.array([np.min(lows, axis=0), np.max(highs, axis=0)])


def half_extents(shape: coal.CollisionGeometry) -> np.ndarray:
    if isinstance(shape, coal.Box):
        return np.asarray(shape.halfSide)
    assert isinstance(shape, coal.Cylinder)
    return np.array([shape.radius, shape.radius, shape.halfLength])


@pytest.mark.parametrize("name", SCENES)
def test_robot_and_arena_match_the_paper(name: str) -> None:
    here = scene(name)
    assert here.name == name
    assert (here.robot.name, here.robot.base) == ("husky_ur5e", "omni")
    np.testing.assert_array_equal(here.start[3:], [1.57, -0.8678, -2.2043, -0.0347, 1.6315, 0.0])
    assert (
        here.arena
        == {"corridor_door": (-5.0, 7.0, -5.0, 5.0), "aisle_drawer": (-5.0, 5.0, -5.0, 5.0)}[name]
    )
    assert list(here.objects) == [GOALS[name][0]]
    assert here.start_clearance() >= START_CLEARANCE


@pytest.mark.parametrize("name", SCENES)
def test_goal_is_within_limits_and_joints_have_rates(name: str) -> None:
    placed, (_, goal) = thing(name), GOALS[name]
    assert (
        placed.object.coordinates.names
        == {"corridor_door": ("hinge", "knob"), "aisle_drawer": ("slide",)}[name]
    )
    assert thing(name, **goal).state[0] == next(iter(goal.values()))
    np.testing.assert_array_equal(placed.state, 0.0)
    limits = {
        "corridor_door": [[-np.pi / 2, 0.0], [np.pi / 2, 0.8]],
        "aisle_drawer": [[0.0], [0.65]],
    }[name]
    np.testing.assert_allclose([placed.object.lower, placed.object.upper], limits, atol=1e-6)
    rates = {"corridor_door": ([1.0, 2.0], [1.0, 4.0]), "aisle_drawer": ([0.5], [1.0])}[name]
    np.testing.assert_array_equal([placed.object.velocity, placed.object.acceleration], rates)
    pushes = {"corridor_door": ["push", "push_back"], "aisle_drawer": ["push"]}[name]
    assert list(placed.object.attachments) == ["handle", "handle_free", *pushes]
    fixed, free = (placed.object.attachment(each) for each in ("handle", "handle_free"))
    assert (fixed.joint, free.joint, fixed.firm, free.firm) == ("fixed", "revolute", False, False)
    assert fixed.placement == free.placement


@pytest.mark.parametrize("name", SCENES)
def test_starts_are_in_the_region_of_the_paper_and_collision_free(name: str) -> None:
    here, rng = scene(name), np.random.default_rng(0)
    low, high = {
        "corridor_door": ((-2.5, -3.0), (-0.5, 3.0)),
        "aisle_drawer": ((0.0, 0.0), (1.0, 5.0)),
    }[name]
    drawn = [here.sample_start(rng) for _ in range(30)]
    bases = np.array([each.start[:3] for each in drawn])
    assert (bases[:, :2] >= low).all()
    assert (bases[:, :2] <= high).all()
    assert (np.ptp(bases[:, :2], axis=0) > 0.8 * np.subtract(high, low)).all(), (
        "they fill the region"
    )
    assert np.ptp(bases[:, 2]) > 5.0, "any heading"
    assert min(each.start_clearance() for each in drawn) >= START_CLEARANCE
    if name == "aisle_drawer":  # before either end of the first counter
        assert {y > 2.5 for y in bases[:, 1]} == {True, False}
        assert (np.abs(bases[:, 1] - 2.5) > 3.25 / 2 + 0.335).all()


# --- the door
# ------------------------------------------------------------------------------------------


def test_a_corridor_leads_to_the_door() -> None:
    name = "corridor_door"
    assert compute_clearance(
        standing(name, "block_left"), standing(name, "block_right")
    ) == pytest.approx(2.0, abs=1e-6)
    np.testing.assert_allclose(
        bounds(standing(name, "block_left")), [[0.0, 1.0, 0.0], [5.0, 5.0, 2.06]], atol=1e-9
    )
    np.testing.assert_allclose(
        bounds(standing(name, "block_right")), [[0.0, -5.0, 0.0], [5.0, -1.0, 2.06]], atol=1e-9
    )
    np.testing.assert_allclose(
        bounds(standing(name, "wall_south")), [[-5.05, -5, 0], [-4.95, 5, 2.06]], atol=1e-9
    )
    north = bounds(standing(name, *WALLS))
    np.testing.assert_allclose(north, [[4.95, -5, 0], [5.05, 5, 2.06]], atol=1e-9)
    assert {*scene(name).obstacle_names} == {*BLOCKS, *WALLS, "wall_south"}


def test_panel_width_matches_the_paper() -> None:
    placed = thing("corridor_door")
    np.testing.assert_allclose(
        bounds(parts(placed, "panel")), [[4.975, -0.55, 0.01], [5.025, 0.55, 2.06]], atol=1e-9
    )
    model = placed.object.model
    assert model.names[1] == "hinge"
    np.testing.assert_allclose(
        (placed.placement * model.jointPlacements[1]).translation, [5.0, 0.55, 0.0], atol=1e-12
    )
    left, right = ([shape] for shape in parts(placed, "frame"))
    assert compute_clearance(left, right) == pytest.approx(1.1 + 0.03 + 0.005, abs=1e-6)
    for post, wall in ((left, WALLS[0]), (right, WALLS[1])):
        assert abs(compute_clearance(post, standing("corridor_door", wall))) < 1e-6, (
            "no gap beside the frame"
        )
        np.testing.assert_allclose(
            bounds(post)[:, [0, 2]], bounds(standing("corridor_door", wall))[:, [0, 2]], atol=1e-9
        )


def test_handle_position_matches_the_paper() -> None:
    placed = thing("corridor_door")
    spindle, bar = parts(placed, "lever")
    assert bar[0].radius == pytest.approx(0.013)
    assert 2 * bar[0].halfLength == pytest.approx(0.10)
    assert spindle[1].translation[1] - -0.55 == pytest.approx(0.08)
    np.testing.assert_allclose(bar[1].translation[[0, 2]], [5.0 - 0.125, 0.95], atol=1e-9)
    tool = placed.link_placement("lever") * placed.object.attachment().placement
    np.testing.assert_allclose(tool.translation[[0, 2]], bar[1].translation[[0, 2]], atol=1e-9)
    low, high = bounds([bar])[:, 1]
    assert low + 0.011 < tool.translation[1] < high - 0.011, (
        "the fingers, 0.022 wide, are on the bar"
    )
    turned = thing("corridor_door", knob=0.5)
    assert (turned.link_placement("lever") * turned.object.attachment().placement).translation[
        2
    ] < 0.95, "it is pressed down"


def test_the_door_swings_free_of_walls_and_frame() -> None:
    for angle in np.linspace(-np.pi / 2, np.pi / 2, 25):
        placed = thing("corridor_door", hinge=float(angle))
        moving = parts(placed, "panel", "lever")
        world = standing("corridor_door", *scene("corridor_door").obstacle_names)
        assert compute_clearance(moving, world) > DIST_SAFE + 0.01
        assert compute_clearance(moving, parts(placed, "frame")) > 0.004
    open_ = bounds(parts(thing("corridor_door", hinge=np.pi / 2), "panel"))
    assert open_[1, 0] == pytest.approx(5.0 + 1.1, abs=1e-6), (
        "hinge > 0 pushes it away from the corridor"
    )


def test_lever_holds_the_door_shut() -> None:
    (latch,) = thing("corridor_door").object.latches
    assert (latch.joint, latch.held_at, latch.released_by) == ("hinge", 0.0, "knob")
    assert (latch.threshold, latch.engaged_within) == (0.5, 0.05)


# --- the drawer
# ------------------------------------------------------------------------------------------


def test_counters_leave_an_aisle() -> None:
    name = "aisle_drawer"
    figures = {
        1: ((2.25, 3.25), (1.125, 2.5)),
        2: ((1.0, 6.0), (4.0, 2.5)),
        3: ((4.5, 1.0), (2.25, 6.0)),
    }
    for number, (size, middle) in figures.items():
        top = bounds(standing(name, f"worktop_{number}"))
        np.testing.assert_allclose(np.ptp(top[:, :2], axis=0), size, atol=1e-9)
        np.testing.assert_allclose(top[:, :2].mean(axis=0), middle, atol=1e-9)
        body = bounds(standing(name, f"counter_{number}"))
        assert (top[1, 2], body[0, 2]) == pytest.approx((0.7, 0.0))
        assert body[1, 2] == pytest.approx(top[0, 2])
        np.testing.assert_allclose(
            [body[0, :2] - top[0, :2], top[1, :2] - body[1, :2]], 0.02, atol=1e-9
        )
    assert compute_clearance(
        standing(name, "worktop_1"), standing(name, "worktop_2")
    ) == pytest.approx(1.25, abs=1e-6)
    rest = {*scene(name).obstacle_names} - {
        f"{part}_{number}" for part in ("worktop", "counter") for number in figures
    }
    assert (
        bounds([each for one in rest - {"plant"} for each in standing(name, one)])[0, 2]
        >= 0.7 - 1e-9
    ), "they stand on them"


def test_drawer_size_matches_the_paper() -> None:
    placed = thing("aisle_drawer")
    front, left, right, back, bottom, *handle = parts(placed, "tray")
    case = parts(placed, "case")[:-1]  # without its plinth
    around = bounds([*case, front])
    np.testing.assert_allclose(around.mean(axis=0), [4.0, 2.5, 0.9], atol=1e-9)
    np.testing.assert_allclose(np.ptp(around, axis=0), [1.0, 0.6, 0.3], atol=1e-9)
    for wall in (front, left, right, back, bottom, *case):
        assert 2 * half_extents(wall[0]).min() == pytest.approx(0.02)
    assert bounds(parts(placed, "case"))[0, 2] == pytest.approx(0.7), "it stands on the counter"
    assert around[0, 0] == pytest.approx(bounds(standing("aisle_drawer", "worktop_2"))[0, 0]), (
        "flush with its edge"
    )
    assert compute_clearance([left, right, back, bottom], case) == pytest.approx(0.01, abs=1e-6)
    tool = placed.link_placement("tray") * placed.object.attachment().placement
    np.testing.assert_allclose(tool.translation, handle[0][1].translation, atol=1e-9)
    assert compute_clearance([handle[0]], [front]) == pytest.approx(0.07 - 0.01, abs=1e-6)


def test_open_drawer_blocks_the_aisle() -> None:
    name = "aisle_drawer"
    for slide in np.linspace(0.0, 0.65, 14):
        placed = thing(name, slide=float(slide))
        assert (
            compute_clearance(parts(placed, "tray"), standing(name, *scene(name).obstacle_names))
            > DIST_SAFE
        )
        assert compute_clearance(parts(placed, "tray"), parts(placed, "case")) > 0.004
    out = bounds(parts(thing(name, slide=0.6), "tray")[:1])
    shut = bounds(parts(thing(name), "tray")[:1])
    np.testing.assert_allclose(out - shut, [[-0.6, 0, 0]] * 2, atol=1e-9)
    assert out[0, 0] - bounds(standing(name, "worktop_1"))[1, 0] == pytest.approx(0.65), (
        "a Husky is 0.67 wide"
    )


# --- the robot at both
# ------------------------------------------------------------------------------------------


def robot_shapes(robot: Robot, z: np.ndarray) -> list[tuple[str, coal.CollisionGeometry, pin.SE3]]:
    """The robot's links and shapes at a configuration."""
    data, shapes = robot.model.createData(), robot.collision.createData()
    pin.updateGeometryPlacements(robot.model, data, robot.collision, shapes, robot.coordinates.q(z))
    return [
        (robot.link_of(index), shape.geometry, placement)
        for index, (shape, placement) in enumerate(
            zip(robot.collision.geometryObjects, shapes.oMg, strict=True)
        )
    ]


def tool_frame(robot: Robot) -> pin.Frame:
    return robot.model.frames[robot.model.getFrameId(robot.tool_frame)]


def room(
    name: str, placed: PlacedObject, robot: list[tuple[str, coal.CollisionGeometry, pin.SE3]]
) -> float:
    """Smallest distance between robot and world [m], except of fingers to the grasped object."""
    here = scene(name)
    labels = zip(here.obstacles, here.obstacle_labels, strict=True)
    world = list_placed_shapes([shape for shape, label in labels if label != FLOOR])
    others = [
        link
        for link in {get_link_name(shape.name) for shape in make_world_shapes(placed)}
        if link != HELD[name]
    ]
    held, touch = parts(placed, HELD[name]), here.robot.touch_links
    everything = [(shape, placement) for _, shape, placement in robot]
    without_hand = [(shape, placement) for link, shape, placement in robot if link not in touch]
    return min(
        compute_clearance(everything, world + parts(placed, *others)),
        compute_clearance(without_hand, held),
    )


def solutions(name: str, placed: PlacedObject, *, count: int = 60) -> np.ndarray:
    """Configurations with the hand at the handle, from random ones near it."""
    robot, rng = scene(name).robot, np.random.default_rng(0)
    target = placed.link_placement(HELD[name]) * placed.object.attachment().placement
    frame = tool_frame(robot)
    solver = PoseSolver(robot.model, PoseRow(frame.parentJoint, pin.SE3(frame.placement), ()))
    lower, upper = robot.lower.copy(), robot.upper.copy()
    arena = scene(name).arena
    near = target.translation[:2]
    lower[:3] = [*np.maximum(arena[::2], near - 1.2), -np.pi]
    upper[:3] = [*np.minimum(arena[1::2], near + 1.2), np.pi]
    seeds = rng.uniform(lower, upper, (count, len(lower)))
    seeds[:, 3:] = robot.home + rng.uniform(-0.8, 0.8, (count, len(lower) - 3))
    found, solved = solver.solve(
        seeds, target, lower=lower, upper=upper, weights=np.ones(len(lower)), iterations=40
    )
    return found[solved]


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("moved", [False, True], ids=["start", "goal"])
def test_the_arm_reaches_the_handle_without_touching_anything(name: str, moved: bool) -> None:
    placed = thing(name, **RELEASED[name], **(GOALS[name][1] if moved else {}))
    robot = scene(name).robot
    data, shapes = robot.model.createData(), robot.collision.createData()
    free = []
    for z in solutions(name, placed):
        q = robot.coordinates.q(z)
        if pin.computeCollisions(robot.model, data, robot.collision, shapes, q, True):
            continue
        if room(name, placed, robot_shapes(robot, z)) >= DIST_SAFE:
            pin.framesForwardKinematics(robot.model, data, q)
            tool = data.oMf[robot.model.getFrameId(robot.tool_frame)]
            wanted = placed.link_placement(HELD[name]) * placed.object.attachment().placement
            np.testing.assert_allclose(tool.homogeneous, wanted.homogeneous, atol=1e-5)
            free.append(z)
    assert len(free) >= 2


@pytest.mark.parametrize("name", SCENES)
def test_hand_is_collision_free_along_the_whole_range(name: str) -> None:
    """Hand and wrist are clear of other shapes; the fingers keep grasp_clearance."""
    robot, (_, goal) = scene(name).robot, GOALS[name]
    z = np.concatenate([np.zeros(3), robot.home])
    links = {*robot.touch_links, "wrist_3_link"}
    hand = [each for each in robot_shapes(robot, z) if each[0] in links]
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
    back = data.oMf[robot.model.getFrameId(robot.tool_frame)].inverse()
    (joint, end), released = next(iter(goal.items())), RELEASED[name]
    for value in np.linspace(0.0, end, 16):
        placed = thing(name, **released, **{joint: float(value)})
        tool = placed.link_placement(HELD[name]) * placed.object.attachment().placement
        there = [(link, shape, tool * back * placement) for link, shape, placement in hand]
        assert room(name, placed, there) > 0.06, "the rest of the arm, behind it, needs some too"
        assert compute_clearance([each[1:] for each in there], parts(placed, HELD[name])) > 0.005


def test_the_robot_fits_through_door_and_aisle() -> None:
    """Its base, 0.67 m wide, drives straight through the open door and along the aisle."""
    for name, headings, path in (
        ("corridor_door", (0.0, np.pi), np.linspace([0.0, -0.1], [6.5, -0.1], 14)),
        ("aisle_drawer", (np.pi / 2, -np.pi / 2), np.linspace([2.875, -1.0], [2.875, 4.8], 14)),
    ):
        here = scene(name)
        goal = GOALS[name][1] if name == "corridor_door" else {}
        here = here.with_state(GOALS[name][0], goal)
        placed = thing(name, **goal)
        world = [
            shape
            for shape, label in zip(here.obstacles, here.obstacle_labels, strict=True)
            if label != FLOOR
        ]
        arm = {
            "shoulder_link",
            "upper_arm_link",
            "forearm_link",
            "wrist_1_link",
            "wrist_2_link",
            "wrist_3_link",
        }
        around = list_placed_shapes(world) + list_placed_shapes(make_world_shapes(placed))
        for heading in headings:
            for x, y in path:
                z = np.concatenate([[x, y, heading], here.robot.home])
                base = [
                    each[1:]
                    for each in robot_shapes(here.robot, z)
                    if each[0] not in {*arm, *here.robot.touch_links}
                ]
                assert compute_clearance(base, around) > DIST_SAFE, (name, x, y)
