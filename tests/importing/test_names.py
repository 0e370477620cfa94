"""Tests that hostile element and file names yield distinct, portable file names."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from xml.sax.saxutils import quoteattr

import pytest
import yaml

import vkc_pin as vkc

NAMES = (
    *(
        "../../evil",
        "/etc/evil",
        "a b",
        "a+b",
        "é",
        "ü",
        "CON",
        "con",
        "\u67dc",
        "x" * 300,
        "é" * 200,
    ),
    *(
        '"/><link name="y',
        "{x: 1}",
        "- a",
        "# a",
        "a: b",
        "\u202ea",
        "a\nfree: true",
        "null",
        "!!x",
    ),
)
PORTABLE = re.compile(r"[A-Za-z0-9_.-]{1,80}")


def format_box(name: str, size: str, at: str) -> str:
    shape = f'<origin xyz="{at}"/><geometry><box size="{size}"/></geometry>'
    return f"<link name={quoteattr(name)}><collision>{shape}</collision></link>"


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
    parts = [format_box("case", "0.4 0.5 3", "0 0 1.5")]
    for k, name in enumerate(NAMES):
        parts += [format_box(name, "0.02 0.4 0.1", "0.22 0 0")]
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
    parts = [format_box("root", "8 8 0.01", "0 0 0")]
    for k, name in enumerate(NAMES):
        size, at = "0.1 0.1 0.1", f"{0.3 * (k % 7) - 3} {0.5 * (k // 7) + 2} 0.2"
        box, kind = format_box(name, size, "0 0 0"), "floating" if k < 3 else "fixed"
        shape = box[box.index("<collision>") : box.index("</link>")]
        parts += [box.replace(shape, 2 * shape)]
        parts += [format_joint(name, kind, "root", name, at, "1 0 0")]
    text = f'<robot name="h">{"".join(parts)}</robot>'
    (tmp_path / "h.urdf").write_text(text, encoding="utf-8")
    imported = vkc.importing.import_home(tmp_path / "h.urdf", tmp_path / "out", most=1)
    check_file_names(tmp_path / "out", "h.urdf")
    names = [*imported.scene.objects, *imported.scene.obstacle_names]
    assert len(set(names)) == len(names) >= len(NAMES)


def test_links_of_a_robot_keep_their_names(tmp_path: Path) -> None:
    file = Path(__file__).parents[1] / "fuzz" / "inputs" / "robot.urdf"
    text = file.read_text(encoding="utf-8")
    for k, name in enumerate(NAMES[4:10]):
        text = text.replace(f'"l{k}"', quoteattr(name))
    (tmp_path / "r.urdf").write_text(text, encoding="utf-8")
    imported = vkc.importing.import_robot(tmp_path / "r.urdf", tmp_path / "out", samples=100)
    check_file_names(tmp_path / "out", "r.urdf")
    assert {*NAMES[4:10]} <= {*imported.robot.links}


@pytest.mark.parametrize(
    "stem", ["x\nfree: true\n#", "\x1b[2J", "x" * 240, "- a", "con", "é", "#", " "]
)
def test_file_names_cannot_add_fields_to_the_description(
    tmp_path: Path, stem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = Path(__file__).parents[1] / "fuzz" / "inputs" / "cabinet.urdf"
    (tmp_path / "in").mkdir()
    source = tmp_path / "in" / f"{stem}.urdf"
    source.write_bytes(file.read_bytes())
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    imported = vkc.importing.import_object(source, most=1)
    check_file_names(imported.file.parent.resolve())
    assert not imported.object.free
    assert yaml.safe_load(imported.file.read_text(encoding="utf-8")).keys() == {
        "urdf",
        "attachments",
    }
