"""Tests the scenes of the first experiment, with stick and cube, and grasps of stick and ball."""

from __future__ import annotations

import itertools
from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import compute_clearance, list_placed_shapes
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene, load_scene

SCENES = ("init_1", "init_2", "init_3")
STICK = np.array([2.5, 1.0])
TABLES = ("table_top", *(f"table_leg_{k}" for k in range(1, 5)))
LOW_TABLES = ("low_table_top", *(f"low_table_leg_{k}" for k in range(1, 5)))
HUSKY_WIDTH = 0.67  # [m]


@cache
def scene(name: str) -> Scene:
    return load_scene(name)


@cache
def starts(name: str) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.array([scene(name).sample_start(rng).start[:3] for _ in range(50)])


def bounds(of: Scene, names: tuple[str, ...]) -> np.ndarray:
    """Lowest and highest x, y, z of upright boxes, shape (2, 3)."""
    shapes = [shape for shape in of.obstacles if shape.name in names]
    assert len(shapes) == len(names)
    assert all(np.array_equal(shape.placement.rotation, np.eye(3)) for shape in shapes)
    halves = [np.asarray(shape.geometry.halfSide) for shape in shapes]
    middles = [shape.placement.translation for shape in shapes]
    corners = [(middle - half, middle + half) for middle, half in zip(middles, halves, strict=True)]
    return np.array(
        [np.min([low for low, _ in corners], axis=0), np.max([high for _, high in corners], axis=0)]
    )


def crosses(start: np.ndarray, end: np.ndarray, box: np.ndarray) -> bool:
    """Whether the straight floor path meets a box, shape (2, 2): lowest and highest x, y."""
    with np.errstate(divide="ignore", invalid="ignore"):
        at = np.sort((box - start) / (end - start), axis=0)
    return bool(max(0.0, *at[0]) <= min(1.0, *at[1]))


@pytest.mark.parametrize("name", SCENES)
def test_tables_cube_and_stick_match_the_paper(name: str) -> None:
    here = scene(name)
    assert here.name == name
    assert here.arena == (-5.0, 5.0, -5.0, 5.0)
    assert (here.robot.name, here.robot.base) == ("husky_ur5e", "omni")
    np.testing.assert_array_equal(here.start[3:], [1.57, -0.8678, -2.2043, -0.0347, 1.6315, 0.0])
    for names, low, high in (
        (TABLES[:1], (2.0, 0.0, 0.68), (3.0, 2.0, 0.72)),
        (LOW_TABLES[:1], (-2.0, 2.7, 0.75), (1.0, 4.3, 0.8)),
        (("cube",), (-1.1, 3.9, 0.0), (-0.9, 4.1, 0.2)),
    ):
        np.testing.assert_allclose(bounds(here, names), [low, high], atol=1e-12)
    for names, top in ((TABLES, 0.68), (LOW_TABLES, 0.75)):
        plate = bounds(here, names[:1])
        for leg in names[1:]:
            foot = bounds(here, (leg,))
            np.testing.assert_allclose(foot[:, 2], [0.0, top], atol=1e-12)
            assert (foot[0, :2] > plate[0, :2]).all()
            assert (foot[1, :2] < plate[1, :2]).all()
            assert (np.ptp(foot[:, :2], axis=0) <= 0.1).all()
    others = set(here.obstacle_names) - {*TABLES, *LOW_TABLES, "cube"}
    assert others == {"init_1": set(), "init_2": {"crate_1", "crate_2"}, "init_3": {"block"}}[name]
    assert list(here.objects) == ["stick"]
    np.testing.assert_allclose(here.objects["stick"].placement.translation[:2], STICK)


def test_scenes_differ_only_in_obstacles() -> None:
    first = scene("init_1")
    for name in SCENES[1:]:
        other = {
            key: value
            for key, value in scene(name).document.items()
            if key not in ("name", "obstacles")
        }
        assert other == {
            key: value for key, value in first.document.items() if key not in ("name", "obstacles")
        }
        assert (
            scene(name).document["obstacles"][: len(first.obstacle_names)]
            == first.document["obstacles"]
        )


