"""Trajectories: efforts and rates by hand, interpolation, phases, plain data, bad input."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.motion.trajectory import PhaseSpan, Trajectory, filled, join
from vkc_pin.scene.hold import Hold, holds_of

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
PHASES = (PhaseSpan("reach door.handle", 0, 2), PhaseSpan("move door.hinge", 2, 3, (Hold("door", "handle"),)))


def example(**changes: Any) -> Trajectory:
    fields = {"names": NAMES, "times": TIMES, "positions": ROWS, "phases": PHASES, "robot_size": 5, **changes}
    return Trajectory(**fields)


def test_efforts() -> None:
    assert example().base_effort() == pytest.approx(5.0 + 1.0)
    assert example().base_effort_l1() == pytest.approx(3.0 + 4.0 + 1.0)
    assert example().arm_effort() == pytest.approx(0.1 + 0.2 + 0.4 + 0.1)  # neither the heading nor the door counts


def test_velocities() -> None:
    expected = [[1.5, 2.0, 0.25, 0.05, -0.1, 0.0], [0.0] * 6, [-0.25, 0.0, 0.875, -0.1, 0.025, 0.3]]
    np.testing.assert_allclose(example().velocities(), expected)


def test_accelerations() -> None:
    """The step of velocity over the shorter of both neighbours' durations; from and to rest."""
    x, hinge = [1.5 / 2.0, -1.5 / 0.5, -0.25 / 0.5, 0.25 / 4.0], [0.0, 0.0, 0.3 / 0.5, -0.3 / 4.0]
    np.testing.assert_allclose(example().accelerations()[:, 0], x)
    np.testing.assert_allclose(example().accelerations()[:, 5], hinge)
    assert example().accelerations().shape == (4, 6)


def test_at() -> None:
    motion = example()
    np.testing.assert_allclose(motion.at(1.0), ROWS[1] / 2 + ROWS[0] / 2)
    np.testing.assert_allclose(motion.at([3.5, 6.5])[0], 0.75 * ROWS[2] + 0.25 * ROWS[3], atol=1e-15)
    np.testing.assert_array_equal(motion.at(TIMES), ROWS)
    np.testing.assert_array_equal(motion.at([-1.0, 7.0]), ROWS[[0, -1]])
    assert motion.at(np.zeros((2, 3))).shape == (2, 3, 6)


def test_columns() -> None:
    column = example().column("door.hinge")
    np.testing.assert_array_equal(column, ROWS[:, 5])
    column[:] = 7.0  # a copy
    np.testing.assert_array_equal(example().column("door.hinge"), ROWS[:, 5])
    with pytest.raises(UnknownNameError) as caught:
        example().column("door.hing")
    assert caught.value.nearest == "door.hinge"


def test_it_cannot_be_changed() -> None:
    rows = ROWS.copy()
    motion = example(positions=rows)
    rows[0, 0] = 9.0
    assert motion.positions[0, 0] == 0.0
    for array in (motion.positions, motion.times):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_round_trip() -> None:
    motion = example(positions=np.random.default_rng(0).normal(size=ROWS.shape))
    again = Trajectory.from_dict(json.loads(json.dumps(motion.to_dict())))
    np.testing.assert_array_equal(again.positions, motion.positions)
    np.testing.assert_array_equal(again.times, motion.times)
    assert (again.names, again.phases, again.robot_size) == (motion.names, motion.phases, motion.robot_size)


def test_what_is_held_through_something_is_kept_too() -> None:
    held, by = {"stick": "grip", "ball": "pull"}, {"ball": "stick.tip"}
    phases = (PhaseSpan("reach", 0, 2), PhaseSpan("carry", 2, 3, holds_of(held, by)))
    data = json.loads(json.dumps(example(phases=phases).to_dict()))
    assert [phase["by"] for phase in data["phases"]] == [{}, by]
    assert Trajectory.from_dict(data).phases == phases
    for phase in data["phases"]:  # as motions were saved before there was such a thing
        del phase["by"]
    assert [phase.holds for phase in Trajectory.from_dict(data).phases] == [(), holds_of(held)]


