from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.executions import simulate_drawer
from hypothesis import assume, given
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.simulation.cameras import ROBOT, Images, render_images
from vkc_pin.simulation.replay import Replay
from vkc_pin.world.models.camera import BASE, HAND, Camera
from vkc_pin.world.models.robot_file import load_robot

points = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


@given(points, points, points)
def test_target_is_centred_and_up_points_up(
    position: tuple[float, ...], target: tuple[float, ...], up: tuple[float, ...]
) -> None:
    distance = np.linalg.norm(ahead := np.subtract(target, position))
    sine = np.linalg.norm(np.cross(ahead, up))
    assume(sine > 1e-2 * max(1.0, distance * np.linalg.norm(up)))
    place = Camera("eye", BASE, position, target, up=up).placement  # type: ignore[arg-type]
    np.testing.assert_allclose(place.actInv(np.array(target)), [0.0, 0.0, -distance], atol=1e-9)
    above = place.rotation.T @ np.array(up)
    assert above[1] > 0.0
    assert above[0] == pytest.approx(0.0, abs=1e-9)
    assert np.linalg.det(place.rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("target", [(0.0, 0.0, 1.0), (0.0, 0.0, 0.3)])
def test_camera_with_undefined_orientation_is_rejected(target: tuple[float, float, float]) -> None:
    with pytest.raises(vkc.InputError, match="orientation of camera 'eye' is undefined"):
        Camera("eye", BASE, (0.0, 0.0, 1.0), target)


def test_frames_resolve_to_robot_frames() -> None:
    robot = load_robot("husky_ur5e")

    def find_frame(name: str) -> str:
        return Camera("eye", name, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)).find_frame(robot)

    expected = [robot.tool_frame, robot.model.names[1], "wrist_3_link"]
    assert [find_frame(name) for name in (HAND, BASE, "wrist_3_link")] == expected
    with pytest.raises(vkc.UnknownNameError, match="did you mean 'wrist_3_link'"):
        find_frame("wrist_3_lnk")


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
def images() -> Images:
    executed = simulate_drawer()
    times = np.array([0.0, 0.0, executed.planned.times[-1]])
    try:
        return render_images(executed, [HEAD, WRIST], times)
    except vkc.VkcError as error:  # no OpenGL on this machine
        pytest.skip(str(error))


def test_images_have_expected_shapes_and_types(images: Images) -> None:
    formats = {name: (pixels.shape, str(pixels.dtype)) for name, pixels in images.pictures.items()}
    expected: dict[str, tuple[tuple[int, ...], str]] = {}
    for name, size in (("head", (3, 64, 96)), ("wrist", (3, 48, 48))):
        expected[f"{name}_image"] = ((*size, 3), "uint8")
        expected |= {f"{name}_{kind}": (size, "uint16") for kind in ("depth", "segmentation")}
    assert formats == expected
    assert {"", ROBOT, "floor", "drawer.tray", "counter"} <= set(images.segments)


def test_images_change_only_with_time(images: Images) -> None:
    for name, pixels in images.pictures.items():
        np.testing.assert_array_equal(pixels[0], pixels[1], err_msg=name)
        assert (pixels[0] != pixels[2]).mean() > 0.01, name


def test_depth_of_floor_pixels_is_consistent(images: Images) -> None:
    """Floor pixels, projected back along their rays, lie at height 0 and all others above."""
    executed = simulate_drawer()
    robot = executed.scene.robot
    world = Replay(executed.scene, executed.trajectory.times, executed.rows)
    row = world.compute_positions(executed.trajectory, executed.planned.times[-1:])[0]
    data = world.model.createData()
    pin.framesForwardKinematics(world.model, data, world.coordinates.q(row))
    for camera, least in ((HEAD, 300), (WRIST, 5)):
        frame = data.oMf[world.model.getFrameId(camera.find_frame(robot))]
        place = frame * camera.placement
        depth = images.pictures[f"{camera.name}_depth"][2].astype(float) / 1000.0
        segments = images.pictures[f"{camera.name}_segmentation"][2]
        v, u = np.mgrid[: camera.height, : camera.width]
        focal = camera.height / 2.0 / np.tan(np.radians(camera.fov) / 2.0)
        x, y = (u + 0.5 - camera.width / 2.0) / focal, -(v + 0.5 - camera.height / 2.0) / focal
        rays = np.stack([x, y, -np.ones_like(x)], axis=-1)
        heights = depth * (rays @ place.rotation[2]) + place.translation[2]
        floor = segments == images.segments.index("floor")
        assert floor.sum() >= least
        assert np.abs(heights[floor]).max() < 0.01
        assert heights[(segments > 0) & ~floor].min() > -0.01
