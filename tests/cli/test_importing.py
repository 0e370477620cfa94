from __future__ import annotations

from pathlib import Path

import pytest
from helpers.downloads import SDF

from vkc_pin.cli.commands import EXIT_MISUSE, run


def test_import_object_writes_and_reports(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "box.sdf").write_text(SDF)
    assert (
        run(["import-object", str(tmp_path / "box.sdf"), "--output", str(tmp_path / "out"), "--height", "0.7", "--most", "1"])
        == 0
    )
    said = capsys.readouterr().out
    assert "0.70 m" in said
    assert "door_bar (bar, called a handle)" in said
    assert said.count("wrote") == 2
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["attachments.png", "box.urdf", "box.yaml"]
    assert run(["import-object", str(tmp_path / "box.sdf"), "--output", str(tmp_path / "out")]) == EXIT_MISUSE
    assert "something already" in capsys.readouterr().err
