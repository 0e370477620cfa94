"""Makes docs/images/gallery.png: robots from several sources that open objects from others.

Imported robots and plans are kept in out/gallery. The pictures are drawn here, point by point, as
they need no more than shades: dozens of them in a browser take long.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin
from PIL import Image

import vkc_pin as vkc
from docs.pictures import IMAGES, ROOT
from tests.benchmarks.robot_object_matrix.pairs import make_pair, parse_requests, prepare_robot
from vkc_pin.experiments.harness.runner import LIMITS
from vkc_pin.visualization.plots.style import new_figure, save_figure, use_style
from vkc_pin.visualization.room import load_drawn_parts
from vkc_pin.world.trajectory.world_model import World

ROBOTS = {"husky_ur5e": "Husky, UR5e", "tiago_pro": "TIAGo Pro", "pr2": "PR2", "panda": "Panda"}
OBJECTS = {
    **{"door_0": "door", "drawers_0": "drawer", "refrigerator_0": "refrigerator"},
    **{"dishwasher_0": "dishwasher", "microwave_0": "microwave", "chest_0": "chest"},
}
STARTS = 5  # random ones: the first from which it is opened is shown
SIDE = 180  # [pixels] of a picture in the grid
FINER = 2  # drawn pixels in each of these
VIEW_DIRECTION = np.array([-0.85, -0.85, 0.62])  # from the target to the camera, not normalized
FIELD = 0.62  # [m] half the width of the view at a distance of 1 m
PIECE = 0.4  # [m] longest edge of a drawn triangle
NEAR = 1.0  # [m] triangles closer to the camera are omitted
DOTS = (0.7, 1.5)  # [pixels] between points, and between those of shadows
PARTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)  # of an edge of a triangle
SUN = np.array([-0.35, -0.45, 0.82]) / np.linalg.norm([-0.35, -0.45, 0.82])
FLOOR = np.array([0.90, 0.89, 0.87])
SKY = np.array([0.97, 0.97, 0.98])
SHADOW = 0.82


def plan_opening(robot: str, file: str, object_name: str, folder: Path) -> vkc.Plan:
    """Return the plan of a robot opening an object, from the first random start that succeeds."""
    kept = folder / "plans" / f"{robot}_{object_name}.npz"
    if kept.is_file():
        return vkc.Plan.load(kept)
    found = make_pair(vkc.load_robot(file), file, object_name)
    if found.scene is None or found.step is None:
        raise SystemExit(f"{robot} opens no {object_name}: {found.because}")
    for number in range(STARTS):
        plan = vkc.plan(
            found.scene.sample_start(np.random.default_rng([7, 0, number])), [found.step], **LIMITS
        )
        if plan.success:
            kept.parent.mkdir(parents=True, exist_ok=True)
            plan.save(kept)
            return plan
    raise SystemExit(f"{robot} opens no {object_name}: {plan.summary()}")


def collect_triangles(scene: vkc.Scene) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield triangles in the world, shape (n, 3, 3), edges at most `PIECE`, and colours (n, 3)."""
    world = World(scene)
    data = world.model.createData()
    pin.forwardKinematics(world.model, data, world.coordinates.q(world.start))
    for shape in world.visual.geometryObjects:
        for solid, colour in load_drawn_parts(shape):
            placed = data.oMi[shape.parentJoint] * shape.placement
            corners = (solid.vertices @ placed.rotation.T + placed.translation)[
                solid.faces.astype(int)
            ]
            while True:
                edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
                large = edges.max(axis=1) > PIECE
                if not large.any():
                    break
                a, b, c = (corners[large, k] for k in range(3))
                ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
                four = [
                    np.stack(one, axis=1)
                    for one in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
                ]
                corners = np.concatenate([corners[~large], *four])
            yield corners, np.tile(np.array(colour[:3]), (len(corners), 1))


class Camera:
    """Where points are in a picture of `size` pixels a side."""

    def __init__(self, target: np.ndarray, position: np.ndarray, size: int) -> None:
        ahead = (target - position) / np.linalg.norm(target - position)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.axes = np.array([right, np.cross(ahead, right), ahead])
        self.position = position
        self.size = size

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixel columns and rows, shape (..., 2), and depths along the view [m]."""
        own = (points - self.position) @ self.axes.T
        ahead = np.maximum(own[..., 2], 1e-6)
        return (own[..., :2] / ahead[..., None] / FIELD + 1.0) * self.size / 2.0, own[..., 2]

    def on_floor(self) -> np.ndarray:
        """Return each pixel's depth to the floor [m], (size, size); inf above the horizon."""
        along = (np.arange(self.size) + 0.5) / self.size * 2.0 - 1.0
        down = -(
            self.axes[0, 2] * along[None] * FIELD
            + self.axes[1, 2] * along[:, None] * FIELD
            + self.axes[2, 2]
        )
        return np.where(down > 1e-6, self.position[2] / np.maximum(down, 1e-6), np.inf)


