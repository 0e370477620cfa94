from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.drawers import load_drawer_scene

from vkc_pin.visualization.plots.scene_view import Approach, plot_scene


def make_approaches(count: int) -> list[Approach]:
    places = np.column_stack([np.linspace(-1.0, 1.5, count), np.zeros(count), np.ones(count)])
    bases = [np.array([x, -1.0, 0.0]) if k % 2 else None for k, (x, _, _) in enumerate(places)]
    return [
        Approach(f"object_{k}.a_handle_with_a_long_name", place, np.array([0.0, 1.0, 0.0]), base)
        for k, (place, base) in enumerate(zip(places, bases, strict=True))
    ]


@pytest.mark.parametrize("count", [0, 1, 17])
def test_attachments_are_numbered_in_a_legend(count: int) -> None:
    figure = plot_scene(load_drawer_scene(), make_approaches(count))
    (axes,) = figure.axes
    numbers = [text.get_text() for text in axes.texts if text.get_text()]
    assert numbers == [str(k) for k in range(1, count + 1)]
    names = [text.get_text() for legend in figure.legends[1:] for text in legend.get_texts()]
    assert [name.partition(".")[0] for name in names] == [f"object_{k}" for k in range(count)]
    assert max((len(line) for name in names for line in name.split("\n")), default=0) <= 40


@pytest.mark.parametrize("arena", [(-20.0, 20.0, -20.0, 20.0), (-30.0, 3.0, -3.0, 3.0)])
def test_limits_are_tight_in_a_large_arena(arena: tuple[float, float, float, float]) -> None:
    figure = plot_scene(dataclasses.replace(load_drawer_scene(), arena=arena), make_approaches(3))
    (axes,) = figure.axes
    width, height = np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())
    assert 3.0 < width < 7.0
    assert 3.0 < height < 7.0


def test_arrows_outside_the_arena_are_shown() -> None:
    outside = Approach("drawer.back", np.array([0.0, -9.0, 1.0]), np.array([0.0, 1.0, 0.0]), None)
    (axes,) = plot_scene(load_drawer_scene(), [outside]).axes
    assert axes.get_ylim()[0] < -9.0
