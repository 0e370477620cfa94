"""Scenes of running MuJoCo simulations, and motions in their coordinates."""

from __future__ import annotations

import re
import warnings
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from helpers.mujoco_kitchens import KITCHEN, make_kitchen, make_kitchen_spec
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.importing.formats.mjcf import read_compiled_model
from vkc_pin.simulation.robot_in_model import ModelJoints, RobotInModel

ROBOT = "husky_ur5e"
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


@pytest.fixture(scope="module")
def model() -> Any:
    return make_kitchen()


def make_data(model: Any, *, prefix: str = "") -> Any:
    """Return data with the robot in front of the drawer, which is a little open."""
    data = mujoco.MjData(model)
    names = vkc.load_robot(ROBOT).coordinates.names
    values = [-0.5, 0.2, 0.3, *vkc.load_robot(ROBOT).home]
    for name, value in zip(names, values, strict=True):
        data.joint(prefix + name).qpos = value
    data.joint("home/drawer slide").qpos = 0.05
    data.joint("home/oven.hinge").qpos = -0.4
    mujoco.mj_forward(model, data)
    return data


@pytest.fixture(scope="module")
def scene(model: Any) -> vkc.Scene:
    return vkc.scene_from_mujoco(model, make_data(model), robot=ROBOT)


@pytest.fixture(scope="module")
def plan(scene: vkc.Scene) -> vkc.Plan:
    steps = [vkc.Grasp("home_cabinet"), vkc.Actuate("home_cabinet", {"home_drawer_slide": 0.3})]
    return vkc.plan(scene, steps)


# Scenes


def test_bodies_with_joints_become_objects_and_others_obstacles(scene: vkc.Scene) -> None:
    assert list(scene.objects) == ["home_cabinet", "home_oven", "home_cup"]
    assert scene.objects["home_cup"].object.free
    assert scene.obstacle_names == ("home_table",)
    assert scene.objects["home_cabinet"].object.attachments
    assert scene.start == pytest.approx([-0.5, 0.2, 0.3, *vkc.load_robot(ROBOT).home], abs=1e-9)
    assert scene.objects["home_cabinet"].state == pytest.approx([0.05])
    # Relative to `ref`.
    assert scene.objects["home_oven"].state == pytest.approx([-0.3])


def place_shapes(placed: vkc.PlacedObject, link: str, state: np.ndarray) -> list[pin.SE3]:
    """Return the placements of a link's shapes in the world, in a state of its object."""
    tree = placed.object.model
    geometry = placed.object.collision
    data = tree.createData()
    geometry_data = geometry.createData()
    q = placed.object.coordinates.q(state)
    pin.updateGeometryPlacements(tree, data, geometry, geometry_data, q)
    found = []
    for number, shape in enumerate(geometry.geometryObjects):
        if shape.name.rsplit("_", 1)[0] == link:
            found.append(placed.placement * geometry_data.oMg[number])
    return found


def test_shapes_of_objects_are_where_mujoco_has_them(model: Any, scene: vkc.Scene) -> None:
    data = make_data(model)
    # Boxes alone: cylinders of a scene have another frame of the same solid.
    geoms = {"home/cabinet": ["left", "right", "back"], "home/drawer": ["front", "tray"]}
    placed = scene.objects["home_cabinet"]
    for value in np.linspace(0.0, 0.35, 4):
        data.joint("home/drawer slide").qpos = value
        mujoco.mj_forward(model, data)
        for body, names in geoms.items():
            shapes = place_shapes(placed, body.replace("/", "_"), np.array([value]))
            positions = np.array([shape.translation for shape in shapes])
            for name in names:
                geom = data.geom(f"home/{name}")
                gaps = np.linalg.norm(positions - geom.xpos, axis=1)
                assert gaps.min() < 1e-6  # files of scenes have micrometres
                rotation = shapes[int(gaps.argmin())].rotation
                assert rotation == pytest.approx(geom.xmat.reshape(3, 3), abs=1e-6)


angles = st.floats(-3.0, 3.0)


