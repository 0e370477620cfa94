"""Makes docs/images/ros_map.png: a map of two rooms, and a motion on it."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

import vkc_pin as vkc
from docs.pictures import IMAGES
from vkc_pin.utils.arrays import Bools
from vkc_pin.visualization.plots.style import new_figure, save_figure, use_style
from vkc_pin.visualization.plots.top_view import draw_top_view
from vkc_pin.world.trajectory.world_model import World

CELL = 0.05  # [m]
ORIGIN = (-2.0, -2.6, 0.2)  # x, y [m], yaw [rad]
NOISE = 0.25  # share of the cells beside walls that are occupied, too


def make() -> None:
    """Draw the map and a motion from one room into the other."""
    walls, outside = draw_rooms()
    grey = np.where(walls, 0, 254)
    grey[outside] = 205
    image = Image.fromarray(np.flipud(grey).astype(np.uint8))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        image.save(folder / "map.pgm")
        fields = {
            **{"image": "map.pgm", "resolution": CELL, "origin": list(ORIGIN), "negate": 0},
            **{"occupied_thresh": 0.65, "free_thresh": 0.196},
        }
        (folder / "map.yaml").write_text(yaml.safe_dump(fields))
        document = {
            **{"name": "rooms", "robot": "husky_ur5e", "map": "map.yaml"},
            **{"start": {"base": [-0.4, -0.6, 0.2]}},
        }
        scene = vkc.Scene.from_document(document, folder)
        plan = vkc.plan(scene, [vkc.GoTo(2.2, 0.2, 0.2)])
    boxes = scene.obstacle_labels.count("map")
    sys.stdout.write(f"{plan.status}, {boxes} boxes\n")
    with use_style():
        figure = new_figure(9.0, 4.0)
        left, right = figure.subfigures(1, 2)
        axes = left.subplots()
        axes.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
        axes.set_axis_off()
        draw_top_view(right, World(scene), plan.trajectory)
        save_figure(figure, IMAGES / "ros_map.png")


def draw_rooms() -> tuple[Bools, Bools]:
    """Return the walls of two rooms with jagged sides, and their surroundings, by cell."""
    rng = np.random.default_rng(0)
    inside = np.zeros((90, 140), bool)
    inside[8:82, 8:66] = True
    inside[8:82, 70:132] = True
    inside[40:66, 66:70] = True  # the passage
    inside[8:24, 100:132] = False  # a cupboard
    walls = grow(inside) & ~inside
    beside = grow(walls) & inside & (rng.random(inside.shape) < NOISE)
    walls |= beside
    walls[50:56, 110:116] = True  # a pillar
    return walls, ~inside & ~walls


def grow(cells: Bools) -> Bools:
    """Return cells and their neighbours."""
    grown = cells.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            grown |= np.roll(cells, step, axis)
    return grown
