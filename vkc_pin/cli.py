"""The command line: plan, check, view, export, bench, srdf."""

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

from vkc_pin.benchmarks.commands import EXIT_OK, add_bench, natural, positive
from vkc_pin.errors import InputError, VkcError
from vkc_pin.motion.tables import GROUPS

__all__ = ["main"]

EXIT_FAILED, EXIT_MISUSE = 1, 2


def parse_settings(settings: Sequence[str]) -> list[Any]:
    """Return `Actuate` steps of "object.joint=value" texts; neighbours of one object become one step.

    Raises:
        InputError: A text is not of that form.
    """
    from vkc_pin.task.steps import Actuate

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
            raise InputError("not a number after '='", field="--set", expected=expected, got=repr(text)) from None
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

    scene = vkc.load_scene(arguments.scene)
    steps = parse_settings(arguments.set)
    plan = vkc.plan(
        scene,
        steps,
        initialization=arguments.initialization,
        time_limit=arguments.time_limit,
        effort=arguments.effort,
        seed=arguments.seed,
        callback=None if arguments.quiet else _progress,
    )
    sys.stdout.write(plan.report() + "\n")
    if arguments.plots:
        Path(arguments.plots).mkdir(parents=True, exist_ok=True)
    writers: dict[str, Callable[[str], object]] = {"save": plan.save, "json": plan.to_json, "csv": plan.to_csv}
    _write(arguments, {**writers, "ros": functools.partial(_write_ros, plan), "html": plan.to_html, "plots": plan.plot})
    return EXIT_OK if plan.success else EXIT_FAILED


def _write(arguments: argparse.Namespace, writers: Mapping[str, Callable[[str], object]]) -> None:
    """Write the files that were asked for, by option, and say so."""
    paths = {option: getattr(arguments, option) for option in writers if getattr(arguments, option)}
    for option, path in paths.items():
        writers[option](path)
    sys.stdout.write("".join(f"wrote {path}\n" for path in paths.values()))


def _write_ros(plan: Any, path: str, **options: Any) -> None:
    from vkc_pin.files.writing import write_atomically

    write_atomically(path, (json.dumps(plan.to_ros(**options)) + "\n").encode("utf-8"))


