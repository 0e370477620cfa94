"""Calls of what is public, with arguments that work; a case makes one or two of these odd."""

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

__all__ = ["CALLS", "case", "run"]

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
    """Something public, and arguments that work; `often` says how many cases it gets."""

    does: Callable[..., Any]
    arguments: Callable[[], dict[str, Any]]
    often: float = 1.0


@functools.cache
def scene() -> vkc.Scene:
    """A small scene: the robot, a table that holds a stick, a drawer."""
    return vkc.load_scene("drawer")


@functools.cache
def fetch() -> vkc.Scene:
    """A scene with things to carry."""
    return vkc.load_scene("fetch")


@functools.cache
def motion() -> vkc.Trajectory:
    """A motion in `scene`: it drives and turns an arm joint."""
    start = np.concatenate([scene().start, [0.0]])
    names = (*scene().robot.coordinates.names, "drawer.slide")
    end = start + 0.1
    positions = np.linspace(start, end, 5)
    phases = (
        vkc.PhaseSpan("reach", 0, 2),
        vkc.PhaseSpan("move", 2, 4, (vkc.Hold("drawer", "handle"),)),
    )
    return vkc.Trajectory(names, np.arange(5.0), positions, phases, len(start) - 1)


@functools.cache
def saved() -> vkc.Plan:
    """What planning with next to no time comes to."""
    options = vkc.Options(**TINY)
    return vkc.plan(
        scene(),
        [vkc.GoTo(0.1, 0.1)],
        options=options,
        time_limit=0.5,
        initialization="interpolated",
    )


