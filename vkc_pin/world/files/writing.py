"""Writes files and folders atomically, and checks their names and targets first."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path

from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.interrupt import defer_interrupt
from vkc_pin.world.files.documents import parse_json, read_text
from vkc_pin.world.files.resources import check_path

MANIFEST = ".vkc-pin.json"
"""File that lists the other files in a folder of `write_folder_atomically`."""
_LEFTOVER = re.compile(r"\.vkc-pin-[0-9a-f]{16}")  # names of `_make_temporary_path`
_MAX_NAME_LENGTH = 200  # bytes, so that an ending can be added
_FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_MAX_LISTED = 3  # files that a message names


def write_atomically(path: str | Path, data: bytes) -> Path:
    """Write a file completely or not at all, and return its path.

    Missing folders are created, links followed, and the mode of an existing file kept. Ctrl-C is
    deferred.
    """
    with _report_path_errors(path):
        target, mode = _resolve_target(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        with defer_interrupt():
            temporary = _make_temporary_path(target.parent)
            try:
                with temporary.open("xb") as stream:
                    stream.write(data)
                    if mode is not None:
                        os.fchmod(stream.fileno(), mode)
                temporary.replace(target)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
    return Path(path)


def check_writable(path: str | Path, *, field: str | None = None) -> Path:
    """Return the target of `write_atomically`."""
    with _report_path_errors(path, field):
        target, _ = _resolve_target(path)
        folder = target.parent
        missing = [target.name]
        while not folder.exists():
            missing.append(folder.name)
            folder = folder.parent
        # File systems raise other errors for names that they do not take.
        for name in missing:
            with contextlib.suppress(FileNotFoundError):
                (folder / name).lstat()
        # Only trying tells whether a disk is read-only, say.
        temporary = _make_temporary_path(folder)
        with defer_interrupt():
            try:
                temporary.open("xb").close()
            finally:
                temporary.unlink(missing_ok=True)
    return target


def check_outputs(
    files: Mapping[str, str | Path], *, inputs: Mapping[str, str | Path] | None = None
) -> None:
    """Check that files can be written without conflicts.

    Args:
        files: Option or argument → output file.
        inputs: Option or argument → input file, which must not be written.
    """
    taken = dict[Path, str]()
    for field, path in (inputs or {}).items():
        source = Path(os.path.realpath(check_path(path, field)))
        taken[source] = field
    targets = dict[Path, str]()
    for field, path in files.items():
        target = check_writable(path, field=field)
        if target in taken:
            raise InputError(
                "this file is named twice",
                file=path,
                field=field,
                expected=f"another file than {taken[target]}",
            )
        taken[target] = field
        targets[target] = field
    for target, field in targets.items():
        for folder in target.parents:
            if folder in targets:
                raise InputError(
                    "a file cannot be a folder",
                    file=folder,
                    field=field,
                    got=f"the file of {targets[folder]}",
                )


def check_name(name: object, field: str, *, file: str | Path | None = None) -> str:
    """Return a name that is safe to join to a folder. All names read from files are checked.

    Args:
        name: Name of a file or folder.
        field: Field or argument of the name, for the error.
        file: File of the name, for the error.
    """
    if isinstance(name, str) and _is_plain_name(name):
        return name
    expected = f"at most {_MAX_NAME_LENGTH} bytes of text without slashes, not beginning with a dot"
    got = format_value(name)
    raise InputError("not a plain file name", file=file, field=field, expected=expected, got=got)


def _is_plain_name(name: str) -> bool:
    has_slash = "/" in name or "\\" in name
    if not name.isprintable() or has_slash or name.startswith("."):
        return False
    return 0 < len(name.encode()) <= _MAX_NAME_LENGTH


def check_inside(path: str | Path, folder: str | Path) -> None:
    """Check that a path in a folder is not a symbolic link to a place outside."""
    root = Path(os.path.realpath(folder))
    target = Path(os.path.realpath(path))
    if not target.is_relative_to(root):
        expected = f"a path inside {root}"
        raise InputError(
            "a symbolic link leads out of the folder", file=path, expected=expected, got=target
        )


def check_links(folder: str | Path) -> None:
    """Check that no symbolic link in a folder leads out of it."""
    with _report_path_errors(folder):
        links = [entry.path for entry in _walk_files(folder) if entry.is_symlink()]
    for link in links:
        check_inside(link, folder)


def is_leftover(path: Path) -> bool:
    """Return whether a file or folder has the name of a temporary one, as a killed run leaves."""
    return _LEFTOVER.fullmatch(path.name) is not None


def remove_leftovers(folder: str | Path) -> None:
    """Remove temporary files and folders of killed runs; no other run may be writing the folder."""
    with _report_path_errors(folder):
        for parent, folder_names, file_names in os.walk(folder):
            for name in filter(_LEFTOVER.fullmatch, file_names):
                Path(parent, name).unlink(missing_ok=True)
            for name in filter(_LEFTOVER.fullmatch, folder_names):
                leftover = Path(parent, name)
                if not leftover.is_symlink():
                    shutil.rmtree(leftover, ignore_errors=True)


def check_replaceable(folder: str | Path) -> None:
    """Check that all files in a folder were written by `write_folder_atomically`."""
    with _report_path_errors(folder):
        found = {os.path.relpath(entry.path, folder) for entry in _walk_files(folder)}
    others = sorted(found - {MANIFEST} - _read_manifest(Path(folder)))
    if others:
        names = ", ".join(others[:_MAX_LISTED])
        if len(others) > _MAX_LISTED:
            names += f" and {len(others) - _MAX_LISTED} more"
        raise InputError(
            "the folder has files that vkc-pin did not write, and would delete",
            file=folder,
            expected="a folder without them: move them elsewhere",
            got=names,
        )


def _read_manifest(folder: Path) -> set[str]:
    """Return the files that a folder's manifest lists; none if there is no valid manifest."""
    path = folder / MANIFEST
    try:
        manifest = parse_json(read_text(path, "JSON"), path)
        return {name for name in manifest["files"] if isinstance(name, str)}
    except (InputError, LookupError, TypeError):
        return set()


