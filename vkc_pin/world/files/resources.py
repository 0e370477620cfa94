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

# Characters of a file name without extension; file systems take 255 bytes with it.
_MAX_NAME_LENGTH = 64
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):(.*)", re.DOTALL)  # not C:, a drive
_MODEL_PATHS = ("GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH")  # variables with folders of models
_NO_PACKAGES: Mapping[str, Path] = MappingProxyType({})
# Sizes of paths and of file names in Linux [bytes]
_MAX_PATH_SIZE = 4095
_MAX_PART_SIZE = 255
_NEAR = 4  # folders above a file whose other folders are searched for a package.xml
_MAX_HEAD = 20_000  # characters of a package.xml that are searched for its name
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
        encoded = os.fsencode(name)
    except UnicodeEncodeError:
        encoded = b""
    longest_part = max(map(len, encoded.split(b"/")))
    is_too_long = len(encoded) > _MAX_PATH_SIZE or longest_part > _MAX_PART_SIZE
    if not encoded or b"\0" in encoded or is_too_long:
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
        folder = prefix / "share" / "example-robot-data"
        if (folder / "robots").is_dir():
            return folder
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
    match = _PACKAGE.match(unquote(address.strip()))
    if match is not None:
        # The package's folder may have another name.
        package_name, inside = match.groups()
        folder = find_package(package_name, file, packages)
        if folder is not None and is_file(folder / inside):
            return folder / inside
    assert first is not None  # there is a folder around every file
    expected = "a mesh file"
    with contextlib.suppress(OSError, ValueError):  # there may be no such folder
        neighbours = sorted(item.name for item in first.parent.iterdir())
        nearest = find_nearest_name(first.name, neighbours)
        if nearest:
            expected += f", such as {nearest}"
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
    if match:
        scheme = match[1].lower()
        rest = match[2]
    else:
        scheme = ""
        rest = text
    if scheme in ("package", "model"):
        found: Iterable[Path] = _list_package_candidates(rest.lstrip("/"), file, packages)
    elif scheme in ("", "file"):
        # `file://HOST/PATH`; without a host also for relative paths
        if rest.startswith("//"):
            rest = rest[2:]
            host, slash, path = rest.partition("/")
            if host.lower() in ("", "localhost"):
                rest = slash + path
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
    for folder in _iterate_folders_above(file):
        yield folder / name / inside
    if inside:
        for folder in _iterate_folders_above(file):
            yield folder / inside
    for folder in _iterate_folders_above(file):
        yield folder / "models" / name / inside
    for variable in _MODEL_PATHS:
        for model_folder in os.environ.get(variable, "").split(os.pathsep):
            if model_folder:
                yield Path(model_folder) / name / inside
    # Copies of the URDFs of example-robot-data may be anywhere.
    if name == "example-robot-data":
        data = find_example_robot_data()
        if data is not None:
            yield data / inside


def _iterate_folders_above(file: Path) -> Iterator[Path]:
    """Yield the folders around a file, and around its target if it is a link, from inside out."""
    own_folders = file.absolute().parents
    yield from own_folders
    # Links are followed only if none of these is wanted, since that reads all folders on the path.
    for folder in file.resolve().parents:
        if folder not in own_folders:
            yield folder


def find_package(
    name: str, file: Path, packages: Mapping[str, str | Path] | None = None
) -> Path | None:
    """Return the folder of a ROS package that a file refers to, or None.

    It is one of `packages`; or a folder of that name around the file; or one around it whose
    package.xml states the name, as checkouts are often called otherwise.
    """
    if packages and name in packages:
        return Path(packages[name])
    around = list(_iterate_folders_above(file))
    for folder in around:
        candidates = [folder / name]
        if folder.name == name:
            candidates.insert(0, folder)
        for candidate in candidates:
            if os.path.isdir(candidate):  # noqa: PTH112 - its name may be too long
                return candidate
    for folder in around:
        if _read_package_name(folder) == name:
            return folder
    for folder in around[:_NEAR]:
        with contextlib.suppress(OSError):
            for candidate in sorted(folder.iterdir()):
                if candidate.is_dir() and _read_package_name(candidate) == name:
                    return candidate
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
    used = {name.lower() for name in taken}
    numbers = dict[str, int]()
    chosen: dict[int, str] = {}
    for index, name in enumerate(given):
        if _is_file_name(name) and name.lower() not in used:
            chosen[index] = name
            used.add(name.lower())
    for index, name in enumerate(given):
        if index in chosen:
            continue
        stem = name if _is_file_name(name) else _replace_characters(name, fallback)
        new = stem
        number = numbers.get(stem.lower(), 1)
        while new.lower() in used:
            number += 1
            ending = f"_{number}"
            new = stem[: _MAX_NAME_LENGTH - len(ending)] + ending
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
