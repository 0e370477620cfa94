from __future__ import annotations

import errno
import os
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from vkc_pin.errors import InputError
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


def everything(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_it_makes_the_folder_and_replaces_what_was_there(tmp_path: Path, umask: int) -> None:
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


def test_the_mode_of_a_file_stays(tmp_path: Path) -> None:
    path = tmp_path / "file"
    for mode in (0o600, 0o640, 0o755):
        path.write_bytes(b"before")
        path.chmod(mode)
        write_atomically(path, b"after")
        assert (path.read_bytes(), path.stat().st_mode & 0o7777) == (b"after", mode)


def test_a_long_name_is_no_problem(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 255)
    assert check_writable(path) == path
    assert write_atomically(path, b"data").read_bytes() == b"data"


@pytest.mark.parametrize("there", [True, False], ids=["there", "dangling"])
def test_links_are_followed(tmp_path: Path, there: bool) -> None:
    target, link, chain = tmp_path / "elsewhere" / "file", tmp_path / "link", tmp_path / "chain"
    if there:
        target.parent.mkdir()
        target.write_bytes(b"before")
    link.symlink_to(Path("elsewhere") / "file")
    chain.symlink_to(link)
    assert check_writable(chain) == target
    assert everything(tmp_path) == {
        "link",
        "chain",
        *(("elsewhere", "elsewhere/file") if there else ()),
    }
    assert write_atomically(chain, b"after") == chain
    assert (link.is_symlink(), chain.is_symlink(), target.read_bytes()) == (True, True, b"after")
    assert everything(tmp_path) == {"link", "chain", "elsewhere", "elsewhere/file"}


def _folder(path: Path) -> str:
    path.mkdir()
    return "got a folder"


def _pipe(path: Path) -> str:
    os.mkfifo(path)
    return "got a pipe"


def _device(path: Path) -> str:
    if os.getuid():
        pytest.skip(
            "only root can make a device, and those of the machine are not to be played with"
        )
    os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    return "got a device"


def _socket(path: Path) -> str:
    here = Path.cwd()
    os.chdir(path.parent)  # the paths of sockets are short
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(path.name)
    os.chdir(here)
    return "got a socket"


def _circle(path: Path) -> str:
    path.with_name("other").symlink_to(path)
    path.symlink_to(path.with_name("other"))
    return "Too many levels of symbolic links"


@pytest.mark.parametrize("make", [_folder, _pipe, _device, _socket, _circle])
def test_what_is_no_file_is_refused(tmp_path: Path, make: object) -> None:
    path = tmp_path / "output"
    said = make(path)  # type: ignore[operator]
    before = everything(tmp_path)
    for write in (check_writable, lambda path: write_atomically(path, b"data")):
        with pytest.raises(
            InputError, match=f"cannot write this.*expected a regular file or a new one.*{said}"
        ) as caught:
            write(path)
        assert caught.value.file == str(path)
    assert everything(tmp_path) == before


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("file/plan.npz", "Not a directory"),
        ("new/", "got a folder"),
        ("new/" + "x" * 256, "File name too long"),
        ("new/" + "x" * 256 + "/plan.npz", "File name too long"),
        ("nul\0", "null byte"),
        ("", "got a folder"),
        ("/proc/nowhere/plan.npz", "got "),
    ],
)
def test_what_cannot_be_written_is_refused(
    tmp_path: Path, path: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    for write in (check_writable, lambda path: write_atomically(path, b"data")):
        with pytest.raises(InputError, match=said):
            write(path)
    assert everything(tmp_path) <= {"file", "new"}


@pytest.mark.parametrize("what", ["file", "folder"])
def test_what_may_not_be_written_is_refused(tmp_path: Path, what: str) -> None:
    """Tried by a user who is nobody: root may write anything."""
    for above in (tmp_path, *tmp_path.parents[:2]):
        above.chmod(0o755)
    (tmp_path / "folder").mkdir()
    path = tmp_path / "folder" / "file"
    path.write_text("before")
    path.chmod(0o444 if what == "file" else 0o666)
    (tmp_path / "folder").chmod(0o777 if what == "file" else 0o555)
    code = f"""
import os
from vkc_pin.errors import InputError
from vkc_pin.world.files.writing import check_writable, write_atomically
os.getuid() or os.setuid(65534)
for write in (check_writable, lambda path: write_atomically(path, b"after")):
    try:
        write({str(path)!r})
    except InputError as error:
        print(error.got)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert len(done.stdout.splitlines()) == 2
    assert done.stdout.lower().count("permission") == 2
    assert path.read_text() == "before"


def test_checking_leaves_no_trace(tmp_path: Path) -> None:
    assert check_writable(tmp_path / "a" / "b" / "file") == tmp_path / "a" / "b" / "file"
    assert everything(tmp_path) == set()


def test_outputs_that_get_in_each_others_way(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("one")
    one, other = tmp_path / "one", tmp_path / "other"
    check_outputs(
        {"--a": one, "--b": other, "--c": tmp_path / "new" / "file"},
        inputs={"PLAN": tmp_path / "plan"},
    )
    with pytest.raises(InputError, match=r"--b: cannot write this .*got a folder"):
        check_outputs({"--a": one, "--b": tmp_path})
    for again in (one, tmp_path / "new" / ".." / "one", tmp_path / "link"):
        with pytest.raises(InputError, match=r"--b: this file is named twice .*than --a"):
            check_outputs({"--a": one, "--b": again})
    with pytest.raises(InputError, match=r"--a: this file is named twice .*than PLAN"):
        check_outputs({"--a": one}, inputs={"PLAN": one})
    with pytest.raises(InputError, match="PLAN: no file can be called that"):
        check_outputs({"--a": one}, inputs={"PLAN": "a\ud800"})
    with pytest.raises(InputError, match=r"--b: a file cannot be a folder .*file of --a"):
        check_outputs({"--a": one, "--b": one / "two" / "three"})
    assert everything(tmp_path) == {"link"}


def test_what_fails_leaves_no_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file.txt"
    path.write_bytes(b"before")

    def full(self: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(InputError, match="no space") as caught:
        write_atomically(path, b"after")
    assert caught.value.file == str(path)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_ctrl_c_waits_until_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal comes between writing and renaming, three times."""
    path, replace = tmp_path / "file.txt", Path.replace

    def pressed(self: Path, target: Path) -> Path:
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)
        return replace(self, target)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(Path, "replace", pressed)
    try:
        with pytest.raises(KeyboardInterrupt):
            write_atomically(path, b"whole")
    finally:
        signal.signal(signal.SIGINT, before)
    assert path.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "new" / "folder"
    with write_folder_atomically(target) as staging:
        (staging / "a").write_text("1", encoding="utf-8")
        assert not target.exists()
    assert sorted(path.name for path in target.iterdir()) == [".vkc-pin.json", "a"]
    with pytest.raises(FileNotFoundError), write_folder_atomically(target, force=True) as staging:
        (staging / "none" / "b").write_text("2", encoding="utf-8")
    assert (target / "a").read_text() == "1"
    with pytest.raises(InputError, match="there already"), write_folder_atomically(target):
        pass
    with write_folder_atomically(target, force=True) as staging:
        (staging / "b").write_text("2", encoding="utf-8")
    assert sorted(path.name for path in target.iterdir()) == [".vkc-pin.json", "b"]
    assert [path.name for path in target.parent.iterdir()] == ["folder"]
    (tmp_path / "file").write_text("3", encoding="utf-8")
    with (
        pytest.raises(InputError, match="no folder"),
        write_folder_atomically(tmp_path / "file", force=True),
    ):
        pass


