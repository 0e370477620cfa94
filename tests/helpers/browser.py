"""Runs headless Chromium for tests and for the pictures of the documentation."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from functools import partial
from pathlib import Path

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
)


def save_screenshot(
    page: Path,
    picture: Path,
    *,
    time: float | None = None,
    size: tuple[int, int] = (1280, 720),
    budget: float = 6.0,
) -> Path:
    """Write a PNG of a local page at `time` [s] of its animation, after at most `budget` [s]."""
    _run(page, time, budget, f"--screenshot={picture}", f"--window-size={size[0]},{size[1]}")
    assert picture.is_file(), f"Chromium wrote no picture of {page}"
    return picture


SMALL_WINDOW = "--window-size=320,240"  # drawn without a graphics card, for the DOM alone
READY = 'data-ready="yes"'  # set by a page after its first frame


def read_document(
    page: Path,
    *,
    time: float | None = None,
    until: str = READY,
    budgets: tuple[float, ...] = (6.0, 20.0, 60.0),
) -> str:
    """Return the DOM of a page after its scripts have run.

    Chromium's virtual clock does not wait for other threads. On a busy machine the budget can end
    before the page is complete. While the text lacks `until`, the page is opened again with the
    next of `budgets` [s].
    """
    text = ""
    for budget in budgets:
        text = _run(page, time, budget, "--dump-dom", SMALL_WINDOW)
        if until in text:
            break
    return text


def _run(page: Path, time: float | None, budget: float, *options: str) -> str:
    assert CHROMIUM is not None, "Chromium is not installed"
    address = page.resolve().as_uri() + ("" if time is None else f"#t={time}")
    with tempfile.TemporaryDirectory() as profile:
        arguments = (f"--user-data-dir={profile}", f"--virtual-time-budget={1000 * budget:.0f}")
        command = [CHROMIUM, *FLAGS, *arguments, *options, address]
        run = partial(subprocess.run, command, capture_output=True, text=True, check=True)
        try:
            return str(run(timeout=40).stdout)
        except subprocess.TimeoutExpired:  # the virtual clock may stall on a busy machine
            return str(run(timeout=120).stdout)
