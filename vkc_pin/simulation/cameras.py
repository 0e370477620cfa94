"""Renders colour, depth and segmentation images of cameras on a robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vkc_pin.simulation.model import Builder, to_mujoco_quaternion
from vkc_pin.simulation.replay import Execution
from vkc_pin.simulation.snapshots import RenderedScene
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.camera import Camera
from vkc_pin.world.models.robot import Robot

ROBOT = "robot"
"""Name of the robot's links in segmentation images."""
# [mm] in 16 bits; pixels further away count as empty
_MAX_DEPTH = 65_535


@dataclass(frozen=True, eq=False)
class Images:
    """Images of cameras.

    Attributes:
        pictures: Maps `<camera>_image` to colours, shape (N, height, width, 3), 8 bits;
            `<camera>_depth` to distances along the camera's axis [mm], shape (N, height, width), 16
            bits, 0 where nothing is visible; `<camera>_segmentation` to indices into `segments`,
            shape (N, height, width), 16 bits.
        segments: Names of visible bodies: "" for nothing, `ROBOT`, the floor, names of obstacles,
            links of objects such as `door.panel`.
    """

    pictures: Mapping[str, NDArray[np.generic]]
    segments: tuple[str, ...]


def render_images(executed: Execution, cameras: Sequence[Camera], times: Floats) -> Images:
    """Render the images of cameras at some times.

    Args:
        executed: The executed motion.
        cameras: Cameras on the robot.
        times: Times, shape (N,) [s].

    Raises:
        UnknownNameError: The robot lacks a camera's frame.
        VkcError: OpenGL is not available without a display.
    """

    def add_cameras(builder: Builder) -> None:
        builder.spec.visual.quality.offsamples = 0  # no anti-aliasing: each pixel shows one body
        for camera in cameras:
            body, place = builder.find_frame(camera.find_frame(robot))
            camera_placement = place * camera.placement
            body.add_camera(
                name=camera.name,
                pos=camera_placement.translation,
                quat=to_mujoco_quaternion(camera_placement),
                fovy=camera.fov,
            )

    robot: Robot = executed.scene.robot
    size = (max(camera.width for camera in cameras), max(camera.height for camera in cameras))
    scene = RenderedScene(executed, size=size, wall_opacity=1.0, add_extras=add_cameras)
    segments, numbers = _number_segments(scene)
    found: dict[str, list[NDArray[np.generic]]] = {}
    for camera, colours, depth, geoms in _render(scene, cameras, times, size):
        found.setdefault(f"{camera}_image", []).append(colours)
        found.setdefault(f"{camera}_depth", []).append(depth)
        found.setdefault(f"{camera}_segmentation", []).append(numbers[geoms])
    return Images({name: np.array(values) for name, values in found.items()}, segments)


def _render(
    scene: RenderedScene, cameras: Sequence[Camera], times: Floats, size: tuple[int, int]
) -> Any:
    """Yield the name of every camera at every time, with colours, depth and geoms that it sees."""
    mj = scene.mj
    model = scene.model
    near = float(model.vis.map.znear * model.stat.extent)
    far = float(model.vis.map.zfar * model.stat.extent)
    view = mj.MjvCamera()
    view.type = mj.mjtCamera.mjCAMERA_FIXED
    flags = [int(mj.mjtRndFlag.mjRND_SEGMENT), int(mj.mjtRndFlag.mjRND_IDCOLOR)]
    for data, gl_scene, gl_context in scene.iterate_states(times, size):
        for camera in cameras:
            view.fixedcamid = model.camera(camera.name).id
            scene.update_view(data, gl_scene, view)
            window = mj.MjrRect(0, 0, camera.width, camera.height)
            colours = np.zeros((camera.height, camera.width, 3), np.uint8)
            codes = np.zeros_like(colours)
            depth = np.zeros(colours.shape[:2], np.float32)
            mj.mjr_render(window, gl_scene, gl_context)
            mj.mjr_readPixels(colours, depth, window, gl_context)
            gl_scene.flags[flags] = 1
            mj.mjr_render(window, gl_scene, gl_context)
            mj.mjr_readPixels(codes, None, window, gl_context)
            gl_scene.flags[flags] = 0
            distances = _to_millimetres(depth, near, far)
            geoms = _decode_geoms(gl_scene, codes)
            # OpenGL's first row is the lowest one.
            yield camera.name, colours[::-1], distances[::-1], geoms[::-1]


def _to_millimetres(depth: Any, near: float, far: float) -> NDArray[np.generic]:
    """Return distances [mm] from OpenGL's depth, which is 0 at `near` and 1 at `far` [m].

    The depth d of a distance z is (1 − near / z) / (1 − near / far).
    """
    distances = near / (1.0 - np.asarray(depth, float) * (1.0 - near / far))
    whole = np.round(1000.0 * distances)
    is_empty = (depth >= 1.0) | (whole > _MAX_DEPTH)
    return np.where(is_empty, 0.0, whole).astype(np.uint16)


def _decode_geoms(scene: Any, codes: Any) -> NDArray[np.generic]:
    """Return one plus the geom visible at every pixel, decoded from MuJoCo's segment colours."""
    visible_geoms = np.zeros(scene.ngeom + 1, np.intp)
    for geom in scene.geoms[: scene.ngeom]:
        visible_geoms[geom.segid + 1] = geom.objid + 1
    red = codes[..., 0]
    green = codes[..., 1].astype(int)
    blue = codes[..., 2].astype(int)
    return visible_geoms[red + 256 * green + 65_536 * blue]


def _number_segments(scene: RenderedScene) -> tuple[tuple[str, ...], NDArray[np.generic]]:
    """Return the names of visible bodies, and for one plus each geom the index of its name."""
    names = [""]
    numbers = np.zeros(scene.model.ngeom + 1, np.uint16)
    for geom, label, is_robot in scene.visible_geoms:
        name = ROBOT if is_robot else label
        if name not in names:
            names.append(name)
        numbers[geom + 1] = names.index(name)
    return tuple(names), numbers
