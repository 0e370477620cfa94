"""Closes the loops of linkages, which a tree of joints cannot express."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.importing.description import MOVING_KINDS, Coupling, Description, Joint, Loop
from vkc_pin.utils.arrays import Floats

_STEPS = 8  # steps of the driving joint from rest to either end of its range
_GAP = 1e-3  # [m] largest distance at which a loop counts as closed
_STIFFNESS = 1e-4  # weight of the distance from the previous configuration
_MAX_JOINTS = 24


def solve_linkages(description: Description) -> list[list[dict[str, float]]]:
    """Return configurations of each linkage that is closed at points.

    The joint with an actuator, or else the first one, drives a linkage. Coupled joints belong to
    one linkage.

    Returns:
        For each linkage, its configurations at rest, at both ends of the driving joint's travel and
        halfway; each maps names of joints to positions, [m] or [rad].
    """
    found = list[list[dict[str, float]]]()
    for names, loops, couplings in _find_linkages(description):
        joints = [joint for joint in description.joints.values() if joint.name in names]
        are_scalar = all(joint.kind in MOVING_KINDS for joint in joints)
        if are_scalar and len(joints) <= _MAX_JOINTS:
            found.append(_Linkage(description, joints, loops, couplings).sweep())
    return found


_Parts = tuple[set[str], list[Loop], list[Coupling]]


def _find_linkages(description: Description) -> list[_Parts]:
    """Return names of the joints, the loops and the couplings of each linkage."""
    linkages = list[_Parts]()
    for loop in description.loops:
        one, other = (set(_walk_joints(description, link)) for link in loop.links)
        if loop.points is not None and one and other:
            linkages.append((one ^ other, [loop], []))
    for coupling in description.couplings:
        coupled = {coupling.joint}
        if coupling.leader is not None:
            coupled.add(coupling.leader)
        if any(coupled & joints for joints, _, _ in linkages):
            linkages.append((coupled, [], [coupling]))
    merged = list[_Parts]()
    for joints, loops, couplings in linkages:
        apart = list[_Parts]()
        for other_joints, other_loops, other_couplings in merged:
            if other_joints & joints:
                joints = joints | other_joints
                loops = loops + other_loops
                couplings = couplings + other_couplings
            else:
                apart.append((other_joints, other_loops, other_couplings))
        merged = [*apart, (joints, loops, couplings)]
    return merged


def _walk_joints(description: Description, link: str) -> Iterator[str]:
    """Yield the names of the joints between a link and the root that are not fixed."""
    for above in description.walk_up(link):
        joint = description.joints.get(above)
        if joint is not None and joint.kind != "fixed":
            yield joint.name


class _Linkage:
    def __init__(
        self,
        description: Description,
        joints: Sequence[Joint],
        loops: Sequence[Loop],
        couplings: Sequence[Coupling],
    ) -> None:
        self._description = description
        self._joints = joints
        self._loops = loops
        self._couplings = couplings
        limits = np.array([joint.limits or (-np.inf, np.inf) for joint in joints], float)
        self._low, self._high = limits.T
        driven = [k for k, joint in enumerate(joints) if joint.is_driven]
        self._driver = driven[0] if driven else 0

    def sweep(self) -> list[dict[str, float]]:
        """Return the configurations at rest, halfway to either end, and at either end."""
        rest = np.clip(np.zeros(len(self._joints)), self._low, self._high)
        found = [rest]
        for end in (self._low[self._driver], self._high[self._driver]):
            path = self._follow(rest, float(end)) if np.isfinite(end) else []
            if path:
                found += [path[(len(path) - 1) // 2], path[-1]]
        return [self._name_positions(state) for state in found]

    def _name_positions(self, state: Floats) -> dict[str, float]:
        names = [joint.name for joint in self._joints]
        return dict(zip(names, map(float, state), strict=True))

    def _follow(self, rest: Floats, end: float) -> list[Floats]:
        """Return closed configurations on a path of the driving joint to `end`.

        With the gaps g of loops and couplings, the driver's position x_d, its target t and the
        previous configuration x', each configuration x minimises
        |g(x)|² + (x_d - t)² + w² |x - x'|², where w is `_STIFFNESS`.
        """
        from scipy.optimize import least_squares

        path = list[Floats]()
        before = rest
        high = np.maximum(self._high, self._low + 1e-6)
        for target in np.linspace(rest[self._driver], end, _STEPS + 1)[1:]:

            def measure(state: Floats, target: float = target, before: Floats = before) -> Floats:
                off_target = [state[self._driver] - target]
                off_before = _STIFFNESS * (state - before)
                return np.concatenate([self._measure_gaps(state), off_target, off_before])

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
        positions = self._name_positions(state)
        gaps = list[Floats]()
        for loop in self._loops:
            assert loop.points is not None
            first_link, second_link = loop.links
            first_point, second_point = loop.points
            first = self._place_point(first_link, first_point, positions)
            second = self._place_point(second_link, second_point, positions)
            gaps.append(first - second)
        for coupling in self._couplings:
            leader = positions[coupling.leader] if coupling.leader is not None else 0.0
            gaps.append(np.array([positions[coupling.joint] - coupling.evaluate(leader)]))
        return np.concatenate(gaps)

    def _place_point(self, link: str, point: Floats, positions: Mapping[str, float]) -> Floats:
        """Return a point of a link in the root's frame [m], shape (3,)."""
        placement = pin.SE3.Identity()
        for above in self._description.walk_up(link):
            joint = self._description.joints.get(above)
            if joint is not None:
                motion = joint.compute_motion(positions.get(joint.name, 0.0))
                placement = joint.placement * motion * placement
        return placement.act(point)
