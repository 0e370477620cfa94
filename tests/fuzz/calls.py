"""Lists public functions with valid arguments."""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

import vkc_pin as vkc
from vkc_pin.experiments.baselines import plan_separately
from vkc_pin.planning import kinematics
from vkc_pin.visualization import plots, to_html

TINY = {
    "max_outer": 1,
    "max_iterations": 3,
    "reach_waypoints": 4,
    "move_waypoints": 4,
    "turn_waypoints": 2,
    "max_restarts": 1,
}
SMALL = {"options": vkc.Options(**TINY), "time_limit": 0.2}


@functools.cache
def load_drawer_scene() -> vkc.Scene:
    """Load a small scene with a drawer."""
    return vkc.load_scene("drawer")


@functools.cache
def make_trajectory() -> vkc.Trajectory:
    """Make a trajectory in the drawer scene along which all coordinates increase."""
    scene = load_drawer_scene()
    start = np.append(scene.start, 0.0)
    names = (*scene.robot.coordinates.names, "drawer.slide")
    positions = np.linspace(start, start + 0.1, 5)
    drawer = vkc.Hold("drawer", "handle")
    phases = (vkc.PhaseSpan("reach", 0, 2), vkc.PhaseSpan("move", 2, 4, (drawer,)))
    return vkc.Trajectory(names, np.arange(5.0), positions, phases, len(start) - 1)


@functools.cache
def make_plan() -> vkc.Plan:
    """Plan with a minimal budget."""
    steps = [vkc.GoTo(0.1, 0.1)]
    return vkc.plan(load_drawer_scene(), steps, initialization="interpolated", **SMALL)


@functools.cache
def get_folder() -> Path:
    """Return the only folder that cases may write to."""
    return Path(tempfile.mkdtemp())


