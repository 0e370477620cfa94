"""Makes random scenes full of obstacles of all kinds, sizes and tilts, to test culling."""

from __future__ import annotations

from typing import Any

import numpy as np

from helpers.carrying import make_room
from helpers.small_problems import load_door_scene
from vkc_pin.world.scene.scene import Scene


def describe_random_obstacles(seed: int, count: int) -> list[dict[str, Any]]:
    """Return `count` random obstacles of 1 cm to 3 m, near and far, partly rotated."""
    rng = np.random.default_rng(seed)
    obstacles = []
    for number in range(count):
        size = (10.0 ** rng.uniform(-2.0, 0.5, 3)).tolist()
        obstacle: dict[str, Any] = {
            "name": f"thing_{number}",
            "position": rng.uniform([-3.0, -3.0, 0.0], [5.0, 3.0, 2.0]).tolist(),
        }
        obstacle["rpy"] = (rng.uniform(-np.pi, np.pi, 3) * rng.choice([0.0, 1.0], 3)).tolist()
        kind = ("box", "sphere", "cylinder", "capsule")[number % 4]
        fields = {"box": {"size": size}, "sphere": {"radius": size[0] / 2}}
        obstacles.append(
            {
                **obstacle,
                "type": kind,
                **fields.get(kind, {"radius": size[0] / 2, "length": size[1]}),
            }
        )
    return obstacles


def make_cluttered_scene(seed: int, count: int) -> Scene:
    """Return the door's scene with `count` random obstacles instead of its own."""
    scene = load_door_scene()
    return Scene.from_document(
        {**scene.document, "obstacles": describe_random_obstacles(seed, count)}, scene.folder
    )


def make_cluttered_room(seed: int, count: int) -> Scene:
    """Return a hall with a stick and a ball that can be carried, among `count` random obstacles."""
    return make_room(*describe_random_obstacles(seed, count), objects=("stick", "ball"))
