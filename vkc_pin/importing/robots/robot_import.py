"""Imports a robot from a file as a folder with robot.yaml, URDF, SRDF and meshes."""

from __future__ import annotations

import dataclasses
import os
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import yaml

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.formats.reading import FORMATS
from vkc_pin.importing.pictures import plot_robot
from vkc_pin.importing.robots.arms import (
    Arm,
    Body,
    build_body_tree,
    choose_arm,
    find_arms,
    find_own_base,
    find_telescopes,
)
from vkc_pin.importing.robots.doctor import Diagnosis, Finding, doctor
from vkc_pin.importing.robots.hand_checks import (
    find_envelopes,
    remove_collision_shapes,
    should_reverse_tool,
)
from vkc_pin.importing.robots.hands import Hand, analyze_hand
from vkc_pin.importing.robots.mesh_pieces import Piece, write_meshes
from vkc_pin.importing.robots.rest_configuration import (
    HOME_ROOM,
    Home,
    find_arm_positions,
    find_home,
    find_inseparable_pairs,
    find_nested_pairs,
    find_sunken_links,
    measure_floor_heights,
)
from vkc_pin.importing.robots.sources import Source, choose_free_name, read_source
from vkc_pin.importing.scenes import make_robot_scene, write_scene
from vkc_pin.importing.targets import (
    check_source,
    check_target,
    format_comment,
    get_origin_marker,
)
from vkc_pin.importing.urdf_writing import add_connection
from vkc_pin.options import Options
from vkc_pin.utils.arguments import check_bool, check_integer, check_text
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.words import split_words
from vkc_pin.world.files.resources import check_path, choose_file_names
from vkc_pin.world.files.srdf import format_srdf
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.files.writing import write_folder_atomically
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.models.robot_model import build_full_model
from vkc_pin.world.models.self_collisions import sample_allowed_pairs, set_collision_pairs
from vkc_pin.world.models.wheels import Drive, describe_misplaced_axle, find_drive, is_on_axle

PICTURE = "robot.png"
"""File name of a robot's picture."""
_SAMPLES = 2000
_NEIGHBOUR_SAMPLES = 300  # random configurations in which neighbours are searched for
_MOSTLY = 0.75  # smallest fraction of them in which neighbours are close
# [m] distance up to which links are neighbours by design, such as the segments of a telescope
_NEIGHBOURS = Options().dist_safe + 0.005
_CLOSED = 0.01  # [m] opening below which fingers that do not move can grasp nothing
_FINGERS = "in robot.yaml: `gripper: {FINGER_JOINT: {closed: POSITION, open: POSITION}}`"
# Joints after which links belong to an arm or its hand; a chain of one more is an arm.
_AT_END = 3
_STANDING = 0.005  # [m] height up to which a root stands on the floor
_MOTION_MODELS = {"holonomic": "omni", "diff_drive": "differential"}
"""Motion model of an SRDF's planar joint → kind of base."""
_NO_WHEELS = "no wheels: an omnidirectional base is assumed; use `fixed` for an arm on a table"


@dataclass(frozen=True, eq=False)
class ImportedRobot:
    """An imported robot.

    Attributes:
        folder: Output folder, for `load_robot`; its scene.yaml is for `load_scene`.
        robot: The robot.
        arms: Names of all arms, the chosen one first.
        pieces: Decompositions of the collision meshes.
        diagnosis: Assumptions, and findings of `doctor`.
    """

    folder: Path
    robot: Robot
    arms: tuple[str, ...]
    pieces: tuple[Piece, ...]
    diagnosis: Diagnosis

    def __str__(self) -> str:
        return f"{self.diagnosis}\nwrote {self.folder}\nwrote {self.folder / PICTURE}"


