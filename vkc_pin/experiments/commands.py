"""Adds the experiments to the command line."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from vkc_pin.utils.command_line import (
    EXIT_OK,
    parse_natural,
    parse_positive,
    report_interruption,
)
from vkc_pin.utils.interrupt import raise_on_interrupt
from vkc_pin.utils.parallel import is_dask_installed


def add_bench(commands: Any) -> None:
    """Add the command "bench" to the subparsers of a parser."""
    about = "Run an experiment; every trial is recorded."
    bench = commands.add_parser("bench", help="run an experiment", description=about)
    benches = bench.add_subparsers(required=True, metavar="EXPERIMENT")
    _add_door(benches)
    _add_comparisons(benches)
    _add_chores(benches)
    _add_execution(benches)
    _add_closed_loop(benches)


def _add_door(benches: Any) -> None:
    door = benches.add_parser("door", help="reach, push and whole task at the door")
    add_count(door, "--trials", 50, "random starts")
    _add_seed_option(door)
    door.add_argument("--json", metavar="FILE", help="write every trial")
    door.add_argument("--quiet", action="store_true", help="hide the progress bar")
    door.set_defaults(run=_bench_door)


def _add_comparisons(benches: Any) -> None:
    about = "compare initialization methods at a task with a tool"
    jobs = (os.cpu_count() or 1) if is_dask_installed() else 1
    module = "vkc_pin.experiments.initialization"
    parser = add_experiment(benches, "initialization", about, module=module, jobs=jobs)
    add_count(parser, "--starts", 50, "random starts per scene")
    add_count(parser, "--repeats", 1, "trials per start and method")
    add_choice(parser, "scenes", "init_1 init_2 init_3 (default: all)")
    add_choice(parser, "methods", "stationary interpolated astar rrt auto (default: all)")

    household = "cup door drawer dishwasher refrigerator cabinet"
    tasks = {
        "baselines": ("door_and_drawer", 50, "at a door and a drawer", "door drawer"),
        "household": ("household", 20, "in a home", household),
    }
    for name, (file, trials, where, names) in tasks.items():
        module = f"vkc_pin.experiments.{file}"
        about = f"compare simultaneous with separate planning of base and arm, {where}"
        parser = add_experiment(benches, name, about, module=module, jobs=jobs)
        add_count(parser, "--trials", trials, "random starts per task")
        add_choice(parser, "tasks", f"{names} (default: all)")
        finer = "B1x1 B2x1 (as many waypoints as VKC, not twice as many) B1x3 B2x3"
        add_choice(parser, "methods", f"B1 B2 VKC (default: these) {finer}")
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


def _add_chores(benches: Any) -> None:
    about = "plan chores of many steps, each in one call"
    parser = add_experiment(benches, "chores", about, module="vkc_pin.experiments.chores")
    add_count(parser, "--trials", 5, "random starts per chore")
    add_count(parser, "--seeds", 1, "random seeds of planning per start", metavar="K")
    add_choice(parser, "chores", "home fetch cluttered (default: all)")
    about = "also plan the steps one by one"
    parser.add_argument("--step-by-step", action="store_true", help=about)


def _add_execution(benches: Any) -> None:
    about = "execute plans of the experiments' tasks in MuJoCo (needs the extra `sim`)"
    module = "vkc_pin.experiments.execution"
    parser = add_experiment(benches, "execution", about, module=module)
    add_count(parser, "--trials", 10, "random starts per task")
    tasks = "door corridor_door drawer household_refrigerator household_dishwasher"
    add_choice(parser, "tasks", f"{tasks} household_cabinet household_cup init_1 (default: all)")
    about = "weld (default), or friction"
    parser.add_argument("--grasp", default="weld", metavar="MODEL", help=about)
    about = "execute and measure the grasp, displace the hand by MM, and plan the rest from there"
    parser.add_argument("--off", nargs="+", type=float, default=[], metavar="MM", help=about)


def _add_closed_loop(benches: Any) -> None:
    about = "execute plans in MuJoCo while the world differs from them (needs the extra `sim`)"
    module = "vkc_pin.experiments.closed_loop"
    parser = add_experiment(benches, "closed-loop", about, module=module)
    add_count(parser, "--trials", 20, "random starts per row and task")
    tasks = "door corridor_door drawer household_refrigerator household_cabinet household_cup"
    add_choice(parser, "tasks", f"{tasks} (default: all)")
    rows = "nothing displaced obstacle person localisation grasp axis"
    add_choice(parser, "rows", f"{rows} (default: all)")
    about = "save how the robots really moved, as plans"
    parser.add_argument("--save-motions", action="store_true", help=about)


def add_experiment(
    benches: Any,
    name: str,
    about: str,
    *,
    module: str,
    jobs: int = 1,
    seeded: bool = True,
) -> argparse.ArgumentParser:
    """Add an experiment with the common options to subparsers.

    Args:
        benches: The subparsers.
        name: Name of the command.
        about: Beginning of a sentence about it, for the help.
        module: Module with a function `run` that takes the options.
        jobs: Default number of processes.
        seeded: Whether it takes a random seed.
    """
    description = f"{about[0].upper()}{about[1:]}."
    parser: argparse.ArgumentParser = benches.add_parser(name, help=about, description=description)
    if seeded:
        _add_seed_option(parser)
    add_count(parser, "--jobs", jobs, "processes", metavar="J")
    about = "address of a Dask scheduler, tcp://HOST:PORT, whose workers run the trials"
    parser.add_argument("--scheduler", metavar="ADDRESS", help=about)
    about = "folder for results, tables and charts; completed trials are not repeated"
    parser.add_argument("--out", required=True, metavar="DIR", help=about)
    parser.add_argument("--quiet", action="store_true", help="hide the progress bar")
    parser.set_defaults(run=_bench_experiment, module=module)
    return parser


def add_count(
    parser: argparse.ArgumentParser, option: str, default: int, about: str, metavar: str = "N"
) -> None:
    """Add an option with a positive number."""
    about = f"{about} (default {default})"
    parser.add_argument(option, type=parse_positive, default=default, metavar=metavar, help=about)


def _add_seed_option(parser: argparse.ArgumentParser) -> None:
    about = "random seed of starts and planning (default 0)"
    parser.add_argument("--seed", type=parse_natural, default=0, metavar="S", help=about)


def add_choice(parser: argparse.ArgumentParser, names: str, choices: str) -> None:
    """Add an option with some of several names."""
    about = f"some of {choices}"
    parser.add_argument(f"--{names}", nargs="+", metavar=names[:-1].upper(), help=about)


def _bench_door(arguments: argparse.Namespace) -> int:
    """Run the experiment at the door and print its table."""
    from vkc_pin.experiments import door
    from vkc_pin.world.files.writing import check_outputs, write_atomically

    if arguments.json is not None:
        check_outputs({"--json": arguments.json})
    progress = not arguments.quiet
    with raise_on_interrupt():
        result = door.run(trials=arguments.trials, seed=arguments.seed, progress=progress)
    text = door.table(result) + "\n"
    if arguments.json is not None:
        document = json.dumps(result, indent=1) + "\n"
        path = write_atomically(arguments.json, document.encode())
        text += f"wrote {path}\n"
    sys.stdout.write(text)
    return EXIT_OK


def _bench_experiment(arguments: argparse.Namespace) -> int:
    """Run an experiment and print its table, or how to resume it."""
    experiment = importlib.import_module(arguments.module)
    settings = dict(vars(arguments))
    for name in ("run", "module", "command", "quiet"):
        settings.pop(name, None)
    settings = {name: value for name, value in settings.items() if value is not None}
    try:
        with raise_on_interrupt():
            experiment.run(**settings, progress=not arguments.quiet)
    except KeyboardInterrupt as stop:
        return report_interruption(arguments.command, stop)
    table = (Path(arguments.out) / "table.md").read_text(encoding="utf-8")
    files = "This table (table.md), its pictures, results.json and results.csv"
    sys.stdout.write(f"{table}\n{files} are in {arguments.out}\n")
    return EXIT_OK
