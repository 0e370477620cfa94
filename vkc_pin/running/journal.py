"""What was run, in a file that one process writes: nothing that is in it is run again, whatever stopped the run."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from vkc_pin.errors import InputError

__all__ = ["Journal", "Kept"]


class Kept:
    """What a journal says.

    Attributes:
        lines: Key → records of every finished task.
        sessions: For each session its jobs, the number of tasks, the time until the last of them [s] and, if tasks say it, the
            processor time until then of the process that writes [s].
        memory: The largest memory of a process [MB].
        memories: Process → the memory it used after each of its tasks [MB], in their order; of tasks that say it.
        processes: Key → the process that ran the task; of tasks that say it.
    """

    def __init__(self) -> None:
        self.lines: dict[str, list[dict[str, Any]]] = {}
        self.sessions: list[dict[str, Any]] = []
        self.memory = 0.0
        self.memories: dict[str, list[float]] = {}
        self.processes: dict[str, str] = {}

    @classmethod
    def read(cls, path: Path) -> Kept:
        """Return what a file says, be it while another process writes it.

        Raises:
            InputError: It cannot be read, or has a line that is none.
        """
        kept = Kept()
        try:
            whole = path.read_bytes().rpartition(b"\n")[0]
        except OSError as error:
            raise InputError("cannot read this", file=path, expected="a journal", got=error.strerror) from error
        if whole:
            kept._parse(path, whole)
        return kept

    @property
    def seconds(self) -> float:
        """How long the sessions took in all, each until the last of its tasks [s]."""
        return float(sum(session["seconds"] for session in self.sessions))

    def _parse(self, path: Path, whole: bytes) -> None:
        """Take note of all that whole lines say."""
        for number, text in enumerate(whole.split(b"\n"), start=1):
            try:
                line = json.loads(text)
                if number == 1:
                    self._begin(line)
                else:
                    self._take(line)
            except (ValueError, LookupError, TypeError, AttributeError) as error:
                if isinstance(error, InputError):
                    raise
                expected = "the lines that a run writes"
                raise InputError("this line is damaged", file=path, line=number, expected=expected) from error

    def _begin(self, header: Mapping[str, Any]) -> None:
        """Take note of the first line."""

    def _take(self, line: dict[str, Any]) -> None:
        if "session" in line:
            self.sessions.append({**line["session"], "trials": 0, "seconds": 0.0})
            return
        self.lines[line["key"]] = line["records"]
        self.memory = max(self.memory, line["memory_mb"])
        self.sessions[-1]["trials"] += 1
        self.sessions[-1]["seconds"] = line["seconds"]
        if "client_seconds" in line:
            self.sessions[-1]["client_seconds"] = line["client_seconds"]
        if "process" in line:
            self.processes[line["key"]] = line["process"]
            self.memories.setdefault(line["process"], []).append(line["resident_mb"])


class Journal(Kept):
    """The finished tasks in a file: a header, then a line for each task and for each session of running them.

    Every line is whole, or the last one and taken off when the file is opened again.

    Args:
        path: The file, for messages.
        stream: The file, open for reading and appending ("a+b").
        header: Everything that what is kept depends on: plain data, fields by name, in groups.
        what: What is kept there, in messages.

    Raises:
        InputError: Another process has the file, it has another header, or a line that is none.
    """

    def __init__(self, path: Path, stream: IO[bytes], header: Mapping[str, Any], what: str = "trials") -> None:
        super().__init__()
        try:  # for this process alone
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError("another run is writing to this folder; wait for it, or use another", file=path) from None
        self._path, self._stream, self._what = path, stream, what
        self._header = json.loads(json.dumps(header))
        stream.seek(0)
        whole, newline, torn = stream.read().rpartition(b"\n")
        if torn:  # what a kill left of the last line
            stream.truncate(len(whole) + len(newline))
        if newline:
            self._parse(path, whole)
        else:
            self._write(self._header)

    def append(self, line: dict[str, Any]) -> None:
        """Write one line down, and take note of it."""
        self._write(line)
        self._take(line)

    def _write(self, line: Mapping[str, Any]) -> None:
        self._stream.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._stream.flush()

    def _begin(self, header: Mapping[str, Any]) -> None:
        """Raise an error that names what differs between two headers, if anything does."""
        old, new = _flat(header), _flat(self._header)
        differing = [name for name in {**old, **new} if old.get(name) != new.get(name)]
        if differing:
            named = [name for name in differing if name != "specification"] or differing
            problem = f"the {self._what} in this folder were run otherwise; use another folder than {self._path.parent}"
            was, now = (", ".join(f"{name.rpartition('.')[2]} {side.get(name)}" for name in named) for side in (old, new))
            raise InputError(problem, file=self._path, field=", ".join(named), expected=was, got=now)


def _flat(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a header by name: settings by their own, others as "versions.pin"."""
    flat: dict[str, Any] = {}
    for name, value in data.items():
        prefix = "" if name == "settings" else f"{name}."
        flat |= {f"{prefix}{key}": item for key, item in value.items()} if isinstance(value, Mapping) else {name: value}
    return flat