def import_robot(  # noqa: PLR0913 - keyword options of a public call
    file: str | Path,
    folder: str | Path | None = None,
    *,
    arm: str | None = None,
    tool_frame: str | None = None,
    srdf: str | Path | None = None,
    packages: Mapping[str, str | Path] | None = None,
    arguments: Mapping[str, str] | None = None,
    most_pieces: int | None = None,
    samples: int = _SAMPLES,
    seed: int = 0,
    force: bool = False,
) -> ImportedRobot:
    """Import a robot from a URDF, xacro, MJCF, SDF or USD file.

    The output folder holds robot.yaml, a URDF with a frame `tool` where the hand grasps, an SRDF
    with sampled pairs that need no check, and meshes, with convex pieces for collision; scene.yaml,
    a scene with the robot alone; and robot.png, a picture of it at home. Missing
    information is guessed from names and shapes, and reported.

    Args:
        file: The file; its first element tells its format.
        folder: Output folder, new or empty; defaults to one named like the file in the current
            folder.
        arm: The arm to plan for: a name of `ImportedRobot.arms`, a part of one ("left"), or an SRDF
            group with its joints.
        tool_frame: Tool frame, if it is not to be guessed: z is the direction of approach, x the
            closing direction.
        srdf: An SRDF; defaults to the one beside the file.
        packages: Folders for `package://` and `$(find ...)`; others are searched for around the
            file.
        arguments: Arguments of a xacro file.
        most_pieces: Largest number of convex pieces of a mesh; 1 keeps hulls. Defaults to 12, and
            to 48 where fewer would fill a cavity.
        samples: Number of configurations for finding pairs that need no check.
        seed: Random seed.
        force: Whether to replace a folder that an earlier import wrote.

    Raises:
        InputError: The file cannot be read, no arm is found, the folder holds other files, or the
            extra `import` is missing.
        UnknownNameError: The arm or frame is unknown; the error names the nearest one.
    """
    path = check_path(file, "file", f"a {FORMATS} file")
    (name,) = choose_file_names([path.name.split(".")[0]], fallback="robot")
    target = Path(name) if folder is None else check_path(folder, "folder", "a folder")
    for field, given in (("arm", arm), ("tool_frame", tool_frame)):
        if given is not None:
            check_text(given, field, "a name")
    if most_pieces is not None:
        check_integer(most_pieces, "most_pieces", low=1, high=1000)
    check_integer(samples, "samples", low=1, high=1_000_000)
    srdf_path = None if srdf is None else check_path(srdf, "srdf")
    check_source(path, f"a {FORMATS} file")
    check_target(target, "import-robot", force=check_bool(force, "force"))
    # `check_target` allowed replacing it
    with write_folder_atomically(target, force=True, source=path) as staging:
        source = read_source(
            path, staging / ".meshes", packages=packages, arguments=arguments, srdf=srdf_path
        )
        importer = _Importer(source, staging, Path(os.path.realpath(target)).name)
        with warnings.catch_warnings():
            # They name temporary files, and loading the folder repeats them.
            warnings.simplefilter("ignore")
            imported = importer.run(arm, tool_frame, most_pieces, samples, seed)
    return dataclasses.replace(imported, folder=target, robot=load_robot(target / "robot.yaml"))


