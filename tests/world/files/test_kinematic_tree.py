"""Tests that links and joints of URDFs must form one tree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error

from vkc_pin.world.files.urdf import load_urdf, read_urdf

SHAPE = "<collision><geometry><sphere radius='0.1'/></geometry></collision>"


def format_joint(
    name: str, parent: str, child: str, *, kind: str = "fixed", inside: str = ""
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{inside}</joint>'


def write_urdf(folder: Path, *lines: str) -> Path:
    (folder / "thing.urdf").write_text("\n".join(['<robot name="r">', *lines, "</robot>"]))
    return folder / "thing.urdf"


def format_links(*names: str) -> list[str]:
    return [f'<link name="{name}">{SHAPE}</link>' for name in names]


def format_pair(kind: str = "fixed", inside: str = "") -> list[str]:
    """Return two links and a joint `j` between them."""
    return [*format_links("a", "b"), format_joint("j", "a", "b", kind=kind, inside=inside)]


@pytest.mark.parametrize(
    ("lines", "line", "message"),
    [
        ([], None, "there are no links"),
        (format_links("a", "a"), 3, "a: two links of one name .got lines 2 and 3"),
        (format_links("a", " "), 3, "a link without a name"),
        ([*format_pair(), format_joint("j", "a", "b")], 5, "j: two joints of one name"),
        (
            [*format_pair(), format_joint("k", "a", "b")],
            5,
            "b: a link with two parents .*'j' and 'k'",
        ),
        ([*format_pair(), format_joint("k", "b", "a")], 2, "a: links in a circle .*a → b → a"),
        ([*format_links("a"), format_joint("j", "a", "a")], 2, "a: links in a circle .*a → a"),
        (format_links("a", "b"), 3, "b: links that nothing connects .*got a, b"),
        (
            [*format_links("a"), format_joint("j", "a", "aa")],
            3,
            "j: child: there is no link 'aa'; did you mean",
        ),
        (
            [*format_links("a"), '<joint name="j" type="fixed"><parent link="a"/></joint>'],
            3,
            "j: a joint that connects nothing .*<child",
        ),
        (format_pair("hinge"), 4, "j: this joint type is not supported .*got hinge"),
        (format_pair("prismatic"), 4, "j: a prismatic joint without limits"),
        (format_pair("continuous", '<axis xyz="0 0 0"/>'), 4, "j: an axis without direction"),
        (
            format_pair("revolute", '<limit lower="1" upper="0" velocity="1"/>'),
            4,
            "j: limit: limits in the wrong order .*got 1 and 0",
        ),
        (
            format_pair("revolute", '<limit lower="0" upper="inf" velocity="1"/>'),
            4,
            "j: limit upper: wrong numbers .*1 finite number, got inf",
        ),
        (
            format_pair("prismatic", '<limit lower="0" upper="1" velocity="-1"/>'),
            4,
            "j: limit velocity: velocity limit out of range .*or 0 for none, got -1",
        ),
        (
            format_pair("continuous", '<limit velocity="1e-300"/>'),
            4,
            "j: limit velocity: velocity limit out of range .*1e-06 or more, .*got 1e-300",
        ),
        (
            format_pair("continuous", '<limit effort="-2"/>'),
            4,
            "j: limit effort: effort limit out of range",
        ),
        (
            format_pair("continuous", '<mimic joint="j" multiplier="twice"/>'),
            4,
            "j: mimic multiplier: wrong numbers .*got twice",
        ),
        (
            [*format_links("a"), '<xacro:wheel side="left"/>'],
            3,
            "xacro has not .*got <xacro:wheel>",
        ),
        *(
            (format_pair(inside=f"<origin {text}/>"), 4, f"j: origin {message}")
            for text, message in (
                ('xyz="nan 0 0"', "xyz: wrong numbers"),
                ('rpy="0 0"', "rpy: wrong numbers"),
                ('xyz="20000 0 0"', "xyz: .*expected at most 10000"),
                (
                    'xyz="1,5 0 0"',
                    "xyz: .*3 finite numbers with spaces between them, got 1,5 0 0",
                ),
                ('xyz="1,,2"', "xyz: wrong numbers"),
            )
        ),
    ],
)
def test_invalid_trees_raise(
    tmp_path: Path, lines: list[str], line: int | None, message: str
) -> None:
    file = write_urdf(tmp_path, *lines)
    with expect_error(message, file=file, line=line):
        read_urdf(file)


@pytest.mark.parametrize("text", ["1, 2, 3", "1,2,3", " 1 ,2 , 3 ", "1.0, 2.0, 3.0,", "1,\n2,\n3"])
def test_commas_between_numbers_are_read_as_spaces(tmp_path: Path, text: str) -> None:
    file = write_urdf(tmp_path, *format_pair(inside=f'<origin xyz="{text}"/>'))
    with pytest.warns(UserWarning, match=r"thing\.urdf: origin xyz: commas are read as spaces"):
        model, _, _ = load_urdf(file)
    np.testing.assert_array_equal(
        model.frames[model.getFrameId("b")].placement.translation, [1, 2, 3]
    )


LARGE = ("1.7976931348623157e308", "3.4028235e38", "1e16", "2147483647", "10000")


@pytest.mark.parametrize("large", LARGE)
def test_huge_limits_count_as_unlimited(tmp_path: Path, large: str) -> None:
    for kind, lower, nq in (
        ("revolute", f"-{large}", 2),
        ("prismatic", f"-{large}", 1),
        ("revolute", "-1", 1),
    ):
        limit = f'<limit lower="{lower}" upper="{large}" velocity="1"/>'
        model, _, _ = load_urdf(write_urdf(tmp_path, *format_pair(kind, limit)))
        assert model.nq == nq  # a continuous joint has cosine and sine
        if nq == 1:
            assert model.lowerPositionLimit[0] == max(float(lower), -1e4)
            assert model.upperPositionLimit[0] == 1e4


def test_incomplete_limits_and_couplings_warn(tmp_path: Path) -> None:
    for read, kind, inside, message in (
        (load_urdf, "revolute", '<limit velocity="1"/>', "a limit without lower and upper"),
        (read_urdf, "continuous", '<mimic joint="k"/>', "there is no joint 'k' to follow"),
    ):
        with pytest.warns(UserWarning, match=f"thing.urdf:4: j: {message}"):
            read(write_urdf(tmp_path, *format_pair(kind, inside)))


def test_velocity_and_effort_limits_are_optional(tmp_path: Path) -> None:
    """The axes of fixed joints have no effect."""
    lines = [
        *format_links("a", "b", "c", "d"),
        format_joint("k", "b", "c", kind="prismatic", inside='<limit upper="2" velocity="3"/>'),
        format_joint("j", "a", "b", kind="revolute", inside='<limit lower="-1" upper="0.5"/>'),
        format_joint("l", "c", "d", inside='<axis xyz="0 0 0"/>'),
    ]
    model, _, _ = load_urdf(write_urdf(tmp_path, *lines))
    assert list(model.names)[1:] == ["j", "k"]
    np.testing.assert_array_equal(model.velocityLimit, [np.inf, 3.0])
    np.testing.assert_array_equal(model.lowerPositionLimit, [-1.0, 0.0])
    np.testing.assert_array_equal(model.upperPositionLimit, [0.5, 2.0])


@pytest.mark.filterwarnings("error")
def test_extensions_are_ignored(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Elements of simulators and undeclared prefixes have no effect and print no errors."""
    lines = format_pair("continuous", '<axis xyz="0 0 1"/><limit effort="3"/>')
    plain, _, _ = load_urdf(write_urdf(tmp_path, *lines))
    gear = lines.pop().replace("</joint>", '<drake:gear ratio="x"/><calibration/></joint>')
    lines += [
        gear,
        '<gazebo reference="a"><material>Gazebo/Red</material></gazebo>',
        '<transmission name="t"><joint name="nowhere"/></transmission>',
        '<drake:joint name="j" type="universal"/>',
        '<xacro:property name="width" value="3"/>',
    ]
    assert load_urdf(write_urdf(tmp_path, *lines))[0] == plain
    assert not capfd.readouterr().err


