"""Defines the commands import-robot, import-object, import-home and doctor."""

from __future__ import annotations

import argparse
import contextlib
import logging
import math
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vkc_pin.cli.options import (
    EXIT_FAILED,
    add_command,
    add_option,
    add_seed,
)
from vkc_pin.errors import InputError
from vkc_pin.utils.command_line import EXIT_OK, parse_positive

if TYPE_CHECKING:
    from vkc_pin.importing.objects.object_import import ImportedObject


def add_importing(commands: Any) -> None:
    """Add the commands to those of a parser."""
    about = "Import a robot from a URDF, xacro, MJCF, SDF or USD file, and report all guesses."
    robot = add_command(commands, "import-robot", "import a robot", _import_robot, about)
    add_option(robot, "file FILE", "URDF, xacro, MJCF, SDF or USD")
    _add_output(robot, "import-robot")
    add_option(robot, "--arm NAME", "the arm to plan for, or a part of its name, e.g. left")
    add_option(robot, "--tool-frame FRAME", "the tool frame, if it is not to be guessed")
    add_option(robot, "--srdf FILE", "an SRDF (default: the one beside the file)")
    _add_packages(robot)
    about = "largest number of convex pieces of a mesh; 1 keeps hulls"
    add_option(robot, "--most-pieces N", about, type=parse_positive)
    about = "number of configurations for finding pairs that need no check"
    add_option(robot, "--samples N", about, type=parse_positive)
    add_seed(robot)

    about = (
        "Import an object from a URDF, xacro, MJCF, SDF or USD file: convex pieces, joint limits, "
        "attachments proposed from its shapes, and a picture of them. The report lists changes, "
        "and joints that no hand can open."
    )
    item = add_command(commands, "import-object", "import an object", _import_object, about)
    add_option(item, "file FILE", "URDF, xacro, MJCF, SDF or USD")
    _add_output(item, "import-object")
    size = item.add_mutually_exclusive_group()
    about = "height, for files without a unit (PartNet-Mobility)"
    add_option(size, "--height METRES", about, type=float)
    add_option(size, "--scale FACTOR", "factor for the file's lengths", type=float)
    about = "axis of the file that points up (default z)"
    add_option(item, "--up", about, choices=("z", "y"), default="z")
    add_option(item, "--link NAME", "import only this link and its descendants")
    _add_packages(item)
    _add_hand(item, most=3)

    about = (
        "Import a whole home from a URDF, xacro, MJCF, SDF, USD or MoveIt .scene file as a scene: "
        "fixed parts become obstacles of convex pieces, parts with joints become objects with "
        "attachments, and free parts become objects to carry. A room that is one mesh, such as a "
        "scan, is divided into its floor and obstacles. The robot starts at a free pose. The "
        "report lists changes, and parts that no hand can move."
    )
    home = add_command(commands, "import-home", "import a whole home", _import_home, about)
    about = "URDF, xacro, MJCF, SDF, USD, MoveIt .scene, or a mesh (glTF, OBJ, PLY, STL)"
    add_option(home, "file FILE", about)
    _add_output(home, "import-home")
    about = "height of the floor in the file (default 0, of a mesh its largest level surface)"
    add_option(home, "--floor METRES", about, type=float)
    about = "an SRDF with pairs of links that may touch (default: the one beside the file)"
    add_option(home, "--srdf FILE", about)
    _add_packages(home)
    _add_hand(home, most=2)
    add_seed(home, "random seed of the search for a start pose (default 0)")

    about = (
        "Examine a robot's description: home, pairs, limits, hand, shapes. "
        "The exit code is 1 if planning would fail."
    )
    doctor = add_command(commands, "doctor", "examine a robot's description", _doctor, about)
    add_option(doctor, "robot ROBOT", "name, or path of a URDF, a robot.yaml or a folder")
    about = "clearance of motions (default: that of plans)"
    add_option(doctor, "--margin METRES", about, type=float)


def _add_output(parser: argparse.ArgumentParser, command: str) -> None:
    add_option(parser, "--output FOLDER", "a new folder (default: one named like the file)")
    add_option(parser, "--force", f"replace an earlier output of {command}")


def _add_packages(parser: argparse.ArgumentParser) -> None:
    about = "folder of a package, for package://, model:// and $(find NAME)"
    add_option(parser, "--package NAME=FOLDER", about, action="append", default=[])
    about = "argument of a xacro file"
    add_option(parser, "--argument NAME=VALUE", about, action="append", default=[])


