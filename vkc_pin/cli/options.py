"""Defines exit codes, and adds commands and options to parsers."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from typing import Any

from vkc_pin.utils.command_line import parse_natural

EXIT_FAILED = 1
EXIT_MISUSE = 2
EXIT_INFEASIBLE = 3


class CommandParser(argparse.ArgumentParser):
    """Parser whose commands report unknown arguments themselves, with their own usage."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments; unknown ones are an error."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown


class GroupedCommands:
    """The commands of a parser, whose help lists them in groups."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._parser = parser
        self._commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def start_group(self, title: str) -> None:
        """Begin the group of the next commands."""
        self._parser.description = f"{self._parser.description}\n\n{title}:"

    def add_parser(self, name: str, *, help: str, **settings: Any) -> argparse.ArgumentParser:
        """Add a command, as `add_parser` of subparsers does."""
        self._parser.description = f"{self._parser.description}\n  {name:<15}{help}"
        return self._commands.add_parser(name, help=help, **settings)


class GroupedHelp(argparse.RawDescriptionHelpFormatter):
    """Formats the help of a parser with `GroupedCommands`, which the description lists."""

    def add_arguments(self, actions: Iterable[argparse.Action]) -> None:
        """Add the options alone."""
        super().add_arguments(action for action in actions if action.option_strings)


def add_command(
    commands: Any,
    name: str,
    summary: str,
    run: Callable[[argparse.Namespace], int],
    description: str | None = None,
) -> argparse.ArgumentParser:
    """Add a command to a parser's commands, and return the command's parser."""
    text = description or f"{summary[0].upper()}{summary[1:]}."
    command: argparse.ArgumentParser = commands.add_parser(name, help=summary, description=text)
    command.set_defaults(run=run)
    return command


def add_option(parser: Any, form: str, text: str, **settings: Any) -> None:
    """Add an option or argument.

    Args:
        parser: Parser or group of options.
        form: Name and placeholder, e.g. "--save FILE" or "plan PLAN". An option without a
            placeholder or settings is a flag.
        text: Help.
        settings: Further arguments of `add_argument`.
    """
    name, _, metavar = form.partition(" ")
    if metavar:
        settings["metavar"] = metavar
    elif not settings:
        settings["action"] = "store_true"
    parser.add_argument(name, help=text, **settings)


def add_seed(parser: Any, text: str = "random seed (default 0)") -> None:
    """Add the option `--seed`."""
    add_option(parser, "--seed", text, type=parse_natural, default=0)