def _export(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc

    plan = vkc.Plan.load(arguments.plan)
    if not (arguments.csv or arguments.json or arguments.ros):
        raise InputError("nothing to write", field="export", expected="--csv FILE, --json FILE or --ros FILE")
    if arguments.rate is not None and not arguments.ros:
        raise InputError("only ROS' points can be resampled", field="--rate", expected="--ros FILE as well")
    names = arguments.joints.split(",") if arguments.joints else None
    joints = names[0] if names is not None and len(names) == 1 and names[0] in GROUPS else names
    chosen = {} if joints is None else {"joints": joints}
    ros = functools.partial(_write_ros, plan, **chosen, rate=arguments.rate)
    _write(arguments, {"csv": functools.partial(plan.to_csv, **chosen), "json": plan.to_json, "ros": ros})
    return EXIT_OK


def _check(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin.validation.validate import validate

    plan = vkc.Plan.load(arguments.plan)
    report = validate(plan.scene, plan.steps, plan.trajectory, plan.options, plan.terms)
    sys.stdout.write("\n".join(report.lines()) + "\n")
    return EXIT_OK if report.ok else EXIT_FAILED


def _view(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin.visualization import viewer as visualization

    shown: Any = vkc.Plan.load(arguments.what) if str(arguments.what).endswith(".npz") else vkc.load_scene(arguments.what)
    if arguments.html:
        sys.stdout.write(f"wrote {visualization.to_html(shown, arguments.html)}\n")
        return EXIT_OK
    visualization.show(shown)
    sys.stdout.write("press Enter to end\n")
    with contextlib.suppress(EOFError, KeyboardInterrupt):
        input()
    return EXIT_OK


def _srdf(arguments: argparse.Namespace) -> int:
    from vkc_pin.models.robot_file import load_robot
    from vkc_pin.models.self_collisions import write_srdf

    written = write_srdf(load_robot(arguments.robot), arguments.output, samples=arguments.samples, seed=arguments.seed)
    sys.stdout.write(f"wrote {written}\n")
    return EXIT_OK


def _parser() -> argparse.ArgumentParser:
    from vkc_pin.benchmarks.harness.record import versions

    parser = argparse.ArgumentParser(prog="vkc-pin", description="Whole-body planning on virtual kinematic chains.")
    listed = ", ".join(f"{name} {number}" for name, number in {**versions(), "Python": platform.python_version()}.items())
    parser.add_argument("--version", action="version", version=listed, help="show versions, also of what motions depend on")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    plan = commands.add_parser("plan", help="plan a motion", description="Plan a motion that brings joints of objects to values.")
    plan.add_argument("scene", metavar="SCENE", help="name of a scene that comes with the package, or a YAML file")
    form = "OBJECT.JOINT=VALUE"
    plan.add_argument("--set", action="append", required=True, metavar=form, help="what should change, in this order")
    plan.add_argument("--html", metavar="FILE", help="write the animation, one self-contained page")
    plan.add_argument("--save", metavar="FILE", help="save the plan (.npz)")
    plan.add_argument("--json", metavar="FILE", help="write trajectory, metrics and report as JSON")
    plan.add_argument("--csv", metavar="FILE", help="write the motion as a table, a line a waypoint")
    plan.add_argument("--ros", metavar="FILE", help="write base and arm with the fields of trajectory_msgs/JointTrajectory")
    plan.add_argument("--plots", metavar="FOLDER", help="write plots")
    plan.add_argument("--initialization", default="auto", metavar="METHOD", help="auto, interpolated, astar, rrt or stationary")
    plan.add_argument("--time-limit", type=float, metavar="SECONDS", help="return the best motion found by then")
    plan.add_argument("--effort", type=int, metavar="UNITS", help="return the best motion found with so much work")
    plan.add_argument("--seed", type=natural, default=0, help="of the random numbers (default 0)")
    plan.add_argument("--quiet", action="store_true", help="no progress")
    plan.set_defaults(run=_plan)

    about = "Run the independent validation on a saved plan."
    check = commands.add_parser("check", help="validate a saved plan", description=about)
    check.add_argument("plan", metavar="PLAN", help="a plan saved with --save or Plan.save")
    check.set_defaults(run=_check)

    view = commands.add_parser("view", help="look at a scene or plan", description="Show a scene or a saved plan in the browser.")
    view.add_argument("what", metavar="SCENE|PLAN")
    view.add_argument("--html", metavar="FILE", help="write a page instead of starting a server")
    view.set_defaults(run=_view)

    about = "Write the motion of a saved plan for other programs."
    export = commands.add_parser("export", help="write a saved plan for other programs", description=about)
    export.add_argument("plan", metavar="PLAN", help="a plan saved with --save or Plan.save")
    export.add_argument("--csv", metavar="FILE", help="a table, a line a waypoint")
    export.add_argument("--json", metavar="FILE", help="trajectory, metrics and report as JSON")
    export.add_argument("--ros", metavar="FILE", help="JSON with the fields of trajectory_msgs/JointTrajectory")
    which = f"{', '.join(GROUPS)}, or names of coordinates with commas between; without it all in a table, robot for ROS"
    export.add_argument("--joints", metavar="WHICH", help=which)
    export.add_argument("--rate", type=float, metavar="HZ", help="points a second for ROS; without it the waypoints")
    export.set_defaults(run=_export)

    add_bench(commands)

    about = "Sample which links of a robot can never collide."
    srdf = commands.add_parser("srdf", help="regenerate allowed collisions", description=about)
    srdf.add_argument("robot", metavar="ROBOT", help="name or URDF file")
    srdf.add_argument("--output", required=True, metavar="FILE")
    srdf.add_argument("--samples", type=positive, default=20000)
    srdf.add_argument("--seed", type=natural, default=0)
    srdf.set_defaults(run=_srdf)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0 on success, 1 if no valid motion came out, 2 on misuse, 130 if Ctrl-C stopped an experiment."""
    arguments = _parser().parse_args(argv)
    arguments.given = list(sys.argv[1:] if argv is None else argv)
    try:
        return int(arguments.run(arguments))
    except BrokenPipeError:
        return EXIT_OK
    except (VkcError, OSError) as error:  # or a file that cannot be written, a full disk
        sys.stderr.write(f"vkc-pin: {error}\n")
        return EXIT_MISUSE


if __name__ == "__main__":
    sys.exit(main())
