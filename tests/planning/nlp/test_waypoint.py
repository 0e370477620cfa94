"""Compares the rows of one waypoint with numeric Pinocchio, derivatives with differences."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import door_scene, full_scene, random_configurations
from helpers.telescopes import coupled_scene

from vkc_pin.options import Options
from vkc_pin.planning.chain.chain import VirtualKinematicChain, consolidate
from vkc_pin.planning.chain.pose import POSE_OFFSET_SIZE, PoseRow, flatten_target
from vkc_pin.planning.nlp.waypoint import Structure, WaypointFunctions, get_waypoint_functions
from vkc_pin.utils.cache import Cache
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.steps import Actuate
from vkc_pin.world.trajectory.wheels import RollingLimits

SLOTS = 3


@pytest.fixture(scope="module")
def chain() -> VirtualKinematicChain:
    """Arm, door and a drawer: turning and sliding joints, and joints that branch."""
    steps = [Actuate("door", {"hinge": 1.2}), Actuate("drawer", {"slide": 0.2})]
    return consolidate(full_scene(), compile_task(full_scene(), steps, Options()).holds)


def some_poses(chain: VirtualKinematicChain) -> tuple[PoseRow, ...]:
    rng, last = np.random.default_rng(0), chain.model.njoints - 1
    local = [pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3)) for _ in range(3)]
    return (
        PoseRow(last, local[0], (1,)),
        PoseRow(5, local[1], (1,), "upright"),
        PoseRow(last, local[2], (1,), "point", (4, (0.1, -0.2, 0.3))),
    )


class Numbers:
    """Random inputs of the functions, and results computed from them by Pinocchio."""

    def __init__(self, chain: VirtualKinematicChain, poses: tuple[PoseRow, ...], seed: int) -> None:
        self.chain, self.poses, rng = chain, poses, np.random.default_rng(seed)
        self.z = random_configurations(chain.lower, chain.upper, 1, rng)[0]
        self.s, self.share = rng.normal(size=SLOTS), float(rng.uniform(0.1, 0.9))
        self.planes = rng.normal(size=(SLOTS, 12 * (chain.model.njoints - 1)))
        self.offsets = rng.normal(size=SLOTS)
        self.targets = [pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3)) for _ in poses]
        self.multipliers = rng.normal(size=SLOTS + sum(pose.rows for pose in poses))
        axes = rng.normal(size=(len(poses), 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        self.pose_offsets = np.column_stack(
            [rng.normal(size=(len(poses), 3)), axes, rng.uniform(0.0, np.pi, len(poses))]
        )

    @property
    def own(self) -> np.ndarray:
        """Its variables: z, slacks and share."""
        return np.concatenate([self.z, self.s, [self.share]])

    def inputs(self, own: np.ndarray) -> list[np.ndarray]:
        targets = np.column_stack([flatten_target(target) for target in self.targets])
        return [
            own,
            self.planes.ravel(order="F"),
            self.offsets,
            targets.ravel(order="F"),
            self.pose_offsets.ravel(),
        ]

    def rows(self, own: np.ndarray) -> np.ndarray:
        """Return the rows as they are defined."""
        z, s, share = np.split(own, [self.chain.size, self.chain.size + SLOTS])
        model, data = self.chain.model, self.chain.model.createData()
        pin.forwardKinematics(model, data, self.chain.coordinates.q(z))
        stacked = np.concatenate([flatten_target(placement) for placement in list(data.oMi)[1:]])
        rows = [self.planes @ stacked - self.offsets + s]
        for pose, there, pose_offsets in zip(
            self.poses, self.targets, self.pose_offsets, strict=True
        ):
            turn = pin.exp3(float(share[0]) * pose_offsets[6] * pose_offsets[3:6])
            target = pin.SE3(there.rotation @ turn, there.translation + share * pose_offsets[:3])
            at = data.oMi[pose.joint] * pose.local
            if pose.shift is not None:
                at.translation = at.translation + data.oMi[pose.shift[0]].rotation @ np.array(
                    pose.shift[1]
                )
            offset, error = at.translation - target.translation, target.rotation.T @ at.rotation
            rows.append(offset)
            if pose.kind == "pose":
                rows.append(pin.unSkew((error - error.T) / 2))
                rows.append(np.array([np.trace(error)]))
            elif pose.kind == "upright":
                rows.append(target.rotation @ at.rotation[2])
        return np.concatenate(rows)


def matrix(
    pattern: tuple[list[int], list[int]], values: ca.DM, shape: tuple[int, int]
) -> np.ndarray:
    out = np.zeros(shape)
    out[pattern[0], pattern[1]] = np.array(values).ravel()
    return out


@pytest.mark.parametrize("seed", range(4))
def test_rows_and_their_derivatives(chain: VirtualKinematicChain, seed: int) -> None:
    poses = some_poses(chain)
    functions, numbers = (
        WaypointFunctions(chain.model, SLOTS, poses, Cache()),
        Numbers(chain, poses, seed),
    )
    x, width, h = numbers.own, chain.size + SLOTS + 1, 1e-6
    assert x.shape == (width,)
    assert functions.pose_rows == [7, 6, 3]
    assert functions.rows == SLOTS + 16
    np.testing.assert_allclose(
        np.array(functions.value(*numbers.inputs(x))).ravel(), numbers.rows(x), atol=1e-12
    )

    def jacobian(x: np.ndarray) -> np.ndarray:
        return matrix(
            functions.jacobian_pattern,
            functions.jacobian(*numbers.inputs(x)),
            (functions.rows, width),
        )

    steps = h * np.eye(width)
    slopes = [(numbers.rows(x + e) - numbers.rows(x - e)) / (2 * h) for e in steps]
    np.testing.assert_allclose(jacobian(x), np.column_stack(slopes), atol=1e-7)
    upper = matrix(
        functions.hessian_pattern,
        functions.hessian(*numbers.inputs(x), numbers.multipliers),
        (width, width),
    )
    assert (np.tril(upper, -1) == 0.0).all()
    assert upper[:, -1].any(), "shares bend what they turn"
    curvature = [numbers.multipliers @ (jacobian(x + e) - jacobian(x - e)) / (2 * h) for e in steps]
    np.testing.assert_allclose(upper + np.triu(upper, 1).T, np.array(curvature), atol=1e-6)


def test_rows_of_a_chain_whose_joints_follow_others(tmp_path: Path) -> None:
    """A coordinate that moves several joints, one after the other, adds up what each does."""
    chain = consolidate(coupled_scene(tmp_path), {"drawer": "grip"})
    assert (chain.size, chain.model.njoints) == (7, 11)
    test_rows_and_their_derivatives(chain, 7)


def test_without_poses_only_slacks_help(chain: VirtualKinematicChain) -> None:
    """Each helps its own plane, and the share none."""
    functions, numbers = WaypointFunctions(chain.model, SLOTS, (), Cache()), Numbers(chain, (), 0)
    inputs = [
        numbers.own,
        numbers.planes.ravel(order="F"),
        numbers.offsets,
        np.ones(12),
        np.ones(POSE_OFFSET_SIZE),
    ]
    np.testing.assert_allclose(
        np.array(functions.value(*inputs)).ravel(), numbers.rows(numbers.own), atol=1e-12
    )
    jacobian = matrix(
        functions.jacobian_pattern, functions.jacobian(*inputs), (SLOTS, chain.size + SLOTS + 1)
    )
    np.testing.assert_array_equal(jacobian[:, chain.size :], np.eye(SLOTS, SLOTS + 1))
    assert max(functions.hessian_pattern[1]) < chain.size


def test_one_plane_and_no_pose(chain: VirtualKinematicChain) -> None:
    """A single row, of which a slice would be a scalar."""
    functions = WaypointFunctions(chain.model, 1, (), Cache())
    assert functions.rows == functions.value.numel_out(0) == 1
    some = WaypointFunctions(chain.model, 1, some_poses(chain), Cache())
    assert some.rows == 1 + sum(some.pose_rows)


def test_functions_of_one_kind_are_built_once(chain: VirtualKinematicChain) -> None:
    model, poses, cache = door_scene().robot.model, some_poses(chain)[1:2], Cache(max_entries=4)
    first = get_waypoint_functions(model, 1, poses, cache)
    later = (dataclasses.replace(poses[0], waypoints=(4, 5)),)
    assert get_waypoint_functions(model.copy(), 1, later, cache) is first, (
        "at which waypoints does not matter"
    )
    second = get_waypoint_functions(model, 2, poses, cache)
    assert second is not first
    assert get_waypoint_functions(model, 1, poses, cache) is first
    other = dataclasses.replace(poses[0], kind="point")
    assert get_waypoint_functions(model, 1, (other,), cache) not in (first, second)
    assert get_waypoint_functions(model, 1, poses, cache) is first, (
        "what was asked for last is kept"
    )
    assert get_waypoint_functions(model, 2, poses, cache) is not second


def test_programs_are_shared_by_structures_that_are_equal(chain: VirtualKinematicChain) -> None:
    given: dict[str, Any] = {"segments": 5, "poses": some_poses(chain), "slots": SLOTS}
    one = Structure(model=chain.model, **given)
    assert Structure(model=chain.model.copy(), **given).key == one.key
    for change in (
        {"segments": 6},
        {"slots": 2},
        {"poses": some_poses(chain)[:2]},
        {"stops": (2,)},
        {"rolling": RollingLimits()},
        {"rolling": RollingLimits(turning_radius=0.8)},
        {"rolling": RollingLimits(track=0.5, wheel_speed=1.0)},
        {"clamped": ((3, 1, 4),)},
        {"pushed": ((3, 1, 4, 1),)},
        {"pushed": ((3, 1, 4, -1),)},
    ):
        assert dataclasses.replace(one, **change).key != one.key  # type: ignore[arg-type]
    assert not one.timed
