"""Finds the pairs that may be close along a motion, and when, and checks gripper and pushes."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.utils.arrays import Ints
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.goals import MOTION_TOLERANCE, make_hold
from vkc_pin.validation.neighbours import ExemptPairs, find_exempt_pairs
from vkc_pin.validation.report import Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.models.gripper import WIDTH_TOLERANCE
from vkc_pin.world.scene.clearance_exemptions import CONTACT_DEPTH
from vkc_pin.world.scene.contact_rules import (
    CONTACT_WINDOW,
    compute_grasp_opening,
    compute_hand_clearance,
    compute_hand_frame,
    find_grasped_link,
    find_gripper_hold,
    find_touch_links,
    is_rigid_grasp,
)
from vkc_pin.world.scene.hold import Hold, get_attachment
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Grasp, Step, Touch

_DWELL_TOLERANCE = 1e-6  # accepted shortfall of a rest [s]

_MOTION_TOLERANCE = 1e-9  # [m] or [rad]
_T = TypeVar("_T")


class Window(NamedTuple):
    """An interval in which pairs may be closer than the usual clearance.

    Attributes:
        pairs: Pairs of indices of the world's shapes, the smaller index first, shape (k, 2).
        first, last: First and last waypoint of the interval.
        margin: Required clearance [m]; -inf if the distance is not checked.
        contact: Overlap that counts as contact [m].
        moves_together: Whether the pairs move rigidly together and need no checks between samples.
        is_exempt: Whether the scene exempts the pairs, rather than an action of the hand.
    """

    pairs: Ints
    first: int
    last: int
    margin: float
    contact: float = CONTACT_DEPTH
    moves_together: bool = False
    is_exempt: bool = False


def find_contact_windows(
    samples: Samples,
    solids: CollisionShapes,
    steps: Sequence[Step],
    options: Options,
    tolerances: Tolerances,
) -> list[Window]:
    """Find all pairs of a motion that may be close, and when, by the scene's contact rules."""
    return list(_WindowFinder(samples, solids, options, tolerances).find(steps))


def check_gripper(samples: Samples, options: Options) -> Iterator[Violation]:
    """Yield rests that are too short for the gripper, and wrong gripper openings.

    Before and during a grasp the gripper must have the opening of the attachment.
    """
    before = set(samples.scene.holds)
    for number, phase in enumerate(samples.trajectory.phases):
        changed, before = before ^ set(phase.holds), set(phase.holds)
        yield from _check_rest(samples, number, changed, options.grasp_time)
        yield from _check_opening(samples, number)


def _check_rest(
    samples: Samples, number: int, changed: set[Hold], required: float
) -> Iterator[Violation]:
    """Check that the robot rests where a phase changes holds or the gripper's opening."""
    motion, size = samples.trajectory, samples.trajectory.robot_size
    phase, times = motion.phases[number], motion.times
    opens = number > 0 and phase.opening != motion.phases[number - 1].opening
    if not (changed or opens):
        return
    (low, high), at = (side[:, :size] for side in samples.ranges), phase.first
    here = motion.positions[at, :size]
    moves = np.flatnonzero(np.maximum(high - here, here - low).max(axis=1) > MOTION_TOLERANCE)
    k = int(np.searchsorted(moves, at))
    begin = at if opens else moves[k - 1] + 1 if k else 0  # fingers start to move here
    end = moves[k] if k < len(moves) else len(times) - 1
    rest = float(times[end] - times[begin])
    if not rest >= required - _DWELL_TOLERANCE:
        subject = ", ".join(sorted(map(str, changed))) or "gripper"
        detail = f"the robot rests for {rest:.2f} s, {required:g} s are required"
        yield samples.make_violation("dwell", subject, required - rest, "s", detail, waypoint=at)