@functools.cache
def folder() -> Path:
    """Return the only folder that cases may write to."""
    root = Path(tempfile.mkdtemp(prefix="vkc_fuzz_"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    return root


@functools.cache
def files() -> dict[str, Path]:
    """The motion in all the kinds of files that can be read."""
    made = {
        "csv": motion().to_csv(folder() / "motion.csv"),
        "json": motion().to_json(folder() / "motion.json"),
    }
    return {**made, "npz": saved().save(folder() / "plan.npz")}


def _steps() -> list[Any]:
    return [vkc.GoTo(0.1, 0.1)]


def _planning() -> dict[str, Any]:
    return {
        "scene": scene(),
        "steps": _steps(),
        "options": vkc.Options(**TINY),
        "time_limit": 0.2,
        "initialization": "auto",
    }


def _written(does: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that writes relative file names into `folder`."""

    def inside(path: Any = None, **arguments: Any) -> Any:
        if isinstance(path, str | Path) and path and not Path(path).is_absolute():
            path = folder() / "written" / path
        return does(path, **arguments)

    return inside


def _method(make: Callable[[], Any], name: str) -> Callable[..., Any]:
    return lambda *a, **k: getattr(make(), name)(*a, **k)


def _term(kind: type, **arguments: Any) -> Any:
    return vkc.plan(**{**_planning(), "terms": [kind(**arguments)]})


def _expression(state: Any) -> Any:
    return state.coordinate("elbow_joint")


def _planned(step: type) -> Callable[..., Any]:
    """Return the step, and look what becomes of it in a task."""

    def built(**arguments: Any) -> Any:
        made = step(**arguments)
        return vkc.build(fetch(), [made], options=vkc.Options(**TINY))

    return built


_POSE = (1.0, 0.2, 0.8, 0.0, 0.1, 0.2)
_ROS = functools.cache(lambda: motion().to_ros())

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
        lambda: {"document": scene().document, "folder": scene().folder},
        0.5,
    ),
    "Scene.with_start": Call(
        _method(scene, "with_start"),
        lambda: {"base": scene().start[:3].tolist(), "arm": scene().start[3:].tolist()},
    ),
    "Scene.with_state": Call(
        _method(scene, "with_state"), lambda: {"name": "drawer", "values": {"slide": 0.1}}
    ),
    "Scene.with_placement": Call(
        _method(fetch, "with_placement"),
        lambda: {"name": next(iter(fetch().objects)), "placement": pin.SE3.Identity()},
    ),
    "Scene.with_held": Call(
        _method(scene, "with_held"), lambda: {"held": {"drawer": "handle"}, "by": {}, "at": {}}
    ),
    "Scene.with_held holds": Call(
        _method(scene, "with_held"), lambda: {"held": [vkc.Hold("drawer", "handle")]}
    ),
    "Scene.start_clearance": Call(_method(scene, "start_clearance"), lambda: {"reach": 0.1}),
    "Scene.sample_start": Call(
        _method(scene, "sample_start"), lambda: {"rng": np.random.default_rng(0)}
    ),
    "PlacedObject.with_state": Call(
        _method(lambda: scene().objects["drawer"], "with_state"), lambda: {"values": {"slide": 0.1}}
    ),
    "PlacedObject.link_placement": Call(
        _method(lambda: scene().objects["drawer"], "link_placement"), lambda: {"link": "tray"}
    ),
    "ArticulatedObject.attachment": Call(
        _method(lambda: scene().objects["drawer"].object, "attachment"), lambda: {"name": "handle"}
    ),
    "ArticulatedObject.link_frame": Call(
        _method(lambda: scene().objects["drawer"].object, "link_frame"), lambda: {"link": "tray"}
    ),
    "ArticulatedObject.link_placement": Call(
        _method(lambda: scene().objects["drawer"].object, "link_placement"),
        lambda: {"link": "tray", "state": [0.1]},
    ),
    "Attachment.motion": Call(
        _method(lambda: scene().objects["drawer"].object.attachment(), "motion"),
        lambda: {"values": []},
    ),
    "Attachment.tool": Call(
        _method(lambda: scene().objects["drawer"].object.attachment(), "tool"),
        lambda: {"values": []},
    ),
    "Freedom.motion": Call(
        vkc.Freedom("", "revolute", np.array([0.0, 0.0, 1.0]), -1.0, 1.0).motion,
        lambda: {"value": 0.5},
    ),
    "Robot.link_of": Call(_method(lambda: scene().robot, "link_of"), lambda: {"geometry": 0}),
    "Coordinates.q": Call(
        _method(lambda: scene().robot.coordinates, "q"), lambda: {"z": scene().start}
    ),
    "Coordinates.index": Call(
        _method(lambda: scene().robot.coordinates, "index"), lambda: {"name": "base_x"}
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
        _written(lambda path, **k: vkc.procedural.write_object(path=path, **k)),
        lambda: {"path": "oven.yaml", "description": vkc.procedural.random_object("oven")},
    ),
    "load_object described": Call(
        vkc.load_object,
        lambda: {"name_or_path": vkc.procedural.random_object("door"), "folder": "."},
    ),
    "goals": Call(vkc.procedural.goals, lambda: {"scene": scene(), "share": 0.5}),
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
    "Reach": Call(_planned(vkc.Reach), lambda: {"pose": list(_POSE), "frame": None}),
    "Grasp": Call(_planned(vkc.Grasp), lambda: {"object": "ball", "attachment": None, "by": None}),
    "Actuate": Call(
        lambda **k: vkc.build(scene(), [vkc.Actuate(**k)], options=vkc.Options(**TINY)),
        lambda: {"object": "drawer", "joints": {"slide": 0.2}, "attachment": "handle"},
    ),
    "Touch": Call(_planned(vkc.Touch), lambda: {"frame": "tool0", "target": [1.0, 0.2, 0.8]}),
    "Place": Call(
        _planned(vkc.Place), lambda: {"object": "ball", "pose": [1.0, 0.2, 0.8], "attachment": None}
    ),
    "Release": Call(
        lambda **k: vkc.build(
            scene(), [vkc.Grasp("drawer"), vkc.Release(**k)], options=vkc.Options(**TINY)
        ),
        lambda: {"object": "drawer"},
    ),
    "GoTo": Call(_planned(vkc.GoTo), lambda: {"x": 0.1, "y": 0.1, "yaw": 0.2}),
    "Constraint": Call(
        functools.partial(_term, vkc.Constraint),
        lambda: {
            "name": "elbow",
            "expression": _expression,
            "lower": -3.0,
            "upper": [3.0],
            "tolerance": 1e-3,
            "during": None,
            "holding": None,
        },
        1.5,
    ),
    "Cost": Call(
        functools.partial(_term, vkc.Cost),
        lambda: {
            "name": "elbow",
            "expression": _expression,
            "weight": 1.0,
            "during": ["go to"],
            "holding": None,
        },
    ),
    "plan": Call(
        vkc.plan,
        lambda: {
            **_planning(),
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
            **_planning(),
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
        vkc.baselines.plan_separately,
        lambda: {
            "scene": scene(),
            "steps": _steps(),
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
            "scene": scene(),
            "steps": _steps(),
            "options": vkc.Options(**TINY),
            "terms": (),
            "cache": None,
        },
    ),
    "validate": Call(
        vkc.validate,
        lambda: {
            "scene": scene(),
            "steps": _steps(),
            "trajectory": motion(),
            "options": vkc.Options(),
            "terms": (),
        },
    ),
    "invert": Call(
        vkc.invert,
        lambda: {"obj": scene().objects["drawer"].object, "link": "tray", "state": [0.1]},
    ),
    "consolidate": Call(
        vkc.consolidate, lambda: {"scene": scene(), "holds": {"drawer": "handle"}, "cache": None}
    ),
    "consolidate holds": Call(
        vkc.consolidate, lambda: {"scene": scene(), "holds": [vkc.Hold("drawer", "handle")]}
    ),
    "Hold": Call(
        lambda **k: scene().with_held([vkc.Hold(**k)]),
        lambda: {"object": "drawer", "attachment": "handle", "by": None, "link": None, "at": ()},
    ),
    "PhaseSpan": Call(
        lambda **k: vkc.Trajectory(
            motion().names,
            motion().times,
            motion().positions,
            [vkc.PhaseSpan(**k)],
            motion().robot_size,
        ),
        lambda: {"name": "all", "first": 0, "last": 4, "holds": ()},
    ),
    "Trajectory": Call(
        vkc.Trajectory,
        lambda: {
            "names": motion().names,
            "times": motion().times,
            "positions": motion().positions,
            "phases": motion().phases,
            "robot_size": motion().robot_size,
        },
        1.5,
    ),
    "Trajectory.at": Call(_method(motion, "at"), lambda: {"time": [0.5, 1.0]}),
    "Trajectory.column": Call(_method(motion, "column"), lambda: {"name": "base_x"}),
    "Trajectory.from_dict": Call(
        vkc.Trajectory.from_dict, lambda: {"data": motion().to_dict()}, 2.0
    ),
    "Trajectory.to_csv": Call(
        _written(lambda path, **k: motion().to_csv(path, **k)),
        lambda: {
            "path": "t.csv",
            "joints": ["base_x", "base_y", "base_yaw"],
            "units": {"base_x": "m"},
        },
    ),
    "Trajectory.to_json": Call(
        _written(lambda path, **k: motion().to_json(path, **k)), lambda: {"path": "t.json"}
    ),
    "Trajectory.to_ros": Call(
        _method(motion, "to_ros"),
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
        vkc.Trajectory.from_csv, lambda: {"path": files()["csv"], "robot_size": None}
    ),
    "Trajectory.from_json": Call(vkc.Trajectory.from_json, lambda: {"path": files()["json"]}),
    "Trajectory.from_ros": Call(
        vkc.Trajectory.from_ros,
        lambda: {"message": _ROS(), "like": motion(), "robot_size": None},
        1.5,
    ),
    "Plan.load": Call(vkc.Plan.load, lambda: {"path": files()["npz"]}),
    "Plan.save": Call(_written(lambda path: saved().save(path)), lambda: {"path": "p.npz"}),
    "Plan.to_json": Call(_written(lambda path: saved().to_json(path)), lambda: {"path": "p.json"}),
    "Plan.to_csv": Call(
        _written(lambda path, **k: saved().to_csv(path, **k)),
        lambda: {"path": "p.csv", "joints": "all"},
    ),
    "Plan.to_ros": Call(_method(saved, "to_ros"), lambda: {"joints": ["base_x"], "rate": None}),
    "Plan.to_html": Call(
        _written(lambda path: saved().to_html(path)), lambda: {"path": "p.html"}, 0.2
    ),
    "Plan.plot": Call(_written(lambda path: saved().plot(path)), lambda: {"path": "p.svg"}, 0.2),
    "to_html": Call(
        lambda path, **k: to_html(path=folder() / "p.html", **k),
        lambda: {"path": None, "plan_or_scene": scene(), "frames": {"goal": pin.SE3.Identity()}},
        0.3,
    ),
    "show": Call(
        lambda **k: vkc.visualization.show(**{**k, "open_browser": False}),
        lambda: {"plan_or_scene": scene(), "open_browser": False, "height": 300, "frames": None},
        0.2,
    ),
    "animate": Call(vkc.visualization.animate, lambda: {"plan": saved(), "viewer": None}, 0.2),
    "plot_joints": Call(plot_joints, lambda: {"plan": saved()}, 0.2),
    "plot_clearance": Call(plot_clearance, lambda: {"plan": saved()}, 0.2),
    "plot_top_view": Call(plot_top_view, lambda: {"plan": saved()}, 0.2),
    "joint_placements": Call(joint_placements, lambda: {"model": scene().robot.model}, 0.5),
    "frame_placements": Call(
        frame_placements, lambda: {"model": scene().robot.model, "frames": ["tool0"]}
    ),
    "frame_jacobian": Call(
        frame_jacobian,
        lambda: {
            "model": scene().robot.model,
            "frame": "tool0",
            "reference": "local_world_aligned",
        },
    ),
    "rnea": Call(rnea, lambda: {"model": scene().robot.model}, 0.5),
    "center_of_mass": Call(center_of_mass, lambda: {"model": scene().robot.model}, 0.5),
}


def case(rng: random.Random) -> dict[str, Any]:
    """Return a case: a call, and which of its arguments is what."""
    names = list(CALLS)
    name = rng.choices(names, [CALLS[each].often for each in names])[0]
    parameters = list(CALLS[name].arguments())
    changes = []
    for parameter in rng.sample(parameters, min(len(parameters), rng.choice((1, 1, 1, 2)))):
        value = rng.choice(odd.USUAL if rng.random() < 0.5 else odd.VALUES)
        if (
            parameter == "callback" and value in odd.RAISING
        ):  # what a caller's own function raises is the caller's
            value = "None"
        changes.append([parameter, value, rng.randrange(8) if rng.random() < 0.4 else None])
    return {"call": name, "changes": changes}


def run(given: dict[str, Any]) -> str:
    """Make the call; return what came of it, or let its error through."""
    call = CALLS[given["call"]]
    arguments = call.arguments()
    for parameter, name, at in given["changes"]:
        value = odd.value(name)
        arguments[parameter] = value if at is None else odd.within(arguments[parameter], value, at)
    call.does(**arguments)
    return "done"
