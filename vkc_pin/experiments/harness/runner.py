"""Runs the trials of an experiment in several processes, and resumes stopped runs."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from tqdm import tqdm

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.experiments.harness.record import describe_environment
from vkc_pin.experiments.harness.tables import to_csv
from vkc_pin.utils.journal import Journal
from vkc_pin.utils.parallel import CrashedTask, check_processes, run_tasks
from vkc_pin.utils.system import measure_peak_memory
from vkc_pin.world.files.resources import find_package_folder, find_resource_folder
from vkc_pin.world.files.writing import check_links, check_writable, write_atomically

MAX_EVALUATIONS = 1_000_000
"""Several times the evaluations of a usual trial."""
TIME_LIMIT = 1800.0
"""Wall time of a call [s]; trials that it ends are no results of the method."""
LIMITS: Mapping[str, Any] = {"max_evaluations": MAX_EVALUATIONS, "time_limit": TIME_LIMIT}
"""Both, as arguments of planners, and for the record."""

Function = Callable[[dict[str, Any]], Mapping[str, Any] | Sequence[Mapping[str, Any]]]
"""What runs one trial: takes its specification, returns its record, or several."""
_JOURNAL = "trials.jsonl"
# Sources that do not affect a trial: a run may be resumed after a change there.
_UNRELATED = ("cli/", "datasets/", "experiments/", "utils/parallel.py", "utils/journal.py")
_PLANNERS = "experiments/baselines/"  # affect trials
_DESCRIPTIONS = (".yaml", ".urdf", ".srdf")


def describe_limit(about: Mapping[str, Any]) -> str:
    """Return the limit of a record's trials in words; old records limit planning time."""
    if "max_evaluations" in about:
        return f"at most {about['max_evaluations']:,} evaluations".replace(",", " ")
    return f"at most {about['time_limit']:g} s of planning"


class Execution(TypedDict, total=False):
    """How `run` executes trials.

    Attributes:
        jobs: Number of processes, each with one thread of BLAS; more than 1 need the extra
            `cluster`. Default: this process alone.
        scheduler: Address of a Dask scheduler whose workers run the trials instead; see
            `parallel.run_tasks`.
        progress: Whether to show a progress bar. Default: True.
    """

    jobs: int
    scheduler: str | None
    progress: bool