def _check_opening(samples: Samples, number: int) -> Iterator[Violation]:
    """Check the opening of the gripper in a phase."""
    gripper, phases = samples.scene.robot.gripper, samples.trajectory.phases
    phase, after = phases[number], phases[number + 1 : number + 2]
    hold = find_gripper_hold(phase.holds) or find_gripper_hold(after[0].holds if after else ())
    if gripper is None or hold is None:
        return
    wide, right = (
        gripper.rest_opening if opening is None else opening
        for opening in (phase.opening, compute_grasp_opening(samples.scene, hold))
    )
    if not abs(wide - right) <= WIDTH_TOLERANCE:
        detail = f"the gripper is {1e3 * wide:.1f} mm open, {1e3 * right:.1f} mm are required"
        yield samples.make_violation(
            "opening", str(hold), abs(wide - right), "m", detail, waypoint=phase.first
        )


def check_pushes(samples: Samples) -> Iterator[Violation]:
    """Yield pushes in which the pushed link follows the hand backwards, which it could not do.

    The link's point at the contact must move into the face or rest.
    """
    scene, tool = samples.scene, samples.scene.robot.tool_frame
    for phase in samples.trajectory.phases:
        for hold in phase.holds:
            attachment = get_attachment(scene.objects, hold)
            if attachment.contact != "push":
                continue
            rows = samples.get_rows(phase)
            hands = samples.compute_placements(rows, tool)
            links = samples.compute_placements(rows, f"{hold.object}.{attachment.link}")
            foremost = compute_hand_frame(scene.robot, attachment) * attachment.offset.inverse()
            travel = [0.0]
            for hand, link, after in zip(hands, links, links[1:], strict=False):
                contact = (hand * foremost).translation
                into = (link * attachment.placement).rotation[:, 2]
                travel.append(
                    travel[-1] + float(into @ (after.act(link.actInv(contact)) - contact))
                )
            back = np.maximum.accumulate(travel) - travel
            worst = int(np.argmax(back))
            if not back[worst] <= CONTACT_DEPTH:
                amount, row = back[worst] - CONTACT_DEPTH, int(rows[worst])
                detail = f"goes back by {1e3 * back[worst]:.2f} mm where the hand only pushes"
                yield samples.make_violation("push", str(hold), amount, "m", detail, row=row)


