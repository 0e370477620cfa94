"""Notebooks: whether this runs in one, and what one shows of a cell's value."""

from __future__ import annotations

import sys
from functools import singledispatch
from html import escape

__all__ = ["card", "in_notebook"]


@singledispatch
def card(value: object) -> str:
    """Return what a notebook shows of `value`, as HTML: its text, unless a module registers something else for its type."""
    return f"<pre>{escape(repr(value))}</pre>"


def in_notebook() -> bool:
    """Return whether this runs in a Jupyter kernel."""
    if "IPython" not in sys.modules:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return getattr(shell, "kernel", None) is not None
