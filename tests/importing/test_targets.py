"""No import writes over what it has not made."""

from __future__ import annotations

from pathlib import Path

import pytest

import vkc_pin as vkc
from vkc_pin.importing.targets import check_target, made_by


def test_only_what_the_same_command_made_may_be_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    check_target(folder, "import-home", force=False)
    folder.mkdir()
    check_target(folder, "import-home", force=False)
    (folder / "a.yaml").write_text(f"# Made of x {made_by('import-home')}.\n", encoding="utf-8")
    (folder / "b.yaml").write_bytes(b"\xff\n")
    check_target(folder, "import-home", force=True)
    for command, force, expected in (
        ("import-home", False, r"--force.*got what import-home made before"),
        ("import-robot", True, r"expected a new or an empty folder, got other files"),
    ):
        with pytest.raises(vkc.InputError, match=expected) as caught:
            check_target(folder, command, force=force)
        assert caught.value.field == "folder"
    (folder / "a.yaml").write_text(f"no first line\n{made_by('import-home')}.\n", encoding="utf-8")
    with pytest.raises(vkc.InputError, match="other files"):
        check_target(folder, "import-home", force=True)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text(f"# Made of x {made_by('import-home')}.\n", encoding="utf-8")
    with pytest.raises(vkc.InputError, match="got a file"):
        check_target(tmp_path / "mine", "import-home", force=True)
