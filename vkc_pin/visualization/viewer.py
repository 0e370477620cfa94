"""Shows scenes and plans with meshcat, in a notebook, a browser or a self-contained web page."""

from __future__ import annotations

import atexit
import base64
import contextlib
import gzip
import html
import json
import os
import re
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from vkc_pin.errors import InputError, VkcError
from vkc_pin.utils.arguments import check_bool, check_instance, check_integer, check_mapping
from vkc_pin.utils.notebook import in_notebook
from vkc_pin.utils.system import has_screen
from vkc_pin.validation.report import CheckedMotion
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.poses import as_placement
from vkc_pin.world.scene.scene import Scene

if TYPE_CHECKING:
    import meshcat
    import pinocchio as pin

    from vkc_pin.visualization.drawing import Displacements, Drawing


# Commands of a scene are 1.5 % larger than at level 9, which takes four times as long.
_LEVEL = 6
# [s] that the server may take for an answer
_PATIENCE = 10.0
# The process, its address for commands, and for browsers.
_server: tuple[subprocess.Popen[bytes], str, str] | None = None


def show(
    plan_or_scene: CheckedMotion | Scene,
    *,
    open_browser: bool | None = None,
    height: int = 560,
    frames: Mapping[str, pin.SE3] | None = None,
) -> Any:
    """Show the motion of a plan, or a scene.

    In a notebook the result is an inline view with play, pause and a time slider, which is saved
    with the notebook. Elsewhere a server on the loopback interface shows it in a browser.

    Args:
        plan_or_scene: Plan or scene to show.
        open_browser: Whether to open a browser window. Default: if there is a screen. Ignored in a
            notebook.
        height: Height of the inline view [pixels].
        frames: Name → placement in the world of static frames to draw (x red, y green, z blue).

    Returns:
        In a notebook an object that displays itself; elsewhere the `meshcat.Visualizer`. Its
        address is printed.

    Raises:
        InputError: Neither a plan nor a scene, or something that cannot be drawn.
        VkcError: The server does not start, or does not answer.
    """
    scene, plan = _split(plan_or_scene)
    height = check_integer(height, "height", low=1, high=100_000)
    if open_browser is not None:
        check_bool(open_browser, "open_browser")
    if in_notebook():
        from IPython.display import HTML

        page = html.escape(_make_page(scene, plan, frames))
        name = html.escape(scene.name)
        style = f"width: 100%; height: {height}px; border: none"
        return cast(Any, HTML)(
            f'<div><iframe srcdoc="{page}" style="{style}" title="{name}"></iframe></div>'
        )
    viewer = open_viewer()
    _draw(viewer, scene, plan, frames=frames)
    sys.stdout.write(f"meshcat shows it at {viewer.url()}\n")
    if has_screen() if open_browser is None else open_browser:
        import webbrowser

        webbrowser.open(viewer.url(), new=2)
    return viewer


def animate(plan: CheckedMotion, viewer: meshcat.Visualizer | None = None) -> meshcat.Visualizer:
    """Animate a motion in a meshcat viewer with play, pause and a time slider in seconds.

    Args:
        plan: Plan to show.
        viewer: Viewer, whose content at its path is replaced. Default: that of `open_viewer`.

    Returns:
        The viewer. Give its `jupyter_cell()` as a cell's result to see it in a notebook, or visit
        its `url()`.

    Raises:
        InputError: Not a plan, or something that cannot be drawn.
    """
    import meshcat

    scene, checked = _split(plan)
    if checked is None:
        raise InputError(
            "a scene has no motion", field="plan", expected="a Plan", got=type(plan).__name__
        )
    if viewer is None:
        viewer = open_viewer()
    else:
        check_instance(viewer, meshcat.Visualizer, "viewer")
    _draw(viewer, scene, checked)
    return viewer


