"""Tests imports of changed SDF, MJCF, URDF, xacro and mesh files."""

from __future__ import annotations

import functools
import re
import tempfile
from pathlib import Path

import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from fuzz.bounds import PLANNING_SECONDS, expect_result_or_error, take_share
from fuzz.changes import change_bytes
from vkc_pin.importing import import_home, import_object, import_robot
from vkc_pin.importing.objects.clean_up import rename_for_scenes
from vkc_pin.importing.objects.object_reading import read_object
from vkc_pin.importing.robots.sources import read_source

INPUTS = Path(__file__).with_name("inputs")
DAE = Path(__file__).with_name("box.dae")
OTHER_XACRO = b'<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><material name="m"/></robot>'
FILE_NAMES = ("ü", "x\nfree: true\n#", "con", "x" * 240, "-a", " ", "\x1b[2J")
NAMED = re.compile(r'(?<=name=")[^"]*(?=")')
ELEMENT = re.compile(r"<(\w+)[ >]")
ODD_NAMES = """ |.|..|../../evil|/etc/evil|a/b|a\\b|con|CON|nul.txt|-rf|~|é|ü|кухня|柜子|🚪
á|&#8238;evil|&#8232;|&#133;|&#10;free: true|&#13;&#10;|&#9;|&quot;/&gt;&lt;link name=&quot;x
&amp;|&lt;|'|{x: 1}|- a|# a|: |!!python/object:os.system|null|true|1|1e5|.nan|%s|{0}|$(find x)
${1/0}|world|__model__|tool|floor|base"""
NAMES = ("", *re.split(r"[|\n]", ODD_NAMES), "x" * 64, "x" * 255, "é" * 200, "x" * 70_000)
"""Names, escaped as in an XML attribute."""


@functools.cache
def read_inputs() -> dict[str, bytes]:
    """Return name → content of the files to import, and of the files beside them."""
    box = trimesh.creation.box((0.05, 0.05, 0.2))
    meshes = {f"part.{kind}": box.export(file_type=kind) for kind in ("stl", "obj")}
    files = {"other.xacro": OTHER_XACRO, "part.dae": DAE.read_bytes()}
    for name, content in meshes.items():
        files[name] = content.encode() if isinstance(content, str) else content
    return files | {path.name: path.read_bytes() for path in sorted(INPUTS.iterdir())}


@st.composite
def rename(draw: st.DrawFn, content: bytes) -> bytes:
    """Rename an element wherever its name occurs."""
    text = content.decode()
    names = sorted(set(NAMED.findall(text)))
    old = draw(st.sampled_from(names))
    new = draw(st.sampled_from((*NAMES, *names)))
    text = text.replace(f'"{old}"', f'"{new}"').replace(f">{old}<", f">{new}<")
    return text.encode("utf-8", "replace")


@st.composite
def multiply_element(draw: st.DrawFn, content: bytes) -> bytes:
    """Nest or repeat an element many times."""
    text = content.decode()
    match = draw(st.sampled_from(list(ELEMENT.finditer(text))))
    count = draw(st.sampled_from((50, 600, 5000, 100_000)))
    tag = match[1]
    nested = f"<{tag}>" * count + f"</{tag}>" * count
    repeated = f"<{tag}/>" * min(count, 5000)
    new = draw(st.sampled_from((nested, repeated)))
    return (text[: match.start()] + new + text[match.start() :]).encode()


@st.composite
def changed_inputs(draw: st.DrawFn) -> tuple[str, bool, dict[str, bytes]]:
    """Return a file to import, whether it is a robot's, and all files, one of them changed."""
    files = dict(read_inputs())
    name = draw(st.sampled_from([path.name for path in sorted(INPUTS.iterdir())]))
    is_robot = name.startswith("robot")
    content = files[name]
    strategy = draw(
        st.sampled_from((change_bytes, change_bytes, change_bytes, rename, multiply_element, None))
    )
    if strategy is not None:
        files[name] = draw(strategy(content))
    elif draw(st.booleans()):
        other = draw(st.sampled_from(sorted(files.keys() - {name})))
        files[other] = draw(change_bytes(files[other]))
    else:
        del files[name]
        name = draw(st.sampled_from(FILE_NAMES)) + Path(name).suffix
        files[name] = content
    return name, is_robot, files


def list_paths(folder: Path) -> set[str]:
    """Return the files below a folder."""
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if not file.is_dir()}


def read_or_import(name: str, is_robot: bool, files: dict[str, bytes], is_imported: bool) -> None:
    """Read or import a file, and check that nothing is written outside the target folder."""
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root, "files")
        folder.mkdir()
        for each, content in files.items():
            (folder / each).write_bytes(content)
        before = list_paths(Path(root))
        try:
            with expect_result_or_error(PLANNING_SECONDS if is_imported else 2.0):
                call_reader(folder / name, Path(root), is_robot, is_imported)
        finally:
            written = list_paths(Path(root)) - before
            assert all(path.startswith(("out/", "scratch/")) for path in written), written
            assert not [path for path in Path(root).iterdir() if path.name.startswith(".")]


def call_reader(file: Path, root: Path, is_robot: bool, is_imported: bool) -> None:
    """Read the description in a file, or import it."""
    if is_robot and is_imported:
        import_robot(file, root / "out", samples=100, most_pieces=1)
    elif is_robot:
        read_source(file, root / "scratch", packages={}, arguments={})
    elif not is_imported:
        rename_for_scenes(read_object(file, free=True))
    elif file.suffix == ".xml":
        import_home(file, root / "out", most=1)
    else:
        import_object(file, root / "out", most=1)


@take_share(0.1)
@given(changed_inputs(), st.integers(0, 9).map(lambda number: number == 0))
def test_changed_inputs_yield_a_result_or_an_error(
    files: tuple[str, bool, dict[str, bytes]], is_imported: bool
) -> None:
    read_or_import(*files, is_imported)


@pytest.mark.long
@pytest.mark.parametrize("name", [path.name for path in sorted(INPUTS.iterdir())])
def test_unchanged_inputs_are_read(name: str, tmp_path: Path) -> None:
    for each, content in read_inputs().items():
        (tmp_path / each).write_bytes(content)
    call_reader(tmp_path / name, tmp_path, name.startswith("robot"), is_imported=False)
