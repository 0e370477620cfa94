"""Tests the dimensions and clearances of the packaged scenes."""

from __future__ import annotations

from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin import PlacedObject, Scene, load_object, load_scene
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.models.shapes import (
    compute_clearance,
    compute_world_box,
    get_link_name,
    list_placed_shapes,
)
from vkc_pin.world.scene.clearance_exemptions import find_close_pairs
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE

DIST_SAFE, GRASP_CLEARANCE = 0.02, 0.005  # [m], defaults of the planner
RANDOM_STARTS = sorted(
    file.stem
    for file in find_resource_folder("scenes").glob("*.yaml")
    if "\nstart_region:" in file.read_text()
)
OBJECTS = (
    *("narrow_door", "low_drawer", "dishwasher", "refrigerator", "cabinet", "cup", "broom"),
    *("stick", "ball", "litter", "door", "drawer"),
)


@cache
def load(name: str = "household") -> Scene:
    return load_scene(name)


def place_at_origin(name: str, **state: float) -> PlacedObject:
    item = load_object(name)
    placed = PlacedObject(name, item, pin.SE3.Identity(), np.zeros(item.coordinates.size))
    return placed.with_state(state)


def list_parts(placed: PlacedObject, *links: str) -> list[pin.GeometryObject]:
    """Return an object's shapes, of all links by default, in the world frame."""
    return [s for s in make_world_shapes(placed) if not links or get_link_name(s.name) in links]


def list_obstacles(scene: Scene, name: str) -> list[pin.GeometryObject]:
    labels = zip(scene.obstacles, scene.obstacle_labels, strict=True)
    return [shape for shape, label in labels if label == name]


def list_close_labels(scene: Scene, reach: float) -> set[str]:
    """Return the labels of links and obstacles that are closer than `reach` [m] to others."""
    return {label for pair in find_close_pairs(scene, reach) for label in pair[:2]}


def place_hand(tool: pin.SE3) -> list[tuple[coal.CollisionGeometry, pin.SE3]]:
    """Return the shapes of the open gripper with the tool frame at `tool`."""
    scene = load()
    robot, back = scene.robot, tool * scene.tool_placement().inverse()
    data, places = robot.model.createData(), robot.collision.createData()
    q = robot.coordinates.q(scene.start)
    pin.updateGeometryPlacements(robot.model, data, robot.collision, places, q)
    return [
        (shape.geometry, back * places.oMg[k])
        for k, shape in enumerate(robot.collision.geometryObjects)
        if robot.link_of(k) in robot.touch_links
    ]


@pytest.mark.parametrize("name", RANDOM_STARTS)
def test_random_starts_fill_their_region(name: str) -> None:
    scene, rng = load(name), np.random.default_rng(0)
    region = scene.start_region
    assert scene.name == name
    assert region is not None
    assert scene.start_clearance() >= START_CLEARANCE
    samples = [scene.sample_start(rng) for _ in range(25)]
    again = scene.sample_start(np.random.default_rng(0))
    np.testing.assert_array_equal(again.start, samples[0].start)
    assert min(one.start_clearance(reach=0.1) for one in samples) >= START_CLEARANCE
    bases = np.array([one.start[:3] for one in samples])
    for column, (low, high) in enumerate((region.x, region.y)):
        assert low <= bases[:, column].min()
        assert bases[:, column].max() <= high
        assert np.ptp(bases[:, column]) > 0.6 * (high - low)
    assert np.ptp(bases[:, 2]) > 4.0


@pytest.mark.parametrize(
    ("name", "owner", "joint", "upper"),
    [
        ("door", "door", "hinge", 1.57),
        ("drawer", "drawer", "slide", 0.4),
        ("corridor_door", "door", "hinge", np.pi / 2),
        ("aisle_drawer", "drawer", "slide", 0.65),
        ("household", "door", "hinge", 1.75),
        ("household", "drawer", "slide", 0.35),
        ("household", "dishwasher", "rack", 0.55),
        ("household", "refrigerator", "hinge", 2.0),
        ("household", "cabinet", "hinge", 1.9),
    ],
)
def test_joints_move_freely_over_their_range(
    name: str, owner: str, joint: str, upper: float
) -> None:
    scene, item = load(name), load(name).objects[owner].object
    k = item.coordinates.index(joint)
    assert item.upper[k] == pytest.approx(upper)
    moving = item.links_moved_by({joint})
    others = [link for link in item.links if link not in moving]
    for value in np.linspace(item.lower[k], item.upper[k], 12):
        moved = scene.with_state(owner, {joint: float(value)})
        assert not list_close_labels(moved, DIST_SAFE) & {f"{owner}.{link}" for link in moving}
        own, rest = (
            list_placed_shapes(list_parts(moved.objects[owner], *links))
            for links in (moving, others)
        )
        assert compute_clearance(own, rest) > 0.004, value


