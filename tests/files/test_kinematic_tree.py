"""Links and joints of URDFs make one tree, or are refused by file and line before any parser sees them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.arrays import LARGEST
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.files.urdf import load_urdf, read_urdf

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
        ([*links("a", "b", "c"), joint("j", "a", "b"), joint("j", "a", "c")], 6, "j: two joints of one name"),
        ([*links("a", "b", "c"), joint("j", "a", "c"), joint("k", "b", "c")], 6, "c: a link with two parents .*'j' and 'k'"),
        ([*links("a", "b"), joint("j", "a", "b"), joint("k", "b", "a")], 2, "a: links in a circle .*a → b → a"),
        ([*links("a"), joint("j", "a", "a")], 2, "a: links in a circle .*a → a"),
        ([*links("r", "a", "b"), joint("j", "a", "b"), joint("k", "b", "a")], 3, "a: links in a circle"),
        (links("a", "b"), 3, "b: links that nothing connects .*got a, b"),
        ([*links("a"), joint("j", "a", "b")], 3, "j: child: there is no link 'b'"),
        ([*links("a"), joint("j", "", "a")], 3, "j: parent: there is no link ''"),
        (
            [*links("a"), '<joint name="j" type="fixed"><parent link="a"/></joint>'],
            3,
            "j: a joint that connects nothing .*<child",
        ),
        ([*links("a", "b"), joint("j", "a", "b", kind="hinge")], 4, "j: this joint type is not supported .*got hinge"),
        ([*links("a", "b"), joint("j", "a", "b").replace(' type="fixed"', "")], 4, "j: this joint type is not supported"),
        ([*links("a", "b"), joint("j", "a", "b", kind="prismatic")], 4, "j: a prismatic joint without limits"),
        ([*links("a", "b"), joint("j", "a", "b", inside='<origin xyz="nan 0 0"/>')], 4, "j: origin xyz: wrong numbers"),
        ([*links("a", "b"), joint("j", "a", "b", inside='<origin xyz="0,1 0 0"/>')], 4, "j: origin xyz: wrong numbers"),
        ([*links("a", "b"), joint("j", "a", "b", inside='<origin rpy="0 0"/>')], 4, "j: origin rpy: wrong numbers"),
        ([*links("a", "b"), joint("j", "a", "b", inside=f'<origin xyz="{2 * LARGEST} 0 0"/>')], 4, "expected at most 10000"),
        (
            [*links("a", "b"), joint("j", "a", "b", kind="continuous", inside='<axis xyz="0 0 0"/>')],
            4,
            "j: an axis without direction",
        ),
        (
            [*links("a", "b"), joint("j", "a", "b", kind="revolute", inside='<limit lower="1" upper="0" velocity="1"/>')],
            4,
            "j: limit: limits in the wrong order .*got 1 and 0",
        ),
        (
            [*links("a", "b"), joint("j", "a", "b", kind="revolute", inside='<limit lower="0" upper="inf" velocity="1"/>')],
            4,
            "j: limit upper: wrong numbers .*1 finite number, got inf",
        ),
    ],
)
def test_what_is_no_tree_is_refused(tmp_path: Path, lines: list[str], line: int | None, message: str) -> None:
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
    file = written(tmp_path_factory.mktemp("tree"), *(lines[k] for k in rng.permutation(len(lines))))
    if more:
        with pytest.raises(InputError, match=r"two parents|circle"):
            read_urdf(file)
    else:
        model, collision, _ = load_urdf(file)
        assert {geometry.name for geometry in collision.geometryObjects} == {f"{name}_0" for name in names}
        assert model.njoints == 1


def test_the_nearest_link_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError) as caught:
        read_urdf(written(tmp_path, *links("upper_arm", "forearm"), joint("j", "uper_arm", "forearm")))
    assert caught.value.nearest == "upper_arm"
