"""Makes a scene of a running MuJoCo simulation: its compiled model and present state."""

from __future__ import annotations

import atexit
import dataclasses
import shutil
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.description import MOVING_KINDS, Description
from vkc_pin.importing.formats.mjcf import CompiledModel, read_compiled_model
from vkc_pin.importing.homes.splitting import Home, add_floor, split_home
from vkc_pin.importing.homes.writing import ImportedHomeObject, write_parts
from vkc_pin.importing.objects.clean_up import (
    compute_bounds,
    load_surfaces,
    move_root,
    rename_for_scenes,
)
from vkc_pin.importing.objects.object_reading import simplify_object
from vkc_pin.importing.scenes import locate_robot, round_interval, write_scene
from vkc_pin.importing.targets import check_target
from vkc_pin.options import Options
from vkc_pin.simulation.robot_in_model import (
    BASE,
    ModelJoints,
    RobotInModel,
    check_data,
    check_model,
    copy_positions,
)
from vkc_pin.utils.arguments import (
    check_bool,
    check_choice,
    check_instance,
    check_integer,
    check_number,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.words import clean_name
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.writing import write_folder_atomically
from vkc_pin.world.models.robot import Base, Robot
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.scene.scene import Scene, load_scene

_COMMAND = "scene_from_mujoco"
_LARGEST = 1e3  # [m] largest height of a floor
_AROUND = 2.0  # [m] of floor around the robot
# [rad] or [m] by which a joint's position may be outside its limits: those of MuJoCo are soft.
_SOFT_LIMIT = 0.05
_BASES = ("omni", "differential", "fixed")

Positions = Mapping[str, float]
"""Positions of joints by name, [rad] or [m]."""


def scene_from_mujoco(  # noqa: PLR0913 - keyword options of a public call
    model: Any,
    data: Any,
    *,
    robot: str | Path | Robot,
    joints: Mapping[str, str] | None = None,
    base: Base | None = None,
    robot_body: str | None = None,
    objects: Literal["auto"] | Sequence[str] = "auto",
    floor: float | None = None,
    folder: str | Path | None = None,
    force: bool = False,
    options: Options | None = None,
    most: int = 2,
) -> Scene:
    """Make a scene of a MuJoCo simulation as it is now.

    Bodies of the robot are replaced by `robot`, which starts as `data` has it. Other bodies with
    hinges and slides, and free bodies, become objects with proposed attachments, in their present
    state; all other geoms that collide become obstacles where they are. Nothing is changed in
    `model` and `data`.

    The robot's base is found by the axes of its joints, which have to be the model's: names of
    bodies and placements of links do not matter. Changes and omissions are warnings, and so are
    the reasons why a joint has no attachment.

    Args:
        model: The `mujoco.MjModel`.
        data: Its `mujoco.MjData`; positions are read, not quantities computed from them.
        robot: The robot: a name, the path of a URDF or robot.yaml, or a robot.
        joints: Coordinate of the robot → name of the model's joint, for names that differ.
            `base_x`, `base_y` and `base_yaw` are two slides and the hinge after them.
        base: Type of the base; defaults to that of a `Robot`, or else to "omni" if the model has
            joints for the base, and to "fixed" if not.
        robot_body: Body that carries the robot, and nothing else; defaults to the one below the
            world with the robot's joints.
        objects: Bodies or joints that become objects, with all that moves on these bodies; other
            joints are fixed where they are. "auto": all of them.
        floor: Height of the floor [m]; defaults to that of the model's highest horizontal plane,
            or 0 without one.
        folder: Folder of the scene's files, new or empty; defaults to a temporary one that is
            deleted when the process ends.
        force: Whether to replace a folder that an earlier call wrote.
        options: Options with the clearances of attachments.
        most: Largest number of attachments of one joint.

    Returns:
        The scene. Its heights are relative to the floor; objects have the names of their root
        bodies, and joints their own.

    Raises:
        InputError: MuJoCo is not installed, the model's robot is another one, a joint is outside
            its limits, the base is not upright, the folder holds other files, or an argument is
            invalid.
        UnknownNameError: The robot, a joint or an object is unknown.
    """
    mujoco = check_model(model)
    check_data(model, data)
    options = Options() if options is None else check_instance(options, Options, "options")
    check_integer(most, "most", low=1, high=100)
    model_joints = ModelJoints(model, joints)
    loaded_robot = _load_robot(robot, base, model_joints)
    found = RobotInModel(model, loaded_robot, model_joints, body=robot_body)
    _check_known(model_joints, loaded_robot)
    placed = copy_positions(model, data)
    mujoco.mj_kinematics(model, placed)
    height = _find_floor(mujoco, model, placed) if floor is None else floor
    height = check_number(height, "floor", "a height [m]", low=-_LARGEST, high=_LARGEST)
    pose, elevation = found.find_base(placed)

    compiled = read_compiled_model(model, data)
    positions = compiled.positions
    description = _remove_robot(compiled, found.root)
    description = _note_tendons(description, model, mujoco)
    description = _fix_joints(description, positions, _choose_joints(description, objects))
    description = simplify_object(description, free=True, positions=positions)
    names = {joint.name: joint.name for joint in description.joints.values()}
    renamed = rename_for_scenes(description)
    for old, new in zip(description.joints.values(), renamed.joints.values(), strict=True):
        names[new.name] = old.name
    description = move_root(renamed, pin.SE3(np.eye(3), np.array([0.0, 0.0, -height])))
    state = {new: positions.get(old, 0.0) for new, old in names.items()}

    target = _choose_folder(folder, force=check_bool(force, "force"))
    notes = list[str]()
    # `check_target` allowed replacing it.
    with write_folder_atomically(target, force=True) as staging:
        home = split_home(description)
        parts = write_parts(
            home, description.file, loaded_robot, staging, options=options, most=most
        )
        notes += [*home.notes, *parts.notes]
        for item in parts.objects:
            notes += [f"{item.name}: {note}" for note in item.notes]
            for joint, reason in item.proposals.because.items():
                notes.append(f"{item.name}: no hand can move {joint}: {reason}")
        arena = _find_arena(home, description, pose)
        document: dict[str, Any] = {
            "name": clean_name(description.file.name),
            "robot": _describe_robot(robot, loaded_robot),
            "start": {
                "base": pose.tolist(),
                "z": loaded_robot.height + elevation - height,
                "arm": found.read_arm(data.qpos),
            },
            "arena": arena,
            "obstacles": parts.obstacles,
            "objects": [_add_state(item, state, notes) for item in parts.objects],
        }
        write_scene(staging / "scene.yaml", description.file, document, _COMMAND)
    for note in dict.fromkeys(notes):
        warnings.warn(note, stacklevel=2)
    return load_scene(target / "scene.yaml")


def _load_robot(robot: str | Path | Robot, base: Base | None, joints: ModelJoints) -> Robot:
    """Return the robot, with a base that moves if the model has joints for it."""
    if base is not None:
        check_choice(base, _BASES, "base", "kind of base")
    if isinstance(robot, Robot):
        if base is not None and base != robot.base:
            problem = "the robot has another base"
            raise InputError(problem, field="base", expected=robot.base, got=base)
        return robot
    if base is None:
        has_base = any(joints.given.get(name, name) in joints for name in BASE)
        base = "omni" if has_base else "fixed"
    return load_robot(robot, base=base)


def _check_known(joints: ModelJoints, robot: Robot) -> None:
    """Check that `joints` names coordinates or fingers of the robot alone."""
    fingers = robot.gripper.names if robot.gripper is not None else ()
    followers = [str(robot.model.names[move.joint]) for move in robot.coordinates.followers]
    known = [*robot.coordinates.names, *followers, *fingers]
    for coordinate in joints.given:
        if coordinate not in known:
            kind = f"coordinate of robot '{robot.name}'"
            raise UnknownNameError(kind, coordinate, known, field="joints")


def _find_floor(mujoco: Any, model: Any, data: Any) -> float:
    """Return the height of the highest horizontal plane that faces upwards, or 0 [m]."""
    heights = list[float]()
    for geom in range(model.ngeom):
        is_plane = int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_PLANE)
        collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        faces_up = data.geom_xmat[geom][8] > 1.0 - 1e-6
        if is_plane and collides and faces_up:
            heights.append(float(data.geom_xpos[geom][2]))
    return max(heights, default=0.0)


