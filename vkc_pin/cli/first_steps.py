"""Defines the commands demo, new and completion, for the first steps."""

from __future__ import annotations

import argparse
import functools
import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vkc_pin.cli.options import EXIT_FAILED, add_command, add_option
from vkc_pin.errors import InputError
from vkc_pin.utils.command_line import EXIT_OK
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.utils.system import has_screen
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.files.writing import check_outputs, write_atomically

_PAGE = "vkc-pin-demo.html"
_SHELLS = ("bash", "fish", "zsh")


def add_first_steps(commands: Any) -> None:
    """Add the commands demo and new to those of a parser."""
    about = "Plan how a robot opens a door, write the motion as a web page, and open it."
    demo = add_command(commands, "demo", "plan the door and open its page", _demo, about)
    add_option(demo, "--html FILE", f"page to write (default: {_PAGE})", default=_PAGE)
    add_option(demo, "--no-browser", "write the page without opening it")

    about = "Write a scene with comments, and a script that plans in it, into a new folder."
    new = add_command(commands, "new", "start a scene of your own", _new, about)
    add_option(new, "folder FOLDER", "a new or empty folder")


def add_completion(
    commands: Any,
    make_parser: Callable[[], argparse.ArgumentParser],
) -> None:
    """Add the command completion, for all commands of the parser that `make_parser` returns."""
    about = (
        "Print a script that completes commands and options.\n\n"
        'in ~/.bashrc: eval "$(vkc-pin completion bash)"\n'
        'in ~/.zshrc: eval "$(vkc-pin completion zsh)"\n'
        "in config.fish of fish: vkc-pin completion fish | source"
    )
    run = functools.partial(_complete, make_parser)
    completion = add_command(commands, "completion", "complete commands in a shell", run, about)
    completion.formatter_class = argparse.RawDescriptionHelpFormatter  # lines can be copied
    add_option(completion, "shell SHELL", ", ".join(_SHELLS), choices=_SHELLS)


def _demo(arguments: argparse.Namespace) -> int:
    import vkc_pin as vkc
    from vkc_pin.planning.kinematics.machine_code import find_compiler

    check_outputs({"--html": arguments.html})
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 1.2})])
    page = plan.to_html(arguments.html).resolve()
    sys.stdout.write(f"{plan.summary()}\nwrote {arguments.html}\n")
    if not arguments.no_browser and has_screen():
        import webbrowser

        webbrowser.open(page.as_uri(), new=2)
    else:
        sys.stdout.write(f"open {page.as_uri()} in a browser\n")
    if find_compiler() is None:
        compiler = os.environ.get("CC") or "cc"
        sys.stdout.write(
            f"there is no C compiler ({compiler}): later plans of a kind take "
            "as long as the first, and with one up to a third less\n"
        )
    sys.stdout.write("next: vkc-pin new FOLDER starts a scene of your own\n")
    return EXIT_OK if plan.success else EXIT_FAILED


def _new(arguments: argparse.Namespace) -> int:
    folder = Path(arguments.folder)
    is_empty = folder.is_dir() and not any(folder.iterdir())
    if folder.exists() and not is_empty:
        raise InputError(
            "this already exists", file=folder, field="FOLDER", expected="a new or empty folder"
        )
    source = find_resource_folder("scenes") / "first"
    for name in ("scene.yaml", "plan.py"):
        write_atomically(folder / name, (source / name).read_bytes())
        sys.stdout.write(f"wrote {folder / name}\n")
    script = shlex.quote(str(folder / "plan.py"))
    scene = shlex.quote(str(folder / "scene.yaml"))
    sys.stdout.write(f"next: vkc-pin view {scene}, and python {script}\n")
    return EXIT_OK


def _complete(
    make_parser: Callable[[], argparse.ArgumentParser], arguments: argparse.Namespace
) -> int:
    shtab = import_optional("shtab", "completion", purpose="completion in shells")
    sys.stdout.write(f"{shtab.complete(make_parser(), shell=arguments.shell)}\n")
    return EXIT_OK
