from __future__ import annotations

import sys

import pytest

import vkc_pin as vkc
from vkc_pin.importing.extras import extra


def test_a_package_that_is_there_is_returned() -> None:
    assert extra("yaml", what="nothing").safe_load("a: 1") == {"a": 1}


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(vkc.InputError) as caught:
        extra("coacd", what="cutting a mesh", file="robot.urdf")
    assert 'pip install "vkc-pin[import]"' in str(caught.value)
    assert caught.value.file == "robot.urdf"
    assert "cutting a mesh needs the Python package coacd" in str(caught.value)
