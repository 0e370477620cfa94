from __future__ import annotations

import contextlib
import dataclasses
import html
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import umsgpack
import zmq
from helpers import browser
from helpers.fake_plan import HINGE
from helpers.pages import read_clips, read_commands
from scipy.spatial.transform import Rotation, Slerp

from vkc_pin import InputError, Plan, VkcError, load_scene
from vkc_pin.visualization import viewer as visualization
from vkc_pin.world.trajectory.world_model import World

needs_chromium = pytest.mark.skipif(browser.CHROMIUM is None, reason="Chromium is not installed")


@pytest.fixture(scope="module")
def page(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return visualization.to_html(plan, tmp_path_factory.mktemp("page") / "door.html")


@pytest.fixture(scope="module")
def commands(page: Path) -> list[dict[str, Any]]:
    return read_commands(page.read_text(encoding="utf-8"))


def map_objects(commands: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {c["path"]: c["object"] for c in commands if c["type"] == "set_object"}


def read_vertices(item: dict[str, Any]) -> np.ndarray:
    extension = item["geometries"][0]["data"]["attributes"]["position"]["array"]
    return np.frombuffer(extension.data, np.float32).reshape(-1, 3)


def read_film(page: Path) -> dict[str, Any]:
    match = re.search(r'id="film">(.*?)</script>', page.read_text(encoding="utf-8"))
    assert match
    return json.loads(match[1])


def place_joints(plan: Plan, moment: float) -> dict[str, np.ndarray]:
    """Return joint → its placement in the world at a time [s], shape (4, 4)."""
    world = World(plan.scene)
    data = world.model.createData()
    (row,) = world.compute_positions(plan.trajectory, [moment])
    pin.forwardKinematics(world.model, data, world.coordinates.q(row))
    return {
        name: at.homogeneous for name, at in zip(world.model.names, data.oMi.tolist(), strict=True)
    }


# Geometry


def test_page_has_robot_door_walls_paths_and_ghosts(
    commands: list[dict[str, Any]], plan: Plan
) -> None:
    shapes = map_objects(commands)
    parts = ("door/frame", "hinge/panel", "knob/lever", "sofa", "floor", "grid")
    assert [part for part in parts if not any(part in path for path in shapes)] == []
    assert {"/meshcat/paths/tool", "/meshcat/paths/base"} <= shapes.keys()
    arm = [read_vertices(item) for path, item in shapes.items() if "forearm_link" in path]
    assert sum(map(len, arm)) > 3000, "the arm's visual meshes"
    robot = [item for path, item in shapes.items() if path.startswith("/meshcat/robot/")]
    assert len({item["materials"][0]["color"] for item in robot}) >= 5
    for name, shown in (("start", [False, True]), ("end", [True, False])):
        for owner in ("robot", "door"):
            path = f"/meshcat/ghosts/{name}/{owner}"
            assert path in shapes
            (track,) = read_clips(commands)[path]["tracks"]
            first, last = track["keys"][0], track["keys"][-1]
            assert [first["value"], last["value"]] == shown
            assert [first["time"], last["time"]] == [0.0, plan.trajectory.times[-1]]


def test_walls_are_transparent_from_outside(commands: list[dict[str, Any]]) -> None:
    walls, shapes = "/meshcat/room/walls", map_objects(commands)
    for name in ("wall_west", "wall_south"):
        (outside,) = shapes[f"{walls}/{name}/outside"]["materials"]
        assert outside["transparent"]
        assert outside["opacity"] < 0.2
        (inside,) = shapes[f"{walls}/{name}/inside"]["materials"]
        assert inside["side"] == 0, "visible from the room only"
    (sides,) = shapes[f"{walls}/wall_left_of_door/sides"]["materials"]
    assert sides["opacity"] < 0.5, "it separates two rooms"


# Animation


def test_scene_page_shows_frames_and_escapes_its_name(tmp_path: Path) -> None:
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.4, 2.0), np.array([1.0, -0.5, 0.8]))
    scene = dataclasses.replace(load_scene("drawer"), name="</script><b>%FILM%")
    file, frames = tmp_path / "deep" / "drawer.html", {"door.hinge": placement}
    text = visualization.to_html(scene, file, frames=frames).read_text(encoding="utf-8")
    assert "<b>" not in text
    assert "<title>&lt;/script&gt;&lt;b&gt;%FILM%" in text
    commands = read_commands(text)
    assert not read_clips(commands)
    shapes, frame = map_objects(commands), "/meshcat/frames/door.hinge"
    assert any("drawer" in path for path in shapes)
    assert not any("ghosts" in path or "paths" in path for path in shapes)
    arrows = {path: item for path, item in shapes.items() if path.startswith("/meshcat/frames/")}
    assert list(arrows) == [f"{frame}/{axis}" for axis in "xyz"]
    for column, item in enumerate(arrows.values()):
        low, high = read_vertices(item).min(axis=0), read_vertices(item).max(axis=0)
        assert high[column] > 0.1  # long along its axis, thin across it
        assert np.delete(high - low, column).max() < 0.02
        rgb = [item["materials"][0]["color"] >> shift & 255 for shift in (16, 8, 0)]
        assert int(np.argmax(rgb)) == column
        assert item["materials"][0]["depthTest"] is False
    (matrix,) = (
        c["matrix"] for c in commands if c["type"] == "set_transform" and c["path"] == frame
    )
    assert np.allclose(np.reshape(matrix, (4, 4)).T, placement.homogeneous)


