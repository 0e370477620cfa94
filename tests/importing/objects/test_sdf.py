from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.downloads import SDF

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.objects.sdf import read_object_sdf


def read(folder: Path, text: str) -> object:
    (folder / "t.sdf").write_text(text)
    return read_object_sdf(folder / "t.sdf")


def test_frames_that_refer_to_each_other(tmp_path: Path) -> None:
    (tmp_path / "t.sdf").write_text(SDF)
    found = read_object_sdf(tmp_path / "t.sdf")
    hinge = found.joints["door"]
    assert (found.root, hinge.kind, hinge.limits) == ("case", "revolute", (-1.5, 0.0))
    assert np.allclose(hinge.axis, [0.0, 0.0, -1.0])
    shut, open_ = (found.compute_placements({"hinge": value})["door"] for value in (0.0, -0.7))
    leaf = found.links["door"].collision[0].placement
    assert np.allclose((shut * leaf).translation, [-0.25, 0.0, 0.0])  # in the frame of the case
    assert np.allclose(shut.translation, [-0.25, -0.3, 0.0])  # on the hinge
    assert (open_ * leaf).translation[0] < -0.35


def test_a_joint_to_the_world_makes_that_the_root(tmp_path: Path) -> None:
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
def test_what_is_wrong_is_said_with_the_file(
    tmp_path: Path, old: str, new: str, error: type[InputError]
) -> None:
    assert old in SDF
    with pytest.raises(error, match=r"t\.sdf"):
        read(tmp_path, SDF.replace(old, new))


def test_what_joints_resist_with(tmp_path: Path) -> None:
    stated = "<dynamics><damping>0.4</damping><friction>0.2</friction></dynamics></axis>"
    (tmp_path / "t.sdf").write_text(SDF.replace("</axis>", stated))
    hinge = read_object_sdf(tmp_path / "t.sdf").joints["door"]
    assert (hinge.damping, hinge.friction) == (0.4, 0.2)
    (tmp_path / "t.sdf").write_text(SDF)
    hinge = read_object_sdf(tmp_path / "t.sdf").joints["door"]
    assert (hinge.damping, hinge.friction) == (0.0, 0.0)


def test_what_links_weigh(tmp_path: Path) -> None:
    moments = "<inertia><ixx>0.1</ixx><iyy>0.2</iyy><izz>0.25</izz></inertia>"
    stated = f"<inertial><pose>0 0 0.1 0 0 0</pose><mass>2</mass>{moments}</inertial>"
    place = SDF.index(">", SDF.index("<link")) + 1
    for inertial, mass, half in (
        (stated, 2.0, False),
        ("<inertial><mass>2</mass></inertial>", 0.0, True),
    ):
        (tmp_path / "t.sdf").write_text(SDF[:place] + inertial + SDF[place:])
        found = read_object_sdf(tmp_path / "t.sdf")
        weights = [link.inertia for link in found.links.values()]
        assert [weight.mass for weight in weights if weight.mass > 0.0] == ([mass] if mass else [])
        assert any("<inertial> counts as none" in note for note in found.notes) == half
        if not half:
            assert sum(np.trace(weight.inertia) for weight in weights) == pytest.approx(0.55)
