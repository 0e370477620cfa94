"""Finds files of users and of the package, and chooses names for new files."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import unquote

import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError, find_nearest_name, format_value
from vkc_pin.utils.system import is_file

_MAX_NAME_LENGTH = (
    64  # characters of a file name without extension; file systems take 255 bytes with it
)
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):(.*)", re.DOTALL)  # not C:, a drive
_MODEL_PATHS = ("GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH")  # variables with folders of models
_NO_PACKAGES: Mapping[str, Path] = MappingProxyType({})
_NEAR = 4  # folders above a file whose other folders are searched for a package.xml
_MAX_HEAD = 20_000  # characters of a package.xml in which its name stands
_PACKAGE = re.compile(r"(?i:package|model):/*([^/]+)/+(.+)")  # NAME/... in an address
_PACKAGE_NAME = re.compile(r"<name>\s*([^<\s]+)\s*</name>")
_FILE_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_PORT_NAMES = {f"{port}{number}" for port in ("com", "lpt") for number in range(10)}
_RESERVED_NAMES = {"con", "prn", "aux", "nul", *_PORT_NAMES}  # reserved on Windows


def find_package_folder() -> Path:
    """Return the folder of the package's sources."""
    return Path(__file__).resolve().parents[2]


def find_resource_folder(kind: str) -> Path:
    """Return the folder "robots" or "scenes" (`kind`), in the installed package or beside it."""
    package = find_package_folder()
    inside = package / kind
    return inside if inside.is_dir() else package.parent / kind


def list_resources(kind: str, pattern: str) -> dict[str, Path]:
    """Return name → path of the files or folders of a `kind` that match a glob pattern."""
    return {path.stem: path for path in sorted(find_resource_folder(kind).glob(pattern))}


def find_resource(kind: str, pattern: str, name: str, *, noun: str) -> Path:
    """Return the path of a resource by its name; see `list_resources`."""
    found = list_resources(kind, pattern)
    if name not in found:
        raise UnknownNameError(noun, name, found)
    return found[name]


def check_path(value: Any, field: str, expected: str = "a path") -> Path:
    """Return the path of a file, which need not exist."""
    if not isinstance(value, str | Path):
        raise InputError("not a path", field=field, expected=expected, got=format_value(value))
    name = str(value)
    try:
        coded = os.fsencode(name)
    except UnicodeEncodeError:
        coded = b""
    if not coded or b"\0" in coded or len(coded) >= 4096 or max(map(len, coded.split(b"/"))) > 255:
        raise InputError(
            "no file can be called that", field=field, expected=expected, got=format_value(name)
        )
    return Path(value)


def find_file(name_or_path: str | Path, kind: str, pattern: str, *, noun: str) -> Path:
    """Return a file by its path (`Path`, slash, or .yaml) or name; see `find_resource`."""
    path = check_path(name_or_path, noun, f"the name of a {noun}, or a path")
    name = str(name_or_path)
    by_path = isinstance(name_or_path, Path) or name.endswith((".yaml", ".yml")) or "/" in name
    return path if by_path else find_resource(kind, pattern, name, noun=noun)


def find_example_robot_data() -> Path | None:
    """Return the folder of example-robot-data in the wheels of cmeel, or None."""
    prefixes = [Path(pin.__file__).resolve().parents[4]]
    spec = importlib.util.find_spec("cmeel")
    if spec is not None and spec.origin is not None:
        prefixes.append(Path(spec.origin).resolve().parents[1] / "cmeel.prefix")
    for prefix in prefixes:
        if (prefix / "share" / "example-robot-data" / "robots").is_dir():
            return prefix / "share" / "example-robot-data"
    return None


def find_mesh_file(
    address: str,
    file: Path,
    packages: Mapping[str, Path] = _NO_PACKAGES,
    *,
    line: int | None = None,
) -> Path:
    """Return the mesh file of an address in a description file.

    Args:
        address: A path relative to `file`, a `file:` URI, `package://NAME/...` or
            `model://NAME/...`, as it is or percent-encoded.
        file: The description file.
        packages: Folders of packages and models by name; others are searched around `file`.
        line: Line of the address in `file`, for messages.

    Raises:
        InputError: There is no such file.
    """
    first: Path | None = None
    for candidate in iterate_address_candidates(address, file, packages):
        if is_file(candidate):
            return candidate
        first = first or candidate
    if (match := _PACKAGE.match(unquote(address.strip()))) is not None:
        place = find_package(match[1], file, packages)  # of another folder name
        if place is not None and is_file(place / match[2]):
            return place / match[2]
    assert first is not None  # there is a folder around every file
    expected = "a mesh file"
    with contextlib.suppress(OSError, ValueError):  # there may be no such folder
        nearest = find_nearest_name(
            first.name, sorted(item.name for item in first.parent.iterdir())
        )
        expected += f", such as {nearest}" if nearest else ""
    raise InputError(
        "there is no such mesh",
        file=file,
        line=line,
        field=address,
        expected=expected,
        got=f"nothing at {first}",
    )


