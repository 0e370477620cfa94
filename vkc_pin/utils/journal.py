"""Records finished tasks in a file that one process writes, so that interrupted runs go on."""

from __future__ import annotations

import fcntl
import itertools
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import (
    check_instance,
    check_integer,
    check_list,
    check_mapping,
    check_number,
    check_text,
)

CheckRecords = Callable[[str, list[dict[str, Any]]], object]
"""Raises an `InputError` for invalid records of a task, given its key and them."""

_MAX_LINE = 50_000_000  # [bytes]


class Records(Mapping[str, list[dict[str, Any]]]):
    """Key → records of a finished task, read from the journal on access: there may be millions."""

    def __init__(self, path: Path) -> None:
        self._path = path.absolute()
        self._offsets: dict[str, int] = {}

    def add(self, key: str, offset: int) -> None:
        """Add a task by the offset of its line in the file [bytes]."""
        self._offsets[key] = offset

    def __getitem__(self, key: str) -> list[dict[str, Any]]:
        offset = self._offsets[key]
        with self._path.open("rb") as stream:
            stream.seek(offset)
            records: list[dict[str, Any]] = json.loads(stream.readline())["records"]
        return records

    def __delitem__(self, key: str) -> None:
        del self._offsets[key]

    def __contains__(self, key: object) -> bool:
        return key in self._offsets

    def __iter__(self) -> Iterator[str]:
        return iter(self._offsets)

    def __len__(self) -> int:
        return len(self._offsets)


class JournalContents:
    """Contents of a journal.

    Attributes:
        lines: Records of every finished task.
        sessions: Jobs of each session, number of tasks, time until the last of them [s] and, if
            recorded, processor time of the writing process until then [s].
        memory: Largest memory of a process [MB].
        memories: Process → memory after each of its tasks, if recorded [MB].
        processes: Key → process of the task, if recorded.
    """

    def __init__(self, path: Path, check_records: CheckRecords | None = None) -> None:
        self._path = path
        self._check_records = check_records
        self.lines = Records(path)
        self.sessions: list[dict[str, Any]] = []
        self.memory = 0.0
        self.memories: dict[str, list[float]] = {}
        self.processes: dict[str, str] = {}

    @classmethod
    def read(cls, path: Path) -> JournalContents:
        """Return the contents of a file, which another process may be writing.

        Raises:
            InputError: The file cannot be read, or has an invalid line.
        """
        contents = JournalContents(path)
        try:
            with path.open("rb") as stream:
                contents._parse(path, stream)
        except OSError as error:
            got = error.strerror
            raise InputError(
                "cannot read this", file=path, expected="a journal", got=got
            ) from error
        return contents

    @property
    def seconds(self) -> float:
        """Total time of the sessions, each until its last task [s]."""
        return float(sum(session["seconds"] for session in self.sessions))

    def _parse(self, path: Path, stream: IO[bytes]) -> int:
        """Read all complete lines, and return the offset of their end [bytes]."""
        end = 0
        for number in itertools.count(1):
            text = stream.readline(_MAX_LINE)
            is_too_long = len(text) == _MAX_LINE
            if not text.endswith(b"\n") and not is_too_long:
                break
            try:
                if is_too_long:
                    raise InputError("too long", expected=f"at most {_MAX_LINE:g} bytes")
                line = json.loads(text)
                if number == 1:
                    self._check_header(line)
                else:
                    self._add(line, end, number)
            except (ValueError, LookupError, RecursionError) as error:
                if isinstance(error, InputError) and error.file is not None:
                    raise
                raise InputError(
                    "this line is damaged",
                    file=path,
                    line=number,
                    expected="the lines that a run writes",
                    got=str(error),
                ) from error
            end += len(text)
        return end

    def _check_header(self, header: Mapping[str, Any]) -> None:
        """Accept any header."""

    def _add(self, line: Any, offset: int, number: int | None = None) -> None:
        """Add a line at an offset [bytes]; `number` is that of a line in the file, else None."""
        line = check_mapping(line, "line")
        if "session" in line:
            session = check_mapping(line["session"], "session")
            session["jobs"] = check_integer(session.get("jobs"), "jobs", low=1)
            self.sessions.append({**session, "trials": 0, "seconds": 0.0})
            return
        key = check_text(line.get("key"), "key")
        records = check_instance(line.get("records"), list, "records")
        check_list(records, "records", "a list of records", dict)
        if number is not None:
            self._check_task(key, records, number)
        numbers = {name: check_number(line.get(name), name) for name in ("memory_mb", "seconds")}
        for name in ("client_seconds", "resident_mb"):
            if name in line:
                numbers[name] = check_number(line[name], name)
        process = None
        if "process" in line:
            process = check_text(line["process"], "process")
        session = self.sessions[-1]
        self.lines.add(key, offset)
        self.memory = max(self.memory, numbers["memory_mb"])
        session["trials"] += 1
        session["seconds"] = numbers["seconds"]
        if "client_seconds" in numbers:
            session["client_seconds"] = numbers["client_seconds"]
        if process is not None:
            self.processes[key] = process
            self.memories.setdefault(process, []).append(numbers["resident_mb"])

    def _check_task(self, key: str, records: list[dict[str, Any]], number: int) -> None:
        """Check the records of a task in a line of the file."""
        if self._check_records is None:
            return
        try:
            self._check_records(key, records)
        except InputError as error:
            raise InputError(
                error.problem,
                file=self._path,
                line=number,
                field=error.field,
                expected=error.expected,
                got=error.got,
            ) from error