def test_interpolated_animation_agrees_with_the_motion(
    commands: list[dict[str, Any]], plan: Plan
) -> None:
    """Interpolate like three.js: positions linearly, quaternions by slerp."""
    clips = read_clips(commands)
    static = {c["path"]: c["matrix"] for c in commands if c["type"] == "set_transform"}
    shift = np.array(static["/meshcat"]).reshape(4, 4).T
    moving = ("/meshcat/robot/", "/meshcat/objects/")
    paths = [path for path in clips if path.startswith(moving) and "<object>" not in path]
    for moment in (0.0, 0.33, 2.9, 3.05, 4.4, 5.9, 6.0):
        expected = place_joints(plan, moment)
        for path in paths:
            nodes, placement = path.split("/"), pin.SE3.Identity()
            for depth in range(2, len(nodes) + 1):
                placement = placement * compute_local_placement(
                    "/".join(nodes[:depth]), moment, clips, static
                )
            name = nodes[-1] if nodes[2] == "robot" else f"{nodes[3]}.{nodes[-1]}"
            np.testing.assert_allclose(placement.homogeneous, shift @ expected[name], atol=1e-5)


def compute_local_placement(
    path: str, moment: float, clips: dict[str, Any], static: dict[str, Any]
) -> pin.SE3:
    placement = pin.SE3(np.array(static.get(path, np.eye(4).ravel())).reshape(4, 4).T)
    for track in clips.get(path, {"tracks": []})["tracks"]:
        times, values = (
            np.array([key[name] for key in track["keys"]]) for name in ("time", "value")
        )
        if track["name"] == ".position":
            placement.translation = np.array([np.interp(moment, times, x) for x in values.T])
        elif track["name"] == ".quaternion":
            placement.rotation = Slerp(times, Rotation.from_quat(values))(moment).as_matrix()
    return placement


def test_violating_links_turn_red_at_the_time_of_the_violation(
    commands: list[dict[str, Any]],
) -> None:
    clips = {path: clip["tracks"][0] for path, clip in read_clips(commands).items()}
    red = {path: track["keys"] for path, track in clips.items() if track["type"] == "color"}
    assert red
    assert all("forearm_link" in path for path in red)
    for keys in red.values():
        alarms = [key["time"] for key in keys if key["value"][0] > 0.85 and key["value"][1] < 0.1]
        assert alarms
        assert all(abs(moment - 4.0) < 0.5 for moment in alarms)


# Page


