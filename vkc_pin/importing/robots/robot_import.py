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
from vkc_pin.utils.arguments import check_bool, check_integer, check_mapping, check_text
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
# Samples, and the smallest fraction of them in which a pair of neighbours is close
_NEAR, _MOSTLY = 300, 0.75
# [m] Distance up to which links are neighbours by design, such as the segments of a telescope
_NEIGHBOURS = Options().dist_safe + 0.005
_CLOSED = 0.01  # [m] opening below which fingers that do not move can grasp nothing
_FINGERS = "in robot.yaml: `gripper: {FINGER_JOINT: {closed: POSITION, open: POSITION}}`"
# Joints after which links belong to an arm or its hand; a chain of one more is an arm.
_AT_END = 3
_STANDING = 0.005  # [m] height up to which a root stands on the floor
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
    """Import a robot from a URDF, xacro, MJCF or SDF file.

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
    path = check_path(file, "file", "a URDF, xacro, MJCF or SDF file")
    (name,) = choose_file_names([path.name.split(".")[0]], fallback="robot")
    target = Path(name) if folder is None else check_path(folder, "folder", "a folder")
    for field, given in (("arm", arm), ("tool_frame", tool_frame)):
        if given is not None:
            check_text(given, field, "a name")
    if most_pieces is not None:
        check_integer(most_pieces, "most_pieces", low=1, high=1000)
    check_integer(samples, "samples", low=1, high=1_000_000)
    places = {
        key: check_path(place, f"packages.{key}")
        for key, place in check_mapping(packages or {}, "packages").items()
    }
    given_arguments = {
        key: str(value) for key, value in check_mapping(arguments or {}, "arguments").items()
    }
    srdf_path = None if srdf is None else check_path(srdf, "srdf")
    check_source(path, "a URDF, xacro, MJCF or SDF file")
    check_target(target, "import-robot", force=check_bool(force, "force"))
    # `check_target` allowed replacing it
    with write_folder_atomically(target, force=True, source=path) as staging:
        source = read_source(
            path, staging / ".meshes", packages=places, arguments=given_arguments, srdf=srdf_path
        )
        with warnings.catch_warnings():
            # They name temporary files, and loading the folder repeats them.
            warnings.simplefilter("ignore")
            imported = _Importer(source, staging, Path(os.path.realpath(target)).name).run(
                arm, tool_frame, most_pieces, samples, seed
            )
    return dataclasses.replace(imported, folder=target, robot=load_robot(target / "robot.yaml"))


class _Importer:
    def __init__(self, source: Source, folder: Path, name: str) -> None:
        self._source, self._file, self._folder, self._name = source, source.file, folder, name
        (stem,) = choose_file_names([name], fallback="robot")
        self._settings: dict[str, Any] = {"urdf": f"{stem}.urdf", "srdf": f"{stem}.srdf"}
        self._base = "omni"
        self._drive: Drive | None = None
        self._group: str | None = None
        self._findings = [
            *(Finding("warning", "shapes", text) for text in source.warnings),
            *(Finding("note", "file", text) for text in source.notes),
        ]

    def run(
        self,
        arm: str | None,
        tool_frame: str | None,
        most_pieces: int | None,
        samples: int,
        seed: int,
    ) -> ImportedRobot:
        """Write all files into the folder."""
        if tool_frame is not None and tool_frame not in (names := sorted(self._get_names())):
            raise UnknownNameError(
                "frame", tool_frame, names, file=self._file.path, field="tool_frame"
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
        robot = self._remove_columns(self._remove_envelopes(self._write_and_load()))
        robot = self._place_root(robot, seed)
        self._report(pieces, self._find_home(robot, samples, seed))
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
        used = list[str]()
        for link in self._file.root.findall("link"):
            for visual in link.findall("visual") if link.get("name") in links else ():
                element = ElementTree.SubElement(link, "collision")
                element.extend(child for child in visual if child.tag in ("origin", "geometry"))
                used.append(link.get("name", ""))
        if not solid and not used:
            raise InputError(
                "the robot has no shapes",
                file=self._file.path,
                expected="<collision> or <visual> elements",
            )
        if used:
            which = ", ".join(dict.fromkeys(used)) if solid else "all links"
            self._guess("guess", f"visual shapes are used for want of collision shapes: {which}")

    def _guess(self, sure: str, text: str, hint: str = "") -> None:
        self._findings.append(
            Finding("warning" if sure == "guess" else "note", "guessed", f"{text} [{sure}]", hint)
        )

    def _set_arm(self, chosen: Arm | None, arms: list[Arm], base_joints: tuple[str, ...]) -> None:
        if base_joints:
            self._settings.setdefault("locked_joints", {}).update(dict.fromkeys(base_joints, 0.0))
            self._guess(
                "sure",
                "the planner's base replaces that of the file: "
                f"{', '.join(base_joints)} are locked",
            )
        carrying = base_joints if chosen is None else (*base_joints, *chosen.joints)
        self._drive = find_drive(build_full_model(self._file), self._file, carrying)
        self._set_base(self._drive)
        if chosen is not None:
            for leader, *others in find_telescopes(build_full_model(self._file), chosen.joints):
                self._settings.setdefault("couplings", {}).update(dict.fromkeys(others, leader))
                text = f"{', '.join(others)} follow {leader} as a telescope: one coordinate"
                self._guess(
                    "likely",
                    text,
                    "if each has a motor of its own: remove `couplings` from robot.yaml",
                )
            others = [other.name for other in arms if other is not chosen]
            also = f"; others: {', '.join(others)}" if others else ""
            self._guess(
                chosen.sure,
                f"arm: {chosen.name}, {chosen.why}{also}",
                "to choose another: arm, --arm" if others else "",
            )

    def _set_base(self, drive: Drive | None) -> None:
        self._base, why, sure = "omni", _NO_WHEELS, "guess"
        if drive is not None:
            self._base, why, sure = drive.kind, drive.why, "likely"
            if drive.turning_radius is not None:
                radius = round(drive.turning_radius, 3)
                self._settings["base"] = {"turning_radius": radius}
                why += f", turning radius {radius:g} m"
        self._guess(
            sure,
            f"base: {self._base} ({why})",
            "if it is wrong: `base` in scene.yaml and other scenes",
        )

    def _set_hand(self, hand: Hand, tool_frame: str | None) -> None:
        links = [link for link in hand.touch_links if link in set(self._file.links)]
        self._settings["touch_links"] = links
        for key, values in hand.settings().items():
            self._settings.setdefault(key, {}).update(values)
        if hand.open and not hand.closed:
            self._report_locked_fingers(hand)
        if tool_frame is None:
            tool = choose_free_name("tool", self._get_names())
            self._add_link(tool, hand.link, hand.tool)
            self._settings["tool_frame"] = tool
            self._guess(
                hand.sure,
                f"hand: frame '{tool}' {hand.why}",
                "if it is wrong: `tool_frame`, a link with z along the approach and x along the "
                "closing direction",
            )

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
        limits = {
            name: tuple(limit.get(key, "0") for key in ("lower", "upper"))
            for joint in self._file.root.findall("joint")
            if (name := joint.get("name", "")) in hand.open
            and (limit := joint.find("limit")) is not None
        }
        fixed = [f"{name} {low} to {high}" for name, (low, high) in limits.items() if low == high]
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
            self._settings.setdefault("locked_joints", {}).update(
                {joint: ends["open"] for joint, ends in fingers.items()}
            )
            self._guess(
                "guess",
                f"the fingers are locked: {error.problem}, {error.got}",
                _FINGERS,
            )
            return self._write_and_load()

    def _get_names(self) -> set[str]:
        return {
            element.get("name", "")
            for tag in ("link", "joint")
            for element in self._file.root.findall(tag)
        }

    def _add_link(self, name: str, parent: str, placement: pin.SE3) -> None:
        root = self._file.root
        ElementTree.SubElement(root, "link", name=name)
        add_connection(root, f"{name}_joint", "fixed", parent, name, placement)

    def _write(self) -> None:
        settings = {
            key: value
            for key, value in self._settings.items()
            if key != "srdf" or (self._folder / value).is_file()
        }
        ElementTree.indent(self._file.root)
        file, marker = self._source.file.path.name, get_origin_marker("import-robot")
        source = f"{file} ({self._source.kind}) {marker}"
        head = format_comment(f"Made of {source}. Units: m, rad, s.")
        body = yaml.safe_dump(settings, sort_keys=False, default_flow_style=None, width=120)
        (self._folder / "robot.yaml").write_text(head + body, encoding="utf-8")
        tree = ElementTree.ElementTree(self._file.root)
        tree.write(self._file.path, encoding="utf-8", xml_declaration=True)

    def _remove_envelopes(self, robot: Robot) -> Robot:
        """Return the robot without shapes that merely enclose its hand."""
        if not (envelopes := find_envelopes(robot)):
            return robot
        remove_collision_shapes(self._file.root, envelopes)
        self._settings["touch_links"] = [
            link for link in self._settings.get("touch_links", ()) if link not in envelopes
        ]
        for link, share in envelopes.items():
            text = f"{link} encloses {share:.0%} of the hand: left out"
            self._findings.append(Finding("warning", "hand", text))
        return self._write_and_load()

    def _remove_columns(self, robot: Robot) -> Robot:
        """Return the robot without shapes that its lift sinks into the floor."""
        if not (columns := find_sunken_links(robot)):
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
        allowed = {
            **self._source.srdf.allowed,
            **sample_allowed_pairs(robot, samples=samples, seed=seed),
        }
        sampled = set_collision_pairs(robot, allowed)
        for one, other in find_inseparable_pairs(
            sampled, _NEIGHBOURS, samples=_NEAR, share=_MOSTLY, seed=seed
        ):
            text = (
                f"{one} and {other} are rarely {1e3 * _NEIGHBOURS:.0f} mm apart: "
                "the pair is not checked"
            )
            self._findings.append(Finding("note", "pairs", text))
            allowed[min(one, other), max(one, other)] = "Near"
        for one, other in find_nested_pairs(set_collision_pairs(robot, allowed), _NEIGHBOURS):
            text = f"{one} and {other} are parts of a telescope: the pair is not checked"
            self._findings.append(Finding("note", "pairs", text))
            allowed[one, other] = "Near"
        checked, arm = set_collision_pairs(robot, allowed), robot.coordinates.names[3:]
        states = self._source.srdf.find_states(arm, self._group)
        named = [
            (f"the state '{name}' of the file", find_arm_positions(robot, state))
            for name, state in states.items()
            if set(arm) <= set(state)
        ]
        home = find_home(checked, [*named, ("joints at 0 or mid-range", robot.home)], seed=seed)
        self._settings["home"] = {
            joint: round(float(value), 6) for joint, value in zip(arm, home.positions, strict=True)
        }
        positions = dict(zip(arm, map(float, home.positions), strict=True))
        text = format_srdf(self._name, positions, dict(sorted(allowed.items())))
        (self._folder / self._settings["srdf"]).write_text(text, encoding="utf-8")
        self._write()
        return home

    def _report(self, pieces: list[Piece], home: Home) -> None:
        values = ", ".join(f"{value:.2f}" for value in home.positions)
        sure = "sure" if home.clearance > 0.0 else "guess"
        self._guess(sure, f"home: {home.how} ({values}), clearance {1e3 * home.clearance:.0f} mm")
        for piece in {piece.mesh: piece for piece in pieces if piece.count > 1}.values():
            what = (
                f"{piece.mesh} in {piece.count} pieces, "
                f"{100.0 * piece.overhead:.0f} % more than its volume"
            )
            hull = f"its hull: {100.0 * piece.hull:.0f} %"
            self._findings.append(
                Finding(
                    "note",
                    "shapes",
                    f"{piece.link}: {what} ({hull}), protruding by {1e3 * piece.error:.0f} mm",
                )
            )


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
