"""The commands of datasets: `generate` makes one, `dataset check` validates one again."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from vkc_pin.benchmarks.commands import EXIT_OK, parse_natural, parse_positive, report_interruption
from vkc_pin.errors import InputError, VkcError
from vkc_pin.utils.interrupt import raise_on_interrupt

__all__ = ["add_datasets"]

_FAILED = 1


def add_datasets(commands: Any) -> None:
    """Add the commands to those of a parser."""
    about = (
        "Make a dataset of a recipe: episodes, each a scene with a timed motion that the independent validation accepts. The "
        "same command goes on where it was stopped, and with more episodes adds to them."
    )
    generate = commands.add_parser(
        "generate", help="make a dataset of checked motions", description=about
    )
    generate.add_argument(
        "recipe",
        metavar="RECIPE",
        help="name of a recipe that comes with the package, or a YAML file",
    )
    # Looked at by generate(), which says what is wrong with it as with the recipe.
    generate.add_argument(
        "--episodes", type=int, required=True, metavar="N", help="how many episodes"
    )
    generate.add_argument("--out", required=True, metavar="DIR", help="folder of the dataset")
    generate.add_argument(
        "--jobs", type=int, default=1, metavar="J", help="processes on this machine (default 1)"
    )
    shown = "address of a Dask scheduler, tcp://HOST:PORT, whose workers are used instead"
    generate.add_argument("--scheduler", metavar="ADDRESS", help=shown)
    generate.add_argument(
        "--variants",
        type=int,
        metavar="K",
        help="motions for each problem, instead of the recipe's number",
    )
    shown = "keep only episodes that physics confirms (needs the extra `sim`)"
    generate.add_argument("--simulate", action="store_true", default=None, help=shown)
    shown = "keep what cameras on the robot see of it, those of the recipe or of the head and the hand (with --simulate)"
    generate.add_argument("--cameras", action="store_true", help=shown)
    generate.add_argument(
        "--lerobot",
        action="store_true",
        help="write LeRobot's layout as well, a dataset for each robot",
    )
    generate.add_argument("--quiet", action="store_true", help="no progress bar")
    generate.set_defaults(run=_generate)

    dataset = commands.add_parser(
        "dataset",
        help="look at a dataset",
        description="Look at a dataset that `generate` has made.",
    )
    inner = dataset.add_subparsers(required=True, metavar="WHAT")
    about = "Validate every episode again, from the files alone, and write a page of statistics."
    check = inner.add_parser("check", help="validate every episode again", description=about)
    check.add_argument("folder", metavar="DIR", help="folder of the dataset")
    check.add_argument(
        "--jobs", type=parse_positive, default=1, metavar="J", help="processes (default 1)"
    )
    check.add_argument(
        "--html", metavar="FILE", help="where to write the page (default: DIR/statistics.html)"
    )
    check.add_argument(
        "--seed",
        type=parse_natural,
        default=0,
        help="of the ten episodes that the page shows (default 0)",
    )
    check.add_argument("--quiet", action="store_true", help="no progress bar")
    check.set_defaults(run=_check)


def _generate(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc

    try:
        with raise_on_interrupt():
            dataset = vkc.datasets.generate(
                arguments.recipe,
                arguments.episodes,
                arguments.out,
                jobs=arguments.jobs,
                scheduler=arguments.scheduler,
                variants=arguments.variants,
                simulate=arguments.simulate,
                cameras=arguments.cameras,
                lerobot=arguments.lerobot,
                progress=not arguments.quiet,
            )
    except KeyboardInterrupt as stop:
        return report_interruption(arguments.given, stop)
    except VkcError as error:
        if isinstance(error, InputError):
            raise
        sys.stderr.write(f"vkc-pin: {error}\n")
        return _FAILED
    sys.stdout.write(
        f"{len(dataset.numbers())} episodes are in {dataset.folder}; README.md there says what they are\n"
    )
    return EXIT_OK


def _check(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc

    with raise_on_interrupt():
        found = vkc.datasets.check_dataset(
            arguments.folder,
            jobs=arguments.jobs,
            page=arguments.html,
            seed=arguments.seed,
            progress=not arguments.quiet,
        )
    sys.stdout.write(f"{found}\n")
    return EXIT_OK if found.ok else _FAILED
