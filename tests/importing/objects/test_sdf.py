from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.downloads import SDF

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.objects.description import Description
from vkc_pin.importing.objects.sdf import read_object_sdf


def read(folder: Path, text: str) -> Description:
    (folder / "t.sdf").write_text(text)
    return read_object_sdf(folder / "t.sdf")


def test_relative_frames_inertia_and_resistance_are_read(tmp_path: Path) -> None:
    moments = "<inertia><ixx>0.1</ixx><iyy>0.2</iyy><izz>0.25</izz></inertia>"
    inertial = f"<inertial><pose>0 0 0.1 0 0 0</pose><mass>2</mass>{moments}</inertial>"
    resistance = "<dynamics><damping>0.4</damping><friction>0.2</friction></dynamics></axis>"
    text = SDF.replace('<link name="case">', f'<link name="case">{inertial}')
    found = read(tmp_path, text.replace("</axis>", resistance))
    assert found.links["case"].inertia.mass == 2.0
    assert np.trace(found.links["case"].inertia.inertia) == pytest.approx(0.55)
    assert (found.joints["door"].damping, found.joints["door"].friction) == (0.4, 0.2)
    hinge = found.joints["door"]
    assert (found.root, hinge.kind, hinge.limits) == ("case", "revolute", (-1.5, 0.0))
    assert np.allclose(hinge.axis, [0.0, 0.0, -1.0])
    shut, open_ = (found.compute_placements({"hinge": value})["door"] for value in (0.0, -0.7))
    leaf = found.links["door"].collision[0].placement
    assert np.allclose((shut * leaf).translation, [-0.25, 0.0, 0.0])  # in the frame of the case
    assert np.allclose(shut.translation, [-0.25, -0.3, 0.0])  # on the hinge
    assert (open_ * leaf).translation[0] < -0.35
    partial = read(tmp_path, text.replace(moments, ""))
    assert partial.links["case"].inertia.mass == 0.0
    assert any("<inertial> counts as none" in note for note in partial.notes)


def test_joint_to_the_world_makes_it_the_root(tmp_path: Path) -> None:
    fixed = '<joint name="f" type="fixed"><parent>world</parent><child>case</child></joint></model>'
    (tmp_path / "t.sdf").write_text(SDF.replace("</model>", fixed))
    found = read_object_sdf(tmp_path / "t.sdf")
    assert found.root == "world"
    assert np.allclose(found.compute_placements()["case"].translation, [1.0, 0.0, 0.4])
    (tmp_path / "t.sdf").write_text(SDF.replace("<parent>case</parent>", "<parent>world</parent>"))
    with pytest.raises(InputError, match="case, world"):
        read_object_sdf(tmp_path / "t.sdf")


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("<child>door</child>", "<child>dor</child>", UnknownNameError),
        ('relative_to="case"', 'relative_to="cas"', UnknownNameError),
        ('relative_to="case"', 'relative_to="hinge"', InputError),
        ("<size>0.4 0.6 0.8</size>", "<size>0.4 0.6</size>", InputError),
        ('<link name="case">', '<include/><link name="case">', InputError),
        ('<model name="box">', '<model name="other"/><model name="box">', InputError),
        ('<link name="case">', '<link name="door"/><link name="case">', InputError),
    ],
)
def test_errors_name_the_file(tmp_path: Path, old: str, new: str, error: type[InputError]) -> None:
    assert old in SDF
    with pytest.raises(error, match=r"t\.sdf"):
        read(tmp_path, SDF.replace(old, new))
