"""Tests that hostile xacro, MJCF and mesh files raise errors that name the file and the reason."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from vkc_pin.errors import InputError
from vkc_pin.importing import import_home, import_object, import_robot
from vkc_pin.importing.formats.mjcf_compiler import NO_MASS, compile_mjcf
from vkc_pin.importing.robots.sources import read_source
from vkc_pin.utils.isolation import TIME_VARIABLE
from vkc_pin.world.files.meshes import load_mesh, load_parts

XACRO = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{}<link name="a"/></robot>'
BOMB = "".join(
    f'<xacro:macro name="m{k}">{f"<xacro:m{k + 1}/>" * 10}</xacro:macro>' for k in range(9)
)
HOSTILE_XACRO = {
    "pipe": ('<xacro:include filename="pipe"/>', "in time"),
    "power": ('<xacro:property name="p" value="${10**10**8}"/><link name="${p}"/>', "in time"),
    "bomb": (f'{BOMB}<xacro:macro name="m9"><link/></xacro:macro><xacro:m0/>', "in time"),
    "list": ('<link name="${list(range(10**10))}"/>', "too much memory"),
    "circle": ('<xacro:include filename="robot.xacro"/>', "recursion"),
    "macro": ('<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>', "recursion"),
    "folder": ('<xacro:include filename="."/>', "directory"),
    "long": (f'<xacro:include filename="{"é" * 300}"/>', "cannot process the file"),
}
MJCF = '<mujoco>{}<worldbody><body name="b"><joint/><geom size="1"/>{}</body></worldbody></mujoco>'
GRID = '<flexcomp name="f" type="grid" count="900 900 900" spacing=".1 .1 .1" dim="3"/>'
COPIES = '<replicate count="1000" offset="1 0 0">'
HEIGHTS = '<hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1"/>'
ATTACH = '<attach model="m" body="b" prefix="p"/>'
HOSTILE_MJCF = {
    "pipe": ('<include file="pipe"/>', "", "in time"),
    "keys": ('<size nkey="1000000000"/>', "", "in time"),
    "copies": ("", f'{COPIES * 3}<geom size="1"/>{"</replicate>" * 3}', "in time"),
    "grid": ("", GRID, "in time"),
    "itself": ('<asset><model name="m" file="a.xml"/></asset>', ATTACH, "crashes"),
    "heights": (f"<asset>{HEIGHTS}</asset>", "", "cannot read"),
    "include": ('<include file="a.xml"/>', "", "cannot read"),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, which contains a pipe without a writer."""
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def limit_time(reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set a short time limit for files whose processing never ends."""
    monkeypatch.setenv(TIME_VARIABLE, "1" if reason == "in time" else "60")


@pytest.mark.parametrize("kind", HOSTILE_XACRO)
def test_hostile_xacro_is_rejected(
    folder: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("xacro")
    text, reason = HOSTILE_XACRO[kind]
    limit_time(reason, monkeypatch)
    (folder / "robot.xacro").write_text(XACRO.format(text), encoding="utf-8")
    with pytest.raises(InputError, match=rf"(?s)^robot.xacro: xacro .*{reason}"):
        import_robot("robot.xacro", "out")
    assert sorted(file.name for file in folder.iterdir()) == ["pipe", "robot.xacro"]


@pytest.mark.parametrize(
    ("kind", "import_file"),
    [
        *((kind, import_object) for kind in HOSTILE_MJCF),
        ("itself", import_robot),
        ("itself", import_home),
    ],
)
def test_hostile_mjcf_is_rejected(
    folder: Path, kind: str, import_file: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    before, inside, reason = HOSTILE_MJCF[kind]
    limit_time(reason, monkeypatch)
    (folder / "a.xml").write_text(MJCF.format(before, inside), encoding="utf-8")
    with pytest.raises(InputError, match=rf"^a.xml: MuJoCo .*{reason}"):
        import_file("a.xml", "out")
    assert sorted(file.name for file in folder.iterdir()) == ["a.xml", "pipe"]


def test_materials_and_textures_that_are_pipes_are_ignored(folder: Path) -> None:
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n"
    (folder / "a.obj").write_text(f"mtllib pipe\n{triangle}", encoding="utf-8")
    (folder / "b.obj").write_text(f"mtllib b.mtl\n{triangle}", encoding="utf-8")
    (folder / "b.mtl").write_text("newmtl m\nmap_Kd pipe\n", encoding="utf-8")
    for name in ("a.obj", "b.obj"):
        assert len(load_parts(folder / name)) == len(load_mesh(folder / name).faces) == 1
    buffers = '"buffers": [{"uri": "pipe", "byteLength": 9}]'
    (folder / "c.gltf").write_text(f'{{"asset": {{"version": "2.0"}}, {buffers}}}')
    with pytest.raises(InputError, match=r"c\.gltf: cannot read the mesh: .*regular file"):
        load_mesh(folder / "c.gltf")


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a.stl", bytes(80) + b"\xff\xff\xff\xff"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nend_header",
        ),
        ("a.off", b"OFF\n99999999999 1 0\n0 0 0\n"),
        ("a.obj", b"v 0 0 0\nf 1 2 999999999999\n"),
        ("a.dae", b"<COLLADA><library_geometries/></COLLADA>"),
        ("deep.dae", b"<COLLADA>" + b"<a>" * 10**6 + b"</a>" * 10**6 + b"</COLLADA>"),
        ("a.glb", b"glTF" + b"\xff" * 100),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_broken_meshes_are_rejected(folder: Path, name: str, data: bytes) -> None:
    (folder / name).write_bytes(data)
    problems = "read the mesh|mesh is empty|wrong number|no such vertex|elements inside each other"
    with pytest.raises(InputError, match=rf"{name}:.*({problems})"):
        load_mesh(folder / name)


@pytest.mark.long
def test_ctrl_c_ends_an_import(folder: Path) -> None:
    pytest.importorskip("mujoco")
    (folder / "a.xml").write_text(MJCF.format('<include file="pipe"/>', ""), encoding="utf-8")
    command = [sys.executable, "-m", "vkc_pin.cli", "import-object", "a.xml"]
    environment = {**os.environ, TIME_VARIABLE: "60"}
    process = subprocess.Popen(command, start_new_session=True, env=environment)
    time.sleep(3.0)
    os.killpg(process.pid, signal.SIGINT)  # as the terminal does
    # -SIGINT: on a slow machine, the signal arrives before the command handles it
    assert process.wait(timeout=10) in (130, -signal.SIGINT)
    assert sorted(file.name for file in folder.iterdir()) == ["a.xml", "pipe"]


@pytest.mark.parametrize(
    ("elements", "name", "expected"),
    [
        ("<!-- <xacro:m/> -->", "robot.urdf", False),
        ("", "robot.urdf.xacro", True),
        ('<xacro:property name="p" value="1"/>', "robot.urdf", True),
        ('<link name="${1}"/>', "robot.urdf", True),
        ('<link name="b"><note>$(arg n)</note></link>', "robot.urdf", True),
    ],
)
def test_only_xacro_elements_and_substitutions_need_xacro(
    elements: str, name: str, expected: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files written by xacro contain neither, but declare its namespace."""
    monkeypatch.setitem(sys.modules, "xacro", None)  # as if not installed
    (tmp_path / name).write_text(XACRO.format(elements))
    with pytest.raises(InputError) if expected else contextlib.nullcontext() as caught:
        read_source(tmp_path / name, tmp_path, packages={}, arguments={})
    assert not expected or "needs the Python package xacro" in str(caught.value)


mujoco = pytest.importorskip("mujoco")

DOOR = """<mujoco>{head}<worldbody><body name="case"><geom type="box" size=".2 .2 .2"/>
  <body name="door" pos="0 -.3 0"><joint name="hinge" axis="0 0 1" range="0 1"/>{inertial}
    <geom name="leaf" type="box" size=".2 .01 .2"{leaf}/>{more}</body></body>
  </worldbody>{tail}</mujoco>"""


def compile_door(folder: Path, **parts: str) -> tuple[object, str]:
    slots = dict.fromkeys(("head", "leaf", "more", "tail", "inertial"), "")
    (folder / "door.xml").write_text(DOOR.format(**{**slots, **parts}))
    model, notes = compile_mjcf(folder / "door.xml")
    return model, "; ".join(notes)


TEXTURE = '<asset><texture name="t" type="{}" {}/><material name="m" texture="t"/></asset>'
MESH = '<asset><mesh name="l" file="gone.obj"/></asset>'
MISSING = ("gone.obj", "there.stl", "lost.stl", f"{'é' * 300}.stl")  # all but one
VISUAL, MESH_GEOM = ' contype="0" conaffinity="0"', '<geom type="mesh" mesh="l"{}/>'


@pytest.mark.parametrize(
    ("parts", "note"),
    [
        ({"head": TEXTURE.format("2d", 'file="a/wood.png"'), "leaf": ' material="m"'}, "wood.png"),
        ({"head": TEXTURE.format("cube", 'fileright="r.png"'), "leaf": ' material="m"'}, "r.png"),
        ({"head": TEXTURE.format("skybox", 'file="sky.png"')}, "sky.png"),
        ({"head": MESH, "more": MESH_GEOM.format(VISUAL)}, "'gone.obj' of body 'door'"),
        ({"head": MESH, "more": MESH_GEOM.format(""), "leaf": VISUAL}, "visual shapes collide"),
        ({"head": MESH}, ""),
        *(
            ({"head": head}, "settings of MuJoCo 2")
            for head in (
                '<option apirate="100"/>',
                '<visual><map old="1"/></visual>',
                '<compiler convexhull="true"/>',
                '<compiler exactmeshinertia="true"/>',
            )
        ),
        ({"head": '<default class="old"/>', "leaf": ' class="old"'}, "settings of MuJoCo 2"),
        *(
            (
                {
                    "inertial": f'<inertial pos="0 0 0" mass="3" {turn} '
                    'fullinertia="0.1 0.1 0.05 0 0 0"/>'
                },
                "settings of MuJoCo 2",
            )
            for turn in (
                'quat="1 0 0 0"',
                'euler="0 0 1"',
                'axisangle="0 0 1 1"',
                'xyaxes="1 0 0 0 1 0"',
                'zaxis="0 0 1"',
            )
        ),
        ({"tail": '<keyframe><key qpos="0 0 0"/></keyframe>'}, "invalid qpos size"),
        ({"tail": '<sensor><touch site="none"/></sensor>'}, "unrecognized name 'none'"),
        ({"tail": '<actuator><motor joint="none"/></actuator>'}, "actuator"),
        (
            {"inertial": '<inertial pos="0 0 0" mass="1" diaginertia="1 1 5"/>'},
            "inertia must satisfy",
        ),
    ],
)
def test_errors_outside_the_geometry_are_noted(
    tmp_path: Path, parts: dict[str, str], note: str
) -> None:
    model, notes = compile_door(tmp_path, **parts)
    assert model.ngeom == 2
    assert model.geom_contype.all()
    assert model.njnt == 1
    assert note in notes


@pytest.mark.parametrize(
    ("head", "leaf"),
    [
        ('<compiler inertiagrouprange="4 4"/>', ' group="0"'),
        ("", ' mass="0"'),
        ("", ' density="0"'),
        ('<compiler inertiafromgeom="false"/>', ""),
        ('<compiler inertiafromgeom="true" inertiagrouprange="3 3"/>', ""),
    ],
)
def test_masses_may_be_missing(tmp_path: Path, head: str, leaf: str) -> None:
    model, _ = compile_door(tmp_path, head=head, leaf=leaf)
    assert model.body_mass[2] <= NO_MASS


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {
                "head": "".join(f'<asset><mesh file="{name}"/></asset>' for name in MISSING),
                "more": "".join(
                    f'<geom type="mesh" mesh="{Path(name).stem}"/>' for name in MISSING
                ),
            },
            r"got no gone\.obj, lost\.stl, é",
        ),
        ({"more": '<geom type="sphere" size="0"/>'}, "cannot read the file: .*size 0 must be"),
        *(
            ({"head": f'<default class="old"/><include file="{name}.xml"/>'}, "cannot read")
            for name in ("door", "none")  # of files for MuJoCo 2
        ),
    ],
)
def test_errors_in_the_geometry_and_in_includes_are_raised(
    tmp_path: Path, parts: dict[str, str], message: str
) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "there.stl")
    with pytest.raises(InputError, match=message):
        compile_door(tmp_path, **parts)


