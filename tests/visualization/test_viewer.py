from __future__ import annotations

import html
import json
import re
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers import browser
from helpers.fake_plan import HINGE, fake_plan
from helpers.pages import clips, commands_of

from vkc_pin.errors import InputError
from vkc_pin.planning.plan import Plan
from vkc_pin.visualization import viewer as visualization
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.trajectory.world_model import World

needs_chromium = pytest.mark.skipif(browser.CHROMIUM is None, reason="Chromium is not installed")


@pytest.fixture(scope="module")
def plan() -> Plan:
    return fake_plan()


@pytest.fixture(scope="module")
def page(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return visualization.to_html(plan, tmp_path_factory.mktemp("page") / "door.html")


@pytest.fixture(scope="module")
def commands(page: Path) -> list[dict[str, Any]]:
    return commands_of(page.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def shots(page: Path) -> dict[float, np.ndarray]:
    return {moment: picture(page, moment) for moment in (0.0, 3.0, 6.0)}


def picture(page: Path, moment: float) -> np.ndarray:
    from PIL import Image

    for budget in (
        6.0,
        20.0,
    ):  # see browser.document: on a busy machine the first may end before anything is drawn
        file = browser.screenshot(
            page, page.with_name(f"{moment}.png"), time=moment, size=(800, 500), budget=budget
        )
        pixels = np.asarray(Image.open(file).convert("RGB"), int)
        if len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100:
            break
    return pixels


def drawn(commands: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {c["path"]: c["object"] for c in commands if c["type"] == "set_object"}


def vertices(item: dict[str, Any]) -> np.ndarray:
    extension = item["geometries"][0]["data"]["attributes"]["position"]["array"]
    return np.frombuffer(extension.data, np.float32).reshape(-1, 3)


# What is drawn


def test_page_has_robot_door_walls_paths_and_ghosts(commands: list[dict[str, Any]]) -> None:
    things = drawn(commands)
    robot, door = (
        ("forearm_link", "gripper_link", "base_link"),
        ("door/frame", "hinge/panel", "knob/lever"),
    )
    for part in (*robot, *door, "wall_west", "sofa", "floor", "grid"):
        assert any(part in path for path in things), part
    for path in (
        "paths/tool",
        "paths/base",
        "ghosts/start/robot",
        "ghosts/end/robot",
        "ghosts/start/door",
        "ghosts/end/door",
    ):
        assert f"/meshcat/{path}" in things
    arm = [vertices(item) for path, item in things.items() if "forearm_link" in path]
    assert sum(len(points) for points in arm) > 3000, "the arm's real meshes"


def test_robot_is_drawn_in_several_colours(commands: list[dict[str, Any]]) -> None:
    things = drawn(commands)
    assert (
        len(
            {
                item["materials"][0]["color"]
                for path, item in things.items()
                if path.startswith("/meshcat/robot/")
            }
        )
        >= 5
    )


def test_walls_let_one_look_in(commands: list[dict[str, Any]]) -> None:
    things = drawn(commands)
    for name in ("wall_west", "wall_south"):
        outside = things[f"/meshcat/room/walls/{name}/outside"]["materials"][0]
        assert outside["transparent"]
        assert outside["opacity"] < 0.2
        assert things[f"/meshcat/room/walls/{name}/inside"]["materials"][0]["side"] == 0, (
            "seen from the room only"
        )
    assert things["/meshcat/room/walls/wall_left_of_door/sides"]["materials"][0]["opacity"] < 0.5, (
        "stands between two rooms"
    )


def test_ghosts_stand_where_the_motion_starts_and_ends(
    commands: list[dict[str, Any]], plan: Plan
) -> None:
    things = drawn(commands)
    for name, row in (("start", 0), ("end", -1)):
        middle = vertices(things[f"/meshcat/ghosts/{name}/robot"]).mean(axis=0)
        assert np.linalg.norm(middle[:2] - plan.trajectory.positions[row, :2]) < 0.7, "arm and base"
    assert vertices(things["/meshcat/ghosts/start/door"])[:, 0].max() < 2.7
    assert vertices(things["/meshcat/ghosts/end/door"])[:, 0].max() > 3.2


def test_a_scene_alone_is_drawn_without_motion(tmp_path: Path) -> None:
    file = visualization.to_html(load_scene("drawer"), tmp_path / "deep" / "drawer.html")
    commands = commands_of(file.read_text(encoding="utf-8"))
    assert not clips(commands)
    assert any("drawer" in path for path in drawn(commands))
    assert not any("ghosts" in path or "paths" in path for path in drawn(commands))


def test_names_that_look_alike_are_drawn_apart(tmp_path: Path) -> None:
    """Two links of an object, each on a joint of its own, and two fixed ones."""
    sizes = {"a+b": 0.1, "a b": 0.2, "c+d": 0.3, "c d": 0.4}
    kinds = {"a+b": "prismatic", "a b": "prismatic", "c+d": "fixed", "c d": "fixed"}
    limit = '<axis xyz="1 0 0"/><limit lower="0" upper="1" velocity="1" effort="1"/>'
    shape = '<geometry><box size="{0} {0} {0}"/></geometry>'
    text = '<robot name="o"><link name="case"/>' + "".join(
        f'<link name="{name}"><collision>{shape.format(size)}</collision>'
        f"<visual>{shape.format(size)}</visual></link>"
        f'<joint name="{name}" type="{kinds[name]}"><parent link="case"/><child link="{name}"/>'
        f'<origin xyz="0 0 {10 * size}"/>{limit}</joint>'
        for name, size in sizes.items()
    )
    kind = {"urdf": f"{text}</robot>", "attachments": []}
    document = {
        "robot": "husky_ur5e",
        "start": {"base": [-3, -3, 0]},
        "objects": [{"name": "it", "type": kind, "position": [0, 0, 0]}],
    }
    frames = {"x+y": pin.SE3.Identity(), "x y": pin.SE3(np.eye(3), np.ones(3))}
    file = visualization.to_html(Scene.from_document(document), tmp_path / "it.html", frames=frames)
    commands = commands_of(file.read_text(encoding="utf-8"))
    boxes = {path: item for path, item in drawn(commands).items() if "/objects/it/" in path}
    extents = sorted(np.ptp(vertices(item), axis=0)[0] for item in boxes.values())
    assert extents == pytest.approx(sorted(sizes.values()), abs=1e-3)
    places = {c["path"]: c["matrix"][14] for c in commands if c["type"] == "set_transform"}
    heights = [
        sum(height for above, height in places.items() if f"{path}/".startswith(f"{above}/"))
        for path in boxes
    ]
    floor = places["/meshcat"]
    assert sorted(heights) == pytest.approx([10 * size + floor for size in sizes.values()])
    assert len([path for path in places if path.startswith("/meshcat/frames/")]) == 2


# Time


def test_frames_are_drawn_where_they_are(tmp_path: Path) -> None:
    placement = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.4, 2.0), np.array([1.0, -0.5, 0.8]))
    file = visualization.to_html(
        load_scene("door"), tmp_path / "frames.html", frames={"door.hinge": placement}
    )
    commands = commands_of(file.read_text(encoding="utf-8"))
    things = {
        path: item for path, item in drawn(commands).items() if path.startswith("/meshcat/frames/")
    }
    assert set(things) == {f"/meshcat/frames/door.hinge/{axis}" for axis in "xyz"}
    for axis, item in things.items():
        column = "xyz".index(axis[-1])
        low, high = vertices(item).min(axis=0), vertices(item).max(axis=0)
        assert high[column] > 0.1  # along its axis, and thin across it
        assert np.delete(high - low, column).max() < 0.02
        red, green, blue = (item["materials"][0]["color"] >> shift & 255 for shift in (16, 8, 0))
        assert int(np.argmax([red, green, blue])) == column
        assert item["materials"][0]["depthTest"] is False
    (stands,) = (
        c["matrix"]
        for c in commands
        if c["type"] == "set_transform" and c["path"] == "/meshcat/frames/door.hinge"
    )
    assert np.allclose(np.reshape(stands, (4, 4)).T, placement.homogeneous)


def test_animation_takes_as_long_as_the_motion(commands: list[dict[str, Any]], plan: Plan) -> None:
    for path, clip in clips(commands).items():
        assert clip["fps"] == 1, "so that key times are seconds"
        for track in clip["tracks"]:
            times = [key["time"] for key in track["keys"]]
            assert times[0] == 0.0
            assert times[-1] == pytest.approx(plan.trajectory.times[-1]), path
            assert (np.diff(times) > 0).all()


def test_interpolated_frames_are_the_motion_itself(
    commands: list[dict[str, Any]], plan: Plan
) -> None:
    """Joint by joint as three.js does it: positions linear, quaternions along the great circle."""
    world = World(plan.scene)
    data = world.model.createData()
    moving, still = (
        clips(commands),
        {c["path"]: c["matrix"] for c in commands if c["type"] == "set_transform"},
    )
    shift = pin.SE3(np.array(still["/meshcat"]).reshape(4, 4).T)
    for moment in (0.0, 0.33, 2.9, 3.05, 4.4, 5.9, 6.0):
        (row,) = world.compute_positions(plan.trajectory, [moment])
        pin.framesForwardKinematics(world.model, data, world.coordinates.q(row))
        for path in (
            p
            for p in moving
            if p.startswith(("/meshcat/robot/", "/meshcat/objects/")) and "<object>" not in p
        ):
            nodes = path.split("/")
            placement = pin.SE3.Identity()
            for depth in range(2, len(nodes) + 1):
                placement = placement * local_placement(
                    "/".join(nodes[:depth]), moment, moving, still
                )
            name = nodes[-1] if nodes[2] == "robot" else f"{nodes[3]}.{nodes[-1]}"
            expected = shift * data.oMi[world.model.getJointId(name)]
            assert np.allclose(placement.homogeneous, expected.homogeneous, atol=1e-5), (
                name,
                moment,
            )


def local_placement(
    path: str, moment: float, moving: dict[str, Any], still: dict[str, Any]
) -> pin.SE3:
    placement = pin.SE3(np.array(still.get(path, np.eye(4).ravel())).reshape(4, 4).T)
    for track in moving.get(path, {"tracks": []})["tracks"]:
        times = np.array([key["time"] for key in track["keys"]])
        values = np.array([key["value"] for key in track["keys"]])
        i = int(np.clip(np.searchsorted(times, moment, side="right") - 1, 0, len(times) - 2))
        part = (moment - times[i]) / (times[i + 1] - times[i])
        if track["name"] == ".position":
            placement.translation = (1 - part) * values[i] + part * values[i + 1]
        elif track["name"] == ".quaternion":
            placement.rotation = (
                pin.Quaternion(values[i]).slerp(part, pin.Quaternion(values[i + 1])).matrix()
            )
    return placement


def test_ghosts_hide_while_the_real_thing_is_there(commands: list[dict[str, Any]]) -> None:
    for name, first, last in (("start", False, True), ("end", True, False)):
        for owner in ("robot", "door"):
            (track,) = clips(commands)[f"/meshcat/ghosts/{name}/{owner}"]["tracks"]
            values = [key["value"] for key in track["keys"]]
            assert (values[0], values[-1]) == (first, last)


def test_offending_links_turn_red_at_that_time(commands: list[dict[str, Any]]) -> None:
    red = {
        path: clip["tracks"][0]
        for path, clip in clips(commands).items()
        if clip["tracks"][0]["type"] == "color"
    }
    assert red
    assert all("forearm_link" in path for path in red)
    for track in red.values():
        alarms = [
            key["time"] for key in track["keys"] if key["value"][0] > 0.85 and key["value"][1] < 0.1
        ]
        assert alarms
        assert all(abs(moment - 4.0) < 0.5 for moment in alarms)


# The page


def test_page_is_one_file_that_loads_nothing(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert page.stat().st_size < 5e6
    assert "default-src 'none'" in text, "the browser itself refuses every load"
    own = re.sub(r'<script type="application/[^>]*>[^<]*</script>', "", text)
    assert not re.search(r"https?://|<link|<img|<iframe|\bsrc=|@import|url\(", own)
    assert [file.name for file in page.parent.glob("*.html")] == ["door.html"]


def test_page_says_what_the_motion_is(page: Path, plan: Plan) -> None:
    match = re.search(r'id="film">(.*?)</script>', page.read_text(encoding="utf-8"))
    assert match
    film = json.loads(match[1])
    assert film["duration"] == pytest.approx(plan.trajectory.times[-1])
    assert [phase["name"] for phase in film["phases"]] == ["reach door.handle", "move door.hinge"]
    assert film["notes"][0]["text"] == "penetration: forearm_link – sofa"
    assert "rejected" in film["headline"]


def test_page_is_written_whole_or_not_at_all(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "door.html"
    target.write_text("before")
    monkeypatch.setattr("vkc_pin.visualization.viewer._packed", lambda data: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        visualization.to_html(plan, target)
    assert [file.name for file in tmp_path.iterdir()] == ["door.html"]
    assert target.read_text() == "before"


def test_names_cannot_break_out_of_the_page() -> None:
    from vkc_pin.visualization.viewer import Recorder, render_page

    text = render_page(Recorder(), title="<b>%FILM%", film={"headline": "</script><b>"})
    assert "<b>" not in text
    assert "<title>&lt;b&gt;%FILM%</title>" in text


def test_what_cannot_be_shown(plan: Plan, tmp_path: Path) -> None:
    for call in (
        lambda: visualization.show("door"),
        lambda: visualization.to_html(None, tmp_path / "x.html"),
    ):  # type: ignore[arg-type]
        with pytest.raises(InputError, match="Plan or a Scene"):
            call()
    with pytest.raises(InputError, match="Plan"):
        visualization.animate(plan.scene)  # type: ignore[arg-type]


# Notebook and server


def test_in_a_notebook_the_view_is_part_of_it(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visualization, "in_notebook", lambda: True)
    cell = visualization.show(plan, height=300)._repr_html_()
    match = re.fullmatch(
        r'<div><iframe srcdoc="([^"]*)" style="[^"]*height: 300px[^"]*" title="door"></iframe></div>',
        cell,
    )
    assert match
    assert len(drawn(commands_of(html.unescape(match[1])))) > 50


@pytest.fixture(scope="module")
def viewer(plan: Plan) -> Iterator[Any]:
    yield visualization.show(plan, open_browser=False)
    process = visualization._server
    assert process is not None
    process[0].kill()


def listening(port: int) -> set[str]:
    """Return the local addresses, as hexadecimal numbers, at which somebody listens on `port`."""
    lines = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    return {
        where
        for where, at in (line[1].split(":") for line in lines if line[3] == "0A")
        if int(at, 16) == port
    }


@pytest.mark.skipif(not Path("/proc/net/tcp").is_file(), reason="needs /proc")
def test_server_listens_on_loopback_only(viewer: Any) -> None:
    assert visualization._server is not None
    for address in visualization._server[1:]:
        port = int(re.findall(r":(\d+)", address)[0])
        assert listening(port) == {"0100007F"}, address


def answer(
    port: int, host: str | None, *more: str, path: str = "/static/", version: str = "1.1"
) -> int:
    """Return the status that the server answers a request with."""
    lines = [
        f"GET {path} HTTP/{version}",
        *([] if host is None else [f"Host: {host}"]),
        "Connection: close",
        *more,
        "",
        "",
    ]
    if more:
        lines.remove("Connection: close")
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall("\r\n".join(lines).encode())
        return int(connection.makefile("rb").readline().split()[1])


def test_server_is_for_this_machine_only_by_whatever_name_it_is_asked(viewer: Any) -> None:
    """A page elsewhere may call this machine by a name of its own."""
    assert visualization._server is not None
    port = int(visualization._server[2].split(":")[2].split("/")[0])
    for host in ("localhost", "LOCALHOST", "127.0.0.1", "[::1]"):
        assert (answer(port, f"{host}:{port}"), answer(port, host)) == (200, 200), host
    upgrade = (
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    )
    assert answer(port, f"localhost:{port}", *upgrade, path="/") == 101
    assert (
        answer(port, f"localhost:{port}", *upgrade, f"Origin: http://localhost:{port}", path="/")
        == 101
    )
    for origin in (
        "http://evil.example",
        f"http://evil.example:{port}",
        "http://localhost:1",
        "null",
    ):
        assert answer(port, f"localhost:{port}", *upgrade, f"Origin: {origin}", path="/") == 403, (
            origin
        )
    for host in (
        "evil.example",
        f"evil.example:{port}",
        "localhost.evil.example",
        "127.0.0.1.evil.example",
        "0.0.0.0",
        "127.0.0.1@evil",
    ):
        assert answer(port, host) in (400, 403), host
        assert answer(port, host, *upgrade, f"Origin: http://{host}", path="/") in (400, 403), host
    assert answer(port, None, version="1.0") == 403


def test_server_serves_the_motion(viewer: Any, plan: Plan) -> None:
    with urllib.request.urlopen(viewer.url(), timeout=10) as answer:
        assert b"meshcat-pane" in answer.read()
    scene = viewer.static_html()
    assert len(scene) > 1e6
    assert visualization.animate(plan).url() == viewer.url(), "one window for a process"


def test_animate_into_a_viewer_of_ones_own(plan: Plan) -> None:
    import meshcat

    from vkc_pin.visualization.viewer import Recorder

    recorder = Recorder()
    mine = meshcat.Visualizer(window=recorder)["mine"]
    assert visualization.animate(plan, mine) is mine
    assert "/meshcat/mine/paths/tool" in drawn(recorder.commands)
    assert all(path.startswith("/meshcat/mine/") for path in clips(recorder.commands))


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


# A real browser


@needs_chromium
@pytest.mark.browser
def test_picture_is_not_empty_and_changes_over_time(shots: dict[float, np.ndarray]) -> None:
    for shot in shots.values():
        inner = shot[80:-60]
        assert len(np.unique(inner.reshape(-1, 3), axis=0)) > 2000
        assert inner.std() > 20
    for before, after in ((0.0, 3.0), (3.0, 6.0)):
        changed = (np.abs(shots[before] - shots[after]).max(axis=2) > 25)[80:-60]
        assert 0.005 < changed.mean() < 0.5, "the robot has moved, the room has not"


@needs_chromium
@pytest.mark.browser
def test_browser_shows_each_thing_where_it_is_at_that_time(page: Path, plan: Plan) -> None:
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
    addEventListener("securitypolicyviolation", (event) => { document.body.dataset.refused = event.blockedURI; });
    addEventListener("error", (event) => { document.body.dataset.error = event.message; });
    </script></body>"""
    probed = page.with_name("probed.htm")
    probed.write_text(page.read_text(encoding="utf-8").replace("</body>", probe), encoding="utf-8")
    moment = 4.4
    text = browser.document(probed, time=moment, until='<pre id="seen">')
    assert 'data-ready="yes"' in text
    assert "data-refused" not in text
    assert "data-error" not in text
    assert re.search(r'<input id="time"[^>]*max="6"', text), "the slider ends where the motion does"
    assert "4.4 / 6.0 s" in text
    assert "penetration: forearm_link" in text
    match = re.search(r'<pre id="seen">(.*?)</pre>', text, re.DOTALL)
    assert match
    told = json.loads(match[1])
    assert told["sun"]
    world = World(plan.scene)
    data = world.model.createData()
    (row,) = world.compute_positions(plan.trajectory, [moment])
    pin.forwardKinematics(world.model, data, world.coordinates.q(row))
    for name, joint in (
        ("wrist_3_joint", "wrist_3_joint"),
        ("base", "base"),
        ("hinge", "door.hinge"),
        ("knob", "door.knob"),
    ):
        seen = np.array(told["seen"][name]).reshape(4, 4).T
        assert np.allclose(seen, data.oMi[world.model.getJointId(joint)].homogeneous, atol=1e-4), (
            name
        )
    assert 0.1 < row[world.coordinates.index("door.hinge")] < HINGE


@needs_chromium
@pytest.mark.browser
def test_page_plays_by_itself_and_in_time(page: Path) -> None:
    probe = """
    <script>
    let first = null;
    const watch = (stamp) => {
      const at = window.vkc ? vkc.time() : 0;
      if (first === null && at > 0) first = [stamp, at];
      if (first !== null && at > first[1] + 1) {
        const panel = document.createElement("pre");
        panel.id = "pace";
        panel.textContent = JSON.stringify([stamp - first[0], at - first[1]]);
        document.body.appendChild(panel);
      } else requestAnimationFrame(watch);
    };
    requestAnimationFrame(watch);
    </script></body>"""
    probed = page.with_name("paced.htm")
    probed.write_text(page.read_text(encoding="utf-8").replace("</body>", probe), encoding="utf-8")
    match = re.search(r'<pre id="pace">(.*?)</pre>', browser.document(probed, until='id="pace"'))
    assert match, "the film runs"
    passed, played = json.loads(match[1])
    assert 0.0 < played <= 1.05e-3 * passed, "at most as fast as the browser's clock"
