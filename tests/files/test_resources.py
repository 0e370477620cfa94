from __future__ import annotations

from pathlib import Path

import pytest

from vkc_pin.errors import UnknownNameError
from vkc_pin.files.resources import available, find, folder


def test_what_travels_with_the_package() -> None:
    assert {"door", "drawer"} <= set(available("scenes", "*.yaml"))
    assert "husky_ur5e" in available("robots", "*")
    for kind, pattern in (("scenes", "*.yaml"), ("robots", "*")):
        for name, path in available(kind, pattern).items():
            assert path.exists()
            assert path.stem == name
            assert path.parent == folder(kind)


def test_names_work_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = find("scenes", "*.yaml", "door", what="scene")
    monkeypatch.chdir(tmp_path)
    assert find("scenes", "*.yaml", "door", what="scene") == before
    assert before.is_absolute()


def test_a_name_that_does_not_exist() -> None:
    with pytest.raises(UnknownNameError, match=r"there is no scene 'draw'; did you mean 'drawer'\?") as caught:
        find("scenes", "*.yaml", "draw", what="scene")
    assert set(caught.value.choices) == set(available("scenes", "*.yaml"))


def test_an_installed_package_has_them_inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside = tmp_path / "site-packages" / "vkc_pin"
    (inside / "scenes").mkdir(parents=True)
    (inside / "scenes" / "own.yaml").write_text("")
    monkeypatch.setattr("vkc_pin.files.resources.__file__", str(inside / "files" / "resources.py"))
    assert folder("scenes") == inside / "scenes"
    assert list(available("scenes", "*.yaml")) == ["own"]
    assert folder("robots") == inside.parent / "robots"  # a source tree has them beside the package
