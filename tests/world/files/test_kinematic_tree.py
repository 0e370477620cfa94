"""Links and joints of URDFs make one tree, or are refused by file and line before any parser sees them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import MAX_COORDINATE
from vkc_pin.world.files.urdf import load_urdf, read_urdf

SHAPE = "<collision><geometry><sphere radius='0.1'/></geometry></collision>"


def joint(name: str, parent: str, child: str, *, kind: str = "fixed", inside: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def written(folder: Path, *lines: str) -> Path:
    (folder / "thing.urdf").write_text("\n".join(['<robot name="r">', *lines, "</robot>"]))
    return folder / "thing.urdf"


def links(*names: str) -> list[str]:
    return [f'<link name="{name}">{SHAPE}</link>' for name in names]


@pytest.mark.parametrize(
    ("lines", "line", "message"),
    [
        ([], None, "there are no links"),
        (links("a", "a"), 3, "a: two links of one name .got lines 2 and 3"),
        (links("a", " "), 3, "a link without a name"),
        (
            [*links("a", "b", "c"), joint("j", "a", "b"), joint("j", "a", "c")],
            6,
            "j: two joints of one name",
        ),
        (
            [*links("a", "b", "c"), joint("j", "a", "c"), joint("k", "b", "c")],
            6,
            "c: a link with two parents .*'j' and 'k'",
        ),
        (
            [*links("a", "b"), joint("j", "a", "b"), joint("k", "b", "a")],
            2,
            "a: links in a circle .*a → b → a",
        ),
        ([*links("a"), joint("j", "a", "a")], 2, "a: links in a circle .*a → a"),
        (
            [*links("r", "a", "b"), joint("j", "a", "b"), joint("k", "b", "a")],
            3,
            "a: links in a circle",
        ),
        (links("a", "b"), 3, "b: links that nothing connects .*got a, b"),
        ([*links("a"), joint("j", "a", "b")], 3, "j: child: there is no link 'b'"),
        ([*links("a"), joint("j", "", "a")], 3, "j: parent: there is no link ''"),
        (
            [*links("a"), '<joint name="j" type="fixed"><parent link="a"/></joint>'],
            3,
            "j: a joint that connects nothing .*<child",
        ),
        (
            [*links("a", "b"), joint("j", "a", "b", kind="hinge")],
            4,
            "j: this joint type is not supported .*got hinge",
        ),
        (
            [*links("a", "b"), joint("j", "a", "b").replace(' type="fixed"', "")],
            4,
            "j: this joint type is not supported",
        ),
        (
            [*links("a", "b"), joint("j", "a", "b", kind="prismatic")],
            4,
            "j: a prismatic joint without limits",
        ),
        (
            [*links("a", "b"), joint("j", "a", "b", inside='<origin xyz="nan 0 0"/>')],
            4,
            "j: origin xyz: wrong numbers",
        ),
        (
            [*links("a", "b"), joint("j", "a", "b", inside='<origin xyz="0,1 0 0"/>')],
            4,
            "j: origin xyz: wrong numbers",
        ),
        (
            [*links("a", "b"), joint("j", "a", "b", inside='<origin rpy="0 0"/>')],
            4,
            "j: origin rpy: wrong numbers",
        ),
        (
            [
                *links("a", "b"),
                joint("j", "a", "b", inside=f'<origin xyz="{2 * MAX_COORDINATE} 0 0"/>'),
            ],
            4,
            "expected at most 10000",
        ),
        (
            [
                *links("a", "b"),
                joint("j", "a", "b", kind="continuous", inside='<axis xyz="0 0 0"/>'),
            ],
            4,
            "j: an axis without direction",
        ),
        (
            [
                *links("a", "b"),
                joint(
                    "j",
                    "a",
                    "b",
                    kind="revolute",
                    inside='<limit lower="1" upper="0" velocity="1"/>',
                ),
            ],
            4,
            "j: limit: limits in the wrong order .*got 1 and 0",
        ),
        (
            [
                *links("a", "b"),
                joint(
                    "j",
                    "a",
                    "b",
                    kind="revolute",
                    inside='<limit lower="0" upper="inf" velocity="1"/>',
                ),
            ],
            4,
            "j: limit upper: wrong numbers .*1 finite number, got inf",
        ),
        (
            [
                *links("a", "b"),
                joint(
                    "j", "a", "b", kind="continuous", inside='<mimic joint="j" multiplier="twice"/>'
                ),
            ],
            4,
            "j: mimic multiplier: wrong numbers .*got twice",
        ),
        (
            [*links("a"), '<xacro:wheel side="left"/>'],
            3,
            "xacro has not been run .*xacro FILE .*got <xacro:wheel>",
        ),
    ],
)
def test_what_is_no_tree_is_refused(
    tmp_path: Path, lines: list[str], line: int | None, message: str
) -> None:
    file = written(tmp_path, *lines)
    with pytest.raises(InputError, match=message) as caught:
        read_urdf(file)
    assert (caught.value.file, caught.value.line) == (file, line)


def test_what_does_not_move_needs_no_axis(tmp_path: Path) -> None:
    file = written(tmp_path, *links("a", "b"), joint("j", "a", "b", inside='<axis xyz="0 0 0"/>'))
    assert read_urdf(file).links == ("a", "b")


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12), st.integers(0, 2**32 - 1), st.booleans())
def test_trees_are_read_and_one_joint_more_is_not(
    tmp_path_factory: pytest.TempPathFactory, count: int, seed: int, more: bool
) -> None:
    """Whatever the order of links and joints; one more joint makes a circle, or gives a link a second parent."""
    rng = np.random.default_rng(seed)
    names = [f"l{k}" for k in rng.permutation(count)]
    lines = links(*names)
    lines += [joint(f"j{k}", names[rng.integers(k)], names[k]) for k in range(1, count)]
    if more:
        lines.append(joint("more", *(names[k] for k in rng.integers(count, size=2))))
    file = written(
        tmp_path_factory.mktemp("tree"), *(lines[k] for k in rng.permutation(len(lines)))
    )
    if more:
        with pytest.raises(InputError, match=r"two parents|circle"):
            read_urdf(file)
    else:
        model, collision, _ = load_urdf(file)
        assert {geometry.name for geometry in collision.geometryObjects} == {
            f"{name}_0" for name in names
        }
        assert model.njoints == 1


def test_the_nearest_link_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError) as caught:
        read_urdf(
            written(tmp_path, *links("upper_arm", "forearm"), joint("j", "uper_arm", "forearm"))
        )
    assert caught.value.nearest == "upper_arm"


def test_what_planning_does_not_need_may_be_left_out(tmp_path: Path) -> None:
    """A limit without effort or velocity: the joint has none, and only what is missing differs."""
    lines = [
        *links("a", "b", "c"),
        joint("k", "b", "c", kind="prismatic", inside='<limit upper="2" velocity="3"/>'),
    ]
    model, _, _ = load_urdf(
        written(
            tmp_path,
            *lines,
            joint("j", "a", "b", kind="revolute", inside='<limit lower="-1" upper="0.5"/>'),
        )
    )
    assert list(model.names)[1:] == ["j", "k"]
    np.testing.assert_array_equal(model.velocityLimit, [np.inf, 3.0])
    np.testing.assert_array_equal(model.lowerPositionLimit, [-1.0, 0.0])
    np.testing.assert_array_equal(model.upperPositionLimit, [0.5, 2.0])


def test_extensions_say_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Elements of simulators and of nobody known, with prefixes that nothing declares; no parser complains behind our back."""
    lines = [
        *links("a", "b"),
        joint("j", "a", "b", kind="continuous", inside='<axis xyz="0 0 1"/><limit effort="3"/>'),
    ]
    plain, _, _ = load_urdf(written(tmp_path, *lines))
    more = [
        '<gazebo reference="a"><material>Gazebo/Red</material></gazebo>',
        '<transmission name="t"><type>SimpleTransmission</type><joint name="nowhere"/></transmission>',
        '<drake:joint name="j" type="universal"/>',
        '<xacro:property name="width" value="3"/>',
        "<velocity>fast</velocity>",
    ]
    inside = lines[-1].replace(
        "</joint>", '<drake:gear ratio="x"/><safety_controller/><calibration rising="x"/></joint>'
    )
    shape = lines[0].replace("</link>", '<drake:proximity/><sensor name="s"/></link>')
    model, collision, _ = load_urdf(written(tmp_path, shape, lines[1], inside, *more))
    assert model == plain
    assert [shape.name for shape in collision.geometryObjects] == ["a_0", "b_0"]
    assert not capfd.readouterr().err