def _read_packages(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments `packages` and `arguments` of an import."""
    return {
        "packages": _parse_pairs(arguments.package, "--package", "NAME=FOLDER"),
        "arguments": _parse_pairs(arguments.argument, "--argument", "NAME=VALUE"),
    }


@contextlib.contextmanager
def _print_progress() -> Iterator[None]:
    """Print the progress that imports log."""
    logger = logging.getLogger("vkc_pin.importing")
    handler = logging.StreamHandler(sys.stderr)
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


def _add_hand(parser: argparse.ArgumentParser, *, most: int) -> None:
    about = "robot with the hand: name, file or folder (default husky_ur5e)"
    add_option(parser, "--robot", about, default="husky_ur5e")
    about = f"largest number of attachments of one joint (default {most})"
    add_option(parser, "--most N", about, type=parse_positive, default=most)


def _import_robot(arguments: argparse.Namespace) -> int:
    from vkc_pin.importing.robots.robot_import import import_robot

    settings = _read_packages(arguments)
    if arguments.most_pieces is not None:
        settings["most_pieces"] = arguments.most_pieces
    if arguments.samples is not None:
        settings["samples"] = arguments.samples
    made = import_robot(
        arguments.file,
        arguments.output,
        arm=arguments.arm,
        tool_frame=arguments.tool_frame,
        srdf=arguments.srdf,
        seed=arguments.seed,
        force=arguments.force,
        **settings,
    )
    scene = shlex.quote(str(made.folder / "scene.yaml"))
    sys.stdout.write(f"{made}\ntry: vkc-pin plan {scene} --go-to 1 0 0\n")
    return EXIT_OK if made.diagnosis.healthy else EXIT_FAILED


def _import_object(arguments: argparse.Namespace) -> int:
    from vkc_pin.importing.objects.object_import import import_object

    with _print_progress():
        done = import_object(
            arguments.file,
            arguments.output,
            height=arguments.height,
            scale=arguments.scale,
            up=arguments.up,
            link=arguments.link,
            robot=_find_robot(arguments.robot),
            most=arguments.most,
            force=arguments.force,
            **_read_packages(arguments),
        )
    written = [done.file, done.picture]
    if done.scene is not None:
        written.append(done.scene)
    lines = "".join(f"wrote {file}\n" for file in written)
    sys.stdout.write(f"{done.summary()}\n{lines}{_suggest_plan(done)}")
    return EXIT_OK


def _suggest_plan(done: ImportedObject) -> str:
    """Return a line with a command for the first joint that a hand can open before all others."""
    for joint in done.object.coordinates.names:
        goal = done.proposals.find_goal(joint, alone=True)
        if goal is not None and done.scene is not None:
            value = math.trunc(1e3 * goal) / 1e3  # within the limits
            setting = shlex.quote(f"{done.object.name}.{joint}={value:g}")
            return f"try: vkc-pin plan {shlex.quote(str(done.scene))} --set {setting}\n"
    return ""


def _import_home(arguments: argparse.Namespace) -> int:
    from vkc_pin.importing.homes.home_import import import_home

    with _print_progress():
        done = import_home(
            arguments.file,
            arguments.output,
            floor=arguments.floor,
            robot=_find_robot(arguments.robot),
            most=arguments.most,
            seed=arguments.seed,
            force=arguments.force,
            srdf=arguments.srdf,
            **_read_packages(arguments),
        )
    sys.stdout.write(f"{done.summary()}\nwrote {done.file}\n")
    return EXIT_OK


def _doctor(arguments: argparse.Namespace) -> int:
    from vkc_pin.importing.robots.doctor import doctor

    found = doctor(_find_robot(arguments.robot), margin=arguments.margin)
    sys.stdout.write(f"{found}\n")
    return EXIT_OK if found.healthy else EXIT_FAILED


def _find_robot(name: str) -> str | Path:
    """Return a folder with a robot.yaml, or else the argument of `load_robot`."""
    return Path(name) if name and (Path(name) / "robot.yaml").is_file() else name


def _parse_pairs(texts: list[str], field: str, form: str) -> dict[str, str]:
    """Return the values of texts "name=value" by name."""
    pairs: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise InputError("not a name with a value", field=field, expected=form, got=repr(text))
        pairs[name] = value
    return pairs
