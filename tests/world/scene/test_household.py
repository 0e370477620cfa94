"""Tests the home of the third experiment with its objects, and the arena of the ten-step chore."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from itertools import combinations

import coal
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.planning.chain.inverse_kinematics import PoseSolver
from vkc_pin.planning.chain.inversion import invert
from vkc_pin.planning.chain.pose import PoseRow
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.models.articulated_object import ArticulatedObject, Freedom
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import compute_clearance, get_link_name, list_placed_shapes
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene, load_scene

DIST_SAFE, GRASP_CLEARANCE = 0.02, 0.005  # [m], the planner's
JOINTS = {  # joint → upper limit, velocity and acceleration; all start at 0
    "narrow_door": {"hinge": (1.75, 1.0, 1.0), "knob": (0.8, 2.0, 4.0)},
    "low_drawer": {"slide": (0.35, 0.5, 1.0)},
    "dishwasher": {"door": (np.pi / 2, 1.0, 1.0), "rack": (0.55, 0.5, 1.0)},
    "refrigerator": {"hinge": (2.0, 1.0, 1.0)},
    "cabinet": {"hinge": (1.9, 1.0, 1.0)},
}
CARRIED = {"cup": ("side", "oblique", "top"), "broom": ("grip", "end"), "litter": ("grip", "pull")}
ATTACHMENTS = {
    "narrow_door": ("handle", "handle_free", "inside", "inside_free", "push", "push_back"),
    "low_drawer": ("handle", "handle_free"),
    "dishwasher": ("handle", "handle_free", "side", "other_side", "door_handle", "door_push"),
    "refrigerator": ("handle", "handle_free", "push"),
    "cabinet": ("handle", "handle_free", "push"),
    **CARRIED,
}
PINNED = {frozenset({"panel", "lever"})}  # the spindle goes through the panel
GOALS = {  # of the experiment
    "door": {"hinge": 1.52},
    "drawer": {"slide": 0.22},
    "dishwasher": {"rack": 0.5},
    "refrigerator": {"hinge": 1.57},
    "cabinet": {"hinge": 0.4},
}
RELEASED = {"door": {"knob": 0.52}}  # so far is the lever turned while the door moves
HUSKY = (0.99, 0.67)  # [m] long, wide

Shapes = list[tuple[coal.CollisionGeometry, pin.SE3]]


@cache
def scene(name: str = "household") -> Scene:
    return load_scene(name)


@cache
def thing(name: str) -> ArticulatedObject:
    return load_object(name)


def at_origin(name: str, **state: float) -> PlacedObject:
    """An object whose base link is at the world's origin."""
    return PlacedObject(
        name, thing(name), pin.SE3.Identity(), np.zeros(len(JOINTS.get(name, ())))
    ).with_state(state)


def parts(placed: PlacedObject, *links: str) -> Shapes:
    """Shapes of some of an object's links, or of all."""
    return list_placed_shapes(
        shape
        for shape in make_world_shapes(placed)
        if not links or get_link_name(shape.name) in links
    )


def obstacles(here: Scene, *, without: Iterable[str] = (FLOOR,)) -> Shapes:
    labels = zip(here.obstacles, here.obstacle_labels, strict=True)
    return list_placed_shapes(shape for shape, label in labels if label not in without)


def world(here: Scene, *, without: Iterable[str] = ()) -> Shapes:
    """Everything that stands in a scene but the floor and some objects."""
    return obstacles(here) + [
        part
        for name, placed in here.objects.items()
        if name not in without
        for part in parts(placed)
    ]


def moving_links(obj: ArticulatedObject) -> list[str]:
    return [link for link in obj.links if link != obj.base_link]


# --- the objects
# ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", JOINTS)
def test_joints_have_their_limits_and_rates(name: str) -> None:
    obj = thing(name)
    assert obj.coordinates.names == tuple(JOINTS[name])
    assert not obj.free
    upper, velocity, acceleration = zip(*JOINTS[name].values(), strict=True)
    np.testing.assert_array_equal(obj.lower, 0.0)
    np.testing.assert_allclose(obj.upper, upper, atol=1e-12)
    np.testing.assert_array_equal([obj.velocity, obj.acceleration], [velocity, acceleration])