def _write_below(write: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that writes to any path, below the folder of the cases."""

    def redirect(path: Any = None, **arguments: Any) -> Any:
        if isinstance(path, str | Path) and path:
            inner = os.path.normpath(f"/{path}").lstrip("/")
            path = get_folder() / "written" / inner
        return write(path, **arguments)

    return redirect


def _place_drawer_in_hand() -> pin.SE3:
    """Return the placement of an open drawer whose handle is in the hand."""
    scene = load_drawer_scene()
    drawer = scene.objects["drawer"].with_state({"slide": 0.1})
    grasp = drawer.object.attachment("handle")
    in_drawer = drawer.object.link_placement(grasp.link, drawer.state) * grasp.tool()
    return scene.tool_placement() * in_drawer.inverse()


def _plan_with_term(kind: type, **arguments: Any) -> Any:
    steps = [vkc.GoTo(0.1, 0.1)]
    return vkc.plan(load_drawer_scene(), steps, terms=[kind(**arguments)], **SMALL)


def _build(scene: vkc.Scene, step: type, before: tuple[Any, ...] = (), **arguments: Any) -> Any:
    return vkc.build(scene, [*before, step(**arguments)], options=SMALL["options"])


def _hold(scene: vkc.Scene, **arguments: Any) -> Any:
    return scene.with_held([vkc.Hold(**arguments)])


def _span(trajectory: vkc.Trajectory, **arguments: Any) -> Any:
    spans = [vkc.PhaseSpan(**arguments)]
    size = trajectory.robot_size
    return vkc.Trajectory(trajectory.names, trajectory.times, trajectory.positions, spans, size)


@functools.cache
def list_calls() -> dict[str, partial[Any]]:
    """Return name → public function with valid arguments, all by keyword."""
    return {
        **_list_calls_of_scenes(),
        **_list_calls_of_models(),
        **_list_calls_of_planning(),
        **_list_calls_of_trajectories(),
        **_list_calls_of_plans(),
    }


def _list_calls_of_scenes() -> dict[str, partial[Any]]:
    scene = load_drawer_scene()
    fetch = vkc.load_scene("fetch")
    free = next(iter(fetch.objects))
    base = scene.start[:3].tolist()
    arm = scene.start[3:].tolist()
    rng = np.random.default_rng(0)
    placed = scene.objects["drawer"]
    room = {"clutter": 0.0, "tables": 0, "settings": None}
    hold = vkc.Hold("drawer", "handle")
    measured = {"name": "drawer", "attachment": "handle", "base": base, "arm": arm}
    return {
        "load_scene": partial(vkc.load_scene, name_or_path="drawer"),
        "Scene.from_document": partial(
            vkc.Scene.from_document, document=scene.document, folder=scene.folder
        ),
        "Scene.with_start": partial(scene.with_start, base=base, arm=arm),
        "Scene.with_state": partial(scene.with_state, name="drawer", values={"slide": 0.1}),
        "Scene.with_placement": partial(
            fetch.with_placement, name=free, placement=pin.SE3.Identity()
        ),
        "Scene.with_held": partial(
            scene.with_held, held={"drawer": "handle"}, by={}, at={}, measured={}
        ),
        "Scene.with_held holds": partial(scene.with_held, held=[hold]),
        "Scene.with_measured_grasp": partial(
            scene.with_measured_grasp,
            **measured,
            state={"slide": 0.1},
            placement=_place_drawer_in_hand(),
        ),
        "Scene.start_clearance": partial(scene.start_clearance, reach=0.1),
        "Scene.sample_start": partial(scene.sample_start, rng=rng),
        "PlacedObject.with_state": partial(placed.with_state, values={"slide": 0.1}),
        "PlacedObject.link_placement": partial(placed.link_placement, link="tray"),
        "Hold": partial(
            _hold,
            scene,
            object="drawer",
            attachment="handle",
            by=None,
            link=None,
            at=(),
            deviation=(0.001, 0.0, 0.0, 0.0, 0.0, 0.1),
        ),
        "consolidate": partial(
            vkc.consolidate, scene=scene, holds={"drawer": "handle"}, cache=None
        ),
        "consolidate holds": partial(vkc.consolidate, scene=scene, holds=[hold]),
        "goals": partial(vkc.procedural.goals, scene=scene, share=0.5),
        "random_room": partial(vkc.procedural.random_room, number=0, objects=(), **room),
        "random_task": partial(
            vkc.procedural.random_task, seed=0, objects=("random_oven",), **room
        ),
        "RoomSettings": partial(
            vkc.procedural.RoomSettings,
            clutter=0.5,
            objects=("door", "drawer"),
            tables=1,
            carried=("cup",),
            width=(4.0, 7.0),
            height=2.4,
            front=1.8,
            gap=0.1,
            robot="husky_ur5e",
        ),
    }


def _list_calls_of_models() -> dict[str, partial[Any]]:
    robot = load_drawer_scene().robot
    start = load_drawer_scene().start
    drawer = load_drawer_scene().objects["drawer"].object
    attachment = drawer.attachment()
    freedom = vkc.Freedom("", "revolute", np.array([0.0, 0.0, 1.0]), -1.0, 1.0)
    oven = vkc.procedural.random_object("oven")
    door = vkc.procedural.random_object("door")
    model = robot.model
    return {
        "load_robot": partial(
            vkc.load_robot,
            name="husky_ur5e",
            base="omni",
            tool_frame=None,
            locked_joints={"elbow_joint": 0.5},
            home={"wrist_1_joint": 0.1},
            srdf=None,
            pairs="srdf",
            packages={"x": "."},
        ),
        "load_object": partial(vkc.load_object, name_or_path="drawer"),
        "load_object described": partial(vkc.load_object, name_or_path=door, folder="."),
        "random_object": partial(vkc.procedural.random_object, kind="oven", seed=0),
        "write_object": partial(
            _write_below(lambda path, **given: vkc.procedural.write_object(path=path, **given)),
            path="oven.yaml",
            description=oven,
        ),
        "Attachment.motion": partial(attachment.motion, values=[]),
        "Attachment.tool": partial(attachment.tool, values=[]),
        "ArticulatedObject.attachment": partial(drawer.attachment, name="handle"),
        "ArticulatedObject.link_frame": partial(drawer.link_frame, link="tray"),
        "ArticulatedObject.link_placement": partial(
            drawer.link_placement, link="tray", state=[0.1]
        ),
        "Freedom.motion": partial(freedom.motion, value=0.5),
        "invert": partial(vkc.invert, obj=drawer, link="tray", state=[0.1]),
        "Robot.link_of": partial(robot.link_of, geometry=0),
        "Coordinates.q": partial(robot.coordinates.q, z=start),
        "Coordinates.index": partial(robot.coordinates.index, name="base_x"),
        "joint_placements": partial(kinematics.joint_placements, model=model),
        "frame_placements": partial(kinematics.frame_placements, model=model, frames=["tool0"]),
        "frame_jacobian": partial(
            kinematics.frame_jacobian, model=model, frame="tool0", reference="local_world_aligned"
        ),
        "rnea": partial(kinematics.rnea, model=model),
        "center_of_mass": partial(kinematics.center_of_mass, model=model),
    }


def _list_calls_of_planning() -> dict[str, partial[Any]]:
    scene = load_drawer_scene()
    fetch = vkc.load_scene("fetch")
    task = {"scene": scene, "steps": [vkc.GoTo(0.1, 0.1)]}
    shared = {**task, **SMALL, "seed": 0, "planner": None}
    planned = {
        **shared,
        "initialization": "auto",
        "callback": None,
        "progress": False,
        "terms": (),
    }
    term = {"name": "elbow", "expression": _read_elbow, "holding": None}
    defaults = vkc.Options()
    point = [1.0, 0.2, 0.8]
    return {
        "Options": partial(
            vkc.Options, **{name: getattr(defaults, name) for name in vars(defaults)}
        ),
        "Options.paper": partial(vkc.Options.paper, dt=0.5, objective="control_effort"),
        "Planner": partial(vkc.Planner, entries=8, megabytes=4.0),
        "plan": partial(vkc.plan, **planned, simultaneous=True, perturbation=0.0),
        "plan_window": partial(vkc.plan, **planned, window=1),
        "plan_separately": partial(plan_separately, **shared, method="B1", retries=1),
        "build": partial(vkc.build, **task, options=SMALL["options"], terms=(), cache=None),
        "validate": partial(
            vkc.validate, **task, trajectory=make_trajectory(), options=defaults, terms=()
        ),
        "Constraint": partial(
            _plan_with_term,
            vkc.Constraint,
            **term,
            lower=-3.0,
            upper=[3.0],
            tolerance=1e-3,
            during=None,
        ),
        "Cost": partial(_plan_with_term, vkc.Cost, **term, weight=1.0, during=["go to"]),
        "Reach": partial(_build, fetch, vkc.Reach, pose=(*point, 0.0, 0.1, 0.2), frame=None),
        "Grasp": partial(_build, fetch, vkc.Grasp, object="ball", attachment=None, by=None),
        "Touch": partial(_build, fetch, vkc.Touch, frame="tool0", target=point),
        "Place": partial(_build, fetch, vkc.Place, object="ball", pose=point, attachment=None),
        "GoTo": partial(_build, fetch, vkc.GoTo, x=0.1, y=0.1, yaw=0.2),
        "Release": partial(_build, scene, vkc.Release, (vkc.Grasp("drawer"),), object="drawer"),
        "Actuate": partial(
            _build, scene, vkc.Actuate, object="drawer", joints={"slide": 0.2}, attachment="handle"
        ),
    }


def _read_elbow(state: Any) -> Any:
    return state.coordinate("elbow_joint")


def _list_calls_of_trajectories() -> dict[str, partial[Any]]:
    trajectory = make_trajectory()
    fields = {name: getattr(trajectory, name) for name in ("names", "times", "positions")}
    size = trajectory.robot_size
    csv = trajectory.to_csv(get_folder() / "motion.csv")
    json = trajectory.to_json(get_folder() / "motion.json")
    joints = ["base_x", "base_y", "base_yaw"]
    return {
        "PhaseSpan": partial(_span, trajectory, name="all", first=0, last=4, holds=()),
        "Trajectory": partial(vkc.Trajectory, **fields, phases=trajectory.phases, robot_size=size),
        "Trajectory.at": partial(trajectory.at, time=[0.5, 1.0]),
        "Trajectory.column": partial(trajectory.column, name="base_x"),
        "Trajectory.from_dict": partial(vkc.Trajectory.from_dict, data=trajectory.to_dict()),
        "Trajectory.from_csv": partial(vkc.Trajectory.from_csv, path=csv, robot_size=None),
        "Trajectory.from_json": partial(vkc.Trajectory.from_json, path=json),
        "Trajectory.from_ros": partial(
            vkc.Trajectory.from_ros, message=trajectory.to_ros(), like=trajectory, robot_size=None
        ),
        "Trajectory.to_csv": partial(
            _write_below(trajectory.to_csv), path="t.csv", joints=joints, units={"base_x": "m"}
        ),
        "Trajectory.to_json": partial(_write_below(trajectory.to_json), path="t.json"),
        "Trajectory.to_ros": partial(
            trajectory.to_ros,
            joints="robot",
            rate=5.0,
            smooth=True,
            derivatives=2,
            frame="world",
            stamp=0.0,
        ),
    }


def _list_calls_of_plans() -> dict[str, partial[Any]]:
    plan = make_plan()
    shown = {"plan_or_scene": load_drawer_scene(), "frames": {"goal": pin.SE3.Identity()}}
    page = get_folder() / "page.html"
    return {
        "Plan.load": partial(vkc.Plan.load, path=plan.save(get_folder() / "plan.npz")),
        "Plan.save": partial(_write_below(plan.save), path="p.npz"),
        "Plan.to_json": partial(_write_below(plan.to_json), path="p.json"),
        "Plan.to_csv": partial(_write_below(plan.to_csv), path="p.csv", joints="all"),
        "Plan.to_ros": partial(plan.to_ros, joints=["base_x"], rate=None),
        "Plan.to_html": partial(_write_below(plan.to_html), path="p.html"),
        "Plan.plot": partial(_write_below(plan.plot), path="p.svg"),
        "to_html": partial(lambda **given: to_html(path=page, **given), **shown),
        "show": partial(
            lambda **given: vkc.visualization.show(**given, open_browser=False), **shown, height=300
        ),
        "animate": partial(vkc.visualization.animate, plan=plan, viewer=None),
        "plot_joints": partial(plots.plot_joints, plan=plan),
        "plot_clearance": partial(plots.plot_clearance, plan=plan),
        "plot_top_view": partial(plots.plot_top_view, plan=plan),
    }
