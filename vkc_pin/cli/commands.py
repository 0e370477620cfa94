"""The commands of `vkc-pin`: plan, view, export, srdf, and those of other modules. Files are written before reports."""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vkc_pin.benchmarks.commands import (
    EXIT_INTERRUPTED,
    EXIT_OK,
    add_bench,
    parse_natural,
    parse_positive,
)
from vkc_pin.cli.checking import add_check
from vkc_pin.cli.datasets import add_datasets
from vkc_pin.cli.importing import add_importing
from vkc_pin.cli.simulating import add_simulate
from vkc_pin.errors import InputError, VkcError
from vkc_pin.world.files.writing import check_outputs, write_atomically
from vkc_pin.world.trajectory.formats.rosbag import import_rosbags
from vkc_pin.world.trajectory.formats.tables import GROUPS

__all__ = ["EXIT_MISUSE", "make_parser", "parse_settings", "run"]

EXIT_FAILED, EXIT_MISUSE, EXIT_INFEASIBLE = 1, 2, 3
_FAILURES = {
    "infeasible": EXIT_INFEASIBLE,
    "interrupted": EXIT_INTERRUPTED,
}  # by a plan's status; others have failed
_CODES = """exit codes:
  0    success: a motion that the validation finds nothing wrong with, and all that was asked for is written and printed
  1    failed: no valid motion came out, a saved one is none or not what its file says, or a scene has a fault
  2    wrong input, or something that cannot be read, written or printed
  3    infeasible: the task cannot be done, and the report says why
  130  Ctrl-C"""
_FILES = ("save", "json", "csv", "ros", "html")
_FOLDERS = ("rosbag",)


def parse_settings(settings: Sequence[str]) -> list[Any]:
    """Return `Actuate` steps of "object.joint=value" texts; neighbours of one object become one step.

    Raises:
        InputError: A text is not of that form.
    """
    from vkc_pin.world.task.steps import Actuate

    grouped: list[tuple[str, dict[str, float]]] = []
    for text in settings:
        name, equals, value = text.partition("=")
        owner, dot, joint = name.strip().partition(".")
        expected = "OBJECT.JOINT=VALUE, e.g. door.hinge=1.2"
        if not (equals and dot and owner and joint):
            raise InputError("not a setting", field="--set", expected=expected, got=repr(text))
        try:
            number = float(value)
        except ValueError:
            raise InputError(
                "not a number after '='", field="--set", expected=expected, got=repr(text)
            ) from None
        if grouped and grouped[-1][0] == owner and joint not in grouped[-1][1]:
            grouped[-1][1][joint] = number
        else:
            grouped.append((owner, {joint: number}))
    return [Actuate(owner, joints) for owner, joints in grouped]


def _progress(row: Any) -> None:
    sys.stderr.write(
        f"  round {row.round:2d}  Ipopt {row.iterations:4d}  clearance {1e3 * row.clearance:7.1f} mm"
        f"  short of it {1e3 * row.shortfall:6.2f} mm  pose error {row.pose_error:.1e}  step {row.step:.3f}  {row.time:.2f} s\n"
    )


