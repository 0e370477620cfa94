"""Writes the reference pages of all packages, docs/api/packages/*.md, from their modules."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE, FOLDER = ROOT / "vkc_pin", ROOT / "docs" / "api" / "packages"


def packages() -> dict[str, dict[str, Path]]:
    """Return package → full module name → file; "package" stands for the top-level modules."""
    found: dict[str, dict[str, Path]] = {}
    for file in sorted(
        PACKAGE.rglob("*.py"), key=lambda file: (file.parent, file.name != "__init__.py", file.name)
    ):
        parts = file.relative_to(ROOT).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__init__")
        if name != "vkc_pin" and file.name != "__main__.py":  # importing it runs it
            found.setdefault(parts[1] if len(parts) > 2 else "package", {})[name] = file
    return found


def find_reexports(file: Path) -> dict[str, list[str]]:
    """Return module → names that a package's `__init__.py` imports from it and documents."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return {
        node.module: [a.name for a in node.names]
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module
    }


def page(package: str, files: dict[str, Path]) -> str:
    """Return the page of a package."""
    own = f"vkc_pin.{package}"
    reexports = find_reexports(files[own]) if own in files else {}
    title = "Top-level modules" if package == "package" else f"`{package}`"
    blocks = [f"# {title}\n"]
    for name in files:
        left_out = (
            f"   :exclude-members: {', '.join(reexports[name])}\n" if name in reexports else ""
        )
        heading = "" if name == own else f"## {name.removeprefix('vkc_pin.')}\n\n"
        blocks.append(f"{heading}```{{eval-rst}}\n.. automodule:: {name}\n{left_out}```\n")
    return "\n".join(blocks)


def write() -> None:
    """Write missing and outdated pages of packages, and delete those of removed packages."""
    FOLDER.mkdir(exist_ok=True)
    pages = {
        FOLDER / f"{package}.md": page(package, files) for package, files in packages().items()
    }
    for file in set(FOLDER.glob("*.md")) - set(pages):
        file.unlink()
    for file, text in pages.items():
        if not file.is_file() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")