def write_folder(target: Path, force: bool = True) -> None:
    with write_folder_atomically(target, force=force) as staging:
        (staging / "deep").mkdir()
        (staging / "deep" / "a").write_text("own", encoding="utf-8")


@pytest.mark.parametrize("other", ["notes.txt", "deep/b", "deep/.vkc-pin.json", ".git/config"])
@pytest.mark.parametrize("has_manifest", [True, False], ids=["ours", "not ours"])
def test_a_folder_with_files_of_others_is_not_replaced(
    tmp_path: Path, other: str, has_manifest: bool
) -> None:
    target = tmp_path / "folder"
    if has_manifest:
        write_folder(target)
    (target / other).parent.mkdir(parents=True, exist_ok=True)
    (target / other).write_text("mine")
    before = everything(tmp_path)
    for check in (check_replaceable, write_folder):
        with pytest.raises(
            InputError, match="files that vkc-pin did not write, and would delete"
        ) as caught:
            check(target)
        assert (caught.value.file, caught.value.got) == (target, other)
    assert (target / other).read_text() == "mine"
    assert everything(tmp_path) == before


def test_a_file_that_comes_while_a_folder_is_written_remains(tmp_path: Path) -> None:
    target = tmp_path / "folder"
    write_folder(target)
    with (
        pytest.raises(InputError, match="would delete"),
        write_folder_atomically(target, force=True),
    ):
        (target / "notes.txt").write_text("mine")
    assert everything(tmp_path) == {
        "folder",
        "folder/.vkc-pin.json",
        "folder/deep",
        "folder/deep/a",
        "folder/notes.txt",
    }
    with (
        pytest.raises(InputError, match="there already"),
        write_folder_atomically(tmp_path / "new"),
    ):
        (tmp_path / "new").mkdir()


