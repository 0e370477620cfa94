from __future__ import annotations

import math
from pathlib import Path

import pytest
import trimesh

from vkc_pin.errors import InputError
from vkc_pin.importing.parsers import NO_MASS, compile_mjcf

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
VISUAL, MESH_GEOM = ' contype="0" conaffinity="0"', '<geom type="mesh" mesh="l"{}/>'


@pytest.mark.parametrize(
    ("parts", "note", "count"),
    [
        (
            {"head": TEXTURE.format("2d", 'file="a/wood.png"'), "leaf": ' material="m"'},
            "wood.png",
            2,
        ),
        (
            {"head": TEXTURE.format("cube", 'fileright="r.png"'), "leaf": ' material="m"'},
            "r.png",
            2,
        ),
        ({"head": TEXTURE.format("skybox", 'file="sky.png"')}, "sky.png", 2),
        ({"head": MESH, "more": MESH_GEOM.format(VISUAL)}, "'gone.obj' of body 'door'", 2),
        ({"head": MESH, "more": MESH_GEOM.format(""), "leaf": VISUAL}, "visual shapes collide", 2),
        ({"head": MESH}, "", 2),
        ({"head": '<option apirate="100"/>'}, "settings of MuJoCo 2", 2),
        ({"head": '<visual><map old="1"/></visual>'}, "settings of MuJoCo 2", 2),
        ({"head": '<compiler convexhull="true"/>'}, "settings of MuJoCo 2", 2),
        ({"head": '<compiler exactmeshinertia="true"/>'}, "settings of MuJoCo 2", 2),
        ({"head": '<default class="old"/>', "leaf": ' class="old"'}, "settings of MuJoCo 2", 2),
        ({"tail": '<keyframe><key qpos="0 0 0"/></keyframe>'}, "invalid qpos size", 2),
        ({"tail": '<sensor><touch site="none"/></sensor>'}, "unrecognized name 'none'", 2),
        ({"tail": '<actuator><motor joint="none"/></actuator>'}, "actuator", 2),
        (
            {"inertial": '<inertial pos="0 0 0" mass="1" diaginertia="1 1 5"/>'},
            "inertia must satisfy",
            2,
        ),
    ],
)
def test_errors_outside_the_geometry_are_noted(
    tmp_path: Path, parts: dict[str, str], note: str, count: int
) -> None:
    model, notes = compile_door(tmp_path, **parts)
    assert model.ngeom == count
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


def test_all_missing_collision_meshes_are_listed(tmp_path: Path) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "there.stl")
    names = ("gone.obj", "there.stl", "lost.stl", f"{'é' * 300}.stl")
    head = "".join(f'<mesh name="{name}" file="{name}"/>' for name in names)
    more = "".join(f'<geom type="mesh" mesh="{name}"/>' for name in names)
    with pytest.raises(InputError, match=r"got no gone\.obj, lost\.stl, é"):
        compile_door(tmp_path, head=f"<asset>{head}</asset>", more=more)


def test_errors_in_the_geometry_are_raised(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"MuJoCo cannot read the file: .*size 0 must be"):
        compile_door(tmp_path, more='<geom type="sphere" size="0"/>')


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


@pytest.mark.parametrize("included", ['<include file="door.xml"/>', '<include file="none.xml"/>'])
def test_invalid_includes_of_a_file_for_mujoco_2_raise(tmp_path: Path, included: str) -> None:
    with pytest.raises(InputError, match="MuJoCo cannot read the file"):
        compile_door(tmp_path, head=f'<default class="old"/>{included}')
