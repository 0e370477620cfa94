"""Defines the recipe of a small dataset."""

from __future__ import annotations

from typing import Any

SMALL: dict[str, Any] = {
    "name": "small",
    "tasks": ["given-open"],
    "objects": ["random_oven", "random_drawers"],
    "rooms": {"count": 2, "objects": 1, "episodes": 2, "clutter": [0.0, 0.0]},
    # No attempt reaches it, or its motion would depend on the load of the machine. The problems of
    # a recipe depend on all its fields: with this value, the first ones are planned at once.
    "time_limit": 3600.0,
}
"""Recipe of episodes that take a tenth of a second to plan."""