@pytest.mark.parametrize("name", OBJECTS)
def test_hand_fits_around_every_attachment(name: str) -> None:
    """Open fingers are clear of the grasped link, the rest of the hand of other links."""
    for attachment in load_object(name).attachments.values():
        if attachment.name == "pull":  # grasped by broom and stick, not by the hand
            continue
        opened = name == "dishwasher" and attachment.link == "rack"
        placed = place_at_origin(name, **({"door": np.pi / 2} if opened else {}))
        tool = placed.link_placement(attachment.link) * attachment.placement
        tool = tool * attachment.motion(np.zeros(len(attachment.freedoms)))
        pushes = attachment.contact == "push"
        shapes = place_hand(tool * load().robot.front.inverse() if pushes else tool)
        gap = compute_clearance(shapes, list_placed_shapes(list_parts(placed, attachment.link)))
        if pushes:
            assert gap == pytest.approx(attachment.standoff, abs=1e-5) or gap > GRASP_CLEARANCE
        else:
            assert gap > GRASP_CLEARANCE, attachment.name
        others = [link for link in placed.object.links if link != attachment.link]
        if others and name not in ("stick", "broom"):
            near = compute_clearance(shapes, list_placed_shapes(list_parts(placed, *others)))
            assert near > DIST_SAFE, attachment.name


@pytest.mark.parametrize(
    ("name", "names", "low", "high"),
    [
        ("corridor_door", "block_left", (0.0, 1.0, 0.0), (5.0, 5.0, 2.06)),
        ("corridor_door", "block_right", (0.0, -5.0, 0.0), (5.0, -1.0, 2.06)),
        ("corridor_door", "door.panel", (4.975, -0.55, 0.01), (5.025, 0.55, 2.06)),
        ("aisle_drawer", "worktop_1 counter_1", (0.0, 0.875, 0.0), (2.25, 4.125, 0.7)),
        ("aisle_drawer", "worktop_2 counter_2", (3.5, -0.5, 0.0), (4.5, 5.5, 0.7)),
        ("init_1", "table_top", (2.0, 0.0, 0.68), (3.0, 2.0, 0.72)),
        ("init_1", "low_table_top", (-2.0, 2.7, 0.75), (1.0, 4.3, 0.8)),
        ("init_1", "cube", (-1.1, 3.9, 0.0), (-0.9, 4.1, 0.2)),
        ("init_3", "block", (1.0, -3.5, 0.0), (3.0, -0.5, 2.1)),
    ],
)
def test_dimensions_match_the_paper(
    name: str, names: str, low: tuple[float, ...], high: tuple[float, ...]
) -> None:
    scene = load(name)
    shapes = [shape for label in names.split() for shape in list_obstacles(scene, label)]
    if names == "door.panel":
        shapes = list_parts(scene.objects["door"], "panel")
    boxes = np.array([compute_world_box(shape.geometry, shape.placement) for shape in shapes])
    bounds = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    np.testing.assert_allclose(bounds, [low, high], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "state", "begin", "end"),
    [
        ("corridor_door", {"hinge": 1.5}, (0.0, -0.1), (6.5, -0.1)),
        ("aisle_drawer", {}, (2.875, -1.0), (2.875, 4.8)),
        ("household", {"hinge": 1.52}, (1.5, -0.15), (1.64, 2.25)),
        ("household", {}, (1.2, -0.4), (-2.4, -0.4)),
        ("household", {}, (-1.0, -0.5), (-1.0, 2.3)),
        ("gap_table", {}, (-2.0, -1.575), (1.0, -1.575)),
    ],
)
def test_base_fits_through_passages(
    name: str, state: dict[str, float], begin: tuple[float, float], end: tuple[float, float]
) -> None:
    scene = load(name).with_state("door", state) if state else load(name)
    heading = float(np.arctan2(end[1] - begin[1], end[0] - begin[0]))
    for x, y in np.linspace(begin, end, 20):
        moved = scene.with_start(base=[x, y, heading], arm=[0.0, *scene.robot.home[1:]])
        assert moved.start_clearance(reach=0.1) > DIST_SAFE, (x, y)


def test_gap_between_pillar_and_wall_is_the_only_passage() -> None:
    scene = load("gap_table")
    for first, second, width in (
        ("pillar", "wall_south", 0.85),
        ("pillar", "sideboard", 0.0),
        ("sideboard", "wall_north", 0.0),
    ):
        one, two = (list_placed_shapes(list_obstacles(scene, name)) for name in (first, second))
        assert compute_clearance(one, two) == pytest.approx(width, abs=1e-6)


def test_household_is_furnished_without_overlaps() -> None:
    """The frame of the door fills an opening."""
    scene = load()
    shapes = [shape for placed in scene.objects.values() for shape in list_parts(placed)]
    assert len(shapes) + len(scene.obstacles) > 120
    assert list_close_labels(scene, 9e-4) <= {"door.frame", *scene.obstacle_labels}
