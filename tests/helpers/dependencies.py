"""Runs scripts with only the declared dependencies of the package."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

__all__ = ["SCRIPTS", "find_undeclared", "run_without"]

CHECKOUT = Path(__file__).resolve().parents[2]
SCRIPTS = CHECKOUT / "tests" / "installed"
"""Folder of scripts that use the installed package."""
_BLOCK = """
import json, runpy, sys
sys.modules.update(dict.fromkeys(json.loads(sys.argv[1])))
runpy.run_path(sys.argv[2], run_name="__main__")
"""


def find_undeclared(extra: str = "") -> list[str]:
    """Return the installed modules that neither the package nor its extra depends on.

    Args:
        extra: Extra that is installed as well; "" for none.
    """
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pending = [(Requirement(text), "") for text in project["dependencies"]]
    pending += [(Requirement(text), "") for text in project["optional-dependencies"].get(extra, [])]
    declared = {"vkc-pin"}
    seen = set[tuple[str, str]]()
    while pending:
        requirement, parent_extra = pending.pop()
        if requirement.marker and not requirement.marker.evaluate({"extra": parent_extra}):
            continue
        name = _normalize(requirement.name)
        declared.add(name)
        for option in ("", *requirement.extras):
            if (name, option) not in seen:
                seen.add((name, option))
                pending += [(Requirement(text), option) for text in _read_requirements(name)]
    return sorted(
        module
        for module, owners in metadata.packages_distributions().items()
        if module.isidentifier() and declared.isdisjoint(map(_normalize, owners))
    )


def run_without(modules: list[str], script: Path, folder: Path) -> None:
    """Run a script in `folder` in a process that cannot import some modules."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(map(str, (CHECKOUT, CHECKOUT / "tests")))
    }
    command = [sys.executable, "-c", _BLOCK, json.dumps(modules), str(script)]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def _read_requirements(name: str) -> list[str]:
    try:
        return metadata.requires(name) or []
    except metadata.PackageNotFoundError:  # for another platform
        return []


def _normalize(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
