"""Adds the experiments to the command line."""

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

__all__ = [
    "EXIT_INTERRUPTED",
    "EXIT_OK",
    "add_bench",
    "parse_natural",
    "parse_positive",
    "report_interruption",
]

EXIT_OK, EXIT_INTERRUPTED = 0, 130


def add_bench(commands: Any) -> None:
    """Add the command "bench" to the subparsers of a parser."""
    about = "Run an experiment; every trial is recorded."
    bench = commands.add_parser("bench", help="run an experiment", description=about)
    benches = bench.add_subparsers(required=True, metavar="BENCHMARK")
    _add_door(benches)
    _add_comparisons(benches)
    _add_scenes(benches)
    _add_arms(benches)
    _add_matrix(benches)
    _add_problems(benches)


def _add_door(benches: Any) -> None:
    door = benches.add_parser("door", help="reach, push and whole task at the door")
    _add_count(door, "--trials", 50, "random starts")
    _add_seed_option(door)
    door.add_argument("--json", metavar="FILE", help="write every trial")
    door.add_argument("--quiet", action="store_true", help="hide the progress bar")
    door.set_defaults(run=_bench_door)


def _add_comparisons(benches: Any) -> None:
    about = "compare initialization methods at a task with a tool"
    parser = _add_experiment(benches, "initialization", about, jobs=os.cpu_count() or 1)
    _add_count(parser, "--starts", 50, "random starts per scene")
    _add_count(parser, "--repeats", 1, "trials per start and method")
    _add_choice(parser, "scenes", "init_1 init_2 init_3 (default: all)")
    _add_choice(parser, "methods", "stationary interpolated astar rrt auto (default: all)")

    tasks = {
        "baselines": (50, "at a door and a drawer", "door drawer"),
        "household": (20, "in a home", "cup door drawer dishwasher refrigerator cabinet"),
    }
    for name, (trials, where, names) in tasks.items():
        about = f"compare simultaneous with separate planning of base and arm, {where}"
        parser = _add_experiment(benches, name, about, jobs=os.cpu_count() or 1)
        _add_count(parser, "--trials", trials, "random starts per task")
        _add_choice(parser, "tasks", f"{names} (default: all)")
        finer = "B1x1 B2x1 (as many waypoints as VKC, not twice as many) B1x3 B2x3"
        _add_choice(parser, "methods", f"B1 B2 VKC (default: these) {finer}")
        parser.add_argument(
            "--max-evaluations",
            type=parse_positive,
            metavar="E",
            help="evaluation budget per trial (default 1000000)",
        )
        if name == "household":
            about = "paper: the tasks of cup and dishwasher with the numbers of the paper's code"
            parser.add_argument("--variant", metavar="VARIANT", help=about)
        about = "save the plans of failures"
        parser.add_argument("--save-failures", action="store_true", help=about)

    about = "compare with trajopt, OMPL, roboplan and HPP (needs the extra `peers`)"
    parser = _add_experiment(benches, "peers", about, module="peers.run")
    _add_count(parser, "--trials", 20, "problems per task")
    _add_choice(parser, "tasks", "reach door drawer (default: all)")
    _add_choice(parser, "methods", "trajopt OMPL roboplan HPP B1 B2 VKC (default: all)")
    about = "wall-clock limit of a trial (default 60)"
    parser.add_argument("--time-limit", type=float, default=60.0, metavar="SECONDS", help=about)


