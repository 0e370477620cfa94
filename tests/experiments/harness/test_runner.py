"""Tests that trials are run, recorded and resumed."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from helpers.trials import (
    SETTINGS,
    crash,
    divide_by_zero,
    identify_worker,
    make_trials,
    solve_square,
)

from vkc_pin import InputError
from vkc_pin.experiments.harness import runner
from vkc_pin.experiments.harness.runner import LIMITS, describe_limit


def test_description_states_evaluations_or_planning_time() -> None:
    assert describe_limit({**LIMITS, "seed": 3}) == "at most 1 000 000 evaluations"
    assert describe_limit({"time_limit": 20.0}) == "at most 20 s of planning"


class CountingSolver:
    """Runs `solve_square` and records the keys; an interrupt comes after `stop_after` trials."""

    def __init__(self, stop_after: int = 1000) -> None:
        self.keys: list[str] = []
        self.stop_after = stop_after

    def __call__(self, spec: dict[str, Any]) -> dict[str, Any]:
        if len(self.keys) == self.stop_after:
            raise KeyboardInterrupt
        self.keys.append(spec["key"])
        return solve_square(spec)


def run_trials(
    out: Path, function: Any = solve_square, number: int = 6, *, jobs: int = 1, **settings: Any
) -> dict[str, Any]:
    settings = {**SETTINGS, **settings}
    trials = make_trials(number)
    return runner.run(trials, function, out, settings=settings, jobs=jobs, progress=False)


def test_results_contain_records_and_settings(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    result = run_trials(out)
    assert json.loads((out / "results.json").read_text(encoding="utf-8")) == result
    assert [t["key"] for t in result["trials"]] == ["000", "001", "002", "003", "004", "005"]
    assert result["trials"][3] == {
        "key": "003",
        "number": 3,
        "square": 9,
        "evaluations": 1.0,
        "good": True,
        "start": [3.0, 0.1],
        "distance": None,
        "violations": ["a, b", 'c "d"'],
        "status": "success",
    }
    meta = result["meta"]
    assert {"pin", "casadi", "sources"} <= set(meta["versions"])
    assert "processor" in meta["machine"]
    assert (meta["benchmark"], meta["seed"], meta["scenes"]) == ("squares", 3, ["a", "b"])
    (session,) = meta["sessions"]
    assert (session["jobs"], session["trials"]) == (1, 6)
    assert 20.0 < meta["peak_memory_mb"] < 10_000.0


def test_csv_and_json_have_the_same_records(tmp_path: Path) -> None:
    result = run_trials(tmp_path, divide_by_zero)  # the failed trial has other fields
    with (tmp_path / "results.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(result["trials"]) == 6
    text_fields = {"key", "status", "failed_constraint"}
    for row, found in zip(rows, result["trials"], strict=True):
        assert set(row) >= set(found)
        for field, cell in row.items():
            value = None if cell == "" else cell if field in text_fields else json.loads(cell)
            assert value == found.get(field), field


def test_trial_may_have_several_records(tmp_path: Path) -> None:
    result = run_trials(tmp_path, lambda spec: [{"part": part} for part in "ba"], number=2)
    records = [(t["key"], t["part"]) for t in result["trials"]]
    assert records == [("000", "b"), ("000", "a"), ("001", "b"), ("001", "a")]


@pytest.mark.parametrize("stop_after", [0, 4])
def test_interrupted_run_is_resumed(tmp_path: Path, stop_after: int) -> None:
    first, second = CountingSolver(stop_after), CountingSolver()
    stopped, whole = tmp_path / "stopped", tmp_path / "whole"
    with pytest.raises(KeyboardInterrupt, match=f"{stop_after} of 6 trials are done"):
        run_trials(stopped, first)
    assert not (stopped / "results.json").exists()
    resumed = run_trials(stopped, second)
    assert len(first.keys) == stop_after
    assert first.keys + second.keys == [t["key"] for t in make_trials()]  # not sorted by key
    assert [s["trials"] for s in resumed["meta"]["sessions"]] == [stop_after, 6 - stop_after]
    assert resumed["trials"] == run_trials(whole)["trials"]
    assert (stopped / "results.csv").read_bytes() == (whole / "results.csv").read_bytes()


def test_interrupted_record_interrupts_the_run(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt, match="0 of 6"):
        run_trials(tmp_path, lambda spec: {**solve_square(spec), "status": "interrupted"})
    assert run_trials(tmp_path)["trials"][0]["status"] == "success"


def test_trial_of_a_truncated_last_line_is_run_again(tmp_path: Path) -> None:
    whole, file = run_trials(tmp_path), tmp_path / "trials.jsonl"
    lines = file.read_bytes().splitlines(keepends=True)
    assert len(lines) == 2 + 6  # header, session, trials in the order of running
    for count in (0, 1, 3, 7):
        file.write_bytes(b"".join(lines[:count]) + lines[count][:-1])
        again = CountingSolver()
        assert run_trials(tmp_path, again)["trials"] == whole["trials"]
        assert again.keys == [t["key"] for t in make_trials()][max(count - 2, 0) :]


def test_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    for name in ("table.md", "results.json", "thesis.tex"):
        (tmp_path / name).mkdir()
        assert run_trials(tmp_path / name)["trials"]
        out = tmp_path / "own" / name
        out.mkdir(parents=True)
        (out / name).write_text("mine")
        with pytest.raises(InputError, match="there are other files in this folder") as caught:
            run_trials(out)
        assert (caught.value.file, caught.value.got) == (out, name)
        assert [(path.name, path.read_text()) for path in out.iterdir()] == [(name, "mine")]
    (tmp_path / "folders" / "objects").mkdir(parents=True)
    (tmp_path / "folders" / ".gitignore").touch()
    assert run_trials(tmp_path / "folders")["trials"]


@pytest.mark.parametrize(
    "name", ["results.csv", "results.json", "table.md", "trials.jsonl", "deep/x"]
)
def test_symbolic_links_out_of_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    out = tmp_path / "out"
    run_trials(out)
    (out / "deep").mkdir()
    (tmp_path / "mine").write_bytes((out / name).read_bytes() if (out / name).is_file() else b"")
    before = (tmp_path / "mine").read_bytes()
    (out / name).unlink(missing_ok=True)
    (out / name).symlink_to("../../mine" if "/" in name else "../mine")
    with pytest.raises(InputError, match="a symbolic link leads out of the folder"):
        run_trials(out)
    assert (tmp_path / "mine").read_bytes() == before


def test_changed_settings_and_versions_are_refused(tmp_path: Path) -> None:
    run_trials(tmp_path)
    before = (tmp_path / "trials.jsonl").read_bytes()
    with pytest.raises(InputError, match="use another folder") as caught:
        run_trials(tmp_path, seed=4, methods=["x"])
    for part in ("seed 3", "seed 4", "methods None", "methods ['x']", str(tmp_path)):
        assert part in str(caught.value)
    assert caught.value.field == "seed, methods"
    with pytest.raises(InputError, match="specification"):  # same settings, other trials
        run_trials(tmp_path, number=5)
    assert (tmp_path / "trials.jsonl").read_bytes() == before
    (tmp_path / "trials.jsonl").write_bytes(before.replace(b'"sources": "', b'"sources": "x'))
    with pytest.raises(InputError, match=r"versions\.sources.*expected sources x"):
        run_trials(tmp_path)


@pytest.mark.parametrize(
    ("name", "is_resumed"),
    [
        ("planning/solver/elimination.hpp", False),
        ("planning/solver/_kkt.cpp", False),
        ("planning/planner.py", False),
        ("utils/parallel.py", True),
        ("utils/journal.py", True),
        ("cli/door.py", True),
    ],
)
def test_resuming_with_other_sources_of_planning_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, is_resumed: bool
) -> None:
    source = tmp_path / "package" / name
    source.parent.mkdir(parents=True)
    source.write_text("before", encoding="utf-8")
    monkeypatch.setattr(runner, "find_package_folder", lambda: tmp_path / "package")
    run_trials(tmp_path / "out")
    source.write_text("after", encoding="utf-8")
    with contextlib.nullcontext() if is_resumed else pytest.raises(InputError, match="sources"):
        run_trials(tmp_path / "out")


def test_workers_of_a_scheduler_run_the_trials(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(host="127.0.0.1", **options) as cluster:
        how = {"settings": SETTINGS, "scheduler": cluster.scheduler_address, "progress": False}
        trials = runner.run(make_trials(2), identify_worker, tmp_path, **how)["trials"]
    assert {t["process"] for t in trials}.isdisjoint({os.getpid()})


def test_results_are_the_same_for_any_number_of_jobs(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    one, two = tmp_path / "one", tmp_path / "two"
    assert run_trials(two, jobs=2)["trials"] == run_trials(one)["trials"]
    assert (two / "results.csv").read_bytes() == (one / "results.csv").read_bytes()


@pytest.mark.parametrize("jobs", [1, 2])
def test_error_is_recorded_as_failure(
    tmp_path: Path, jobs: int, capsys: pytest.CaptureFixture[str]
) -> None:
    if jobs > 1:
        pytest.importorskip("distributed")
    records = run_trials(tmp_path, divide_by_zero, jobs=jobs)["trials"]
    assert records[2] == {
        "key": "002",
        "number": 2,
        "success": False,
        "status": "error",
        "failed_constraint": "error",
        "violations": ["ZeroDivisionError: nothing to divide by"],
    }
    assert [t["status"] for t in records].count("error") == 1
    stderr = capsys.readouterr().err
    for part in ("002 failed with an error", "nothing to divide by", "in divide_by_zero"):
        assert part in stderr


@pytest.mark.long
def test_trial_that_kills_its_processes_is_recorded_as_failure(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    records = run_trials(tmp_path / "out", crash, jobs=2)["trials"]
    whole = run_trials(tmp_path / "whole")["trials"]
    failed = records.pop(2)
    assert (failed["success"], failed["status"]) == (False, "error")
    assert "4 processes died" in failed["violations"][0]
    assert records == [record for record in whole if record["number"] != 2]


def test_wrong_arguments_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(InputError, match="no folder"):
            run_trials(out)
    with pytest.raises(InputError, match="same key"):
        runner.run([*make_trials(2), *make_trials(1)], solve_square, tmp_path, settings=SETTINGS)
    with pytest.raises(InputError, match="jobs"):
        run_trials(tmp_path, jobs=0)


SCRIPT = """
import sys, time
from vkc_pin.experiments.harness import runner
from helpers.trials import SETTINGS, make_trials, solve_slowly
more = {"settings": SETTINGS, "jobs": int(sys.argv[2]), "progress": False}
runner.run(make_trials(), solve_slowly, sys.argv[1], **more)
"""


@pytest.mark.long
@pytest.mark.parametrize(("jobs", "kind"), [(1, signal.SIGKILL), (2, signal.SIGINT)])
def test_stopped_process_keeps_finished_trials(
    tmp_path: Path, jobs: int, kind: signal.Signals
) -> None:
    path = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(tmp_path), str(jobs)],
        start_new_session=True,  # a process group, like that of a command in a terminal
        # Children of background jobs inherit SIG_IGN.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    file, deadline = tmp_path / "trials.jsonl", time.monotonic() + 60.0
    while not (file.exists() and file.read_bytes().count(b"\n") >= 4):
        assert time.monotonic() < deadline
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.02)
    os.killpg(process.pid, kind)  # like Ctrl-C, which all processes receive
    _, stderr = process.communicate(timeout=30)
    assert ("of 6 trials are done" in stderr) == (kind == signal.SIGINT)
    counting = CountingSolver()
    assert run_trials(tmp_path, counting)["trials"] == run_trials(tmp_path / "whole")["trials"]
    assert 0 < len(counting.keys) <= 4
