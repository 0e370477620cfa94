"""Where a user's own constraints and costs hold in a task, and where the frames are that they are about."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.planning.chain.chain import VirtualKinematicChain
from vkc_pin.planning.chain.pose import target_vector
from vkc_pin.planning.nlp.term_rows import FrameAt, TermAt, TermRow, Tree, Value
from vkc_pin.planning.nlp.transcription import Transcription
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task, stretches
from vkc_pin.world.task.terms import Cost, Term

__all__ = ["TermNumbers", "term_goals"]

_SLOWER, _SLOWEST = (
    1.2,
    8.0,
)  # factor by which steps are made longer at a time, and in all, until a seed is slow enough
_SMALL = 1e-3  # what an excess as large as the tolerance counts as, among residuals of poses


def term_goals(
    scene: Scene, chain: VirtualKinematicChain, task: Task, terms: Sequence[Term]
) -> tuple[tuple[TermRow, ...], tuple[Term, ...]]:
    """Return what the program has of terms, and the terms that this is: those that can change something in this task.

    Args:
        scene: Where objects stand.
        chain: The chain.
        task: What is held when.
        terms: Traced terms.
    """
    whereabouts = _Whereabouts(scene, chain, task)
    rows, kept = [], []
    for term in terms:
        formula, at = term.formula, []
        values = tuple(whereabouts.value(name) for name in formula.coordinates)
        for number, (name, held) in enumerate(stretches(task)):
            if not term.active(name, held):
                continue
            for waypoint in range(whereabouts.starts[number] + 1, whereabouts.ends[number] + 1):
                earlier = (
                    number if waypoint - 1 > whereabouts.starts[number] else max(number - 1, 0)
                )
                now = tuple(
                    whereabouts.frame_at(frame, number, waypoint) for frame in formula.frames
                )
                before = tuple(
                    whereabouts.frame_at(frame, earlier, waypoint - 1) for frame in formula.frames
                )
                at.append(TermAt(waypoint, now, before))
        row = TermRow(formula, term.weight if isinstance(term, Cost) else None, values, tuple(at))
        at = [
            item for item in at if any(waypoint > 0 for waypoint in row.kind(item)[0])
        ]  # others nothing can change
        if at:
            rows.append(TermRow(formula, row.weight, values, tuple(at)))
            kept.append(term)
    return tuple(rows), tuple(kept)


class _Whereabouts:
    """Where frames are in a task.

    Attributes:
        starts, ends: First and last waypoint of every phase.
    """

    def __init__(self, scene: Scene, chain: VirtualKinematicChain, task: Task) -> None:
        self.scene, self.chain, self.phases = scene, chain, task.phases
        self.ends = [int(end) for end in np.cumsum([phase.segments for phase in task.phases])]
        self.starts = [0, *self.ends[:-1]]

    def value(self, name: str) -> Value:
        """Return what a coordinate of the scene is in the program."""
        if name in self.chain.names:
            return Value(self.chain.index(name))
        owner, _, joint = name.partition(".")
        placed = self.scene.objects[owner]
        return Value(None, float(placed.state[placed.object.coordinates.index(joint)]))

    def frame_at(self, frame: str, number: int, waypoint: int) -> FrameAt:
        """Return where a frame is at a waypoint of phase `number`."""
        owner, dot, link = frame.partition(".")
        if not dot or owner not in self.scene.objects:
            return self._on_chain(
                self.chain.frame(frame, opening=self.phases[number].opening), waypoint
            )
        placed, phase = self.scene.objects[owner], self.phases[number]
        item = placed.object
        if (
            not item.free
        ):  # the same whether it is held or not; where it is held, the chain is closed
            found = item.model.frames[item.model.getFrameId(link, pin.FrameType.BODY)]
            values = tuple(self.value(f"{owner}.{name}") for name in item.coordinates.names)
            tree = Tree(item.model.saveToString(), _numbers(placed.placement), values)
            moves = found.parentJoint > 0 and any(value.column is not None for value in values)
            return FrameAt(
                _numbers(found.placement), found.parentJoint, waypoint if moves else -1, tree
            )
        hold = next((hold for hold in phase.held if hold.object == owner), None)
        if hold is not None:
            return self._on_chain(self.chain.frame(link, hold), waypoint)
        if owner in phase.left:  # where the hand let go of it
            hold, last = phase.left[owner]
            return self._on_chain(self.chain.frame(link, hold), self.ends[last])
        stands = phase.standing.get(owner, placed.placement)
        return FrameAt(_numbers(stands * item.link_placement(link, placed.state)))

    def _on_chain(self, at: tuple[int, pin.SE3], waypoint: int) -> FrameAt:
        joint, local = at
        return FrameAt(_numbers(local), joint, waypoint if joint else -1)


def _numbers(placement: pin.SE3) -> tuple[float, ...]:
    return tuple(target_vector(placement).tolist())


class TermNumbers:
    """The terms of a program at given waypoints.

    Attributes:
        rows: Which rows of the program they are, shape (R,).
        lower, upper: Their bounds, shape (R,).
        scale: What an excess of 1 counts as, shape (R,).
    """

    def __init__(self, terms: Sequence[Term], transcription: Transcription, start: Floats) -> None:
        self.terms, self.transcription, self.start = terms, transcription, start
        rows, bounds, scales = [np.zeros(0, int)], [np.zeros((0, 2))], [np.zeros(0)]
        timed, names = [np.zeros(0, bool)], []
        for term, at in zip(terms, transcription.term_rows, strict=True):
            if isinstance(term, Cost):
                continue
            for own in at.values():
                rows.append(own)
                bounds.append(np.column_stack(term.box(len(own))))
                scales.append(np.full(len(own), _SMALL / term.tolerance))
                timed.append(np.full(len(own), term.formula.timed))
                names += [term.name] * len(own)
        order = np.argsort(np.concatenate(rows))
        self.rows = np.concatenate(rows)[order]
        self.lower, self.upper = np.concatenate(bounds)[order].T
        self.scale, self._timed = np.concatenate(scales)[order], np.concatenate(timed)[order]
        self._names = [names[k] for k in order]

    def error(self, z: Floats, dt: Floats) -> float:
        """Return by how much constraints are violated at most at z_1..z_N, shape (N, n), 1e-3 being their tolerance."""
        return float(self._excess(z, dt).max(initial=0.0))

    def cost(self, z: Floats, dt: Floats) -> float:
        """Return the weighted sum of all costs."""
        return float(self._evaluated(z, dt)[2]) if self.terms else 0.0

    def slower(self, z: Floats, dt: Floats, runs: Sequence[tuple[int, int]]) -> Floats:
        """Return the time of every step, made longer until z_1..z_N satisfies what depends on it, as far as that helps.

        Args:
            z: Shape (N, n).
            dt: Time of every step so far, shape (N,).
            runs: The stretches, as first and last waypoint, in which all steps take the same time.
        """
        waypoint = np.zeros(len(self.rows), int)
        for at in self.transcription.term_rows:
            for number, own in at.items():
                waypoint[np.searchsorted(self.rows, own)] = number
        for begin, end in runs:
            mine = self._timed & (waypoint > begin) & (waypoint <= end)
            best, least = 1.0, np.inf
            trial, factor = dt.copy(), 1.0
            while mine.any() and factor <= _SLOWEST and least > _SMALL:
                trial[begin:end] = factor * dt[begin:end]
                excess = float(self._excess(z, trial)[mine].max())
                if excess < least * (1.0 - 1e-3):
                    best, least = factor, excess
                factor *= _SLOWER
            dt = np.concatenate([dt[:begin], best * dt[begin:end], dt[end:]])
        return dt

    def check(self, z: Floats, dt: Floats) -> None:
        """Check that values and slopes exist at z_1..z_N.

        Raises:
            InputError: They do not.
        """
        if not self.terms:
            return
        values, jacobian, cost, gradient = self._evaluated(z, dt)
        row, entries = (
            np.array(jacobian.sparsity().get_triplet()[0], int),
            np.array(jacobian.nonzeros(), float),
        )
        wrong = ~np.isfinite(values)
        wrong[row[~np.isfinite(entries)]] = True
        names = {name for name, bad in zip(self._names, wrong, strict=True) if bad}
        if not (np.isfinite(cost) and np.isfinite(gradient).all()):
            names |= {term.name for term in self.terms if isinstance(term, Cost)}
        if names:
            name = min(names)
            expected = "a smooth expression, e.g. cos(a) >= 0.98 instead of a <= 0.2, or squares instead of roots"
            raise InputError(
                "it has no value or no slope at the start",
                field=f"terms[{name!r}].expression",
                expected=expected,
            )

    def _excess(self, z: Floats, dt: Floats) -> Floats:
        if not len(self.rows):
            return np.zeros(0)
        values = self._evaluated(z, dt)[0]
        excess = np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0) * self.scale
        return np.where(np.isnan(excess), np.inf, excess)

    def _evaluated(self, z: Floats, dt: Floats) -> tuple[Floats, Any, float, Any]:
        x = self.transcription.pack(z)
        values, jacobian, cost, gradient = self.transcription.term_values(x, self.start, dt)
        return np.asarray(values).ravel(), jacobian, float(cost), np.asarray(gradient.nonzeros())
