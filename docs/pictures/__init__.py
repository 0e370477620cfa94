"""Makes the pictures of the documentation; see `docs.pictures.__main__`."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
IMAGES = DOCS / "images"

sys.path.append(str(ROOT / "tests"))  # for their helpers
