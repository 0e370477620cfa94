"""Calls public functions with one or two invalid arguments."""

from __future__ import annotations

import atexit
import functools
import random
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

import vkc_pin as vkc
from vkc_pin.experiments.baselines import plan_separately
from vkc_pin.planning.kinematics import (
    center_of_mass,
    frame_jacobian,
    frame_placements,
    joint_placements,
    rnea,
)
from vkc_pin.visualization import to_html
from vkc_pin.visualization.plots import plot_clearance, plot_joints, plot_top_view

from . import odd

__all__ = ["CALLS", "make_case", "run"]

TINY = {
    "max_outer": 1,
    "max_iterations": 3,
    "reach_waypoints": 4,
    "move_waypoints": 4,
    "turn_waypoints": 2,
    "max_restarts": 1,
}


@dataclass(frozen=True)
class Call:
    """A public function with valid arguments, and its weight in the choice of cases."""

    function: Callable[..., Any]
    arguments: Callable[[], dict[str, Any]]
    weight: float = 1.0


@functools.cache
def load_drawer_scene() -> vkc.Scene:
    """Load a small scene with a drawer."""
    return vkc.load_scene("drawer")


@functools.cache
def load_fetch_scene() -> vkc.Scene:
    """Load a scene with free objects."""
    return vkc.load_scene("fetch")


@functools.cache
def make_trajectory() -> vkc.Trajectory:
    """Make a trajectory in the drawer scene along which all coordinates increase."""
    start = np.concatenate([load_drawer_scene().start, [0.0]])
    names = (*load_drawer_scene().robot.coordinates.names, "drawer.slide")
    end = start + 0.1
    positions = np.linspace(start, end, 5)
    phases = (
        vkc.PhaseSpan("reach", 0, 2),
        vkc.PhaseSpan("move", 2, 4, (vkc.Hold("drawer", "handle"),)),
    )
    return vkc.Trajectory(names, np.arange(5.0), positions, phases, len(start) - 1)


@functools.cache
def make_plan() -> vkc.Plan:
    """Plan with a minimal budget."""
    options = vkc.Options(**TINY)
    return vkc.plan(
        load_drawer_scene(),
        [vkc.GoTo(0.1, 0.1)],
        options=options,
        time_limit=0.5,
        initialization="interpolated",
    )


