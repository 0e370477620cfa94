"""Parses the command line of the benchmarks."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Sequence
from typing import Any

from vkc_pin.errors import VkcError
from vkc_pin.experiments.commands import add_choice, add_count, add_experiment
from vkc_pin.utils.command_line import parse_natural, parse_positive

PROGRAM = ("python", "-m", "tests.benchmarks")


def main(arguments: Sequence[str]) -> int:
    """Run a benchmark; return the exit code."""
    parser = make_parser()
    parsed = parser.parse_args(arguments)
    parsed.command = [*PROGRAM, *arguments]
    try:
        return int(parsed.run(parsed))
    except VkcError as error:
        parser.error(str(error))


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; each benchmark sets `run`, a function of the arguments."""
    about = "Run a benchmark; every trial is recorded."
    parser = argparse.ArgumentParser(prog=" ".join(PROGRAM), description=about)
    benches = parser.add_subparsers(required=True, metavar="BENCHMARK")
    _add_peers(benches)
    _add_scenes(benches)
    _add_arms(benches)
    _add_matrix(benches)
    _add_problems(benches)
    return parser


def _add_peers(benches: Any) -> None:
    about = "compare with trajopt, OMPL, roboplan and HPP (needs the extra `peers`)"
    parser = _add_benchmark(benches, "peers", about, "peers.run")
    add_count(parser, "--trials", 20, "problems per task")
    add_choice(parser, "tasks", "reach door drawer (default: all)")
    add_choice(parser, "methods", "trajopt OMPL roboplan HPP B1 B2 VKC (default: all)")
    _add_time_limit(parser)


def _add_scenes(benches: Any) -> None:
    about = "measure planning time against the number of obstacles or segments"
    parser = _add_benchmark(benches, "scale", about, "scale")
    add_count(parser, "--starts", 50, "random starts per scene")
    of = ("obstacles", "segments")
    about = f"varied quantity (default: {of[0]})"
    parser.add_argument("--of", choices=of, default=of[0], help=about)
    about = "numbers of them (default: 10 30 100 300 1000 obstacles, 20 40 80 160 320 segments)"
    parser.add_argument("--counts", nargs="+", type=parse_positive, metavar="N", help=about)

    about = "open a door and a drawer with every kind of base"
    parser = _add_benchmark(benches, "bases", about, "bases")
    add_count(parser, "--trials", 50, "random starts per task and base")
    add_choice(parser, "tasks", "door drawer (default: both)")
    add_choice(parser, "bases", "omni differential ackermann (default: all)")
    about = "names or robot.yaml files of other robots (default: the robot of the scenes)"
    parser.add_argument("--robots", nargs="+", metavar="ROBOT", help=about)

    about = "plan in a room from maps, clouds and files, beside the one that is described by hand"
    parser = _add_benchmark(benches, "worlds", about, "worlds")
    add_count(parser, "--starts", 5, "random starts per source")
    about = "sources of the room (default: all)"
    parser.add_argument("--sources", nargs="+", metavar="SOURCE", help=about)

    about = "plan motions again, towards objects that have been displaced"
    parser = _add_benchmark(benches, "replans", about, "replans")
    add_count(parser, "--starts", 15, "random starts and displacements per task")
    add_choice(parser, "tasks", "door corridor_door drawer household_refrigerator (default: all)")

    parser = _add_benchmark(benches, "gap", "reach over a table beyond a gap of 0.85 m", "gap")
    add_count(parser, "--trials", 50, "random starts of base and arm")

    about = "measure validated episodes per hour of each dataset task"
    parser = _add_benchmark(benches, "throughput", about, "throughput", seeded=False)
    add_count(parser, "--episodes", 200, "episodes per task")
    about = "robots, objects and rooms (default: home)"
    parser.add_argument("--recipe", metavar="RECIPE", help=about)
    about = "do not repeat the episodes with one and two workers"
    parser.add_argument("--no-curve", dest="curve", action="store_false", help=about)