def _walk_files(folder: str | Path) -> Iterator[os.DirEntry[str]]:
    """Yield the files below a folder, without following links."""
    pending = [os.fspath(folder)]
    while pending:
        with os.scandir(pending.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    pending.append(entry.path)
                else:
                    yield entry


@contextlib.contextmanager
def write_folder_atomically(
    path: str | Path, *, force: bool = False, source: Path | None = None
) -> Iterator[Path]:
    """Yield a new folder, which replaces `path` on success and is removed on failure.

    It gets a list of its files, so that a later call can replace it safely. The new folder has the
    name of `path`. Errors about files in it, which are gone, name `source` instead, or files in
    `path`.

    Args:
        path: The folder, created with its parents.
        force: Replace an existing folder that is empty or written by this function.
        source: File of which the folder is made.
    """
    target = Path(os.path.realpath(check_path(path, "path", "a folder")))
    _check_target(target, path, force)
    with _report_path_errors(path):
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = _make_temporary_path(target.parent)
        staging = temporary / target.name
        staging.mkdir(parents=True)
    try:
        yield staging
        _check_target(target, path, force)  # it may have changed in the meantime
        with _report_path_errors(path), defer_interrupt():
            _write_manifest(staging)
            _replace_folder(target, staging)
    except InputError as error:
        if source is None:
            _rename_files(error, re.compile(re.escape(str(staging))), str(path))
        else:
            inside = re.compile(rf"{re.escape(str(staging))}(/[^:\s]*)?(:\d+)?")
            _rename_files(error, inside, str(source))
        raise
    except OSError as error:
        if error.errno not in _FULL_DISK:
            raise
        raise InputError("cannot write this", file=path, got=error.strerror) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _rename_files(error: InputError, pattern: re.Pattern[str], name: str) -> None:
    """Replace file names, also with lines, in an error."""

    def rename(text: str) -> str:
        # A function, since a text would be a template with escapes.
        return pattern.sub(lambda _: name, text)

    error.args = tuple(rename(str(part)) for part in error.args)
    error.problem = rename(error.problem)
    if error.file is not None:
        renamed = rename(str(error.file))
        error.file = type(error.file)(renamed)
        # The line is one of the other file.
        if renamed == name:
            error.line = None


def _check_target(target: Path, path: str | Path, force: bool) -> None:
    """Check that a folder does not exist, or may be replaced."""
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError("this is no folder", file=path, expected="a new folder", got="a file")
    if not force:
        expected = "a new folder, or force=True (--force) to replace it"
        raise InputError("this folder already exists", file=path, expected=expected)
    check_replaceable(target)


def _write_manifest(folder: Path) -> None:
    path = folder / MANIFEST
    path.unlink(missing_ok=True)
    files = sorted(os.path.relpath(entry.path, folder) for entry in _walk_files(folder))
    text = json.dumps({"files": files}, indent=1) + "\n"
    path.write_text(text, encoding="utf-8")


def _replace_folder(target: Path, staging: Path) -> None:
    """Rename a folder to `target`, and delete the previous one."""
    if not target.exists():
        staging.rename(target)
        return
    old = _make_temporary_path(target.parent)
    target.rename(old)
    try:
        staging.rename(target)
    except OSError:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _resolve_target(path: str | Path) -> tuple[Path, int | None]:
    """Return the real path, and the mode of an existing file."""
    target = Path(os.path.realpath(path))
    try:
        found = os.stat(path)  # noqa: PTH116 - as text, which tells a folder by its slash
    except FileNotFoundError:
        if not str(path) or str(path).endswith(os.sep):
            raise IsADirectoryError("a folder") from None
        return target, None
    if not stat.S_ISREG(found.st_mode):
        raise IsADirectoryError(_describe_special_file(found.st_mode))
    if not os.access(target, os.W_OK):
        raise PermissionError("no permission to write it")
    return target, stat.S_IMODE(found.st_mode)


def _describe_special_file(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "a folder"
    if stat.S_ISFIFO(mode):
        return "a pipe"
    if stat.S_ISSOCK(mode):
        return "a socket"
    return "a device"


def _make_temporary_path(folder: Path) -> Path:
    return folder / f".vkc-pin-{secrets.token_hex(8)}"


@contextlib.contextmanager
def _report_path_errors(path: str | Path, field: str | None = None) -> Iterator[None]:
    # Text stays text: it may end with a slash, which paths forget.
    path = path if isinstance(path, str) else check_path(path, "path")
    try:
        yield
    except (OSError, ValueError) as error:  # the latter: a NUL in the name
        got = getattr(error, "strerror", None) or str(error)
        expected = "a regular file or a new one"
        raise InputError(
            "cannot write this", file=str(path), field=field, expected=expected, got=got
        ) from error
