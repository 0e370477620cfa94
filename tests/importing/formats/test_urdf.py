from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.partnet import write_partnet_object
from helpers.texts import format_fixed_link

from vkc_pin.errors import InputError
from vkc_pin.importing.description import Description, Link
from vkc_pin.importing.objects.object_reading import read_object


def test_missing_values_of_partnet_are_none(tmp_path: Path) -> None:
    found = read_object(write_partnet_object(tmp_path))
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


def read_text(folder: Path, text: str, **options: bool) -> Description:
    """Read a URDF with these links and joints."""
    (folder / "t.urdf").write_text(f'<robot name="t">{text}</robot>')
    return read_object(folder / "t.urdf", **options)


def format_joint(kind: str, child: str = "b", more: str = "") -> str:
    ends = f'<parent link="a"/><child link="{child}"/>'
    return f'<joint name="to_{child}" type="{kind}">{ends}{more}</joint>'


LINKS = '<link name="a"/><link name="b"/><link name="c"/>'


def test_swapped_limits_and_unsupported_joints_are_noted(tmp_path: Path) -> None:
    more = '<limit lower="1" upper="-0.5"/><mimic joint="k"/>'
    swapped = format_joint("revolute", "b", f'{more}<dynamics damping="0.4" friction="0.1"/>')
    text = LINKS + swapped + format_joint("planar", "c")
    found = read_text(tmp_path, text)
    joint = found.joints["b"]
    assert joint.limits == (-0.5, 1.0)
    assert np.allclose(joint.axis, [1.0, 0.0, 0.0])
    assert (joint.damping, joint.friction) == (0.4, 0.1)
    assert found.joints["c"].kind == "fixed"
    for words in ("lower limit above its upper limit", "is planar: taken as fixed", "follows 'k'"):
        assert words in " ".join(found.notes)