class _Importer:
    def __init__(self, source: Source, folder: Path, name: str) -> None:
        self._source = source
        self._file = source.file
        self._folder = folder
        self._name = name
        (stem,) = choose_file_names([name], fallback="robot")
        self._settings: dict[str, Any] = {"urdf": f"{stem}.urdf", "srdf": f"{stem}.srdf"}
        self._base = "omni"
        self._drive: Drive | None = None
        self._group: str | None = None
        self._findings = [Finding("warning", "shapes", text) for text in source.warnings]
        self._findings += [Finding("note", "file", text) for text in source.notes]

    def run(
        self,
        arm: str | None,
        tool_frame: str | None,
        most_pieces: int | None,
        samples: int,
        seed: int,
    ) -> ImportedRobot:
        """Write all files into the folder."""
        names = self._get_names()
        if tool_frame is not None and tool_frame not in names:
            raise UnknownNameError(
                "frame", tool_frame, sorted(names), file=self._file.path, field="tool_frame"
            )
        tree = build_body_tree(self._file)
        self._use_visual_shapes(tree)
        solid = {shape.link for shape in self._file.read_shapes("collision")}
        base_joints = find_own_base(self._file, tree, solid)
        groups = self._source.srdf.groups
        arms = find_arms(self._file, tree, groups, solid)
        chosen = None
        if arms or arm in groups or tool_frame is None:
            chosen = choose_arm(arms, arm, self._file, tree, groups, solid)
            self._group = arm if arm in groups else None
        self._set_arm(chosen, arms, base_joints)
        root, pieces, notes = write_meshes(self._file, self._folder, most_pieces=most_pieces)
        self._findings += [Finding("warning", "shapes", note) for note in notes]
        text = ElementTree.tostring(root, encoding="unicode")
        self._file = UrdfFile(self._folder / self._settings["urdf"], text, root)
        hand = None
        if chosen is not None:
            full = build_full_model(self._file)
            hand = analyze_hand(self._file, full, chosen, self._source.linkages)
            self._set_hand(hand, tool_frame)
        if tool_frame is not None:
            self._settings["tool_frame"] = tool_frame
        robot = self._write_and_load()
        robot = self._remove_envelopes(robot)
        robot = self._remove_columns(robot)
        robot = self._place_root(robot, seed)
        home = self._find_home(robot, samples, seed)
        self._report_home(home)
        self._report_pieces(pieces)
        robot = load_robot(self._folder / "robot.yaml")
        if hand is not None and tool_frame is None:
            robot = self._turn_tool(robot, hand, seed)
        return self._make_result(robot, arms, chosen, pieces)

    def _make_result(
        self, robot: Robot, arms: list[Arm], chosen: Arm | None, pieces: list[Piece]
    ) -> ImportedRobot:
        scene = make_robot_scene(self._name, "robot.yaml", self._base)
        write_scene(self._folder / "scene.yaml", self._source.file.path, scene, "import-robot")
        plot_robot(robot, self._folder / PICTURE)
        findings = (*doctor(robot).findings, *self._findings)
        others = [arm.name for arm in arms if arm is not chosen]
        names = () if chosen is None else (chosen.name, *others)
        diagnosis = Diagnosis(self._name, findings)
        return ImportedRobot(self._folder, robot, names, tuple(pieces), diagnosis)

    def _use_visual_shapes(self, tree: Body) -> None:
        """Use visual shapes for collision where the file has none: everywhere, or on an arm."""
        solid = {shape.link for shape in self._file.read_shapes("collision")}
        links = set[str]()
        for body in tree.subtree():
            joints_above = sum(part.is_planned for part in body.path())
            is_on_arm = joints_above >= _AT_END or joints_above + body.depth() > _AT_END
            if not solid or (is_on_arm and not solid & set(body.links)):
                links |= set(body.links)
        used = dict[str, None]()  # an ordered set
        for link in self._file.root.findall("link"):
            name = link.get("name", "")
            if name not in links:
                continue
            for visual in link.findall("visual"):
                element = ElementTree.SubElement(link, "collision")
                element.extend(child for child in visual if child.tag in ("origin", "geometry"))
                used[name] = None
        if not solid and not used:
            raise InputError(
                "the robot has no shapes",
                file=self._file.path,
                expected="<collision> or <visual> elements",
            )
        if used:
            which = ", ".join(used) if solid else "all links"
            self._guess("guess", f"visual shapes are used for want of collision shapes: {which}")

    def _guess(self, sure: str, text: str, hint: str = "") -> None:
        """Report an assumption with its confidence, "sure", "likely" or "guess"."""
        level = "warning" if sure == "guess" else "note"
        self._findings.append(Finding(level, "guessed", f"{text} [{sure}]", hint))

    def _update_setting(self, key: str, values: Mapping[str, Any]) -> None:
        """Add values to a mapping in robot.yaml."""
        self._settings.setdefault(key, {}).update(values)

    def _set_arm(self, chosen: Arm | None, arms: list[Arm], base_joints: tuple[str, ...]) -> None:
        if base_joints:
            self._update_setting("locked_joints", dict.fromkeys(base_joints, 0.0))
            text = "the planner's base replaces that of the file"
            self._guess("sure", f"{text}: {', '.join(base_joints)} are locked")
        carrying = base_joints if chosen is None else (*base_joints, *chosen.joints)
        full = build_full_model(self._file)
        self._drive = find_drive(full, self._file, carrying)
        self._set_base(self._drive)
        if chosen is None:
            return
        for leader, *followers in find_telescopes(full, chosen.joints):
            self._update_setting("couplings", dict.fromkeys(followers, leader))
            text = f"{', '.join(followers)} follow {leader} as a telescope: one coordinate"
            hint = "if each has a motor of its own: remove `couplings` from robot.yaml"
            self._guess("likely", text, hint)
        text = f"arm: {chosen.name}, {chosen.why}"
        hint = ""
        others = [other.name for other in arms if other is not chosen]
        if others:
            text += f"; others: {', '.join(others)}"
            hint = "to choose another: arm, --arm"
        self._guess(chosen.sure, text, hint)

    def _set_base(self, drive: Drive | None) -> None:
        hint = "if it is wrong: `base` in scene.yaml and other scenes"
        planar = self._source.srdf.planar_joint
        if planar is not None and (planar.motion_model or drive is None):
            # Without a motion model MoveIt takes the joint for holonomic; wheels may say more.
            model = planar.motion_model or "holonomic"
            why = f"planar joint {planar.name} of the SRDF"
            if model not in _MOTION_MODELS:
                why += f" with an unknown motion model '{model}'"
            self._base = _MOTION_MODELS.get(model, "omni")
            sure = "sure" if model in _MOTION_MODELS else "guess"
            self._guess(sure, f"base: {self._base} ({why})", hint)
            return
        if drive is None:
            self._base = "omni"
            self._guess("guess", f"base: {self._base} ({_NO_WHEELS})", hint)
            return
        self._base = drive.kind
        why = drive.why
        if drive.turning_radius is not None:
            radius = round(drive.turning_radius, 3)
            self._settings["base"] = {"turning_radius": radius}
            why += f", turning radius {radius:g} m"
        self._guess("likely", f"base: {self._base} ({why})", hint)

    def _set_hand(self, hand: Hand, tool_frame: str | None) -> None:
        known = set(self._file.links)
        self._settings["touch_links"] = [link for link in hand.touch_links if link in known]
        for key, values in hand.settings().items():
            self._update_setting(key, values)
        if hand.open and not hand.closed:
            self._report_locked_fingers(hand)
        if tool_frame is None:
            tool = choose_free_name("tool", self._get_names())
            self._add_link(tool, hand.link, hand.tool)
            self._settings["tool_frame"] = tool
            hint = (
                "if it is wrong: `tool_frame`, a link with z along the approach and x along the "
                "closing direction"
            )
            self._guess(hand.sure, f"hand: frame '{tool}' {hand.why}", hint)

    def _turn_tool(self, robot: Robot, hand: Hand, seed: int) -> Robot:
        """Return the robot with its closing direction reversed if its wrist then can do more."""
        if not should_reverse_tool(robot, seed=seed):
            return robot
        for kind, name in (("link", robot.tool_frame), ("joint", f"{robot.tool_frame}_joint")):
            (element,) = self._file.root.findall(f"{kind}[@name='{name}']")
            self._file.root.remove(element)
        half_turn = pin.SE3(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        self._add_link(robot.tool_frame, hand.link, hand.tool * half_turn)
        self._write()
        return load_robot(self._folder / "robot.yaml")

    def _report_locked_fingers(self, hand: Hand) -> None:
        """Report that the gripper does not move, a fault if its fingers are closed."""
        fixed = list[str]()
        for joint in self._file.root.findall("joint"):
            name = joint.get("name", "")
            limit = joint.find("limit")
            if name in hand.open and limit is not None:
                low = limit.get("lower", "0")
                high = limit.get("upper", "0")
                if low == high:
                    fixed.append(f"{name} {low} to {high}")
        text = f"the gripper does not move: its fingers stay {1e3 * hand.opening:.0f} mm apart"
        hint = _FINGERS
        if fixed:
            text += f"; limits in the file: {', '.join(fixed)}"
            hint = (
                "widen these limits in a copy of the file, to ±0.6 rad or ±40 mm say, and import it"
            )
        level = "fault" if hand.opening < _CLOSED else "warning"
        self._findings.append(Finding(level, "hand", text, hint))

    def _write_and_load(self) -> Robot:
        """Write the files and return the robot."""
        self._write()
        try:
            return load_robot(self._folder / "robot.yaml", pairs="all")
        except InputError as error:
            if not str(error.field).startswith("gripper"):
                raise
            fingers = self._settings.pop("gripper")
            opened = {joint: ends["open"] for joint, ends in fingers.items()}
            self._update_setting("locked_joints", opened)
            text = f"the fingers are locked: {error.problem}, {error.got}"
            self._guess("guess", text, _FINGERS)
            return self._write_and_load()

    def _get_names(self) -> set[str]:
        """Return the names of all links and joints."""
        root = self._file.root
        elements = [*root.findall("link"), *root.findall("joint")]
        return {element.get("name", "") for element in elements}

    def _add_link(self, name: str, parent: str, placement: pin.SE3) -> None:
        root = self._file.root
        ElementTree.SubElement(root, "link", name=name)
        add_connection(root, f"{name}_joint", "fixed", parent, name, placement)

    def _write(self) -> None:
        settings = dict(self._settings)
        # The SRDF is written last.
        if not (self._folder / settings["srdf"]).is_file():
            del settings["srdf"]
        ElementTree.indent(self._file.root)
        file = self._source.file.path.name
        marker = get_origin_marker("import-robot")
        source = f"{file} ({self._source.kind}) {marker}"
        head = format_comment(f"Made of {source}. Units: m, rad, s.")
        body = yaml.safe_dump(settings, sort_keys=False, default_flow_style=None, width=120)
        (self._folder / "robot.yaml").write_text(head + body, encoding="utf-8")
        tree = ElementTree.ElementTree(self._file.root)
        tree.write(self._file.path, encoding="utf-8", xml_declaration=True)

    def _remove_envelopes(self, robot: Robot) -> Robot:
        """Return the robot without shapes that merely enclose its hand."""
        envelopes = find_envelopes(robot)
        if not envelopes:
            return robot
        remove_collision_shapes(self._file.root, envelopes)
        touch_links = self._settings.get("touch_links", ())
        self._settings["touch_links"] = [link for link in touch_links if link not in envelopes]
        for link, share in envelopes.items():
            text = f"{link} encloses {share:.0%} of the hand: left out"
            self._findings.append(Finding("warning", "hand", text))
        return self._write_and_load()

    def _remove_columns(self, robot: Robot) -> Robot:
        """Return the robot without shapes that its lift sinks into the floor."""
        columns = find_sunken_links(robot)
        if not columns:
            return robot
        remove_collision_shapes(self._file.root, columns)
        for link in columns:
            text = f"the lift sinks {link} into the floor: its collision shapes are left out"
            hint = "nothing keeps this column off obstacles"
            self._findings.append(Finding("warning", "shapes", text, hint))
        return self._write_and_load()

    def _place_root(self, robot: Robot, seed: int) -> Robot:
        """Return the robot with its root on the floor, and on the axle of wheels.

        The arm is clear of the floor, and x is the direction in which the wheels roll.
        """
        low, reachable = measure_floor_heights(robot, seed=seed)
        why = "it stands on its lowest point"
        footprint = _find_footprint(robot)
        if footprint is not None:
            name, low = footprint
            why = f"{name} is on the floor"
        lift = -low if abs(low) > _STANDING else 0.0
        raised = max(0.0, HOME_ROOM - reachable - lift)
        height = round(lift + raised, 6)
        drive = self._drive
        is_beside = drive is not None and not is_on_axle(drive)
        if height == 0.0 and not is_beside:
            return robot
        place = np.array([0.0, 0.0, -height])  # of the new root in the old one
        turn = np.eye(3)
        if drive is not None and is_beside:
            place[:2] = drive.center
            turn = pin.rpy.rpyToMatrix(0.0, 0.0, drive.yaw)
        floor = choose_free_name("floor", self._get_names())
        root = build_body_tree(self._file).links[0]
        self._file.root.insert(0, ElementTree.Element("link", name=floor))
        moved = pin.SE3(turn, place).inverse()
        add_connection(self._file.root, f"{floor}_joint", "fixed", floor, root, moved)
        if raised:
            why = f"{1e3 * raised:.0f} mm of it keep all links of the arm clear of the floor"
        if height:
            text = f"{root} is {height:.3f} m above the floor, the new root '{floor}': {why}"
            self._guess("likely", text)
        if drive is not None and is_beside:
            text = f"{describe_misplaced_axle(drive)}: the new root '{floor}' is there, "
            self._guess("likely", f"{text}with x in the direction in which they roll")
        return self._write_and_load()

    def _find_home(self, robot: Robot, samples: int, seed: int) -> Home:
        """Write the SRDF and home of a robot that is loaded with all pairs; return the home."""
        allowed = self._find_allowed_pairs(robot, samples, seed)
        arm = robot.coordinates.names[3:]
        candidates = list[tuple[str, Floats]]()
        for name, state in self._source.srdf.find_states(arm, self._group).items():
            if set(arm) <= set(state):
                how = f"the state '{name}' of the file"
                candidates.append((how, find_arm_positions(robot, state)))
        candidates.append(("joints at 0 or mid-range", robot.home))
        home = find_home(set_collision_pairs(robot, allowed), candidates, seed=seed)
        positions = dict(zip(arm, map(float, home.positions), strict=True))
        self._settings["home"] = {joint: round(value, 6) for joint, value in positions.items()}
        text = format_srdf(self._name, positions, dict(sorted(allowed.items())))
        (self._folder / self._settings["srdf"]).write_text(text, encoding="utf-8")
        self._write()
        return home

    def _find_allowed_pairs(
        self, robot: Robot, samples: int, seed: int
    ) -> dict[tuple[str, str], str]:
        """Return pairs of links that are not checked, with the reason, and note neighbours."""
        allowed = dict(self._source.srdf.allowed)
        allowed |= sample_allowed_pairs(robot, samples=samples, seed=seed)
        inseparable = find_inseparable_pairs(
            set_collision_pairs(robot, allowed),
            _NEIGHBOURS,
            samples=_NEIGHBOUR_SAMPLES,
            share=_MOSTLY,
            seed=seed,
        )
        for one, other in inseparable:
            about = f"{one} and {other} are rarely {1e3 * _NEIGHBOURS:.0f} mm apart"
            self._findings.append(Finding("note", "pairs", f"{about}: the pair is not checked"))
            allowed[min(one, other), max(one, other)] = "Near"
        for one, other in find_nested_pairs(set_collision_pairs(robot, allowed), _NEIGHBOURS):
            about = f"{one} and {other} are parts of a telescope"
            self._findings.append(Finding("note", "pairs", f"{about}: the pair is not checked"))
            allowed[one, other] = "Near"
        return allowed

    def _report_home(self, home: Home) -> None:
        values = ", ".join(f"{value:.2f}" for value in home.positions)
        sure = "sure" if home.clearance > 0.0 else "guess"
        self._guess(sure, f"home: {home.how} ({values}), clearance {1e3 * home.clearance:.0f} mm")

    def _report_pieces(self, pieces: list[Piece]) -> None:
        """Note the meshes of several pieces, each once."""
        by_mesh = {piece.mesh: piece for piece in pieces if piece.count > 1}
        for piece in by_mesh.values():
            volume = f"{100.0 * piece.overhead:.0f} % more than its volume"
            hull = f"its hull: {100.0 * piece.hull:.0f} %"
            protrusion = f"protruding by {1e3 * piece.error:.0f} mm"
            about = f"{piece.mesh} in {piece.count} pieces, {volume} ({hull}), {protrusion}"
            self._findings.append(Finding("note", "shapes", f"{piece.link}: {about}"))


def _find_footprint(robot: Robot) -> tuple[str, float] | None:
    """Return the link of the base that is on the floor by its name, and its height [m], or None.

    A base_footprint is the point of a robot on the floor (REP 120 of ROS).
    """
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, pin.neutral(robot.model))
    for frame, place in zip(robot.model.frames, data.oMf, strict=True):
        is_link = frame.type == pin.FrameType.BODY and frame.parentJoint == 1
        if is_link and "footprint" in split_words(frame.name):
            return frame.name, float(place.translation[2])
    return None