@st.composite
def tree_texts(draw: st.DrawFn) -> str:
    """Return MJCF of a random tree of bodies with hinges, slides, and several joints of a body."""
    text = ""
    depth = draw(st.integers(1, 4))
    number = 0
    for _ in range(depth):
        position = " ".join(str(draw(st.floats(-1.0, 1.0))) for _ in range(3))
        euler = " ".join(str(draw(angles)) for _ in range(3))
        text += f'<body pos="{position}" euler="{euler}">'
        for _ in range(draw(st.integers(0, 2))):
            kind = draw(st.sampled_from(["hinge", "slide"]))
            axis = draw(st.sampled_from(["1 0 0", "0 1 1", "-1 2 3"]))
            anchor = " ".join(str(draw(st.floats(-0.5, 0.5))) for _ in range(3))
            reference = draw(st.floats(-0.3, 0.3))
            text += (
                f'<joint name="j{number}" type="{kind}" axis="{axis}" pos="{anchor}" '
                f'ref="{reference}" range="-1 1"/>'
            )
            number += 1
        shape = draw(st.sampled_from(['box" size="0.1 0.2 0.3', 'sphere" size="0.1']))
        text += f'<geom type="{shape}" pos="{position}" euler="{euler}"/>'
    text += "</body>" * depth
    # Otherwise inertias may be singular, which MuJoCo logs.
    default = '<default><joint armature="1"/></default>'
    return f'<mujoco><compiler angle="radian"/>{default}<worldbody>{text}</worldbody></mujoco>'


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(text=tree_texts(), seed=st.integers(0, 1000))
def test_frames_agree_with_mujoco_for_all_positions(text: str, seed: int) -> None:
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    compiled = read_compiled_model(model, data)
    rng = np.random.default_rng(seed)
    for _ in range(3):
        data.qpos[:] = rng.uniform(-1.0, 1.0, model.nq)
        mujoco.mj_forward(model, data)
        positions = read_compiled_model(model, data).positions
        placements = compiled.description.compute_placements(positions)
        for body, link in enumerate(compiled.bodies):
            parts = compiled.description.links[link].collision
            first = int(model.body_geomadr[body])
            assert len(parts) == int(model.body_geomnum[body])
            for geom, part in enumerate(parts, first):
                place = placements[link] * part.placement
                assert np.abs(place.translation - data.geom_xpos[geom]).max() < 1e-9
                assert np.abs(place.rotation.ravel() - data.geom_xmat[geom]).max() < 1e-9


def test_what_does_not_collide_is_no_obstacle(scene: vkc.Scene) -> None:
    assert not any("marker" in name for name in scene.obstacle_names)


def test_only_chosen_objects_move(model: Any) -> None:
    data = make_data(model)
    with pytest.warns(
        UserWarning, match=r"hence fixed where they are: home/drawer slide, home/cup"
    ):
        scene = vkc.scene_from_mujoco(model, data, robot=ROBOT, objects=["home/oven"])
    assert list(scene.objects) == ["home_oven"]
    names = [name for name in scene.obstacle_labels if name == "home_drawer"]
    assert names
    shapes = zip(scene.obstacle_labels, scene.obstacles, strict=True)
    lowest = min(
        float(np.linalg.norm(shape.placement.translation - data.geom("home/front").xpos))
        for name, shape in shapes
        if name == "home_drawer"
    )
    assert lowest < 1e-6


def test_reason_why_nothing_can_be_grasped_is_a_warning(model: Any) -> None:
    data = make_data(model)
    too_far = vkc.Options(dist_safe=0.5)
    with pytest.warns(
        UserWarning, match="home_oven: no hand can move home_oven_hinge: of .* places"
    ):
        vkc.scene_from_mujoco(model, data, robot=ROBOT, objects=["home/oven"], options=too_far)


def test_floor_and_raised_robot(model: Any) -> None:
    data = make_data(model)
    raised = vkc.scene_from_mujoco(model, data, robot=ROBOT, floor=-0.2, objects=["home/drawer"])
    cabinet = raised.objects["home_cabinet"]
    front = np.array(data.geom("home/front").xpos) + np.array([0.0, 0.0, 0.2])
    shapes = place_shapes(cabinet, "home_drawer", cabinet.state)
    assert min(np.linalg.norm(shape.translation - front) for shape in shapes) < 1e-6
    assert raised.robot.height == pytest.approx(0.2, abs=1e-9)


