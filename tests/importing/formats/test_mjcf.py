from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.partnet import MJCF

from vkc_pin.errors import InputError
from vkc_pin.importing.objects.object_reading import read_object

mujoco = pytest.importorskip("mujoco")


def test_bodies_joints_and_shapes_are_read(tmp_path: Path) -> None:
    attributes = 'name="hinge" damping="0.4" frictionloss="0.2"'
    (tmp_path / "t.xml").write_text(MJCF.replace('name="hinge"', attributes))
    found = read_object(tmp_path / "t.xml")
    assert list(found.links) == ["world", "case", "door"]
    hinge = found.joints["door"]
    assert (hinge.name, hinge.kind, hinge.limits) == ("hinge", "revolute", (-1.5, 0.0))
    assert np.allclose(hinge.axis, [0.0, 0.0, -1.0])
    assert (hinge.damping, hinge.friction) == (0.4, 0.2)
    place = found.compute_placements()["door"]
    assert np.allclose(place.translation, [0.75, -0.3, 0.4])
    door = found.links["door"]
    shapes = [(part.name, part.kind) for part in door.collision]
    assert shapes == [("leaf", "box"), ("handle", "capsule")]
    assert door.collision[1].size == pytest.approx((0.01, 0.3))
    assert [part.name for part in door.visual] == ["leaf", "handle", "looks"]
    looks = door.visual[2].make_mesh()  # MuJoCo moves meshes to their principal axes
    assert np.allclose(looks.bounds, [[-0.02, 0.1, 0.0], [0.08, 0.2, 0.1]], atol=1e-6)
    notes = " ".join(found.notes)
    assert "'cup' is free" in notes
    assert "'floor'" in notes
    with_free = read_object(tmp_path / "t.xml", free=True)
    cup = with_free.joints["cup"]
    assert (cup.kind, cup.parent) == ("floating", "world")
    assert cup.placement.translation == pytest.approx([2.0, 0.0, 0.0])
    assert [part.kind for part in with_free.links["cup"].collision] == ["sphere"]
    assert "'cup'" not in " ".join(with_free.notes)


def test_inertia_agrees_with_mujoco(tmp_path: Path) -> None:
    """MuJoCo infers masses from the geoms."""
    (tmp_path / "t.xml").write_text(MJCF)
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = read_object(tmp_path / "t.xml", free=True)
    for name, place in found.compute_placements().items():
        body = model.body(name).id
        inertia = place.act(found.links[name].inertia)
        assert inertia.mass == pytest.approx(model.body_mass[body])
        if inertia.mass > 0.0:
            assert np.allclose(inertia.lever, data.xipos[body])
            axes = data.ximat[body].reshape(3, 3)
            assert np.allclose(inertia.inertia, axes @ np.diag(model.body_inertia[body]) @ axes.T)
    assert found.links["door"].inertia.mass > 0.0


def test_unnamed_bodies_and_second_joints_get_unique_names(tmp_path: Path) -> None:
    (tmp_path / "t.xml").write_text(
        """<mujoco><worldbody><body name="case"><geom size="0.1"/>
        <body name="a"><geom size="0.2"/>
          <joint name="x" range="-1 1"/><joint name="y" axis="0 1 0" range="-1 1"/></body>
        <body name="a_0"><joint name="z" range="-1 1"/><geom size="0.3"/></body>
        <body><geom size="0.4"/></body></body></worldbody></mujoco>"""
    )
    found = read_object(tmp_path / "t.xml")
    assert list(found.links) == ["world", "case", "a_0_", "a", "a_0", "body_4"]
    assert (found.joints["a"].parent, found.joints["a"].name) == ("a_0_", "y")
    (tmp_path / "t.xml").write_text("<mujoco><worldbody><geom type='bx'/></worldbody></mujoco>")
    with pytest.raises(InputError, match=r"t\.xml"):
        read_object(tmp_path / "t.xml")


@pytest.mark.parametrize(
    ("joint", "limits", "spring"),
    [
        ('range="-10 95" ref="5" stiffness="4" springref="-60"', (-15.0, 90.0), (4.0, -65.0)),
        ('range="0 90" stiffness="2"', (0.0, 90.0), (2.0, 0.0)),
        ('range="0 90" ref="90"', (-90.0, 0.0), (0.0, -90.0)),
        ('range="0 90" stiffness="1" springref="30"', (0.0, 90.0), (1.0, 30.0)),
        ('stiffness="1" ref="-20"', None, (1.0, 20.0)),
    ],
)
def test_springs_and_limits_are_relative_to_the_pose_in_the_file(
    tmp_path: Path,
    joint: str,
    limits: tuple[float, float] | None,
    spring: tuple[float, float],
) -> None:
    (tmp_path / "t.xml").write_text(
        f"""<mujoco><worldbody><geom size="0.1"/><body name="a"><geom size="0.2"/>
        <joint name="x" {joint}/></body></worldbody></mujoco>"""
    )
    found = read_object(tmp_path / "t.xml")
    read = found.joints["a"]
    assert read.limits == (None if limits is None else pytest.approx(np.radians(limits)))
    assert (read.stiffness, np.degrees(read.springref)) == pytest.approx(spring)
    assert ("`ref`" in " ".join(found.notes)) == (" ref=" in joint)


WEDGE = '<mesh name="wedge" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>'


@pytest.mark.parametrize("name", ["", 'name="hills"'])
@pytest.mark.parametrize("mesh", ["", WEDGE])
def test_height_fields_are_left_out(tmp_path: Path, mesh: str, name: str) -> None:
    field = '<hfield name="h" nrow="2" ncol="2" size="1 1 .3 .1" elevation="0 0 1 0"/>'
    shape = '<geom type="mesh" mesh="wedge"/>' if mesh else '<geom name="wedge" size="1"/>'
    (tmp_path / "t.xml").write_text(
        f"<mujoco><asset>{mesh}{field}</asset><worldbody>"
        f'<geom {name} type="hfield" hfield="h"/><body name="b">{shape}</body>'
        "</worldbody></mujoco>"
    )
    found = read_object(tmp_path / "t.xml")
    assert [part.name for link in found.links.values() for part in link.solid] == ["wedge"]
    title = "hills" if name else ""
    assert found.notes == (f"geom '{title}' of body 'world' is a height field: left out",)