def to_html(
    plan_or_scene: CheckedMotion | Scene,
    path: str | Path,
    *,
    frames: Mapping[str, pin.SE3] | None = None,
    moving: Displacements | None = None,
) -> Path:
    """Write a self-contained web page with the motion of a plan, or a scene.

    The page plays the motion, with a time slider in seconds; `page.html#t=3.5` shows it at 3.5 s.

    Args:
        plan_or_scene: What to show.
        path: File to write, atomically.
        frames: Frames to draw; see `show`.
        moving: Obstacle that moves during the motion → times, shape (K,) [s], and its displacements
            from where the scene has it, in the world.

    Returns:
        The path.

    Raises:
        InputError: Neither a plan nor a scene, or something that cannot be drawn.
    """
    scene, plan = _split(plan_or_scene)
    page = _make_page(scene, plan, frames, moving)
    return write_atomically(path, page.encode("utf-8"))


def open_viewer() -> meshcat.Visualizer:
    """Return a viewer on the process's own meshcat server, which is started on demand.

    The server listens on the loopback interface only and ends with the process. All viewers of a
    process share one window.

    Raises:
        VkcError: The server does not start, or does not answer.
    """
    global _server
    import meshcat

    if _server is None or _server[0].poll() is not None:
        _server = _start_server()
    with contextlib.redirect_stdout(None):  # it would print its address
        window = _make_window(_server[1])
    return meshcat.Visualizer(window=window)


def _make_window(address: str) -> Any:
    """Return a connection to a meshcat server that raises an error if there is no answer in time.

    A server that does not answer is terminated, so that the next viewer gets a new one.
    """
    import zmq
    from meshcat.visualizer import ViewerWindow

    class Window(ViewerWindow):
        def connect_zmq(self) -> None:
            super().connect_zmq()
            self.zmq_socket.setsockopt(zmq.LINGER, 0)
            self.zmq_socket.setsockopt(zmq.RCVTIMEO, round(1000.0 * _PATIENCE))

        def wait(self) -> str:
            answer = super().wait()
            while answer != "ok":  # the server answers before a page is open
                answer = super().wait()
            return str(answer)

        def send(self, command: Any) -> None:
            with _report_silence():
                super().send(command)

    @contextlib.contextmanager
    def _report_silence() -> Iterator[None]:
        try:
            yield
        except zmq.Again:
            if _server is not None:
                _server[0].kill()
            raise VkcError(
                f"meshcat's server did not answer within {_PATIENCE:g} s; it is ended, "
                "and the next call starts another"
            ) from None

    with _report_silence():
        return Window(address, False, [])


def _start_server() -> tuple[subprocess.Popen[bytes], str, str]:
    """Start a server; return the process, its address for commands, and for browsers."""
    # -P: the folder of that file is no place to import from.
    command = [sys.executable, "-P", "-u", str(Path(__file__).with_name("server.py"))]
    folders = [folder for folder in sys.path if folder]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=environment,
        start_new_session=True,
    )
    atexit.register(process.kill)
    assert process.stdout is not None
    addresses: list[str] = []
    for _ in range(2):  # lines "zmq_url=..." and "web_url=..."
        line = process.stdout.readline().decode().strip()
        addresses.append(line.partition("=")[2])
    command_address, browser_address = addresses
    if not command_address or not browser_address:
        process.kill()
        raise VkcError(
            "meshcat's server does not start; is a port from 6000 and one from 7000 on free?"
        )
    return process, command_address, browser_address


def _split(plan_or_scene: Any) -> tuple[Scene, CheckedMotion | None]:
    """Return the scene, and the motion if there is one."""
    if isinstance(plan_or_scene, Scene):
        return plan_or_scene, None
    if isinstance(plan_or_scene, CheckedMotion):
        return plan_or_scene.scene, plan_or_scene
    got = type(plan_or_scene).__name__
    raise InputError(
        "this cannot be shown", field="plan_or_scene", expected="a Plan or a Scene", got=got
    )


