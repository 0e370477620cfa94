from __future__ import annotations

import logging
from pathlib import Path

import pytest
import trimesh
from helpers.descriptions import make_part

import vkc_pin as vkc
from vkc_pin.importing.description import Link
from vkc_pin.importing.homes.splitting import Home
from vkc_pin.importing.homes.writing import measure_parts
from vkc_pin.importing.progress import ImportProgress


class Clock:
    """A clock that tests set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        monkeypatch.setattr("time.perf_counter", lambda: self.now)


def test_progress_is_logged_every_few_seconds(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    links = tuple(Link(f"chair {k}", (), (make_part(),)) for k in range(6))
    clock = Clock(monkeypatch)
    with caplog.at_level("INFO", "vkc_pin.importing"):
        progress = ImportProgress(measure_parts(Home((), links, (), (), 6, ())))
        for number, _ in enumerate(progress.follow(links)):
            clock.now += (0.5, 2.0, 0.5, 3.0, 0.5, 0.5)[number]
    assert [record.getMessage() for record in caplog.records] == [
        "chair 2: part 3 of 6, about 5 s left",
        "chair 4: part 5 of 6, about 3 s left",
    ]


def test_long_parts_are_announced(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    clock = Clock(monkeypatch)
    with caplog.at_level("INFO", "vkc_pin.importing"):
        progress = ImportProgress([100_000.0, 100.0, 40_000.0, 100.0])
        for name in ("first", "second", "third", "fourth"):
            part = Link(name, (), ())
            for _ in progress.follow([part]):
                clock.now += {"first": 10.0, "third": 4.0}.get(name, 0.0)
    lines = [record.getMessage() for record in caplog.records]
    # A part without a predecessor takes 0.4 ms a triangle.
    assert lines[0] == "first: part 1 of 4, about 56 s left"
    assert lines[1:] == [
        "second: part 2 of 4, about 4 s left",
        "third: part 3 of 4, about 4 s left",
        "fourth: part 4 of 4, about 0 s left",
    ]


def test_object_import_logs_each_link_with_a_mesh(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock runs on whenever it is read, so that each part takes long."""
    clock = Clock(monkeypatch)

    def tick() -> float:
        clock.now += 3.0
        return clock.now

    monkeypatch.setattr("time.perf_counter", tick)
    trimesh.creation.box((0.4, 0.6, 0.8)).export(tmp_path / "body.stl")
    trimesh.creation.box((0.02, 0.5, 0.7)).export(tmp_path / "door.stl")
    shape = '<geometry><mesh filename="{0}.stl"/></geometry>'
    mesh = f'<link name="{{0}}"><collision>{shape}</collision></link>'
    hinge = """<joint name="hinge" type="revolute"><parent link="body"/><child link="door"/>
    <origin xyz="-0.25 0.25 0"/><axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1"
    velocity="1"/></joint>"""
    parts = mesh.format("body") + mesh.format("door") + hinge
    (tmp_path / "case.urdf").write_text(f'<robot name="case">{parts}</robot>')
    with caplog.at_level(logging.INFO, "vkc_pin.importing"):
        vkc.importing.import_object(tmp_path / "case.urdf", tmp_path / "out")
    names = [record.getMessage().split(" of 3")[0] for record in caplog.records]
    assert names == ["body: part 1", "door: part 2", "attachments: part 3"]
