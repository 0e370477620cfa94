"""Notebooks: whether this runs in one, and what one shows of a cell's value."""

from __future__ import annotations

import sys
from functools import singledispatch
from html import escape
from importlib import import_module

__all__ = ["card", "cards_from", "in_notebook", "show"]

_makers: list[str] = []  # modules that register cards, imported when the first one is shown


@singledispatch
def card(value: object) -> str:
    """Return what a notebook shows of `value`, as HTML: its text, unless a module registers something else for its type."""
    return f"<pre>{escape(repr(value))}</pre>"


def cards_from(module: str) -> None:
    """Name a module that registers cards, which is imported when a notebook shows the first one."""
    _makers.append(module)


def show(value: object) -> str:
    """Return `value`'s card, as HTML."""
    for module in _makers:
        import_module(module)
    return card(value)


def in_notebook() -> bool:
    """Return whether this runs in a Jupyter kernel."""
    if "IPython" not in sys.modules:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return getattr(shell, "kernel", None) is not None
