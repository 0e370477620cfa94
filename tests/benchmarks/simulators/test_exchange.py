"""Tests the files and actions that planner and environments share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from .exchange import Motion, read_motion, write_motion, write_state


def make_motion() -> Motion:
    return Motion(["lift", "drawer"], np.arange(8.0).reshape(4, 2), np.array([0, 0, 1, 1], bool))


def test_motions_are_read_as_they_are_written_for_a_reset(tmp_path: Path) -> None:
    qpos = np.array([0.1, 0.2, 0.3])
    write_state(tmp_path, qpos)
    write_motion(tmp_path, make_motion())
    motion = read_motion(tmp_path, qpos)
    np.testing.assert_array_equal(motion.get_positions(["drawer", "lift"])[1], [3.0, 2.0])
    assert motion.get_end("drawer") == 7.0
    with pytest.raises(SystemExit, match="another one"):
        read_motion(tmp_path, qpos + 1e-12)


def test_arm_stands_while_the_hand_closes_and_at_the_end() -> None:
    actions = list(make_motion().iterate_actions(settle=1, close=2))
    assert actions == [
        (0, True, False),
        (1, True, False),
        (2, False, False),
        (2, False, True),
        (2, False, True),
        (2, True, True),
        (3, True, True),
        (3, False, True),
    ]