def test_page_is_one_self_contained_file(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert page.stat().st_size < 5e6
    assert "default-src 'none'" in text, "the browser blocks all requests"
    markup = re.sub(r'<script type="application/[^>]*>[^<]*</script>', "", text)
    assert not re.search(r"https?://|<link|<img|<iframe|\bsrc=|@import|url\(", markup)
    assert [file.name for file in page.parent.glob("*.html")] == ["door.html"]


def test_page_contains_phases_violations_and_status(page: Path, plan: Plan) -> None:
    film = read_film(page)
    assert film["duration"] == pytest.approx(plan.trajectory.times[-1])
    assert [phase["name"] for phase in film["phases"]] == ["reach door.handle", "move door.hinge"]
    assert film["notes"][0]["text"].startswith("penetration forearm_link – sofa: ")
    assert film["because"] == list(plan.report.notes)
    assert "rejected" in film["headline"]


def test_page_times_start_with_the_motion(plan: Plan, page: Path, tmp_path: Path) -> None:
    motion, (violation,) = plan.trajectory, plan.report.violations
    later = dataclasses.replace(violation, time=violation.time + 100.0)
    shifted = dataclasses.replace(
        plan,
        trajectory=dataclasses.replace(motion, times=motion.times + 100.0, curve=None),
        report=dataclasses.replace(plan.report, violations=(later,)),
    )
    (note,) = read_film(page)["notes"]
    (found,) = read_film(visualization.to_html(shifted, tmp_path / "page.html"))["notes"]
    assert found == {**note, "time": pytest.approx(note["time"])}


@pytest.mark.parametrize(("delay", "slower"), [(1.7e9, 1.0), (-50.0, 1.0), (0.0, 1e9)])
def test_paths_do_not_depend_on_times(
    plan: Plan, commands: list[dict[str, Any]], tmp_path: Path, delay: float, slower: float
) -> None:
    """Recorded motions begin at the time of a clock, and may last for months."""
    motion = plan.trajectory
    times = delay + slower * motion.times
    other = dataclasses.replace(plan, trajectory=dataclasses.replace(motion, times=times))
    page = visualization.to_html(other, tmp_path / "page.html").read_text(encoding="utf-8")
    found, expected = map_objects(read_commands(page)), map_objects(commands)
    for path in ("/meshcat/paths/tool", "/meshcat/paths/base"):
        np.testing.assert_allclose(
            read_vertices(found[path]), read_vertices(expected[path]), atol=1e-3
        )


def test_invalid_arguments_are_rejected(plan: Plan, tmp_path: Path) -> None:
    for call in (
        lambda: visualization.show("door"),
        lambda: visualization.to_html(None, tmp_path / "x.html"),
    ):  # type: ignore[arg-type]
        with pytest.raises(InputError, match="Plan or a Scene"):
            call()
    with pytest.raises(InputError, match="Plan"):
        visualization.animate(plan.scene)  # type: ignore[arg-type]


# Notebook and server


@pytest.fixture(scope="module")
def viewer(plan: Plan) -> Iterator[Any]:
    yield visualization.show(plan, open_browser=False)
    process = visualization._server
    assert process is not None
    process[0].kill()


def request_status(port: int, host: str, *lines: str) -> int:
    """Return the status of the server's response; header lines request its websocket."""
    head = [f"GET {'/' if lines else '/static/'} HTTP/1.1", f"Host: {host}"]
    head += lines or ["Connection: close"]
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall("\r\n".join([*head, "", ""]).encode())
        return int(connection.makefile("rb").readline().split()[1])


def test_server_accepts_only_local_clients(viewer: Any) -> None:
    """A foreign web page may resolve its own host name to this machine."""
    assert visualization._server is not None
    addresses = visualization._server[1:]
    ports = [int(re.findall(r":(\d+)", address)[0]) for address in addresses]
    upgrade = (
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    )
    port = ports[1]
    for host in ("localhost", "LOCALHOST", "127.0.0.1", f"[::1]:{port}"):
        assert request_status(port, host) == 200, host
    local = f"localhost:{port}"
    assert request_status(port, local, *upgrade, f"Origin: http://{local}") == 101
    for origin in ("http://evil.example", f"http://evil.example:{port}", "http://localhost:1"):
        assert request_status(port, local, *upgrade, f"Origin: {origin}") == 403, origin
    for host in (f"evil.example:{port}", "localhost.evil.example", "0.0.0.0", "127.0.0.1@evil"):
        assert request_status(port, host) in (400, 403), host
        assert request_status(port, host, *upgrade, f"Origin: http://{host}") in (400, 403), host
    for number in ports:
        with pytest.raises(ConnectionRefusedError):  # bound to 127.0.0.1 only
            socket.create_connection(("127.0.0.2", number), timeout=20)


def connect_page(port: int) -> socket.socket:
    """Open the websocket of a page that has a small buffer, and reads the answer's header only."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    connection.settimeout(20)
    connection.connect(("127.0.0.1", port))
    lines = ("GET / HTTP/1.1", f"Host: localhost:{port}", "Connection: Upgrade")
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="
    lines += ("Upgrade: websocket", "Sec-WebSocket-Version: 13", key, "", "")
    connection.sendall("\r\n".join(lines).encode())
    header = b""
    while not header.endswith(b"\r\n\r\n"):
        header += connection.recv(1)
    assert b" 101 " in header
    return connection


def read_memory(process: subprocess.Popen[bytes]) -> int:
    """Return the resident memory of a process [bytes]."""
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


CONTENT = itertools.cycle(range(256))  # the server ignores an object that it has


def send_objects(address: str, count: int, size: int) -> None:
    """Send commands that replace one object, by another one each time."""
    with zmq.Context() as context, context.socket(zmq.REQ) as client:
        client.setsockopt(zmq.RCVTIMEO, 20_000)
        client.setsockopt(zmq.LINGER, 0)
        client.connect(address)
        for _ in range(count):
            client.send_multipart([b"set_object", b"/large", bytes([next(CONTENT)]) * size])
            assert client.recv() == b"ok"


def count_received(connection: socket.socket, most: int) -> int:
    """Return the number of bytes that arrive until there are enough, or the server disconnects."""
    total = 0
    while total < most:
        part = connection.recv(1 << 20)
        if not part:
            break
        total += len(part)
    return total


@pytest.fixture
def fresh_server() -> Iterator[tuple[subprocess.Popen[bytes], str, int]]:
    """Start a server with an empty scene; return its process, address and port for pages."""
    process, address, web = visualization._start_server()
    yield process, address, int(re.findall(r":(\d+)", web)[0])
    process.kill()


def test_pages_that_do_not_read_are_disconnected(
    fresh_server: tuple[subprocess.Popen[bytes], str, int],
) -> None:
    """What waits for a page would else fill the memory; others are not affected."""
    process, address, port = fresh_server
    before = read_memory(process)
    size, count = 4_000_000, 60
    with connect_page(port) as deaf, connect_page(port) as reader:
        for _ in range(count):
            send_objects(address, 1, size)
            assert count_received(reader, size) >= size
        assert read_memory(process) - before < 150_000_000
        assert count_received(deaf, size * count) < 80_000_000
    with connect_page(port) as late:
        assert count_received(late, size) >= size, "a new page gets the scene"


@pytest.mark.long
def test_small_commands_do_not_fill_the_memory(
    fresh_server: tuple[subprocess.Popen[bytes], str, int],
) -> None:
    """A waiting command takes 2 kB besides its own bytes, and its page is soon disconnected."""
    _, address, port = fresh_server
    size, count = 1000, 30_000
    with connect_page(port) as deaf:
        send_objects(address, count, size)
        assert count_received(deaf, size * count) < size * count


def test_many_pages_that_do_not_read_are_disconnected(
    fresh_server: tuple[subprocess.Popen[bytes], str, int],
) -> None:
    """Each alone may have 64 MB of waiting commands, but not all of them."""
    process, address, port = fresh_server
    before = read_memory(process)
    with contextlib.ExitStack() as stack:
        pages = [stack.enter_context(connect_page(port)) for _ in range(20)]
        send_objects(address, 12, 4_000_000)
        assert read_memory(process) - before < 700_000_000
        reader = stack.enter_context(connect_page(port))
        assert count_received(reader, 4_000_000) >= 4_000_000
        received = [count_received(page, 48_000_000) >= 48_000_000 for page in pages]
    assert 5 < sum(received) < 20, "only as many as necessary"


def test_closed_pages_do_not_delay_others(tmp_path: Path) -> None:
    """The commands that waited for them are forgotten, without a traceback for each."""
    log = tmp_path / "log"
    command = [sys.executable, "-P", "-u", str(visualization.__file__).replace("viewer", "server")]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with log.open("wb") as errors, subprocess.Popen(command, **pipes, stderr=errors) as process:
        assert process.stdout is not None
        found = [process.stdout.readline().decode().partition("=")[2] for _ in range(2)]
        address, web = (text.strip() for text in found)
        with connect_page(int(re.findall(r":(\d+)", web)[0])):
            send_objects(address, 300, 100_000)
        for _ in range(50):
            time.sleep(0.1)
            if b"closed" in log.read_bytes():
                break
        send_objects(address, 1, 100)
        process.kill()
    assert b"opened" in log.read_bytes()
    assert b"closed" in log.read_bytes()
    assert b"exception" not in log.read_bytes()


def test_pages_may_be_late_and_get_large_commands(
    fresh_server: tuple[subprocess.Popen[bytes], str, int],
) -> None:
    _, address, port = fresh_server
    for size, count in ((100_000_000, 1), (3_000_000, 16)):
        with connect_page(port) as page:
            shown = 100_000_000 if size < 100_000_000 else 0  # the scene
            send_objects(address, count, size)
            time.sleep(0.2)
            assert count_received(page, shown + size * count) >= shown + size * count


def test_properties_do_not_pile_up(
    fresh_server: tuple[subprocess.Popen[bytes], str, int],
) -> None:
    """A page that is opened later gets the last value of each property."""
    _, address, port = fresh_server
    with zmq.Context() as context, context.socket(zmq.REQ) as client:
        client.setsockopt(zmq.LINGER, 0)
        client.connect(address)
        for k in range(300):
            for name in ("color", "visible"):
                command = {"type": "set_property", "path": "/a", "property": name, "value": k}
                client.send_multipart([b"set_property", b"/a", umsgpack.packb(command)])
                assert client.recv() == b"ok"
    with connect_page(port) as page:
        time.sleep(0.5)
        data = page.recv(1 << 20)
    assert data.count(b"set_property") == 2
    for name in (b"color", b"visible"):
        assert umsgpack.packb({"property": name.decode(), "value": 299})[1:] in data


BAD_MESSAGES = [
    [b""],
    [b"\xff\xfe"],
    [bytes(range(256))],
    [b"set_object"],
    [b"set_object", b"/a"],
    [b"set_object", b"\xff", b""],
    [b"set_object", b"/a" * 5000, b""],
    [b"delete", b"/a/b/c/d", b"", b""],
    [b"capture_image"],
    [b"capture_image", b"", b""],
    [b"set_transform", b"", b"\xc1"],
    [b"wait"],
]


@pytest.mark.long
def test_invalid_messages_are_answered_and_leave_viewers_usable(viewer: Any, plan: Plan) -> None:
    assert visualization._server is not None
    address = visualization._server[1]
    context = zmq.Context()
    context.setsockopt(zmq.LINGER, 0)
    context.setsockopt(zmq.RCVTIMEO, 20_000)
    for message in BAD_MESSAGES:
        with context.socket(zmq.REQ) as client:
            client.connect(address)
            client.send_multipart(message)
            assert client.recv() == b"ok" or message[0] != b"set_transform"
    with context.socket(zmq.REQ) as client:  # disconnects before the reply
        client.connect(address)
        client.send(b"wait")
        time.sleep(0.1)
    context.destroy()
    second_viewer = visualization.show(plan, open_browser=False)
    assert second_viewer.url() == viewer.url(), "the server still runs"
    assert len(second_viewer.static_html()) > 1e6


def test_show_raises_if_the_server_does_not_answer(
    viewer: Any, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = visualization._server
    assert server is not None
    monkeypatch.setattr(visualization, "_PATIENCE", 0.5)
    os.kill(server[0].pid, signal.SIGSTOP)
    with pytest.raises(VkcError, match="did not answer within"):
        visualization.show(plan, open_browser=False)
    assert server[0].wait(timeout=20) != 0
    assert visualization.show(plan, open_browser=False).url().startswith("http://127.0.0.1:")


@pytest.mark.parametrize("path", ["%00", "a%00b", "%00/../index.html", "x" * 300, "%ff", ".."])
def test_addresses_without_a_file_are_not_found(viewer: Any, path: str) -> None:
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(f"{visualization.open_viewer().url()}{path}", timeout=10)
    assert caught.value.code in (400, 403, 404)


def test_server_serves_the_motion(viewer: Any, plan: Plan) -> None:
    with urllib.request.urlopen(viewer.url(), timeout=10) as answer:
        assert b"meshcat-pane" in answer.read()
    scene = viewer.static_html()
    assert len(scene) > 1e6
    assert visualization.animate(plan).url() == viewer.url(), "one window per process"


def test_animate_uses_a_given_viewer(plan: Plan) -> None:
    import meshcat

    from vkc_pin.visualization.viewer import Recorder

    recorder = Recorder()
    mine = meshcat.Visualizer(window=recorder)["mine"]
    assert visualization.animate(plan, mine) is mine
    assert "/meshcat/mine/paths/tool" in map_objects(recorder.commands)
    assert all(path.startswith("/meshcat/mine/") for path in read_clips(recorder.commands))


def test_server_ends_with_its_process() -> None:
    start = "from vkc_pin.visualization import viewer as v; v.open_viewer()"
    code = f"import os; {start}; print(v._server[0].pid, flush=True); os._exit(1)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    stat = Path(f"/proc/{int(done.stdout)}/stat")
    for _ in range(50):
        if not stat.is_file() or " Z " in stat.read_text():
            return
        time.sleep(0.1)
    pytest.fail("the server outlives its process")


# Browser


def take_picture(page: Path, moment: float) -> np.ndarray:
    from PIL import Image

    for budget in (6.0, 20.0):  # a busy browser may end before it has drawn anything
        file = page.with_name(f"{moment}.png")
        browser.save_screenshot(page, file, time=moment, size=(800, 500), budget=budget)
        pixels = np.asarray(Image.open(file).convert("RGB"), int)
        if len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100:
            break
    return pixels


@pytest.mark.long
@needs_chromium
@pytest.mark.browser
def test_picture_changes_over_time(page: Path) -> None:
    start, end = (take_picture(page, moment)[80:-60] for moment in (0.0, 6.0))
    assert len(np.unique(start.reshape(-1, 3), axis=0)) > 2000
    changed = np.abs(start - end).max(axis=2) > 25
    assert 0.005 < changed.mean() < 0.5, "the robot has moved, the room has not"


@pytest.mark.long
@needs_chromium
@pytest.mark.browser
@pytest.mark.parametrize("count", [3, pytest.param(5, marks=pytest.mark.long)])
def test_page_counts_the_reasons_that_it_does_not_show(
    plan: Plan, tmp_path: Path, count: int
) -> None:
    reasons = tuple(f"reason {k}" for k in range(count))
    report = dataclasses.replace(plan.report, notes=reasons)
    page = visualization.to_html(dataclasses.replace(plan, report=report), tmp_path / "door.html")
    text = browser.read_document(page, time=0.0, until="because reason 0")
    shown = re.search(r'<div id="because">(.*?)</div>', text)
    assert shown
    hidden = [f"and {count - 3} more in the report"] if count > 3 else []
    assert shown[1].split(" · ") == [*(f"because {reason}" for reason in reasons[:3]), *hidden]


@needs_chromium
@pytest.mark.browser
def test_browser_shows_links_at_their_placements(page: Path, plan: Plan) -> None:
    probe = """
    <script>
    const waiting = setInterval(() => {
      if (!document.documentElement.dataset.ready) return;
      clearInterval(waiting);
      const root = vkc.viewer.scene_tree.find(["meshcat"]).object, seen = {};
      vkc.viewer.scene.updateMatrixWorld(true);
      const base = root.matrixWorld.clone().invert();
      const look = (o) => { seen[o.name] = base.clone().multiply(o.matrixWorld).elements; };
      for (const part of ["robot", "objects"]) root.getObjectByName(part).traverse(look);
      const panel = document.createElement("pre");
      panel.id = "seen";
      const sun = vkc.viewer.scene.getObjectByProperty("type", "DirectionalLight");
      panel.textContent = JSON.stringify({ seen, sun: sun !== undefined });
      document.body.appendChild(panel);
    }, 50);
    const data = document.body.dataset;
    addEventListener("securitypolicyviolation", (event) => { data.refused = event.blockedURI; });
    addEventListener("error", (event) => { data.error = event.message; });
    </script></body>"""
    probed = page.with_name("probed.htm")
    probed.write_text(page.read_text(encoding="utf-8").replace("</body>", probe), encoding="utf-8")
    moment = 4.4
    text = browser.read_document(probed, time=moment, until='<pre id="seen">')
    assert 'data-ready="yes"' in text
    assert "data-refused" not in text
    assert "data-error" not in text
    assert re.search(r'<input id="time"[^>]*max="6"', text), "the slider ends where the motion does"
    assert "4.4 / 6.0 s" in text
    assert "penetration forearm_link" in text
    assert f"because {plan.report.notes[0]}" in text
    match = re.search(r'<pre id="seen">(.*?)</pre>', text, re.DOTALL)
    assert match
    measured = json.loads(match[1])
    assert measured["sun"]
    expected = place_joints(plan, moment)
    for name in ("wrist_3_joint", "base", "door.hinge", "door.knob"):
        placement = np.array(measured["seen"][name.removeprefix("door.")]).reshape(4, 4).T
        np.testing.assert_allclose(placement, expected[name], atol=1e-4)
    assert 0.1 < plan.trajectory.column("door.hinge")[-2] < HINGE


def open_at(page: Path, width: int, height: int, script: str = "") -> dict[str, Any]:
    """Return what a script finds in a page of a size [pixels], which may be that of a telephone.

    Chromium's own windows are at least 500 pixels wide, so the page is in a frame.
    """
    probe = f"""<script>
    const waiting = setInterval(async () => {{
      if (!document.documentElement.dataset.ready) return;
      clearInterval(waiting);
      const found = await (async () => {{ {script} }})();
      parent.postMessage(JSON.stringify(found), "*");
    }}, 20);
    </script></body>"""
    text = page.read_text(encoding="utf-8").replace("</body>", probe)
    own = page.with_name(f"probe-{width}.html")
    own.write_text(text, encoding="utf-8")
    outer = page.with_name(f"outer-{width}.html")
    outer.write_text(
        f"""<!doctype html><body style="margin:0">
        <iframe src="{own.name}#t=1" style="border:0;width:{width}px;height:{height}px"></iframe>
        <script>addEventListener("message", (event) => {{
          const shown = document.createElement("pre");
          shown.id = "found";
          shown.textContent = event.data;
          document.body.append(shown);
        }});</script>""",
        encoding="utf-8",
    )
    text = browser.read_document(outer, until='<pre id="found">')
    match = re.search(r'<pre id="found">(.*?)</pre>', text)
    assert match, text[-2000:]
    return dict(json.loads(html.unescape(match[1])))


LOOK = """
const box = (id) => document.getElementById(id).getBoundingClientRect();
const [bar, phase, about] = ["bar", "phase", "about"].map(box);
const panel = document.querySelector(".dg");
const camera = vkc.viewer.camera, heights = [];
vkc.viewer.scene.updateMatrixWorld(true);
vkc.viewer.scene_tree.find(["meshcat", "paths"]).object.traverse((part) => {
  const points = part.geometry && part.geometry.attributes.position;
  for (let k = 0; points && k < points.count; k++) {
    const point = part.position.clone().fromBufferAttribute(points, k);
    heights.push(part.localToWorld(point).project(camera).y);
  }
});
const isCut = (part) => part.scrollWidth > part.clientWidth;
const texts = [...document.querySelectorAll("#phase, #headline, #because, #note")];
return {
  cut: texts.filter(isCut).map((part) => part.id),
  width: innerWidth, phase: phase.width * phase.height, right: bar.right, lowest: bar.bottom,
  text: document.getElementById("phase").textContent, about: about.right,
  panel: panel ? getComputedStyle(panel).display : "none",
  filled: Math.max(...heights) - Math.min(...heights),
};
"""


@needs_chromium
@pytest.mark.browser
@pytest.mark.parametrize("size", [(390, 844), pytest.param((1280, 720), marks=pytest.mark.long)])
def test_page_fits_screens_of_telephones(page: Path, size: tuple[int, int]) -> None:
    found = open_at(page, *size, LOOK)
    assert found["width"] == size[0]
    assert found["text"] == "reach door.handle"
    assert found["phase"] > 500.0, "the name of the phase is visible"
    assert found["right"] <= size[0]
    assert found["lowest"] <= size[1]
    assert found["about"] <= size[0]
    assert found["panel"] == "none", "MeshCat's own controls are hidden"
    if size[0] < size[1]:
        assert found["filled"] > 0.7, "of 2: the paths extend along the height"


@pytest.mark.long
@needs_chromium
@pytest.mark.browser
@pytest.mark.parametrize("size", [(390, 844), pytest.param((1280, 720), marks=pytest.mark.long)])
def test_long_names_are_shown_whole(plan: Plan, tmp_path: Path, size: tuple[int, int]) -> None:
    """Those of phases have a line of their own on telephones; others are broken anywhere."""
    first, *others = plan.trajectory.phases
    name = "move door.hinge, door.knob, ünter"
    trajectory = dataclasses.replace(
        plan.trajectory, phases=(dataclasses.replace(first, name=name), *others)
    )
    scene = dataclasses.replace(plan.scene, name="living_room_" * 12)
    report = dataclasses.replace(plan.report, notes=("no_break_" * 20,))
    longer = dataclasses.replace(plan, scene=scene, trajectory=trajectory, report=report)
    found = open_at(visualization.to_html(longer, tmp_path / "long.html"), *size, LOOK)
    assert found["text"] == name
    assert found["cut"] == []
    assert found["about"] <= size[0]


@pytest.mark.long
@needs_chromium
@pytest.mark.browser
def test_short_motions_have_a_slider_and_a_clock(plan: Plan, tmp_path: Path) -> None:
    motion = plan.trajectory
    shorter = dataclasses.replace(motion, times=motion.times / 1000.0)
    page = visualization.to_html(
        dataclasses.replace(plan, trajectory=shorter), tmp_path / "short.html"
    )
    script = """const slider = document.getElementById("time");
    slider.value = 0.0043;
    slider.dispatchEvent(new Event("input"));
    return { time: vkc.time(), clock: document.getElementById("clock").textContent };"""
    found = open_at(page, 800, 600, script)
    assert found["time"] == pytest.approx(0.0043)
    assert found["clock"] == "0.004 / 0.006 s"


PLAY = """
// Frames of a slow machine, at these times in milliseconds, after which the speed changes.
const script = STEPS;
let frames = [];
const stamps = [];
window.requestAnimationFrame = (call) => { frames.push(call); return 0; };
while (frames.length < 2) {  // those of the page and of MeshCat, requested before
  await new Promise((resolve) => setTimeout(resolve, 20));
}
vkc.show(0);
vkc.play(true);
for (const [time, speed] of script) {
  const due = frames;
  frames = [];
  due.forEach((call) => call(10000 + time));
  stamps.push(vkc.time());
  if (speed === "hide") document.dispatchEvent(new Event("visibilitychange", { bubbles: true }));
  else if (speed === "again") { vkc.play(false); vkc.play(true); }
  else if (speed) document.getElementById("speed").value = speed;
}
return { stamps };
"""


@needs_chromium
@pytest.mark.browser
@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        pytest.param(
            [(700 * k, "") for k in range(5)], [0.0, 0.7, 1.4, 2.1, 2.8], marks=pytest.mark.long
        ),
        (
            [(0, "2"), (500, "0.25"), (900, "4"), (1000, "1"), (1100, "")],
            [0.0, 1.0, 1.1, 1.5, 1.6],
        ),
        # A hidden page gets no frames, and goes on where it was.
        pytest.param(
            [(0, ""), (500, "hide"), (90_000, ""), (90_400, "")],
            [0.0, 0.5, 0.5, 0.9],
            marks=pytest.mark.long,
        ),
        # The end is shown for 2 s, also after the motion was started again there.
        pytest.param(
            [(0, "4"), (1500, ""), (3400, "again"), (3500, ""), (5000, ""), (6900, ""), (7100, "")],
            [0.0, 6.0, 6.0, 0.0, 6.0, 6.0, 0.0],
            marks=pytest.mark.long,
        ),
    ],
)
def test_motions_are_played_in_real_time(
    page: Path, steps: list[tuple[int, str]], expected: list[float]
) -> None:
    """Slow frames do not slow the motion down."""
    stamps = open_at(page, 800, 600, PLAY.replace("STEPS", json.dumps(steps)))["stamps"]
    assert stamps == pytest.approx(expected)
