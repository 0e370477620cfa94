"""Tests the progress line in terminals and pipes."""

from __future__ import annotations

import io
import os
import re
from types import SimpleNamespace

import pytest
from helpers.drives import make_hall

import vkc_pin as vkc
from vkc_pin.planning import progress as module
from vkc_pin.planning.progress import Progress, show_progress


class Terminal(io.StringIO):
    """A terminal that records its output."""

    def isatty(self) -> bool:
        return True

    def show(self) -> str:
        """Return the only line: text after a carriage return overwrites it."""
        (written, after), text = self.getvalue().split("\n"), ""
        assert after == ""
        for part in written.split("\r"):
            text = part + text[len(part) :]
        return text.rstrip()


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    stream = Terminal()
    size = os.terminal_size((70, 24))
    monkeypatch.setattr(module, "sys", SimpleNamespace(stderr=stream))
    monkeypatch.setattr(module.shutil, "get_terminal_size", lambda *_, **__: size)
    return stream


def test_progress_text_names_steps_and_activity() -> None:
    seen: list[tuple[str, bool]] = []
    line = Progress(lambda text, last: seen.append((text, last)))
    line.set_steps(3, 2, 18)
    line.begin(["reach cup.side", "place cup"])
    line.set_activity("looking for a guess")
    line(SimpleNamespace(round=3, shortfall=0.0123, objective=4.5678))
    begin, end = "0 s · steps 3 to 4 of 18 · ", " · reach cup.side, place cup"
    assert seen[-2][0] == f"{begin}looking for a guess{end}"
    assert seen[-1][0] == f"{begin}round 3, 12.3 mm missing, objective 4.57{end}"
    line.set_steps(7, 1, 18)
    line(SimpleNamespace(round=3, shortfall=0.0, objective=4.5678))
    assert "step 7 of 18 · round 3, clear, " in seen[-1][0]
    line.stop()
    line.stop()
    line.set_activity("nothing any more")
    assert [last for _, last in seen] == [False] * (len(seen) - 1) + [True]
    assert re.fullmatch(r"stopped after [\d.]+ s", seen[-1][0])


def test_terminal_shows_one_line(terminal: Terminal) -> None:
    plan = vkc.plan(make_hall(), [vkc.GoTo(-1.0, 0.5)], progress=True)
    assert plan.success
    line = r".*: success — base \d\.\d\d m, arm .* rad, planned in [\d.]+ s"
    assert re.fullmatch(line, terminal.show())
    assert all(len(part.rstrip()) < 70 for part in re.split(r"[\r\n]", terminal.getvalue()))
    assert "looking for an initial guess" in terminal.getvalue()
    assert "round 1" in terminal.getvalue()


def test_progress_line_ends_after_an_error(terminal: Terminal) -> None:
    def fail(line: vkc.Iteration) -> None:
        raise ValueError("mine")

    with pytest.raises(ValueError, match="mine"):
        vkc.plan(make_hall(), [vkc.GoTo(-1.0, 0.5)], progress=True, callback=fail)
    assert re.fullmatch(r"stopped after [\d.]+ s", terminal.show())


def test_closed_terminal_does_not_stop_planning(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail_to_write(text: str) -> int:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(terminal, "write", fail_to_write)
    assert vkc.plan(make_hall(), [vkc.GoTo(0.3, 0.2)], progress=True).success


def test_nothing_is_written_to_a_pipe(capfd: pytest.CaptureFixture[str]) -> None:
    with show_progress(True) as line:
        line.set_activity("something")
        assert line.write is None
    assert capfd.readouterr() == ("", "")