@pytest.mark.parametrize(
    "turn",
    [
        'quat="0.7071068 0 0.7071068 0"',
        'quat="0.1 -0.5 0.7 0.5"',
        'euler="20 -40 75"',
        'axisangle="1 2 3 50"',
        'xyaxes="0 1 0 -1 0 0"',
        'zaxis="1 1 0"',
    ],
)
@pytest.mark.parametrize("products", ["0 0 0", "0.03 -0.02 0.01", "-0.05 0 0"])
def test_full_inertias_beside_any_orientation_are_those_of_mujoco_without_it(
    tmp_path: Path, turn: str, products: str
) -> None:
    mujoco = pytest.importorskip("mujoco")
    frame = '<body name="frame" pos="1 2 3" euler="10 20 30"><geom size=".1" mass="2"/>{}</body>'
    leaf = (
        '<body name="leaf" pos=".5 0 0"><joint name="hinge"/><geom size=".2"/><inertial '
        f'pos=".1 -.2 .3" mass="3" {{}} fullinertia="0.11 0.2 0.25 {products}"/></body>'
    )
    text = f"<mujoco><worldbody>{frame.format(leaf)}</worldbody></mujoco>"
    expected = mujoco.MjModel.from_xml_string(text.format(""))
    with pytest.raises(ValueError, match="fullinertia"):
        mujoco.MjModel.from_xml_string(text.format(turn))
    (tmp_path / "leaf.xml").write_text(text.format(turn))
    found, notes = compile_mjcf(tmp_path / "leaf.xml")
    assert "settings of MuJoCo 2" in " ".join(notes)
    np.testing.assert_allclose(found.body_mass, expected.body_mass)
    np.testing.assert_allclose(found.body_ipos, expected.body_ipos)
    for body in range(found.nbody):
        turned, plain = (
            compute_tensor(model.body_iquat[body], model.body_inertia[body])
            for model in (found, expected)
        )
        np.testing.assert_allclose(turned, plain, atol=1e-12)
    xx, yy, zz = 0.11, 0.2, 0.25
    xy, xz, yz = map(float, products.split())
    stated = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    np.testing.assert_allclose(turned, stated, atol=1e-9)


