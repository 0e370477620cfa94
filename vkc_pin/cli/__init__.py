"""Implements the command line `vkc-pin`."""

from vkc_pin.cli.process import main

__all__ = ["main"]