def load_inertia(folder: Path, inside: str) -> pin.Inertia:
    """Return the inertia of a link that a joint moves."""
    root, moving = format_links("r", "a")
    inertial = f"<inertial>{inside}</inertial>"
    lines = [moving.replace("</link>", f"{inertial}</link>"), root]
    joint = format_joint("j", "r", "a", kind="continuous")
    model, _, _ = load_urdf(write_urdf(folder, *lines, joint))
    return model.inertias[1]


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ("", "2: a: an <inertial> without <mass>"),
        ('<mass value="1"/>', "2: a: an <inertial> without <inertia>"),
        ('<mass value="heavy"/><inertia ixx="1"/>', "a: mass value: wrong numbers .*got heavy"),
        ('<mass value="-3"/><inertia ixx="1"/>', "2: a: a negative mass .*got -3"),
        ('<mass value="1e10"/><inertia ixx="1"/>', "a: mass value: .*at most 1e.09, got 1e10"),
    ],
)
def test_incomplete_inertials_warn(tmp_path: Path, inside: str, message: str) -> None:
    with pytest.warns(UserWarning, match=f"{message}.*counts as none"):
        assert load_inertia(tmp_path, inside).mass == 0.0


@pytest.mark.parametrize(("mass", "moment"), [(2e4, 400.0), (20.0, 4e5), (1e9, 1e9)])
def test_large_masses_are_preserved(tmp_path: Path, mass: float, moment: float) -> None:
    moments = " ".join(f'{key}="{moment}"' for key in ("ixx", "iyy", "izz"))
    inertia = load_inertia(tmp_path, f'<mass value="{mass}"/><inertia {moments}/>')
    assert inertia.mass == mass
    np.testing.assert_allclose(inertia.inertia, moment * np.eye(3))


def test_unnamed_robots_are_named_after_their_file(tmp_path: Path) -> None:
    file = tmp_path / "x\x01\udcff\n.urdf"
    file.write_text(f"<robot>{''.join(format_links('a'))}</robot>")
    model, collision, _ = load_urdf(file)
    assert model.name == "x\ufffd\ufffd\n"
    assert len(collision.geometryObjects) == 1
