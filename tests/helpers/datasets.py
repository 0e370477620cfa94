"""A small dataset, made once for the tests of a file, and what its recipe says."""

from __future__ import annotations

from typing import Any

SMALL: dict[str, Any] = {
    "name": "small",
    "tasks": ["given-open"],
    "objects": ["random_oven", "random_drawers"],
    "rooms": {"count": 2, "objects": 1, "episodes": 2, "clutter": [0.0, 0.0]},
}
"""Of episodes that are planned in a tenth of a second."""
