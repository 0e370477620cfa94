"""Spares imports the rasterization of their pictures, which takes longer than most of them."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.figure import Figure
from PIL import Image

from vkc_pin.importing import pictures

DRAWN = "test_pictures.py"
"""Tests of the pictures' pixels. Imports of module-scoped fixtures are drawn, too."""


def _write_blank(figure: Figure, path: str | Path | None) -> Figure:
    """Write one white pixel instead of the figure, which has been composed already."""
    if path is not None:
        Image.new("RGB", (1, 1), "white").save(path)
    return figure


@pytest.fixture(autouse=True)
def blank_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the pictures of imports blank."""
    if request.path.name != DRAWN:
        monkeypatch.setattr(pictures, "save_figure", _write_blank)
