"""The commands that bring descriptions from elsewhere: import-robot, -object, -home, and doctor, which examines robots."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from vkc_pin.benchmarks.commands import EXIT_OK, parse_natural, parse_positive
from vkc_pin.errors import InputError

__all__ = ["EXIT_SICK", "add_importing"]

EXIT_SICK = 1


def add_importing(commands: Any) -> None:
    """Add the commands to the parser's."""
    about = "Make a robot's folder of a URDF, xacro or MJCF file, and say what was guessed."
    robot = commands.add_parser(
        "import-robot", help="make a robot's folder of a file", description=about
    )
    robot.add_argument("file", metavar="FILE", help="URDF, xacro or MJCF")
    robot.add_argument(
        "--output",
        metavar="FOLDER",
        help="where to write (default: a folder of the file's name here)",
    )
    robot.add_argument(
        "--arm", metavar="NAME", help="which arm to plan, or a part of its name, e.g. left"
    )
    robot.add_argument(
        "--tool-frame", metavar="FRAME", help="the frame that grasps, if it is not to be guessed"
    )
    robot.add_argument("--srdf", metavar="FILE", help="an SRDF (default: the one beside the file)")
    robot.add_argument(
        "--package",
        action="append",
        default=[],
        metavar="NAME=FOLDER",
        help="for package:// and $(find NAME)",
    )
    robot.add_argument(
        "--argument", action="append", default=[], metavar="NAME=VALUE", help="of a xacro file"
    )
    robot.add_argument(
        "--most-pieces",
        type=parse_positive,
        metavar="N",
        help="convex pieces of a mesh, at most; 1 keeps hulls",
    )
    robot.add_argument(
        "--samples",
        type=parse_positive,
        metavar="N",
        help="configurations to look at for pairs that need no check",
    )
    robot.add_argument(
        "--seed", type=parse_natural, default=0, help="of the random numbers (default 0)"
    )
    robot.add_argument(
        "--force", action="store_true", help="replace a folder that import-robot made before"
    )
    robot.set_defaults(run=_import_robot)

    about = """Make an object that can be planned with of a URDF, MJCF or SDF file: convex pieces, limits, attachments that are
    proposed from its shapes, and a picture of these. The report says what was changed, and which joints no hand can open."""
    item = commands.add_parser(
        "import-object", help="make an object of a downloaded file", description=about
    )
    item.add_argument("file", metavar="FILE", help="URDF, MJCF or SDF")
    item.add_argument(
        "--output", metavar="FOLDER", help="a new folder for the object (default: its name)"
    )
    size = item.add_mutually_exclusive_group()
    size.add_argument(
        "--height",
        type=float,
        metavar="METRES",
        help="how high it is, for files without a unit (PartNet-Mobility)",
    )
    size.add_argument(
        "--scale", type=float, metavar="FACTOR", help="by what to multiply the file's lengths"
    )
    item.add_argument(
        "--up", choices=("z", "y"), default="z", help="which axis of the file points up (default z)"
    )
    item.add_argument("--link", metavar="NAME", help="import this link and what hangs on it alone")
    item.add_argument(
        "--robot",
        default="husky_ur5e",
        help="whose hand shall open it: name, file or folder (default husky_ur5e)",
    )
    item.add_argument(
        "--most",
        type=parse_positive,
        default=3,
        metavar="N",
        help="attachments for one joint, at most (default 3)",
    )
    item.add_argument(
        "--force", action="store_true", help="replace a folder that import-object made before"
    )
    item.set_defaults(run=_import_object)
    about = """Make a scene of a URDF or MJCF file of a whole home: what stands fixed becomes obstacles in convex pieces, what has
    joints becomes objects with proposed attachments, what moves freely becomes objects to carry, and the robot starts at a free
    place. The report says what was changed, and what no hand can open."""
    home = commands.add_parser(
        "import-home", help="make a scene of a file of a whole home", description=about
    )
    home.add_argument("file", metavar="FILE", help="URDF or MJCF")
    home.add_argument(
        "--output", metavar="FOLDER", help="a new folder for the scene (default: the file's name)"
    )
    home.add_argument(
        "--force", action="store_true", help="replace a folder that import-home made before"
    )
    home.add_argument(
        "--floor",
        type=float,
        default=0.0,
        metavar="METRES",
        help="height of the floor in the file (default 0)",
    )
    home.add_argument(
        "--robot",
        default="husky_ur5e",
        help="the robot that is there: name, file or folder (default husky_ur5e)",
    )
    home.add_argument(
        "--most",
        type=parse_positive,
        default=2,
        metavar="N",
        help="attachments for one joint, at most (default 2)",
    )
    home.add_argument(
        "--seed",
        type=parse_natural,
        default=0,
        help="of the places where a start is looked for (default 0)",
    )
    home.set_defaults(run=_import_home)

    about = "Examine a robot's description: home, pairs, limits, hand, shapes. Exit code 1 if plans would fail for it."
    doctor = commands.add_parser("doctor", help="examine a robot's description", description=about)
    doctor.add_argument(
        "robot",
        metavar="ROBOT",
        help="a robot's name, or the path of a URDF, a robot.yaml or a folder",
    )
    doctor.add_argument(
        "--margin",
        type=float,
        metavar="METRES",
        help="clearance that motions keep (default: that of plans)",
    )
    doctor.set_defaults(run=_doctor)


