"""Tests that imports overwrite only their own earlier output."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.importing.targets import check_target, format_comment, get_origin_marker


def test_only_output_of_the_same_command_may_be_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    check_target(folder, "import-home", force=False)
    folder.mkdir()
    check_target(folder, "import-home", force=False)
    (folder / "b.yaml").write_bytes(b"\xff\n")
    marker = f"{get_origin_marker('import-home')}.\n"
    for text, command, force, expected in (
        (
            f"# Made of x {marker}",
            "import-home",
            False,
            "--force.*an earlier output of import-home",
        ),
        (
            f"# Made of x {marker}",
            "import-robot",
            True,
            "a new or an empty folder, got other files",
        ),
        (f"no first line\n{marker}", "import-home", True, "other files"),
    ):
        (folder / "a.yaml").write_text(text, encoding="utf-8")
        with pytest.raises(vkc.InputError, match=expected) as caught:
            check_target(folder, command, force=force)
        assert caught.value.field == "folder"
    (folder / "a.yaml").write_text(f"# Made of x {marker}", encoding="utf-8")
    check_target(folder, "import-home", force=True)
    with pytest.raises(vkc.InputError, match="got a file"):
        check_target(folder / "a.yaml", "import-home", force=True)


@given(st.text())
def test_comment_is_one_line_with_the_text(text: str) -> None:
    line = format_comment(text)
    assert line.startswith("# ")
    assert line.splitlines(keepends=True) == [line]
    assert line.isascii() or line[:-1].isprintable()
    for loader in (yaml.SafeLoader, yaml.CSafeLoader):
        assert yaml.load(f"{line}free: false\n", Loader=loader) == {"free": False}
    escaped = line[2:-1].encode("ascii", "backslashreplace")
    assert escaped.decode("unicode_escape") == text


@pytest.mark.parametrize(
    "import_file",
    [vkc.importing.import_object, vkc.importing.import_robot, vkc.importing.import_home],
)
def test_folders_are_named_as_what_cannot_be_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, import_file: Callable[[str], object]
) -> None:
    """The default target of an import from the current folder has the folder's name."""
    monkeypatch.chdir(tmp_path)
    Path("cabinet").mkdir()
    Path("cabinet/mobility.urdf").touch()
    with pytest.raises(vkc.InputError, match=r"^cabinet: file: cannot import a folder .*URDF"):
        import_file("cabinet")