def iterate_address_candidates(
    address: str, file: Path, packages: Mapping[str, Path] = _NO_PACKAGES
) -> Iterator[Path]:
    """Yield the paths that an address in a description file may mean; see `find_mesh_file`.

    Raises:
        InputError: The address has another scheme, such as `https:`.
    """
    text = address.strip()
    match = _SCHEME.fullmatch(text)
    scheme, rest = (match[1].lower(), match[2]) if match else ("", text)
    if scheme in ("package", "model"):
        found: Iterable[Path] = _list_package_candidates(rest.lstrip("/"), file, packages)
    elif scheme in ("", "file"):
        if rest.startswith("//"):  # `file://HOST/PATH`; without a host also for relative paths
            host, slash, path = rest[2:].partition("/")
            rest = slash + path if host.lower() in ("", "localhost") else rest[2:]
        found = [folder / rest for folder in _list_folders(file)]
    elif rest.startswith("//"):
        raise InputError(
            "this kind of address is not supported",
            file=file,
            field=address,
            expected="a path, or an address with file:, package:// or model://",
            got=f"{scheme}://",
        )
    else:  # a colon in a file name
        found = [folder / text for folder in _list_folders(file)]
    decoded = []
    for path in found:
        yield path
        if "%" in str(path):
            decoded.append(Path(unquote(str(path))))
    yield from decoded


def _list_folders(file: Path) -> list[Path]:
    """Return the folder of a link to a file, and that of the file itself."""
    return [file.absolute().parent, file.resolve().parent]


def _list_package_candidates(
    address: str, file: Path, packages: Mapping[str, Path]
) -> Iterator[Path]:
    """Yield the paths of `NAME/...` in given folders, around a file and in Gazebo's folders."""
    name, _, inside = address.partition("/")
    inside = inside.lstrip("/")
    if name in packages:
        yield packages[name] / inside
    around = dict.fromkeys([*file.absolute().parents, *file.resolve().parents])
    yield from (folder / name / inside for folder in around)
    yield from (folder / inside for folder in around if inside)
    yield from (folder / "models" / name / inside for folder in around)
    for variable in _MODEL_PATHS:
        for folder in filter(None, os.environ.get(variable, "").split(os.pathsep)):
            yield Path(folder) / name / inside
    # for copies of its URDFs, wherever they are
    if name == "example-robot-data" and (data := find_example_robot_data()) is not None:
        yield data / inside


def find_package(
    name: str, file: Path, packages: Mapping[str, str | Path] | None = None
) -> Path | None:
    """Return the folder of a ROS package that a file refers to, or None.

    It is one of `packages`; or a folder of that name around the file; or one around it whose
    package.xml states the name, as checkouts are often called otherwise.
    """
    if packages and name in packages:
        return Path(packages[name])
    around = list(dict.fromkeys([*file.absolute().parents, *file.resolve().parents]))
    for folder in around:
        for place in (folder, folder / name) if folder.name == name else (folder / name,):
            if os.path.isdir(place):  # noqa: PTH112 - its name may be too long
                return place
    for folder in around:
        if _read_package_name(folder) == name:
            return folder
    for folder in around[:_NEAR]:
        with contextlib.suppress(OSError):
            for place in sorted(folder.iterdir()):
                if place.is_dir() and _read_package_name(place) == name:
                    return place
    return None


def _read_package_name(folder: Path) -> str | None:
    """Return the name that a folder's package.xml states, or None."""
    file = folder / "package.xml"
    try:
        with file.open(encoding="utf-8", errors="replace") as stream:
            found = _PACKAGE_NAME.search(stream.read(_MAX_HEAD))
    except OSError:
        return None
    return found.group(1) if found else None


def choose_file_names(
    names: Iterable[str], *, fallback: str = "part", taken: Iterable[str] = ()
) -> list[str]:
    """Choose a unique, portable file name without extension for each name.

    File names have 1 to 64 ASCII letters, digits, "_" and "-", differ in more than case, and are
    not reserved on Windows. Valid names are kept. In others, "_" replaces invalid characters, and a
    number distinguishes equal results.

    Args:
        names: Names of links, objects or files.
        fallback: File name for names without ASCII letters and digits.
        taken: Existing file names in the folder.
    """
    given = list(names)
    used, numbers = {name.lower() for name in taken}, dict[str, int]()
    chosen: dict[int, str] = {}
    for index, name in enumerate(given):
        if _is_file_name(name) and name.lower() not in used:
            chosen[index] = name
            used.add(name.lower())
    for index, name in enumerate(given):
        if index in chosen:
            continue
        stem = name if _is_file_name(name) else _replace_characters(name, fallback)
        new, number = stem, numbers.get(stem.lower(), 1)
        while new.lower() in used:
            number += 1
            new = f"{stem[: _MAX_NAME_LENGTH - 1 - len(str(number))]}_{number}"
        numbers[stem.lower()] = number
        chosen[index] = new
        used.add(new.lower())
    return [chosen[index] for index in range(len(given))]


def _is_file_name(name: str) -> bool:
    return _FILE_NAME.fullmatch(name) is not None and name.lower() not in _RESERVED_NAMES


def _replace_characters(name: str, fallback: str) -> str:
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:_MAX_NAME_LENGTH]
    if re.search(r"[A-Za-z0-9]", stem) is None:
        return fallback
    return f"{stem}_" if stem.lower() in _RESERVED_NAMES else stem