def _add_arms(benches: Any) -> None:
    about = "plan for an arm on MoveIt's problems, beside roboplan and OMPL (extra `peers`)"
    parser = _add_benchmark(benches, "arms", about, "arms")
    about = "folder with files scene0001.yaml and request0001.yaml"
    parser.add_argument("folder", metavar="FOLDER", help=about)
    parser.add_argument("--robot", required=True, metavar="ROBOT", help="name or robot.yaml file")
    add_choice(parser, "methods", "VKC roboplan OMPL (default: all)")
    add_choice(parser, "bases", "fixed omni (default: fixed)")
    add_choice(parser, "goals", "joints pose (default: joints)")
    add_count(parser, "--every", 1, "only every so many problems", metavar="K")
    _add_time_limit(parser)


def _add_matrix(benches: Any) -> None:
    about = "open objects with robots by proposed attachments"
    parser = _add_benchmark(benches, "anything", about, "robot_object_matrix.run")
    add_count(parser, "--starts", 5, "random starts per combination")
    add_choice(
        parser, "robots", "names and files for `load_robot`, name=path, and default (ten robots)"
    )
    objects = "<kind>_<seed> of random_object, names in scenes/objects, paths, name=path#link"
    add_choice(parser, "objects", f"{objects}, and default (29 objects of ten kinds)")

    about = "import robots from their manufacturers' files and reach random poses"
    parser = _add_benchmark(benches, "robots", about, "robot_object_matrix.robots")
    add_count(parser, "--goals", 20, "poses per robot")
    robots = "names of example-robot-data, and paths of URDF, xacro and MJCF files"
    add_choice(parser, "robots", f"{robots} (default: its arms and mobile manipulators)")


def _add_problems(benches: Any) -> None:
    ablation = _add_benchmark(
        benches, "ablation", "change one setting at a time", "problems.ablation"
    )
    about = "settings to change, one at a time: Options.FIELD=VALUE or MODULE:NAME=VALUE"
    about += ", e.g. solver.loop:PROGRESS=0.6"
    ablation.add_argument("--changes", nargs="+", metavar="CHANGE", help=about)
    tasks = "door drawer init_1 init_2 init_3 corridor_door ..."
    add_choice(ablation, "tasks", f"{tasks}, from random starts, instead of sixty problems")
    add_count(ablation, "--starts", 10, "random starts per task")
    about = "plan each of sixty problems with several random seeds"
    spread = _add_benchmark(benches, "spread", about, "problems.spread")
    least = functools.partial(parse_natural, least=2)
    about = "random seeds per problem (default 5)"
    spread.add_argument("--seeds", type=least, default=5, metavar="K", help=about)
    for parser in (ablation, spread):
        about = "numbers from 0 to 59 (default: all)"
        parser.add_argument("--problems", nargs="+", type=parse_natural, metavar="N", help=about)

    about = "count how often the first initial guess suffices"
    parser = _add_benchmark(benches, "first-seed", about, "problems.first_seed")
    add_count(parser, "--trials", 10, "random starts per task")
    add_choice(parser, "tasks", f"{tasks} (default: all)")

    about = "plan random problems and save the plans"
    parser = _add_benchmark(benches, "random", about, "problems.random_problems")
    add_count(parser, "--problems", 100, "problems")
    about = "anything (default): random steps, feasible or not; rooms: one task in each random room"
    parser.add_argument("--of", choices=("anything", "rooms"), default="anything", help=about)

    about = "plan impossible problems with known reasons"
    parser = _add_benchmark(benches, "impossible", about, "problems.impossible")
    add_count(parser, "--problems", 50, "problems")


def _add_time_limit(parser: argparse.ArgumentParser) -> None:
    about = "wall-clock limit of a trial (default 60)"
    parser.add_argument("--time-limit", type=float, default=60.0, metavar="SECONDS", help=about)


def _add_benchmark(
    benches: Any, name: str, about: str, module: str, *, seeded: bool = True
) -> argparse.ArgumentParser:
    """Add a benchmark, which the function `run` of a module in this folder runs."""
    return add_experiment(benches, name, about, module=f"{__package__}.{module}", seeded=seeded)
