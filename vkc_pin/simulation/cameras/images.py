"""What cameras on the robot see of what happened: colours, distances, and what is where, drawn by MuJoCo without a screen."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vkc_pin.simulation.cameras.mount import Camera
from vkc_pin.simulation.model import Builder, quaternion
from vkc_pin.simulation.replay import Executed
from vkc_pin.simulation.snapshots import Stage, drawing_context
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot

__all__ = ["ROBOT", "Images", "taken"]

ROBOT = "robot"
"""What a robot's links are called where it is said what is where."""
_FARTHEST = 65_535  # [mm] of 16 bits; what is further is as nothing


@dataclass(frozen=True, eq=False)
class Images:
    """What cameras saw.

    Attributes:
        pictures: By `<camera>_image`: colours, shape (N, height, width, 3), 8 bits;
            `<camera>_depth`: distance along the camera's axis [mm], shape (N, height, width), 16
            bits, 0 where there is nothing; `<camera>_segmentation`: place in `segments` of what is
            seen, shape (N, height, width), 16 bits.
        segments: What there is to see: "" for nothing, `ROBOT`, the floor, obstacles by name, links
            of objects as `door.panel`.
    """

    pictures: Mapping[str, NDArray[np.generic]]
    segments: tuple[str, ...]

    def to_bytes(self) -> bytes:
        """Return them as bytes, compressed, which `from_bytes` reads."""
        buffer = io.BytesIO()
        names: Any = np.array(json.dumps([list(self.pictures), self.segments]))
        pictures: Any = {f"picture_{k}": pixels for k, pixels in enumerate(self.pictures.values())}
        np.savez_compressed(buffer, allow_pickle=False, names=names, **pictures)
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> Images:
        """Return those that `to_bytes` made bytes of."""
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            names, segments = json.loads(str(archive["names"]))
            return cls(
                {name: archive[f"picture_{k}"] for k, name in enumerate(names)}, tuple(segments)
            )


def taken(executed: Executed, cameras: Sequence[Camera], times: Floats) -> Images:
    """Return what cameras saw at some times [s], shape (N,).

    Args:
        executed: What happened.
        cameras: On the robot.
        times: When.

    Raises:
        UnknownNameError: The robot lacks a camera's frame.
        VkcError: There is no OpenGL without a screen.
    """

    def mounted(builder: Builder) -> None:
        builder.spec.visual.quality.offsamples = 0  # a pixel is one thing at one distance
        for camera in cameras:
            body, place = builder.frame(camera.on(robot))
            seat = place * camera.placement
            body.add_camera(
                name=camera.name, pos=seat.translation, quat=quaternion(seat), fovy=camera.fov
            )

    robot: Robot = executed.scene.robot
    size = (max(camera.width for camera in cameras), max(camera.height for camera in cameras))
    stage = Stage(executed, size=size, veil=1.0, more=mounted)
    segments, numbers = _segments(stage)
    found: dict[str, list[NDArray[np.generic]]] = {}
    for camera, picture in _drawn(stage, cameras, times, size):
        for kind, pixels in zip(("image", "depth", "segmentation"), picture, strict=True):
            found.setdefault(f"{camera}_{kind}", []).append(
                numbers[pixels] if kind == "segmentation" else pixels
            )
    return Images({name: np.array(values) for name, values in found.items()}, segments)


def _drawn(stage: Stage, cameras: Sequence[Camera], times: Floats, size: tuple[int, int]) -> Any:
    """Yield a camera's name and its colours, distances [mm] and geoms, of every camera at every moment; geom 0 is none."""
    mj, model = stage.mj, stage.model
    data, option, eye = mj.MjData(model), mj.MjvOption(), mj.MjvCamera()
    near, far = (
        float(limit * model.stat.extent) for limit in (model.vis.map.znear, model.vis.map.zfar)
    )
    eye.type = mj.mjtCamera.mjCAMERA_FIXED
    with drawing_context(size):
        scene, render = (
            mj.MjvScene(model, maxgeom=20_000),
            mj.MjrContext(model, mj.mjtFontScale.mjFONTSCALE_100),
        )
        mj.mjr_setBuffer(mj.mjtFramebuffer.mjFB_OFFSCREEN, render)
        for row in stage.rows(times):
            data.qpos[:] = stage.qpos(row)
            mj.mj_forward(model, data)
            for camera in cameras:
                eye.fixedcamid = model.camera(camera.name).id
                mj.mjv_updateScene(
                    model, data, option, mj.MjvPerturb(), eye, mj.mjtCatBit.mjCAT_ALL, scene
                )
                window, shape = (
                    mj.MjrRect(0, 0, camera.width, camera.height),
                    (camera.height, camera.width),
                )
                colours, codes = np.zeros((2, *shape, 3), np.uint8)
                depth = np.zeros(shape, np.float32)
                mj.mjr_render(window, scene, render)
                mj.mjr_readPixels(colours, depth, window, render)
                flags = [int(mj.mjtRndFlag.mjRND_SEGMENT), int(mj.mjtRndFlag.mjRND_IDCOLOR)]
                scene.flags[flags] = 1
                mj.mjr_render(window, scene, render)
                mj.mjr_readPixels(codes, None, window, render)
                scene.flags[flags] = 0
                yield (
                    camera.name,
                    (
                        colours[::-1],
                        _millimetres(depth, near, far)[::-1],
                        _geoms(scene, codes)[::-1],
                    ),
                )
        render.free()


def _millimetres(depth: Any, near: float, far: float) -> NDArray[np.generic]:
    """Return distances [mm] of what OpenGL keeps of them, from 0 at `near` to 1 at `far` [m]."""
    away = near / (1.0 - np.asarray(depth, float) * (1.0 - near / far))
    whole = np.round(1000.0 * away)
    return np.where((depth >= 1.0) | (whole > _FARTHEST), 0.0, whole).astype(np.uint16)


def _geoms(scene: Any, codes: Any) -> NDArray[np.generic]:
    """Return one more than the geom that is seen at every pixel, of the colours that MuJoCo codes what it draws with."""
    drawn = np.zeros(scene.ngeom + 1, np.intp)
    for geom in scene.geoms[: scene.ngeom]:
        drawn[geom.segid + 1] = geom.objid + 1
    code = codes[..., 0] + 256 * codes[..., 1].astype(int) + 65_536 * codes[..., 2].astype(int)
    return drawn[code]


def _segments(stage: Stage) -> tuple[tuple[str, ...], NDArray[np.generic]]:
    """Return what there is to see, and for one more than a geom its place there."""
    names, numbers = [""], np.zeros(stage.model.ngeom + 1, np.uint16)
    for geom, label, robots in stage.drawn:
        label = ROBOT if robots else label
        if label not in names:
            names.append(label)
        numbers[geom + 1] = names.index(label)
    return tuple(names), numbers
