"""Defines the commands `generate` and `dataset check`, which make and validate a dataset."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from vkc_pin.cli.options import (
    EXIT_FAILED,
    add_command,
    add_option,
    add_seed,
)
from vkc_pin.errors import InputError, VkcError
from vkc_pin.utils.command_line import EXIT_OK, parse_positive, report_interruption
from vkc_pin.utils.interrupt import raise_on_interrupt


def add_datasets(commands: Any) -> None:
    """Add the commands to those of a parser."""
    about = (
        "Generate a dataset from a recipe: episodes, each a scene with a timed motion that the "
        "independent validation accepts. The same command continues an interrupted run, and adds "
        "episodes if their number is larger."
    )
    summary = "generate a dataset of validated motions"
    generate = add_command(commands, "generate", summary, _generate, about)
    add_option(generate, "recipe RECIPE", "name of an included recipe, or a YAML file")
    # generate() checks these numbers, with errors like those of the recipe.
    add_option(generate, "--episodes N", "number of episodes", type=int, required=True)
    add_option(generate, "--out DIR", "folder of the dataset", required=True)
    add_option(generate, "--jobs J", "processes on this machine (default 1)", type=int, default=1)
    about = "address of a Dask scheduler, tcp://HOST:PORT, whose workers are used instead"
    add_option(generate, "--scheduler ADDRESS", about)
    about = "motions for each problem, instead of the recipe's number"
    add_option(generate, "--variants K", about, type=int)
    about = "keep only episodes that the simulation confirms (needs the extra `sim`)"
    add_option(generate, "--simulate", about, action="store_true", default=None)
    about = "store images of the recipe's cameras, or of head and hand (with --simulate)"
    add_option(generate, "--cameras", about)
    add_option(generate, "--lerobot", "write LeRobot's layout as well, a dataset for each robot")
    add_option(generate, "--quiet", "show no progress bar")

    about = "Examine a dataset that `generate` has made."
    dataset = commands.add_parser("dataset", help="examine a dataset", description=about)
    inner = dataset.add_subparsers(required=True, metavar="WHAT")
    about = "Validate every episode again, from the files alone, and write a page of statistics."
    check = add_command(inner, "check", "validate every episode again", _check, about)
    add_option(check, "folder DIR", "folder of the dataset")
    add_option(check, "--jobs J", "processes (default 1)", type=parse_positive, default=1)
    add_option(check, "--html FILE", "page to write (default: DIR/statistics.html)")
    add_seed(check, "random seed of the ten episodes on the page (default 0)")
    add_option(check, "--quiet", "show no progress bar")


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
        return report_interruption(arguments.command, stop)
    except VkcError as error:
        if isinstance(error, InputError):
            raise
        sys.stderr.write(f"vkc-pin: {error}\n")
        return EXIT_FAILED
    count = len(dataset.numbers())
    sys.stdout.write(f"{count} episodes are in {dataset.folder}; its README.md describes them\n")
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
    return EXIT_OK if found.ok else EXIT_FAILED