@pytest.mark.parametrize("name", CARRIED)
def test_carried_objects_are_free_with_firm_grasps(name: str) -> None:
    obj = thing(name)
    assert obj.free
    assert not obj.coordinates.names
    assert all(attachment.firm for attachment in obj.attachments.values())
    assert 0.0 < sum(inertia.mass for inertia in obj.model.inertias) < 5.0, "a UR5e carries 5 kg"


@pytest.mark.parametrize("name", ATTACHMENTS)
def test_attachments_are_where_hands_can_be(name: str) -> None:
    """The open fingers are clear of the grasped link, and the rest of the hand of the object."""
    obj = thing(name)
    assert tuple(obj.attachments) == ATTACHMENTS[name]
    for attachment in obj.attachments.values():
        if name == "litter" and attachment.name == "pull":  # for the broom
            continue
        placed = at_origin(
            name,
            **({"door": np.pi / 2} if name == "dishwasher" and attachment.link == "rack" else {}),
        )
        tool = (
            placed.link_placement(attachment.link)
            * attachment.placement
            * attachment.motion(np.zeros(len(attachment.freedoms)))
        )
        pushes = attachment.contact == "push"
        hand = moved_hand(tool * scene().robot.front.inverse() if pushes else tool)
        gap = compute_clearance(hand, parts(placed, attachment.link))
        assert gap > GRASP_CLEARANCE or (
            pushes and gap == pytest.approx(attachment.standoff, abs=1e-5)
        ), attachment.name
        others = [link for link in obj.links if link != attachment.link]
        assert not others or compute_clearance(hand, parts(placed, *others)) > DIST_SAFE, (
            attachment.name
        )


def test_hand_on_the_dishwashers_door_can_stay_level_until_it_is_open() -> None:
    grasp = thing("dishwasher").attachment("door_handle")
    for angle in np.linspace(0.0, np.pi / 2, 5):
        tool = (
            at_origin("dishwasher", door=float(angle)).link_placement("door")
            * grasp.placement
            * grasp.motion([-angle])
        )
        np.testing.assert_allclose(tool.rotation[:, 2], [1.0, 0.0, 0.0], atol=1e-9)
        assert lowest(moved_hand(tool)) > DIST_SAFE, "it clears the floor"


@pytest.mark.parametrize("name", ATTACHMENTS)
def test_object_turned_round_is_the_same_object(name: str) -> None:
    obj, rng = thing(name), np.random.default_rng(0)
    for link in obj.links:
        state = rng.uniform(obj.lower, obj.upper)
        tree = invert(obj, link, state)
        data = tree.model.createData()
        z = [state[obj.coordinates.index(joint)] for joint in tree.coordinates.names]
        pin.framesForwardKinematics(tree.model, data, tree.coordinates.q(np.array(z)))
        base = data.oMf[tree.model.getFrameId(obj.base_link)]
        np.testing.assert_allclose(
            base.homogeneous, obj.link_placement(link, state).inverse().homogeneous, atol=1e-12
        )
        assert len(tree.collision.geometryObjects) == len(obj.collision.geometryObjects)


@pytest.mark.parametrize("name", JOINTS)
def test_parts_do_not_overlap_while_they_move(name: str) -> None:
    """Every joint moves over its range; the rack only moves with its door open."""
    obj = thing(name)
    pairs = [pair for pair in combinations(obj.links, 2) if frozenset(pair) not in PINNED]
    ends = [np.linspace(0.0, upper, 11) for upper in obj.upper]
    for moving in range(len(ends)):
        grid = np.meshgrid(
            *[end if index == moving else end[[0, -1]] for index, end in enumerate(ends)]
        )
        for state in np.stack([axis.ravel() for axis in grid], axis=1):
            if name == "dishwasher" and state[1] > 0.0 and state[0] < np.pi / 2:
                continue
            placed = at_origin(
                name, **dict(zip(obj.coordinates.names, state.tolist(), strict=True))
            )
            for first, second in pairs:
                assert compute_clearance(parts(placed, first), parts(placed, second)) > 0.005, (
                    first,
                    second,
                    state,
                )


