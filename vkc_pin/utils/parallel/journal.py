"""What was run, in a file that one process writes: nothing that is in it is run again, whatever stopped the run."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from vkc_pin.errors import InputError

__all__ = ["Journal", "JournalContents", "Records"]


class Records(Mapping[str, list[dict[str, Any]]]):
    """Key → records of a finished task. Its line is read when it is asked for: a run may have millions.

    Args:
        path: The journal.
    """

    def __init__(self, path: Path) -> None:
        self._path = path.absolute()
        self._places: dict[str, int] = {}

    def note(self, key: str, place: int) -> None:
        """Take note of where in the file [bytes] the line of a task begins."""
        self._places[key] = place

    def __getitem__(self, key: str) -> list[dict[str, Any]]:
        place = self._places[key]
        with self._path.open("rb") as stream:
            stream.seek(place)
            records: list[dict[str, Any]] = json.loads(stream.readline())["records"]
        return records

    def __delitem__(self, key: str) -> None:
        del self._places[key]

    def __contains__(self, key: object) -> bool:
        return key in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


class JournalContents:
    """What a journal says.

    Args:
        path: Of the journal.

    Attributes:
        lines: The records of every finished task.
        sessions: For each session its jobs, the number of tasks, the time until the last of them
            [s] and, if tasks say it, the processor time until then of the process that writes [s].
        memory: The largest memory of a process [MB].
        memories: Process → the memory it used after each of its tasks [MB], in their order; of
            tasks that say it.
        processes: Key → the process that ran the task; of tasks that say it.
    """

    def __init__(self, path: Path) -> None:
        self.lines = Records(path)
        self.sessions: list[dict[str, Any]] = []
        self.memory = 0.0
        self.memories: dict[str, list[float]] = {}
        self.processes: dict[str, str] = {}

    @classmethod
    def read(cls, path: Path) -> JournalContents:
        """Return what a file says, be it while another process writes it.

        Raises:
            InputError: It cannot be read, or has a line that is none.
        """
        kept = JournalContents(path)
        try:
            with path.open("rb") as stream:
                kept._parse(path, stream)
        except OSError as error:
            raise InputError(
                "cannot read this", file=path, expected="a journal", got=error.strerror
            ) from error
        return kept

    @property
    def seconds(self) -> float:
        """How long the sessions took in all, each until the last of its tasks [s]."""
        return float(sum(session["seconds"] for session in self.sessions))

    def _parse(self, path: Path, lines: Iterable[bytes]) -> int:
        """Take note of all that whole lines say; return where they end [bytes]."""
        end = 0
        for number, text in enumerate(lines, start=1):
            if not text.endswith(b"\n"):
                break
            try:
                line = json.loads(text)
                if number == 1:
                    self._begin(line)
                else:
                    self._take(line, end)
            except (ValueError, LookupError, TypeError, AttributeError) as error:
                if isinstance(error, InputError):
                    raise
                expected = "the lines that a run writes"
                raise InputError(
                    "this line is damaged", file=path, line=number, expected=expected
                ) from error
            end += len(text)
        return end

    def _begin(self, header: Mapping[str, Any]) -> None:
        """Take note of the first line."""

    def _take(self, line: dict[str, Any], place: int) -> None:
        """Take note of a line that begins at some place [bytes]."""
        if "session" in line:
            self.sessions.append({**line["session"], "trials": 0, "seconds": 0.0})
            return
        if not isinstance(line["records"], list):
            raise TypeError("a task's records are a list")
        self.lines.note(line["key"], place)
        self.memory = max(self.memory, line["memory_mb"])
        self.sessions[-1]["trials"] += 1
        self.sessions[-1]["seconds"] = line["seconds"]
        if "client_seconds" in line:
            self.sessions[-1]["client_seconds"] = line["client_seconds"]
        if "process" in line:
            self.processes[line["key"]] = line["process"]
            self.memories.setdefault(line["process"], []).append(line["resident_mb"])


class Journal(JournalContents):
    """The finished tasks in a file: a header, then a line for each task and for each session of running them.

    Every line is whole, or the last one and taken off when the file is opened again.

    Args:
        path: The file, for messages.
        stream: The file, open for reading and appending ("a+b").
        header: Everything that what is kept depends on: plain data, fields by name, in groups.
        what: What is kept there, in messages.

    Raises:
        InputError: Another process has the file, it is not a journal, or its header is another one.
    """

    def __init__(
        self, path: Path, stream: IO[bytes], header: Mapping[str, Any], what: str = "trials"
    ) -> None:
        super().__init__(path)
        try:  # for this process alone
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                "another run is writing to this folder; wait for it, or use another", file=path
            ) from None
        self._path, self._stream, self._what = path, stream, what
        self._header = json.loads(json.dumps(header))
        stream.seek(0)
        self._end = self._parse(path, stream)
        if not self._end:
            self._check_begun()
        stream.truncate(self._end)  # removes the last line if it is incomplete
        if not self._end:
            self._write(self._header)

    def append(self, line: dict[str, Any]) -> None:
        """Write one line down, and take note of it."""
        place = self._end
        self._write(line)
        self._take(line, place)

    def _check_begun(self) -> None:
        """Raise InputError if a file without a whole line is not the beginning of the header."""
        header = _encode_line(self._header)
        self._stream.seek(0)
        if not header.startswith(begun := self._stream.read(len(header))):
            expected = "a new file, or the lines that a run writes"
            got = begun[:80].decode(errors="replace")
            raise InputError("not a journal", file=self._path, line=1, expected=expected, got=got)

    def _write(self, line: Mapping[str, Any]) -> None:
        text = _encode_line(line)
        self._stream.write(text)
        self._stream.flush()
        self._end += len(text)

    def _begin(self, header: Mapping[str, Any]) -> None:
        """Raise an error that names what differs between two headers, if anything does."""
        old, new = _flatten(header), _flatten(self._header)
        differing = [name for name in {**old, **new} if old.get(name) != new.get(name)]
        if differing:
            named = [name for name in differing if name != "specification"] or differing
            problem = f"the {self._what} in this folder were run otherwise; use another folder than {self._path.parent}"
            was, now = (
                ", ".join(f"{name.rpartition('.')[2]} {side.get(name)}" for name in named)
                for side in (old, new)
            )
            raise InputError(
                problem, file=self._path, field=", ".join(named), expected=was, got=now
            )


def _encode_line(data: Mapping[str, Any]) -> bytes:
    """Return plain data as a line of a journal."""
    return json.dumps(data, allow_nan=False).encode() + b"\n"


def _flatten(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a header by name: settings by their own, others as "versions.pin"."""
    flat: dict[str, Any] = {}
    for name, value in data.items():
        prefix = "" if name == "settings" else f"{name}."
        flat |= (
            {f"{prefix}{key}": item for key, item in value.items()}
            if isinstance(value, Mapping)
            else {name: value}
        )
    return flat
