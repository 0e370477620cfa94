"""The command line of the benchmarks."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["EXIT_INTERRUPTED", "EXIT_OK", "add_bench", "natural", "positive"]

EXIT_OK, EXIT_INTERRUPTED = 0, 130


def add_bench(commands: Any) -> None:
    """Add the command "bench" to a parser's commands."""
    bench = commands.add_parser("bench", help="run a benchmark", description="Run a benchmark; every trial is recorded.")
    benches = bench.add_subparsers(required=True, metavar="BENCHMARK")
    door = benches.add_parser("door", help="reach, push and whole task at the door, from random starts")
    door.add_argument("--trials", type=positive, default=50, metavar="N", help="random starts (default 50)")
    door.add_argument("--seed", type=natural, default=0, metavar="S", help="of the starts and of planning (default 0)")
    door.add_argument("--json", metavar="FILE", help="write every trial")
    door.add_argument("--quiet", action="store_true", help="no progress bar")
    door.set_defaults(run=_bench_door)
    about = (
        "Compare initialisations of the trajectory in three scenes, from the same random starts, and plan step after step too."
    )
    initialization = benches.add_parser(
        "initialization", help="methods of initialising, at a task with a tool", description=about
    )
    _add_experiment_options(initialization, "--starts")
    about = "trials per start and method (default 1)"
    initialization.add_argument("--repeats", type=positive, default=1, metavar="R", help=about)
    initialization.add_argument("--scenes", nargs="+", metavar="SCENE", help="some of init_1 init_2 init_3 (default: all)")
    some = "some of stationary interpolated astar auto (default: all)"
    initialization.add_argument("--methods", nargs="+", metavar="METHOD", help=some)
    initialization.set_defaults(run=_bench_initialization)
    about = "Compare planning base and arm together with planning them apart, at a door and a drawer, from random starts."
    baselines = benches.add_parser("baselines", help="base and arm together or apart, at a door and a drawer", description=about)
    _add_comparison_options(baselines, "door drawer (default: both)")
    baselines.set_defaults(run=_bench_comparison, experiment="baselines")
    about = "Compare planning base and arm together with planning them apart, at six tasks in a home, from random starts."
    household = benches.add_parser("household", help="base and arm together or apart, at six tasks in a home", description=about)
    some = "cup door drawer dishwasher refrigerator cabinet (default: all)"
    _add_comparison_options(household, some, trials=20)
    household.set_defaults(run=_bench_comparison, experiment="household")
    about = "Plan two chores, of eighteen and of ten steps, each in one call, from random starts."
    chores = benches.add_parser("chores", help="chores of many steps, in a home and in an arena", description=about)
    _add_experiment_options(chores, "--trials", default=5, jobs=1)
    chores.add_argument("--chores", nargs="+", metavar="CHORE", help="some of home fetch (default: both)")
    chores.set_defaults(run=_bench_chores)
    about = "Measure planning time against the number of obstacles, at the door from random starts."
    scale = benches.add_parser("scale", help="planning time against the number of obstacles", description=about)
    _add_experiment_options(scale, "--starts", jobs=1)
    numbers = "numbers of obstacles (default: 10 30 100 300 1000)"
    scale.add_argument("--obstacles", nargs="+", type=positive, metavar="N", help=numbers)
    scale.set_defaults(run=_bench_scale)


def _add_comparison_options(parser: argparse.ArgumentParser, tasks: str, *, trials: int = 50) -> None:
    _add_experiment_options(parser, "--trials", default=trials)
    parser.add_argument("--tasks", nargs="+", metavar="TASK", help=f"some of {tasks}")
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help="some of B1 B2 VKC (default: all)")
    parser.add_argument("--save-failures", action="store_true", help="save the plans of failures, to be viewed")


def _add_experiment_options(parser: argparse.ArgumentParser, number: str, *, default: int = 50, jobs: int | None = None) -> None:
    """Add what all experiments have, by default `default` starts and `jobs` processes, or one per core."""
    about = f"random starts per {'task' if number == '--trials' else 'scene'} (default {default})"
    parser.add_argument(number, type=positive, default=default, metavar="N", help=about)
    parser.add_argument("--seed", type=natural, default=0, metavar="S", help="of the starts and of planning (default 0)")
    processes = f"processes (default: {'one per core' if jobs is None else jobs})"
    parser.add_argument("--jobs", type=positive, default=jobs or os.cpu_count() or 1, metavar="J", help=processes)
    about = "folder for results, table and charts; trials that it has already are not run again"
    parser.add_argument("--out", required=True, metavar="DIR", help=about)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _bench_door(arguments: argparse.Namespace) -> int:
    from vkc_pin.benchmarks import door

    result = door.run(trials=arguments.trials, seed=arguments.seed, progress=not arguments.quiet)
    sys.stdout.write(door.table(result) + "\n")
    if arguments.json:
        from vkc_pin.files.writing import write_atomically

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
        methods=arguments.methods or initialization.COMPARED_INITIALIZATIONS,
    )


def _bench_comparison(arguments: argparse.Namespace) -> int:
    """Run an experiment that compares methods at tasks."""
    from vkc_pin.benchmarks import baselines, household

    experiment: Any = baselines if arguments.experiment == "baselines" else household
    return _experiment(
        arguments,
        experiment.run,
        trials=arguments.trials,
        tasks=arguments.tasks or tuple(experiment.TASKS),
        methods=arguments.methods or experiment.COMPARED_PLANNERS,
        save_failures=arguments.save_failures,
    )


def _bench_scale(arguments: argparse.Namespace) -> int:
    from vkc_pin.benchmarks import scale

    return _experiment(arguments, scale.run, starts=arguments.starts, counts=arguments.obstacles or scale.COUNTS)


def _bench_chores(arguments: argparse.Namespace) -> int:
    from vkc_pin.benchmarks import chores

    return _experiment(arguments, chores.run, trials=arguments.trials, chores=arguments.chores or tuple(chores.CHORES))


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


def natural(text: str, least: int = 0) -> int:
    """Return a whole number of at least 0, or what is the least."""
    if not text.isdigit() or int(text) < least:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least {least}, got {text!r}")
    return int(text)


def positive(text: str) -> int:
    """Return a whole number of at least 1."""
    return natural(text, least=1)
