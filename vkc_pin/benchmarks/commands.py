"""The command line of the benchmarks."""

from __future__ import annotations

import argparse
import functools
import importlib
import json
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vkc_pin.utils.interrupt import raise_on_interrupt

__all__ = ["EXIT_INTERRUPTED", "EXIT_OK", "add_bench", "natural", "positive", "stopped"]

EXIT_OK, EXIT_INTERRUPTED = 0, 130


def add_bench(commands: Any) -> None:
    """Add the command "bench" to a parser's commands."""
    bench = commands.add_parser(
        "bench", help="run a benchmark", description="Run a benchmark; every trial is recorded."
    )
    benches = bench.add_subparsers(required=True, metavar="BENCHMARK")
    door = benches.add_parser(
        "door", help="reach, push and whole task at the door, from random starts"
    )
    _add_starts(door, "--trials", 50, "random starts")
    door.add_argument("--json", metavar="FILE", help="write every trial")
    door.add_argument("--quiet", action="store_true", help="no progress bar")
    door.set_defaults(run=_bench_door)

    about = "Compare initialization methods in three scenes from the same random starts, and planning step by step."
    shown = "methods of initialising, at a task with a tool"
    initialization = _add_experiment(benches, "initialization", shown, about, "--starts")
    about = "trials per start and method (default 1)"
    initialization.add_argument("--repeats", type=positive, default=1, metavar="R", help=about)
    _add_choice(initialization, "scenes", "init_1 init_2 init_3 (default: all)")
    _add_choice(initialization, "methods", "stationary interpolated astar rrt auto (default: all)")

    for name, where, trials, tasks in (
        ("baselines", "at a door and a drawer", 50, "door drawer (default: both)"),
        (
            "household",
            "at six tasks in a home",
            20,
            "cup door drawer dishwasher refrigerator cabinet (default: all)",
        ),
    ):
        about = f"Compare planning base and arm together with planning them apart, {where}, from random starts."
        comparison = _add_experiment(
            benches, name, f"base and arm together or apart, {where}", about, default=trials
        )
        _add_choice(comparison, "tasks", tasks)
        others = "B1x1 B2x1 (as many waypoints as VKC, not twice as many) B1x3 B2x3"
        _add_choice(comparison, "methods", f"B1 B2 VKC (default: these) {others}")
        comparison.add_argument(
            "--max-evaluations",
            type=positive,
            metavar="E",
            help="evaluations that a trial may take (default 1000000)",
        )
        if name == "household":
            words = (
                "paper: the cup's and the dishwasher's tasks with the numbers of the paper's code"
            )
            comparison.add_argument("--variant", metavar="VARIANT", help=words)
        comparison.add_argument(
            "--save-failures", action="store_true", help="save the plans of failures, to be viewed"
        )

    about = "Plan chores of many steps, each in one call, from random starts."
    shown = "chores of many steps, in a home and in an arena"
    chores = _add_experiment(benches, "chores", shown, about, default=5, jobs=1)
    _add_choice(chores, "chores", "home fetch cluttered (default: all)")
    chores.add_argument(
        "--seeds",
        type=positive,
        default=1,
        metavar="K",
        help="seeds of planning to each start (default 1)",
    )
    chores.add_argument(
        "--step-by-step", action="store_true", help="plan the steps one by one as well"
    )

    shown = "planning time against the number of obstacles or segments"
    about = "Measure planning time against the number of obstacles, or of segments, at the door from random starts."
    scale = _add_experiment(benches, "scale", shown, about, "--starts", jobs=1)
    shown = "what there is more and more of: obstacles (default) or segments"
    scale.add_argument("--of", choices=("obstacles", "segments"), default="obstacles", help=shown)
    numbers = "how many (default: 10 30 100 300 1000 obstacles, 20 40 80 160 320 segments)"
    scale.add_argument("--counts", nargs="+", type=positive, metavar="N", help=numbers)

    about = (
        "Open a door and a drawer with every kind of base that drives, from the same random starts."
    )
    shown = "a door and a drawer with every kind of base that drives"
    bases = _add_experiment(
        benches, "bases", shown, about, jobs=1, what="random starts for each task and base"
    )
    bases.set_defaults(benchmark="driving.bases")
    _add_choice(bases, "tasks", "door drawer (default: both)")
    _add_choice(bases, "bases", "omni differential ackermann (default: all)")

    about = "Plan to drive through a gap of 0.85 m and to reach over a table beyond it, from random starts of base and arm."
    _add_experiment(benches, "gap", "reach over a table beyond a gap of 0.85 m", about, jobs=1)

    about = "Open objects with robots, by attachments that are proposed from the shapes, from random starts in a hall."
    shown = "robots × objects, by proposed attachments"
    anything = _add_experiment(
        benches,
        "anything",
        shown,
        about,
        "--starts",
        default=5,
        jobs=1,
        what="random starts of each combination",
    )
    anything.set_defaults(benchmark="robot_object_matrix.run")
    _add_choice(
        anything,
        "robots",
        "what `load_robot` takes: names, paths, name=path, and the word default (ten)",
    )
    objects = "<kind>_<seed> of random_object, names in scenes/objects, paths, name=path#link, and the word default (29 of ten)"
    _add_choice(anything, "objects", objects)

    about = (
        "Import robots from their makers' files, and let each reach random poses that it can reach."
    )
    shown = "robots imported from their makers' files reach random poses"
    robots = _add_experiment(
        benches, "robots", shown, about, "--goals", default=20, jobs=1, what="poses for each robot"
    )
    robots.set_defaults(benchmark="robot_object_matrix.robots")
    choices = "names of example-robot-data, paths of URDF, xacro and MJCF files (default: all arms and mobile manipulators there)"
    _add_choice(robots, "robots", choices)

    about = "Plan the tasks of the experiments from random starts and execute the plans in MuJoCo."
    shown = "plans executed in physics (needs the extra `sim`)"
    execution = _add_experiment(benches, "execution", shown, about, default=10, jobs=1)
    execution.set_defaults(benchmark="executing.execution")
    choices = "door corridor_door drawer household_refrigerator household_dishwasher household_cabinet household_cup init_1"
    _add_choice(execution, "tasks", f"{choices} (default: all)")
    execution.add_argument(
        "--grasp",
        default="weld",
        metavar="HOW",
        help="what holds: weld (default), or friction alone",
    )

    about = (
        "Make datasets of one task each, and say how many validated episodes an hour that gives."
    )
    shown, what = "validated episodes an hour", "episodes of each task"
    throughput = _add_experiment(
        benches,
        "throughput",
        shown,
        about,
        "--episodes",
        default=200,
        jobs=1,
        what=what,
        seeded=False,
    )
    throughput.set_defaults(benchmark="datasets.throughput")
    throughput.add_argument(
        "--recipe", metavar="RECIPE", help="robots, objects and rooms (default: home)"
    )
    shown = "do not make the same episodes with one worker and with two as well"
    throughput.add_argument("--no-curve", dest="curve", action="store_false", help=shown)

    about = "Give the same reaches, held doors and held drawers to other planners, to both baselines, and to this package."
    shown = "beside trajopt, OMPL and roboplan (needs the extra `peers`)"
    peers = _add_experiment(
        benches, "peers", shown, about, default=20, jobs=1, what="problems per task"
    )
    peers.set_defaults(benchmark="peers.run")
    _add_choice(peers, "tasks", "reach door drawer (default: all)")
    _add_choice(peers, "methods", "trajopt OMPL roboplan B1 B2 VKC (default: all)")
    peers.add_argument(
        "--time-limit",
        type=float,
        default=60.0,
        metavar="SECONDS",
        help="by the clock, for a trial (default 60)",
    )

    _add_problems(benches)


