"""Makes docs/images/measured_points.png: motions among boxes, and among points on them."""

from __future__ import annotations

import sys

import numpy as np

import vkc_pin as vkc
from docs.pictures import IMAGES
from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization.plots.style import new_figure, save_figure, use_style
from vkc_pin.visualization.plots.top_view import draw_top_view
from vkc_pin.world.trajectory.world_model import World

DENSITY = 6000.0  # points on a square metre
NOISE = 0.003  # [m]
BOXES = {
    "table": ([0.0, 1.7, 0.4], [1.6, 0.8, 0.8]),
    "desk": ([0.3, -1.5, 0.35], [1.2, 0.8, 0.7]),
    "column": ([0.4, 0.1, 0.7], [0.3, 0.3, 1.4]),
}
"""Name → centre and size [m]."""


def make() -> None:
    """Draw the plan views of both motions."""
    scene = vkc.Scene.from_document(
        {
            **{"robot": "husky_ur5e", "arena": {"x": [-3, 3], "y": [-2.5, 2.5]}},
            **{"start": {"base": [-1.8, 0.0, 0.0]}},
            "objects": [{"name": "drawer", "type": "drawer", "position": [2.2, 0.0, 0.0]}],
        }
    )
    obstacles = [
        {"name": name, "type": "box", "position": position, "size": size}
        for name, (position, size) in BOXES.items()
    ]
    described = vkc.Scene.from_document({**scene.document, "obstacles": obstacles}, scene.folder)
    rng = np.random.default_rng(0)
    cloud = np.concatenate([sample_sides(*box, rng) for box in BOXES.values()])
    with use_style():
        figure = new_figure(9.0, 4.2)
        parts = figure.subfigures(1, 2)
        for part, known in zip(parts, (described, scene.with_points(cloud)), strict=True):
            plan = vkc.plan(known, [vkc.Actuate("drawer", {"slide": 0.3})])
            sys.stdout.write(f"{plan.status}\n")
            draw_top_view(part, World(known), plan.trajectory)
        save_figure(figure, IMAGES / "measured_points.png")


def sample_sides(position: list[float], size: list[float], rng: np.random.Generator) -> Floats:
    """Return noisy points on the sides of a box and on its top, shape (n, 3) [m]."""
    half = np.array(size) / 2.0
    points = []
    for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0), (2, 1.0)):
        area = 4.0 * np.prod(np.delete(half, axis))
        side = rng.uniform(-half, half, (int(DENSITY * area), 3))
        side[:, axis] = sign * half[axis]
        points.append(side)
    sides = np.concatenate(points)
    return np.asarray(position + sides + rng.normal(0.0, NOISE, sides.shape))
