"""Imports corrupted SDF, MJCF, URDF, xacro and mesh files."""

from __future__ import annotations

import functools
import os
import random
import re
import tempfile
import warnings
from pathlib import Path
from typing import Any

import trimesh

from vkc_pin.importing import import_home, import_object, import_robot
from vkc_pin.importing.objects.clean_up import rename_for_scenes
from vkc_pin.importing.objects.object_reading import read_object
from vkc_pin.importing.robots.sources import read_source

from .files import DAE
from .mutate import corrupt

__all__ = ["FILES", "make_case", "make_neighbor_files", "run"]

OTHER_XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><material name="m"/></robot>'
IMPORT_SHARE = 0.1  # share of cases that are imported; the others are only read
_NAMED = re.compile(r'(?<=name=")[^"]*(?=")')
_TEXTS = """ |.|..|../../evil|/etc/evil|a/b|a\\b|con|CON|nul.txt|-rf|~|é|ü|кухня|柜子|🚪
á|&#8238;evil|&#8232;|&#133;|&#10;free: true|&#13;&#10;|&#9;|&quot;/&gt;&lt;link name=&quot;x
&amp;|&lt;|'|{x: 1}|- a|# a|: |!!python/object:os.system|null|true|1|1e5|.nan|%s|{0}|$(find x)
${1/0}|world|__model__|tool|floor|base"""
NAMES = ("", *_TEXTS.replace("\n", "|").split("|"), "x" * 64, "x" * 255, "é" * 200, "x" * 70_000)
"""Names, escaped as in an XML attribute."""
FILES = {
    path.name: path.read_text(encoding="utf-8")
    for path in sorted(Path(__file__).with_name("inputs").iterdir())
}


@functools.cache
def make_neighbor_files() -> dict[str, bytes]:
    """Return the files beside those of `FILES`, by name."""
    box = trimesh.creation.box((0.05, 0.05, 0.2))
    contents = {f"part.{kind}": box.export(file_type=kind) for kind in ("stl", "obj")}
    contents["part.dae"] = DAE
    contents["other.xacro"] = OTHER_XACRO
    return {
        name: text if isinstance(text, bytes) else text.encode() for name, text in contents.items()
    }


def make_case(rng: random.Random) -> dict[str, Any]:
    """Return a case: a file and its neighbors, one of which is changed."""
    name = rng.choice(tuple(FILES))
    files = {name: FILES[name].encode(), **make_neighbor_files()}
    file_name = name
    match rng.randrange(8):
        case 0 | 1 | 2:
            files[name] = corrupt(rng, files[name])
        case 3:
            other = rng.choice([neighbor for neighbor in files if neighbor != name])
            files[other] = corrupt(rng, files[other])
        case 4 | 5:
            files[name] = _rename(rng, FILES[name]).encode("utf-8", "replace")
        case 6:
            file_name = rng.choice(
                ("ü", "x\nfree: true\n#", "con", "x" * 240, "-a", " ", "\x1b[2J")
            )
            file_name += Path(name).suffix
            files[file_name] = files.pop(name)
        case _:
            files[name] = _multiply_element(rng, FILES[name]).encode()
    return {
        "file": file_name,
        "kind": Path(name).stem,
        "content": {key: data.decode("latin-1") for key, data in files.items()},
        "plan": rng.random() < IMPORT_SHARE,
    }


def _rename(rng: random.Random, text: str) -> str:
    """Rename one or two elements wherever their names occur."""
    names = sorted(set(_NAMED.findall(text)))
    for old in rng.sample(names, min(len(names), rng.choice((1, 1, 2)))):
        new = rng.choice((*NAMES, *names))
        text = re.sub(rf'(?<=")(?:{re.escape(old)})(?=")', lambda _, new=new: new, text)
        text = text.replace(f">{old}<", f">{new}<")
    return text


def _multiply_element(rng: random.Random, text: str) -> str:
    """Nest or repeat an element many times."""
    match = rng.choice(list(re.finditer(r"<(\w+)[ >]", text)))
    count, tag = rng.choice((50, 600, 5000, 100_000)), match[1]
    if rng.random() < 0.5:
        new = f"<{tag}>" * count + f"</{tag}>" * count
    else:
        new = f"<{tag}/>" * min(count, 5000)
    return text[: match.start()] + new + text[match.start() :]


def run(case: dict[str, Any]) -> str:
    """Read or import the file, and check that nothing is written outside the target folder."""
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root, "files")
        folder.mkdir()
        for name, text in case["content"].items():
            (folder / name).write_bytes(text.encode("latin-1"))
        before = _list_files(Path(root))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return _import(folder / case["file"], case["kind"], Path(root), case["plan"])
        finally:
            new = _list_files(Path(root)) - before
            assert all(name.startswith(("out/", "scratch/")) for name in new), sorted(new)
            assert not any(name.startswith(".") for name in os.listdir(root)), os.listdir(root)  # noqa: PTH208


def _import(file: Path, kind: str, root: Path, complete: bool) -> str:
    if kind == "robot":
        if complete:
            import_robot(file, root / "out", samples=100, most_pieces=1)
        else:
            read_source(file, root / "scratch", packages={}, arguments={})
    elif not complete:
        rename_for_scenes(read_object(file, free=True))
    elif file.suffix == ".xml":
        import_home(file, root / "out", most=1)
    else:
        import_object(file, root / "out", most=1)
    return "imported" if complete else "loaded"


def _list_files(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if not file.is_dir()}
