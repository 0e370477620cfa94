"""Reads HDF5 files of others: links, types and sizes are checked before anything is read."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.optional_imports import import_optional

MAX_BYTES = 40_000_000
"""Largest array that is read [bytes]: 200 000 waypoints of 25 coordinates."""
# [bytes] of an attribute
_MAX_TEXT = 50_000_000
# [bytes] of a text in an array
_MAX_ITEM = 100
_KINDS = {"f": "floating-point numbers", "i": "integers", "u": "unsigned integers", "S": "texts"}


def require_h5py() -> Any:
    """Return h5py.

    Raises:
        InputError: It is not installed.
    """
    return import_optional("h5py", "data", purpose="a dataset")


@contextlib.contextmanager
def open_hdf5(path: Path) -> Iterator[Group]:
    """Yield the root of an HDF5 file.

    Raises:
        InputError: The file is missing or no HDF5 file, or reading from it fails.
    """
    h5py = require_h5py()
    if not path.is_file():  # reading a pipe would wait for ever
        raise InputError("there is no such file", file=path, expected="a shard of a dataset")
    try:
        with h5py.File(path, "r") as file:
            yield Group(file, path)
    except InputError:
        raise
    except OSError as error:
        raise InputError(
            "not an HDF5 file, or a damaged one",
            file=path,
            expected="a shard of a dataset",
            got=str(error),
        ) from error
    # h5py raises these for parts that it does not understand.
    except (LookupError, TypeError, ValueError, RuntimeError, MemoryError, OverflowError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError("a damaged HDF5 file", file=path, got=got) from error


class Group:
    """A group of an HDF5 file, whose errors name the file and the member.

    Only hard links are followed: soft and external ones may show other files of the reader.

    Args:
        group: The h5py group.
        file: The file, for messages.
        name: Path of the group, for messages.
    """

    def __init__(self, group: Any, file: Path, name: str = "") -> None:
        self.handle = group
        self.file = file
        self.name = name

    def make_error(
        self, problem: str, name: str = "", *, expected: object = None, got: object = None
    ) -> InputError:
        """Return the error for a member."""
        field = "/".join(part for part in (self.name, name) if part) or None
        return InputError(problem, file=self.file, field=field, expected=expected, got=got)

    def list_names(self) -> list[str]:
        """Return the names of all members."""
        return list(self.handle)

    def check_names(self, known: Collection[str]) -> None:
        """Raise an error if there is a member with another name than the known ones."""
        for name in self.handle:
            if name not in known:
                kind = f"member of {self.name or 'a shard'}"
                shown = ascii(name)[1:-1]
                raise UnknownNameError(kind, shown, known, file=self.file, field=self.name or None)

    def open_group(self, name: str) -> Group:
        """Return a group in this one."""
        inner = "/".join(part for part in (self.name, name) if part)
        return Group(self._find(name, require_h5py().Group, "a group"), self.file, inner)

    def check_array(
        self, name: str, dtype: str, shape: tuple[int | None, ...], largest: int = MAX_BYTES
    ) -> Any:
        """Return an array without reading it.

        Args:
            name: Name of the array, with those of groups around it: "obs/gripper".
            dtype: Its type, such as "f4"; "S" for texts of up to `_MAX_ITEM` bytes.
            shape: Its shape, with None for any number.
            largest: Its maximum size [bytes].
        """
        first, _, rest = name.partition("/")
        if rest:
            return self.open_group(first).check_array(rest, dtype, shape, largest)
        item = self._find(name, require_h5py().Dataset, "an array")
        if item.is_virtual or item.external:
            raise self.make_error("the array is stored in other files", name)
        found = item.dtype
        expected = np.dtype(dtype)
        if dtype == "S":
            has_size = found.itemsize <= _MAX_ITEM
        else:
            has_size = found.itemsize == expected.itemsize
        if found.kind != expected.kind or not has_size:
            kind = f"{_KINDS[expected.kind]} of {expected.itemsize or f'at most {_MAX_ITEM}'} bytes"
            raise self.make_error("wrong type of array", name, expected=kind, got=str(found))
        if not _has_shape(item, shape):
            sizes = ", ".join("any" if size is None else str(size) for size in shape)
            raise self.make_error(
                "wrong shape", name, expected=f"({sizes})", got=format_value(item.shape)
            )
        # A chunk is unpacked whole, and may be larger than an array that can grow.
        count = max(math.prod(item.shape), math.prod(item.chunks or ()))
        size = count * found.itemsize
        if size > largest:
            raise self.make_error(
                "too large", name, expected=f"at most {largest:g} bytes", got=f"{size:g}"
            )
        return item

    def read_array(
        self, name: str, dtype: str, shape: tuple[int | None, ...], largest: int = MAX_BYTES
    ) -> Any:
        """Return the values of an array; see `check_array`."""
        return self.check_array(name, dtype, shape, largest)[()]

    def read_text(self, name: str) -> str:
        """Return an attribute that is a text."""
        value = self.read_attribute(name)
        if not isinstance(value, str):
            raise self.make_error("not text", name, expected="text", got=format_value(value))
        return value

    def read_integer(self, name: str) -> int:
        """Return an attribute that is a whole number of at least 0."""
        value = self.read_attribute(name)
        if not isinstance(value, np.integer) or value < 0:
            raise self.make_error(
                "wrong value",
                name,
                expected="a whole number of at least 0",
                got=format_value(value),
            )
        return int(value)

    def _find(self, name: str, kind: Any, expected: str) -> Any:
        """Return a member of a kind, which `expected` describes."""
        link = self.handle.get(name, getlink=True)
        if link is None:
            raise self.make_error("missing", name, expected=expected)
        if not isinstance(link, require_h5py().HardLink):
            raise self.make_error("a link, which is not followed", name, expected=expected)
        found = self.handle[name]
        if not isinstance(found, kind):
            got = type(found).__name__
            raise self.make_error("wrong kind of member", name, expected=expected, got=got)
        return found

    def read_attribute(self, name: str) -> Any:
        """Return an attribute with one value."""
        attributes = self.handle.attrs
        if name not in attributes:
            raise self.make_error("missing", name, expected="an attribute")
        identifier = attributes.get_id(name)
        if identifier.shape != () or identifier.get_type().get_size() > _MAX_TEXT:
            got = f"shape {identifier.shape}"
            raise self.make_error("wrong shape", name, expected="one value", got=got)
        return attributes[name]


def _has_shape(item: Any, shape: tuple[int | None, ...]) -> bool:
    """Return whether an array has a shape, whose sizes of None are any."""
    if item.shape is None or len(item.shape) != len(shape):
        return False
    for size, expected in zip(item.shape, shape, strict=True):
        if expected is not None and size != expected:
            return False
    return True
