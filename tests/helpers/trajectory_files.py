"""Generates trajectories of all kinds, and writes invalid files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

FILES = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None
)
ROBOT = ("base_x", "base_y", "base_yaw", "lift", "elbow")


@st.composite
def trajectories(draw: st.DrawFn, largest: float | None = None) -> Trajectory:
    """Return trajectories of robots with up to five coordinates that grasp and carry objects."""
    robot = draw(st.integers(3, 5))
    objects = draw(st.lists(st.sampled_from("abcde"), max_size=4, unique=True))
    names = (*ROBOT[:robot], *(f"{name}.joint" for name in objects))
    steps = draw(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=8))
    times = draw(st.floats(-1e3, 1e3)) + np.cumsum([0.0, *steps])
    numbers = (
        st.floats(allow_nan=False, allow_infinity=False)
        if largest is None
        else st.floats(-largest, largest)
    )
    rows = draw(
        st.lists(
            st.lists(numbers, min_size=len(names), max_size=len(names)),
            min_size=len(times),
            max_size=len(times),
        )
    )
    cuts = sorted(draw(st.sets(st.integers(1, len(steps)))) | {len(steps)})
    label = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
    phases = []
    first = 0
    name = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="."), max_size=6)
    link = label.filter(bool)
    for last in cuts:
        held = list(draw(st.dictionaries(name, label, max_size=3)).items())
        holds: list[Hold] = []
        for grasped, attachment in held:
            by = draw(st.sampled_from([None, *holds]))
            holds.append(Hold(grasped, attachment, by, draw(link) if by else None))
        phases.append(PhaseSpan(draw(label), first, last, tuple(holds)))
        first = last
    return Trajectory(names, times, rows, tuple(phases), robot)


@st.composite
def curved_trajectories(draw: st.DrawFn) -> Trajectory:
    """Return smooth motions of four coordinates from rest to rest, some of which rest between.

    Cubics last 10 ms to 1 s, and accelerations jump at their knots.
    """
    count = draw(st.integers(2, 7))
    durations = draw(st.lists(st.floats(0.01, 1.0), min_size=count - 1, max_size=count - 1))
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    times = np.cumsum([0.0, *durations])
    rates = rng.uniform(-1.0, 1.0, (count, 4))
    rates[[0, -1]] = 0.0
    # Means of neighbouring velocities, plus what makes accelerations jump.
    means = (rates[1:] + rates[:-1]) / 2.0 + rng.uniform(-0.1, 0.1, (count - 1, 4))
    rest = draw(st.none() | st.integers(0, count - 2))
    if rest is not None:
        rates[[rest, rest + 1]] = means[rest] = 0.0
    steps = means * np.diff(times)[:, None]
    positions = np.concatenate([np.zeros((1, 4)), np.cumsum(steps, axis=0)])
    names = ("base_x", "base_y", "base_yaw", "lift")
    inner = draw(st.sets(st.integers(1, count - 1))) | {count - 1}
    waypoints = [0, *sorted(inner)]
    phases = (PhaseSpan("move", 0, len(waypoints) - 1),)
    curve = Curve(times, positions, rates)
    return Trajectory(names, times[waypoints], positions[waypoints], phases, 4, curve)


def are_equal(one: Trajectory, other: Trajectory) -> bool:
    return one.to_dict() == other.to_dict()


def write_text_file(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


NAMES = ("base_x", "base_y", "base_yaw", "shoulder", "elbow", "door.hinge")
ROWS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        [3.0, 4.0, 0.5, 0.1, 0.8, 0.0],
        [3.0, 4.0, 0.5, 0.1, 0.8, 0.0],
        [2.0, 4.0, 4.0, -0.3, 0.9, 1.2],
    ]
)
TIMES = np.array([0.0, 2.0, 2.5, 6.5])
PHASES = (
    PhaseSpan("reach door.handle", 0, 2),
    PhaseSpan("move door.hinge", 2, 3, (Hold("door", "handle"),)),
)


def make_example_trajectory(**changes: Any) -> Trajectory:
    fields = {
        "names": NAMES,
        "times": TIMES,
        "positions": ROWS,
        "phases": PHASES,
        "robot_size": 5,
        **changes,
    }
    return Trajectory(**fields)
