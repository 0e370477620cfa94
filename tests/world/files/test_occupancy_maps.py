"""Tests maps of ROS against the table of Nav2's `map_io`, computed pixel by pixel."""

from __future__ import annotations

import fractions
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.expected_errors import expect_error
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from vkc_pin.world.files.occupancy_maps import read_occupancy_map

GREYS = (0, 10, 80, 100, 130, 205, 254)
FIELDS: dict[str, Any] = {
    **{"image": "map.pgm", "resolution": 0.05, "origin": [1.0, 2.0, 0.5]},
    **{"negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.196},
}


def write_map(folder: Path, image: Image.Image, name: str = "map.png", **fields: Any) -> Path:
    image.save(folder / name)
    file = folder / "map.yaml"
    file.write_text(yaml.safe_dump({**FIELDS, "image": name, **fields}))
    return file


def compute_value(
    pixel: tuple[int, ...], mode: str, negate: bool, occupied: float, free: float
) -> int:
    """Return the occupancy of a pixel (red, green, blue[, opacity]), in Nav2's words."""
    shade = float(fractions.Fraction(sum(pixel[:3]), 3 * 255))
    if mode == "trinary":
        shade = float(fractions.Fraction(sum(pixel), len(pixel) * 255))
    occ = shade if negate else 1.0 - shade
    if mode == "raw":
        percent = math.floor(shade * 255 + 0.5)
        return percent if percent <= 100 else -1
    if mode == "scale" and len(pixel) == 4 and pixel[3] < 255:
        return -1
    if occ > occupied:
        return 100
    if occ < free:
        return 0
    return -1 if mode == "trinary" else round((occ - free) / (occupied - free) * 100)


@pytest.mark.parametrize("suffix", ["png", "pgm", "bmp"])
@pytest.mark.parametrize(
    ("mode", "negate", "values"),
    [
        (None, 0, [0, 0, 0, 100, -1, -1]),
        ("trinary", 1, [100, 100, 100, 0, -1, 100]),
        ("scale", 0, [0, 0, 0, 100, 91, 0]),
        ("scale", 1, [100, 100, 100, 0, 43, 100]),
        ("raw", 0, [-1, -1, -1, 0, 100, -1]),
        ("raw", 1, [-1, -1, -1, 0, 100, -1]),
    ],
)
def test_modes_have_the_values_of_nav2(
    tmp_path: Path, mode: str | None, negate: int, values: list[int], suffix: str
) -> None:
    grey = np.array([[255, 254, 250, 0, 100, 205]], np.uint8)
    fields = {"negate": negate} if mode is None else {"negate": negate, "mode": mode}
    file = write_map(tmp_path, Image.fromarray(grey), f"map.{suffix}", **fields)
    assert read_occupancy_map(file).values.tolist() == [values]


def test_values_at_the_thresholds_are_unknown(tmp_path: Path) -> None:
    grey = np.array([[50, 51, 152, 153, 154]], np.uint8)  # 51 and 153 are 0.2 and 0.6 of 255
    thresholds = {"free_thresh": 0.2, "occupied_thresh": 0.6}
    file = write_map(tmp_path, Image.fromarray(grey), negate=1, **thresholds)
    assert read_occupancy_map(file).values.tolist() == [[0, -1, -1, -1, 100]]


def test_first_row_is_the_lowest_of_the_image(tmp_path: Path) -> None:
    grey = np.array([[0, 254], [254, 254], [205, 205]], np.uint8)
    found = read_occupancy_map(write_map(tmp_path, Image.fromarray(grey)))
    assert found.values.tolist() == [[-1, -1], [0, 0], [100, 0]]
    assert found.occupied.tolist() == [[False, False], [False, False], [True, False]]
    assert found.free.tolist() == [[False, False], [True, True], [False, True]]
    np.testing.assert_allclose(found.size, [0.1, 0.15])
    assert found.origin == (1.0, 2.0, 0.5)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_pixels_have_the_values_of_nav2(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    channels = data.draw(st.sampled_from([1, 2, 3, 4]))
    shape = (data.draw(st.integers(1, 4)), data.draw(st.integers(1, 4)), channels)
    count = int(np.prod(shape))
    numbers = data.draw(st.lists(st.integers(0, 255), min_size=count, max_size=count))
    pixels = np.array(numbers, np.uint8).reshape(shape)
    free, occupied = sorted(
        data.draw(st.lists(st.floats(0.0, 1.0), min_size=2, max_size=2, unique=True))
    )
    mode = data.draw(st.sampled_from(["trinary", "scale", "raw"]))
    negate = data.draw(st.booleans())
    folder = tmp_path_factory.mktemp("map")
    picture = Image.fromarray(pixels[..., 0] if channels == 1 else pixels)
    limits = {"free_thresh": free, "occupied_thresh": occupied}
    file = write_map(folder, picture, negate=negate, mode=mode, **limits)
    found = read_occupancy_map(file)
    for row in range(shape[0]):
        for column in range(shape[1]):
            pixel = tuple(pixels[shape[0] - 1 - row, column].tolist())
            if channels < 3:
                pixel = (pixel[0], pixel[0], pixel[0], *pixel[1:])
            expected = compute_value(pixel, mode, negate, occupied, free)
            assert found.values[row, column] == expected
            if mode == "raw":
                is_occupied = expected == 100 or expected > 100 * occupied
                is_free = expected == 0 or 0 < expected < 100 * free
            else:
                is_occupied = expected == 100
                is_free = expected == 0
            assert found.occupied[row, column] == is_occupied
            assert found.free[row, column] == is_free


def test_text_images_and_long_pixels_are_read(tmp_path: Path) -> None:
    file = write_map(tmp_path, Image.new("L", (1, 1)))
    (tmp_path / "text.pgm").write_text("P2\n# made by hand\n3 1\n100\n100 0 50\n")
    file.write_text(yaml.safe_dump({**FIELDS, "image": "text.pgm"}))
    assert read_occupancy_map(file).values.tolist() == [[0, 100, -1]]
    grey = np.array([[65535, 0, 32768]], np.uint16)
    file = write_map(tmp_path, Image.fromarray(grey), "long.png")
    assert read_occupancy_map(file).values.tolist() == [[0, 100, -1]]


def test_other_fields_are_named(tmp_path: Path) -> None:
    file = write_map(tmp_path, Image.new("L", (1, 1)), cost=3)
    with pytest.warns(UserWarning, match=r"map.yaml: these fields are not used: cost"):
        read_occupancy_map(file)


@pytest.mark.parametrize("field", ["image", "resolution", "origin", "negate", "free_thresh"])
def test_fields_are_required(tmp_path: Path, field: str) -> None:
    file = write_map(tmp_path, Image.new("L", (1, 1)))
    fields = dict(FIELDS)
    del fields[field]
    file.write_text(yaml.safe_dump(fields))
    with expect_error(rf"map\.yaml:\d+: {field}: missing"):
        read_occupancy_map(file)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("image", "room.pgm", r"image: there is no such image .*got room\.pgm"),
        ("image", "", r"image: .*no file can be called that"),
        ("resolution", 0.0, "resolution: out of range"),
        ("resolution", "fine", "resolution: wrong value .*a number"),
        ("origin", [0.0, 0.0], "origin: wrong number of values .*expected 3 values"),
        ("origin", [0.0, 0.0, "north"], r"origin\[2\]: wrong value .*a number"),
        ("origin", [0.0, 0.0, math.nan], r"origin\[2\]: wrong value .*a finite number"),
        ("negate", 2, "negate: wrong value .*expected 0 or 1"),
        ("occupied_thresh", 1.5, "occupied_thresh: out of range"),
        ("free_thresh", 0.7, "free_thresh: the thresholds are out of order .*0.65.*got 0.7"),
        ("free_thresh", 0.65, "free_thresh: the thresholds are out of order"),
        ("mode", "scaled", "there is no mode 'scaled'; did you mean 'scale'"),
    ],
)
def test_wrong_fields_are_named(tmp_path: Path, field: str, value: Any, message: str) -> None:
    file = write_map(tmp_path, Image.new("L", (1, 1)))
    file.write_text(yaml.safe_dump({**FIELDS, "image": "map.png", field: value}))
    with expect_error(rf"map\.yaml:\d+: .*{message}"):
        read_occupancy_map(file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"P5\n4 4\n255\nab", "cannot read the image"),
        (b"P5\n4000 4000\n255\nab", "the image is too large .*at most 10000000 pixels"),
        (b"P5\n40000 40000\n255\nab", "cannot read the image .*1600000000 pixels"),
        (b"GIF89a\x01\x00\x01\x00\x00\x00\x00;", "cannot read the image"),
        (b"", "cannot read the image"),
    ],
)
def test_wrong_images_are_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "map.pgm").write_bytes(content)
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(FIELDS))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with expect_error(rf"map\.yaml:\d+: image: .*{message}"):
            read_occupancy_map(tmp_path / "map.yaml")