def _remove_robot(compiled: CompiledModel, body: int) -> Description:
    """Return the description without the robot's bodies, with a note that names them.

    Args:
        compiled: The model.
        body: Number of the body that carries the robot.
    """
    description = compiled.description
    outermost = compiled.bodies[body]
    # A body with several joints has links between it and its parent.
    parent = description.joints[outermost].parent
    while parent not in compiled.bodies:
        outermost = parent
        parent = description.joints[outermost].parent
    gone = description.subtree(outermost)
    links = {name: link for name, link in description.links.items() if name not in gone}
    joints = {child: joint for child, joint in description.joints.items() if child not in gone}
    solid = [name for name in description.links if name in gone and description.links[name].solid]
    listed = ", ".join(solid) or "none with shapes"
    note = f"bodies of the robot, which its own shapes replace: {listed}"
    return description.keep(links, joints).add_notes(note)


def _note_tendons(description: Description, model: Any, mujoco: Any) -> Description:
    """Return the description with a note about each tendon on a joint, and flexible bodies."""
    notes = list[str]()
    names = {joint.name for joint in description.joints.values()}
    for tendon in range(model.ntendon):
        first = int(model.tendon_adr[tendon])
        held = list[str]()
        for wrap in range(first, first + int(model.tendon_num[tendon])):
            if int(model.wrap_type[wrap]) != int(mujoco.mjtWrap.mjWRAP_JOINT):
                continue
            joint = int(model.wrap_objid[wrap])
            name = str(model.joint(joint).name) or f"joint_{joint}"
            if name in names:
                held.append(f"'{name}'")
        title = str(model.tendon(tendon).name) or f"number {tendon}"
        if held:
            notes.append(f"tendon '{title}' couples joints {', '.join(held)}: made independent")
    if model.nflex:
        notes.append(f"{model.nflex} flexible bodies (flex): left out")
    return description.add_notes(*notes)


