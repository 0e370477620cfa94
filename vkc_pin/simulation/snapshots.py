"""Snapshots and videos of what happened in physics, drawn by MuJoCo without a screen."""

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
from vkc_pin.simulation.physics import Physics, engine, weigh
from vkc_pin.simulation.replay import Executed, Replay
from vkc_pin.simulation.servos import Servo
from vkc_pin.utils import arguments
from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization.camera import FIELD_OF_VIEW
from vkc_pin.visualization.room import is_wall
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.obstacles import FLOOR

__all__ = ["Stage", "drawing_context", "film", "strip"]

_SIZE = (640, 480)  # of a snapshot [pixels]
_FASTEST = 60.0  # pictures a second in a video
_MOST = 24  # snapshots in a picture
_SEEN = 2  # MuJoCo draws geoms of the groups 0 to 2
_VEIL = 0.12  # opacity of walls
_CONTEXTS = ("egl", "osmesa", "glfw")  # of OpenGL, without a screen first


class Stage:
    """A scene to be drawn, with its visual meshes.

    Args:
        executed: What happened in it.
        size: Of the largest picture, width and height [pixels].
        veil: Opacity of walls.
        more: What else to add to the model: cameras, say.

    Attributes:
        mj: The package `mujoco`.
    """

    def __init__(
        self,
        executed: Executed,
        *,
        size: tuple[int, int] = _SIZE,
        veil: float = _VEIL,
        more: Callable[[Builder], None] | None = None,
    ) -> None:
        self.mj, self._executed = engine(), executed
        self._world = Replay(executed.scene, executed.trajectory.times, executed.rows)
        shapes, robot = len(self._world.shapes), executed.scene.robot
        weigh(self._world, Physics())
        none = Pairs(np.zeros((0, 2), int), np.zeros(shapes, int), np.zeros(shapes, int), {}, ())
        count = len(executed.scene.start) + (
            0 if robot.gripper is None else len(robot.gripper.names)
        )
        servos = [
            Servo(name, 1.0, 1.0, 1.0, 0.0, np.inf)
            for name in self._world.coordinates.names[:count]
        ]

        def dressed(builder: Builder) -> None:
            _dress(builder, size, veil)
            if more is not None:
                more(builder)

        self._physical = Builder(self._world, Physics()).built(none, servos, (), (), more=dressed)

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel`."""
        return self._physical.model

    @property
    def drawn(self) -> Iterator[tuple[int, str, bool]]:
        """What can be seen: a geom, the link or obstacle that it belongs to, and whether that is the robot's."""
        world, model = self._world, self.model
        for number, (shape, label) in enumerate(
            zip(world.visual.geometryObjects, world.visual_labels, strict=True)
        ):
            yield (
                int(model.geom(f"seen {number}").id),
                label,
                shape.parentJoint > 0 and "." not in label,
            )
        for number, label in enumerate(world.collision_labels):
            if label == FLOOR:
                yield int(model.geom(f"shape {number}").id), label, False

    def rows(self, times: Floats) -> Floats:
        """Return where everything was at some times [s], shape (K,): shape (K, n)."""
        return self._world.positions(self._executed.trajectory, times)

    def qpos(self, row: Floats) -> Floats:
        """Return MuJoCo's configuration of coordinates of the world, shape (n,)."""
        return self._physical.qpos(row)

    def pictures(
        self, times: Floats, viewpoint: tuple[Floats, Floats]
    ) -> Iterator[NDArray[np.uint8]]:
        """Yield a picture of what was at each of some times [s], shape (K,): shape (height, width, 3).

        Args:
            times: When.
            viewpoint: What the camera looks at, and where it is, shape (3,) each [m].

        Raises:
            VkcError: There is no OpenGL without a screen.
        """
        mj, model = self.mj, self.model
        data, camera, option = mj.MjData(model), mj.MjvCamera(), mj.MjvOption()
        target, place = viewpoint
        ahead = target - place
        camera.lookat[:], camera.distance = target, float(np.linalg.norm(ahead))
        camera.azimuth = float(np.degrees(np.arctan2(ahead[1], ahead[0])))
        camera.elevation = float(np.degrees(np.arcsin(ahead[2] / camera.distance)))
        window = mj.MjrRect(0, 0, *_SIZE)
        with drawing_context(_SIZE):
            stage, render = (
                mj.MjvScene(model, maxgeom=20_000),
                mj.MjrContext(model, mj.mjtFontScale.mjFONTSCALE_100),
            )
            mj.mjr_setBuffer(mj.mjtFramebuffer.mjFB_OFFSCREEN, render)
            for row in self.rows(times):
                data.qpos[:] = self.qpos(row)
                mj.mj_forward(model, data)
                mj.mjv_updateScene(
                    model, data, option, mj.MjvPerturb(), camera, mj.mjtCatBit.mjCAT_ALL, stage
                )
                mj.mjr_render(window, stage, render)
                pixels = np.zeros((_SIZE[1], _SIZE[0], 3), np.uint8)
                mj.mjr_readPixels(pixels, None, window, render)
                yield pixels[::-1]
            render.free()

    def viewpoint(self) -> tuple[Floats, Floats]:
        """Return from where all that happens is seen; see `Drawing.viewpoint`."""
        import meshcat

        from vkc_pin.visualization.drawing import Drawing
        from vkc_pin.visualization.viewer import Recorder

        viewer, executed = meshcat.Visualizer(window=Recorder()), self._executed
        times = np.linspace(executed.trajectory.times[0], executed.trajectory.times[-1], 60)
        return Drawing(
            viewer, executed.scene, executed.trajectory, world=self._world, times=times
        ).viewpoint()


def strip(executed: Executed, path: str | Path, *, count: int = 6) -> Path:
    """Write a picture (.png) of snapshots in a row, evenly spread over the time in which something is held, and one before.

    Args:
        executed: What happened.
        path: The file, written whole or not at all.
        count: How many.

    Returns:
        The path.

    Raises:
        InputError: `count` is out of range.
        VkcError: There is no OpenGL without a screen.
    """
    count = arguments.whole(count, "count", low=2, high=_MOST)
    first, last = float(executed.planned.times[0]), float(executed.planned.times[-1])
    held = [phase for phase in executed.planned.phases if phase.holds]
    begin = float(executed.planned.times[held[0].first]) if held else first
    times = np.concatenate([[(first + begin) / 2.0], np.linspace(begin, last, count - 1)])
    stage = Stage(executed)
    pictures = list(stage.pictures(times, stage.viewpoint()))
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
        phase = next(
            (
                p.name
                for p in executed.planned.phases
                if time <= executed.planned.times[p.last] + 1e-9
            ),
            "",
        )
        axes.set_title(f"{time:.1f} s – {phase}", fontsize=10)
    data = io.BytesIO()
    figure.savefig(data, format="png")
    return write_atomically(path, data.getvalue())


def film(executed: Executed, path: str | Path, *, rate: float = 25.0) -> Path:
    """Write a video (.mp4, H.264) of what happened, at the speed at which it did.

    Args:
        executed: What happened.
        path: The file, written whole or not at all.
        rate: Pictures a second [Hz].

    Returns:
        The path.

    Raises:
        InputError: `rate` is out of range, or there is no ffmpeg.
        VkcError: There is no OpenGL without a screen, or ffmpeg refuses.
    """
    rate, encoder = (
        arguments.number(rate, "rate", "pictures a second", low=1.0, high=_FASTEST),
        _ffmpeg(),
    )
    times = np.arange(executed.trajectory.times[0], executed.trajectory.times[-1], 1.0 / rate)
    stage, size = Stage(executed), "x".join(map(str, _SIZE))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "film.mp4")
        taken = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(rate), "-i", "-"]
        command = [
            encoder,
            "-loglevel",
            "error",
            *taken,
            "-c:v",
            "libx264",
            "-pix_fmt",
            "yuv420p",
            str(file),
        ]
        pictures = b"".join(
            picture.tobytes() for picture in stage.pictures(times, stage.viewpoint())
        )
        done = subprocess.run(command, input=pictures, capture_output=True, check=False)
        if done.returncode:
            raise VkcError(
                f"ffmpeg writes no video: {done.stderr.decode(errors='replace').strip()}"
            )
        return write_atomically(path, file.read_bytes())


def _ffmpeg() -> str:
    """Return the program ffmpeg: the machine's own, or that of the package imageio-ffmpeg."""
    if (own := shutil.which("ffmpeg")) is not None:
        return own
    try:
        return str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise InputError(
            "videos need ffmpeg", expected="ffmpeg, or pip install imageio-ffmpeg", got="neither"
        ) from error


def _dress(builder: Builder, size: tuple[int, int], veil: float) -> None:
    """Add what is seen: visual meshes instead of collision shapes, walls that may be looked through, light and sky."""
    mj, spec, world = builder.mj, builder.spec, builder.world
    for number, shape in enumerate(world.visual.geometryObjects):
        geom = builder.geom(
            builder.bodies[shape.parentJoint],
            f"seen {number}",
            shape.geometry,
            shape.placement,
            thin=True,
        )
        geom.contype = geom.conaffinity = 0
        geom.density, geom.group, geom.rgba = 0.0, _SEEN, np.asarray(shape.meshColor)
        if shape.parentJoint == 0 and is_wall(shape):
            geom.rgba[3] = veil
    for number, label in enumerate(world.collision_labels):
        if label == FLOOR:
            spec.geom(f"shape {number}").group = _SEEN
    look = spec.visual
    look.global_.offwidth, look.global_.offheight, look.global_.fovy = *size, FIELD_OF_VIEW
    look.headlight.ambient, look.headlight.diffuse, look.headlight.specular = (
        [0.45] * 3,
        [0.35] * 3,
        [0.0] * 3,
    )
    sun = mj.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(
        type=sun, dir=[0.1, 0.15, -1.0], pos=[0.0, 0.0, 6.0], diffuse=[0.5] * 3
    )
    sky = {
        "type": mj.mjtTexture.mjTEXTURE_SKYBOX,
        "builtin": mj.mjtBuiltin.mjBUILTIN_GRADIENT,
        "width": 64,
        "height": 384,
    }
    spec.add_texture(name="sky", rgb1=[0.93, 0.95, 0.97], rgb2=[0.99, 0.99, 0.99], **sky)


@contextlib.contextmanager
def drawing_context(size: tuple[int, int]) -> Iterator[None]:
    """Have a context of OpenGL that needs no screen, for pictures of a size [pixels].

    Raises:
        VkcError: There is none; the message says what was tried.
    """
    tried = []
    for name in _CONTEXTS:
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(*size)
            context.make_current()
            break
        except Exception as error:  # whatever a driver that is not there comes up with
            tried.append(f"{name}: {error}")
    else:
        raise VkcError(
            f"nothing can be drawn without a screen; MuJoCo needs EGL or OSMesa ({'; '.join(tried)})"
        )
    try:
        yield
    finally:
        context.free()
