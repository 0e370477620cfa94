"""Runs the trials of an experiment on several processes; keeps each as soon as it is done, and goes on where it was stopped."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from vkc_pin.benchmarks.harness.record import meta, peak_memory
from vkc_pin.benchmarks.harness.tables import to_csv
from vkc_pin.errors import InputError, UnknownNameError, VkcError
from vkc_pin.files.resources import folder, package_folder
from vkc_pin.files.writing import check_writable, write_atomically

__all__ = ["Function", "chosen", "run"]

Function = Callable[[dict[str, Any]], Mapping[str, Any] | Sequence[Mapping[str, Any]]]
"""What runs one trial: takes its specification, returns its record, or several."""

# What shows results has no part in them: a table may be written anew after a change there.
_NO_PART = ("cli/", "benchmarks/")
_DESCRIPTIONS = (".yaml", ".urdf", ".srdf")


def run(
    trials: Sequence[Mapping[str, Any]],
    function: Function,
    out: str | Path,
    *,
    settings: Mapping[str, Any],
    report: Callable[[dict[str, Any]], str] | None = None,
    jobs: int = 1,
    progress: bool = True,
) -> dict[str, Any]:
    """Run `function` on every trial, but for those that `out` has already.

    Every finished trial is a line of `out`/trials.jsonl at once, so a stop, of whatever kind, loses only those that were
    running; the same call goes on from there. At the end `out` has results.json and results.csv with the records in the
    order of their keys: neither `jobs` nor stops make a difference to them, but for measured times.

    Args:
        trials: Plain data, each with a text `key` of its own. They are begun in this order, and a process keeps what it has
            built: put those that share a symbolic program together.
        function: What runs a trial. It must be importable by other processes if `jobs` > 1. If it raises an exception, that
            is printed, and the trial is recorded as a failure of status "error". A record of status "interrupted" counts as
            Ctrl-C.
        out: The folder, made if need be.
        settings: Everything that the results depend on, as plain data; goes into the results' "meta".
        report: What makes of a result the text of `out`/table.md.
        jobs: Number of processes, each with one thread of BLAS; 1 runs all trials in this process.
        progress: Whether to show a progress bar.

    Returns:
        {"meta": versions, machine, settings, sessions, peak_memory_mb, "trials": records}, as in results.json.

    Raises:
        InputError: `out` has trials of other settings, versions or machines, is no folder, or is in use by another run.
        VkcError: A process died.
        KeyboardInterrupt: Ctrl-C was pressed; the message says how far it came.
    """
    if jobs < 1:
        raise InputError("out of range", field="jobs", expected="at least 1", got=jobs)
    todo = {str(trial["key"]): dict(trial) for trial in trials}
    if len(todo) < len(trials):
        raise InputError("two trials have the same key", field="trials")
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError("this is no folder", file=out, field="out") from None
    check_writable(out / "trials.jsonl")
    about = meta()
    about["versions"]["sources"] = _sources()
    described = json.dumps([todo[key] for key in sorted(todo)], sort_keys=True).encode()
    header = {"settings": dict(settings), **about, "specification": hashlib.sha256(described).hexdigest()[:12]}
    with (out / "trials.jsonl").open("a+b") as stream:
        journal = _Journal(out / "trials.jsonl", stream, header)
        left = [trial for key, trial in todo.items() if key not in journal.lines]
        if left:
            done = len(todo) - len(left)
            bar = tqdm(total=len(todo), initial=done, unit="trial", smoothing=0.05, disable=not progress)
            try:
                _run(left, function, journal, jobs, bar)
            except KeyboardInterrupt:
                raise KeyboardInterrupt(f"{len(journal.lines)} of {len(todo)} trials are done and kept in {out}") from None
        records = [record for key in sorted(todo) for record in journal.lines[key]]
        measured = {"sessions": journal.sessions, "peak_memory_mb": round(journal.memory, 1)}
    result = {"meta": {**about, **json.loads(json.dumps(dict(settings))), **measured}, "trials": records}
    write_atomically(out / "results.csv", to_csv(records).encode())
    write_atomically(out / "results.json", (json.dumps(result, indent=1, allow_nan=False) + "\n").encode())
    if report is not None:
        write_atomically(out / "table.md", report(result).encode())
    return result


def chosen(kind: str, names: Iterable[str], choices: Iterable[str]) -> tuple[str, ...]:
    """Return names of a `kind` without repetition, in the order of the choices.

    Raises:
        UnknownNameError: One of them is none of the choices.
        InputError: There are none.
    """
    names, choices = list(names), list(dict.fromkeys(choices))
    for name in names:
        if name not in choices:
            raise UnknownNameError(kind, name, choices, field=f"{kind}s")
    if not names:
        raise InputError("there is nothing to run", field=f"{kind}s", expected="at least one")
    return tuple(choice for choice in choices if choice in names)


def _run(trials: Sequence[dict[str, Any]], function: Function, journal: _Journal, jobs: int, bar: Any) -> None:
    """Run `trials`, write each down as it comes, and print what went wrong."""
    began, told = time.perf_counter(), set[str]()
    journal.append({"session": {"jobs": jobs}})
    with bar, contextlib.closing(_lines(trials, function, jobs)) as lines:
        for line in lines:
            if any(record.get("status") == "interrupted" for record in line["records"]):
                raise KeyboardInterrupt
            journal.append({**line, "seconds": round(time.perf_counter() - began, 3)})
            bar.update()
            if "traceback" in line:
                (message,) = line["records"][0]["violations"]
                detail = "" if message in told else f"\n{line['traceback']}"  # many trials may fail in the same way
                tqdm.write(f"{line['key']} failed with an error: {message}{detail}", file=sys.stderr)
                told.add(message)


def _lines(trials: Sequence[dict[str, Any]], function: Function, jobs: int) -> Generator[dict[str, Any]]:
    """Yield what is to be written down of each trial, in the order in which they end."""
    if jobs == 1:
        for trial in trials:
            yield _attempt(function, trial)
        return
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import BrokenProcessPool

    # Batches of one: a batch comes back as a whole, and a stop would lose all of it.
    with parallel_config(backend="loky", n_jobs=jobs, inner_max_num_threads=1):
        parallel = Parallel(return_as="generator_unordered", batch_size=1, max_nbytes=None)
        lines = parallel(delayed(_attempt_elsewhere)(function, trial, os.getpid()) for trial in trials)
    try:
        yield from lines
    except BrokenProcessPool as error:
        problem = "a process died, perhaps for want of memory; the trials that were done are kept, and the same call goes on"
        raise VkcError(f"{problem} ({str(error).splitlines()[0]})") from error
    finally:
        with contextlib.suppress(KeyboardInterrupt):  # this ends the other processes' trials if some are still running
            lines.close()


def _attempt_elsewhere(function: Function, trial: dict[str, Any], parent: int) -> dict[str, Any]:
    """Run one trial in a process of its own, which leaves Ctrl-C, that reaches all processes, to `parent` and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(parent)
    return _attempt(function, trial)


