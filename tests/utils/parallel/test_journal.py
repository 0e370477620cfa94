from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from vkc_pin.errors import InputError
from vkc_pin.utils.parallel.journal import Journal, JournalContents

HEADER = {"settings": {"recipe": "abc"}, "versions": {"pin": "4"}}


def opened(path: Path, header: dict[str, dict[str, str]] = HEADER) -> Journal:
    return Journal(path, path.open("a+b"), header, "episodes")


def line(key: int) -> dict[str, object]:
    return {
        "key": str(key),
        "records": [{"number": key}],
        "memory_mb": 100.0 + key,
        "seconds": 0.5 * key,
    }


def test_what_was_written_is_there_again(tmp_path: Path) -> None:
    journal = opened(tmp_path / "j")
    journal.append({"session": {"jobs": 2}})
    for key in (3, 1, 2):
        journal.append(line(key))
    journal._stream.close()
    again = opened(tmp_path / "j")
    assert again.lines == {str(key): [{"number": key}] for key in (3, 1, 2)}
    assert again.memory == 103.0
    assert again.sessions == [{"jobs": 2, "trials": 3, "seconds": 1.0}]


def test_it_is_read_while_it_is_written(tmp_path: Path) -> None:
    journal = opened(tmp_path / "j")
    for jobs, keys in ((1, (0, 4)), (2, (1, 2, 3))):
        journal.append({"session": {"jobs": jobs}})
        for key in keys:
            journal.append(line(key))
    journal._stream.write(b'{"key": "5", "rec')
    journal._stream.flush()
    kept = JournalContents.read(tmp_path / "j")
    assert (kept.lines, kept.sessions, kept.memory) == (
        journal.lines,
        journal.sessions,
        journal.memory,
    )
    assert kept.seconds == 2.0 + 1.5  # of each session, the time until its last task
    assert (tmp_path / "j").read_bytes().endswith(b'"rec')
    with pytest.raises(InputError, match="cannot read this"):
        JournalContents.read(tmp_path / "nothing")
    (tmp_path / "bad").write_bytes(b'{}\n{"key": "1"}\n')
    with pytest.raises(InputError, match="this line is damaged") as caught:
        JournalContents.read(tmp_path / "bad")
    assert caught.value.line == 2


@pytest.mark.parametrize(
    "text",
    [
        "one line of a user's own",
        '{"settings": {"recipe": "abd"',
        '{"settings": {"recipe": "abc"}, "versions": {"pin": "4"}} and more',
        "[1, 2, 3]\n",
        "1\n2\n",
        "\n",
    ],
)
def test_a_file_that_is_not_a_journal_remains(tmp_path: Path, text: str) -> None:
    (tmp_path / "j").write_text(text)
    with pytest.raises(InputError, match=r"not a journal|damaged|run otherwise") as caught:
        opened(tmp_path / "j")
    assert (caught.value.file, caught.value.line or 1) == (tmp_path / "j", 1)
    assert (tmp_path / "j").read_text() == text


@pytest.mark.parametrize("length", [0, 1, 20, 57])
def test_a_header_that_was_cut_off_is_written_again(tmp_path: Path, length: int) -> None:
    header = '{"settings": {"recipe": "abc"}, "versions": {"pin": "4"}}'
    assert len(header) == 57
    (tmp_path / "j").write_text(header[:length])
    opened(tmp_path / "j").append({"session": {"jobs": 1}})
    assert (tmp_path / "j").read_text() == f'{header}\n{{"session": {{"jobs": 1}}}}\n'


def test_records_stay_in_the_file(tmp_path: Path) -> None:
    """A run of a million tasks would not fit into memory."""
    journal = opened(tmp_path / "j")
    journal.append({"session": {"jobs": 1}})
    way = [[0.001 * k, 0.002 * k] for k in range(200)]
    tracemalloc.start()
    for key in range(300):
        journal.append({**line(key), "records": [{"number": key, "way": way}]})
    kept = JournalContents.read(tmp_path / "j")
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size < (tmp_path / "j").stat().st_size / 5
    for lines in (journal.lines, kept.lines):
        assert len(lines) == 300
        assert lines["7"] == [{"number": 7, "way": way}]
        assert "300" not in lines
        with pytest.raises(KeyError):
            lines["300"]
    del journal.lines["7"]
    assert ("7" in journal.lines, len(journal.lines), list(journal.lines)[6:8]) == (
        False,
        299,
        ["6", "8"],
    )
    journal.append(
        {**line(7), "records": [{"number": 7}, {"number": 7, "again": True}]}
    )  # what is run again counts
    assert (
        journal.lines["7"]
        == JournalContents.read(tmp_path / "j").lines["7"]
        == [{"number": 7}, {"number": 7, "again": True}]
    )


def test_memories_and_the_time_of_the_writer(tmp_path: Path) -> None:
    journal = opened(tmp_path / "j")
    journal.append({"session": {"jobs": 2}})
    journal.append(line(0))  # of a version that did not say it
    for key, process in ((1, "a"), (2, "b"), (3, "a")):
        journal.append(
            {
                **line(key),
                "process": process,
                "resident_mb": 10.0 * key,
                "client_seconds": 0.01 * key,
            }
        )
    kept = JournalContents.read(tmp_path / "j")
    assert kept.memories == {"a": [10.0, 30.0], "b": [20.0]}
    assert kept.sessions == [{"jobs": 2, "trials": 4, "seconds": 1.5, "client_seconds": 0.03}]


def test_any_cut_leaves_whole_lines(tmp_path: Path) -> None:
    journal = opened(tmp_path / "j")
    journal.append({"session": {"jobs": 1}})
    for key in range(4):
        journal.append(line(key))
    journal._stream.close()
    data = (tmp_path / "j").read_bytes()
    for cut in range(len(data)):
        (tmp_path / "cut").write_bytes(data[:cut])
        again = opened(tmp_path / "cut")
        whole = data[:cut].count(b"\n")
        assert len(again.lines) == max(0, whole - 2)
        again._stream.close()
        assert (tmp_path / "cut").read_bytes().endswith(b"\n")


def test_of_another_recipe(tmp_path: Path) -> None:
    opened(tmp_path / "j")._stream.close()
    with pytest.raises(
        InputError, match=r"the episodes in this folder were run otherwise.*recipe abc.*recipe xyz"
    ) as caught:
        opened(tmp_path / "j", {**HEADER, "settings": {"recipe": "xyz"}})
    assert caught.value.field == "recipe"


def test_one_process_at_a_time(tmp_path: Path) -> None:
    first = opened(tmp_path / "j")
    with pytest.raises(InputError, match="another run is writing"):
        opened(tmp_path / "j")
    first._stream.close()
    opened(tmp_path / "j")
