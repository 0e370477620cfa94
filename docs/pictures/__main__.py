"""Makes the pictures of the documentation.

Usage, in a checkout: `python -m docs.pictures [NAME ...]`; all without a name. `scenes` needs
Chromium, `gallery` the extra `import`.
"""

from __future__ import annotations

import argparse
import importlib
import io
import time

from PIL import Image

from docs.pictures import IMAGES

NAMES = (
    "architecture",
    "closed_loop",
    "gallery",
    "initial_guesses",
    "measured_points",
    "ros_map",
    "scenes",
    "separation",
    "tradeoff",
)
COLOURS = 256


def main() -> None:
    """Make the pictures that the command line names, and reduce them to palettes."""
    parser = argparse.ArgumentParser(prog="python -m docs.pictures", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    names = parser.parse_args().names or NAMES
    for name in names:
        if name not in NAMES:
            parser.error(f"there are no pictures '{name}': {', '.join(NAMES)}")
    began = time.time()
    for name in names:
        importlib.import_module(f"docs.pictures.{name}").make()
    reduce_pictures(began)


def reduce_pictures(since: float) -> None:
    """Rewrite each picture newer than a time [s] that becomes smaller with a palette."""
    for file in sorted(IMAGES.glob("*.png")):
        picture = Image.open(file)
        if file.stat().st_mtime < since or picture.mode == "P":
            continue
        buffer = io.BytesIO()
        reduced = picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
        reduced.save(buffer, "png", optimize=True)
        if len(buffer.getvalue()) < file.stat().st_size:
            file.write_bytes(buffer.getvalue())


if __name__ == "__main__":
    main()