def _add_scenes(benches: Any) -> None:
    about = "plan chores of many steps, each in one call"
    parser = _add_experiment(benches, "chores", about)
    _add_count(parser, "--trials", 5, "random starts per chore")
    _add_count(parser, "--seeds", 1, "random seeds of planning per start", metavar="K")
    _add_choice(parser, "chores", "home fetch cluttered (default: all)")
    about = "also plan the steps one by one"
    parser.add_argument("--step-by-step", action="store_true", help=about)

    about = "measure planning time against the number of obstacles or segments"
    parser = _add_experiment(benches, "scale", about)
    _add_count(parser, "--starts", 50, "random starts per scene")
    of = ("obstacles", "segments")
    about = f"varied quantity (default: {of[0]})"
    parser.add_argument("--of", choices=of, default=of[0], help=about)
    about = "numbers of them (default: 10 30 100 300 1000 obstacles, 20 40 80 160 320 segments)"
    parser.add_argument("--counts", nargs="+", type=parse_positive, metavar="N", help=about)

    about = "open a door and a drawer with every kind of base"
    parser = _add_experiment(benches, "bases", about, module="bases")
    _add_count(parser, "--trials", 50, "random starts per task and base")
    _add_choice(parser, "tasks", "door drawer (default: both)")
    _add_choice(parser, "bases", "omni differential ackermann (default: all)")
    about = "names or robot.yaml files of other robots (default: the robot of the scenes)"
    parser.add_argument("--robots", nargs="+", metavar="ROBOT", help=about)

    parser = _add_experiment(benches, "gap", "reach over a table beyond a gap of 0.85 m")
    _add_count(parser, "--trials", 50, "random starts of base and arm")

    about = "execute plans of the experiments' tasks in MuJoCo (needs the extra `sim`)"
    parser = _add_experiment(benches, "execution", about, module="execution")
    _add_count(parser, "--trials", 10, "random starts per task")
    tasks = "door corridor_door drawer household_refrigerator household_dishwasher"
    _add_choice(parser, "tasks", f"{tasks} household_cabinet household_cup init_1 (default: all)")
    about = "weld (default), or friction"
    parser.add_argument("--grasp", default="weld", metavar="MODEL", help=about)
    about = "execute and measure the grasp, displace the hand by MM, and plan the rest from there"
    parser.add_argument("--off", nargs="+", type=float, default=[], metavar="MM", help=about)

    about = "measure validated episodes per hour of each dataset task"
    parser = _add_experiment(benches, "throughput", about, module="throughput", seeded=False)
    _add_count(parser, "--episodes", 200, "episodes per task")
    about = "robots, objects and rooms (default: home)"
    parser.add_argument("--recipe", metavar="RECIPE", help=about)
    about = "do not repeat the episodes with one and two workers"
    parser.add_argument("--no-curve", dest="curve", action="store_false", help=about)


def _add_arms(benches: Any) -> None:
    about = "plan for an arm on MoveIt's problems, beside roboplan and OMPL (extra `peers`)"
    parser = _add_experiment(benches, "arms", about)
    about = "folder with files scene0001.yaml and request0001.yaml"
    parser.add_argument("folder", metavar="FOLDER", help=about)
    parser.add_argument("--robot", required=True, metavar="ROBOT", help="name or robot.yaml file")
    _add_choice(parser, "methods", "VKC roboplan OMPL (default: all)")
    _add_choice(parser, "bases", "fixed omni (default: fixed)")
    _add_choice(parser, "goals", "joints pose (default: joints)")
    _add_count(parser, "--every", 1, "only every so many problems", metavar="K")
    about = "wall-clock limit of a trial (default 60)"
    parser.add_argument("--time-limit", type=float, default=60.0, metavar="SECONDS", help=about)


def _add_matrix(benches: Any) -> None:
    about = "open objects with robots by proposed attachments"
    parser = _add_experiment(benches, "anything", about, module="robot_object_matrix.run")
    _add_count(parser, "--starts", 5, "random starts per combination")
    _add_choice(
        parser, "robots", "names and files for `load_robot`, name=path, and default (ten robots)"
    )
    objects = "<kind>_<seed> of random_object, names in scenes/objects, paths, name=path#link"
    _add_choice(parser, "objects", f"{objects}, and default (29 objects of ten kinds)")

    about = "import robots from their manufacturers' files and reach random poses"
    parser = _add_experiment(benches, "robots", about, module="robot_object_matrix.robots")
    _add_count(parser, "--goals", 20, "poses per robot")
    robots = "names of example-robot-data, and paths of URDF, xacro and MJCF files"
    _add_choice(parser, "robots", f"{robots} (default: its arms and mobile manipulators)")


def _add_problems(benches: Any) -> None:
    ablation = _add_experiment(
        benches, "ablation", "change one setting at a time", module="problems.ablation"
    )
    about = "settings to change, one at a time: Options.FIELD=VALUE or MODULE:NAME=VALUE"
    about += ", e.g. solver.loop:PROGRESS=0.6"
    ablation.add_argument("--changes", nargs="+", metavar="CHANGE", help=about)
    tasks = "door drawer init_1 init_2 init_3 corridor_door ..."
    _add_choice(ablation, "tasks", f"{tasks}, from random starts, instead of sixty problems")
    _add_count(ablation, "--starts", 10, "random starts per task")
    about = "plan each of sixty problems with several random seeds"
    spread = _add_experiment(benches, "spread", about, module="problems.spread")
    least = functools.partial(parse_natural, least=2)
    about = "random seeds per problem (default 5)"
    spread.add_argument("--seeds", type=least, default=5, metavar="K", help=about)
    for parser in (ablation, spread):
        about = "numbers from 0 to 59 (default: all)"
        parser.add_argument("--problems", nargs="+", type=parse_natural, metavar="N", help=about)

    about = "count how often the first initial guess suffices"
    parser = _add_experiment(benches, "first-seed", about, module="problems.first_seed")
    _add_count(parser, "--trials", 10, "random starts per task")
    _add_choice(parser, "tasks", f"{tasks} (default: all)")

    about = "plan random problems and save the plans"
    parser = _add_experiment(benches, "random", about, module="problems.random_problems")
    _add_count(parser, "--problems", 100, "problems")
    about = "anything (default): random steps, feasible or not; rooms: one task in each random room"
    parser.add_argument("--of", choices=("anything", "rooms"), default="anything", help=about)

    about = "plan impossible problems with known reasons"
    parser = _add_experiment(benches, "impossible", about, module="problems.impossible")
    _add_count(parser, "--problems", 50, "problems")


