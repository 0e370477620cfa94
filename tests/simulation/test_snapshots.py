"""Tests that snapshots and videos show the robot and moving objects."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.executions import simulate_drawer

import vkc_pin as vkc
from vkc_pin.simulation import snapshots
from vkc_pin.simulation.snapshots import RenderedScene


@pytest.mark.long
def test_snapshots_differ_where_objects_move(tmp_path: Path) -> None:
    result = simulate_drawer()
    rendered = RenderedScene(result)
    try:
        first, again, last = rendered.render(
            np.array([0.0, 0.0, result.trajectory.times[-1]]), rendered.find_viewpoint()
        )
    except vkc.VkcError as error:  # no OpenGL on this machine
        pytest.skip(str(error))
    np.testing.assert_array_equal(first, again)
    assert first.std() > 10.0
    moved = (np.abs(first.astype(int) - last).max(axis=2) > 30).mean()
    assert 0.005 < moved < 0.5
    picture = result.plot(tmp_path / "strip.png", count=3).read_bytes()
    assert picture.startswith(b"\x89PNG")


def test_missing_opengl_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    result = simulate_drawer()
    monkeypatch.setattr(snapshots, "_CONTEXTS", ("no_such_context",))
    with pytest.raises(vkc.VkcError, match="EGL or OSMesa"):
        result.plot(tmp_path / "strip.png")
    assert not (tmp_path / "strip.png").exists()
    with pytest.raises(vkc.InputError, match="count"):
        result.plot(tmp_path / "strip.png", count=1)


def test_video_has_the_duration_of_the_motion(tmp_path: Path) -> None:
    result = simulate_drawer()
    try:
        file = result.to_mp4(tmp_path / "deep" / "film.mp4", rate=5.0)
    except vkc.VkcError as error:  # no OpenGL or no ffmpeg on this machine
        pytest.skip(str(error))
    data = file.read_bytes()
    assert data[4:8] == b"ftyp"
    at = data.index(b"mvhd") + 4  # version and flags, creation, modification, time scale, duration
    time_scale, duration = (int.from_bytes(data[at + k : at + k + 4], "big") for k in (12, 16))
    times = result.trajectory.times
    assert duration / time_scale == pytest.approx(times[-1] - times[0], abs=0.25)


def test_missing_ffmpeg_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    result = simulate_drawer()
    monkeypatch.setattr(snapshots.shutil, "which", lambda name: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(vkc.InputError, match="ffmpeg") as caught:
        result.to_mp4(tmp_path / "film.mp4")
    assert "imageio-ffmpeg" in str(caught.value.expected)
    with pytest.raises(vkc.InputError, match="rate"):
        result.to_mp4(tmp_path / "film.mp4", rate=0.0)
    assert not list(tmp_path.iterdir())