def test_free_bodies_are_objects_of_their_own(tmp_path: Path) -> None:
    text = LINKS + format_joint("fixed", "b") + format_joint("floating", "c")
    box = '<link name="{}"><collision><geometry><box size="1 1 1"/></geometry></collision></link>'
    solid = text.replace('<link name="a"/>', box.format("a"))
    assert read_text(tmp_path, solid, free=True).joints["c"].kind == "floating"
    beside = read_text(tmp_path, solid)
    assert list(beside.links) == ["a", "b"]
    assert beside.notes == ("body 'c' is free, hence a separate object: left out",)
    alone = read_text(tmp_path, text.replace('<link name="c"/>', box.format("c")))
    assert list(alone.links) == ["c"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LINKS + format_joint("fixed", "d"), r"t\.urdf"),
        (
            '<link name="a"><collision><geometry><mesh filename="gone.obj"/></geometry>'
            "</collision></link>",
            r"gone\.obj",
        ),
        (
            LINKS + format_joint("revolute", "b", '<limit lower="-1.8e308" upper="1"/>'),
            "to_b: limit lower: wrong numbers",  # beyond the largest float
        ),
    ],
)
def test_errors_name_file_and_element(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_text(tmp_path, text).check_meshes()


def test_inertia_is_read(tmp_path: Path) -> None:
    origin = '<origin xyz="0.1 0.2 0.3" rpy="0 0 1.5707963267948966"/>'
    moments = '<inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0.01"/>'
    complete = f'<inertial>{origin}<mass value="2"/>{moments}</inertial>'
    unit = '<inertia ixx="1" iyy="1" izz="1"/>'
    impossible = '<inertia ixx="1" iyy="1" izz="1" ixy="3"/>'
    text = f'<link name="a">{complete}</link><link name="b"/>' + "".join(
        format_fixed_link(name, "a", shapes=f"<inertial>{mass}{inertia}</inertial>")
        for name, mass, inertia in (
            ("c", '<mass value="1"/>', ""),
            ("d", '<mass value="-1"/>', unit),
            ("e", '<mass value="1"/>', impossible),
            ("f", '<mass value="heavy"/>', unit),
        )
    )
    found = read_text(tmp_path, text + format_joint("fixed"))
    stated = found.links["a"].inertia
    assert (stated.mass, list(stated.lever)) == (2.0, [0.1, 0.2, 0.3])
    # along the link's axes
    expected = [[0.2, -0.01, 0.0], [-0.01, 0.1, 0.0], [0.0, 0.0, 0.25]]
    assert np.allclose(stated.inertia, expected)
    assert [found.links[name].inertia.mass for name in "bcdef"] == [0.0] * 5
    reasons = ("without <inertia>", "a negative mass", "moments of inertia", "heavy")
    for name, words in zip("cdef", reasons, strict=True):
        (note,) = (note for note in found.notes if f"'{name}'" in note)
        assert words in note
        assert "counts as none" in note


@pytest.mark.parametrize(
    ("kind", "limit", "expected"),
    [
        ("revolute", 'lower="-1.79769e308" upper="1.79769e308"', ("revolute", None)),
        ("revolute", 'lower="-1e16" upper="1.5"', ("revolute", (-np.inf, 1.5))),
        ("prismatic", 'lower="-1e16" upper="1e16"', ("prismatic", None)),
        ("prismatic", 'lower="0" upper="2147483647"', ("prismatic", (0.0, np.inf))),
        ("prismatic", 'lower="0" upper="0.4" velocity="-1"', ("prismatic", (0.0, 0.4))),
    ],
)
def test_huge_limits_count_as_unlimited(
    tmp_path: Path, kind: str, limit: str, expected: tuple[str, tuple[float, float] | None]
) -> None:
    links = LINKS + format_joint("fixed", "c")
    joint = read_text(tmp_path, links + format_joint(kind, "b", f"<limit {limit}/>")).joints["b"]
    assert (joint.kind, joint.limits, joint.velocity) == (*expected, None)


FORWARD = '<limit lower="0" upper="1.5"/>'


@pytest.mark.parametrize(
    ("leader", "follower", "mimic", "expected"),
    [
        (FORWARD, FORWARD, 'multiplier="-1"', (-1.5, 0.0)),  # limits copied from the leader
        (FORWARD, '<limit lower="-1.5" upper="0"/>', 'multiplier="-1"', (-1.5, 0.0)),
        (FORWARD, "", 'multiplier="-1"', (-1.5, 0.0)),
        (FORWARD, '<limit lower="-1e16" upper="1e16"/>', 'multiplier="0.5"', (0.0, 0.75)),
        (FORWARD, '<limit lower="-3" upper="3"/>', 'multiplier="2" offset="-1"', (-1.0, 2.0)),
        (FORWARD, '<limit lower="0" upper="1"/>', "", (0.0, 1.0)),
        (FORWARD, '<limit lower="0" upper="1"/>', 'offset="4"', (4.0, 5.5)),
        ("", FORWARD, 'multiplier="-1"', (0.0, 1.5)),
        ('<limit lower="0" upper="1e16"/>', FORWARD, 'multiplier="-1"', (-np.inf, 0.0)),
    ],
)
def test_followers_keep_the_limits_that_their_leaders_reach(
    tmp_path: Path,
    leader: str,
    follower: str,
    mimic: str,
    expected: tuple[float, float],
) -> None:
    first = format_joint("revolute", "b", leader)
    second = format_joint("revolute", "c", f'{follower}<mimic joint="to_b" {mimic}/>')
    for joints in (first + second, second + first):
        found = read_text(tmp_path, LINKS + joints)
        assert found.joints["c"].limits == pytest.approx(expected)
        (note,) = found.notes
        assert "'to_c' follows 'to_b' (<mimic>): made independent" in note


def test_chains_of_followers_are_limited_by_their_leader(tmp_path: Path) -> None:
    links = LINKS + '<link name="d"/>'
    chain = (
        format_joint("revolute", "d", FORWARD + '<mimic joint="to_c" multiplier="-1"/>')
        + format_joint("revolute", "c", FORWARD + '<mimic joint="to_b" multiplier="-0.5"/>')
        + format_joint("revolute", "b", FORWARD)
    )
    found = read_text(tmp_path, links + chain)
    assert found.joints["c"].limits == pytest.approx((-0.75, 0.0))
    assert found.joints["d"].limits == pytest.approx((0.0, 0.75))
