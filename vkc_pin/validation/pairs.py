"""Lists the pairs of shapes that could collide along a motion, with their required clearances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.validation.contact_windows import Window
from vkc_pin.validation.distances import CollisionShapes, PlacedShapes
from vkc_pin.validation.samples import Samples
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["PairTable"]

_MOTION_TOLERANCE = 1e-9  # [m] or [rad]


class PairTable:
    """All pairs of a motion: indices of `world.shapes` and required clearances [m], shape (P,).

    Args:
        scene: Scene of the motion.
        solids: The shapes of the scene as one plain tree.
        trajectory: The motion.
        dist_safe: Required clearance at the waypoints [m].
        self_distance: Required clearance between links of the robot [m]. Default: `dist_safe`.
        windows: Pairs that may be closer, with their intervals.
        samples: Samples of the motion, if they exist already.
    """

    def __init__(
        self,
        scene: Scene,
        solids: CollisionShapes,
        trajectory: Trajectory,
        dist_safe: float,
        self_distance: float | None = None,
        *,
        windows: Sequence[Window] = (),
        samples: Samples | None = None,
    ) -> None:
        self.scene, self.world, self.solids = scene, solids.world, solids
        world, own_margin = self.world, dist_safe if self_distance is None else self_distance
        samples, lasts = (
            Samples(scene, trajectory) if samples is None else samples,
            [phase.last for phase in trajectory.phases],
        )
        self._moves = np.array(
            [
                self._find_moving_shapes(samples.z[samples.get_rows(phase)])
                for phase in trajectory.phases
            ]
        )
        self._phase = np.searchsorted(lasts, np.arange(len(trajectory.times)))  # the earlier of two
        labels, bodies = world.collision_labels, range(solids.body_count)
        owners = [label.partition(".")[0] if "." in label else "" for label in labels]
        robots = len(scene.robot.collision.geometryObjects)
        self.groups = [
            "robot" if i < robots else name if name in scene.objects else ""
            for i, name in enumerate(owners)
        ]
        self._robot_pairs = {
            frozenset(pair): own for pair, own in scene.robot.own_margins(own_margin).items()
        }
        self._ever_moves: Bools = np.asarray(self._moves.any(axis=0))
        own = np.array(
            [(i, j) for j in bodies for i in range(j) if self._can_collide(i, j)], int
        ).reshape(-1, 2)
        self.pairs = np.concatenate([own, self._pair_with_obstacles()])
        if not len(self.pairs):
            raise InputError(
                "no pair of geometries can collide", field="scene", expected="collision geometry"
            )
        self.margins = np.full(len(self.pairs), float(dist_safe))
        self.margins[: len(own)] = [
            self._robot_pairs.get(frozenset(pair), dist_safe) for pair in own.tolist()
        ]
        self._windows = _WindowIndex(windows, self.pairs)

    def _find_moving_shapes(self, rows: Floats) -> Bools:
        """Return which shapes move in a sequence of configurations, shape (G,)."""
        world = self.world
        moved = world.coordinates.find_moved_joints(np.ptp(rows, axis=0) > _MOTION_TOLERANCE)
        for joint in range(1, len(moved)):
            moved[joint] |= moved[world.model.parents[joint]]
        robots = len(self.scene.robot.collision.geometryObjects)
        return np.array(
            [i < robots or moved[shape.parentJoint] for i, shape in enumerate(world.shapes)]
        )

    def get_margins(self, pairs: Ints, waypoints: Ints) -> Floats:
        """Return the required clearances of pairs at waypoints, shape (n,) each [m]; -inf: none."""
        margins, (k, which) = self.margins[pairs], self._windows.find(pairs, waypoints, waypoints)
        np.minimum.at(margins, k, self._windows.margin[which])
        return margins

    def get_contact_overlaps(self, pairs: Ints, first: Ints, last: Ints) -> Floats:
        """Return the overlaps that count as contact from `first` to `last`, shape (n,) each [m]."""
        overlap, (k, which) = np.zeros(len(pairs)), self._windows.find(pairs, first, last)
        np.maximum.at(overlap, k, self._windows.contact[which])
        return overlap

    def find_exempt(self, pairs: Ints, waypoints: Ints) -> Bools:
        """Return which pairs the scene exempts from clearance at waypoints, shape (n,) each."""
        exempt, (k, which) = (
            np.zeros(len(pairs), bool),
            self._windows.find(pairs, waypoints, waypoints),
        )
        exempt[k[self._windows.is_exempt[which]]] = True
        return exempt

    def find_moving_together(self, pairs: Ints, first: Ints, last: Ints) -> Bools:
        """Return which pairs move rigidly together from `first` to `last`, shape (n,) each."""
        as_one, (k, which) = np.zeros(len(pairs), bool), self._windows.find(pairs, first, last)
        as_one[k[self._windows.moves_together[which]]] = True
        return as_one

    def _can_collide(self, i: int, j: int) -> bool:
        """Return whether bodies i < j (robot first, then objects) can collide."""
        a, b = self.groups[i], self.groups[j]
        if a == "robot" and b == "robot":
            return frozenset((i, j)) in self._robot_pairs
        if a == "robot":
            return True
        if a == b:  # self-collision of an object
            links = frozenset(self.world.collision_labels[k].partition(".")[2] for k in (i, j))
            return links in self.scene.objects[a].object.own_pairs
        return bool(self._ever_moves[i] or self._ever_moves[j])

    def _pair_with_obstacles(self) -> Ints:
        """Return the pairs of moving bodies with obstacles, shape (n, 2), by obstacle."""
        bodies, labels = range(self.solids.body_count), self.world.collision_labels
        joints = [self.world.shapes[i].parentJoint for i in bodies]
        moving = [i for i in bodies if self._ever_moves[i]]
        # Wheels touch the floor, and mounted objects may.
        free = {name for name, placed in self.scene.objects.items() if placed.object.free}
        above = [
            i
            for i in moving
            if self.groups[i] in free or (self.groups[i] == "robot" and joints[i] > 1)
        ]
        obstacles = range(self.solids.body_count, len(labels))
        found = [np.zeros((0, 2), int)]
        for floor, ones in ((False, moving), (True, above)):
            others = [j for j in obstacles if (labels[j] == FLOOR) == floor]
            found.append(
                np.column_stack(
                    [np.tile(np.array(ones, int), len(others)), np.repeat(others, len(ones))]
                )
            )
        return np.concatenate(found).astype(int)

    def find_close_pairs(
        self, placed: PlacedShapes, first: Ints, last: Ints, moved: Floats, limit: float
    ) -> tuple[Ints, Ints]:
        """Find intervals and pairs that may come closer than `limit` [m], shape (n,) each.

        Pairs whose boxes prove a larger distance are left out, and so are pairs of shapes that do
        not move. The intervals are from waypoint `first` to `last`, shape (K,); `moved` is the
        largest displacement of each shape in them, shape (K, G) [m].
        """
        return placed.boxes.find_close_pairs(
            first,
            last,
            self.pairs,
            moved=moved,
            moves=self._moves,
            phases=self._phase[last],
            limit=limit,
        )


class _WindowIndex:
    """An index of windows for vectorized queries, with their properties as arrays."""

    def __init__(self, windows: Sequence[Window], pairs: Ints) -> None:
        most = max((int(window.pairs.max()) for window in windows if len(window.pairs)), default=0)
        base = np.array([max(most, int(pairs.max())) + 1, 1])
        numbers, rows = pairs @ base, [np.zeros((0, 2), int)]  # a unique number for each pair
        order = np.argsort(numbers)
        for w, window in enumerate(windows):
            wanted = window.pairs @ base
            at = order[np.minimum(np.searchsorted(numbers, wanted, sorter=order), len(order) - 1)]
            rows.append(np.column_stack([at, np.full(len(at), w)])[numbers[at] == wanted])
        found = np.concatenate(rows)
        of_pair, self._which = found[np.lexsort((found[:, 1], found[:, 0]))].T
        self._count = np.bincount(of_pair, minlength=len(pairs))
        self._begin = np.cumsum(self._count) - self._count
        self._first, self._last = (
            np.array([getattr(window, end) for window in windows], int) for end in ("first", "last")
        )
        self.margin, self.contact = (
            np.array([getattr(w, name) for w in windows], float) for name in ("margin", "contact")
        )
        self.moves_together, self.is_exempt = (
            np.array([getattr(w, name) for w in windows], bool)
            for name in ("moves_together", "is_exempt")
        )

    def find(self, pairs: Ints, first: Ints, last: Ints) -> tuple[Ints, Ints]:
        """Return (k, window) for all windows of pair k that cover waypoints `first` to `last`."""
        some = np.flatnonzero(self._count[pairs])
        count = self._count[pairs[some]]
        k, place = (
            np.repeat(some, count),
            np.repeat(self._begin[pairs[some]] - np.cumsum(count) + count, count),
        )
        which = self._which[place + np.arange(len(k))]
        holds = (self._first[which] <= first[k]) & (last[k] <= self._last[which])
        return k[holds], which[holds]
