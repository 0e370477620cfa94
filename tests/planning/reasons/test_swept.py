"""What an object's own joint is proven to hit, and what proves nothing."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from helpers.small_problems import door_scene

from vkc_pin.options import Options
from vkc_pin.planning.reasons.swept import swept
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.scene.scene import Scene
from vkc_pin.task.compiler import compile_task
from vkc_pin.task.steps import Actuate

POST = (3.2, 0.14, 0.25)  # in the hall, where the leaf is at 1.14 rad


def problem(hinge: float, at: Sequence[float], *, object_type: str | None = None, state: float = 0.0) -> TrajectoryProblem:
    scene = door_scene().with_state("door", {"hinge": state})
    document = scene.document
    if object_type is None:
        box = {"name": "post", "type": "box", "size": [0.08, 0.1, 0.5], "position": list(at)}
        document = {**document, "obstacles": [*document["obstacles"], box]}
    else:
        document = {**document, "objects": [*document["objects"], {"name": "post", "type": object_type, "position": list(at)}]}
    scene = Scene.from_document(document, scene.folder)
    options = Options(reach_waypoints=4, turn_waypoints=3, move_waypoints=6)
    return TrajectoryProblem(scene, compile_task(scene, [Actuate("door", {"hinge": hinge})], options), options)


def test_what_stands_where_the_leaf_goes_is_named() -> None:
    (line,) = swept(problem(1.3, POST))
    assert "no way for door.hinge, proven: between 0 and 1.3, at " in line
    assert "door.panel – post overlap by " in line
    at = float(line.partition(", at ")[2].partition(",")[0])
    assert 1.0 < at < 1.3


@pytest.mark.parametrize(
    ("hinge", "at", "state"),
    [
        (0.7, POST, 0.0),  # it ends before
        (1.3, (3.2, 0.14, 2.6), 0.0),  # above the leaf
        (1.5, POST, 1.45),  # it begins beyond
    ],
)
def test_what_stands_elsewhere_proves_nothing(hinge: float, at: Sequence[float], state: float) -> None:
    assert swept(problem(hinge, at, state=state)) == []


def test_what_can_be_carried_away_proves_nothing() -> None:
    assert swept(problem(1.3, (3.2, 0.14, 0.4), object_type="ball")) == []
    assert swept(problem(1.3, (3.2, 0.14, 0.0), object_type="cabinet")) != []  # its case stays
