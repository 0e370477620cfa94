from __future__ import annotations

import errno
import os
import signal
from pathlib import Path

import pytest
from helpers.expected_errors import expect_error

from vkc_pin import InputError
from vkc_pin.world.files.writing import (
    check_inside,
    check_links,
    check_name,
    check_outputs,
    check_replaceable,
    check_writable,
    write_atomically,
    write_folder_atomically,
)


def list_paths(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_parents_are_created_and_files_replaced(tmp_path: Path, umask: int) -> None:
    path = tmp_path / "deep" / "er" / "file.txt"
    before = os.umask(umask)
    try:
        for data in (b"one, and longer", b"two"):
            assert write_atomically(path, data) == path
            assert path.read_bytes() == data
    finally:
        os.umask(before)
    assert list(path.parent.iterdir()) == [path]
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask
    for mode in (0o600, 0o640, 0o755):  # the mode of an existing file is preserved
        path.chmod(mode)
        write_atomically(path, b"after")
        assert path.stat().st_mode & 0o7777 == mode


@pytest.mark.parametrize("target_exists", [True, False], ids=["file", "dangling"])
def test_links_are_followed(tmp_path: Path, target_exists: bool) -> None:
    target, link = tmp_path / "elsewhere" / "file", tmp_path / "link"
    if target_exists:
        target.parent.mkdir()
        target.write_bytes(b"before")
    link.symlink_to(Path("elsewhere") / "file")
    assert check_writable(link) == target
    assert target.parent.exists() == target_exists
    assert write_atomically(link, b"after") == link
    assert (link.is_symlink(), target.read_bytes()) == (True, b"after")
    assert list_paths(tmp_path) == {"link", "elsewhere", "elsewhere/file"}


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("folder", "a regular file or a new one.*got a folder"),
        ("pipe", "a regular file or a new one.*got a pipe"),
        ("loop", "a regular file or a new one.*Too many levels of symbolic links"),
        ("file/plan.npz", "Not a directory"),
        ("new/", "got a folder"),
        ("new/" + "x" * 256 + "/plan.npz", "File name too long"),
        ("nul\0", "null byte"),
        ("", "got a folder"),
    ],
)
def test_invalid_paths_raise(
    tmp_path: Path, path: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    monkeypatch.chdir(tmp_path)
    before = list_paths(tmp_path)
    for write in (check_writable, lambda path: write_atomically(path, b"data")):
        with expect_error(reason):
            write(path)
    assert list_paths(tmp_path) <= before | {"new"}


def test_conflicting_outputs_raise(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("one")
    one, other = tmp_path / "one", tmp_path / "other"
    check_outputs({"--a": one, "--b": other, "--c": tmp_path / "new" / "file"})
    for again in (one, tmp_path / "new" / ".." / "one", tmp_path / "link"):
        with expect_error(r"--b: this file is named twice .*than --a"):
            check_outputs({"--a": one, "--b": again})
    with expect_error(r"--a: this file is named twice .*than PLAN"):
        check_outputs({"--a": one}, inputs={"PLAN": one})
    with expect_error(r"--b: a file cannot be a folder .*file of --a"):
        check_outputs({"--a": one, "--b": one / "two" / "three"})
    assert list_paths(tmp_path) == {"link"}


def test_failed_writes_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file.txt"
    path.write_bytes(b"before")

    def raise_disk_full(self: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(Path, "replace", raise_disk_full)
    with expect_error("no space", file=str(path)):
        write_atomically(path, b"after")
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_interrupts_are_deferred_until_the_file_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal arrives three times between writing and renaming."""
    path, replace = tmp_path / "file.txt", Path.replace

    def replace_after_interrupts(self: Path, target: Path) -> Path:
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)
        return replace(self, target)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(Path, "replace", replace_after_interrupts)
    try:
        with pytest.raises(KeyboardInterrupt):
            write_atomically(path, b"whole")
    finally:
        signal.signal(signal.SIGINT, before)
    assert path.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [path]


def test_folders_are_written_completely_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folder"
    with write_folder_atomically(target) as staging:
        (staging / "a").write_text("1")
        assert not target.exists()
    assert list_paths(target) == {".vkc-pin.json", "a"}
    with pytest.raises(FileNotFoundError), write_folder_atomically(target, force=True) as staging:
        (staging / "none" / "b").write_text("2")
    with expect_error("already exists"), write_folder_atomically(target):
        pass
    assert list_paths(target) == {".vkc-pin.json", "a"}
    write_folder(target)
    assert list_paths(target) == {".vkc-pin.json", "deep", "deep/a"}
    assert list(target.parent.iterdir()) == [target]
    with expect_error("no folder"):
        write_folder(target / "deep" / "a")


def write_folder(target: Path, force: bool = True) -> None:
    with write_folder_atomically(target, force=force) as staging:
        (staging / "deep").mkdir()
        (staging / "deep" / "a").write_text("own")


@pytest.mark.parametrize("has_manifest", [True, False])
def test_folders_with_foreign_files_are_not_replaced(tmp_path: Path, has_manifest: bool) -> None:
    target, other = tmp_path / "folder", "deep/.vkc-pin.json"
    if has_manifest:
        write_folder(target)
    (target / other).parent.mkdir(parents=True, exist_ok=True)
    (target / other).write_text("mine")
    before = list_paths(tmp_path)
    for check in (check_replaceable, write_folder):
        with expect_error("files that vkc-pin did not write", file=target, got=other):
            check(target)
    assert list_paths(tmp_path) == before


def test_files_created_during_writing_are_preserved(tmp_path: Path) -> None:
    target = tmp_path / "folder"
    write_folder(target)
    with expect_error("would delete"), write_folder_atomically(target, force=True):
        (target / "notes.txt").write_text("mine")
    assert (target / "notes.txt").read_text() == "mine"
    assert (target / "deep" / "a").exists()


def test_links_in_replaced_folders_are_not_followed(tmp_path: Path) -> None:
    target, outside = tmp_path / "folder", tmp_path / "outside"
    write_folder(target)
    (target / "deep").rename(outside)
    (target / "deep").symlink_to(outside)
    with expect_error("got deep"):
        write_folder(target)
    assert (outside / "a").exists()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"files": 3}', '{"files": [["notes.txt"]]}'])
def test_damaged_manifests_list_no_files(tmp_path: Path, text: str) -> None:
    for name in ("a", "b", "c", "d", "e"):
        (tmp_path / name).touch()
    (tmp_path / ".vkc-pin.json").write_text(text)
    with expect_error("got a, b, c and 2 more"):
        check_replaceable(tmp_path)


def test_folders_survive_a_failed_rename(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target, rename = tmp_path / "folder", Path.rename
    write_folder(target)
    before = list_paths(tmp_path)

    def fail_to_rename(self: Path, other: Path) -> Path:
        if other == target and (self / "new").exists():
            raise OSError(errno.EIO, "input/output error")
        return rename(self, other)

    monkeypatch.setattr(Path, "rename", fail_to_rename)
    with (
        expect_error("input/output error"),
        write_folder_atomically(target, force=True) as staging,
    ):
        (staging / "new").touch()
    assert list_paths(tmp_path) == before


@pytest.mark.parametrize("name", ["a", "ur5e v2.1", "Küche", "x" * 200, "a..b", "-"])
def test_valid_names_are_accepted(name: str) -> None:
    assert check_name(name, "robot") == name


@pytest.mark.parametrize(
    "name",
    ["", "..", ".a", "/a", "a/b", "a\\b", "a\0", "a\n", "\u202ea", "\ud800", "ä" * 101, None, b"a"],
)
def test_invalid_names_raise(name: str) -> None:
    with pytest.raises(InputError, match="not a plain file name") as caught:
        check_name(name, "robot", file="journal.jsonl")
    assert (caught.value.file, caught.value.field) == ("journal.jsonl", "robot")
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("target", ["..", "/etc", "../folderx", "../outside/none"])
def test_links_out_of_a_folder_raise(tmp_path: Path, target: str) -> None:
    for name in ("folder/deep", "folderx", "outside"):
        (tmp_path / name).mkdir(parents=True)
    link = tmp_path / "folder" / "link"
    link.symlink_to(target)
    with pytest.raises(InputError, match="leads out of the folder") as caught:
        check_links(tmp_path / "folder")
    assert str(caught.value.file) == str(link)
    with expect_error("leads out of the folder"):
        check_inside(link, tmp_path / "folder")


def test_links_inside_a_folder_are_accepted(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    (folder / "deep").mkdir(parents=True)
    for name, target in {"one": "file", "two": "deep", "self": ".", "deep/up": ".."}.items():
        (folder / name).symlink_to(target)
    (tmp_path / "link").symlink_to("folder")
    check_links(tmp_path / "link")
    check_inside(tmp_path / "link" / "new", folder)
    with expect_error("cannot write this"):
        check_links(tmp_path / "none")