def test_carried_objects_fit_the_hand_and_rest_on_their_origin() -> None:
    for name in ("cup", "broom"):
        lowest = min(bounds([part])[0, 2] for part in parts(at_origin(name)))
        assert lowest == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(
        np.ptp(bounds(parts(at_origin("cup"))), axis=0), [0.07, 0.07, 0.1], atol=1e-12
    )
    np.testing.assert_allclose(
        np.ptp(bounds(parts(at_origin("broom"))), axis=0), [0.04, 0.28, 0.95], atol=1e-12
    )
    np.testing.assert_allclose(np.ptp(bounds(parts(at_origin("litter"))), axis=0), 0.07, atol=1e-12)
    down = thing("broom").link_placement("bristles", [])
    np.testing.assert_allclose(down.rotation @ [0, 0, 1], [0, 0, -1], atol=1e-12)


def test_refrigerator_and_cabinet_have_room_for_cup_and_ball() -> None:
    for name, item, x in (("refrigerator", "cup", 0.2), ("cabinet", "ball", 0.2)):
        body = parts(at_origin(name), thing(name).base_link)
        shelf = {"refrigerator": 0.98, "cabinet": 0.81}[name]
        height = shelf + {"cup": 0.001, "ball": 0.036}[item]
        inside = list_placed_shapes(
            make_world_shapes(
                PlacedObject(
                    item, thing(item), pin.SE3(np.eye(3), np.array([x, 0, height])), np.zeros(0)
                )
            )
        )
        assert compute_clearance(inside, body) == pytest.approx(1e-3, abs=1e-6), (
            "it stands on the shelf, and on nothing else"
        )
        lifted = [
            (shape, pin.SE3(where.rotation, where.translation + np.array([0.0, 0.0, 0.1])))
            for shape, where in inside
        ]
        assert compute_clearance(lifted, body) > 0.1, "there is air above it"


# --- the home
# ------------------------------------------------------------------------------------------


def test_home_size_and_furniture_match_the_paper() -> None:
    here = scene()
    assert (here.name, here.robot.name, here.robot.base) == ("household", "husky_ur5e", "omni")
    assert here.arena == (-4.0, 4.0, -4.0, 4.0)
    region = here.start_region
    assert region is not None
    assert (region.x, region.y, region.yaw) == ((0.5, 2.5), (-2.5, 0.5), None)
    inner = {"wall_west": (0, 1), "wall_east": (0, 0), "wall_south": (1, 1), "wall_north": (1, 0)}
    for wall, (axis, side) in inner.items():
        (standing,) = [shape for shape in here.obstacles if shape.name == wall]
        assert abs(bounds(list_placed_shapes([standing]))[side, axis]) == pytest.approx(4.0)
    shapes = len(obstacles(here)) + sum(
        len(placed.object.collision.geometryObjects) for placed in here.objects.values()
    )
    assert shapes >= 120
    everything = bounds(world(here))
    np.testing.assert_allclose(everything, [[-4.1, -4.1, 0.0], [4.1, 4.1, 2.4]], atol=1e-9)
    assert {placed.object.name for placed in here.objects.values()} == set(ATTACHMENTS)


def test_start_region_has_free_places_at_any_heading() -> None:
    here, rng = scene(), np.random.default_rng(0)
    assert here.start_clearance() >= START_CLEARANCE
    bases = np.array([here.sample_start(rng).start[:3] for _ in range(40)])
    assert (np.ptp(bases[:, :2], axis=0) > [1.6, 2.4]).all(), "they fill the region"
    assert np.ptp(bases[:, 2]) > 5.0


