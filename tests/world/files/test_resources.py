from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin import UnknownNameError
from vkc_pin.world.files.resources import (
    choose_file_names,
    find_file,
    find_mesh_file,
    find_resource,
    find_resource_folder,
    list_resources,
)


def test_files_are_found_by_name_or_path() -> None:
    door = find_resource("scenes", "*.yaml", "door", noun="scene")
    for name, found in (("door", door), ("a/b", "a/b"), ("b.yaml", "b.yaml"), (Path("b"), "b")):
        assert find_file(name, "scenes", "*.yaml", noun="scene") == Path(found)


@pytest.mark.parametrize("address", ["package://robot/part.stl", "package://other/part.stl"])
def test_packages_are_found_around_the_target_of_a_link(tmp_path: Path, address: str) -> None:
    """A link to a description stands apart from its meshes."""
    package = tmp_path / "deep" / "robot"
    package.mkdir(parents=True)
    (package / "part.stl").touch()
    (package / "robot.urdf").touch()
    link = tmp_path / "links" / "robot.urdf"
    link.parent.mkdir()
    link.symlink_to(package / "robot.urdf")
    assert find_mesh_file(address, link) == package / "part.stl"


def test_unknown_resources_raise() -> None:
    with pytest.raises(
        UnknownNameError, match=r"there is no scene 'draw'; did you mean 'drawer'\?"
    ) as caught:
        find_resource("scenes", "*.yaml", "draw", noun="scene")
    assert set(caught.value.choices) == set(list_resources("scenes", "*.yaml"))


def test_installed_packages_contain_their_resources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "site-packages" / "vkc_pin"
    (package / "scenes").mkdir(parents=True)
    (package / "scenes" / "own.yaml").write_text("")
    monkeypatch.setattr(
        "vkc_pin.world.files.resources.__file__", str(package / "world" / "files" / "resources.py")
    )
    assert find_resource_folder("scenes") == package / "scenes"
    assert list(list_resources("scenes", "*.yaml")) == ["own"]
    # It is beside the package, as in a source tree.
    assert find_resource_folder("robots") == package.parent / "robots"


# Names of new files

PORTABLE = re.compile(r"[A-Za-z0-9_-]{1,64}")
DEVICES = {
    "con",
    "prn",
    "aux",
    "nul",
    *(f"{port}{k}" for port in ("com", "lpt") for k in range(10)),
}
NAMES = st.lists(
    st.one_of(
        st.text(max_size=80),
        st.text("aA_-1 +", max_size=4),
        st.sampled_from(["con", "COM1", "a_2", ".", "..", "", "a/b", "\0", "\n", "x" * 300]),
    ),
    max_size=12,
)


@given(NAMES)
def test_file_names_are_portable_unique_and_reproducible(names: list[str]) -> None:
    chosen = choose_file_names(names)
    assert choose_file_names(names) == chosen == choose_file_names(chosen)
    assert len({name.lower() for name in chosen}) == len(names)
    for name in chosen:
        assert PORTABLE.fullmatch(name)
        assert name.lower() not in DEVICES
    others = choose_file_names(names, taken=chosen)
    assert len({name.lower() for name in (*chosen, *others)}) == 2 * len(names)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["drawer", "left-door_2"], ["drawer", "left-door_2"]),
        (["a+b", "a b", "a_b"], ["a_b_2", "a_b_3", "a_b"]),
        (["шкаф", "."], ["part", "part_2"]),
        (["Door", "door"], ["Door", "door_2"]),
        (["con", "Lpt1", "conx"], ["con_", "Lpt1_", "conx"]),
        (["../../etc/passwd"], ["______etc_passwd"]),
        (["a" * 65, "a" * 64 + "b"], ["a" * 64, "a" * 62 + "_2"]),
    ],
)
def test_file_names_of_examples(names: list[str], expected: list[str]) -> None:
    assert choose_file_names(names) == expected
    assert choose_file_names(["робот", "r2", "+"], fallback="robot") == ["robot", "r2", "robot_2"]