def _add_problems(benches: Any) -> None:
    """Add what is measured on problems that nothing was tuned on."""
    for name, shown, about in (
        (
            "ablation",
            "one setting changed at a time, on sixty problems",
            "Plan sixty problems, also with one setting changed.",
        ),
        (
            "spread",
            "what a random seed makes of sixty problems",
            "Plan each of sixty problems with several random seeds.",
        ),
    ):
        parser = _add_experiment(benches, name, shown, about, None, jobs=1)
        parser.set_defaults(benchmark=f"problems.{name}")
        parser.add_argument(
            "--problems",
            nargs="+",
            type=natural,
            metavar="N",
            help="numbers from 0 to 59 (default: all)",
        )
        if name == "ablation":
            form = "settings to change, one at a time: Options.FIELD=VALUE or MODULE:NAME=VALUE, e.g. solver.loop:PROGRESS=0.6"
            parser.add_argument("--changes", nargs="+", metavar="CHANGE", help=form)
            choices = "door drawer init_1 init_2 init_3 corridor_door ..., from random starts, instead of the sixty problems"
            _add_choice(parser, "tasks", choices)
            parser.add_argument(
                "--starts",
                type=positive,
                default=10,
                metavar="N",
                help="random starts per task (default 10)",
            )
        else:
            count = functools.partial(natural, least=2)
            parser.add_argument(
                "--seeds",
                type=count,
                default=5,
                metavar="K",
                help="random seeds per problem (default 5)",
            )
    about = "Measure how often the first seed trajectory suffices, at the tasks of all experiments, from random starts."
    first = _add_experiment(
        benches,
        "first-seed",
        "how often the first seed trajectory suffices",
        about,
        default=10,
        jobs=1,
    )
    first.set_defaults(benchmark="problems.first_seed")
    about = "Plan problems drawn at random, in rooms and in scenes that come along, and keep every plan to be judged by others."
    shown, what = "problems drawn at random, whose plans are kept", "problems"
    drawn = _add_experiment(
        benches, "random", shown, about, "--problems", default=100, jobs=1, what=what
    )
    drawn.set_defaults(benchmark="problems.random_problems")
    shown = "anything (default): steps at random, possible or not; rooms: something to open in each of as many random rooms"
    drawn.add_argument("--of", choices=("anything", "rooms"), default="anything", help=shown)
    about = "Plan problems that cannot be done, each for one known reason: how long that takes, and whether the report says why."
    shown = "problems that cannot be done: how soon that is said, and why"
    own = _add_experiment(
        benches, "impossible", shown, about, "--problems", default=50, jobs=1, what="problems"
    )
    own.set_defaults(benchmark="problems.impossible")
    _add_choice(
        first,
        "tasks",
        "door drawer init_1 init_2 init_3 corridor_door aisle_drawer household_cup ... (default: all)",
    )