def test_no_shapes_overlap() -> None:
    """Furniture may touch walls and supported objects; free objects keep 1 mm, others more."""
    here = scene()
    for name, placed in here.objects.items():
        links = (
            ("panel", "lever") if name == "door" else ()
        )  # its frame fills an opening in the wall
        assert (
            compute_clearance(parts(placed, *links), world(here, without={name}), reach=0.1) > 9e-4
        ), name
    movable = {
        "chair",
        "desk_chair",
        "chair_west",
        "chair_south_west",
        "chair_south_east",
        "stool_west",
        "stool_east",
        "plant",
        "bin",
    }
    for name in movable:
        standing = [
            shape
            for shape, label in zip(here.obstacles, here.obstacle_labels, strict=True)
            if label == name
        ]
        assert (
            compute_clearance(
                list_placed_shapes(standing), obstacles(here, without={FLOOR, name}), reach=0.1
            )
            > 0.01
        ), name


@pytest.mark.parametrize("name", GOALS)
def test_moving_parts_keep_clear_of_the_home(name: str) -> None:
    here = scene()
    placed = here.objects[name]
    rest = world(here, without={name})
    (joint,) = GOALS[name]
    upper = placed.object.upper[placed.object.coordinates.index(joint)]
    assert upper >= GOALS[name][joint]
    for value in np.linspace(0.0, upper, 12):
        moved = placed.with_state({joint: float(value)})
        assert (
            compute_clearance(parts(moved, *moving_links(placed.object)), rest, reach=0.1)
            > DIST_SAFE + 0.005
        ), value


def test_dishwasher_door_shuts_and_the_rack_comes_out_over_it() -> None:
    placed = scene().objects["dishwasher"]
    assert placed.state.tolist() == [1.57, 0.0]
    rest = world(scene(), without={"dishwasher"})
    for angle in np.linspace(0.0, np.pi / 2, 12):
        assert (
            compute_clearance(
                parts(placed.with_state({"door": float(angle)}), "door"), rest, reach=0.1
            )
            > DIST_SAFE + 0.005
        )
    out = placed.with_state({"rack": 0.5})
    rack = bounds(parts(out, "rack"))
    assert rack[0, 1] < placed.placement.translation[1] - 0.4, "most of it is before the face"
    door = bounds(parts(out, "door"))
    assert door[0, 1] < rack[0, 1], "whoever stands before it stands behind the door"
    assert door[1, 2] < 0.2


def test_furniture_is_as_its_colours_and_descriptions_say() -> None:
    files = sorted((find_resource_folder("scenes") / "furniture").glob("*.urdf"))
    used = {item["file"] for item in scene().document["obstacles"] if item["type"] == "urdf"}
    assert {f"furniture/{file.name}" for file in files} | {"objects/low_drawer.urdf"} == used
    heights = {
        "chair": 0.85,
        "dining_table": 0.75,
        "coffee_table": 0.45,
        "bar_table": 1.05,
        "desk": 0.74,
        "bin": 0.3,
    }
    for name, height in heights.items():
        item = {
            "name": name,
            "type": "urdf",
            "file": f"furniture/{name}.urdf",
            "position": [0, 0, 0],
        }
        robot = {"robot": "husky_ur5e", "start": {"base": [3, 3, 0]}, "obstacles": [item]}
        alone = obstacles(Scene.from_document(robot, find_resource_folder("scenes")))
        np.testing.assert_allclose(bounds(alone)[:, 2], [0.0, height], atol=1e-9)


# --- the robot in it
# ------------------------------------------------------------------------------------------


def test_robot_fits_through_the_open_door_and_nowhere_else_into_the_bedroom() -> None:
    here = scene().with_state("door", GOALS["door"])
    around = world(here)
    body = body_at(here.robot, 1.575)
    along = np.array([np.cos(1.52), np.sin(1.52)])  # as the open door points
    for way in np.linspace(-1.4, 1.0, 25):
        x, y = np.array([1.584, 1.25]) + way * along
        assert compute_clearance(body_at(here.robot, x, y, 1.52), around, reach=0.1) > DIST_SAFE, (
            way
        )
    assert compute_clearance(body_at(here.robot, 1.58, 1.25), world(scene()), reach=0.1) < 0.0, (
        "the door is shut"
    )
    left, right = (bounds([part]) for part in parts(here.objects["door"], "frame")[:2])
    panel = bounds(parts(scene().objects["door"].with_state({"hinge": 1.5707}), "panel"))
    assert min(abs(left - right)[:, 0]) > HUSKY[1]
    assert right[0, 0] - panel[1, 0] == pytest.approx(1.1 * HUSKY[1], abs=0.005)
    assert len(body) == 3