@cache
def _end_with(parent: int) -> None:
    """Let this process end soon after `parent` was killed, instead of working on for nobody."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _attempt(function: Function, trial: dict[str, Any]) -> dict[str, Any]:
    """Run one trial and return its line; an exception becomes a failure on record."""
    key, more = trial["key"], {}
    try:
        result = function(dict(trial))
        found = [result] if isinstance(result, Mapping) else list(result)
        text = json.dumps([{"key": key, **record} for record in found], default=_plain)
        records = json.loads(text, parse_constant=lambda _: None)  # numbers that JSON does not know
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
        failure = {"success": False, "status": "error", "failed_constraint": "error", "violations": [message]}
        records, more = [{**trial, **failure}], {"traceback": traceback.format_exc()}
    return {"key": key, "memory_mb": round(peak_memory(), 1), "records": records, **more}


def _plain(value: Any) -> Any:
    """Return what JSON makes of a mapping, or of NumPy's types."""
    if not isinstance(value, Mapping | np.ndarray | np.generic):
        raise TypeError(f"Object of type {type(value).__name__} is not JSON serializable")
    return dict(value) if isinstance(value, Mapping) else value.tolist()


def _sources() -> str:
    """Return a digest of all that planning depends on here: the package's sources, scenes and robots."""
    package, digest = package_folder(), hashlib.sha256()
    named = {path.relative_to(package).as_posix(): path for suffix in ("py", "cpp") for path in package.rglob(f"*.{suffix}")}
    named = {name: path for name, path in named.items() if not name.startswith(_NO_PART)}
    for kind in ("scenes", "robots"):
        files = (path for path in folder(kind).rglob("*") if path.suffix in _DESCRIPTIONS)
        named |= {f"{kind}/{path.relative_to(folder(kind)).as_posix()}": path for path in files}
    for name in sorted(named):
        digest.update(f"{name}\n".encode() + named[name].read_bytes())
    return digest.hexdigest()[:12]


