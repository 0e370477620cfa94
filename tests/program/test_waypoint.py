"""The rows of one waypoint: values by numeric Pinocchio, derivatives by finite differences."""

from __future__ import annotations

import dataclasses
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import door_scene, full_scene, random_configurations

from vkc_pin.cache import Cache
from vkc_pin.chain.chain import VirtualKinematicChain, consolidate
from vkc_pin.chain.pose import PoseRow, target_vector
from vkc_pin.options import Options
from vkc_pin.program.waypoint import Structure, WaypointFunctions, waypoint_functions
from vkc_pin.task.compiler import compile_task
from vkc_pin.task.steps import Actuate

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
    """Random values of all that the functions depend on, and what is computed from them by Pinocchio."""

    def __init__(self, chain: VirtualKinematicChain, poses: tuple[PoseRow, ...], seed: int) -> None:
        self.chain, self.poses, rng = chain, poses, np.random.default_rng(seed)
        self.z = random_configurations(chain.lower, chain.upper, 1, rng)[0]
        self.s = float(rng.normal())
        self.planes = rng.normal(size=(SLOTS, 12 * (chain.model.njoints - 1)))
        self.offsets = rng.normal(size=SLOTS)
        self.targets = [pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3)) for _ in poses]
        self.multipliers = rng.normal(size=SLOTS + sum(pose.rows for pose in poses))

    def inputs(self, z: np.ndarray, s: float) -> list[np.ndarray | float]:
        targets = np.column_stack([target_vector(target) for target in self.targets])
        return [z, s, self.planes.ravel(order="F"), self.offsets, targets.ravel(order="F")]

    def rows(self, z: np.ndarray, s: float) -> np.ndarray:
        """Return the rows as they are defined."""
        model, data = self.chain.model, self.chain.model.createData()
        pin.forwardKinematics(model, data, self.chain.coordinates.q(z))
        stacked = np.concatenate([target_vector(placement) for placement in list(data.oMi)[1:]])
        rows = [self.planes @ stacked - self.offsets + s]
        for pose, target in zip(self.poses, self.targets, strict=True):
            at = data.oMi[pose.joint] * pose.local
            if pose.shift is not None:
                at.translation = at.translation + data.oMi[pose.shift[0]].rotation @ np.array(pose.shift[1])
            offset, error = at.translation - target.translation, target.rotation.T @ at.rotation
            rows.append(offset)
            if pose.kind == "pose":
                rows.append(pin.unSkew((error - error.T) / 2))
                rows.append(np.array([np.trace(error)]))
            elif pose.kind == "upright":
                rows.append(target.rotation @ at.rotation[2])
        return np.concatenate(rows)


def matrix(pattern: tuple[list[int], list[int]], values: ca.DM, shape: tuple[int, int]) -> np.ndarray:
    out = np.zeros(shape)
    out[pattern[0], pattern[1]] = np.array(values).ravel()
    return out


@pytest.mark.parametrize("seed", range(4))
def test_rows_and_their_derivatives(chain: VirtualKinematicChain, seed: int) -> None:
    poses = some_poses(chain)
    functions, numbers, n, h = (
        WaypointFunctions(chain.model, SLOTS, poses, Cache()),
        Numbers(chain, poses, seed),
        chain.size,
        1e-6,
    )
    assert functions.pose_rows == [7, 6, 3]
    assert functions.rows == SLOTS + 16
    given = numbers.inputs(numbers.z, numbers.s)
    np.testing.assert_allclose(np.array(functions.value(*given)).ravel(), numbers.rows(numbers.z, numbers.s), atol=1e-12)

    def jacobian(x: np.ndarray) -> np.ndarray:
        return matrix(functions.jacobian_pattern, functions.jacobian(*numbers.inputs(x[:-1], x[-1])), (functions.rows, n + 1))

    x = np.append(numbers.z, numbers.s)
    steps = h * np.eye(n + 1)
    slopes = [(numbers.rows((x + e)[:-1], (x + e)[-1]) - numbers.rows((x - e)[:-1], (x - e)[-1])) / (2 * h) for e in steps]
    np.testing.assert_allclose(jacobian(x), np.column_stack(slopes), atol=1e-7)
    upper = matrix(functions.hessian_pattern, functions.hessian(*given, numbers.multipliers), (n, n))
    assert (np.tril(upper, -1) == 0.0).all()
    curvature = [numbers.multipliers @ (jacobian(x + e) - jacobian(x - e))[:, :n] / (2 * h) for e in steps[:n]]
    np.testing.assert_allclose(upper + np.triu(upper, 1).T, np.array(curvature), atol=1e-6)


def test_functions_of_one_kind_are_built_once(chain: VirtualKinematicChain) -> None:
    model, poses, cache = door_scene().robot.model, some_poses(chain)[1:2], Cache(entries=3)
    first = waypoint_functions(model, 1, poses, cache)
    later = (dataclasses.replace(poses[0], waypoints=(4, 5)),)
    assert waypoint_functions(model.copy(), 1, later, cache) is first, "at which waypoints does not matter"
    second = waypoint_functions(model, 2, poses, cache)
    assert second is not first
    assert waypoint_functions(model, 1, poses, cache) is first
    other = dataclasses.replace(poses[0], kind="point")
    assert waypoint_functions(model, 1, (other,), cache) not in (first, second)
    assert waypoint_functions(model, 1, poses, cache) is first, "what was asked for last is kept"
    assert waypoint_functions(model, 2, poses, cache) is not second


def test_programs_are_shared_by_structures_that_are_equal(chain: VirtualKinematicChain) -> None:
    given: dict[str, Any] = {"segments": 5, "poses": some_poses(chain), "slots": SLOTS}
    given |= {"weights_velocity": np.ones((5, chain.size)), "weights_acceleration": np.ones(chain.size)}
    one = Structure(model=chain.model, **given)
    assert Structure(model=chain.model.copy(), **given).key == one.key
    for change in (
        {"segments": 6},
        {"slots": 2},
        {"poses": some_poses(chain)[:2]},
        {"weights_acceleration": 2 * np.ones(chain.size)},
        {"stops": (2,)},
        {"differential": True},
        {"clamped": ((3, 1, 4),)},
    ):
        assert dataclasses.replace(one, **change).key != one.key  # type: ignore[arg-type]
    assert not one.timed