def test_block_size_matches_the_paper() -> None:
    np.testing.assert_allclose(
        bounds(scene("init_3"), ("block",)), [[1.0, -3.5, 0.0], [3.0, -0.5, 2.1]], atol=1e-12
    )


@pytest.mark.parametrize("name", SCENES)
def test_fifty_starts_can_be_drawn(name: str) -> None:
    drawn = starts(name)
    region = scene(name).start_region
    assert region is not None
    for column, interval in ((0, region.x), (1, region.y)):
        assert interval[0] <= drawn[:, column].min() < drawn[:, column].max() <= interval[1]
        assert np.ptp(drawn[:, column]) > 0.9 * (interval[1] - interval[0]), "they fill the region"
    assert np.ptp(drawn[:, 2]) > 5.5, "any heading"
    assert (
        min(scene(name).with_start(base=base).start_clearance() for base in drawn)
        >= START_CLEARANCE
    )


def test_straight_path_to_the_stick_crosses_the_block() -> None:
    block, region = bounds(scene("init_3"), ("block",))[:, :2], scene("init_3").start_region
    assert region is not None
    corners = itertools.product(region.x, region.y)
    assert all(crosses(np.array(corner), STICK, block) for corner in corners), (
        "and so does that from any place between them"
    )
    assert all(crosses(start[:2], STICK, block) for start in starts("init_3"))


def test_first_scene_has_no_obstacles_on_the_path() -> None:
    here = scene("init_1")
    for name in set(here.obstacle_names) - set(TABLES):
        assert not any(
            crosses(start[:2], STICK, bounds(here, (name,))[:, :2]) for start in starts("init_1")
        )


def test_second_scene_has_two_obstacles_on_most_paths() -> None:
    """The base's centre cannot pass within half the robot's width of either obstacle."""
    around = np.array([[-1.0], [1.0]]) * HUSKY_WIDTH / 2
    first, second = (
        bounds(scene("init_2"), (name,))[:, :2] + around for name in ("crate_1", "crate_2")
    )
    assert 0.5 < np.mean([crosses(start[:2], STICK, first) for start in starts("init_2")]) <= 1.0
    # From west of the stick's table, where the arm reaches the stick, to west of the low table,
    # whence the stick the cube.
    for stood in np.linspace([1.45, 0.6], [1.45, 1.4], 9):
        assert crosses(stood, np.array([-2.6, 4.0]), second)


def test_the_stick_lies_on_its_table_without_touching_it() -> None:
    for name in SCENES:
        here = scene(name)
        stick = list_placed_shapes(make_world_shapes(here.objects["stick"]))
        top = [shape for shape in here.obstacles if shape.name == "table_top"]
        assert 0.0005 <= compute_clearance(stick, list_placed_shapes(top)) < 0.002
        others = [shape for shape in here.obstacles if shape.name != "table_top"]
        assert compute_clearance(stick, list_placed_shapes(others)) > 0.02


