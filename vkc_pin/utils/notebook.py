"""Notebooks: whether this runs in one, and what one shows of a cell's value."""

from __future__ import annotations

import sys
from functools import singledispatch
from html import escape
from importlib import import_module

__all__ = ["in_notebook", "make_card", "register_card_module", "render_card"]

_card_modules: list[str] = []  # modules that register cards, imported when the first one is shown


@singledispatch
def make_card(value: object) -> str:
    """Return what a notebook shows of `value`, as HTML: its text, unless a module registers something else for its type."""
    return f"<pre>{escape(repr(value))}</pre>"


def register_card_module(module: str) -> None:
    """Name a module that registers cards, which is imported when a notebook shows the first one."""
    _card_modules.append(module)


def render_card(value: object) -> str:
    """Return `value`'s card, as HTML."""
    for module in _card_modules:
        import_module(module)
    return make_card(value)


def in_notebook() -> bool:
    """Return whether this runs in a Jupyter kernel."""
    if "IPython" not in sys.modules:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return getattr(shell, "kernel", None) is not None