def _import_robot(arguments: argparse.Namespace) -> int:
    from vkc_pin.importing.robots.robot_import import import_robot

    chosen = {
        name: value
        for name in ("most_pieces", "samples")
        if (value := getattr(arguments, name)) is not None
    }
    made = import_robot(
        arguments.file,
        arguments.output,
        arm=arguments.arm,
        tool_frame=arguments.tool_frame,
        srdf=arguments.srdf,
        packages=_pairs(arguments.package, "--package", "NAME=FOLDER"),
        arguments=_pairs(arguments.argument, "--argument", "NAME=VALUE"),
        seed=arguments.seed,
        force=arguments.force,
        **chosen,
    )
    sys.stdout.write(f"{made}\n")
    return EXIT_OK if made.diagnosis.healthy else EXIT_SICK


def _import_object(arguments: argparse.Namespace) -> int:
    from vkc_pin.importing.objects.object_import import import_object

    done = import_object(
        arguments.file,
        arguments.output,
        height=arguments.height,
        scale=arguments.scale,
        up=arguments.up,
        link=arguments.link,
        robot=_robot(arguments.robot),
        most=arguments.most,
        force=arguments.force,
    )
    sys.stdout.write(f"{done.summary()}\nwrote {done.file}\nwrote {done.picture}\n")
    return EXIT_OK


def _import_home(arguments: argparse.Namespace) -> int:
    from vkc_pin.importing.homes.home_import import import_home

    done = import_home(
        arguments.file,
        arguments.output,
        floor=arguments.floor,
        robot=_robot(arguments.robot),
        most=arguments.most,
        seed=arguments.seed,
        force=arguments.force,
    )
    sys.stdout.write(f"{done.summary()}\nwrote {done.file}\n")
    return EXIT_OK


def _doctor(arguments: argparse.Namespace) -> int:
    from vkc_pin.importing.robots.doctor import doctor

    found = doctor(_robot(arguments.robot), margin=arguments.margin)
    sys.stdout.write(f"{found}\n")
    return EXIT_OK if found.healthy else EXIT_SICK


def _robot(name: str) -> str | Path:
    """Return what is meant by a robot's name: a folder here that import-robot has made, or else what `load_robot` takes."""
    return Path(name) if name and (Path(name) / "robot.yaml").is_file() else name


def _pairs(texts: list[str], field: str, form: str) -> dict[str, str]:
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise InputError("not a name with a value", field=field, expected=form, got=repr(text))
        found[name] = value
    return found
