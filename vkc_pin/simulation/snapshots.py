"""Renders snapshots and videos of an executed motion with MuJoCo, without a display."""

from __future__ import annotations

import contextlib
import importlib
import io
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vkc_pin.errors import InputError, VkcError
from vkc_pin.simulation.contacts import Pairs
from vkc_pin.simulation.model import Builder
from vkc_pin.simulation.physics import Physics, complete_inertias, import_mujoco
from vkc_pin.simulation.replay import Execution, Replay
from vkc_pin.simulation.servos import Servo
from vkc_pin.utils import arguments
from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization.camera import FIELD_OF_VIEW
from vkc_pin.visualization.room import is_wall
from vkc_pin.world.files.writing import check_writable, write_atomically
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.trajectory.trajectory import Trajectory

# width and height of a snapshot [pixels]
_SIZE = (640, 480)
# frames per second of a video
_MAX_RATE = 60.0
# snapshots in an image
_MAX_SNAPSHOTS = 24
# MuJoCo draws geoms of groups 0 to 2
_VISIBLE_GROUP = 2
_WALL_OPACITY = 0.12
# OpenGL back ends, those without a display first
_CONTEXTS = ("egl", "osmesa", "glfw")
# geoms that MuJoCo draws at most
_MAX_GEOMS = 20_000


