"""The commands that make descriptions of files from elsewhere: import-object."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from vkc_pin.benchmarks.commands import EXIT_OK, positive

__all__ = ["add_importing"]


def add_importing(commands: Any) -> None:
    """Add the commands to those of the command line."""
    about = """Make an object that can be planned with of a URDF, MJCF or SDF file: convex pieces, limits, attachments that are
    proposed from its shapes, and a picture of these. The report says what was changed, and which joints no hand can open."""
    item = commands.add_parser("import-object", help="make an object of a downloaded file", description=about)
    item.add_argument("file", metavar="FILE", help="URDF, MJCF or SDF")
    item.add_argument("--output", metavar="FOLDER", help="a new folder for the object (default: its name)")
    size = item.add_mutually_exclusive_group()
    size.add_argument(
        "--height", type=float, metavar="METRES", help="how high it is, for files without a unit (PartNet-Mobility)"
    )
    size.add_argument("--scale", type=float, metavar="FACTOR", help="by what to multiply the file's lengths")
    item.add_argument("--up", choices=("z", "y"), default="z", help="which axis of the file points up (default z)")
    item.add_argument("--link", metavar="NAME", help="import this link and what hangs on it alone")
    item.add_argument("--robot", default="husky_ur5e", help="whose hand shall open it: name or file (default husky_ur5e)")
    item.add_argument("--most", type=positive, default=3, metavar="N", help="attachments for one joint, at most (default 3)")
    item.set_defaults(run=_import_object)


def _import_object(arguments: argparse.Namespace) -> int:
    from vkc_pin.importing.objects.object_import import import_object

    done = import_object(
        arguments.file,
        arguments.output,
        height=arguments.height,
        scale=arguments.scale,
        up=arguments.up,
        link=arguments.link,
        robot=arguments.robot,
        most=arguments.most,
    )
    sys.stdout.write(f"{done.report()}\nwrote {done.file}\nwrote {done.picture}\n")
    return EXIT_OK
