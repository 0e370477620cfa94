from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.partnet import write_partnet_object

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.objects.description import Link
from vkc_pin.importing.objects.urdf import read_object_urdf


def test_missing_values_of_partnet_are_none(tmp_path: Path) -> None:
    found = read_object_urdf(write_partnet_object(tmp_path))
    assert found.root == "base"
    joints = {joint.name: joint for joint in found.joints.values()}
    assert joints["joint_0"].limits == (0.0, 0.36)
    assert joints["joint_1"].limits is None
    assert joints["joint_3"].kind == "continuous"
    assert {joint.velocity for joint in joints.values()} == {None}
    drawer = found.links["link_0"]
    assert [part.name for part in drawer.collision] == [part.name for part in drawer.visual]
    assert "handle-7" in [part.name for part in drawer.collision]
    case = found.links["link_2"]
    assert case.solid == case.collision
    assert Link("", case.visual).solid == case.visual


def test_swapped_limits_and_unsupported_joints_are_noted(tmp_path: Path) -> None:
    text = """<robot name="t"><link name="a"/><link name="b"/><link name="c"/>
    <joint name="j" type="revolute"><parent link="a"/><child link="b"/>
      <limit lower="1" upper="-0.5"/>
      <mimic joint="k"/><dynamics damping="0.4" friction="-1"/></joint>
    <joint name="k" type="floating"><parent link="a"/><child link="c"/></joint></robot>"""
    (tmp_path / "t.urdf").write_text(text)
    found = read_object_urdf(tmp_path / "t.urdf")
    assert found.joints["b"].limits == (-0.5, 1.0)
    assert np.allclose(found.joints["b"].axis, [1.0, 0.0, 0.0])
    assert (found.joints["b"].damping, found.joints["b"].friction) == (0.4, 0.0)
    assert found.joints["c"].kind == "fixed"
    assert [
        word in " ".join(found.notes)
        for word in ("lower limit above its upper limit", "floating", "mimics")
    ] == [True] * 3
    free = read_object_urdf(tmp_path / "t.urdf", free=True)
    assert free.joints["c"].kind == "floating"
    assert "floating" not in " ".join(free.notes)


def test_errors_name_file_and_element(tmp_path: Path) -> None:
    file = tmp_path / "t.urdf"
    file.write_text(
        '<robot name="t"><link name="a"/><joint name="j" type="fixed">'
        '<parent link="a"/><child link="d"/></joint></robot>'
    )
    with pytest.raises(UnknownNameError, match=r"t\.urdf"):
        read_object_urdf(file)
    geometry = '<geometry><mesh filename="gone.obj"/></geometry>'
    file.write_text(
        f'<robot name="t"><link name="a"><collision>{geometry}</collision></link></robot>'
    )
    with pytest.raises(InputError, match=r"gone\.obj"):
        read_object_urdf(file)


def test_inertia_is_read(tmp_path: Path) -> None:
    origin = '<origin xyz="0.1 0.2 0.3" rpy="0 0 1.5707963267948966"/>'
    moments = '<inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0.01"/>'
    complete = f'<inertial>{origin}<mass value="2"/>{moments}</inertial>'
    unit = '<inertia ixx="1" iyy="1" izz="1"/>'
    impossible = '<inertia ixx="1" iyy="1" izz="1" ixy="3"/>'
    text = f"""<robot name="t"><link name="a">{complete}</link><link name="b"/>
    <link name="c"><inertial><mass value="1"/></inertial></link>
    <link name="d"><inertial><mass value="-1"/>{unit}</inertial></link>
    <link name="e"><inertial><mass value="1"/>{impossible}</inertial></link>
    <link name="f"><inertial><mass value="heavy"/>{unit}</inertial></link>
    """ + "".join(
        f'<joint name="{c}" type="fixed"><parent link="a"/><child link="{c}"/></joint>'
        for c in "bcdef"
    )
    (tmp_path / "t.urdf").write_text(text + "</robot>")
    found = read_object_urdf(tmp_path / "t.urdf")
    stated = found.links["a"].inertia
    assert (stated.mass, list(stated.lever)) == (2.0, [0.1, 0.2, 0.3])
    assert np.allclose(
        stated.inertia, [[0.2, -0.01, 0.0], [-0.01, 0.1, 0.0], [0.0, 0.0, 0.25]]
    )  # along the link's axes
    assert [found.links[name].inertia.mass for name in "bcdef"] == [0.0] * 5
    link_notes = [next(note for note in found.notes if f"'{name}'" in note) for name in "cdef"]
    for note, words in zip(
        link_notes,
        ("without <inertia>", "a negative mass", "moments of inertia", "heavy"),
        strict=True,
    ):
        assert words in note
        assert "counts as none" in note


@pytest.mark.parametrize(
    ("kind", "limit", "expected_kind", "limits"),
    [
        ("revolute", 'lower="-1.8e308" upper="1.8e308"', None, None),
        ("revolute", 'lower="-1.79769e308" upper="1.79769e308"', "continuous", None),
        ("revolute", 'lower="-3.4028235e38" upper="3.4028235e38"', "continuous", None),
        ("revolute", 'lower="-1e16" upper="1.5"', "revolute", (-np.inf, 1.5)),
        ("prismatic", 'lower="-1e16" upper="1e16"', "prismatic", None),
        ("prismatic", 'lower="0" upper="2147483647"', "prismatic", (0.0, np.inf)),
        ("prismatic", 'lower="0" upper="0.4" velocity="-1" effort="-1"', "prismatic", (0.0, 0.4)),
    ],
)
def test_huge_limits_count_as_unlimited(
    tmp_path: Path,
    kind: str,
    limit: str,
    expected_kind: str | None,
    limits: tuple[float, float] | None,
) -> None:
    file = tmp_path / "t.urdf"
    file.write_text(
        f'<robot name="t"><link name="a"/><link name="b"/><joint name="j" type="{kind}">'
        f'<parent link="a"/><child link="b"/><limit {limit}/></joint></robot>'
    )
    if expected_kind is None:  # beyond the largest float
        with pytest.raises(InputError, match="j: limit lower: wrong numbers"):
            read_object_urdf(file)
        return
    joint = read_object_urdf(file).joints["b"]
    assert (joint.kind, joint.limits, joint.velocity) == (expected_kind, limits, None)