class _WindowFinder:
    def __init__(
        self, samples: Samples, solids: CollisionShapes, options: Options, tolerances: Tolerances
    ) -> None:
        self.tolerances = tolerances
        self.samples, self.solids, self.options = samples, solids, options
        self.scene, self.trajectory, world = samples.scene, samples.trajectory, samples.world
        self.labels = np.array(world.collision_labels)
        self.q = world.coordinates.q(samples.z[samples.waypoint_rows])
        low, high = samples.ranges
        # Freedoms of later grasps may change at rest.
        columns = [name not in samples.grasp_freedoms for name in self.trajectory.names]
        self.steps = (high - low)[:, columns].max(axis=1) > _MOTION_TOLERANCE
        self.robots = len(self.scene.robot.collision.geometryObjects)
        self.supports = samples.free_objects.supports

    def find(self, steps: Sequence[Step]) -> Iterator[Window]:
        for one in find_exempt_pairs(self.scene, self.solids, self.options.dist_safe):
            yield from self._find_exemption_windows(one)
        holds = [set(phase.holds) for phase in self.trajectory.phases]
        for hold, first, last in self._find_spans([set(self.scene.holds), *holds]):
            yield from self._find_hold_windows(hold, first, last)
        yield from self._find_grasp_windows([step for step in steps if isinstance(step, Grasp)])
        moved = set[str]()
        for owner, first, last in sorted(
            self._find_spans(self._list_carried_objects()),
            key=lambda run: -1 if run[1] is None else run[1],
        ):
            begin, is_new = first or 0, owner not in moved
            yield from self._find_carry_windows(owner, begin, self._extend(begin, 1), new=is_new)
            if last is not None:
                yield from self._find_carry_windows(
                    owner, last, self._extend(last, -1), begin=False
                )
            moved.add(owner)
        for phase, riding in zip(self.trajectory.phases, self.supports, strict=True):
            for owner, label in riding.items():
                others = {other for other, on in riding.items() if on == label and other != owner}
                mates = [
                    k
                    for k, one in enumerate(self.labels)
                    if one == label or one.partition(".")[0] in others
                ]
                pairs = self._make_pairs(self._get_shapes(owner), mates)
                yield Window(pairs, phase.first, phase.last, -np.inf, moves_together=True)
        yield from self._find_touch_windows([step for step in steps if isinstance(step, Touch)])

    def _find_exemption_windows(self, one: ExemptPairs) -> Iterator[Window]:
        """Yield windows of exempt pairs: always, or while their joint ranges hold."""
        count = len(self.steps) + 1
        holds = one.are_active(self.samples.z[self.samples.waypoint_rows])
        contact, together = CONTACT_DEPTH + max(0.0, -one.margin), one.margin == -np.inf
        for begin, end in (
            np.flatnonzero(np.diff(holds, prepend=False, append=False)).reshape(-1, 2).tolist()
        ):
            if len(one.pairs):
                last = min(end, count) - 1
                yield Window(one.pairs, begin, last, one.margin, contact, together, is_exempt=True)

    def _find_hold_windows(
        self, hold: Hold, first: int | None, last: int | None
    ) -> Iterator[Window]:
        """Yield windows of a hold from waypoint `first` to `last` (None: start, end)."""
        begin, end = 0 if first is None else first, len(self.steps) if last is None else last
        since = begin if first is None else self._extend(begin, -1)
        until = end if last is None else self._extend(end, 1)
        yield from self._find_hand_windows(hold, since, until)
        link, is_rigid = find_grasped_link(self.scene, hold), is_rigid_grasp(self.scene, hold)
        clearance = compute_hand_clearance(self.scene, hold, link, self.options)
        pairs = self._pair_links(find_touch_links(self.scene, hold), {link})
        margin = min(clearance, 0.0) if is_rigid else clearance
        contact = CONTACT_DEPTH + max(0.0, -margin)
        yield Window(pairs, begin, end, margin, contact, moves_together=is_rigid)

    def _find_hand_windows(self, hold: Hold, first: int, last: int) -> Iterator[Window]:
        """Yield windows of the grasping links with all links of the object."""
        by_clearance: dict[float, set[str]] = {}
        for link in self.labels.tolist():
            if link.startswith(f"{hold.object}."):
                least = compute_hand_clearance(self.scene, hold, link, self.options)
                by_clearance.setdefault(least, set()).add(link)
        for least, links in by_clearance.items():
            pairs = self._pair_links(find_touch_links(self.scene, hold), links)
            contact = 0.0 if least > 0.0 else CONTACT_DEPTH - least
            yield Window(pairs, first, last, least, contact)

    def _find_grasp_windows(self, steps: Sequence[Grasp]) -> Iterator[Window]:
        """Yield windows around phase ends at which the hand is at a grasp, held or not."""
        ends = np.array([phase.last for phase in self.trajectory.phases])
        for step in steps:
            attachments = self.scene.objects[step.object].object.attachments
            limits = (self.tolerances.goal_position, self.tolerances.goal_angle)
            for name in attachments if step.attachment is None else [step.attachment]:
                hold = make_hold(self.scene, step, name)
                errors = self.samples.compute_grasp_errors(hold, self.samples.waypoint_rows[ends])
                for at in ends[(errors <= limits).all(axis=1)].tolist():
                    yield from self._find_hand_windows(
                        hold, self._extend(at, -1), self._extend(at, 1)
                    )

    def _find_carry_windows(
        self, owner: str, at: int, other: int, *, begin: bool = True, new: bool = False
    ) -> Iterator[Window]:
        """Yield windows of a free object with its neighbours where carrying begins or ends.

        It begins or ends at waypoint `at`; `other` is the other end of the window. An object that
        has not moved before (`new`) may penetrate its neighbours as deep as it did.
        """
        mine = self._get_shapes(owner)
        others = [k for k in range(self.robots, len(self.labels)) if k not in mine]
        pairs = self._make_pairs(mine, others)
        placed, here = self.solids.place(self.q[[at]]), np.zeros(len(pairs), int)
        pairs = pairs[placed.compute_lower_bounds(here, pairs) < self.options.dist_safe]
        distances = placed.compute_distances(here[: len(pairs)], pairs)
        first, last = (at, other) if begin else (other, at)
        yield Window(pairs[distances < self.options.dist_safe], first, last, 0.0)
        for k in np.flatnonzero(distances < -CONTACT_DEPTH).tolist() if new else ():
            depth = float(distances[k])
            yield Window(pairs[[k]], first, last, depth, CONTACT_DEPTH - depth)

    def _find_touch_windows(self, steps: Sequence[Touch]) -> Iterator[Window]:
        """Yield windows around touches with the shapes at their targets."""
        ends, safe = [phase.last for phase in self.trajectory.phases], self.options.dist_safe
        for step in steps:
            goal = step.target
            target = goal.translation if isinstance(goal, pin.SE3) else np.array(goal)
            frames = self.samples.compute_placements(self.samples.waypoint_rows[ends], step.frame)
            links = _find_touching_links(self.scene, step.frame)
            mine = [k for k, label in enumerate(self.labels) if label in links]
            own = self._get_shapes(step.frame.partition(".")[0])
            for at, frame in zip(ends, frames, strict=True):
                if np.linalg.norm(frame.translation - target) <= safe:
                    near = self.solids.place(self.q[[at]]).find_shapes_near(target, safe)
                    others = [k for k in near if k >= self.robots and k not in own]
                    pairs = self._make_pairs(mine, others)
                    yield Window(pairs, self._extend(at, -1), self._extend(at, 1), 0.0)

    def _list_carried_objects(self) -> list[set[str]]:
        """Return the grasped or supported free objects at the start and in every phase."""
        free = {name for name, placed in self.scene.objects.items() if placed.object.free}
        phases = zip(self.trajectory.phases, self.supports, strict=True)
        return [
            free & self.scene.held.keys(),
            *(free & (phase.held.keys() | riding.keys()) for phase, riding in phases),
        ]

    def _find_spans(
        self, phases: Sequence[Collection[_T]]
    ) -> Iterator[tuple[_T, int | None, int | None]]:
        """Yield items with the first and last waypoint of their presence; None: start, end.

        `phases` are the items that are present at the start, and in every phase.
        """
        spans, begun = self.trajectory.phases, dict[_T, int | None]()
        for number, now in enumerate(phases):
            at = spans[number - 1].first if number else None
            for item in [item for item in begun if item not in now]:
                yield item, begun.pop(item), at
            for item in now:
                begun.setdefault(item, at)
        yield from ((item, first, None) for item, first in begun.items())

    def _pair_links(self, ones: Collection[str], others: Collection[str]) -> Ints:
        first, second = (
            [k for k, label in enumerate(self.labels) if label in links] for links in (ones, others)
        )
        return self._make_pairs(first, second)

    def _get_shapes(self, owner: str) -> list[int]:
        return [
            k
            for k, label in enumerate(self.labels)
            if label.partition(".")[0] == owner and k < self.solids.body_count
        ]

    def _make_pairs(self, ones: Iterable[int], others: Collection[int]) -> Ints:
        return np.array([(min(i, j), max(i, j)) for i in ones for j in others], int).reshape(-1, 2)

    def _extend(self, at: int, direction: int) -> int:
        """Return the last (1) or first (−1) exempt waypoint of a contact; see `CONTACT_WINDOW`."""
        times, moved, end = self.trajectory.times, 0, at
        longest, most = CONTACT_WINDOW + _MOTION_TOLERANCE, self.options.steps(CONTACT_WINDOW)
        while 0 <= (after := end + direction) < len(times):
            moved += int(self.steps[min(end, after)])
            if abs(times[after] - times[at]) > longest and moved > most:
                break
            end = after
        return end


def _find_touching_links(scene: Scene, frame: str) -> set[str]:
    """Return the labels of the links to which the frame of a `Touch` is fixed."""
    if frame.partition(".")[0] in scene.objects:
        return {frame}
    robot = scene.robot
    joint = robot.model.frames[robot.model.getFrameId(frame)].parentJoint
    return {
        robot.link_of(i)
        for i, shape in enumerate(robot.collision.geometryObjects)
        if shape.parentJoint == joint
    }