class _Journal:
    """The finished trials in a file: a header, then a line for each trial and for each session of running them.

    Attributes:
        lines: Key → records of every finished trial.
        sessions: For each session its jobs, the number of trials and the time until the last of them [s].
        memory: The largest memory of a process [MB].
    """

    def __init__(self, path: Path, stream: Any, header: Mapping[str, Any]) -> None:
        try:  # for this process alone
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError("another run is writing to this folder; wait for it, or use another", file=path) from None
        self._path, self._stream = path, stream
        self.lines: dict[str, list[dict[str, Any]]] = {}
        self.sessions: list[dict[str, Any]] = []
        self.memory = 0.0
        stream.seek(0)
        whole, newline, torn = stream.read().rpartition(b"\n")
        if torn:  # what a kill left of the last line
            stream.truncate(len(whole) + len(newline))
        header = json.loads(json.dumps(header))
        if not newline:
            self._write(header)
            return
        for number, text in enumerate(whole.split(b"\n"), start=1):
            try:
                line = json.loads(text)
                if number == 1:
                    self._compare(line, header)
                else:
                    self._take(line)
            except (ValueError, LookupError, TypeError, AttributeError) as error:
                if isinstance(error, InputError):
                    raise
                expected = "the lines that an experiment writes"
                raise InputError("this line is damaged", file=path, line=number, expected=expected) from error

    def append(self, line: dict[str, Any]) -> None:
        """Write one line down, and take note of it."""
        self._write(line)
        self._take(line)

    def _write(self, line: Mapping[str, Any]) -> None:
        self._stream.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._stream.flush()

    def _take(self, line: dict[str, Any]) -> None:
        if "session" in line:
            self.sessions.append({**line["session"], "trials": 0, "seconds": 0.0})
            return
        self.lines[line["key"]] = line["records"]
        self.memory = max(self.memory, line["memory_mb"])
        self.sessions[-1]["trials"] += 1
        self.sessions[-1]["seconds"] = line["seconds"]

    def _compare(self, there: Mapping[str, Any], here: Mapping[str, Any]) -> None:
        """Raise an error that names what differs between two headers, if anything does."""
        old, new = _flat(there), _flat(here)
        differing = [name for name in {**old, **new} if old.get(name) != new.get(name)]
        if differing:
            named = [name for name in differing if name != "specification"] or differing
            problem = f"the trials in this folder were run otherwise; use another folder than {self._path.parent}"
            was, now = (", ".join(f"{name.rpartition('.')[2]} {side.get(name)}" for name in named) for side in (old, new))
            raise InputError(problem, file=self._path, field=", ".join(named), expected=was, got=now)


def _flat(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a header by name: settings by their own, others as "versions.pin"."""
    flat: dict[str, Any] = {}
    for name, value in data.items():
        prefix = "" if name == "settings" else f"{name}."
        flat |= {f"{prefix}{key}": item for key, item in value.items()} if isinstance(value, Mapping) else {name: value}
    return flat