def test_a_robot_without_a_name_is_called_like_its_file(tmp_path: Path) -> None:
    file = written(tmp_path, *links("a"))
    file.write_text(file.read_text().replace(' name="r"', ""))
    assert load_urdf(file)[0].name == "thing"


@pytest.mark.parametrize(
    ("inertial", "message"),
    [
        ("<inertial/>", "2: a: an <inertial> without <mass>.*counts as none"),
        (
            '<inertial><mass value="1"/></inertial>',
            "2: a: an <inertial> without <inertia>.*counts as none",
        ),
        (
            '<inertial><mass value="heavy"/><inertia ixx="1"/></inertial>',
            "a: mass value: wrong numbers .*got heavy.*counts as none",
        ),
    ],
)
def test_masses_that_are_none(tmp_path: Path, inertial: str, message: str) -> None:
    lines = [*links("r", "a"), joint("j", "r", "a", kind="continuous")]
    lines[:2] = [lines[1].replace("</link>", f"{inertial}</link>"), lines[0]]
    with pytest.warns(UserWarning, match=message):
        model, _, _ = load_urdf(written(tmp_path, *lines))
    assert model.inertias[1].mass == 0.0


def test_a_limit_without_numbers_is_warned_of(tmp_path: Path) -> None:
    lines = [
        *links("a", "b"),
        joint("j", "a", "b", kind="revolute", inside='<limit effort="1" velocity="1"/>'),
    ]
    with pytest.warns(
        UserWarning, match="thing.urdf:4: j: a limit without lower and upper: it cannot move"
    ):
        load_urdf(written(tmp_path, *lines))


def test_a_joint_that_follows_nothing_is_warned_of(tmp_path: Path) -> None:
    lines = [*links("a", "b"), joint("j", "a", "b", kind="continuous", inside='<mimic joint="k"/>')]
    with pytest.warns(UserWarning, match="thing.urdf:4: j: there is no joint 'k' to follow"):
        read_urdf(written(tmp_path, *lines))


def test_a_robot_without_a_name_is_named_like_its_file_whatever_that_is(tmp_path: Path) -> None:
    file = tmp_path / "x\x01\udcff\n.urdf"
    file.write_text(f"<robot>{''.join(links('a'))}</robot>")
    model, collision, _ = load_urdf(file)
    assert model.name == "x\ufffd\ufffd\n"
    assert len(collision.geometryObjects) == 1
