from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest
from helpers.expected_errors import expect_error

from vkc_pin.utils.journal import Journal, JournalContents

HEADER = {"settings": {"recipe": "abc"}, "versions": {"pin": "4"}}


def open_journal(path: Path, header: dict[str, dict[str, str]] = HEADER) -> Journal:
    return Journal(path, path.open("a+b"), header, "episodes")


def make_line(key: int) -> dict[str, object]:
    return {
        "key": str(key),
        "records": [{"number": key}],
        "memory_mb": 100.0 + key,
        "seconds": 0.5 * key,
    }


def test_journals_are_read_while_they_are_written(tmp_path: Path) -> None:
    journal = open_journal(tmp_path / "j")
    for jobs, keys in ((1, (0, 4)), (2, (1, 2, 3))):
        journal.append({"session": {"jobs": jobs}})
        for key in keys:
            journal.append(make_line(key))
    with (tmp_path / "j").open("ab") as stream:
        stream.write(b'{"key": "5", "rec')
    contents = JournalContents.read(tmp_path / "j")
    assert (contents.lines, contents.sessions) == (journal.lines, journal.sessions)
    assert contents.lines == {str(key): [{"number": key}] for key in (0, 4, 1, 2, 3)}
    assert contents.memory == journal.memory == 104.0
    assert contents.seconds == 2.0 + 1.5  # the time of each session until its last task
    with expect_error("cannot read this"):
        JournalContents.read(tmp_path / "nothing")
    (tmp_path / "bad").write_bytes(b'{}\n{"key": "1"}\n')
    with expect_error("bad:2: this line is damaged"):
        JournalContents.read(tmp_path / "bad")


@pytest.mark.parametrize(
    "text",
    [
        "one line of a user's own",
        '{"settings": {"recipe": "abd"',
        '{"settings": {"recipe": "abc"}, "versions": {"pin": "4"}} and more',
        "[1, 2, 3]\n",
        "\n",
    ],
)
def test_foreign_files_are_not_changed(tmp_path: Path, text: str) -> None:
    (tmp_path / "j").write_text(text)
    with expect_error(r"not a journal|damaged|run otherwise", file=tmp_path / "j"):
        open_journal(tmp_path / "j")
    assert (tmp_path / "j").read_text() == text


def test_incomplete_lines_are_removed(tmp_path: Path) -> None:
    journal = open_journal(tmp_path / "j")
    journal.append({"session": {"jobs": 1}})
    for key in range(4):
        journal.append(make_line(key))
    data = (tmp_path / "j").read_bytes()
    for cut in range(len(data)):
        (tmp_path / "cut").write_bytes(data[:cut])
        reopened = open_journal(tmp_path / "cut")
        assert len(reopened.lines) == max(0, data[:cut].count(b"\n") - 2)
        assert (tmp_path / "cut").read_bytes() == data[: data.rfind(b"\n", 0, max(cut, 58)) + 1]
        del reopened


def test_records_stay_in_the_file(tmp_path: Path) -> None:
    """The records of a million tasks would not fit into memory."""
    journal = open_journal(tmp_path / "j")
    journal.append({"session": {"jobs": 1}})
    path = [[0.001 * k, 0.002 * k] for k in range(200)]
    tracemalloc.start()
    for key in range(300):
        journal.append({**make_line(key), "records": [{"number": key, "path": path}]})
    contents = JournalContents.read(tmp_path / "j")
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size < (tmp_path / "j").stat().st_size / 5
    for lines in (journal.lines, contents.lines):
        assert len(lines) == 300
        assert lines["7"] == [{"number": 7, "path": path}]
        assert "300" not in lines
    del journal.lines["7"]
    assert ("7" in journal.lines, list(journal.lines)[6:8]) == (False, ["6", "8"])
    journal.append({**make_line(7), "records": [{"number": 7, "again": True}]})
    for lines in (journal.lines, JournalContents.read(tmp_path / "j").lines):
        assert lines["7"] == [{"number": 7, "again": True}]


def test_memory_and_processor_time_are_recorded(tmp_path: Path) -> None:
    journal = open_journal(tmp_path / "j")
    journal.append({"session": {"jobs": 2}})
    journal.append(make_line(0))
    for key, process in ((1, "a"), (2, "b"), (3, "a")):
        journal.append(
            {
                **make_line(key),
                "process": process,
                "resident_mb": 10.0 * key,
                "client_seconds": 0.01 * key,
            }
        )
    contents = JournalContents.read(tmp_path / "j")
    assert contents.memories == {"a": [10.0, 30.0], "b": [20.0]}
    assert contents.sessions == [{"jobs": 2, "trials": 4, "seconds": 1.5, "client_seconds": 0.03}]


@pytest.mark.parametrize(
    ("settings", "other", "field", "message"),
    [
        (
            {"recipe": "abc"},
            {"recipe": "xyz"},
            "recipe",
            "run otherwise.*recipe abc.*recipe xyz",
        ),
        (
            {"benchmark": "door", "scenes": "a"},
            {"benchmark": "gap", "tasks": "b"},
            "benchmark",
            "expected benchmark door, got benchmark gap",
        ),
    ],
)
def test_different_headers_raise(
    tmp_path: Path, settings: dict[str, str], other: dict[str, str], field: str, message: str
) -> None:
    open_journal(tmp_path / "j", {"settings": settings})._stream.close()
    with expect_error(f"the episodes in this folder .*{message}", field=field):
        open_journal(tmp_path / "j", {"settings": other})


def test_two_writers_raise(tmp_path: Path) -> None:
    first = open_journal(tmp_path / "j")
    with expect_error("another run is writing"):
        open_journal(tmp_path / "j")
    first._stream.close()
    open_journal(tmp_path / "j")
