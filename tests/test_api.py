from __future__ import annotations

import importlib
import inspect
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import vkc_pin as vkc

ROOT = Path(__file__).resolve().parent.parent
# Compiled, a bare folder, and a process of its own.
SCRIPTS = ("vkc_pin.cpin._cpin", "vkc_pin.benchmarks", "vkc_pin.visualization.server")
MODULES = [name for _, name, _ in pkgutil.walk_packages(vkc.__path__, "vkc_pin.") if name not in SCRIPTS]


@pytest.mark.parametrize("name", ["vkc_pin", *MODULES])
def test_every_module_lists_its_public_names(name: str) -> None:
    if name.endswith(".upstream"):
        pytest.importorskip("pinocchio.casadi")
    module = importlib.import_module(name)
    assert module.__doc__
    names = (
        getattr(module, "__all__", []) if hasattr(module, "__path__") else module.__all__
    )  # most wings hand out nothing themselves
    assert sorted(set(names)) == sorted(names)
    for public in names:
        assert hasattr(module, public), public


def test_every_public_name_is_documented() -> None:
    for public in vkc.__all__:
        thing = getattr(vkc, public)
        if inspect.isclass(thing) or inspect.isfunction(thing):
            assert inspect.getdoc(thing), public
    for name in ("plan", "build", "load_scene", "load_robot", "load_object", "validate"):
        assert "Raises:" in (getattr(vkc, name).__doc__ or ""), name


@pytest.mark.parametrize("name", ["plan", "build", "load_robot"])
def test_options_are_keyword_only(name: str) -> None:
    positional = [p for p in inspect.signature(getattr(vkc, name)).parameters.values() if p.kind is not p.KEYWORD_ONLY]
    assert len(positional) <= 2


def test_importing_the_package_leaves_heavy_things_alone() -> None:
    code = "import sys, vkc_pin; print([m for m in ('trimesh', 'meshcat', 'matplotlib', 'scipy', 'tqdm') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"