def test_joints_with_other_names() -> None:
    model = make_kitchen(prefix="robot0_")
    data = make_data(model, prefix="robot0_")
    names = vkc.load_robot(ROBOT).coordinates.names
    joints = {name: f"robot0_{name}" for name in names}
    found = RobotInModel(model, vkc.load_robot(ROBOT), ModelJoints(model, joints))
    pose, elevation = found.find_base(data)
    assert pose == pytest.approx([-0.5, 0.2, 0.3], abs=1e-9)
    assert elevation == pytest.approx(0.0, abs=1e-9)


@given(
    mount=st.tuples(*[st.floats(-2.0, 2.0)] * 3, angles),
    signs=st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3),
    swaps=st.booleans(),
    qpos=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), angles),
)
@settings(max_examples=10, deadline=None)
def test_base_is_found_wherever_its_joints_are(
    mount: tuple[float, ...], signs: tuple[float, ...], swaps: bool, qpos: tuple[float, ...]
) -> None:
    axes = np.diag(signs)
    if swaps:
        axes[[0, 1]] = axes[[1, 0]]
    model = make_kitchen(mount=np.array(mount), axes=axes)
    data = make_data(model)
    robot = vkc.load_robot(ROBOT)
    found = RobotInModel(model, robot, ModelJoints(model, None))
    motion = found.find_base_motion(data)
    data.qpos[:3] = qpos
    mujoco.mj_kinematics(model, data)
    pose, elevation = found.find_base(data)
    assert elevation == pytest.approx(mount[2], abs=1e-9)
    back = motion.invert(pose[None])[0]
    turns = (back[2] - qpos[2]) / (2.0 * np.pi)
    assert back[:2] == pytest.approx(qpos[:2], abs=1e-9)
    assert turns == pytest.approx(round(turns), abs=1e-9)
    # The robot's own kinematics agree with MuJoCo's there.
    z = np.array([*pose, *robot.home])
    kinematics = robot.model.createData()
    pin.framesForwardKinematics(robot.model, kinematics, robot.coordinates.q(z))
    tool = kinematics.oMf[robot.model.getFrameId(robot.tool_frame)].translation
    assert data.body("tool").xpos == pytest.approx(tool + np.array([0.0, 0.0, elevation]), abs=1e-9)


def test_bases_that_do_not_stay_level_are_refused() -> None:
    model = make_kitchen(axes=np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]]))
    found = RobotInModel(model, vkc.load_robot(ROBOT), ModelJoints(model, None))
    with pytest.raises(vkc.InputError, match="does not move as x, y and yaw"):
        found.find_base_motion(make_data(model))
    tilted = make_kitchen(axes=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]]))
    check_error(tilted, make_data(tilted), "is not upright in the model")


# Misuse


def check_error(model: Any, data: Any, message: str, **options: Any) -> None:
    with pytest.raises(vkc.InputError, match=re.escape(message)):
        vkc.scene_from_mujoco(model, data, **{"robot": ROBOT, **options})


def test_misuse_names_what_is_wrong(model: Any) -> None:
    data = make_data(model)
    check_error("x.xml", data, "model: this is no model of MuJoCo (expected a mujoco.MjModel")
    check_error(model, None, "data: this is no data of MuJoCo")
    other = mujoco.MjModel.from_xml_string("<mujoco/>")
    check_error(model, mujoco.MjData(other), "data: the data belong to another model")
    check_error(model, data, "did you mean 'wrist_1_joint'", joints={"wrist_1_joint": "wrist_1"})
    check_error(model, data, "did you mean 'wrist_1_joint'", joints={"wrist_1": "wrist_1_joint"})
    check_error(
        model, data, "joint 'home/cup free' has no single", joints={"base_x": "home/cup free"}
    )
    check_error(model, data, "did you mean 'home/drawer'", objects=["home/drawr"])
    check_error(model, data, "'home/table' does not move", objects=["home/table"])
    check_error(model, data, "did you mean 'auto'", objects="aut")
    check_error(model, data, "no one body carries", joints={"base_x": "home/drawer slide"})
    check_error(model, data, "joint of the model for coordinate 'panda_joint1'", robot="panda")
    swapped = {"wrist_1_joint": "wrist_2_joint", "wrist_2_joint": "wrist_1_joint"}
    check_error(model, data, "or `joints` maps its joints wrongly", joints=swapped)
    check_error(model, data, "robot_body: no one body carries", robot_body="home/oven")
    check_error(model, data, "did you mean 'body 1'", robot_body="body1")