class Journal(JournalContents):
    """File of finished tasks: a header, then a line for each task and for each session.

    Only the last line may be incomplete; it is removed when the file is opened again.

    Args:
        path: The file, for messages.
        stream: The file, open for reading and appending ("a+b").
        header: Plain data that the results depend on: fields by name, in groups.
        kind: Plural name of the tasks, for messages.
        check_records: Checks the records of every task in the file.

    Raises:
        InputError: Another process writes the file, it is not a journal, or its header differs.
    """

    def __init__(
        self,
        path: Path,
        stream: IO[bytes],
        header: Mapping[str, Any],
        kind: str = "trials",
        check_records: CheckRecords | None = None,
    ) -> None:
        super().__init__(path, check_records)
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            problem = "another run is writing to this folder; wait for it, or use another"
            raise InputError(problem, file=path) from None
        self._stream = stream
        self._kind = kind
        self._header = json.loads(json.dumps(header))
        stream.seek(0)
        self._end = self._parse(path, stream)
        if not self._end:
            self._check_partial_header()
        stream.truncate(self._end)
        if not self._end:
            self._write(self._header)

    def append(self, line: dict[str, Any]) -> None:
        """Write a line, and add it to the contents."""
        offset = self._end
        self._write(line)
        self._add(line, offset)

    def _check_partial_header(self) -> None:
        """Check that a file without a complete line is a part of the header."""
        header = _encode_line(self._header)
        self._stream.seek(0)
        begun = self._stream.read(len(header))
        if not header.startswith(begun):
            expected = "a new file, or the lines that a run writes"
            got = begun[:80].decode(errors="replace")
            raise InputError("not a journal", file=self._path, line=1, expected=expected, got=got)

    def _write(self, line: Mapping[str, Any]) -> None:
        text = _encode_line(line)
        done = 0
        try:
            # Past the buffer, which would raise once more when the stream is closed.
            while done < len(text):
                done += os.write(self._stream.fileno(), text[done:])
        except OSError as error:
            raise InputError(
                "cannot write this", file=self._path, expected="a writable file", got=error.strerror
            ) from error
        self._end += len(text)

    def _check_header(self, header: Mapping[str, Any]) -> None:
        """Raise an error that names the differences to this journal's header."""
        old = _flatten(check_mapping(header, "header"))
        new = _flatten(self._header)
        differing = [name for name in {**old, **new} if old.get(name) != new.get(name)]
        if not differing:
            return
        # Other settings change the digest of all trials, too.
        named = [name for name in differing if name != "specification"] or differing
        if "benchmark" in named:  # others have other settings
            named = ["benchmark"]
        problem = (
            f"the {self._kind} in this folder were run otherwise; "
            f"use another folder than {self._path.parent}"
        )
        raise InputError(
            problem,
            file=self._path,
            field=", ".join(named),
            expected=_format_entries(old, named),
            got=_format_entries(new, named),
        )


def _encode_line(data: Mapping[str, Any]) -> bytes:
    return json.dumps(data, allow_nan=False).encode() + b"\n"


def _format_entries(flat: Mapping[str, Any], names: list[str]) -> str:
    """Return entries of a flat header as text, "pin 4.1.0, seed 3"."""
    return ", ".join(f"{name.rpartition('.')[2]} {flat.get(name)}" for name in names)


def _flatten(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a header: settings by their own name, others as "versions.pin"."""
    flat: dict[str, Any] = {}
    for name, value in data.items():
        if not isinstance(value, Mapping):
            flat[name] = value
            continue
        prefix = "" if name == "settings" else f"{name}."
        for key, item in value.items():
            flat[f"{prefix}{key}"] = item
    return flat
