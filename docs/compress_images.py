"""Reduces the pictures of docs/images to palettes: run it after the scripts that make them."""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

COLOURS = 256


def main() -> None:
    """Rewrite each picture that becomes smaller."""
    for file in sorted((Path(__file__).parent / "images").glob("*.png")):
        picture, buffer = Image.open(file), io.BytesIO()
        if picture.mode != "P":
            reduced = picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
            reduced.save(buffer, "png", optimize=True)
            if len(buffer.getvalue()) < file.stat().st_size:
                file.write_bytes(buffer.getvalue())


if __name__ == "__main__":
    main()
