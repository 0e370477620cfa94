"""Defines the recipe of a small dataset."""

from __future__ import annotations

from typing import Any

SMALL: dict[str, Any] = {
    "name": "small",
    "tasks": ["given-open"],
    "objects": ["random_oven", "random_drawers"],
    "rooms": {"count": 2, "objects": 1, "episodes": 2, "clutter": [0.0, 0.0]},
}
"""Recipe of episodes that take a tenth of a second to plan."""
