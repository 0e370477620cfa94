"""Runs commands in an empty folder."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.commands import Result, RunCommand

from vkc_pin.cli import main


@pytest.fixture
def run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> RunCommand:
    """Return a function that runs a command in the test's folder."""
    monkeypatch.chdir(tmp_path)

    def run_command(command: str) -> Result:
        try:
            code = main(command.split())
        except SystemExit as stop:  # raised by argparse
            code = int(stop.code or 0)
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return Result(code, out, err)

    return run_command
