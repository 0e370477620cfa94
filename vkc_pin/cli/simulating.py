"""The command `simulate`: a saved plan in physics."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

from vkc_pin.world.files.writing import check_outputs

__all__ = ["add_simulate"]

_OK, _FAILED = 0, 1
_FILES = ("html", "picture", "video", "json")


def add_simulate(commands: Any) -> None:
    """Add the command to those of a parser."""
    about = (
        "Execute a saved plan in MuJoCo, with masses, friction, servos and a hand that can lose its hold, and say what came "
        "of it. Needs the extra `sim`."
    )
    simulate = commands.add_parser(
        "simulate", help="execute a saved plan in physics", description=about
    )
    simulate.add_argument(
        "plan", metavar="PLAN", help="a plan saved with --save or Plan.save (.npz)"
    )
    shown = "the scene that it happens in (default: the plan's own, where it starts)"
    simulate.add_argument("--actual", metavar="SCENE", help=shown)
    how = "how the hand holds: weld (default), or friction of fingers that close"
    simulate.add_argument("--grasp", default="weld", metavar="HOW", help=how)
    simulate.add_argument(
        "--html",
        metavar="FILE",
        help="write what happened beside what was planned, one self-contained page",
    )
    simulate.add_argument("--picture", metavar="FILE", help="write snapshots (.png)")
    simulate.add_argument(
        "--video",
        metavar="FILE",
        help="write a video (.mp4); needs ffmpeg or the package imageio-ffmpeg",
    )
    simulate.add_argument("--json", metavar="FILE", help="write all that came of it")
    simulate.set_defaults(run=_simulate)


def _simulate(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc

    files = {name: path for name in _FILES if (path := getattr(arguments, name)) is not None}
    check_outputs(
        {f"--{name}": path for name, path in files.items()}, inputs={"PLAN": arguments.plan}
    )
    plan = vkc.Plan.load(arguments.plan)
    actual = None
    if arguments.actual is not None:
        start = plan.scene.start
        actual = vkc.load_scene(arguments.actual).with_start(base=start[:3], arm=start[3:])
    result = plan.simulate(actual=actual, grasp=arguments.grasp)
    writers: dict[str, Callable[[str], object]] = {
        "html": result.to_html,
        "picture": result.plot,
        "video": result.to_mp4,
        "json": result.to_json,
    }
    for name, path in files.items():
        writers[name](path)
    sys.stdout.write(
        "".join([f"{result.summary()}\n", *(f"wrote {path}\n" for path in files.values())])
    )
    return _OK if result.ok else _FAILED
