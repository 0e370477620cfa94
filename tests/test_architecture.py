"""Tests that imports follow the layers, and that modules and packages are documented."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from docs.pictures import architecture

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "vkc_pin"
SCRIPTS = {"vkc_pin.visualization.server", "vkc_pin.cli.__main__"}  # never imported
# Runs the import linter on the working directory instead of an editable installation.
LINT = (
    "import sys; sys.meta_path = [one for one in sys.meta_path "
    "if 'vkc_pin' not in getattr(type(one), '__module__', '')]; "
    "sys.path.insert(0, '.'); from importlinter.cli import lint_imports_command; "
    "lint_imports_command()"
)


def find_modules() -> dict[str, Path]:
    """Return every module of the package by its full name."""
    files = {
        ".".join(file.relative_to(ROOT).with_suffix("").parts): file
        for file in PACKAGE.rglob("*.py")
    }
    return {name.removesuffix(".__init__"): file for name, file in files.items()}


@cache
def parse(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", LINT, "--no-cache"]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture
def package_copy(tmp_path: Path) -> Path:
    """Return a copy of the package and its import contracts that tests may modify."""
    shutil.copytree(
        PACKAGE, tmp_path / "vkc_pin", ignore=shutil.ignore_patterns("__pycache__", "*.html")
    )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_import_contracts_refuse_forbidden_imports(package_copy: Path) -> None:
    changes = (
        ("world/files/writing.py", "from vkc_pin.world.models.robot import Robot"),
        ("world/models/robot.py", "def _late():\n    from vkc_pin.planning.plan import Plan"),
        ("world/scene/scene.py", "if TYPE_CHECKING:\n    from vkc_pin.planning.plan import Plan"),
        ("validation/distances.py", "from vkc_pin.world.task.compiler import compile_task"),
        ("planning/initialization/beam_search.py", "import casadi"),
        ("world/models/coordinates.py", "from vkc_pin.world.models import robot"),
        ("planning/nlp/problem.py", "from vkc_pin.visualization.viewer import show"),
    )
    for file, line in changes:
        with (package_copy / "vkc_pin" / file).open("a", encoding="utf-8") as stream:
            stream.write(f"\n{line}\n")
    done = lint(package_copy)
    output = done.stdout.partition("Broken contracts")
    for contract, *chains in (
        ("Imports inside the world go down", "world.files.writing -> vkc_pin.world.models.robot"),
        (
            "Every import goes down",
            "vkc_pin.world.models.robot -> vkc_pin.planning.plan",
            "vkc_pin.world.scene.scene -> vkc_pin.planning.plan",
            "vkc_pin.planning.nlp.problem -> vkc_pin.visualization.viewer",
        ),
        (
            "Validation and trajectories know neither planning nor compiled tasks",
            "vkc_pin.validation.distances -> vkc_pin.world.task.compiler",
        ),
        (
            "CasADi in planning and in terms of users alone",
            "vkc_pin.planning.initialization.beam_search -> casadi",
        ),
        ("No circles among siblings", ".coordinates -> .robot"),
    ):
        assert re.search(rf"^{contract}.* BROKEN", output[0], re.MULTILINE), output
        section = output[2].partition(f"{contract}\n---")[2].partition("\n---")[0]
        assert [chain for chain in chains if chain not in section] == [], section


def test_a_package_without_a_layer_is_refused(package_copy: Path) -> None:
    (package_copy / "vkc_pin" / "new_package").mkdir()
    (package_copy / "vkc_pin" / "new_package" / "__init__.py").touch()
    done = lint(package_copy)
    assert done.returncode != 0
    assert "new_package" in done.stdout + done.stderr


def test_names_are_imported_from_modules_and_not_from_packages() -> None:
    known = find_modules()
    packages = {name.rpartition(".")[0] for name in known if name.count(".")}
    packages.remove("vkc_pin.planning.kinematics")
    wrong = [
        f"{name}: from {node.module} import {alias.name}"
        for name, file in known.items()
        if file.name != "__init__.py" and name != "vkc_pin.cli.commands"
        for node in ast.walk(parse(file))
        if isinstance(node, ast.ImportFrom) and node.module in packages
        for alias in node.names
        if f"{node.module}.{alias.name}" not in known
    ]
    assert wrong == []


def test_calls_of_the_operating_system_are_in_one_module() -> None:
    calls = re.compile(r"/proc/|sched_|malloc_trim|prctl|import resource\n|getrusage|confstr")
    found = [name for name, file in find_modules().items() if calls.search(file.read_text())]
    assert found == ["vkc_pin.utils.system"]


def test_faces_alone_list_public_names() -> None:
    """Names of other modules are public unless they begin with an underscore."""
    listing = [
        name
        for name, file in find_modules().items()
        if re.search(r"^__all__ = ", file.read_text(encoding="utf-8"), re.MULTILINE)
        and file.name != "__init__.py"
    ]
    assert listing == []


def test_architecture_page_lists_every_package() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = text.split("## The packages")[1].split("\n## ")[0]
    first_cells = "".join(re.findall(r"^\| (`[^|]*)\|", table, re.MULTILINE))
    packages = {name.split(".")[1] for name in find_modules() if "." in name}
    assert set(re.findall(r"`(\w+)`", first_cells)) == packages


def test_architecture_diagram_is_up_to_date() -> None:
    drawn = architecture.draw()
    assert (ROOT / "docs" / "images" / "architecture.svg").read_text(encoding="utf-8") == drawn