class RenderedScene:
    """A scene with its visual meshes, ready for rendering.

    Args:
        executed: The executed motion.
        size: Width and height of the largest image [pixels].
        wall_opacity: Opacity of walls.
        add_extras: Adds cameras, for example, to the model.

    Attributes:
        mj: The package `mujoco`.
    """

    def __init__(
        self,
        executed: Execution,
        *,
        size: tuple[int, int] = _SIZE,
        wall_opacity: float = _WALL_OPACITY,
        add_extras: Callable[[Builder], None] | None = None,
    ) -> None:
        self.mj = import_mujoco()
        self._executed = executed
        self._world = Replay(executed.scene, executed.trajectory.times, executed.rows)
        complete_inertias(self._world, Physics())
        shape_count = len(self._world.shapes)
        no_pairs = Pairs(
            always=np.zeros((0, 2), int),
            types=np.zeros(shape_count, int),
            affinities=np.zeros(shape_count, int),
            bits={},
            overlapping=(),
        )
        gripper = executed.scene.robot.gripper
        finger_count = 0 if gripper is None else len(gripper.names)
        names = self._world.coordinates.names[: len(executed.scene.start) + finger_count]
        # Nothing is simulated: any servo will do.
        servos = [Servo(name, 1.0, 1.0, 1.0, 0.0, np.inf) for name in names]

        def add_all_visuals(builder: Builder) -> None:
            _add_visuals(builder, size, wall_opacity)
            if add_extras is not None:
                add_extras(builder)

        builder = Builder(self._world, Physics())
        self._physical = builder.build(no_pairs, servos, (), (), add_extras=add_all_visuals)

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel`."""
        return self._physical.model

    @property
    def visible_geoms(self) -> Iterator[tuple[int, str, bool]]:
        """Visible geoms with their link or obstacle, and whether the link is the robot's."""
        world = self._world
        visuals = zip(world.visual.geometryObjects, world.visual_labels, strict=True)
        for number, (shape, label) in enumerate(visuals):
            geom = int(self.model.geom(f"visual {number}").id)
            is_robot = shape.parentJoint > 0 and "." not in label
            yield geom, label, is_robot
        for number, label in enumerate(world.collision_labels):
            if label == FLOOR:
                geom = int(self.model.geom(f"shape {number}").id)
                yield geom, label, False

    def iterate_states(
        self, times: Floats, size: tuple[int, int]
    ) -> Iterator[tuple[Any, Any, Any]]:
        """Yield `MjData`, `MjvScene` and `MjrContext` for images at times [s], shape (K,).

        Raises:
            VkcError: OpenGL is not available without a display.
        """
        mj = self.mj
        model = self.model
        data = mj.MjData(model)
        with open_gl_context(size):
            gl_scene = mj.MjvScene(model, maxgeom=_MAX_GEOMS)
            gl_context = mj.MjrContext(model, mj.mjtFontScale.mjFONTSCALE_100)
            mj.mjr_setBuffer(mj.mjtFramebuffer.mjFB_OFFSCREEN, gl_context)
            for row in self._world.compute_positions(self._executed.trajectory, times):
                data.qpos[:] = self._physical.to_qpos(row)
                mj.mj_forward(model, data)
                yield data, gl_scene, gl_context
            gl_context.free()

    def update_view(self, data: Any, gl_scene: Any, camera: Any) -> None:
        """Update a scene of OpenGL for a state and a camera."""
        mj = self.mj
        options = mj.MjvOption()
        perturbation = mj.MjvPerturb()
        everything = mj.mjtCatBit.mjCAT_ALL
        mj.mjv_updateScene(self.model, data, options, perturbation, camera, everything, gl_scene)

    def render(
        self, times: Floats, viewpoint: tuple[Floats, Floats]
    ) -> Iterator[NDArray[np.uint8]]:
        """Yield an image, shape (height, width, 3), for each of some times.

        Args:
            times: Times, shape (K,) [s].
            viewpoint: Target and position of the camera, shape (3,) each [m].
        """
        mj = self.mj
        target, position = viewpoint
        ahead = target - position
        camera = mj.MjvCamera()
        camera.lookat[:] = target
        camera.distance = float(np.linalg.norm(ahead))
        camera.azimuth = float(np.degrees(np.arctan2(ahead[1], ahead[0])))
        camera.elevation = float(np.degrees(np.arcsin(ahead[2] / camera.distance)))
        width, height = _SIZE
        window = mj.MjrRect(0, 0, width, height)
        for data, gl_scene, gl_context in self.iterate_states(times, _SIZE):
            self.update_view(data, gl_scene, camera)
            mj.mjr_render(window, gl_scene, gl_context)
            pixels = np.zeros((height, width, 3), np.uint8)
            mj.mjr_readPixels(pixels, None, window, gl_context)
            yield pixels[::-1]  # OpenGL's first row is the lowest one

    def find_viewpoint(self) -> tuple[Floats, Floats]:
        """Return a viewpoint that sees the whole motion; see `Drawing.find_viewpoint`."""
        import meshcat

        from vkc_pin.visualization.drawing import Drawing
        from vkc_pin.visualization.viewer import Recorder

        viewer = meshcat.Visualizer(window=Recorder())
        trajectory = self._executed.trajectory
        times = np.linspace(trajectory.times[0], trajectory.times[-1], 60)
        scene = self._executed.scene
        drawing = Drawing(viewer, scene, trajectory, world=self._world, times=times)
        return drawing.find_viewpoint()


def write_snapshots(executed: Execution, path: str | Path, *, count: int = 6) -> Path:
    """Write an image (.png) of snapshots side by side.

    They are evenly distributed over the time in which the robot holds something, plus one before.

    Returns:
        The path.
    """
    count = arguments.check_integer(count, "count", low=2, high=_MAX_SNAPSHOTS)
    check_writable(path)
    planned = executed.planned
    first, last = planned.times[[0, -1]].tolist()
    holding = [phase for phase in planned.phases if phase.holds]
    begin = float(planned.times[holding[0].first]) if holding else first
    before = (first + begin) / 2.0
    times = np.concatenate([[before], np.linspace(begin, last, count - 1)])
    scene = RenderedScene(executed)
    pictures = list(scene.render(times, scene.find_viewpoint()))
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=(4.0 * columns, 3.3 * rows), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for number, (time, picture) in enumerate(zip(times.tolist(), pictures, strict=True), 1):
        axes = figure.add_subplot(rows, columns, number)
        axes.imshow(picture)
        axes.set_axis_off()
        axes.set_title(f"{time:.1f} s – {_find_phase_name(planned, time)}", fontsize=10)
    data = io.BytesIO()
    figure.savefig(data, format="png")
    return write_atomically(path, data.getvalue())


def _find_phase_name(trajectory: Trajectory, time: float) -> str:
    """Return the name of the phase at a time [s]; "" after the last one."""
    for phase in trajectory.phases:
        if time <= trajectory.times[phase.last] + 1e-9:
            return phase.name
    return ""


def write_video(executed: Execution, path: str | Path, *, rate: float = 25.0) -> Path:
    """Write a video (.mp4, H.264) of the executed motion in real time.

    Args:
        executed: The executed motion.
        path: Output file, written atomically.
        rate: Frame rate [Hz].

    Returns:
        The path.
    """
    rate = arguments.check_number(rate, "rate", "frames per second", low=1.0, high=_MAX_RATE)
    encoder = _find_ffmpeg()
    check_writable(path)
    times = np.arange(executed.trajectory.times[0], executed.trajectory.times[-1], 1.0 / rate)
    scene = RenderedScene(executed)
    width, height = _SIZE
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "film.mp4")
        source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {rate} -i -"
        options = f"-loglevel error {source} -c:v libx264 -pix_fmt yuv420p"
        command = [encoder, *options.split(), str(file)]
        pictures = scene.render(times, scene.find_viewpoint())
        pixels = b"".join(picture.tobytes() for picture in pictures)
        done = subprocess.run(command, input=pixels, capture_output=True, check=False)
        if done.returncode:
            message = done.stderr.decode(errors="replace").strip()
            raise VkcError(f"ffmpeg failed to write the video: {message}")
        return write_atomically(path, file.read_bytes())


def _find_ffmpeg() -> str:
    """Return the ffmpeg executable: the system's own, or that of the package imageio-ffmpeg."""
    installed = shutil.which("ffmpeg")
    if installed is not None:
        return installed
    try:
        return str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise InputError(
            "videos need ffmpeg", expected="ffmpeg, or pip install imageio-ffmpeg", got="neither"
        ) from error


def _add_visuals(builder: Builder, size: tuple[int, int], wall_opacity: float) -> None:
    """Add visual meshes in place of collision shapes, translucent walls, lights and a sky."""
    mj = builder.mj
    spec = builder.spec
    world = builder.world
    for number, shape in enumerate(world.visual.geometryObjects):
        geom = builder.add_geom(
            builder.bodies[shape.parentJoint],
            f"visual {number}",
            shape.geometry,
            shape.placement,
            thin=True,
        )
        geom.contype = 0
        geom.conaffinity = 0
        geom.density = 0.0
        geom.group = _VISIBLE_GROUP
        geom.rgba = np.asarray(shape.meshColor)
        if shape.parentJoint == 0 and is_wall(shape):
            geom.rgba[3] = wall_opacity
    for number, label in enumerate(world.collision_labels):
        if label == FLOOR:
            spec.geom(f"shape {number}").group = _VISIBLE_GROUP
    width, height = size
    visual = spec.visual
    visual.global_.offwidth = width
    visual.global_.offheight = height
    visual.global_.fovy = FIELD_OF_VIEW
    visual.headlight.ambient = [0.45] * 3
    visual.headlight.diffuse = [0.35] * 3
    visual.headlight.specular = [0.0] * 3
    spec.worldbody.add_light(
        type=mj.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=[0.1, 0.15, -1.0],
        pos=[0.0, 0.0, 6.0],
        diffuse=[0.5] * 3,
    )
    spec.add_texture(
        name="sky",
        type=mj.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mj.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=64,
        height=384,
        rgb1=[0.93, 0.95, 0.97],
        rgb2=[0.99, 0.99, 0.99],
    )


@contextlib.contextmanager
def open_gl_context(size: tuple[int, int]) -> Iterator[None]:
    """Provide an OpenGL context without a display, for images of a size [pixels]."""
    failures: list[str] = []
    for name in _CONTEXTS:
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(*size)
            context.make_current()
            break
        except Exception as error:  # missing drivers raise errors of any type
            failures.append(f"{name}: {error}")
    else:
        tried = "; ".join(failures)
        raise VkcError(f"cannot render without a display; MuJoCo needs EGL or OSMesa ({tried})")
    try:
        yield
    finally:
        context.free()
