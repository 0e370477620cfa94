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
# Sources among these that do.
_PLANNERS = "experiments/baselines/"
_SOURCES = (".py", ".cpp", ".hpp")
_DESCRIPTIONS = (".yaml", ".urdf", ".srdf")
# characters of a digest
_DIGEST_LENGTH = 12


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
    # The digest of the sources decides whether trials belong together.
    commit = about.pop("commit")
    about["versions"]["sources"] = _compute_sources_digest()
    keys = sorted(todo)
    specification = json.dumps([todo[key] for key in keys], sort_keys=True)
    header = {
        "settings": dict(settings),
        **about,
        "specification": hashlib.sha256(specification.encode()).hexdigest()[:_DIGEST_LENGTH],
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
        records: list[Mapping[str, Any]] = []
        for key in keys:
            records += journal.lines[key]
        sessions = journal.sessions
        peak_memory = round(journal.memory, 1)
    plain_settings = json.loads(json.dumps(dict(settings)))
    meta = {
        "commit": _list_commits(records) or commit,
        **about,
        **plain_settings,
        "sessions": sessions,
        "peak_memory_mb": peak_memory,
    }
    result = {"meta": meta, "trials": records}
    text = json.dumps(result, indent=1, allow_nan=False) + "\n"
    write_atomically(out / "results.csv", to_csv(records).encode())
    write_atomically(out / "results.json", text.encode())
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
    names = sorted(path.name for path in out.iterdir() if not path.is_dir())
    files = [name for name in names if not name.startswith(".")]
    if files and not any((out / name).is_file() for name in journals):
        raise InputError(
            "there are other files in this folder",
            file=out,
            field="out",
            expected="a new folder, or one with trials of this run",
            got=", ".join(files[:3]),
        )
    check_links(out)


def select_names(kind: str, names: Iterable[str], choices: Iterable[str]) -> tuple[str, ...]:
    """Return distinct names in the order of the choices.

    Raises:
        InputError: There are no names, or one is no choice.
    """
    names = list(names)
    choices = list(dict.fromkeys(choices))
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
    began = time.perf_counter()
    reported = set[str]()  # errors
    journal.append({"session": {"jobs": jobs}})
    tasks = ((str(trial["key"]), trial) for trial in trials)
    attempt = functools.partial(_attempt, function)
    results = run_tasks(attempt, tasks, jobs=jobs, scheduler=scheduler)
    with bar, contextlib.closing(results):
        for key, result in results:
            line = _describe_crash(key, result) if isinstance(result, CrashedTask) else result
            if any(record.get("status") == "interrupted" for record in line["records"]):
                raise KeyboardInterrupt
            journal.append({**line, "seconds": round(time.perf_counter() - began, 3)})
            bar.update()
            if "traceback" in line:
                (message,) = line["records"][0]["violations"]
                # Many trials may fail alike.
                detail = "" if message in reported else f"\n{line['traceback']}"
                text = f"{line['key']} failed with an error: {message}{detail}"
                tqdm.write(text, file=sys.stderr)
                reported.add(message)


def _attempt(function: Function, trial: dict[str, Any]) -> dict[str, Any]:
    """Run a trial and return its line of the journal."""
    trace: str | None = None
    try:
        result = function(dict(trial))
        found = [result] if isinstance(result, Mapping) else list(result)
        text = json.dumps([{"key": trial["key"], **record} for record in found], default=_convert)
        # JSON knows neither NaN nor infinity.
        records = json.loads(text, parse_constant=lambda _: None)
    except Exception as error:
        failure = _make_failure(f"{type(error).__name__}: {error}")
        records = [{**trial, **failure}]
        trace = traceback.format_exc()
    memory = round(measure_peak_memory(), 1)
    line = {"key": trial["key"], "memory_mb": memory, "records": records}
    if trace is not None:
        line["traceback"] = trace
    return line


def _describe_crash(key: str, crash: CrashedTask) -> dict[str, Any]:
    """Return the line of a trial that no process survived."""
    failure = {"key": key, **_make_failure(crash.reason)}
    return {"key": key, "memory_mb": 0.0, "records": [failure], "traceback": crash.reason}


def _make_failure(message: str) -> dict[str, Any]:
    """Return the fields of a record that an error ended."""
    return {
        "success": False,
        "status": "error",
        "failed_constraint": "error",
        "violations": [message],
    }


def _list_commits(records: Iterable[Mapping[str, Any]]) -> str:
    """Return the distinct commits of records."""
    commits = [str(record["commit"]) for record in records if record.get("commit")]
    return ", ".join(dict.fromkeys(commits))


def _convert(value: Any) -> Any:
    """Convert mappings and NumPy types for JSON."""
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"Object of type {type(value).__name__} is not JSON serializable")


def _compute_sources_digest() -> str:
    """Return a digest of the sources, scenes and robots that planning depends on."""
    package = find_package_folder()
    named: dict[str, Path] = {}
    for suffix in _SOURCES:
        for path in package.rglob(f"*{suffix}"):
            name = path.relative_to(package).as_posix()
            if name.startswith(_PLANNERS) or not name.startswith(_UNRELATED):
                named[name] = path
    for kind in ("scenes", "robots"):
        folder = find_resource_folder(kind)
        for path in folder.rglob("*"):
            if path.suffix in _DESCRIPTIONS:
                named[f"{kind}/{path.relative_to(folder).as_posix()}"] = path
    digest = hashlib.sha256()
    for name in sorted(named):
        digest.update(f"{name}\n".encode() + named[name].read_bytes())
    return digest.hexdigest()[:_DIGEST_LENGTH]