def test_links_in_a_folder_that_is_replaced_are_not_followed(tmp_path: Path) -> None:
    target = tmp_path / "folder"
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "a").write_text("mine")
    write_folder(target)
    (target / "link").symlink_to(tmp_path / "outside")
    with pytest.raises(InputError, match="got link"):
        write_folder(target)
    (target / "link").unlink()
    (target / "deep" / "a").unlink()
    (target / "deep").rmdir()
    (target / "deep").symlink_to(tmp_path / "outside")
    with pytest.raises(InputError, match="got deep"):
        write_folder(target)
    assert (tmp_path / "outside" / "a").read_text() == "mine"


@pytest.mark.parametrize(
    "text",
    ["", "no JSON", "[]", "{}", '{"files": 3}', '{"files": [["notes.txt"]]}', "\ud800", "[" * 5000],
)
def test_a_damaged_manifest_lists_nothing(tmp_path: Path, text: str) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / ".vkc-pin.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(InputError, match=r"got notes\.txt"):
        check_replaceable(tmp_path)


def test_many_files_of_others_are_counted(tmp_path: Path) -> None:
    for name in "abcde":
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="got a, b, c and 2 more"):
        check_replaceable(tmp_path)


def test_a_folder_that_cannot_be_renamed_is_still_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, rename = tmp_path / "folder", Path.rename
    write_folder(target)
    before = everything(tmp_path)

    def refuse(self: Path, other: Path) -> Path:
        if other == target and (self / "new").exists():
            raise OSError(errno.EIO, "input/output error")
        return rename(self, other)

    monkeypatch.setattr(Path, "rename", refuse)
    with (
        pytest.raises(InputError, match="input/output error"),
        write_folder_atomically(target, force=True) as staging,
    ):
        (staging / "new").touch()
    assert everything(tmp_path) == before


@pytest.mark.parametrize(
    "name", ["a", "husky_ur5e", "ur5e v2.1", "Küche", "x" * 200, "a..b", "-", "con", "0a1b2c3d4e5f"]
)
def test_names_of_files(name: str) -> None:
    assert check_name(name, "robot") == name


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        ".a",
        "/",
        "/a",
        "a/",
        "a/b",
        "../a",
        "a/../b",
        "a\\b",
        "a\0",
        "a\n",
        "\u202ea",
        "\ud800",
        "x" * 201,
        "ä" * 101,
    ],
)
def test_what_is_not_the_name_of_a_file(name: str) -> None:
    with pytest.raises(InputError, match="not a plain file name") as caught:
        check_name(name, "robot", file="journal.jsonl")
    assert (caught.value.file, caught.value.field) == ("journal.jsonl", "robot")
    assert (
        caught.value.expected
        == "at most 200 bytes of text without slashes, not beginning with a dot"
    )
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", [None, 3, 1.5, True, b"a", Path("a"), ["a"]])
def test_a_name_is_text(name: object) -> None:
    with pytest.raises(InputError, match="field: not a plain file name"):
        check_name(name, "field")


@pytest.mark.parametrize(
    "target", ["..", "../outside", "/etc", "../folderx", "deep/../../outside", "../outside/none"]
)
def test_links_that_lead_out_of_a_folder(tmp_path: Path, target: str) -> None:
    for name in ("folder/deep", "folderx", "outside"):
        (tmp_path / name).mkdir(parents=True)
    link = tmp_path / "folder" / "link"
    link.symlink_to(target)
    for check in (
        lambda: check_links(tmp_path / "folder"),
        lambda: check_inside(link, tmp_path / "folder"),
    ):
        with pytest.raises(InputError, match="leads out of the folder") as caught:
            check()
        assert str(caught.value.file) == str(link)
    link.rename(tmp_path / "folder" / "deep" / "link")
    if not target.startswith("/"):
        (tmp_path / "folder" / "deep" / "link").unlink()
        (tmp_path / "folder" / "deep" / "link").symlink_to(f"../{target}")
    with pytest.raises(InputError, match="leads out of the folder"):
        check_links(tmp_path / "folder")


def test_links_that_stay_in_a_folder(tmp_path: Path) -> None:
    (tmp_path / "folder" / "deep").mkdir(parents=True)
    (tmp_path / "folder" / "file").touch()
    for name, target in {
        "one": "file",
        "two": "deep",
        "three": "none",
        "self": ".",
        "deep/up": "..",
    }.items():
        (tmp_path / "folder" / name).symlink_to(target)
    (tmp_path / "link").symlink_to("folder")
    check_links(tmp_path / "folder")
    check_links(tmp_path / "link")
    check_inside(tmp_path / "link" / "one", tmp_path / "folder")
    check_inside(tmp_path / "link" / "new", tmp_path / "link")
    with pytest.raises(InputError, match="cannot write this"):
        check_links(tmp_path / "none")