def run(
    trials: Sequence[Mapping[str, Any]],
    function: Function,
    out: str | Path,
    *,
    settings: Mapping[str, Any],
    format_results: Callable[[dict[str, Any]], str] | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run `function` on every trial that `out` does not have yet.

    Every finished trial is appended to `out`/trials.jsonl at once, so that the same call resumes a
    stopped run. At the end, `out` has results.json and results.csv with the records in the order of
    their keys, which depend neither on `jobs` nor on stops, measured times excepted.

    Args:
        trials: Plain data with a unique text `key` each, in the order of execution. Processes cache
            symbolic programs: keep trials that share one together.
        function: Runs a trial; importable by other processes. An exception is recorded as a failure
            with status "error". A record with status "interrupted" counts as Ctrl-C.
        out: Folder, created if necessary.
        settings: Settings that determine the results, as plain data.
        format_results: Makes `out`/table.md of a result.
        jobs: See `Execution`.
        scheduler: See `Execution`.
        progress: See `Execution`.

    Returns:
        {"meta": commit, versions, machine, settings, sessions, peak_memory_mb, "trials": records}.

    Raises:
        InputError: `out` has trials of other settings, versions or machines, has other files but no
            trials, is no folder, or is used by another run.
        KeyboardInterrupt: Ctrl-C was pressed; the message counts the finished trials.
    """
    check_positive(jobs=jobs)
    check_processes(jobs, scheduler)
    todo = {str(trial["key"]): dict(trial) for trial in trials}
    if len(todo) < len(trials):
        raise InputError("two trials have the same key", field="trials")
    out = Path(out)
    check_folder(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError("this is no folder", file=out, field="out") from None
    check_writable(out / _JOURNAL)
    about = describe_environment()
    made = about.pop("commit")  # the digest of the sources decides whether trials belong together
    about["versions"]["sources"] = _sources()
    described = json.dumps([todo[key] for key in sorted(todo)], sort_keys=True).encode()
    header = {
        "settings": dict(settings),
        **about,
        "specification": hashlib.sha256(described).hexdigest()[:12],
    }
    with (out / _JOURNAL).open("a+b") as stream:
        journal = Journal(out / _JOURNAL, stream, header)
        left = [trial for key, trial in todo.items() if key not in journal.lines]
        if left:
            done = len(todo) - len(left)
            bar = tqdm(
                total=len(todo), initial=done, unit="trial", smoothing=0.05, disable=not progress
            )
            try:
                _run(left, function, journal, jobs, scheduler, bar)
            except KeyboardInterrupt:
                raise KeyboardInterrupt(
                    f"{len(journal.lines)} of {len(todo)} trials are done and kept in {out}"
                ) from None
        records = [record for key in sorted(todo) for record in journal.lines[key]]
        measured = {"sessions": journal.sessions, "peak_memory_mb": round(journal.memory, 1)}
    result = {
        "meta": {
            "commit": _commits(records) or made,
            **about,
            **json.loads(json.dumps(dict(settings))),
            **measured,
        },
        "trials": records,
    }
    write_atomically(out / "results.csv", to_csv(records).encode())
    write_atomically(
        out / "results.json", (json.dumps(result, indent=1, allow_nan=False) + "\n").encode()
    )
    if format_results is not None:
        write_atomically(out / "table.md", format_results(result).encode())
    return result


def check_folder(out: str | Path, journals: Sequence[str] = (_JOURNAL,)) -> None:
    """Check that a folder holds a run or no files, so that none are overwritten.

    Args:
        out: Folder. Its subfolders may have any content.
        journals: Paths in the folder, one of which every run has.

    Raises:
        InputError: The folder has files but no journal, or a symbolic link that leads out of it.
    """
    out = Path(out)
    if not out.is_dir():
        return
    files = sorted(
        path.name for path in out.iterdir() if not path.is_dir() and not path.name.startswith(".")
    )
    if files and not any((out / name).is_file() for name in journals):
        expected = "a new folder, or one with trials of this run"
        problem, got = "there are other files in this folder", ", ".join(files[:3])
        raise InputError(problem, file=out, field="out", expected=expected, got=got)
    check_links(out)


def select_names(kind: str, names: Iterable[str], choices: Iterable[str]) -> tuple[str, ...]:
    """Return distinct names in the order of the choices.

    Raises:
        InputError: There are no names, or one is no choice.
    """
    names, choices = list(names), list(dict.fromkeys(choices))
    for name in names:
        if name not in choices:
            raise UnknownNameError(kind, name, choices, field=f"{kind}s")
    if not names:
        raise InputError("there is nothing to run", field=f"{kind}s", expected="at least one")
    return tuple(choice for choice in choices if choice in names)


def check_positive(**counts: int) -> None:
    """Raise `InputError` for counts below 1, by the names of their fields."""
    for field, count in counts.items():
        if count < 1:
            raise InputError("out of range", field=field, expected="at least 1", got=count)


def _run(
    trials: Sequence[dict[str, Any]],
    function: Function,
    journal: Journal,
    jobs: int,
    scheduler: str | None,
    bar: Any,
) -> None:
    """Run trials, append each to the journal, and print errors."""
    began, told = time.perf_counter(), set[str]()
    journal.append({"session": {"jobs": jobs}})
    tasks = ((str(trial["key"]), trial) for trial in trials)
    found = run_tasks(functools.partial(_attempt, function), tasks, jobs=jobs, scheduler=scheduler)
    with bar, contextlib.closing(found) as lines:
        for key, line in lines:
            line = _given_up(key, line) if isinstance(line, CrashedTask) else line
            if any(record.get("status") == "interrupted" for record in line["records"]):
                raise KeyboardInterrupt
            journal.append({**line, "seconds": round(time.perf_counter() - began, 3)})
            bar.update()
            if "traceback" in line:
                (message,) = line["records"][0]["violations"]
                # Many trials may fail alike.
                detail = "" if message in told else f"\n{line['traceback']}"
                tqdm.write(
                    f"{line['key']} failed with an error: {message}{detail}", file=sys.stderr
                )
                told.add(message)


def _attempt(function: Function, trial: dict[str, Any]) -> dict[str, Any]:
    """Run a trial and return its line of the journal."""
    key, more = trial["key"], {}
    try:
        result = function(dict(trial))
        found = [result] if isinstance(result, Mapping) else list(result)
        text = json.dumps([{"key": key, **record} for record in found], default=_plain)
        records = json.loads(text, parse_constant=lambda _: None)  # numbers that JSON does not know
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
        failure = {
            "success": False,
            "status": "error",
            "failed_constraint": "error",
            "violations": [message],
        }
        records, more = [{**trial, **failure}], {"traceback": traceback.format_exc()}
    return {"key": key, "memory_mb": round(measure_peak_memory(), 1), "records": records, **more}


def _given_up(key: str, died: CrashedTask) -> dict[str, Any]:
    """Return the line of a trial that no process survived."""
    failure = {
        "key": key,
        "success": False,
        "status": "error",
        "failed_constraint": "error",
        "violations": [died.reason],
    }
    return {"key": key, "memory_mb": 0.0, "records": [failure], "traceback": died.reason}


def _commits(records: Iterable[Mapping[str, Any]]) -> str:
    """Return the distinct commits of records."""
    return ", ".join(
        dict.fromkeys(str(record["commit"]) for record in records if record.get("commit"))
    )


def _plain(value: Any) -> Any:
    """Convert mappings and NumPy types for JSON."""
    if not isinstance(value, Mapping | np.ndarray | np.generic):
        raise TypeError(f"Object of type {type(value).__name__} is not JSON serializable")
    return dict(value) if isinstance(value, Mapping) else value.tolist()


def _sources() -> str:
    """Return a digest of the sources, scenes and robots that planning depends on."""
    package, digest = find_package_folder(), hashlib.sha256()
    named = {
        path.relative_to(package).as_posix(): path
        for suffix in ("py", "cpp", "hpp")
        for path in package.rglob(f"*.{suffix}")
    }
    named = {
        name: path
        for name, path in named.items()
        if name.startswith(_PLANNERS) or not name.startswith(_UNRELATED)
    }
    for kind in ("scenes", "robots"):
        files = (
            path for path in find_resource_folder(kind).rglob("*") if path.suffix in _DESCRIPTIONS
        )
        named |= {
            f"{kind}/{path.relative_to(find_resource_folder(kind)).as_posix()}": path
            for path in files
        }
    for name in sorted(named):
        digest.update(f"{name}\n".encode() + named[name].read_bytes())
    return digest.hexdigest()[:12]