@functools.cache
def get_folder() -> Path:
    """Return the only folder that cases may write to."""
    root = Path(tempfile.mkdtemp(prefix="vkc_fuzz_"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    return root


@functools.cache
def write_files() -> dict[str, Path]:
    """Write the trajectory and the plan in all file formats that can be read."""
    files = {
        "csv": make_trajectory().to_csv(get_folder() / "motion.csv"),
        "json": make_trajectory().to_json(get_folder() / "motion.json"),
    }
    return {**files, "npz": make_plan().save(get_folder() / "plan.npz")}


def _make_steps() -> list[Any]:
    return [vkc.GoTo(0.1, 0.1)]


def _make_planning_arguments() -> dict[str, Any]:
    return {
        "scene": load_drawer_scene(),
        "steps": _make_steps(),
        "options": vkc.Options(**TINY),
        "time_limit": 0.2,
        "initialization": "auto",
    }


def _redirect_output(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that writes to relative paths below the folder of the cases."""

    def redirected(path: Any = None, **arguments: Any) -> Any:
        if isinstance(path, str | Path) and path and not Path(path).is_absolute():
            path = get_folder() / "written" / path
        return function(path, **arguments)

    return redirected


def _call_method(make: Callable[[], Any], name: str) -> Callable[..., Any]:
    return lambda *a, **k: getattr(make(), name)(*a, **k)


def _plan_with_term(kind: type, **arguments: Any) -> Any:
    return vkc.plan(**{**_make_planning_arguments(), "terms": [kind(**arguments)]})


def _compute_expression(state: Any) -> Any:
    return state.coordinate("elbow_joint")


def _make_step_builder(step: type) -> Callable[..., Any]:
    """Return a function that makes the step and builds a problem with it."""

    def build(**arguments: Any) -> Any:
        instance = step(**arguments)
        return vkc.build(load_fetch_scene(), [instance], options=vkc.Options(**TINY))

    return build


_POSE = (1.0, 0.2, 0.8, 0.0, 0.1, 0.2)
_ROS = functools.cache(lambda: make_trajectory().to_ros())


def _place_drawer_in_hand() -> pin.SE3:
    """Return the placement of an open drawer whose handle is in the hand."""
    drawer = load_drawer_scene().objects["drawer"].with_state({"slide": 0.1})
    grasp = drawer.object.attachment("handle")
    in_drawer = drawer.object.link_placement(grasp.link, drawer.state) * grasp.tool()
    return load_drawer_scene().tool_placement() * in_drawer.inverse()


CALLS: dict[str, Call] = {
    "load_scene": Call(vkc.load_scene, lambda: {"name_or_path": "drawer"}),
    "load_robot": Call(
        vkc.load_robot,
        lambda: {
            "name": "husky_ur5e",
            "base": "omni",
            "tool_frame": None,
            "locked_joints": {"elbow_joint": 0.5},
            "home": {"wrist_1_joint": 0.1},
            "srdf": None,
            "pairs": "srdf",
            "packages": {"x": "."},
        },
        2.0,
    ),
    "load_object": Call(vkc.load_object, lambda: {"name_or_path": "drawer"}),
    "Scene.from_document": Call(
        vkc.Scene.from_document,
        lambda: {"document": load_drawer_scene().document, "folder": load_drawer_scene().folder},
        0.5,
    ),
    "Scene.with_start": Call(
        _call_method(load_drawer_scene, "with_start"),
        lambda: {
            "base": load_drawer_scene().start[:3].tolist(),
            "arm": load_drawer_scene().start[3:].tolist(),
        },
    ),
    "Scene.with_state": Call(
        _call_method(load_drawer_scene, "with_state"),
        lambda: {"name": "drawer", "values": {"slide": 0.1}},
    ),
    "Scene.with_placement": Call(
        _call_method(load_fetch_scene, "with_placement"),
        lambda: {"name": next(iter(load_fetch_scene().objects)), "placement": pin.SE3.Identity()},
    ),
    "Scene.with_held": Call(
        _call_method(load_drawer_scene, "with_held"),
        lambda: {"held": {"drawer": "handle"}, "by": {}, "at": {}, "measured": {}},
    ),
    "Scene.with_measured_grasp": Call(
        _call_method(load_drawer_scene, "with_measured_grasp"),
        lambda: {
            "name": "drawer",
            "attachment": "handle",
            "base": load_drawer_scene().start[:3].tolist(),
            "arm": load_drawer_scene().start[3:].tolist(),
            "state": {"slide": 0.1},
            "placement": _place_drawer_in_hand(),
        },
    ),
    "Scene.with_held holds": Call(
        _call_method(load_drawer_scene, "with_held"),
        lambda: {"held": [vkc.Hold("drawer", "handle")]},
    ),
    "Scene.start_clearance": Call(
        _call_method(load_drawer_scene, "start_clearance"), lambda: {"reach": 0.1}
    ),
    "Scene.sample_start": Call(
        _call_method(load_drawer_scene, "sample_start"), lambda: {"rng": np.random.default_rng(0)}
    ),
    "PlacedObject.with_state": Call(
        _call_method(lambda: load_drawer_scene().objects["drawer"], "with_state"),
        lambda: {"values": {"slide": 0.1}},
    ),
    "PlacedObject.link_placement": Call(
        _call_method(lambda: load_drawer_scene().objects["drawer"], "link_placement"),
        lambda: {"link": "tray"},
    ),
    "ArticulatedObject.attachment": Call(
        _call_method(lambda: load_drawer_scene().objects["drawer"].object, "attachment"),
        lambda: {"name": "handle"},
    ),
    "ArticulatedObject.link_frame": Call(
        _call_method(lambda: load_drawer_scene().objects["drawer"].object, "link_frame"),
        lambda: {"link": "tray"},
    ),
    "ArticulatedObject.link_placement": Call(
        _call_method(lambda: load_drawer_scene().objects["drawer"].object, "link_placement"),
        lambda: {"link": "tray", "state": [0.1]},
    ),
    "Attachment.motion": Call(
        _call_method(lambda: load_drawer_scene().objects["drawer"].object.attachment(), "motion"),
        lambda: {"values": []},
    ),
    "Attachment.tool": Call(
        _call_method(lambda: load_drawer_scene().objects["drawer"].object.attachment(), "tool"),
        lambda: {"values": []},
    ),
    "Freedom.motion": Call(
        vkc.Freedom("", "revolute", np.array([0.0, 0.0, 1.0]), -1.0, 1.0).motion,
        lambda: {"value": 0.5},
    ),
    "Robot.link_of": Call(
        _call_method(lambda: load_drawer_scene().robot, "link_of"), lambda: {"geometry": 0}
    ),
    "Coordinates.q": Call(
        _call_method(lambda: load_drawer_scene().robot.coordinates, "q"),
        lambda: {"z": load_drawer_scene().start},
    ),
    "Coordinates.index": Call(
        _call_method(lambda: load_drawer_scene().robot.coordinates, "index"),
        lambda: {"name": "base_x"},
    ),
    "random_room": Call(
        vkc.procedural.random_room,
        lambda: {"number": 0, "settings": None, "clutter": 0.0, "tables": 0, "objects": ()},
        0.3,
    ),
    "random_task": Call(
        vkc.procedural.random_task,
        lambda: {
            "seed": 0,
            "settings": None,
            "clutter": 0.0,
            "tables": 0,
            "objects": ("random_oven",),
        },
        0.3,
    ),
    "random_object": Call(vkc.procedural.random_object, lambda: {"kind": "oven", "seed": 0}),
    "write_object": Call(
        _redirect_output(lambda path, **k: vkc.procedural.write_object(path=path, **k)),
        lambda: {"path": "oven.yaml", "description": vkc.procedural.random_object("oven")},
    ),
    "load_object described": Call(
        vkc.load_object,
        lambda: {"name_or_path": vkc.procedural.random_object("door"), "folder": "."},
    ),
    "goals": Call(vkc.procedural.goals, lambda: {"scene": load_drawer_scene(), "share": 0.5}),
    "RoomSettings": Call(
        vkc.procedural.RoomSettings,
        lambda: {
            "clutter": 0.5,
            "objects": ("door", "drawer"),
            "tables": 1,
            "carried": ("cup",),
            "width": (4.0, 7.0),
            "height": 2.4,
            "front": 1.8,
            "gap": 0.1,
            "robot": "husky_ur5e",
        },
        2.0,
    ),
    "Options": Call(
        vkc.Options,
        lambda: {name: getattr(vkc.Options(), name) for name in vkc.Options.__dataclass_fields__},
        2.0,
    ),
    "Options.paper": Call(vkc.Options.paper, lambda: {"dt": 0.5, "objective": "control_effort"}),
    "Reach": Call(_make_step_builder(vkc.Reach), lambda: {"pose": list(_POSE), "frame": None}),
    "Grasp": Call(
        _make_step_builder(vkc.Grasp), lambda: {"object": "ball", "attachment": None, "by": None}
    ),
    "Actuate": Call(
        lambda **k: vkc.build(load_drawer_scene(), [vkc.Actuate(**k)], options=vkc.Options(**TINY)),
        lambda: {"object": "drawer", "joints": {"slide": 0.2}, "attachment": "handle"},
    ),
    "Touch": Call(
        _make_step_builder(vkc.Touch), lambda: {"frame": "tool0", "target": [1.0, 0.2, 0.8]}
    ),
    "Place": Call(
        _make_step_builder(vkc.Place),
        lambda: {"object": "ball", "pose": [1.0, 0.2, 0.8], "attachment": None},
    ),
    "Release": Call(
        lambda **k: vkc.build(
            load_drawer_scene(),
            [vkc.Grasp("drawer"), vkc.Release(**k)],
            options=vkc.Options(**TINY),
        ),
        lambda: {"object": "drawer"},
    ),
    "GoTo": Call(_make_step_builder(vkc.GoTo), lambda: {"x": 0.1, "y": 0.1, "yaw": 0.2}),
    "Constraint": Call(
        functools.partial(_plan_with_term, vkc.Constraint),
        lambda: {
            "name": "elbow",
            "expression": _compute_expression,
            "lower": -3.0,
            "upper": [3.0],
            "tolerance": 1e-3,
            "during": None,
            "holding": None,
        },
        1.5,
    ),
    "Cost": Call(
        functools.partial(_plan_with_term, vkc.Cost),
        lambda: {
            "name": "elbow",
            "expression": _compute_expression,
            "weight": 1.0,
            "during": ["go to"],
            "holding": None,
        },
    ),
    "plan": Call(
        vkc.plan,
        lambda: {
            **_make_planning_arguments(),
            "callback": None,
            "seed": 0,
            "simultaneous": True,
            "perturbation": 0.0,
            "progress": False,
            "terms": (),
            "planner": None,
        },
        2.0,
    ),
    "plan_window": Call(
        vkc.plan,
        lambda: {
            **_make_planning_arguments(),
            "window": 1,
            "callback": None,
            "seed": 0,
            "progress": False,
            "terms": (),
            "planner": None,
        },
        2.0,
    ),
    "plan_separately": Call(
        plan_separately,
        lambda: {
            "scene": load_drawer_scene(),
            "steps": _make_steps(),
            "method": "B1",
            "options": vkc.Options(**TINY),
            "seed": 0,
            "time_limit": 0.2,
            "retries": 1,
            "planner": None,
        },
    ),
    "Planner": Call(vkc.Planner, lambda: {"entries": 8, "megabytes": 4.0}),
    "build": Call(
        vkc.build,
        lambda: {
            "scene": load_drawer_scene(),
            "steps": _make_steps(),
            "options": vkc.Options(**TINY),
            "terms": (),
            "cache": None,
        },
    ),
    "validate": Call(
        vkc.validate,
        lambda: {
            "scene": load_drawer_scene(),
            "steps": _make_steps(),
            "trajectory": make_trajectory(),
            "options": vkc.Options(),
            "terms": (),
        },
    ),
    "invert": Call(
        vkc.invert,
        lambda: {
            "obj": load_drawer_scene().objects["drawer"].object,
            "link": "tray",
            "state": [0.1],
        },
    ),
    "consolidate": Call(
        vkc.consolidate,
        lambda: {"scene": load_drawer_scene(), "holds": {"drawer": "handle"}, "cache": None},
    ),
    "consolidate holds": Call(
        vkc.consolidate,
        lambda: {"scene": load_drawer_scene(), "holds": [vkc.Hold("drawer", "handle")]},
    ),
    "Hold": Call(
        lambda **k: load_drawer_scene().with_held([vkc.Hold(**k)]),
        lambda: {
            "object": "drawer",
            "attachment": "handle",
            "by": None,
            "link": None,
            "at": (),
            "deviation": (0.001, 0.0, 0.0, 0.0, 0.0, 0.1),
        },
    ),
    "PhaseSpan": Call(
        lambda **k: vkc.Trajectory(
            make_trajectory().names,
            make_trajectory().times,
            make_trajectory().positions,
            [vkc.PhaseSpan(**k)],
            make_trajectory().robot_size,
        ),
        lambda: {"name": "all", "first": 0, "last": 4, "holds": ()},
    ),
    "Trajectory": Call(
        vkc.Trajectory,
        lambda: {
            "names": make_trajectory().names,
            "times": make_trajectory().times,
            "positions": make_trajectory().positions,
            "phases": make_trajectory().phases,
            "robot_size": make_trajectory().robot_size,
        },
        1.5,
    ),
    "Trajectory.at": Call(_call_method(make_trajectory, "at"), lambda: {"time": [0.5, 1.0]}),
    "Trajectory.column": Call(_call_method(make_trajectory, "column"), lambda: {"name": "base_x"}),
    "Trajectory.from_dict": Call(
        vkc.Trajectory.from_dict, lambda: {"data": make_trajectory().to_dict()}, 2.0
    ),
    "Trajectory.to_csv": Call(
        _redirect_output(lambda path, **k: make_trajectory().to_csv(path, **k)),
        lambda: {
            "path": "t.csv",
            "joints": ["base_x", "base_y", "base_yaw"],
            "units": {"base_x": "m"},
        },
    ),
    "Trajectory.to_json": Call(
        _redirect_output(lambda path, **k: make_trajectory().to_json(path, **k)),
        lambda: {"path": "t.json"},
    ),
    "Trajectory.to_ros": Call(
        _call_method(make_trajectory, "to_ros"),
        lambda: {
            "joints": "robot",
            "rate": 5.0,
            "smooth": True,
            "derivatives": 2,
            "frame": "world",
            "stamp": 0.0,
        },
        1.5,
    ),
    "Trajectory.from_csv": Call(
        vkc.Trajectory.from_csv, lambda: {"path": write_files()["csv"], "robot_size": None}
    ),
    "Trajectory.from_json": Call(vkc.Trajectory.from_json, lambda: {"path": write_files()["json"]}),
    "Trajectory.from_ros": Call(
        vkc.Trajectory.from_ros,
        lambda: {"message": _ROS(), "like": make_trajectory(), "robot_size": None},
        1.5,
    ),
    "Plan.load": Call(vkc.Plan.load, lambda: {"path": write_files()["npz"]}),
    "Plan.save": Call(
        _redirect_output(lambda path: make_plan().save(path)), lambda: {"path": "p.npz"}
    ),
    "Plan.to_json": Call(
        _redirect_output(lambda path: make_plan().to_json(path)), lambda: {"path": "p.json"}
    ),
    "Plan.to_csv": Call(
        _redirect_output(lambda path, **k: make_plan().to_csv(path, **k)),
        lambda: {"path": "p.csv", "joints": "all"},
    ),
    "Plan.to_ros": Call(
        _call_method(make_plan, "to_ros"), lambda: {"joints": ["base_x"], "rate": None}
    ),
    "Plan.to_html": Call(
        _redirect_output(lambda path: make_plan().to_html(path)), lambda: {"path": "p.html"}, 0.2
    ),
    "Plan.plot": Call(
        _redirect_output(lambda path: make_plan().plot(path)), lambda: {"path": "p.svg"}, 0.2
    ),
    "to_html": Call(
        lambda path, **k: to_html(path=get_folder() / "p.html", **k),
        lambda: {
            "path": None,
            "plan_or_scene": load_drawer_scene(),
            "frames": {"goal": pin.SE3.Identity()},
        },
        0.3,
    ),
    "show": Call(
        lambda **k: vkc.visualization.show(**{**k, "open_browser": False}),
        lambda: {
            "plan_or_scene": load_drawer_scene(),
            "open_browser": False,
            "height": 300,
            "frames": None,
        },
        0.2,
    ),
    "animate": Call(vkc.visualization.animate, lambda: {"plan": make_plan(), "viewer": None}, 0.2),
    "plot_joints": Call(plot_joints, lambda: {"plan": make_plan()}, 0.2),
    "plot_clearance": Call(plot_clearance, lambda: {"plan": make_plan()}, 0.2),
    "plot_top_view": Call(plot_top_view, lambda: {"plan": make_plan()}, 0.2),
    "joint_placements": Call(
        joint_placements, lambda: {"model": load_drawer_scene().robot.model}, 0.5
    ),
    "frame_placements": Call(
        frame_placements, lambda: {"model": load_drawer_scene().robot.model, "frames": ["tool0"]}
    ),
    "frame_jacobian": Call(
        frame_jacobian,
        lambda: {
            "model": load_drawer_scene().robot.model,
            "frame": "tool0",
            "reference": "local_world_aligned",
        },
    ),
    "rnea": Call(rnea, lambda: {"model": load_drawer_scene().robot.model}, 0.5),
    "center_of_mass": Call(center_of_mass, lambda: {"model": load_drawer_scene().robot.model}, 0.5),
}


def make_case(rng: random.Random) -> dict[str, Any]:
    """Return a case: a call and changes of its arguments."""
    names = list(CALLS)
    name = rng.choices(names, [CALLS[each].weight for each in names])[0]
    parameters = list(CALLS[name].arguments())
    changes = []
    for parameter in rng.sample(parameters, min(len(parameters), rng.choice((1, 1, 1, 2)))):
        value = rng.choice(odd.USUAL if rng.random() < 0.5 else odd.VALUES)
        if parameter == "callback" and value in odd.RAISING:  # its own errors pass through
            value = "None"
        changes.append([parameter, value, rng.randrange(8) if rng.random() < 0.4 else None])
    return {"call": name, "changes": changes}


def run(case: dict[str, Any]) -> str:
    """Make the call of a case and return its outcome, or raise its error."""
    call = CALLS[case["call"]]
    arguments = call.arguments()
    for parameter, name, at in case["changes"]:
        value = odd.make_value(name)
        arguments[parameter] = (
            value if at is None else odd.insert_value(arguments[parameter], value, at)
        )
    call.function(**arguments)
    return "done"
