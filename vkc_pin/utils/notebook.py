"""Renders values in Jupyter notebooks."""

from __future__ import annotations

import sys
from functools import singledispatch
from html import escape
from importlib import import_module

_card_modules: list[str] = []


@singledispatch
def make_card(value: object) -> str:
    """Return the HTML card of a value; modules register functions for their types."""
    return f"<pre>{escape(repr(value))}</pre>"


def register_card_module(module: str) -> None:
    """Register a module with cards, which is imported when the first card is rendered."""
    _card_modules.append(module)


def render_card(value: object) -> str:
    """Return the card of a value as HTML, with the cards of all registered modules."""
    for module in _card_modules:
        import_module(module)
    return make_card(value)


def in_notebook() -> bool:
    """Return whether this process is a Jupyter kernel."""
    if "IPython" not in sys.modules:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return getattr(shell, "kernel", None) is not None
