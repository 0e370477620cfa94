"""The layout keeps to its rules."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "vkc_pin"


def test_every_module_has_its_tests() -> None:
    """docs/contributing.md lists the modules that are tested through others, with files that there are, and the reason."""
    page = (ROOT / "docs" / "contributing.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w/]+)` \| (.+?) \| (.+?) \|$", page, re.MULTILINE)
    modules = {
        file.relative_to(PACKAGE).with_suffix("")
        for file in PACKAGE.rglob("*.py")
        if file.name != "__init__.py"
    }
    missing = {
        str(name)
        for name in modules
        if not (ROOT / "tests" / name.parent / f"test_{name.name}.py").is_file()
    }
    assert missing == {name for name, _, _ in rows}
    for _, files, why in rows:
        named = re.findall(r"`([\w/]+\.py)`", files)
        assert named
        assert [name for name in named if not (ROOT / "tests" / name).is_file()] == []
        assert why