def test_aisles_are_wide_enough_for_the_robot() -> None:
    """It drives, as long as it is, to every object, and turns on the spot where it starts."""
    here = scene()
    around = world(here)
    ways = {
        "cabinet": ([1.2, -0.4], [-2.4, -0.4]),
        "kitchen": ([-1.0, -0.5], [-1.0, 2.3]),
        "dishwasher": ([-1.0, 2.2], [-1.9, 2.2]),
        "television": ([1.5, -1.5], [1.5, -2.9]),
    }
    for name, (begin, end) in ways.items():
        heading = float(np.arctan2(*np.subtract(end, begin)[::-1]))
        for x, y in np.linspace(begin, end, 20):
            assert (
                compute_clearance(body_at(here.robot, x, y, heading), around, reach=0.1) > DIST_SAFE
            ), (
                name,
                x,
                y,
            )
    for yaw in np.linspace(-np.pi, np.pi, 24):
        assert compute_clearance(body_at(here.robot, 1.3, -1.0, yaw), around, reach=0.1) > DIST_SAFE


REACHED = [
    *((name, "handle", moved) for name in GOALS for moved in (False, True)),
    ("door", "inside", True),
    ("drawer", "handle_free", False),
    ("refrigerator", "handle_free", True),
    ("dishwasher", "side", True),
    ("dishwasher", "other_side", True),
    ("dishwasher", "door_handle", False),
    *(("cup", attachment, False) for attachment in CARRIED["cup"]),
    ("cold_cup", "side", True),
    ("broom", "grip", False),
]


@pytest.mark.parametrize(("name", "attachment", "moved"), REACHED)
def test_arm_reaches_the_attachment_without_collisions(
    name: str, attachment: str, moved: bool
) -> None:
    here = scene()
    if name in GOALS and moved:
        here = here.with_state(name, {**RELEASED.get(name, {}), **GOALS[name]})
    elif attachment == "door_handle":
        here = here.with_state(name, {"door": 0.0})
    elif name == "cold_cup":
        here = here.with_state("refrigerator", GOALS["refrigerator"])
    placed = here.objects[name]
    grasp = placed.object.attachment(attachment)
    robot, held = here.robot, parts(placed, grasp.link)
    others = world(here, without={name})
    rest = [link for link in placed.object.links if link != grasp.link]
    others += parts(placed, *rest) if rest else []
    ball = [(coal.Sphere(1.8), pin.SE3(np.eye(3), placed.placement.translation))]
    others = [part for part in others if compute_clearance(ball, [part]) < 0.0]
    data, shapes = robot.model.createData(), robot.collision.createData()
    frame, rng = tool_frame(robot), np.random.default_rng(0)
    for turn in turns(grasp.freedoms):
        target = placed.link_placement(grasp.link) * grasp.placement * grasp.motion(turn)
        for z in solutions(robot, target, rng):
            links = robot_shapes(robot, z)
            near = compute_clearance(
                [part[1:] for part in links if part[0] == "base_link"], others, reach=DIST_SAFE
            )
            q = robot.coordinates.q(z)
            if near < DIST_SAFE or pin.computeCollisions(
                robot.model, data, robot.collision, shapes, q, True
            ):
                continue
            away = [part[1:] for part in links if part[0] not in robot.touch_links]
            if compute_clearance([part[1:] for part in links], others, reach=DIST_SAFE) < DIST_SAFE:
                continue
            if compute_clearance(away, held, reach=DIST_SAFE) >= DIST_SAFE:
                tool = data.oMi[frame.parentJoint] * frame.placement
                np.testing.assert_allclose(tool.homogeneous, target.homogeneous, atol=1e-5)
                return
    pytest.fail("no free configuration")


