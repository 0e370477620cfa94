from __future__ import annotations

import ast
import importlib
import inspect
import os
import pkgutil
import subprocess
import sys
import types
from pathlib import Path

import pytest

import vkc_pin as vkc
from vkc_pin.utils import disk_cache

ROOT = Path(__file__).resolve().parent.parent
# Compiled modules, and modules that run as scripts.
COMPILED = tuple(
    f"vkc_pin.{name}"
    for name in (
        "planning.kinematics._cpin",
        "world.collision._distances",
        "planning.base_paths._driving",
        "planning.solver._kkt",
        "planning.retiming._speeds",
    )
)
SCRIPTS = (*COMPILED, "vkc_pin.visualization.server", "vkc_pin.cli.__main__")
MODULES = [
    name for _, name, _ in pkgutil.walk_packages(vkc.__path__, "vkc_pin.") if name not in SCRIPTS
]
BARE = set(vars(types.ModuleType("bare"))) | {
    "__builtins__",
    "__cached__",
    "__file__",
    "__path__",
    "annotations",
}


def _submodules(name: str) -> set[str]:
    return {
        other.rpartition(".")[2]
        for other in (*MODULES, *SCRIPTS)
        if other.rpartition(".")[0] == name
    }


@pytest.mark.parametrize("name", ["vkc_pin", *MODULES])
def test_every_module_has_a_docstring_and_every_face_lists_its_names(name: str) -> None:
    module = importlib.import_module(name)
    assert module.__doc__
    if Path(str(module.__file__)).name != "__init__.py":
        return
    if set(vars(module)) <= BARE | _submodules(name):
        return  # a package without names of its own
    assert sorted(set(module.__all__)) == sorted(module.__all__)
    for public in module.__all__:
        assert hasattr(module, public), public


def test_every_public_name_is_documented() -> None:
    for public in vkc.__all__:
        value = getattr(vkc, public)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), public


def test_heavy_dependencies_are_loaded_on_first_use() -> None:
    heavy = (
        "casadi",
        "coal",
        "pinocchio",
        "pydantic",
        "trimesh",
        "meshcat",
        "matplotlib",
        "scipy",
        "tqdm",
    )
    loaded = f"[m for m in {heavy} if m in sys.modules]"
    steps = (f"print({loaded})", "vkc.VkcError", f"print({loaded})", "vkc.plan", f"print({loaded})")
    code = f"import sys, vkc_pin as vkc; {'; '.join(steps)}"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.splitlines() == ["[]", "[]", "['casadi', 'coal', 'pinocchio', 'pydantic']"]


def test_scene_of_known_meshes_is_loaded_without_readers_of_meshes(tmp_path: Path) -> None:
    heavy = ("trimesh", "scipy", "meshcat", "matplotlib", "mujoco")
    loaded = f"[m for m in {heavy} if m in sys.modules]"
    code = f"import sys, vkc_pin as vkc; vkc.load_scene('door'); print({loaded})"
    found = [
        subprocess.run(
            [sys.executable, "-c", code],
            cwd=ROOT,
            env={**os.environ, disk_cache.CACHE_VARIABLE: str(tmp_path)},
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        ).stdout
        for _ in range(2)
    ]
    assert "trimesh" in found[0]
    assert found[1] == "[]\n"


def test_stub_lists_the_public_names() -> None:
    tree = ast.parse((ROOT / "vkc_pin/__init__.pyi").read_text(encoding="utf-8"))
    listed = next(
        ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign)
    )
    assert sorted(listed) == sorted(vkc.__all__)
    assert set(dir(vkc)) == set(listed) - {"__version__"}
    names: dict[str, object] = {}
    exec("from vkc_pin import *", names)
    assert {name for name in names if name != "__builtins__"} == set(vkc.__all__)
    with pytest.raises(AttributeError, match="plann") as caught:
        vkc.plann  # type: ignore[attr-defined]  # noqa: B018
    # Python finds the nearest name with these two.
    assert (caught.value.name, caught.value.obj) == ("plann", vkc)


@pytest.mark.parametrize("package", ["datasets", "importing", "procedural"])
def test_no_public_function_is_named_like_a_sibling_module(package: str) -> None:
    """Importing the module would replace the function as the package's attribute."""
    owner = getattr(vkc, package)
    assert {name for _, name, _ in pkgutil.iter_modules(owner.__path__)}.isdisjoint(owner.__all__)