def _choose_joints(description: Description, objects: Literal["auto"] | Sequence[str]) -> set[str]:
    """Return the children of the joints that stay movable.

    Raises:
        InputError: A name is that of nothing that moves.
        UnknownNameError: There is no body or joint of this name.
    """
    kinds = (*MOVING_KINDS, "floating")
    movable = {child for child, joint in description.joints.items() if joint.kind in kinds}
    if isinstance(objects, str):
        check_choice(objects, ("auto",), "objects", "choice of objects, which is a list of names")
        return movable
    chosen = set[str]()
    by_joint = {joint.name: child for child, joint in description.joints.items()}
    for name in objects:
        if name not in description.links and name not in by_joint:
            known = [*description.links, *(description.joints[child].name for child in movable)]
            raise UnknownNameError("body or joint of the model", name, known, field="objects")
        moved = {by_joint[name]} if name in by_joint else description.subtree(name)
        if not moved & movable:
            problem = f"'{name}' does not move, nor does anything on it"
            raise InputError(problem, field="objects", expected="a body or joint that moves")
        chosen |= moved & movable
    return chosen


def _fix_joints(description: Description, positions: Positions, movable: set[str]) -> Description:
    """Return the description with all but the chosen joints fixed where they are.

    Joints of free bodies are fixed, too: free objects are rigid.
    """
    joints = dict(description.joints)
    fixed = list[str]()
    notes = list[str]()
    for child, joint in description.joints.items():
        carriers = list(description.walk_up(child))[1:]
        is_on_free = any(
            link in description.joints and description.joints[link].kind == "floating"
            for link in carriers
        )
        if joint.kind == "floating" and child not in movable:
            joints[child] = dataclasses.replace(joint, kind="fixed")
            fixed.append(joint.name)
        elif joint.kind in MOVING_KINDS and (child not in movable or is_on_free):
            joints[child] = joint.fix(positions.get(joint.name, 0.0))
            if is_on_free and child in movable:
                notes.append(f"joint '{joint.name}' belongs to a free object: fixed")
            else:
                fixed.append(joint.name)
    if fixed:
        notes.append(f"not among `objects`, hence fixed where they are: {', '.join(fixed)}")
    return dataclasses.replace(description, joints=joints).add_notes(*notes)


def _find_arena(home: Home, description: Description, pose: Floats) -> dict[str, list[float]]:
    """Return the intervals of the scene's arena: all shapes, and the floor around the robot."""
    low = np.array([*pose[:2], 0.0]) - _AROUND
    high = np.array([*pose[:2], 0.0]) + _AROUND
    if any(link.solid for link in description.links.values()):
        bounds = compute_bounds(description, load_surfaces(description))
        floor_low, floor_high = add_floor(home, *bounds)
        low = np.minimum(low, floor_low)
        high = np.maximum(high, floor_high)
    return {"x": round_interval(low[0], high[0]), "y": round_interval(low[1], high[1])}


def _describe_robot(robot: str | Path | Robot, loaded: Robot) -> dict[str, Any]:
    """Return the scene's entry of the robot."""
    entry: dict[str, Any] = {"name": locate_robot(robot), "base": loaded.base}
    if isinstance(robot, Robot):
        entry["tool_frame"] = robot.tool_frame
        if robot.base == "ackermann":
            entry["turning_radius"] = robot.turning_radius
    return entry


def _add_state(item: ImportedHomeObject, state: Positions, notes: list[str]) -> dict[str, Any]:
    """Return the entry of an object in its present state, within its limits.

    Raises:
        InputError: A joint is farther outside its limits than those of MuJoCo yield.
    """
    if item.free:
        return item.entry
    owner = item.proposals.object
    values = dict[str, float]()
    limits = zip(owner.coordinates.names, owner.lower, owner.upper, strict=True)
    for name, low, high in limits:
        value = state.get(name, 0.0)
        inside = float(np.clip(value, low, high))
        if abs(inside - value) > _SOFT_LIMIT:
            raise InputError(
                f"joint '{name}' of object '{item.name}' is outside its limits",
                field="data",
                expected=f"a position from {low:g} to {high:g}",
                got=value,
            )
        if inside != value:
            notes.append(f"joint '{name}' is at {value:.6g}, beyond its limit {inside:.6g}")
        values[name] = inside
    return {**item.entry, "state": values}


def _choose_folder(folder: str | Path | None, *, force: bool) -> Path:
    """Return the folder of the scene, by default a new one that this process deletes at its end."""
    if folder is None:
        parent = Path(tempfile.mkdtemp(prefix="vkc_pin_"))
        atexit.register(shutil.rmtree, parent, ignore_errors=True)
        return parent / "scene"
    target = check_path(folder, "folder", "a folder")
    check_target(target, _COMMAND, force=force)
    return target