def test_joint_outside_its_limits(model: Any) -> None:
    data = make_data(model)
    data.joint("elbow_joint").qpos = 4.0
    check_error(model, data, "elbow_joint", objects=["home/drawer"])
    data = make_data(model)
    data.joint("home/drawer slide").qpos = 0.5
    check_error(model, data, "joint 'home_drawer_slide' of object 'home_cabinet' is outside its")
    data.joint("home/drawer slide").qpos = -0.001
    with pytest.warns(UserWarning, match="is at -0.001, beyond its limit 0"):
        scene = vkc.scene_from_mujoco(model, data, robot=ROBOT, objects=["home/drawer"])
    assert scene.objects["home_cabinet"].state == pytest.approx([0.0])


def test_ball_joints_and_tendons_are_noted() -> None:
    extra = """
    <body name="lamp" pos="-2 -2 1"><joint name="socket" type="ball"/>
      <geom type="sphere" size="0.1"/></body>
    """
    tendon = """
    <tendon><fixed name="rope"><joint joint="drawer slide" coef="1"/>
      <joint joint="oven.hinge" coef="1"/></fixed></tendon>
    """
    text = KITCHEN.replace("</worldbody>", f"{extra}</worldbody>{tendon}")
    spec = make_kitchen_spec(text)
    model = spec.compile()
    compiled = read_compiled_model(model, mujoco.MjData(model))
    assert "joint 'socket' is a ball joint: taken as fixed" in compiled.description.notes


# Motions


def test_motion_ends_at_the_goal_in_the_models_coordinates(model: Any, plan: vkc.Plan) -> None:
    data = make_data(model)
    motion = plan.to_mujoco(model, 50.0, data=data)
    assert motion.qpos.shape == (len(motion.times), model.nq)
    assert motion.times[0] == 0.0
    assert motion.times[-1] == pytest.approx(float(plan.trajectory.times[-1]))
    # The simulation stands at its first sample.
    assert motion.qpos[0] == pytest.approx(data.qpos, abs=1e-9)
    assert motion.positions(["home/drawer slide"])[-1] == pytest.approx([0.3])
    assert motion.driven == vkc.load_robot(ROBOT).coordinates.names
    assert motion.positions()[-1] == pytest.approx(plan.trajectory.positions[-1, :9], abs=1e-9)
    # What does not move stays.
    assert np.ptp(motion.positions(["home/oven.hinge"])) == 0.0
    assert not motion.holding[0]
    assert motion.holding[-1]
    for k in (0, len(motion.times) // 2, -1):
        data.qpos[:] = motion.qpos[k]
        mujoco.mj_forward(model, data)
        tool = plan.pose(None, float(plan.trajectory.times[0] + motion.times[k]))
        assert data.body("tool").xpos == pytest.approx(tool.translation, abs=1e-9)
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'elbow_joint'"):
        motion.positions(["elbow"])


@pytest.mark.parametrize("turns", [-2, 1])
def test_base_does_not_turn_back_before_it_moves(model: Any, turns: int) -> None:
    """A hinge that has turned several times goes on from there."""
    data = make_data(model)
    data.joint("base_yaw").qpos += 2.0 * np.pi * turns
    mujoco.mj_forward(model, data)
    scene = vkc.scene_from_mujoco(model, data, robot=ROBOT)
    plan = vkc.plan(scene, [vkc.GoTo(-0.6, 0.3, 0.5)])
    motion = plan.to_mujoco(model, 50.0, data=data)
    assert motion.qpos[0] == pytest.approx(data.qpos, abs=1e-9)
    assert np.ptp(motion.positions(["base_yaw"])) < 0.5
    assert np.abs(np.diff(motion.ctrl, axis=0)).max() < 0.1


def test_controls_open_the_drawer(model: Any, plan: vkc.Plan) -> None:
    data = make_data(model)
    motion = plan.to_mujoco(model, 1.0 / model.opt.timestep, data=data)
    assert motion.ctrl is not None
    assert motion.ctrl[-1] == pytest.approx(motion.positions()[-1], abs=1e-9)
    weld = model.equality("grip").id
    for k, ctrl in enumerate(motion.ctrl):
        if motion.holding[k] and not data.eq_active[weld]:
            # The servos have no feed-forward, so that the hand arrives late.
            mujoco.mj_step(model, data, nstep=500)
            grip(model, data, weld)
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data)
    mujoco.mj_step(model, data, nstep=500)
    assert data.joint("home/drawer slide").qpos[0] == pytest.approx(0.3, abs=5e-3)