# --- helpers
# ------------------------------------------------------------------------------------------


def bounds(shapes: Iterable[tuple[coal.CollisionGeometry, pin.SE3]]) -> np.ndarray:
    """Lowest and highest x, y, z of what is drawn around shapes, shape (2, 3)."""
    lows, highs = [], []
    for shape, where in shapes:
        if isinstance(shape, coal.Box):
            reach = np.abs(where.rotation) @ np.asarray(shape.halfSide)
        elif isinstance(shape, coal.Sphere):
            reach = np.full(3, shape.radius)
        else:
            axis = np.abs(where.rotation[:, 2])
            reach = shape.halfLength * axis + shape.radius * np.sqrt(np.maximum(0.0, 1.0 - axis**2))
        lows.append(where.translation - reach)
        highs.append(where.translation + reach)
    return np.array([np.min(lows, axis=0), np.max(highs, axis=0)])


def lowest(shapes: Shapes) -> float:
    """How far shapes are above the floor [m]."""
    plate = (coal.Box(20.0, 20.0, 0.1), pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.05])))
    return compute_clearance(shapes, [plate])


def robot_shapes(robot: Robot, z: np.ndarray) -> list[tuple[str, coal.CollisionGeometry, pin.SE3]]:
    """The robot's links and shapes at a configuration."""
    data, shapes = robot.model.createData(), robot.collision.createData()
    pin.updateGeometryPlacements(robot.model, data, robot.collision, shapes, robot.coordinates.q(z))
    return [
        (robot.link_of(index), shape.geometry, where)
        for index, (shape, where) in enumerate(
            zip(robot.collision.geometryObjects, shapes.oMg, strict=True)
        )
    ]


def body_at(robot: Robot, x: float, y: float = 0.0, yaw: float = np.pi / 2) -> Shapes:
    """The Husky without its arm."""
    z = np.concatenate([[x, y, yaw], robot.home])
    return [(shape, where) for link, shape, where in robot_shapes(robot, z) if link == "base_link"]


def tool_frame(robot: Robot) -> pin.Frame:
    return robot.model.frames[robot.model.getFrameId(robot.tool_frame)]


def moved_hand(tool: pin.SE3) -> Shapes:
    """The open gripper with its tool frame at `tool`."""
    robot = scene().robot
    z = np.concatenate([np.zeros(3), robot.home])
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
    back = tool * data.oMf[robot.model.getFrameId(robot.tool_frame)].inverse()
    return [
        (shape, back * where)
        for link, shape, where in robot_shapes(robot, z)
        if link in robot.touch_links
    ]


def turns(freedoms: Sequence[Freedom]) -> list[np.ndarray]:
    """Values of a grasp's freedoms: all zero, and its turn half and all of the range."""
    rows = [np.zeros(len(freedoms))]
    if freedoms:
        ends = (
            freedoms[-1].lower / 2,
            freedoms[-1].upper / 2,
            freedoms[-1].lower,
            freedoms[-1].upper,
        )
        rows += [np.append(np.zeros(len(freedoms) - 1), end) for end in ends]
    return rows


@cache
def solver(robot: Robot) -> PoseSolver:
    frame = tool_frame(robot)
    return PoseSolver(robot.model, PoseRow(frame.parentJoint, pin.SE3(frame.placement), ()))


def solutions(
    robot: Robot, target: pin.SE3, rng: np.random.Generator, *, count: int = 800
) -> np.ndarray:
    """Configurations with the tool frame at `target`, from random ones near it."""
    lower, upper = robot.lower.copy(), robot.upper.copy()
    near = target.translation[:2]
    lower[:3], upper[:3] = [*(near - 1.2), -np.pi], [*(near + 1.2), np.pi]
    seeds = rng.uniform(lower, upper, (count, len(lower)))
    seeds[:, 3:] = robot.home + rng.uniform(-1.5, 1.5, (count, len(lower) - 3))
    found, solved = solver(robot).solve(
        seeds, target, lower=lower, upper=upper, weights=np.ones(len(lower)), iterations=40
    )
    return found[solved]
