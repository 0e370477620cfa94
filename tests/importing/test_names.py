"""Tests that hostile element and file names yield distinct, portable file names."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import pytest
import yaml
from helpers.texts import format_box

import vkc_pin as vkc

HOSTILE = ("../../evil", "/etc/evil", "a b", "a+b", "é", "ü", "CON", "con", "\u67dc", "x" * 300)
YAML = ('"/><link name="y', "{x: 1}", "- a", "# a", "\u202ea", "a\nfree: true", "null", "!!x")
NAMES = (*HOSTILE, "é" * 200, *YAML)
INPUTS = Path(__file__).parents[1] / "fuzz" / "inputs"
PORTABLE = re.compile(r"[A-Za-z0-9_.-]{1,80}")


def format_link(name: str, size: str, at: str, count: int = 1) -> str:
    """Return a link with `count` equal shapes."""
    return f"<link name={quoteattr(name)}>{count * format_box(size, at)}</link>"


def format_joint(name: str, kind: str, parent: str, child: str, at: str, axis: str) -> str:
    return (
        f"<joint name={quoteattr(name)} type={quoteattr(kind)}><origin xyz={quoteattr(at)}/>"
        f"<parent link={quoteattr(parent)}/><child link={quoteattr(child)}/>"
        f'<axis xyz="{axis}"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint>'
    )


def check_file_names(folder: Path, *others: str) -> None:
    """Check that only `others` exist beside the folder, and that its file names are portable."""
    assert {path.name for path in folder.parent.iterdir()} == {folder.name, *others}
    paths = [path.relative_to(folder) for path in folder.rglob("*")]
    assert all(PORTABLE.fullmatch(part) for path in paths for part in path.parts), paths
    assert len({str(path).lower() for path in paths}) == len(paths)


def test_links_of_an_object_get_distinct_names(tmp_path: Path) -> None:
    parts = [format_link("case", "0.4 0.5 3", "0 0 1.5")]
    for k, name in enumerate(NAMES):
        parts += [format_link(name, "0.02 0.4 0.1", "0.22 0 0")]
        parts += [format_joint(name, "prismatic", "case", name, f"0 0 {0.1 + 0.13 * k}", "1 0 0")]
    text = f"<robot name={quoteattr(NAMES[0])}>{''.join(parts)}</robot>"
    (tmp_path / "o.urdf").write_text(text, encoding="utf-8")
    imported = vkc.importing.import_object(tmp_path / "o.urdf", tmp_path / "out", most=1)
    check_file_names(tmp_path / "out", "o.urdf")
    assert len(set(imported.object.coordinates.names)) == len(NAMES)
    document = yaml.safe_load(imported.file.read_text(encoding="utf-8"))
    assert document.keys() == {"urdf", "attachments"}
    links = ElementTree.parse(imported.file.parent / document["urdf"]).findall("link")
    assert len({link.get("name") for link in links}) == len(NAMES) + 1


def test_obstacles_and_objects_of_a_home_get_distinct_names(tmp_path: Path) -> None:
    parts = [format_link("root", "8 8 0.01", "0 0 0")]
    for k, name in enumerate(NAMES):
        at, kind = f"{0.3 * (k % 7) - 3} {0.5 * (k // 7) + 2} 0.2", "fixed" if k > 2 else "floating"
        parts += [format_link(name, "0.1 0.1 0.1", "0 0 0", 2)]
        parts += [format_joint(name, kind, "root", name, at, "1 0 0")]
    text = f'<robot name="h">{"".join(parts)}</robot>'
    (tmp_path / "h.urdf").write_text(text, encoding="utf-8")
    imported = vkc.importing.import_home(tmp_path / "h.urdf", tmp_path / "out", most=1)
    check_file_names(tmp_path / "out", "h.urdf")
    names = [*imported.scene.objects, *imported.scene.obstacle_names]
    assert len(set(names)) == len(names) >= len(NAMES)


def test_links_of_a_robot_keep_their_names(tmp_path: Path) -> None:
    text = (INPUTS / "robot.urdf").read_text(encoding="utf-8")
    for k, name in enumerate(NAMES[4:10]):
        text = text.replace(f'"l{k}"', quoteattr(name))
    (tmp_path / "r.urdf").write_text(text, encoding="utf-8")
    imported = vkc.importing.import_robot(tmp_path / "r.urdf", tmp_path / "out", samples=100)
    check_file_names(tmp_path / "out", "r.urdf")
    assert {*NAMES[4:10]} <= {*imported.robot.links}


# Its only grasp is quickly found.
DRAWER = (
    f'<robot name="r">{format_link("case", "0.3 0.3 0.3", "0 0 0")}'
    f"{format_link('knob', '0.04 0.04 0.04', '0 0 0')}"
    f"{format_joint('slide', 'prismatic', 'case', 'knob', '-0.2 0 0', '-1 0 0')}</robot>"
)


@pytest.mark.parametrize(
    ("import_file", "text", "description"),
    [
        (partial(vkc.importing.import_object, most=1), DRAWER, "[!s]*.yaml"),
        (
            partial(vkc.importing.import_robot, samples=20),
            (INPUTS / "robot.urdf").read_text(encoding="utf-8"),
            "robot.yaml",
        ),
        (partial(vkc.importing.import_home, most=1), DRAWER, "scene.yaml"),
    ],
    ids=["object", "robot", "home"],
)
def test_file_names_cannot_add_fields_to_the_description(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    import_file: Callable[[Path], Any],
    text: str,
    description: str,
) -> None:
    found = []
    stems = (
        "plain",
        "x\nfree: true\nfloor: false\n#\x01\udcff",
        "\x1b[2J",
        "x" * 240,
        "- a",
        "con",
        "é",
        " ",
    )
    for number, stem in enumerate(stems):
        (tmp_path / str(number)).mkdir()
        monkeypatch.chdir(tmp_path / str(number))
        source = tmp_path / f"{stem}.urdf"
        source.write_text(text, encoding="utf-8")
        import_file(source)
        (folder,) = Path.cwd().iterdir()
        check_file_names(folder)
        (file,) = folder.glob(description)
        found.append(yaml.safe_load(file.read_text(encoding="utf-8")).keys())
    assert found == [found[0]] * len(stems)