def _add_experiment(
    benches: Any,
    name: str,
    about: str,
    *,
    module: str | None = None,
    jobs: int = 1,
    seeded: bool = True,
) -> argparse.ArgumentParser:
    """Add an experiment with the common options."""
    description = f"{about[0].upper()}{about[1:]}."
    parser: argparse.ArgumentParser = benches.add_parser(name, help=about, description=description)
    if seeded:
        _add_seed_option(parser)
    _add_count(parser, "--jobs", jobs, "processes", metavar="J")
    about = "address of a Dask scheduler, tcp://HOST:PORT, whose workers run the trials"
    parser.add_argument("--scheduler", metavar="ADDRESS", help=about)
    about = "folder for results, tables and charts; completed trials are not repeated"
    parser.add_argument("--out", required=True, metavar="DIR", help=about)
    parser.add_argument("--quiet", action="store_true", help="hide the progress bar")
    parser.set_defaults(run=_bench_experiment, benchmark=module or name)
    return parser


def _add_count(
    parser: argparse.ArgumentParser, option: str, default: int, about: str, metavar: str = "N"
) -> None:
    about = f"{about} (default {default})"
    parser.add_argument(option, type=parse_positive, default=default, metavar=metavar, help=about)


def _add_seed_option(parser: argparse.ArgumentParser) -> None:
    about = "random seed of starts and planning (default 0)"
    parser.add_argument("--seed", type=parse_natural, default=0, metavar="S", help=about)


def _add_choice(parser: argparse.ArgumentParser, names: str, choices: str) -> None:
    about = f"some of {choices}"
    parser.add_argument(f"--{names}", nargs="+", metavar=names[:-1].upper(), help=about)


def _bench_door(arguments: argparse.Namespace) -> int:
    from vkc_pin.benchmarks import door
    from vkc_pin.world.files.writing import check_outputs, write_atomically

    if arguments.json is not None:
        check_outputs({"--json": arguments.json})
    with raise_on_interrupt():
        result = door.run(
            trials=arguments.trials, seed=arguments.seed, progress=not arguments.quiet
        )
    text = door.table(result) + "\n"
    if arguments.json is not None:
        data = (json.dumps(result, indent=1) + "\n").encode()
        text += f"wrote {write_atomically(arguments.json, data)}\n"
    sys.stdout.write(text)
    return EXIT_OK


def _bench_experiment(arguments: argparse.Namespace) -> int:
    """Run an experiment and print its table, or how to resume it."""
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
        return report_interruption(arguments.given, stop)
    table = (Path(arguments.out) / "table.md").read_text(encoding="utf-8")
    files = "This table (table.md), its pictures, results.json and results.csv"
    sys.stdout.write(f"{table}\n{files} are in {arguments.out}\n")
    return EXIT_OK


def report_interruption(given: Sequence[str], stop: KeyboardInterrupt) -> int:
    """Print how to resume an interrupted command; return its exit code.

    Args:
        given: Arguments of `vkc-pin`.
        stop: The interruption; its text is also printed.
    """
    again = shlex.join(["vkc-pin", *given])
    detail = f"; {stop}" if str(stop) else ""
    sys.stderr.write(f"\nvkc-pin: stopped{detail}. The same command resumes it:\n{again}\n")
    return EXIT_INTERRUPTED


def parse_natural(text: str, least: int = 0) -> int:
    """Parse a whole number of at least `least`."""
    if not text.isdigit() or int(text) < least:
        raise argparse.ArgumentTypeError(
            f"expected a whole number of at least {least}, got {text!r}"
        )
    return int(text)


parse_positive = functools.partial(parse_natural, least=1)
"""Parses a whole number of at least 1."""