def test_the_stick_is_a_tenth_by_half_a_metre_and_its_tip_points_east() -> None:
    placed = scene("init_1").objects["stick"]
    assert placed.object.free
    assert placed.object.coordinates.size == 0
    lows, highs = [], []
    for shape in placed.object.collision.geometryObjects:
        ends = [support(shape, direction) for direction in np.vstack([np.eye(3), -np.eye(3)])]
        highs.append(ends[:3])
        lows.append([-end for end in ends[3:]])
    np.testing.assert_allclose(np.min(lows, axis=0), [-0.05, -0.25, -0.05], atol=1e-9)
    np.testing.assert_allclose(np.max(highs, axis=0), [0.05, 0.25, 0.05], atol=1e-9)
    tip = placed.link_placement("tip")
    np.testing.assert_allclose(tip.translation, [2.75, 1.0, 0.771], atol=1e-12)
    np.testing.assert_allclose(tip.rotation[:, 2], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(tip.rotation[:, 0], placed.placement.rotation[:, 0], atol=1e-12)
    assert sum(inertia.mass for inertia in placed.object.model.inertias) == pytest.approx(
        0.39, abs=0.01
    )
    drawn, solid = (
        geometry.geometryObjects for geometry in (placed.object.visual, placed.object.collision)
    )
    for picture, shape in zip(drawn, solid, strict=True):
        assert picture.placement == shape.placement
        assert type(picture.geometry) is type(shape.geometry)
        for size in ("radius", "halfLength"):
            assert getattr(picture.geometry, size, None) == getattr(shape.geometry, size, None)


def support(shape: pin.GeometryObject, direction: np.ndarray) -> float:
    """How far a cylinder or a sphere reaches along a direction of its link's frame."""
    middle, local = direction @ shape.placement.translation, shape.placement.rotation.T @ direction
    if isinstance(shape.geometry, coal.Sphere):
        return float(middle + shape.geometry.radius)
    assert isinstance(shape.geometry, coal.Cylinder)
    across = np.hypot(local[0], local[1])
    return float(
        middle + shape.geometry.halfLength * abs(local[2]) + shape.geometry.radius * across
    )


# --- the grasps
# ------------------------------------------------------------------------------------------


def hand(robot: Robot, tool: pin.SE3) -> list[tuple[coal.CollisionGeometry, pin.SE3]]:
    """The gripper's shapes with the tool frame at `tool`."""
    model, geometry = robot.model, robot.collision
    data, shapes = model.createData(), geometry.createData()
    q = robot.coordinates.q(np.concatenate([np.zeros(3), robot.home]))
    pin.framesForwardKinematics(model, data, q)
    pin.updateGeometryPlacements(model, data, geometry, shapes)
    back = data.oMf[model.getFrameId(robot.tool_frame)].inverse()
    found = [
        (shape.geometry, tool * back * shapes.oMg[index])
        for index, shape in enumerate(geometry.geometryObjects)
        if robot.link_of(index) in robot.touch_links
    ]
    assert len(found) == 5
    return found


SLIDES = np.linspace(-0.095, 0.095, 5)


@pytest.mark.parametrize(("turn", "table"), [(0.0, 0.04), (0.45, 0.02), (-0.45, 0.02)])
def test_the_hand_fits_round_the_stick_along_the_whole_range(turn: float, table: float) -> None:
    """It keeps dist_safe from the table, and grasp_clearance from dowel and discs."""
    here = scene("init_1")
    placed = here.objects["stick"]
    grip = placed.object.attachments["grip"]
    assert (grip.joint, grip.firm, grip.coordinates) == (
        "cylindrical",
        True,
        ("grip_slide", "grip_turn"),
    )
    assert [(freedom.lower, freedom.upper) for freedom in grip.freedoms] == [
        (-0.095, 0.095),
        (-1.2, 1.2),
    ]
    dowel, butt, front, *tip = list_placed_shapes(make_world_shapes(placed))
    world = [shape for shape in here.obstacles if shape.name in (*TABLES, "floor")]
    for slide in SLIDES:
        tool = placed.link_placement("stick") * grip.placement * grip.motion([slide, turn])
        shapes = hand(here.robot, tool)
        assert compute_clearance(shapes, list_placed_shapes(world)) > table
        assert compute_clearance(shapes, [dowel]) > 0.005
        assert compute_clearance(shapes, [butt]) > 0.005
        assert compute_clearance(shapes, [front, *tip]) > 0.05
        # The dowel's axis runs between the pads, 0.01 in front of the tool frame and across the
        # closing direction.
        inside = tool.actInv(dowel[1])
        np.testing.assert_allclose(inside.translation[[0, 2]], [0.0, 0.01], atol=1e-9)
        np.testing.assert_allclose(np.abs(inside.rotation[:, 2]), [0.0, 1.0, 0.0], atol=1e-9)


def test_sliding_goes_towards_the_tip_and_stays_in_the_half_away_from_it() -> None:
    placed = scene("init_1").objects["stick"]
    grip, tip = (
        placed.object.attachments["grip"],
        placed.object.link_placement("tip", []).translation,
    )
    low, high = (
        (grip.placement * grip.motion([freedom, 0.0])).translation for freedom in (-0.095, 0.095)
    )
    assert np.linalg.norm(low - tip) > np.linalg.norm(high - tip)
    np.testing.assert_allclose([low, high], [[0.0, -0.19, 0.01], [0.0, 0.0, 0.01]], atol=1e-12)
    end = placed.object.attachments["end"]
    assert (end.joint, end.freedoms, end.firm) == ("fixed", (), True)
    middle = (grip.placement * grip.motion([0.0, 0.0])).homogeneous
    np.testing.assert_allclose((end.placement * end.motion()).homogeneous, middle, atol=1e-12)


@pytest.mark.parametrize("turn", [1.2, -1.2])
def test_in_the_air_the_hand_fits_at_the_ends_of_its_turn_too(turn: float) -> None:
    placed = scene("init_1").objects["stick"]
    grip, shapes = placed.object.attachments["grip"], list_placed_shapes(make_world_shapes(placed))
    for slide in SLIDES:
        tool = placed.link_placement("stick") * grip.placement * grip.motion([slide, turn])
        assert compute_clearance(hand(scene("init_1").robot, tool), shapes) > 0.005


LYING = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.036]))  # the ball, 1 mm above the floor


