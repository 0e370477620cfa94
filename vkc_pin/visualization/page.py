"""One self-contained web page with a drawing: meshcat's viewer, the drawing's commands, and a bar with play and time."""

from __future__ import annotations

import base64
import gzip
import html
import json
import re
import struct
from functools import lru_cache
from pathlib import Path
from typing import Any

__all__ = ["Recorder", "render_page"]


class Recorder:
    """Takes a viewer's commands instead of a server; give it as `window` to `meshcat.Visualizer`.

    Attributes:
        commands: The commands so far.
    """

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []

    def send(self, command: Any) -> None:
        """Take one of meshcat's commands."""
        self.commands.append(command.lower())


def render_page(recorder: Recorder, *, title: str, film: dict[str, Any]) -> str:
    """Return the page.

    Args:
        recorder: What to draw.
        title: Of the page.
        film: What the bar shows: "duration" [s], "phases" ("name", "last" [s]), "notes" ("text", "time" [s]), "headline".
    """
    import meshcat
    import umsgpack  # type: ignore[import-untyped]

    viewer = Path(meshcat.__file__).parent / "viewer" / "dist" / "main.min.js"
    packed = [umsgpack.packb(command) for command in recorder.commands]
    template = (Path(__file__).parent / "page.html").read_text(encoding="utf-8")
    pieces = {
        "TITLE": html.escape(title),
        "FILM": json.dumps(film).replace("<", "\\u003c"),
        "VIEWER": _packed_file(viewer),
        "COMMANDS": _packed(b"".join(struct.pack("<I", len(command)) + command for command in packed)),
    }
    return re.sub(r"%(TITLE|FILM|VIEWER|COMMANDS)%", lambda match: pieces[match[1]], template)


@lru_cache(maxsize=1)
def _packed_file(file: Path) -> str:
    return _packed(file.read_bytes())


def _packed(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode("ascii")
