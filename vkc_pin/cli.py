"""The command line: plan, check, view, bench, srdf."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from vkc_pin.errors import InputError, VkcError

__all__ = ["main"]

EXIT_OK, EXIT_FAILED, EXIT_MISUSE, EXIT_INTERRUPTED = 0, 1, 2, 130


def parse_settings(settings: Sequence[str]) -> list[Any]:
    """Return `Actuate` steps of "object.joint=value" texts; neighbours of one object become one step.

    Raises:
        InputError: A text is not of that form.
    """
    from vkc_pin.steps import Actuate

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
    from vkc_pin.plan import write_atomically

    scene = vkc.load_scene(arguments.scene)
    steps = parse_settings(arguments.set)
    plan = vkc.plan(
        scene,
        steps,
        initialization=arguments.initialization,
        time_limit=arguments.time_limit,
        seed=arguments.seed,
        callback=None if arguments.quiet else _progress,
    )
    sys.stdout.write(plan.report() + "\n")
    if arguments.save:
        plan.save(arguments.save)
    if arguments.json:
        write_atomically(arguments.json, (json.dumps(plan.to_dict(), indent=1) + "\n").encode())
    if arguments.html:
        plan.to_html(arguments.html)
    if arguments.plots:
        folder = Path(arguments.plots)
        folder.mkdir(parents=True, exist_ok=True)
        plan.plot(folder)
    for option in ("save", "json", "html", "plots"):
        if getattr(arguments, option):
            sys.stdout.write(f"wrote {getattr(arguments, option)}\n")
    return EXIT_OK if plan.success else EXIT_FAILED


def _check(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin.validation import validate

    plan = vkc.Plan.load(arguments.plan)
    report = validate(plan.scene, plan.steps, plan.trajectory, plan.options)
    sys.stdout.write("\n".join(report.lines()) + "\n")
    return EXIT_OK if report.ok else EXIT_FAILED


def _view(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin import visualization

    shown: Any = vkc.Plan.load(arguments.what) if str(arguments.what).endswith(".npz") else vkc.load_scene(arguments.what)
    if arguments.html:
        sys.stdout.write(f"wrote {visualization.to_html(shown, arguments.html)}\n")
        return EXIT_OK
    visualization.show(shown)
    sys.stdout.write("press Enter to end\n")
    with contextlib.suppress(EOFError, KeyboardInterrupt):
        input()
    return EXIT_OK


def _bench_door(arguments: argparse.Namespace) -> int:
    from vkc_pin.benchmarks import door

    result = door.run(trials=arguments.trials, seed=arguments.seed, progress=not arguments.quiet)
    sys.stdout.write(door.table(result) + "\n")
    if arguments.json:
        from vkc_pin.plan import write_atomically

        write_atomically(arguments.json, (json.dumps(result, indent=1) + "\n").encode())
        sys.stdout.write(f"wrote {arguments.json}\n")
    return EXIT_OK


def _bench_initialization(arguments: argparse.Namespace) -> int:
    from vkc_pin.benchmarks import initialization

    return _experiment(
        arguments,
        initialization.run,
        starts=arguments.starts,
        repeats=arguments.repeats,
        scenes=arguments.scenes or initialization.SCENES,
        methods=arguments.methods or initialization.METHODS,
    )


def _bench_baselines(arguments: argparse.Namespace) -> int:
    from vkc_pin.benchmarks import baselines

    return _experiment(
        arguments,
        baselines.run,
        trials=arguments.trials,
        tasks=arguments.tasks or tuple(baselines.TASKS),
        methods=arguments.methods or baselines.METHODS,
        save_failures=arguments.save_failures,
    )


def _bench_scale(arguments: argparse.Namespace) -> int:
    from vkc_pin.benchmarks import scale

    return _experiment(arguments, scale.run, starts=arguments.starts, counts=arguments.obstacles or scale.COUNTS)


def _experiment(arguments: argparse.Namespace, run: Callable[..., Any], **settings: Any) -> int:
    """Run an experiment on the options that all of them have, and `settings`; print its table, or how to go on."""
    common = {"seed": arguments.seed, "jobs": arguments.jobs, "out": arguments.out}
    try:
        run(**common, **settings, progress=not arguments.quiet)
    except KeyboardInterrupt as stop:
        again = shlex.join(["vkc-pin", *arguments.given])
        sys.stderr.write(f"\nvkc-pin: stopped{f'; {stop}' if str(stop) else ''}. The same command goes on from there:\n{again}\n")
        return EXIT_INTERRUPTED
    sys.stdout.write((Path(arguments.out) / "table.md").read_text(encoding="utf-8"))
    sys.stdout.write(f"\nThis table (table.md), its pictures, results.json and results.csv are in {arguments.out}\n")
    return EXIT_OK


def _srdf(arguments: argparse.Namespace) -> int:
    from vkc_pin.allowed_collisions import write_srdf
    from vkc_pin.robot import load_robot

    written = write_srdf(load_robot(arguments.robot), arguments.output, samples=arguments.samples, seed=arguments.seed)
    sys.stdout.write(f"wrote {written}\n")
    return EXIT_OK


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return int(text)


def _natural(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0, got {text!r}")
    return int(text)


def _parser() -> argparse.ArgumentParser:
    from vkc_pin.version import __version__

    parser = argparse.ArgumentParser(prog="vkc-pin", description="Whole-body planning on virtual kinematic chains.")
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    plan = commands.add_parser("plan", help="plan a motion", description="Plan a motion that brings joints of objects to values.")
    plan.add_argument("scene", metavar="SCENE", help="name of a scene that comes with the package, or a YAML file")
    form = "OBJECT.JOINT=VALUE"
    plan.add_argument("--set", action="append", required=True, metavar=form, help="what should change, in this order")
    plan.add_argument("--html", metavar="FILE", help="write the animation, one self-contained page")
    plan.add_argument("--save", metavar="FILE", help="save the plan (.npz)")
    plan.add_argument("--json", metavar="FILE", help="write trajectory, metrics and report as JSON")
    plan.add_argument("--plots", metavar="FOLDER", help="write plots")
    plan.add_argument("--initialization", default="auto", metavar="METHOD", help="auto, interpolated, astar or stationary")
    plan.add_argument("--time-limit", type=float, metavar="SECONDS", help="return the best motion found by then")
    plan.add_argument("--seed", type=_natural, default=0, help="of the random numbers (default 0)")
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

    bench = commands.add_parser("bench", help="run a benchmark", description="Run a benchmark; every trial is recorded.")
    benches = bench.add_subparsers(required=True, metavar="BENCHMARK")
    door = benches.add_parser("door", help="reach, push and whole task at the door, from random starts")
    door.add_argument("--trials", type=_positive, default=50, metavar="N", help="random starts (default 50)")
    door.add_argument("--seed", type=_natural, default=0, metavar="S", help="of the starts and of planning (default 0)")
    door.add_argument("--json", metavar="FILE", help="write every trial")
    door.add_argument("--quiet", action="store_true", help="no progress bar")
    door.set_defaults(run=_bench_door)
    about = (
        "Compare ways of initialising the trajectory in three scenes, from the same random starts, and plan step after step too."
    )
    initialization = benches.add_parser("initialization", help="ways of initialising, at a task with a tool", description=about)
    _add_experiment_options(initialization, "--starts")
    initialization.add_argument(
        "--repeats", type=_positive, default=1, metavar="R", help="trials per start and method (default 1)"
    )
    initialization.add_argument("--scenes", nargs="+", metavar="SCENE", help="some of init_1 init_2 init_3 (default: all)")
    some = "some of stationary interpolated astar auto (default: all)"
    initialization.add_argument("--methods", nargs="+", metavar="METHOD", help=some)
    initialization.set_defaults(run=_bench_initialization)
    about = "Compare planning base and arm together with planning them apart, at a door and a drawer, from random starts."
    baselines = benches.add_parser("baselines", help="base and arm together or apart, at a door and a drawer", description=about)
    _add_experiment_options(baselines, "--trials")
    baselines.add_argument("--tasks", nargs="+", metavar="TASK", help="some of door drawer (default: both)")
    baselines.add_argument("--methods", nargs="+", metavar="METHOD", help="some of B1 B2 VKC (default: all)")
    baselines.add_argument("--save-failures", action="store_true", help="save the plans of failures, to be viewed")
    baselines.set_defaults(run=_bench_baselines)
    about = "Measure planning time against the number of obstacles, at the door from random starts."
    scale = benches.add_parser("scale", help="planning time against the number of obstacles", description=about)
    _add_experiment_options(scale, "--starts", jobs=1)
    numbers = "numbers of obstacles (default: 10 30 100 300 1000)"
    scale.add_argument("--obstacles", nargs="+", type=_positive, metavar="N", help=numbers)
    scale.set_defaults(run=_bench_scale)

    about = "Sample which links of a robot can never collide."
    srdf = commands.add_parser("srdf", help="regenerate allowed collisions", description=about)
    srdf.add_argument("robot", metavar="ROBOT", help="name or URDF file")
    srdf.add_argument("--output", required=True, metavar="FILE")
    srdf.add_argument("--samples", type=_positive, default=20000)
    srdf.add_argument("--seed", type=_natural, default=0)
    srdf.set_defaults(run=_srdf)
    return parser


def _add_experiment_options(parser: argparse.ArgumentParser, number: str, *, jobs: int | None = None) -> None:
    """Add what all experiments have; `jobs` is the default number of processes, None one per core."""
    parser.add_argument(number, type=_positive, default=50, metavar="N", help="random starts per scene (default 50)")
    parser.add_argument("--seed", type=_natural, default=0, metavar="S", help="of the starts and of planning (default 0)")
    processes = f"processes (default: {'one per core' if jobs is None else jobs})"
    parser.add_argument("--jobs", type=_positive, default=jobs or os.cpu_count() or 1, metavar="J", help=processes)
    about = "folder for results, table and charts; trials that it has already are not run again"
    parser.add_argument("--out", required=True, metavar="DIR", help=about)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return 0 on success, 1 if no valid motion came out, 2 on misuse, 130 if Ctrl-C stopped an experiment."""
    arguments = _parser().parse_args(argv)
    arguments.given = list(sys.argv[1:] if argv is None else argv)
    try:
        return int(arguments.run(arguments))
    except VkcError as error:
        sys.stderr.write(f"vkc-pin: {error}\n")
        return EXIT_MISUSE
    except BrokenPipeError:
        return EXIT_OK
    except OSError as error:  # a file that cannot be written, a full disk
        sys.stderr.write(f"vkc-pin: {error}\n")
        return EXIT_MISUSE


if __name__ == "__main__":
    sys.exit(main())