@pytest.mark.parametrize("key", ["names", "times", "positions", "phases", "robot_size"])
def test_data_that_lacks_something(key: str) -> None:
    data = example().to_dict()
    del data[key]
    with pytest.raises(InputError) as caught:
        Trajectory.from_dict(data)
    assert caught.value.field == key


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("Trajectory.times", {"times": [0.0, 1.0, 1.0, 2.0]}),
        ("Trajectory.times", {"times": [[0.0, 1.0, 2.0, 3.0]]}),
        ("Trajectory.times", {"times": [0.0], "positions": ROWS[:1], "phases": ()}),
        ("Trajectory.times", {"times": "soon"}),
        ("Trajectory.times[3]", {"times": [0.0, 1.0, 2.0, np.inf]}),
        ("Trajectory.positions", {"positions": ROWS[:3]}),
        ("Trajectory.positions", {"positions": ROWS[:, :5]}),
        ("Trajectory.positions", {"positions": [[0.0], [1.0, 2.0]]}),
        ("Trajectory.positions[2, 1]", {"positions": np.where(np.arange(24).reshape(4, 6) == 13, np.nan, ROWS)}),
        ("Trajectory.names", {"names": (*NAMES[:5], "elbow")}),
        ("Trajectory.robot_size", {"robot_size": 7}),
        ("Trajectory.robot_size", {"robot_size": 2}),
        ("Trajectory.phases", {"phases": ()}),
        ("Trajectory.phases", {"phases": PHASES[:1]}),
        ("Trajectory.phases", {"phases": PHASES[1:]}),
        ("Trajectory.phases", {"phases": (PHASES[0], PhaseSpan("gap", 1, 3))}),
        ("Trajectory.phases", {"phases": (PHASES[0], PhaseSpan("nothing", 2, 2), PHASES[1])}),
        ("Trajectory.phases", {"phases": (PHASES[0], PhaseSpan("beyond", 2, 4))}),
    ],
)
def test_bad_input(field: str, changes: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        example(**changes)
    assert caught.value.field == field


def test_what_is_not_known_is_as_it_was_or_as_it_will_be() -> None:
    nan = np.nan
    table = np.array([[nan, 1.0, nan], [2.0, nan, nan], [nan, nan, nan], [3.0, 4.0, nan], [nan, nan, nan]])
    expected = [[2.0, 1.0, nan], [2.0, 1.0, nan], [2.0, 1.0, nan], [3.0, 4.0, nan], [3.0, 4.0, nan]]
    np.testing.assert_array_equal(filled(table), expected)
    assert np.isnan(table[0, 0])  # what was given is left alone


def parts() -> tuple[Trajectory, Trajectory, Trajectory]:
    """Reach for the door, open it, and go on, holding what was held; only the second knows the door's hinge."""
    robot = NAMES[:5]
    held = (Hold("door", "handle"),)
    reach = Trajectory(robot, np.array([0.0, 1.0, 3.0]), ROWS[:3, :5], (PhaseSpan("a", 0, 1), PhaseSpan("b", 1, 2)), 5)
    opens = Trajectory(NAMES, np.array([7.0, 8.0]), ROWS[2:], (PhaseSpan("c", 0, 1, held),), 5)
    after = Trajectory(robot, np.array([0.0, 0.5]), ROWS[[3, 0], :5], (PhaseSpan("d", 0, 1, held),), 5)
    return reach, opens, after


def test_motions_are_joined() -> None:
    """The hand closes between the first two, so the robot waits there; between the others it does not."""
    whole = join(parts(), pause=0.25)
    assert whole.names == NAMES
    np.testing.assert_allclose(whole.times, [0.0, 1.0, 3.0, 3.25, 4.25, 4.75])
    np.testing.assert_array_equal(whole.positions[:, :5], ROWS[[0, 1, 2, 2, 3, 0], :5])
    np.testing.assert_array_equal(whole.positions[:, 5], [0.0, 0.0, 0.0, 0.0, 1.2, 1.2])  # as it will be, or as it was
    # Waiting belongs to what follows.
    assert [(p.name, p.first, p.last) for p in whole.phases] == [("a", 0, 1), ("b", 1, 2), ("c", 2, 4), ("d", 4, 5)]
    assert [dict(p.held) for p in whole.phases] == [{}, {}, {"door": "handle"}, {"door": "handle"}]
    assert whole.robot_size == 5


def test_what_is_held_through_another_thing_makes_a_pause_too() -> None:
    both = {"stick": "grip", "ball": "pull"}
    holds = [holds_of(both, {"ball": "stick.tip"}), holds_of(both), holds_of({"stick": "grip"})]
    spans = [PhaseSpan(name, 0, 1, held) for name, held in zip("abc", holds, strict=True)]
    motions = [Trajectory(NAMES, np.array([0.0, 1.0]), ROWS[[1, 2]], (span,), 5) for span in spans]
    np.testing.assert_allclose(join(motions, pause=0.5).times, [0.0, 1.0, 1.5, 2.5, 3.0, 4.0])


def test_one_motion_alone_stays_as_it_is() -> None:
    whole = join([example()], pause=1.0)
    np.testing.assert_array_equal(whole.positions, ROWS)
    np.testing.assert_array_equal(whole.times, TIMES)
    assert whole.phases == PHASES


def test_only_motions_that_follow_one_another_can_be_joined() -> None:
    reach, opens, _ = parts()
    with pytest.raises(InputError) as raised:
        join([reach, reach], pause=0.1)
    assert raised.value.field == "parts[1]"
    moved = Trajectory(NAMES, opens.times, opens.positions + 2e-6, opens.phases, 5)
    with pytest.raises(InputError):
        join([reach, moved], pause=0.1)
    closer = Trajectory(NAMES, opens.times, opens.positions + 5e-7, opens.phases, 5)
    assert len(join([reach, closer], pause=0.1).times) == 5
    with pytest.raises(InputError, match="nothing to join"):
        join([], pause=0.1)
