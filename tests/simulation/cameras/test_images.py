"""What cameras see is where forward kinematics says that it is."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.executions import drawer_plan

import vkc_pin as vkc
from vkc_pin.simulation import snapshots
from vkc_pin.simulation.cameras.images import ROBOT, Images, taken
from vkc_pin.simulation.cameras.mount import Camera
from vkc_pin.simulation.replay import Replay
from vkc_pin.simulation.result import SimulationResult

HEAD = Camera("head", "base", (0.0, 0.0, 1.5), (1.2, 0.0, 0.6), width=96, height=64)
WRIST = Camera(
    "wrist",
    "hand",
    (0.0, -0.12, -0.12),
    (0.0, 0.0, 0.1),
    up=(0.0, -1.0, 0.0),
    fov=75.0,
    width=48,
    height=48,
)


@pytest.fixture(scope="module")
def executed() -> SimulationResult:
    return drawer_plan().simulate()


@pytest.fixture(scope="module")
def images(executed: SimulationResult) -> Images:
    try:
        return taken(executed, [HEAD, WRIST], np.array([0.0, 0.0, executed.planned.times[-1]]))
    except vkc.VkcError as error:  # no OpenGL on this machine
        pytest.skip(str(error))


def test_shapes_and_kinds(images: Images) -> None:
    said = {name: (pixels.shape, str(pixels.dtype)) for name, pixels in images.pictures.items()}
    assert said == {
        "head_image": ((3, 64, 96, 3), "uint8"),
        "head_depth": ((3, 64, 96), "uint16"),
        "head_segmentation": ((3, 64, 96), "uint16"),
        "wrist_image": ((3, 48, 48, 3), "uint8"),
        "wrist_depth": ((3, 48, 48), "uint16"),
        "wrist_segmentation": ((3, 48, 48), "uint16"),
    }
    assert {"", ROBOT, "floor", "drawer.tray", "counter"} <= set(images.segments)


def test_the_same_moment_looks_the_same_and_another_does_not(images: Images) -> None:
    for name, pixels in images.pictures.items():
        np.testing.assert_array_equal(pixels[0], pixels[1], err_msg=name)
        assert (pixels[0] != pixels[2]).mean() > 0.01, name


def test_pixels_of_the_floor_are_on_the_floor(images: Images, executed: SimulationResult) -> None:
    """Every pixel that is the floor's, sent back along its ray by its distance, is at height 0; and no other one is below."""
    world = Replay(executed.scene, executed.trajectory.times, executed.rows)
    data = world.model.createData()
    row = world.positions(executed.trajectory, np.array([executed.planned.times[-1]]))[0]
    pin.framesForwardKinematics(world.model, data, world.coordinates.q(row))
    for camera, least in ((HEAD, 300), (WRIST, 5)):
        seat = data.oMf[world.model.getFrameId(camera.on(executed.scene.robot))] * camera.placement
        depth = images.pictures[f"{camera.name}_depth"][2].astype(float) / 1000.0
        what = images.pictures[f"{camera.name}_segmentation"][2]
        v, u = np.mgrid[: camera.height, : camera.width]
        focal = camera.height / 2.0 / np.tan(np.radians(camera.fov) / 2.0)
        x, y = (u + 0.5 - camera.width / 2.0) / focal, -(v + 0.5 - camera.height / 2.0) / focal
        points = (
            np.stack([x, y, -np.ones_like(x)], axis=-1) * depth[..., None]
        ) @ seat.rotation.T + seat.translation
        floor = what == images.segments.index("floor")
        assert floor.sum() >= least
        assert np.abs(points[floor][:, 2]).max() < 0.01
        assert points[(what > 0) & ~floor][:, 2].min() > -0.01


def test_as_bytes_and_back(images: Images) -> None:
    again = Images.from_bytes(images.to_bytes())
    assert again.segments == images.segments
    assert list(again.pictures) == list(images.pictures)
    for name, pixels in images.pictures.items():
        np.testing.assert_array_equal(again.pictures[name], pixels)


def test_without_opengl_the_error_says_so(
    monkeypatch: pytest.MonkeyPatch, executed: SimulationResult
) -> None:
    monkeypatch.setattr(snapshots, "_CONTEXTS", ("no_such_context",))
    with pytest.raises(vkc.VkcError, match="EGL or OSMesa"):
        taken(executed, [HEAD], np.zeros(1))
