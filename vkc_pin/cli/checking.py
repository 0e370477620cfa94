"""The command `check`: a saved plan against everything that was asked of it, or a scene before anything is planned in it."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from vkc_pin.benchmarks.commands import parse_natural
from vkc_pin.errors import InputError
from vkc_pin.world.files.writing import check_outputs

__all__ = ["add_check"]

_OK, _FAILED = 0, 1


def add_check(commands: Any) -> None:
    """Add the command to those of a parser."""
    about = (
        "Run the independent validation on a saved plan, and say what its file says otherwise. Or look at a scene: what is "
        "closer than Options.dist_safe, what overlaps, which attachments can be reached, from where and from which side."
    )
    check = commands.add_parser(
        "check", help="validate a saved plan, or look at a scene", description=about
    )
    check.add_argument(
        "what",
        metavar="SCENE|PLAN",
        help="a scene, or a plan saved with --save or Plan.save (.npz)",
    )
    check.add_argument(
        "--plot", metavar="FILE", help="write a picture of the scene from above (.png, .svg, .pdf)"
    )
    check.add_argument(
        "--seed",
        type=parse_natural,
        default=0,
        help="of the random configurations that are tried (default 0)",
    )
    check.set_defaults(run=_check)


def _check(arguments: argparse.Namespace) -> int:
    return _plan(arguments) if str(arguments.what).endswith(".npz") else _scene(arguments)


def _plan(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc

    if arguments.plot is not None:
        raise InputError(
            "a plan has pictures of its own", field="--plot", expected="a scene", got=arguments.what
        )
    plan = vkc.Plan.load(arguments.what)
    otherwise = plan.contradictions()
    sys.stdout.write(
        "\n".join(
            [
                *plan.report.lines(),
                *(f"  the file says otherwise: {line}" for line in otherwise),
            ]
        )
        + "\n"
    )
    return _OK if plan.report.ok and not otherwise else _FAILED


def _scene(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin.visualization.plots.plots import PICTURES

    if arguments.plot is not None:
        if not arguments.plot.lower().endswith(PICTURES):
            expected = f"a name that ends with {', '.join(PICTURES)}"
            raise InputError(
                "not the name of a picture", field="--plot", expected=expected, got=arguments.plot
            )
        check_outputs({"--plot": arguments.plot}, inputs={"SCENE": arguments.what})
    found = vkc.check_scene(vkc.load_scene(arguments.what), seed=arguments.seed)
    if arguments.plot is not None:
        found.plot(arguments.plot)
    sys.stdout.write(
        f"{found}\n" + (f"wrote {arguments.plot}\n" if arguments.plot is not None else "")
    )
    return _OK if found.ok else _FAILED