def grip(model: Any, data: Any, weld: int) -> None:
    """Weld the drawer to the hand as it is."""
    tool = data.body("tool")
    drawer = data.body("home/drawer")
    position = np.zeros(3)
    orientation = np.zeros(4)
    inverse = (np.zeros(3), np.zeros(4))
    mujoco.mju_negPose(*inverse, tool.xpos, tool.xquat)
    mujoco.mju_mulPose(position, orientation, *inverse, drawer.xpos, drawer.xquat)
    model.eq_data[weld][3:6] = position
    model.eq_data[weld][6:10] = orientation
    data.eq_active[weld] = 1


def test_a_grasped_free_body_moves_with_the_hand(model: Any) -> None:
    data = make_data(model)
    data.qpos[:3] = [-0.4, 0.9, 1.57]
    scene = vkc.scene_from_mujoco(model, data, robot=ROBOT, floor=-0.1, objects=["home/cup"])
    # The cup stands on a table of 0.7 m: it is grasped where the hand finds it.
    plan = vkc.plan(scene, [vkc.Grasp("home_cup"), vkc.GoTo(-0.6, 0.6, 1.2)])
    assert plan.success, plan.summary()
    motion = plan.to_mujoco(model, 20.0, data=data)
    before = None
    for qpos, holds in zip(motion.qpos, motion.holding, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        tool = data.body("tool")
        cup = data.body("home/cup")
        if not holds:
            assert cup.xpos == pytest.approx([-0.4, 2.1, 0.76], abs=1e-6)
            continue
        # In the frame of the hand.
        relative = tool.xmat.reshape(3, 3).T @ (cup.xpos - tool.xpos)
        before = relative if before is None else before
        assert relative == pytest.approx(before, abs=1e-5)
    assert before is not None


def test_fixed_base_stands_where_the_scene_has_it(model: Any) -> None:
    data = make_data(model)
    data.qpos[:3] = [-0.7, 0.1, 0.4]
    scene = vkc.scene_from_mujoco(model, data, robot=ROBOT, base="fixed", objects=["home/drawer"])
    assert scene.start[:3] == pytest.approx([-0.7, 0.1, 0.4], abs=1e-9)
    plan = vkc.plan(scene, [vkc.Configure({"wrist_3_joint": 0.5})])
    motion = plan.to_mujoco(model, 20.0, data=data)
    assert motion.driven == vkc.load_robot(ROBOT).coordinates.names[3:]
    assert motion.qpos[:, :3] == pytest.approx(np.tile([-0.7, 0.1, 0.4], (len(motion.times), 1)))
    with pytest.raises(vkc.InputError, match="stands elsewhere in this state"):
        plan.to_mujoco(model, 20.0)


def test_motion_of_another_model(plan: vkc.Plan) -> None:
    empty = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(vkc.UnknownNameError, match="joint of the model for coordinate"):
        plan.to_mujoco(empty, 50.0)
    model = make_kitchen(text=KITCHEN.replace("drawer slide", "drawer slider"))
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'home/drawer slider'"):
        plan.to_mujoco(model, 50.0)
    joints = {"home_cabinet.home_drawer_slide": "home/drawer slider"}
    motion = plan.to_mujoco(model, 50.0, joints=joints)
    assert motion.positions(["home/drawer slider"])[-1] == pytest.approx([0.3])
    with pytest.raises(vkc.UnknownNameError, match="coordinate of the scene 'home_cab"):
        plan.to_mujoco(model, 50.0, joints={"home_cabinet.slide": "home/drawer slider"})
    with pytest.raises(vkc.InputError, match="rate"):
        plan.to_mujoco(model, 0.0, joints=joints)


def test_loading_a_scene_needs_no_mujoco() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert callable(vkc.scene_from_mujoco)
