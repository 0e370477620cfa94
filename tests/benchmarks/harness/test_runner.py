from __future__ import annotations

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
from helpers.trials import SETTINGS, fatal, mistaken, square, trials, where

from vkc_pin.benchmarks.harness import record, runner
from vkc_pin.errors import InputError, VkcError


@pytest.fixture(autouse=True)
def same_sources(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sources may be worked on while the tests run, but for the test that is about them."""
    if "sources" not in request.node.name:
        monkeypatch.setattr(runner, "_sources", lambda: "abc")


class Counting:
    """`square`, which notes what it was asked for and is stopped by Ctrl-C after some trials."""

    def __init__(self, until: int = 1000) -> None:
        self.asked: list[str] = []
        self.until = until

    def __call__(self, spec: dict[str, Any]) -> dict[str, Any]:
        if len(self.asked) == self.until:
            raise KeyboardInterrupt
        self.asked.append(spec["key"])
        return square(spec)


def run(
    out: Path, function: Any = square, number: int = 6, jobs: int = 1, **settings: Any
) -> dict[str, Any]:
    return runner.run(
        trials(number), function, out, settings={**SETTINGS, **settings}, jobs=jobs, progress=False
    )


def read(out: Path) -> dict[str, Any]:
    return json.loads((out / "results.json").read_text(encoding="utf-8"))


def test_results(tmp_path: Path) -> None:
    result = run(tmp_path / "new" / "out")
    assert read(tmp_path / "new" / "out") == result
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
    assert session["seconds"] >= 0.0  # rounded
    assert 20.0 < meta["peak_memory_mb"] < 10_000.0


def test_csv_has_the_rows_of_json(tmp_path: Path) -> None:
    result = run(tmp_path, mistaken)  # the failure has other fields than the rest
    with (tmp_path / "results.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(result["trials"]) == 6
    texts = {"key", "status", "failed_constraint"}
    for row, found in zip(rows, result["trials"], strict=True):
        assert set(row) >= set(found)
        for field, cell in row.items():
            value = None if cell == "" else cell if field in texts else json.loads(cell)
            assert value == found.get(field), field


def test_several_records_of_a_trial(tmp_path: Path) -> None:
    result = run(
        tmp_path, lambda spec: [{"part": part, "number": spec["number"]} for part in "ba"], number=2
    )
    assert [(t["key"], t["part"]) for t in result["trials"]] == [
        ("000", "b"),
        ("000", "a"),
        ("001", "b"),
        ("001", "a"),
    ]


@pytest.mark.parametrize("until", [0, 1, 5])
def test_going_on_after_ctrl_c(tmp_path: Path, until: int) -> None:
    first, second = Counting(until), Counting()
    with pytest.raises(KeyboardInterrupt, match=f"{until} of 6 trials are done"):
        run(tmp_path / "stopped", first)
    assert not (tmp_path / "stopped" / "results.json").exists()
    resumed = run(tmp_path / "stopped", second)
    assert sorted(first.asked + second.asked) == [t["key"] for t in trials()][::-1]
    assert (
        first.asked == [t["key"] for t in trials()][:until]
    )  # in the order given, not that of the keys
    assert [s["trials"] for s in resumed["meta"]["sessions"]] == [until, 6 - until]
    assert resumed["trials"] == run(tmp_path / "whole")["trials"]
    assert (tmp_path / "stopped" / "results.csv").read_bytes() == (
        tmp_path / "whole" / "results.csv"
    ).read_bytes()


def test_a_finished_one_is_not_run_again(tmp_path: Path) -> None:
    first, again = run(tmp_path), Counting()
    (tmp_path / "results.json").unlink()
    assert run(tmp_path, again) == first == read(tmp_path)
    assert again.asked == []


def test_a_planner_that_notes_ctrl_c_itself(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt, match="0 of 6"):
        run(tmp_path, lambda spec: {**square(spec), "status": "interrupted"})
    assert run(tmp_path)["trials"][0]["status"] == "success"


def test_a_torn_last_line(tmp_path: Path) -> None:
    whole = run(tmp_path)
    file = tmp_path / "trials.jsonl"
    data = file.read_bytes()
    lines = data.splitlines(keepends=True)
    assert len(lines) == 2 + 6  # header, session, trials in the order of running
    # Torn inside the header, the session's line and trials; within a line, and just before the end
    # of it.
    for kept, cut in ((0, 40), (1, 5), (3, 25), (7, len(lines[7]) - 1), (7, 1)):
        file.write_bytes(b"".join(lines[:kept]) + lines[kept][:cut])
        again = Counting()
        assert run(tmp_path, again)["trials"] == whole["trials"]
        assert again.asked == [t["key"] for t in trials()][max(kept - 2, 0) :]
        assert [
            json.loads(line) for line in file.read_bytes().splitlines()
        ]  # nothing of the torn line is left


def test_a_damaged_line_is_not_skipped(tmp_path: Path) -> None:
    run(tmp_path)
    file = tmp_path / "trials.jsonl"
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    for damage in ('{"key": "00\n', "[]\n", "{}\n"):
        file.write_text("".join([*lines[:3], damage, *lines[4:]]), encoding="utf-8")
        with pytest.raises(InputError, match=r"trials\.jsonl:4: this line is damaged"):
            run(tmp_path)


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    for name in ("table.md", "results.json", "thesis.tex"):
        (tmp_path / name).mkdir()
        assert run(tmp_path / name)["trials"]
        out = tmp_path / "own" / name
        out.mkdir(parents=True)
        (out / name).write_text("mine")
        with pytest.raises(InputError, match="there are other files in this folder") as caught:
            run(out)
        assert (caught.value.file, caught.value.got) == (out, name)
        assert [(path.name, path.read_text()) for path in out.iterdir()] == [(name, "mine")]
    (tmp_path / "folders" / "objects").mkdir(parents=True)
    (tmp_path / "folders" / ".gitignore").touch()
    assert run(tmp_path / "folders")["trials"]


def test_a_file_with_the_name_of_the_journal_remains(tmp_path: Path) -> None:
    (tmp_path / "trials.jsonl").write_text("court cases, in one line")
    with pytest.raises(InputError, match="not a journal"):
        run(tmp_path)
    assert (tmp_path / "trials.jsonl").read_text() == "court cases, in one line"
    assert [path.name for path in tmp_path.iterdir()] == ["trials.jsonl"]


@pytest.mark.parametrize(
    "name", ["results.csv", "results.json", "table.md", "trials.jsonl", "deep/x"]
)
def test_links_that_lead_out_are_refused(tmp_path: Path, name: str) -> None:
    out = tmp_path / "out"
    run(out)
    (out / "deep").mkdir()
    (tmp_path / "mine").write_bytes((out / name).read_bytes() if (out / name).is_file() else b"")
    before = (tmp_path / "mine").read_bytes()
    (out / name).unlink(missing_ok=True)
    (out / name).symlink_to("../../mine" if "/" in name else "../mine")
    with pytest.raises(InputError, match="a symbolic link leads out of the folder"):
        run(out)
    assert (tmp_path / "mine").read_bytes() == before


def test_other_settings_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(tmp_path)
    before = (tmp_path / "trials.jsonl").read_bytes()
    with pytest.raises(InputError) as caught:
        run(tmp_path, seed=4, methods=["x"])
    text = str(caught.value)
    for part in (
        "seed 3",
        "seed 4",
        "methods None",
        "methods ['x']",
        "use another folder",
        str(tmp_path),
    ):
        assert part in text
    assert caught.value.field == "seed, methods"
    with pytest.raises(InputError, match="specification"):  # the same settings, yet other trials
        runner.run(trials(5), square, tmp_path, settings=SETTINGS, progress=False)
    monkeypatch.setattr(runner, "_sources", lambda: "xyz")
    with pytest.raises(
        InputError, match=r"versions\.sources.*expected sources abc, got sources xyz"
    ):
        run(tmp_path)
    assert (tmp_path / "trials.jsonl").read_bytes() == before


def test_other_versions_and_machines_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path)
    real = record.meta()
    other = {
        **real,
        "versions": {**real["versions"], "pin": "9.9"},
        "machine": {**real["machine"], "cores": 999},
    }
    monkeypatch.setattr(runner, "meta", lambda: json.loads(json.dumps(other)))
    with pytest.raises(InputError, match=r"pin 9\.9, cores 999"):
        run(tmp_path)


def test_jobs_make_no_difference(tmp_path: Path) -> None:
    assert run(tmp_path / "two", jobs=2)["trials"] == run(tmp_path / "one")["trials"]
    assert (tmp_path / "two" / "results.csv").read_bytes() == (
        tmp_path / "one" / "results.csv"
    ).read_bytes()


def test_other_processes_are_kept_and_have_one_thread(tmp_path: Path) -> None:
    found = run(tmp_path, where, number=10, jobs=2)["trials"]
    processes = {t["process"] for t in found}
    assert len(processes) == 2
    assert os.getpid() not in processes
    assert {t["threads"] for t in found} == {"1"}


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_is_a_failure_on_record(
    tmp_path: Path, jobs: int, capsys: pytest.CaptureFixture[str]
) -> None:
    records = run(tmp_path, mistaken, jobs=jobs)["trials"]
    assert records[2] == {
        "key": "002",
        "number": 2,
        "success": False,
        "status": "error",
        "failed_constraint": "error",
        "violations": ["ZeroDivisionError: nothing to divide by"],
    }
    assert [t["status"] for t in records].count("error") == 1
    said = capsys.readouterr().err
    assert "002 failed with an error" in said
    assert "nothing to divide by" in said
    assert "in mistaken" in said  # where it happened


def test_the_same_error_again_is_told_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(tmp_path, lambda spec: {}[spec["number"] // 2], number=4)
    said = capsys.readouterr().err
    assert [f"00{k} failed with an error: KeyError: {k // 2}" in said for k in range(4)] == [
        True
    ] * 4
    assert said.count("Traceback") == 2


def test_a_record_that_is_no_data_is_an_error_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (record,) = run(tmp_path, lambda spec: {"plan": object()}, number=1)["trials"]
    assert record["status"] == "error"
    assert "not JSON serializable" in capsys.readouterr().err


def test_a_process_that_dies(tmp_path: Path) -> None:
    with pytest.raises(VkcError, match="a process died"):
        run(tmp_path, fatal, jobs=2)
    assert run(tmp_path)["trials"] == run(tmp_path / "whole")["trials"]


def test_two_runs_in_one_folder(tmp_path: Path) -> None:
    def meddle(spec: dict[str, Any]) -> dict[str, Any]:
        with pytest.raises(InputError, match="another run is writing"):
            run(tmp_path)
        return square(spec)

    assert {t["status"] for t in run(tmp_path, meddle, number=1)["trials"]} == {"success"}


def test_misuse(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="no folder"):
        run(tmp_path / "file")
    with pytest.raises(InputError, match="no folder"):
        run(tmp_path / "file" / "out")
    with pytest.raises(InputError, match="same key"):
        runner.run([*trials(2), *trials(1)], square, tmp_path, settings=SETTINGS)
    with pytest.raises(InputError, match="jobs"):
        run(tmp_path, jobs=0)


def test_progress(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, Counting(4))
    assert capfd.readouterr().err == ""
    runner.run(trials(), square, tmp_path, settings=SETTINGS, progress=True)
    said = capfd.readouterr().err
    assert "4/6" in said  # what was done before counts
    assert "6/6" in said
    assert "<00:00" in said  # time left


def test_sources_are_those_that_planning_depends_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vkc_pin.world.files.resources import find_resource_folder

    for name in (
        "__init__.py",
        "planner.py",
        "cli/commands.py",
        "benchmarks/tables.py",
        "scenes/a.yaml",
        "scenes/notes.txt",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("1\n")
    monkeypatch.setattr(runner, "find_package_folder", lambda: tmp_path)
    monkeypatch.setattr(
        runner,
        "folder",
        lambda kind: tmp_path / "scenes" if kind == "scenes" else find_resource_folder(kind),
    )
    first = runner._sources()
    for name, counts in (
        ("cli/commands.py", False),
        ("benchmarks/tables.py", False),
        ("scenes/notes.txt", False),
        ("planner.py", True),
        ("scenes/a.yaml", True),
    ):
        (tmp_path / name).write_text("2\n")
        assert (runner._sources() != first) == counts, name
        (tmp_path / name).write_text("1\n")
        assert runner._sources() == first


SCRIPT = """
import sys, time
from vkc_pin.benchmarks.harness import record, runner
from helpers.trials import SETTINGS, slow, trials
runner._sources = lambda: "abc"
runner.run(trials(), slow, sys.argv[1], settings=SETTINGS, jobs=int(sys.argv[2]), progress=False)
"""


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("kind", ["SIGINT", "SIGKILL"])
def test_a_real_stop_leaves_what_was_done_and_no_process(
    tmp_path: Path, jobs: int, kind: str
) -> None:
    path = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(tmp_path), str(jobs)],
        start_new_session=True,  # a group of its own, as of a command in a terminal
        preexec_fn=lambda: signal.signal(
            signal.SIGINT, signal.SIG_DFL
        ),  # a shell's background job ignores it, and hands that on
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    file, deadline = tmp_path / "trials.jsonl", time.monotonic() + 60.0
    while not (file.exists() and file.read_bytes().count(b"\n") >= 4):
        assert time.monotonic() < deadline
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.02)
    if kind == "SIGINT":  # as Ctrl-C: to all processes
        os.killpg(process.pid, signal.SIGINT)
    else:
        process.kill()
    _, said = process.communicate(
        timeout=30
    )  # the other processes hold the pipe's end while they live
    if kind == "SIGINT":
        assert "of 6 trials are done" in said
    counting = Counting()
    assert run(tmp_path, counting)["trials"] == run(tmp_path / "whole")["trials"]
    assert 0 < len(counting.asked) <= 4