@pytest.mark.parametrize(
    "turn",
    [(0.0, 0.0, 0.0), (1.2, 0.0, 0.0), (-1.2, 0.0, 0.0), (0.0, 0.15, 0.7), (0.0, -0.15, -1.5)],
)
def test_the_hand_fits_round_a_ball_on_the_floor(turn: tuple[float, float, float]) -> None:
    ball, here = load_object("ball"), scene("init_1")
    grip = ball.attachment()
    assert (ball.free, grip.firm, grip.joint) == (True, True, "spherical")
    assert {(freedom.lower, freedom.upper) for freedom in grip.freedoms} == {(-1.5, 1.5)}
    (round_,) = ball.collision.geometryObjects
    tool = LYING * grip.placement * grip.motion(turn)
    shapes = hand(here.robot, tool)
    assert compute_clearance(shapes, [(round_.geometry, LYING)]) > 0.005
    assert (
        compute_clearance(
            shapes, list_placed_shapes([s for s in here.obstacles if s.name == "floor"])
        )
        > 0.02
    )
    np.testing.assert_allclose(tool.actInv(LYING).translation, [0.0, 0.0, 0.01], atol=1e-12)


def test_hand_never_grasps_the_ball_from_below() -> None:
    grip = load_object("ball").attachment("grip")
    for turn in itertools.product(np.linspace(-1.5, 1.5, 7), repeat=3):
        assert (grip.placement * grip.motion(turn)).rotation[2, 2] < 0.0


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-np.pi, np.pi)] * 3))
def test_a_sticks_tip_touches_the_ball_and_points_at_its_centre(
    turn: tuple[float, float, float],
) -> None:
    ball, stick = load_object("ball"), scene("init_1").objects["stick"].object
    pull = ball.attachment("pull")
    assert all(
        freedom.lower <= value <= freedom.upper
        for freedom, value in zip(pull.freedoms, turn, strict=True)
    )
    tip = pull.placement * pull.motion(turn)
    np.testing.assert_allclose(tip.actInv(np.zeros(3)), [0.0, 0.0, 0.035], atol=1e-12)
    (round_,) = ball.collision.geometryObjects
    at = tip * stick.link_placement("tip", []).inverse()
    dowel, butt, front, shaft, pole = [
        (shape.geometry, at * shape.placement) for shape in stick.collision.geometryObjects
    ]
    around = [(round_.geometry, pin.SE3.Identity())]
    assert compute_clearance([pole], around) == pytest.approx(0.0, abs=1e-6)
    assert compute_clearance([dowel, butt, front, shaft], around) > 0.005
