from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.episode import run_attempt
from vkc_pin.datasets.formats.hdf5 import (
    make_part,
    read_episodes,
    read_numbers,
    write_shard,
)
from vkc_pin.datasets.formats.samples import sample_episode
from vkc_pin.errors import InputError

h5py = pytest.importorskip("h5py")


def test_groups_have_the_robomimic_layout(dataset: Dataset) -> None:
    (shard,) = dataset.shards
    with h5py.File(shard) as file:
        data = file["data"]
        assert json.loads(data.attrs["env_args"]).keys() == {"env_name", "env_type", "env_kwargs"}
        assert sorted(data) == [f"demo_{k}" for k in range(4)]
        assert data.attrs["total"] == sum(group.attrs["num_samples"] for group in data.values())
        masks = [name.decode() for mask in file["mask"].values() for name in mask[:]]
        assert sorted(masks) == sorted(data)
        for group in data.values():
            count = group.attrs["num_samples"]
            assert {"actions", "states", "obs", "rewards", "dones"} <= set(group)
            for name, values in [
                *group["obs"].items(),
                *((name, group[name]) for name in ("actions", "states", "rewards", "dones")),
            ]:
                assert len(values) == count, name
                assert values.dtype in (np.float32, np.uint8), name
            assert group["dones"][:].tolist() == [0] * (count - 1) + [1]
            actions, observations = group["actions"][:], group["obs"]
            parts = ("base_pose", "arm_position", "gripper")
            robot = np.hstack([observations[name][:] for name in parts])
            assert np.array_equal(actions[:-1], robot[1:])  # an action is the robot's next state


def test_episodes_are_read_back_to_1e_9(dataset: Dataset) -> None:
    for episode in read_episodes(dataset.shards[0], dataset.folder / "scenes"):
        record, fresh = run_attempt(dataset.recipe.document, episode.number, {})
        assert record["success"]
        assert fresh is not None
        times = np.linspace(fresh.trajectory.times[0], fresh.trajectory.times[-1], 300)
        assert np.abs(episode.trajectory.at(times) - fresh.trajectory.at(times)).max() <= 1e-9
        assert episode.trajectory.phases == fresh.trajectory.phases
        for name in ("steps", "options", "about", "document"):
            assert getattr(episode, name) == getattr(fresh, name)
        assert np.array_equal(episode.scene().start, fresh.scene().start)


def test_samples_lie_on_the_trajectory(dataset: Dataset) -> None:
    episode = next(dataset.episodes())
    robot = episode.scene().robot
    found = sample_episode(episode, robot, 25.0)
    motion = episode.trajectory
    assert found["time"][-1] == motion.times[-1]
    assert np.allclose(np.diff(found["time"])[:-1], 0.04)
    assert np.array_equal(found["states"], motion.at(found["time"]))
    step = 1e-6
    middle = found["time"][5]
    rate = (motion.at(middle + step) - motion.at(middle - step)) / (2 * step)
    assert np.allclose(found["arm_velocity"][5], rate[3 : motion.robot_size], atol=1e-5)
    data = robot.model.createData()
    pin.framesForwardKinematics(
        robot.model, data, robot.coordinates.q(found["states"][7][: motion.robot_size])
    )
    hand = data.oMf[robot.model.getFrameId(robot.tool_frame)]
    hand_pose = pin.XYZQUATToSE3(found["hand_pose"][7])
    assert np.allclose(hand_pose.homogeneous, hand.homogeneous, atol=1e-9)
    assert (found["holding"] == 1.0).all()  # grasped from the start
    assert (
        np.einsum("ij,ij->i", found["hand_pose"][1:, 3:], found["hand_pose"][:-1, 3:]) > 0.0
    ).all()


def test_shards_are_reproducible(dataset: Dataset, tmp_path: Path) -> None:
    """Rewriting the episodes and copying the shard give the same bytes."""
    files, recipe = [], dataset.recipe
    for episode in dataset.episodes():
        files.append(tmp_path / f"{episode.number}.hdf5")
        part = make_part(episode, episode.scene().robot, recipe.fields.rate, recipe.digest)
        files[-1].write_bytes(part)
    again = write_shard(tmp_path / "again.hdf5", [(file, 0) for file in files], tmp_path / "scenes")
    copied = write_shard(
        tmp_path / "copied.hdf5", [(dataset.shards[0], k) for k in range(4)], tmp_path / "scenes"
    )
    assert again.read_bytes() == copied.read_bytes() == dataset.shards[0].read_bytes()
    assert read_numbers(again) == dataset.numbers()
    scenes = [
        {file.name: file.read_bytes() for file in (folder / "scenes").iterdir()}
        for folder in (tmp_path, dataset.folder)
    ]
    assert scenes[0] == scenes[1]


def test_changed_scene_raises(copy: Path) -> None:
    for file in (copy / "scenes").iterdir():
        file.write_text(file.read_text().replace('"floor":true', '"floor":false'))
    with pytest.raises(InputError, match="not what its name says"):
        list(Dataset.open(copy).episodes())