def _draw(
    viewer: Any,
    scene: Scene,
    plan: CheckedMotion | None,
    *,
    play: bool = True,
    frames: Mapping[str, pin.SE3] | None = None,
    moving: Displacements | None = None,
) -> Drawing:
    """Draw a scene, and a motion in it, into a viewer."""
    from vkc_pin.visualization.drawing import Drawing

    given = {} if frames is None else frames
    named = check_mapping(given, "frames", "names, each with a pinocchio.SE3")
    placed = {name: as_placement(where, name=f"frames.{name}") for name, where in named.items()}
    if plan is None:
        drawing = Drawing(viewer, scene)
    else:
        drawing = Drawing(viewer, scene, plan.trajectory, plan.report, moving=moving)
    drawing.draw(play=play, frames=placed)
    return drawing


def _make_page(
    scene: Scene,
    plan: CheckedMotion | None,
    frames: Mapping[str, pin.SE3] | None = None,
    moving: Displacements | None = None,
) -> str:
    import meshcat

    recorder = Recorder()
    viewer = meshcat.Visualizer(window=recorder)
    drawing = _draw(viewer, scene, plan, play=False, frames=frames, moving=moving)
    film = {**_describe_film(scene, plan), "portrait": drawing.find_portrait_position()}
    return render_page(recorder, title=f"{scene.name} – vkc_pin", film=film)


def _describe_film(scene: Scene, plan: CheckedMotion | None) -> dict[str, Any]:
    if plan is None:
        return {"duration": 0.0, "phases": [], "notes": [], "because": [], "headline": scene.name}
    begin = float(plan.trajectory.times[0])
    times = plan.trajectory.times - begin
    phases = [
        {"name": phase.name, "last": float(times[phase.last])} for phase in plan.trajectory.phases
    ]
    notes: list[dict[str, Any]] = []
    for violation in plan.report.violations:
        text = f"{violation.constraint} {violation.subject}: {violation.detail}"
        notes.append({"text": text, "time": violation.time - begin})
    outcome = "success" if plan.success else f"FAILED, {plan.status}"
    return {
        "duration": float(times[-1]),
        "phases": phases,
        "notes": notes,
        "because": list(plan.report.notes),
        "headline": f"{scene.name}: {outcome}",
    }


class Recorder:
    """Records a viewer's commands; pass it as `window` to `meshcat.Visualizer`.

    Attributes:
        commands: Recorded commands.
    """

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []

    def send(self, command: Any) -> None:
        """Record a meshcat command."""
        self.commands.append(command.lower())


def render_page(recorder: Recorder, *, title: str, film: dict[str, Any]) -> str:
    """Render a web page with meshcat's viewer, a drawing's commands and playback controls."""
    import meshcat
    import umsgpack  # type: ignore[import-untyped]

    viewer = Path(meshcat.__file__).parent / "viewer" / "dist" / "main.min.js"
    # Each command follows its length, an unsigned 32-bit number.
    parts: list[bytes] = []
    for command in recorder.commands:
        packed = umsgpack.packb(command)
        parts += [struct.pack("<I", len(packed)), packed]
    commands = b"".join(parts)
    template = (Path(__file__).parent / "page.html").read_text(encoding="utf-8")
    pieces = {
        "TITLE": html.escape(title),
        "FILM": json.dumps(film).replace("<", "\\u003c"),
        "VIEWER": _pack_file(viewer),
        "COMMANDS": _pack(commands),
    }
    return re.sub(r"%(TITLE|FILM|VIEWER|COMMANDS)%", lambda match: pieces[match[1]], template)


@lru_cache(maxsize=1)
def _pack_file(file: Path) -> str:
    return _pack(file.read_bytes())


def _pack(data: bytes) -> str:
    """Return data as compressed text that the page unpacks."""
    compressed = gzip.compress(data, _LEVEL, mtime=0)
    return base64.b64encode(compressed).decode("ascii")
