"""Defines the commands plan, check, simulate, view, export and srdf, and runs all commands."""

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

from vkc_pin.cli.datasets import add_datasets
from vkc_pin.cli.first_steps import add_completion, add_first_steps
from vkc_pin.cli.importing import add_importing
from vkc_pin.cli.options import (
    EXIT_FAILED,
    EXIT_INFEASIBLE,
    EXIT_MISUSE,
    CommandParser,
    GroupedCommands,
    GroupedHelp,
    add_command,
    add_option,
    add_seed,
)
from vkc_pin.cli.steps import add_steps, make_steps
from vkc_pin.errors import InputError, VkcError
from vkc_pin.experiments.commands import add_bench
from vkc_pin.utils.command_line import EXIT_INTERRUPTED, EXIT_OK, parse_positive
from vkc_pin.world.files.writing import check_outputs, write_atomically
from vkc_pin.world.trajectory.formats.rosbag import import_rosbags
from vkc_pin.world.trajectory.formats.tables import GROUPS

# Exit codes by the status of a plan; others mean failure
_STATUS_CODES = {"infeasible": EXIT_INFEASIBLE, "interrupted": EXIT_INTERRUPTED}
_EPILOG = """exit codes:
  0    success: the motion is valid, and all outputs are written
  1    failed: no valid motion was found, a saved one is invalid, or a scene or robot has faults
  2    wrong input, or something cannot be read, written or printed
  3    infeasible: the report says why
  130  Ctrl-C"""
_FOLDERS = ("rosbag",)
_OUTPUTS = {
    "--html FILE": "write the animation as one self-contained page",
    "--save FILE": "save the plan (.npz)",
    "--plots FOLDER": "write plots",
}
_EXPORTS = {
    "--json FILE": "write trajectory, metrics and report as JSON",
    "--csv FILE": "write a table with a line per knot of the curve",
    "--ros FILE": "write JSON with the fields of trajectory_msgs/JointTrajectory",
    "--rosbag FOLDER": "write a recording of ROS 2 (rosbag2); needs the extra `ros`",
}
Writers = Mapping[str, Callable[[str], object]]


def _print_progress(row: Any) -> None:
    """Print a round of planning."""
    sys.stderr.write(
        f"  round {row.round:2d}  Ipopt {row.iterations:4d}"
        f"  clearance {1e3 * row.clearance:7.1f} mm  shortfall {1e3 * row.shortfall:6.2f} mm"
        f"  pose error {row.pose_error:.1e}  step {row.step:.3f}  {row.time:.2f} s\n"
    )