def sample_triangles(
    corners: np.ndarray, pixels: np.ndarray, apart: float
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield indices of triangles and points on them, shape (k, 3), at most `apart` [pixels]."""
    longest = np.linalg.norm(pixels - np.roll(pixels, -1, axis=1), axis=2).max(axis=1)
    parts = np.array(PARTS)[np.searchsorted(PARTS[:-1], longest / apart)]
    for count in np.unique(parts):
        first, second = (
            grid.ravel() for grid in np.meshgrid(np.arange(count + 1), np.arange(count + 1))
        )
        inside = first + second <= count
        u, v = first[inside] / count, second[inside] / count
        own = np.flatnonzero(parts == count)
        points = np.einsum("nkd,kp->npd", corners[own], np.stack([1.0 - u - v, u, v]))
        yield np.repeat(own, len(u)), points.reshape(-1, 3)


def draw_scene(scene: vkc.Scene) -> Image.Image:
    """Return the picture of a scene, viewed from beside the robot and its load."""
    tool, base = scene.tool_placement().translation, scene.start[:2]
    target = np.array([*(0.5 * (tool[:2] + base)), 0.72])
    size = SIDE * FINER
    camera = Camera(
        target,
        target + VIEW_DIRECTION * (1.15 + 0.5 * float(np.linalg.norm(tool[:2] - base))),
        size,
    )
    floor = camera.on_floor()
    depth, dark = floor.ravel().copy(), np.zeros(size * size, bool)
    image = np.where(np.isfinite(depth)[:, None], FLOOR, SKY)
    for corners, colours in collect_triangles(scene):
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        shades = np.clip(colours * (0.62 + 0.38 * np.abs(normals @ SUN))[:, None], 0.0, 1.0)
        fallen = corners - corners[..., 2:] * SUN / SUN[2]
        for own, shown, apart in ((corners, True, DOTS[0]), (fallen, False, DOTS[1])):
            pixels, ahead = camera.project(own)
            visible = (
                (ahead.min(axis=1) > NEAR)
                & (pixels.max(axis=1) > 0.0).all(axis=1)
                & (pixels.min(axis=1) < size).all(axis=1)
            )
            numbers = np.flatnonzero(visible)
            for which, points in sample_triangles(own[numbers], pixels[numbers], apart):
                place, away = camera.project(points)
                columns, rows = place.astype(int).T
                kept = (columns >= 0) & (columns < size) & (rows >= 0) & (rows < size)
                at, which, away = (rows * size + columns)[kept], numbers[which[kept]], away[kept]
                if not shown:
                    dark[at] = True
                    continue
                order = np.argsort(
                    -away, kind="stable"
                )  # of several on one pixel the nearest is written last
                at, which, away = at[order], which[order], away[order]
                nearer = away < depth[at] + 1e-9
                depth[at[nearer]], image[at[nearer]] = away[nearer], shades[which[nearer]]
    image[dark & (depth >= floor.ravel() - 1e-3) & np.isfinite(depth)] *= SHADOW
    picture = Image.fromarray((255.0 * image.reshape(size, size, 3)).round().astype(np.uint8))
    return picture.resize((SIDE, SIDE), Image.Resampling.LANCZOS)


def make() -> None:
    """Make it."""
    folder = ROOT / "out" / "gallery"
    ready = {
        one.called: prepare_robot(one, folder / "robots")
        for one in parse_requests(list(ROBOTS), "robots", ())
    }
    target = IMAGES / "gallery.png"
    with use_style():
        figure = new_figure(2.0 * len(OBJECTS) + 0.3, 2.0 * len(ROBOTS) + 0.3)
        axes = figure.subplots(
            len(ROBOTS), len(OBJECTS), gridspec_kw={"wspace": 0.02, "hspace": 0.02}
        )
        for row, (robot, file) in enumerate(ready.items()):
            for column, (object_name, name) in enumerate(OBJECTS.items()):
                axis = axes[row, column]
                axis.imshow(draw_scene(plan_opening(robot, file, object_name, folder).end_scene()))
                axis.set(xticks=[], yticks=[])
                axis.set_title(name if row == 0 else "", fontsize=10)
                axis.set_ylabel(ROBOTS[robot] if column == 0 else "", fontsize=10)
                print(f"{robot}: {name}", flush=True)
        save_figure(figure, target)