def compute_tensor(quaternion: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Return the inertia of a body about its centre of mass in its own axes [kg m²]."""
    w, x, y, z = quaternion
    axes = pin.Quaternion(w, x, y, z).matrix()
    return axes @ np.diag(moments) @ axes.T


def test_full_inertias_keep_their_axes_beside_an_orientation(tmp_path: Path) -> None:
    """MuJoCo 2 took the axes from the matrix, whatever else was stated."""
    inertial = '<inertial pos="0 0 0" mass="3" {} fullinertia="0.1 0.2 0.25 0 0 0"/>'
    plain, notes = compile_door(tmp_path, inertial=inertial.format(""))
    assert not notes
    turned, _ = compile_door(tmp_path, inertial=inertial.format('quat="0.6 0.8 0 0"'))
    np.testing.assert_allclose(turned.body_inertia, plain.body_inertia)
    np.testing.assert_allclose(turned.body_iquat, plain.body_iquat)


def test_a_file_for_mujoco_2_is_read_with_its_includes(tmp_path: Path) -> None:
    """Furniture of furniture_sim has classes at the top level; MuJoCo 3 takes one there."""
    (tmp_path / "parts" / "deep").mkdir(parents=True)
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "parts" / "box.stl")
    (tmp_path / "parts" / "door.xml").write_text(
        """<mujocoinclude><compiler angle="degree"/><asset><mesh name="box" file="parts/box.stl"/>
        </asset><include file="parts/deep/classes.xml"/></mujocoinclude>"""
    )
    (tmp_path / "parts" / "deep" / "classes.xml").write_text(
        """<mujocoinclude><default class="a"><geom type="mesh" mesh="box"/></default>
        <default class="b"><geom type="sphere" size=".3"/></default></mujocoinclude>"""
    )
    more = '<geom class="a"/><geom class="b"/>'
    include = '<include file="parts\\door.xml"/>'
    model, note = compile_door(tmp_path, head=include, more=more)
    assert "settings of MuJoCo 2" in note
    assert model.ngeom == 4
    assert sorted(model.geom_aabb[2, 3:]) == pytest.approx([0.05, 0.1, 0.15], abs=1e-6)
    assert model.geom_size[3, 0] == pytest.approx(0.3)
    assert model.jnt_range[0, 1] == pytest.approx(math.radians(1.0))