def _add_experiment(
    benches: Any,
    name: str,
    shown: str,
    about: str,
    number: str | None = "--trials",
    *,
    default: int = 50,
    jobs: int | None = None,
    what: str | None = None,
    seeded: bool = True,
) -> argparse.ArgumentParser:
    """Add an experiment with what all have, by default `default` starts and `jobs` processes, or one per core.

    Without an option for their `number` the starts are fixed; `what` there are so many of, if not
    starts, and whether they have a seed.
    """
    parser: argparse.ArgumentParser = benches.add_parser(name, help=shown, description=about)
    _add_starts(
        parser,
        number,
        default,
        what or f"random starts per {'task' if number == '--trials' else 'scene'}",
        seeded,
    )
    processes = f"processes (default: {'one per core' if jobs is None else jobs})"
    parser.add_argument(
        "--jobs", type=positive, default=jobs or os.cpu_count() or 1, metavar="J", help=processes
    )
    shown = "address of a Dask scheduler, tcp://HOST:PORT, whose workers are used instead"
    parser.add_argument("--scheduler", metavar="ADDRESS", help=shown)
    about = "folder for results, table and charts; trials that it has already are not run again"
    parser.add_argument("--out", required=True, metavar="DIR", help=about)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=_bench_experiment, benchmark=name)
    return parser


def _add_starts(
    parser: argparse.ArgumentParser,
    number: str | None,
    default: int,
    about: str,
    seeded: bool = True,
) -> None:
    if number is not None:
        parser.add_argument(
            number, type=positive, default=default, metavar="N", help=f"{about} (default {default})"
        )
    seed = "of planning" if number is None else "of the starts and of planning"
    if seeded:
        parser.add_argument(
            "--seed", type=natural, default=0, metavar="S", help=f"{seed} (default 0)"
        )


def _add_choice(parser: argparse.ArgumentParser, names: str, choices: str) -> None:
    parser.add_argument(
        f"--{names}", nargs="+", metavar=names[:-1].upper(), help=f"some of {choices}"
    )


def _bench_door(arguments: argparse.Namespace) -> int:
    from vkc_pin.benchmarks import door
    from vkc_pin.world.files.writing import check_outputs, write_atomically

    if arguments.json is not None:
        check_outputs({"--json": arguments.json})
    with raise_on_interrupt():
        result = door.run(
            trials=arguments.trials, seed=arguments.seed, progress=not arguments.quiet
        )
    said = door.table(result) + "\n"
    if arguments.json is not None:
        said += f"wrote {write_atomically(arguments.json, (json.dumps(result, indent=1) + chr(10)).encode())}\n"
    sys.stdout.write(said)
    return EXIT_OK


def _bench_experiment(arguments: argparse.Namespace) -> int:
    """Run an experiment on the options that were given; print its table, or how to go on."""
    experiment = importlib.import_module(f"vkc_pin.benchmarks.{arguments.benchmark}")
    others = ("run", "benchmark", "given", "quiet")
    settings = {
        name: value
        for name, value in vars(arguments).items()
        if value is not None and name not in others
    }
    try:
        with raise_on_interrupt():
            experiment.run(**settings, progress=not arguments.quiet)
    except KeyboardInterrupt as stop:
        return stopped(arguments.given, stop)
    sys.stdout.write((Path(arguments.out) / "table.md").read_text(encoding="utf-8"))
    sys.stdout.write(
        f"\nThis table (table.md), its pictures, results.json and results.csv are in {arguments.out}\n"
    )
    return EXIT_OK


def stopped(given: Sequence[str], stop: KeyboardInterrupt) -> int:
    """Say how a command goes on that Ctrl-C has stopped; return its exit code.

    Args:
        given: The command's words after `vkc-pin`.
        stop: What it ended by; its text, if any, is said too.
    """
    again = shlex.join(["vkc-pin", *given])
    sys.stderr.write(
        f"\nvkc-pin: stopped{f'; {stop}' if str(stop) else ''}. The same command goes on from there:\n{again}\n"
    )
    return EXIT_INTERRUPTED


def natural(text: str, least: int = 0) -> int:
    """Return a whole number of at least 0, or what is the least."""
    if not text.isdigit() or int(text) < least:
        raise argparse.ArgumentTypeError(
            f"expected a whole number of at least {least}, got {text!r}"
        )
    return int(text)


positive = functools.partial(natural, least=1)
"""Returns a whole number of at least 1."""
