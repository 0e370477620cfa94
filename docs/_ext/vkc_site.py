"""Adds to the site: contents, outputs of notebooks, animations and cross references."""

from __future__ import annotations

import inspect
import os
import re
import shutil
from pathlib import Path
from typing import Any

# Under autodoc, which sets TYPE_CHECKING, its first import would end half way.
import pydantic  # noqa: F401
from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode

import vkc_pin as vkc
from docs.pictures.closed_loop import execute_beside_person

ROOT = Path(__file__).resolve().parents[2]
START = "docs/index"
EXECUTED = ROOT / "out" / "notebooks"  # where the tests leave the notebooks that they have run
REDIRECT = (
    '<!DOCTYPE html>\n<meta charset="utf-8">\n<title>vkc_pin</title>\n'
    '<meta http-equiv="refresh" content="0; url={}">\n'
)


def read(app: Sphinx, name: str, source: list[str]) -> None:
    """Insert contents and animations, and replace notebooks by their executed versions."""
    if name.startswith("notebooks/"):
        run = EXECUTED / f"{Path(name).name}.ipynb"
        if run.is_file():
            source[0] = run.read_text(encoding="utf-8")
        return
    if name == START:
        lines = (ROOT / "docs" / "_contents.md").read_text(encoding="utf-8").splitlines()
        there = (
            line
            for line in lines
            if not line.endswith("*") or list((ROOT / "docs").glob(f"{line}.*"))
        )
        source[0] += "\n" + "\n".join(there)
    source[0] = re.sub(
        r"<!-- film: (\w+) -->\n!\[([^\]]*)\]\([^)]*\)",
        r'<iframe class="film" src="animations/\1.html" title="\2"></iframe>',
        source[0],
    )
    source[0] = re.sub(
        r"\[(\w+)\.md\]\((\1\.md[^)]*)\)", r"[](\2)", source[0]
    )  # the page's title instead of its file's name
    source[0] = re.sub(r"\[([^\]]*)\]\((animations/\w+\.html)\)", r'<a href="\2">\1</a>', source[0])


def find_outdated_pages(
    app: Sphinx, env: BuildEnvironment, added: set[str], changed: set[str], removed: set[str]
) -> list[str]:
    """Return the notebooks executed since they were read: the repository has no outputs."""
    notebooks = [
        name for name in env.found_docs if name.startswith("notebooks/") and name in env.all_docs
    ]
    files = {name: EXECUTED / f"{Path(name).name}.ipynb" for name in notebooks}
    return [
        name
        for name, file in files.items()
        if file.is_file() and file.stat().st_mtime > env.all_docs[name] / 1e6
    ]


def films(app: Sphinx, problem: Exception | None) -> None:
    """Add the animations, two of them planned now, and a page at the root that redirects."""
    if problem is not None or app.builder.name != "html":
        return
    folder = Path(app.outdir) / "docs" / "animations"
    recorded = ROOT / "docs" / "animations"  # not in the sdist
    if recorded.is_dir():
        shutil.copytree(recorded, folder, dirs_exist_ok=True)
    folder.mkdir(exist_ok=True)
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 1.2})])
    if not plan.success:
        raise RuntimeError(plan.summary())
    plan.to_html(folder / "door.html")
    execute_beside_person().to_html(folder / "closed_loop.html")
    (Path(app.outdir) / "index.html").write_text(REDIRECT.format(f"{START}.html"), encoding="utf-8")


def escape_docstring(
    app: Sphinx, what: str, name: str, member: Any, options: Any, lines: list[str]
) -> None:
    """Convert a docstring to reStructuredText: outside of `code`, * and | are plain characters."""
    for number, line in enumerate(lines):
        parts = re.split(r"(``[^`]*``|(?::[\w:]+:)?`[^`]*`)", line)
        for i in range(0, len(parts), 2):
            parts[i] = re.sub(r"(?<!\\)([*|])", r"\\\1", parts[i])
            parts[i] = re.sub(r"(?<=\w)_(?!\w)", r"\\_", parts[i])
        lines[number] = "".join(parts)


def reset_signature(app: Sphinx, function: Any, bound: bool) -> None:
    """Restore the first parameter, which `autodoc_preserve_defaults` removes from bound methods."""
    if inspect.ismethod(function):
        vars(function.__func__).pop("__signature__", None)


def resolve(
    app: Sphinx, env: BuildEnvironment, node: addnodes.pending_xref, content: nodes.Node
) -> nodes.Node | None:
    """Resolve names by their last part: `vkc_pin.Plan` is defined in `vkc_pin.planning.plan`."""
    if node.get("refdomain") != "py":
        return None
    target = str(node["reftarget"])
    if "." in target and not target.startswith("vkc_pin"):
        return None
    last = target.rpartition(".")[2]
    known = env.domains.python_domain.objects
    found = [
        name
        for name in known
        if name.rpartition(".")[2] == last
        and known[name].objtype in ("class", "function", "exception")
    ]
    owners = ("", "datasets.", "importing.", "procedural.")
    public = [name for name in found if name in {f"vkc_pin.{owner}{last}" for owner in owners}]
    public = public or found
    if len(public) != 1:
        return None
    entry = known[public[0]]
    return make_refnode(
        app.builder, str(node["refdoc"]), entry.docname, entry.node_id, content, public[0]
    )


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect all of it."""
    os.environ.setdefault("MPLBACKEND", "agg")
    app.connect("source-read", read)
    app.connect("env-get-outdated", find_outdated_pages)
    app.connect("build-finished", films)
    app.connect("autodoc-process-docstring", escape_docstring, priority=400)
    app.connect("autodoc-before-process-signature", reset_signature, priority=900)
    app.connect("missing-reference", resolve)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