def _plan(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin.visualization.plots.plots import PICTURES

    steps = make_steps(arguments.steps or ())
    files = _get_given(arguments, "save", "json", "csv", "ros", "html", "rosbag", "plots")
    outputs: dict[str, str] = dict(files)
    folder = files.get("plots")
    if folder is not None:
        if Path(folder).suffix.lower() in PICTURES:
            raise InputError(
                "this is the name of a picture", field="--plots", expected="a folder", got=folder
            )
        outputs["plots"] = str(Path(folder, "joints.png"))
    _check_outputs(outputs, SCENE=arguments.scene)
    scene = vkc.load_scene(arguments.scene)
    if arguments.robot is not None:
        radius = scene.robot.turning_radius or None
        base = scene.robot.base
        scene = scene.with_robot(arguments.robot, base=base, turning_radius=radius)
    plan = vkc.plan(
        scene,
        steps,
        initialization=arguments.initialization,
        time_limit=arguments.time_limit,
        max_evaluations=arguments.max_evaluations,
        seed=arguments.seed,
        callback=None if arguments.quiet else _print_progress,
    )
    writers = _make_exporters(plan)
    writers["save"] = plan.save
    writers["html"] = plan.to_html
    writers["plots"] = plan.plot
    if not _write(files, writers, f"{plan.summary()}\n"):
        return EXIT_MISUSE
    return EXIT_OK if plan.success else _STATUS_CODES.get(plan.status, EXIT_FAILED)


def _get_given(arguments: argparse.Namespace, *options: str) -> dict[str, str]:
    """Return the values of those options that are given."""
    values = {option: getattr(arguments, option) for option in options}
    return {option: value for option, value in values.items() if value is not None}


def _check_outputs(outputs: Mapping[str, str], **inputs: str) -> None:
    """Check that outputs can be written and do not overwrite inputs."""
    files: dict[str, str | Path] = {}
    for option, path in outputs.items():
        files[f"--{option}"] = path
        if option in _FOLDERS:
            if Path(path).exists():
                raise InputError(
                    "this already exists", file=path, field=f"--{option}", expected="a new folder"
                )
            import_rosbags()
            files[f"--{option}"] = Path(path, "metadata.yaml")
    read: dict[str, str | Path] = {}
    for name, path in inputs.items():
        is_folder = Path(path).is_dir()  # which stands for the scene in it
        read[name.replace("_", "|")] = Path(path, "scene.yaml") if is_folder else path
    check_outputs(files, inputs=read)


def _write(files: Mapping[str, str], writers: Writers, report: str = "") -> bool:
    """Write files by option, print the report and their names; return whether all are written."""
    lines = [report]
    errors: list[str] = []
    for option, path in files.items():
        try:
            writers[option](path)
            lines.append(f"wrote {path}\n")
        except (VkcError, OSError) as error:  # the others are written all the same
            errors.append(f"vkc-pin: {error}\n")
    sys.stdout.write("".join(lines))
    sys.stderr.write("".join(errors))
    return not errors


def _make_exporters(plan: Any, rate: float | None = None, **joints: Any) -> dict[str, Any]:
    """Return the functions that write a plan for other programs, by option."""

    def write_ros(path: str) -> None:
        message = plan.to_ros(**joints, rate=rate)
        write_atomically(path, f"{json.dumps(message)}\n".encode())

    return {
        "csv": functools.partial(plan.to_csv, **joints),
        "json": plan.to_json,
        "ros": write_ros,
        "rosbag": functools.partial(plan.to_rosbag, rate=rate),
    }


def _export(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc

    files = _get_given(arguments, "csv", "json", "ros", *_FOLDERS)
    if not files:
        expected = "--csv FILE, --json FILE, --ros FILE or --rosbag FOLDER"
        raise InputError("nothing to write", field="export", expected=expected)
    if arguments.rate is not None and "ros" not in files and "rosbag" not in files:
        expected = "--ros FILE or --rosbag FOLDER as well"
        raise InputError("only ROS' points can be resampled", field="--rate", expected=expected)
    if arguments.joints is not None and files.keys() == {"rosbag"}:
        expected = "--csv FILE or --ros FILE as well"
        raise InputError("recordings have all joints", field="--joints", expected=expected)
    _check_outputs(files, PLAN=arguments.plan)
    plan = vkc.Plan.load(arguments.plan)
    joints: dict[str, Any] = {}
    if arguments.joints in GROUPS:
        joints["joints"] = arguments.joints
    elif arguments.joints:
        joints["joints"] = arguments.joints.split(",")
    writers = _make_exporters(plan, arguments.rate, **joints)
    return EXIT_OK if _write(files, writers) else EXIT_MISUSE


def _check(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin.visualization.plots.plots import PICTURES

    files = _get_given(arguments, "plot")
    if str(arguments.what).endswith(".npz"):
        if files:
            raise InputError(
                "a plan has plots of its own",
                field="--plot",
                expected="a scene",
                got=arguments.what,
            )
        plan = vkc.Plan.load(arguments.what)
        contradictions = plan.contradictions()
        for line in plan.report.lines():
            sys.stdout.write(f"{line}\n")
        for line in contradictions:
            sys.stdout.write(f"  the file says otherwise: {line}\n")
        return EXIT_OK if plan.report.ok and not contradictions else EXIT_FAILED
    if files and not arguments.plot.lower().endswith(PICTURES):
        expected = f"a name that ends with {', '.join(PICTURES)}"
        raise InputError(
            "not the name of a picture", field="--plot", expected=expected, got=arguments.plot
        )
    _check_outputs(files, SCENE=arguments.what)
    try:
        scene = vkc.load_scene(arguments.what)
    except InputError as error:
        if Path(arguments.what).suffix in ("", ".yaml", ".yml"):
            raise
        expected = "a saved plan (.npz) or a scene (.yaml)"
        raise InputError(
            "neither a plan nor a scene", file=arguments.what, expected=expected
        ) from error
    found = vkc.check_scene(scene, seed=arguments.seed)
    if not _write(files, {"plot": found.plot}, f"{found}\n"):
        return EXIT_MISUSE
    return EXIT_OK if found.ok else EXIT_FAILED


def _simulate(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc

    files = _get_given(arguments, "html", "picture", "video", "json")
    inputs = {"PLAN": arguments.plan}
    if arguments.actual is not None:
        inputs["--actual"] = arguments.actual
    _check_outputs(files, **inputs)
    plan = vkc.Plan.load(arguments.plan)
    actual = None
    if arguments.actual is not None:
        start = plan.scene.start
        names = plan.scene.robot.coordinates.names
        actual = vkc.load_scene(arguments.actual)
        if actual.robot.coordinates.names == names:  # `simulate` refuses another robot
            actual = actual.with_start(base=start[:3], arm=start[3:])
    result = plan.simulate(actual=actual, grasp=arguments.grasp)
    writers: Writers = {
        "html": result.to_html,
        "picture": result.plot,
        "video": result.to_mp4,
        "json": result.to_json,
    }
    if not _write(files, writers, f"{result.summary()}\n"):
        return EXIT_MISUSE
    return EXIT_OK if result.ok else EXIT_FAILED


def _view(arguments: argparse.Namespace) -> int:
    from vkc_pin import visualization
    from vkc_pin.cli.shown import find_description, load_shown

    files = _get_given(arguments, "html")
    what = str(arguments.what)
    _check_outputs(files, WHAT=str(find_description(Path(what))))
    shown, frames = load_shown(what)
    if files:
        writers = {"html": functools.partial(visualization.to_html, shown, frames=frames)}
        return EXIT_OK if _write(files, writers) else EXIT_MISUSE
    visualization.show(shown, frames=frames)
    sys.stdout.write("press Enter to end\n")
    sys.stdout.flush()
    with contextlib.suppress(EOFError):
        input()
    return EXIT_OK


def _srdf(arguments: argparse.Namespace) -> int:
    from vkc_pin.world.models.robot_file import load_robot
    from vkc_pin.world.models.self_collisions import write_srdf

    _check_outputs({"output": arguments.output}, ROBOT=arguments.robot)
    robot = load_robot(arguments.robot)
    written = write_srdf(robot, arguments.output, samples=arguments.samples, seed=arguments.seed)
    sys.stdout.write(f"wrote {written}\n")
    return EXIT_OK


def make_parser() -> argparse.ArgumentParser:
    """Return the command line parser; each command sets `run`, a function of the arguments."""
    from vkc_pin.utils.system import find_versions

    parser = CommandParser(
        prog="vkc-pin",
        description="Whole-body planning on virtual kinematic chains.",
        epilog=_EPILOG,
        formatter_class=GroupedHelp,
    )
    versions = {**find_versions(), "Python": platform.python_version()}
    listed = ", ".join(f"{name} {number}" for name, number in versions.items())
    add_option(
        parser, "--version", "show versions, also of dependencies", action="version", version=listed
    )
    commands = GroupedCommands(parser)
    commands.start_group("first steps")
    add_first_steps(commands)
    commands.start_group("motions")
    _add_plan(commands)
    _add_check_and_simulate(commands)
    _add_view_and_export(commands)
    commands.start_group("robots, objects and homes from files")
    add_importing(commands)
    _add_srdf(commands)
    commands.start_group("datasets and experiments")
    add_datasets(commands)
    add_bench(commands)
    commands.start_group("this command")
    add_completion(commands, make_parser)
    return parser


def _add_srdf(commands: Any) -> None:
    srdf = add_command(
        commands,
        "srdf",
        "regenerate allowed collisions",
        _srdf,
        "Sample which links of a robot can never collide.",
    )
    add_option(srdf, "robot ROBOT", "name or URDF file")
    add_option(srdf, "--output FILE", "SRDF to write", required=True)
    add_option(srdf, "--samples", "number of configurations", type=parse_positive, default=20000)
    add_seed(srdf)


def _add_plan(commands: Any) -> None:
    about = (
        "Plan a motion of steps, in the order in which they are given: they bring joints of "
        "objects to values, objects and the hand to poses, and the base to places."
    )
    plan = add_command(commands, "plan", "plan a motion", _plan, about)
    add_option(plan, "scene SCENE", "a YAML file, a folder with scene.yaml, or an included scene")
    about = "another robot: a name, folder, robot.yaml or URDF (default: the scene's)"
    add_option(plan, "--robot ROBOT", about)
    add_steps(plan)
    for form, text in (_OUTPUTS | _EXPORTS).items():
        add_option(plan, form, text)
    methods = "auto, interpolated, astar, rrt or stationary"
    add_option(plan, "--initialization METHOD", methods, default="auto")
    about = "return the best motion found by then; default 60, or none with --max-evaluations"
    add_option(plan, "--time-limit SECONDS", about, type=float)
    about = "return the best motion found with this number of evaluations"
    add_option(plan, "--max-evaluations COUNT", about, type=int)
    add_seed(plan)
    add_option(plan, "--quiet", "print no progress")


def _add_check_and_simulate(commands: Any) -> None:
    about = (
        "Validate a saved plan, and report what its file states otherwise. Or examine a scene: "
        "pairs closer than Options.dist_safe, overlaps, and reachable attachments."
    )
    check = add_command(
        commands, "check", "validate a saved plan or examine a scene", _check, about
    )
    add_option(check, "what SCENE|PLAN", "a scene, or a saved plan (.npz)")
    add_option(check, "--plot FILE", "write a top view of the scene (.png, .svg, .pdf)")
    add_seed(check)

    about = (
        "Execute a saved plan in MuJoCo, with masses, friction, servos and a hand that can lose "
        "its hold, and report the outcome. Needs the extra `sim`."
    )
    simulate = add_command(
        commands, "simulate", "execute a saved plan in physics", _simulate, about
    )
    add_option(simulate, "plan PLAN", "a saved plan (.npz)")
    add_option(simulate, "--actual SCENE", "scene of the execution (default: that of the plan)")
    about = "grasp model: weld (default), or friction of closing fingers"
    add_option(simulate, "--grasp MODEL", about, default="weld")
    add_option(simulate, "--html FILE", "write executed and planned motion as one page")
    add_option(simulate, "--picture FILE", "write snapshots (.png)")
    about = "write a video (.mp4); needs ffmpeg or the package imageio-ffmpeg"
    add_option(simulate, "--video FILE", about)
    add_option(simulate, "--json FILE", "write the result as JSON")


def _add_view_and_export(commands: Any) -> None:
    about = "Show a scene, a saved plan, a robot with its tool frame, or an object in the browser."
    view = add_command(commands, "view", "show a scene, plan, robot or object", _view, about)
    about = "a saved plan (.npz), or the name, file or folder of a scene, robot or object"
    add_option(view, "what WHAT", about)
    add_option(view, "--html FILE", "write a page instead of starting a server")

    about = "Write the motion of a saved plan for other programs."
    export = add_command(
        commands, "export", "write a saved plan for other programs", _export, about
    )
    add_option(export, "plan PLAN", "a saved plan (.npz)")
    for form, text in _EXPORTS.items():
        add_option(export, form, text)
    groups = ", ".join(GROUPS)
    about = f"{groups}, or names separated by commas (default: all; for ROS the robot's)"
    add_option(export, "--joints WHICH", about)
    about = "smallest frequency of the points for ROS (default: the motion's knots)"
    add_option(export, "--rate HZ", about, type=float)


def run(argv: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    arguments = make_parser().parse_args(argv)
    arguments.command = ["vkc-pin", *argv]
    try:
        return int(arguments.run(arguments))
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except (VkcError, OSError) as error:  # e.g. an unwritable file or a full disk
        sys.stderr.write(f"vkc-pin: {error}\n")
        return EXIT_MISUSE
