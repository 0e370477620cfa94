"""Tests the contents and the dependencies of the installed package."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.dependencies import SCRIPTS, find_undeclared, run_without
from packaging.requirements import Requirement

CHECKOUT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    return tomllib.loads((CHECKOUT / "pyproject.toml").read_text())


def test_command_is_declared_and_exists() -> None:
    (entry,) = metadata.entry_points(group="console_scripts", name="vkc-pin")
    assert entry.value == "vkc_pin.cli:main"
    assert callable(entry.load())


def test_dependencies_are_ranges(project: dict[str, Any]) -> None:
    for text in project["project"]["dependencies"]:
        specifiers = Requirement(text).specifier
        operators = {specifier.operator for specifier in specifiers}
        assert operators == {">=", "<"}, text
        assert metadata.version(Requirement(text).name) in specifiers, text


@pytest.mark.parametrize(
    ("extra", "script"),
    [("import", "meshes"), pytest.param("import", "imports", marks=pytest.mark.long)],
)
def test_declared_dependencies_suffice(extra: str, script: str, tmp_path: Path) -> None:
    """Optional dependencies of dependencies, such as trimesh's, are declared or not required."""
    modules = find_undeclared(extra)
    assert {"pytest", "sphinx"} & set(modules)
    assert "trimesh" not in modules
    run_without([*modules, "networkx"], SCRIPTS / f"{script}.py", tmp_path)


def test_mesh_that_needs_an_extra_names_it(tmp_path: Path) -> None:
    script = tmp_path / "load.py"
    script.write_text(
        "from pathlib import Path\n"
        "from vkc_pin import InputError\n"
        "from vkc_pin.world.files.meshes import load_mesh\n"
        "text = '# Größe\\nv 0 0 0\\nv 1 0 0\\nv 1 1 0\\nv 0 1 0\\nf 1 2 3\\nf 1 3 4\\n'\n"
        "Path('mesh.obj').write_text(text, encoding='utf-8')\n"
        "assert len(load_mesh('mesh.obj').faces) == 2\n"
        "Path('mesh.obj').write_text(text, encoding='latin-1')\n"
        "concave = 'v 0 0 0\\nv 2 0 0\\nv 0.2 0.2 0\\nv 0 2 0\\nf 1 2 3 4\\n'\n"
        "Path('concave.obj').write_text(concave, encoding='utf-8')\n"
        "for name in ('mesh.obj', 'concave.obj'):\n"
        "    try:\n"
        "        load_mesh(name)\n"
        "    except InputError as error:\n"
        "        assert 'the extra `import`' in str(error), error\n"
        "    else:\n"
        "        raise AssertionError(name)\n",
        encoding="utf-8",
    )
    run_without(find_undeclared(), script, tmp_path)


def test_build_and_runtime_dependencies_have_the_same_ranges(project: dict[str, Any]) -> None:
    """Pip then installs the versions that the extensions are compiled against."""
    build = {r.name: r.specifier for r in map(Requirement, project["build-system"]["requires"])}
    run = {r.name: r.specifier for r in map(Requirement, project["project"]["dependencies"])}
    assert build["libpinocchio"] == run["pin"]
    assert build["casadi"] == run["casadi"]
    assert build["cmeel-boost"] == run["cmeel-boost"]
    assert build["libcoal"] == run["coal"]


def test_a_dependency_has_one_range_everywhere(project: dict[str, Any]) -> None:
    """The lowest versions of all extras can be installed together: `make test-lowest`."""
    extras = project["project"]["optional-dependencies"]
    texts = [*project["project"]["dependencies"], *project["build-system"]["requires"]]
    texts += [text for name, own in extras.items() if name != "peers" for text in own]
    ranges: dict[str, set[str]] = {}
    for requirement in map(Requirement, texts):
        lowest = [one.version for one in requirement.specifier if one.operator == ">="]
        assert len(lowest) == 1, requirement
        ranges.setdefault(requirement.name, set()).add(str(requirement.specifier))
    assert {name: own for name, own in ranges.items() if len(own) > 1} == {}


def test_lowest_versions_are_exact(project: dict[str, Any]) -> None:
    """`make test-lowest` demands the lower bound of each range, not what pip prefers."""
    done = subprocess.run(
        ["make", "--dry-run", "VENV=absent", "VERSIONS=lowest", "absent/installed.stamp"],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=True,
    )
    (command,) = (line for line in done.stdout.splitlines() if "project dependencies" in line)
    command = command.partition(" > ")[0].replace("absent/bin/python", sys.executable)
    printed = subprocess.run(
        command, shell=True, cwd=CHECKOUT, capture_output=True, text=True, check=True
    )
    found = {r.name: str(r.specifier) for r in map(Requirement, printed.stdout.split())}
    for requirement in map(Requirement, project["project"]["dependencies"]):
        (lowest,) = (one.version for one in requirement.specifier if one.operator == ">=")
        assert found[requirement.name] == f"=={lowest}"


def test_conda_recipe_requires_the_same_packages(project: dict[str, Any]) -> None:
    names = {"matplotlib": "matplotlib-base", "meshcat": "meshcat-python", "pin": "pinocchio"}
    names |= {"pin-pink": "pink", "PyYAML": "pyyaml"}
    recipe = yaml.safe_load((CHECKOUT / "tools/conda/recipe.yaml").read_text(encoding="utf-8"))
    found = {text.partition(" ")[0] for text in recipe["requirements"]["run"]} - {"python"}
    required = {Requirement(text).name for text in project["project"]["dependencies"]}
    assert found == {names.get(name, name) for name in required - {"cmeel-boost"}}


def test_messages_refer_to_no_file_of_the_checkout() -> None:
    """The installed package comes without the pages of the documentation."""
    texts = [
        node.value
        for path in (CHECKOUT / "vkc_pin").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    assert not [text for text in texts if re.search(r"docs/\w+\.md", text)]


def build(kind: str, folder: Path) -> Path:
    """Build an sdist, or a wheel without compiled modules."""
    settings = {f"cmake.define.VKC_PIN_BUILD_{module}": "OFF" for module in ("CPIN", "DISTANCES")}
    code = f"import scikit_build_core.build as b; b.build_{kind}({str(folder)!r}, {settings})"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = folder.iterdir()
    return built


@pytest.mark.long
def test_sdist_is_small(tmp_path: Path) -> None:
    assert build("sdist", tmp_path).stat().st_size < 8e6


def test_wheel_is_small_and_contains_robots_and_scenes(tmp_path: Path) -> None:
    """With the compiled modules (1.1 MB) the wheel is smaller than 3 MB."""
    wheel = build("wheel", tmp_path)
    assert wheel.stat().st_size < 1.9e6
    names = set(zipfile.ZipFile(wheel).namelist())
    assert "vkc_pin/py.typed" in names
    for kind in ("robots", "scenes"):
        files = {
            p.relative_to(CHECKOUT)
            for p in (CHECKOUT / kind).rglob("*")
            if p.is_file() and "__pycache__" not in p.parts
        }
        assert files
        assert {f"vkc_pin/{path.as_posix()}" for path in files} <= names
    assert not [
        name for name in names if name.startswith("tests/") or name.endswith((".cpp", ".hpp"))
    ]
