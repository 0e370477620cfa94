"""Solves the closed linkages of an MJCF file, which trees of joints cannot express."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vkc_pin.utils.arrays import Floats

__all__ = ["solve_linkages"]

_STEPS = 8  # steps of the driving joint from rest to either end of its range
_GAP = 1e-3  # [m] largest distance at which a loop counts as closed
_STIFFNESS = 1e-4  # weight of the distance from the previous configuration
_MAX_JOINTS = 24


def solve_linkages(mujoco: Any, model: Any) -> list[list[dict[int, float]]]:
    """Return configurations of each linkage that is closed by <connect>.

    The joint with an actuator, or else the first one, drives a linkage. Joints that <joint>
    equalities couple belong to one linkage.

    Returns:
        For each linkage, its configurations at rest, at both ends of the driving joint's travel and
        halfway; each maps joint numbers to displacements from the file's pose, [m] or [rad].
    """
    return [
        _Linkage(mujoco, model, joints, connects, couplings).sweep()
        for joints, connects, couplings in _find_linkages(mujoco, model)
        if len(joints) <= _MAX_JOINTS
    ]


def _find_linkages(mujoco: Any, model: Any) -> list[tuple[list[int], list[int], list[int]]]:
    """Return joints, <connect> constraints and <joint> couplings of each linkage."""
    kinds, is_active = mujoco.mjtEq, model.eq_active0 > 0
    linkages: list[tuple[set[int], set[int], set[int]]] = []
    for k in np.flatnonzero((model.eq_type == int(kinds.mjEQ_CONNECT)) & is_active).tolist():
        one, other = (_find_joints(model, body) for body in _get_bodies(mujoco, model, k))
        if one and other:
            linkages.append((one ^ other, {k}, set()))
    for k in np.flatnonzero((model.eq_type == int(kinds.mjEQ_JOINT)) & is_active).tolist():
        pair = {int(model.eq_obj1id[k]), int(model.eq_obj2id[k])} - {-1}
        if any(pair & joints for joints, _, _ in linkages):
            linkages.append((pair, set(), {k}))
    merged: list[tuple[set[int], set[int], set[int]]] = []
    for linkage in linkages:
        touching = [other for other in merged if other[0] & linkage[0]]
        merged = [other for other in merged if other not in touching]
        joints, loops, pairs = (
            set[int]().union(*sets) for sets in zip(linkage, *touching, strict=True)
        )
        merged.append((joints, loops, pairs))
    return [(sorted(joints), sorted(loops), sorted(pairs)) for joints, loops, pairs in merged]


def _get_bodies(mujoco: Any, model: Any, equality: int) -> tuple[int, int]:
    one, other = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
    if model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE):
        return int(model.site_bodyid[one]), int(model.site_bodyid[other])
    return one, other


def _find_joints(model: Any, body: int) -> set[int]:
    """Return the joints between a body and the world."""
    joints = set[int]()
    while body > 0:
        first = int(model.body_jntadr[body])
        joints |= set(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    return joints


class _Linkage:
    def __init__(
        self,
        mujoco: Any,
        model: Any,
        joints: Sequence[int],
        connects: Sequence[int],
        couplings: Sequence[int],
    ) -> None:
        self._mujoco, self._model, self._data = mujoco, model, mujoco.MjData(model)
        self._joints, self._connects, self._couplings = list(joints), connects, couplings
        self._addresses = model.jnt_qposadr[self._joints]
        self._zero = np.array(model.qpos0[self._addresses])
        limited = model.jnt_limited[self._joints].astype(bool)
        low, high = model.jnt_range[self._joints].T
        self._low = np.where(limited, low, -np.inf) - self._zero
        self._high = np.where(limited, high, np.inf) - self._zero
        by_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
        driven = set(model.actuator_trnid[by_joint, 0].tolist())
        self._driver = next((k for k, joint in enumerate(self._joints) if joint in driven), 0)

    def sweep(self) -> list[dict[int, float]]:
        """Return the configurations at rest, halfway to either end, and at either end."""
        rest = np.clip(np.zeros(len(self._joints)), self._low, self._high)
        found = [rest]
        for end in (self._low[self._driver], self._high[self._driver]):
            path = self._follow(rest, float(end)) if np.isfinite(end) else []
            found += [path[(len(path) - 1) // 2], path[-1]] if path else []
        return [dict(zip(self._joints, map(float, state), strict=True)) for state in found]

    def _follow(self, rest: Floats, end: float) -> list[Floats]:
        """Return closed configurations on a path of the driving joint to `end`."""
        from scipy.optimize import least_squares

        path, before = list[Floats](), rest
        high = np.maximum(self._high, self._low + 1e-6)
        for target in np.linspace(rest[self._driver], end, _STEPS + 1)[1:]:

            def measure(state: Floats, target: float = target, before: Floats = before) -> Floats:
                off = [state[self._driver] - target], _STIFFNESS * (state - before)
                return np.concatenate([self._measure_gaps(state), *off])

            start = np.clip(before, self._low + 1e-9, high - 1e-9)
            state = least_squares(measure, start, bounds=(self._low, high)).x
            gaps = np.abs(self._measure_gaps(state)).max(initial=0.0)
            if gaps > _GAP or abs(state[self._driver] - target) > _GAP:
                break
            path.append(state)
            before = state
        return path

    def _measure_gaps(self, state: Floats) -> Floats:
        """Return the errors of the loops [m] and of the couplings."""
        model, data = self._model, self._data
        data.qpos[:] = model.qpos0
        data.qpos[self._addresses] = self._zero + state
        self._mujoco.mj_kinematics(model, data)
        gaps = [np.subtract(*self._find_anchors(k)) for k in self._connects]
        index = {joint: k for k, joint in enumerate(self._joints)}
        for k in self._couplings:
            one, other = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
            leader = state[index[other]] if other >= 0 else 0.0
            value = np.polynomial.polynomial.polyval(leader, model.eq_data[k, :5])
            gaps.append(np.array([state[index[one]] - value]))
        return np.concatenate(gaps)

    def _find_anchors(self, equality: int) -> tuple[Floats, Floats]:
        """Return both ends of a <connect> in the world [m], shape (3,) each."""
        model, data = self._model, self._data
        ids = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        if model.eq_objtype[equality] == int(self._mujoco.mjtObj.mjOBJ_SITE):
            return data.site_xpos[ids[0]].copy(), data.site_xpos[ids[1]].copy()
        anchors = model.eq_data[equality, :3], model.eq_data[equality, 3:6]
        first, second = (
            data.xpos[body] + data.xmat[body].reshape(3, 3) @ anchor
            for body, anchor in zip(ids, anchors, strict=True)
        )
        return first, second