def _plan(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin.visualization.plots.plots import PICTURES

    steps, outputs = parse_settings(arguments.set), _options(_chosen(arguments, _FILES))
    if (folder := arguments.plots) is not None:
        if Path(folder).suffix.lower() in PICTURES:
            raise InputError(
                "this is the name of a picture", field="--plots", expected="a folder", got=folder
            )
        outputs["--plots"] = Path(folder, "joints.png")
    check_outputs(outputs | _new_folders(arguments), inputs={"SCENE": arguments.scene})
    scene = vkc.load_scene(arguments.scene)
    plan = vkc.plan(
        scene,
        steps,
        initialization=arguments.initialization,
        time_limit=arguments.time_limit,
        max_evaluations=arguments.max_evaluations,
        seed=arguments.seed,
        callback=None if arguments.quiet else _progress,
    )
    ros = functools.partial(_write_ros, plan)
    writers: dict[str, Callable[[str], object]] = {
        "save": plan.save,
        "json": plan.to_json,
        "csv": plan.to_csv,
        "ros": ros,
        "rosbag": plan.to_rosbag,
        "html": plan.to_html,
        "plots": plan.plot,
    }
    if not _write(
        _chosen(arguments, (*_FILES, *_FOLDERS, "plots")), writers, plan.summary() + "\n"
    ):
        return EXIT_MISUSE
    return EXIT_OK if plan.success else _FAILURES.get(plan.status, EXIT_FAILED)


def _chosen(arguments: argparse.Namespace, options: Sequence[str]) -> dict[str, str]:
    """Return what options name, of those that are given."""
    return {
        option: value for option in options if (value := getattr(arguments, option)) is not None
    }


def _new_folders(arguments: argparse.Namespace) -> dict[str, str | Path]:
    """Return a file in each folder that options have made, by option, if these can be made."""
    folders = _chosen(arguments, _FOLDERS)
    for option, path in folders.items():
        if Path(path).exists():
            raise InputError(
                "this already exists", file=path, field=f"--{option}", expected="a new folder"
            )
        import_rosbags()
    return {f"--{option}": Path(path, "metadata.yaml") for option, path in folders.items()}


def _options(files: Mapping[str, str]) -> dict[str, str | Path]:
    return {f"--{option}": path for option, path in files.items()}


def _write(
    files: Mapping[str, str], writers: Mapping[str, Callable[[str], object]], report: str = ""
) -> bool:
    """Write files by option, then print a report and what was written; return whether all of them were."""
    said, failed = [report], []
    for option, path in files.items():
        try:
            writers[option](path)
            said.append(f"wrote {path}\n")
        except (VkcError, OSError) as error:  # the others are written all the same
            failed.append(f"vkc-pin: {error}\n")
    sys.stdout.write("".join(said))
    sys.stderr.write("".join(failed))
    return not failed


def _write_ros(plan: Any, path: str, **options: Any) -> None:
    write_atomically(path, (json.dumps(plan.to_ros(**options)) + "\n").encode("utf-8"))


def _export(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc

    files = _chosen(arguments, ("csv", "json", "ros", *_FOLDERS))
    if not files:
        expected = "--csv FILE, --json FILE, --ros FILE or --rosbag FOLDER"
        raise InputError("nothing to write", field="export", expected=expected)
    if arguments.rate is not None and not {"ros", "rosbag"} & files.keys():
        expected = "--ros FILE or --rosbag FOLDER as well"
        raise InputError("only ROS' points can be resampled", field="--rate", expected=expected)
    if arguments.joints is not None and files.keys() == {"rosbag"}:
        raise InputError(
            "recordings have all joints",
            field="--joints",
            expected="--csv FILE or --ros FILE as well",
        )
    plain = {option: path for option, path in files.items() if option not in _FOLDERS}
    check_outputs(_options(plain) | _new_folders(arguments), inputs={"PLAN": arguments.plan})
    plan = vkc.Plan.load(arguments.plan)
    names = arguments.joints.split(",") if arguments.joints else None
    joints = names[0] if names is not None and len(names) == 1 and names[0] in GROUPS else names
    chosen = {} if joints is None else {"joints": joints}
    ros = functools.partial(_write_ros, plan, **chosen, rate=arguments.rate)
    bag = functools.partial(plan.to_rosbag, rate=arguments.rate)
    writers: dict[str, Callable[[str], object]] = {
        "csv": functools.partial(plan.to_csv, **chosen),
        "json": plan.to_json,
        "ros": ros,
        "rosbag": bag,
    }
    whole = _write(files, writers)
    return EXIT_OK if whole else EXIT_MISUSE


def _view(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin.visualization import viewer as visualization

    files = _chosen(arguments, ("html",))
    check_outputs(_options(files), inputs={"SCENE|PLAN": arguments.what})
    shown: Any = (
        vkc.Plan.load(arguments.what)
        if str(arguments.what).endswith(".npz")
        else vkc.load_scene(arguments.what)
    )
    if files:
        return (
            EXIT_OK
            if _write(files, {"html": functools.partial(visualization.to_html, shown)})
            else EXIT_MISUSE
        )
    visualization.show(shown)
    sys.stdout.write("press Enter to end\n")
    sys.stdout.flush()
    with contextlib.suppress(EOFError):
        input()
    return EXIT_OK


def _srdf(arguments: argparse.Namespace) -> int:
    from vkc_pin.world.models.robot_file import load_robot
    from vkc_pin.world.models.self_collisions import write_srdf

    check_outputs({"--output": arguments.output}, inputs={"ROBOT": arguments.robot})
    written = write_srdf(
        load_robot(arguments.robot),
        arguments.output,
        samples=arguments.samples,
        seed=arguments.seed,
    )
    sys.stdout.write(f"wrote {written}\n")
    return EXIT_OK


def make_parser() -> argparse.ArgumentParser:
    """Return what understands the command line; each command sets `run`, which takes what was understood."""
    from vkc_pin.benchmarks.harness.record import find_versions

    parser = argparse.ArgumentParser(
        prog="vkc-pin",
        description="Whole-body planning on virtual kinematic chains.",
        epilog=_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    listed = ", ".join(
        f"{name} {number}"
        for name, number in {**find_versions(), "Python": platform.python_version()}.items()
    )
    parser.add_argument(
        "--version",
        action="version",
        version=listed,
        help="show versions, also of what motions depend on",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    plan = commands.add_parser(
        "plan",
        help="plan a motion",
        description="Plan a motion that brings joints of objects to values.",
    )
    plan.add_argument(
        "scene", metavar="SCENE", help="name of a scene that comes with the package, or a YAML file"
    )
    form = "OBJECT.JOINT=VALUE"
    plan.add_argument(
        "--set",
        action="append",
        required=True,
        metavar=form,
        help="what should change, in this order",
    )
    plan.add_argument("--html", metavar="FILE", help="write the animation, one self-contained page")
    plan.add_argument("--save", metavar="FILE", help="save the plan (.npz)")
    plan.add_argument("--json", metavar="FILE", help="write trajectory, metrics and report as JSON")
    plan.add_argument(
        "--csv", metavar="FILE", help="write the motion as a table, a line a waypoint"
    )
    plan.add_argument(
        "--ros",
        metavar="FILE",
        help="write base and arm with the fields of trajectory_msgs/JointTrajectory",
    )
    plan.add_argument(
        "--rosbag",
        metavar="FOLDER",
        help="write a recording of ROS 2 (rosbag2); needs the extra `ros`",
    )
    plan.add_argument("--plots", metavar="FOLDER", help="write plots")
    plan.add_argument(
        "--initialization",
        default="auto",
        metavar="METHOD",
        help="auto, interpolated, astar, rrt or stationary",
    )
    plan.add_argument(
        "--time-limit", type=float, metavar="SECONDS", help="return the best motion found by then"
    )
    plan.add_argument(
        "--max-evaluations",
        type=int,
        metavar="UNITS",
        help="return the best motion found with so much work",
    )
    plan.add_argument(
        "--seed", type=parse_natural, default=0, help="of the random numbers (default 0)"
    )
    plan.add_argument("--quiet", action="store_true", help="no progress")
    plan.set_defaults(run=_plan)

    add_check(commands)
    add_simulate(commands)

    view = commands.add_parser(
        "view",
        help="look at a scene or plan",
        description="Show a scene or a saved plan in the browser.",
    )
    view.add_argument("what", metavar="SCENE|PLAN")
    view.add_argument("--html", metavar="FILE", help="write a page instead of starting a server")
    view.set_defaults(run=_view)

    about = "Write the motion of a saved plan for other programs."
    export = commands.add_parser(
        "export", help="write a saved plan for other programs", description=about
    )
    export.add_argument("plan", metavar="PLAN", help="a plan saved with --save or Plan.save")
    export.add_argument("--csv", metavar="FILE", help="a table, a line a waypoint")
    export.add_argument("--json", metavar="FILE", help="trajectory, metrics and report as JSON")
    export.add_argument(
        "--ros", metavar="FILE", help="JSON with the fields of trajectory_msgs/JointTrajectory"
    )
    export.add_argument(
        "--rosbag", metavar="FOLDER", help="a recording of ROS 2 (rosbag2); needs the extra `ros`"
    )
    which = f"{', '.join(GROUPS)}, or names of coordinates with commas between; without it all in a table, robot for ROS"
    export.add_argument("--joints", metavar="WHICH", help=which)
    export.add_argument(
        "--rate", type=float, metavar="HZ", help="points a second for ROS; without it the waypoints"
    )
    export.set_defaults(run=_export)

    add_datasets(commands)
    add_bench(commands)
    add_importing(commands)

    about = "Sample which links of a robot can never collide."
    srdf = commands.add_parser("srdf", help="regenerate allowed collisions", description=about)
    srdf.add_argument("robot", metavar="ROBOT", help="name or URDF file")
    srdf.add_argument("--output", required=True, metavar="FILE")
    srdf.add_argument("--samples", type=parse_positive, default=20000)
    srdf.add_argument("--seed", type=parse_natural, default=0)
    srdf.set_defaults(run=_srdf)

    return parser


def run(argv: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    arguments = make_parser().parse_args(argv)
    arguments.given = list(argv)
    try:
        return int(arguments.run(arguments))
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except (VkcError, OSError) as error:  # or a file that cannot be written, a full disk
        sys.stderr.write(f"vkc-pin: {error}\n")
        return EXIT_MISUSE
