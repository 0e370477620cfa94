from __future__ import annotations

import shlex
import sys
import types
from importlib.metadata import requires
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement

import vkc_pin as vkc
from vkc_pin.planning.base_paths.base_path import shortest_path
from vkc_pin.planning.base_paths.grid import BaseGrid
from vkc_pin.utils import optional_imports


def find_path() -> object:
    grid = BaseGrid([], [], [], (-2.0, 2.0, -2.0, 2.0), 0.0, cells=9)
    return shortest_path(grid, [-1.0, -1.0, 0.0], np.array([[1.0, 1.0, 0.5]]))


def test_missing_compiled_modules_raise(monkeypatch: pytest.MonkeyPatch) -> None:
    def raise_import_error(name: str) -> types.ModuleType:
        raise ImportError(f"no {name}")

    with monkeypatch.context() as patch:
        patch.setattr(optional_imports, "import_module", raise_import_error)
        with pytest.raises(
            vkc.BuildError, match=r"_driving cannot be imported \(no .*compiler.*pip install"
        ):
            find_path()
    assert find_path() is not None


def test_incompatible_library_releases_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "casadi-3.9.1.dist-info").mkdir()
    text = "Metadata-Version: 2.1\nName: casadi\nVersion: 3.9.1\n"
    (tmp_path / "casadi-3.9.1.dist-info" / "METADATA").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(sys.modules, "vkc_pin.planning.base_paths._driving", None)
    expected = r"does not fit .* casadi 3\.9\.1 \(.*pip install 'casadi<3\.9,>=3\.8', or"
    with pytest.raises(vkc.BuildError, match=expected):
        find_path()


@pytest.mark.parametrize("name", ["mujoco", "mujoco.inside"])
def test_missing_packages_name_the_extra(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(vkc.InputError) as caught:
        optional_imports.import_optional(
            name, "import", purpose="cutting a mesh", file="robot.urdf", field="mesh"
        )
    found = {requirement.name for requirement in map(Requirement, requires("vkc-pin") or ())}
    assert {"mujoco", "xacro"} <= found
    command = shlex.split(str(caught.value.expected).partition(" (")[0])
    assert command[:2] == ["pip", "install"]
    asked = {Requirement(one).name for one in command[2:]}
    assert asked == {"charset-normalizer", "mapbox_earcut", "mujoco", "xacro"}
    assert caught.value.expected.endswith("(the extra `import`)")
    assert (caught.value.file, caught.value.field) == ("robot.urdf", "mesh")
    assert "cutting a mesh needs the Python package mujoco" in str(caught.value)
