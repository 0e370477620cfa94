from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin import Plan
from vkc_pin.world.trajectory.placements import Motion, key_times, sample_motion
from vkc_pin.world.trajectory.world_model import World


@pytest.fixture(scope="module")
def world(plan: Plan) -> World:
    return World(plan.scene)


@pytest.fixture(scope="module")
def motion(world: World, plan: Plan) -> Motion:
    return sample_motion(world, plan.trajectory)


def test_key_times_include_waypoints_and_divide_long_turns(plan: Plan) -> None:
    times = key_times(plan.trajectory)
    assert set(plan.trajectory.times) <= set(times)
    assert np.abs(np.diff(plan.trajectory.at(times), axis=0)).max() <= 1.0 + 1e-9
    assert (np.diff(times) > 0).all()


def test_key_times_limit_the_change_of_coordinates(plan: Plan) -> None:
    names = plan.trajectory.names
    times = key_times(plan.trajectory, {names[0]: 2.0, names[3]: 0.0125})
    moved = np.abs(np.diff(plan.trajectory.at(times), axis=0))
    assert moved[:, 3].max() <= 0.0125 + 1e-9
    assert len(times) > len(key_times(plan.trajectory))


def test_placements_equal_those_of_the_world_model(
    motion: Motion, world: World, plan: Plan
) -> None:
    data, k = world.model.createData(), 5
    (row,) = world.compute_positions(plan.trajectory, [motion.times[k]])
    pin.framesForwardKinematics(world.model, data, world.coordinates.q(row))
    tool = data.oMf[world.model.getFrameId(plan.scene.robot.tool_frame)].translation
    assert np.allclose(motion.tool[k], tool)
    assert np.allclose(motion.base[k, :2], row[:2])
    for j in range(1, world.model.njoints):
        assert np.allclose(motion.world[k, j], data.oMi[j].homogeneous)
        parent = motion.world[k, world.model.parents[j]]
        assert np.allclose(parent @ motion.local[j][k].homogeneous, data.oMi[j].homogeneous)
