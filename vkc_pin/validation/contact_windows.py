"""Finds the pairs that may be close along a motion, and when, and checks gripper and pushes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
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
from vkc_pin.world.trajectory.phase_span import PhaseSpan

# accepted shortfall of a rest [s]
_DWELL_TOLERANCE = 1e-6
# [m] or [rad]
_MOTION_TOLERANCE = 1e-9
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
    *,
    obstacles_only: bool = False,
) -> list[Window]:
    """Find all pairs of a motion that may be close, and when, by the scene's contact rules.

    Args:
        samples: Sampled motion.
        solids: Shapes of robot, objects and obstacles.
        steps: Steps of the motion.
        options: Clearances to keep.
        tolerances: Accepted errors of goals.
        obstacles_only: Whether windows that hold for no obstacle are left out.
    """
    finder = _WindowFinder(samples, solids, options, tolerances)
    if obstacles_only:
        return list(finder.find_obstacle_windows(steps, obstacles_only=True))
    return list(finder.find(steps))


def check_gripper(samples: Samples, options: Options) -> Iterator[Violation]:
    """Yield rests that are too short for the gripper, and wrong gripper openings.

    Before and during a grasp the gripper must have the opening of the attachment.
    """
    before = set(samples.scene.holds)
    for number, phase in enumerate(samples.trajectory.phases):
        holds = set(phase.holds)
        yield from _check_rest(samples, number, before ^ holds, options.grasp_time)
        yield from _check_opening(samples, number)
        before = holds


def _check_rest(
    samples: Samples, number: int, changed: set[Hold], required: float
) -> Iterator[Violation]:
    """Check that the robot rests where a phase changes holds or the gripper's opening."""
    motion = samples.trajectory
    times = motion.times
    size = motion.robot_size
    phase = motion.phases[number]
    is_opening_changed = number > 0 and phase.opening != motion.phases[number - 1].opening
    if not (changed or is_opening_changed):
        return
    at = phase.first
    here = motion.positions[at, :size]
    low, high = (side[:, :size] for side in samples.ranges)
    distances = np.maximum(high - here, here - low).max(axis=1)
    moving = np.flatnonzero(distances > MOTION_TOLERANCE)  # segments that leave this position
    after = int(np.searchsorted(moving, at))
    if is_opening_changed:
        begin = at  # fingers start to move here
    elif after > 0:
        begin = int(moving[after - 1]) + 1
    else:
        begin = 0
    end = moving[after] if after < len(moving) else len(times) - 1
    rest = float(times[end] - times[begin])
    if not rest >= required - _DWELL_TOLERANCE:
        subject = ", ".join(sorted(str(hold) for hold in changed)) or "gripper"
        detail = f"the robot rests for {rest:.2f} s, {required:g} s are required"
        yield samples.make_violation("dwell", subject, required - rest, "s", detail, waypoint=at)


def _check_opening(samples: Samples, number: int) -> Iterator[Violation]:
    """Check the opening of the gripper in a phase."""
    gripper = samples.scene.robot.gripper
    phases = samples.trajectory.phases
    phase = phases[number]
    hold = find_gripper_hold(phase.holds)
    if hold is None and number + 1 < len(phases):
        hold = find_gripper_hold(phases[number + 1].holds)
    if gripper is None or hold is None:
        return
    opening = phase.opening
    if opening is None:
        opening = gripper.rest_opening
    required = compute_grasp_opening(samples.scene, hold)
    if required is None:
        required = gripper.rest_opening
    difference = abs(opening - required)
    if not difference <= WIDTH_TOLERANCE:
        detail = f"the gripper is {1e3 * opening:.1f} mm open, {1e3 * required:.1f} mm are required"
        yield samples.make_violation(
            "opening", str(hold), difference, "m", detail, waypoint=phase.first
        )


def check_pushes(samples: Samples) -> Iterator[Violation]:
    """Yield pushes in which the pushed link follows the hand backwards, which it could not do.

    The link's point at the contact must move into the face or rest.
    """
    for phase in samples.trajectory.phases:
        for hold in phase.holds:
            attachment = get_attachment(samples.scene.objects, hold)
            if attachment.contact != "push":
                continue
            travel = _compute_travel(samples, phase, hold)
            back = np.maximum.accumulate(travel) - travel
            worst = int(np.argmax(back))
            if not back[worst] <= CONTACT_DEPTH:
                detail = f"goes back by {1e3 * back[worst]:.2f} mm where the hand only pushes"
                yield samples.make_violation(
                    "push",
                    str(hold),
                    back[worst] - CONTACT_DEPTH,
                    "m",
                    detail,
                    row=int(samples.get_rows(phase)[worst]),
                )


def _compute_travel(samples: Samples, phase: PhaseSpan, hold: Hold) -> list[float]:
    """Compute how far a pushed link has moved into its face at each sample of a phase [m].

    Between two samples the point of the link at the contact p moves to L₁ L₀⁻¹ p, where L₀ and L₁
    are the link's placements. The travel adds the part of this motion along z of the attachment's
    frame, which points into the face.
    """
    robot = samples.scene.robot
    attachment = get_attachment(samples.scene.objects, hold)
    rows = samples.get_rows(phase)
    hands = samples.compute_placements(rows, robot.tool_frame)
    links = samples.compute_placements(rows, f"{hold.object}.{attachment.link}")
    # the foremost point of the hand, in the tool's frame
    foremost = compute_hand_frame(robot, attachment) * attachment.offset.inverse()
    travel = [0.0]
    for hand, link, link_after in zip(hands, links, links[1:], strict=False):
        contact = (hand * foremost).translation
        contact_after = link_after.act(link.actInv(contact))
        into = (link * attachment.placement).rotation[:, 2]
        travel.append(travel[-1] + float(into @ (contact_after - contact)))
    return travel


class _WindowFinder:
    """Finds the windows of a motion by kind of contact."""

    def __init__(
        self, samples: Samples, solids: CollisionShapes, options: Options, tolerances: Tolerances
    ) -> None:
        self.tolerances = tolerances
        self.samples = samples
        self.solids = solids
        self.options = options
        self.scene = solids.world.scene
        self.trajectory = samples.trajectory
        self.labels = np.array(solids.world.collision_labels)
        self.z = samples.z[samples.waypoint_rows]
        self.q = samples.world.coordinates.q(self.z)
        low, high = samples.ranges
        # Freedoms of later grasps may change at rest.
        columns = [name not in samples.grasp_freedoms for name in self.trajectory.names]
        self.is_moving = (high - low)[:, columns].max(axis=1) > _MOTION_TOLERANCE  # by segment
        self.last_waypoint = len(self.is_moving)
        self.robot_size = len(self.scene.robot.collision.geometryObjects)
        self.supports = samples.free_objects.supports

    def find(self, steps: Sequence[Step]) -> Iterator[Window]:
        yield from self.find_obstacle_windows(steps)
        holds = [set(phase.holds) for phase in self.trajectory.phases]
        for hold, first, last in self._find_spans([set(self.scene.holds), *holds]):
            yield from self._find_hold_windows(hold, first, last)
        yield from self._find_grasp_windows([step for step in steps if isinstance(step, Grasp)])
        yield from self._find_support_windows()

    def find_obstacle_windows(
        self, steps: Sequence[Step], *, obstacles_only: bool = False
    ) -> Iterator[Window]:
        """Yield the windows of those kinds of contact that obstacles may have, too."""
        exempt_pairs = find_exempt_pairs(
            self.scene, self.solids, self.options.dist_safe, obstacles_only=obstacles_only
        )
        for exempt in exempt_pairs:
            yield from self._find_exemption_windows(exempt)
        yield from self._find_free_object_windows()
        yield from self._find_touch_windows([step for step in steps if isinstance(step, Touch)])

    def _find_exemption_windows(self, exempt: ExemptPairs) -> Iterator[Window]:
        """Yield windows of exempt pairs: always, or while their joint ranges hold."""
        if not len(exempt.pairs):
            return
        contact = CONTACT_DEPTH + max(0.0, -exempt.margin)
        moves_together = exempt.margin == -np.inf
        is_active = exempt.are_active(self.z)
        changes = np.flatnonzero(np.diff(is_active, prepend=False, append=False))
        for begin, end in changes.reshape(-1, 2).tolist():
            yield Window(
                exempt.pairs,
                begin,
                end - 1,
                exempt.margin,
                contact,
                moves_together,
                is_exempt=True,
            )

    def _find_hold_windows(
        self, hold: Hold, first: int | None, last: int | None
    ) -> Iterator[Window]:
        """Yield windows of a hold from waypoint `first` to `last` (None: start, end)."""
        begin = 0 if first is None else first
        end = self.last_waypoint if last is None else last
        extended_begin = begin if first is None else self._extend(begin, -1)
        extended_end = end if last is None else self._extend(end, 1)
        yield from self._find_hand_windows(hold, extended_begin, extended_end)
        link = find_grasped_link(self.scene, hold)
        is_rigid = is_rigid_grasp(self.scene, hold)
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
                clearance = compute_hand_clearance(self.scene, hold, link, self.options)
                by_clearance.setdefault(clearance, set()).add(link)
        for clearance, links in by_clearance.items():
            pairs = self._pair_links(find_touch_links(self.scene, hold), links)
            contact = 0.0 if clearance > 0.0 else CONTACT_DEPTH - clearance
            yield Window(pairs, first, last, clearance, contact)

    def _find_grasp_windows(self, steps: Sequence[Grasp]) -> Iterator[Window]:
        """Yield windows around phase ends at which the hand is at a grasp, held or not."""
        ends = np.array([phase.last for phase in self.trajectory.phases])
        rows = self.samples.waypoint_rows[ends]
        limits = (self.tolerances.goal_position, self.tolerances.goal_angle)
        for step in steps:
            attachments = self.scene.objects[step.object].object.attachments
            names = list(attachments) if step.attachment is None else [step.attachment]
            for name in names:
                hold = make_hold(self.scene, step, name)
                errors = self.samples.compute_grasp_errors(hold, rows)
                is_at_grasp = (errors <= limits).all(axis=1)
                for at in ends[is_at_grasp].tolist():
                    first = self._extend(at, -1)
                    last = self._extend(at, 1)
                    yield from self._find_hand_windows(hold, first, last)

    def _find_free_object_windows(self) -> Iterator[Window]:
        """Yield windows of free objects with their neighbours where these are lifted and put down.

        Objects come in the order in which they begin to move.
        """
        spans = list(self._find_spans(self._list_carried_objects()))
        spans.sort(key=lambda span: -1 if span[1] is None else span[1])
        moved = set[str]()
        for owner, first, last in spans:
            begin = first or 0
            is_new = owner not in moved
            yield from self._find_carry_windows(owner, begin, self._extend(begin, 1), new=is_new)
            if last is not None:
                before = self._extend(last, -1)
                yield from self._find_carry_windows(owner, last, before, begin=False)
            moved.add(owner)

    def _find_support_windows(self) -> Iterator[Window]:
        """Yield windows of objects that move with their support, and of those on the same one."""
        for phase, supports in zip(self.trajectory.phases, self.supports, strict=True):
            for owner, support in supports.items():
                on_support = {other for other, label in supports.items() if label == support}
                on_support.remove(owner)
                shapes: list[int] = []
                for k, label in enumerate(self.labels):
                    if label == support or label.partition(".")[0] in on_support:
                        shapes.append(k)
                pairs = self._make_pairs(self._get_shapes(owner), shapes)
                yield Window(pairs, phase.first, phase.last, -np.inf, moves_together=True)

    def _find_carry_windows(
        self, owner: str, at: int, other: int, *, begin: bool = True, new: bool = False
    ) -> Iterator[Window]:
        """Yield windows of a free object with its neighbours where carrying begins or ends.

        It begins or ends at waypoint `at`; `other` is the other end of the window. An object that
        has not moved before (`new`) may penetrate its neighbours as deep as it did.
        """
        safe = self.options.dist_safe
        mine = self._get_shapes(owner)
        others = [k for k in range(self.robot_size, len(self.labels)) if k not in mine]
        pairs = self._make_pairs(mine, others)
        placed = self.solids.place(self.q[[at]])
        here = np.zeros(len(pairs), int)
        pairs = pairs[placed.compute_lower_bounds(here, pairs) < safe]
        distances = placed.compute_distances(here[: len(pairs)], pairs)
        first, last = (at, other) if begin else (other, at)
        yield Window(pairs[distances < safe], first, last, 0.0)
        if not new:
            return
        for k in np.flatnonzero(distances < -CONTACT_DEPTH).tolist():
            distance = float(distances[k])
            yield Window(pairs[[k]], first, last, distance, CONTACT_DEPTH - distance)

    def _find_touch_windows(self, steps: Sequence[Touch]) -> Iterator[Window]:
        """Yield windows around touches with the shapes at their targets."""
        ends = [phase.last for phase in self.trajectory.phases]
        rows = self.samples.waypoint_rows[ends]
        safe = self.options.dist_safe
        for step in steps:
            goal = step.target
            target = goal.translation if isinstance(goal, pin.SE3) else np.array(goal)
            frames = self.samples.compute_placements(rows, step.frame)
            links = _find_touching_links(self.scene, step.frame)
            mine = [k for k, label in enumerate(self.labels) if label in links]
            own = self._get_shapes(step.frame.partition(".")[0])
            for at, frame in zip(ends, frames, strict=True):
                if not np.linalg.norm(frame.translation - target) <= safe:
                    continue
                near = self.solids.place(self.q[[at]]).find_shapes_near(target, safe)
                others = [k for k in near if k >= self.robot_size and k not in own]
                pairs = self._make_pairs(mine, others)
                yield Window(pairs, self._extend(at, -1), self._extend(at, 1), 0.0)

    def _list_carried_objects(self) -> list[set[str]]:
        """Return the grasped or supported free objects at the start and in every phase."""
        free = {name for name, placed in self.scene.objects.items() if placed.object.free}
        carried = [free & self.scene.held.keys()]
        for phase, supports in zip(self.trajectory.phases, self.supports, strict=True):
            carried.append(free & (phase.held.keys() | supports.keys()))
        return carried

    def _find_spans(
        self, phases: Sequence[Collection[_T]]
    ) -> Iterator[tuple[_T, int | None, int | None]]:
        """Yield items with the first and last waypoint of their presence; None: start, end.

        `phases` are the items that are present at the start, and in every phase.
        """
        spans = self.trajectory.phases
        begun: dict[_T, int | None] = {}
        for number, present in enumerate(phases):
            at = spans[number - 1].first if number else None
            ended = [item for item in begun if item not in present]
            for item in ended:
                yield item, begun.pop(item), at
            for item in present:
                begun.setdefault(item, at)
        for item, first in begun.items():
            yield item, first, None

    def _pair_links(self, ones: Collection[str], others: Collection[str]) -> Ints:
        """Return all pairs of a shape of some links with a shape of other links."""
        first = [k for k, label in enumerate(self.labels) if label in ones]
        second = [k for k, label in enumerate(self.labels) if label in others]
        return self._make_pairs(first, second)

    def _get_shapes(self, owner: str) -> list[int]:
        """Return the shapes of an object."""
        owners = [label.partition(".")[0] for label in self.labels[: self.solids.body_count]]
        return [k for k, name in enumerate(owners) if name == owner]

    def _make_pairs(self, ones: Sequence[int], others: Sequence[int]) -> Ints:
        """Return all pairs of two lists of shapes, the smaller index first, shape (n, 2)."""
        first = np.repeat(np.array(ones, int), len(others))
        second = np.tile(np.array(others, int), len(ones))
        return np.column_stack([np.minimum(first, second), np.maximum(first, second)])

    def _extend(self, at: int, direction: int) -> int:
        """Return the last (1) or first (−1) exempt waypoint of a contact; see `CONTACT_WINDOW`.

        The window ends where it is both longer than `CONTACT_WINDOW` and has more moving segments
        than the planner uses for that time.
        """
        times = self.trajectory.times
        max_time = CONTACT_WINDOW + _MOTION_TOLERANCE
        max_moving = self.options.steps(CONTACT_WINDOW)
        moving = 0  # segments in the window that move
        end = at
        after = end + direction
        while 0 <= after < len(times):
            moving += int(self.is_moving[min(end, after)])
            if abs(times[after] - times[at]) > max_time and moving > max_moving:
                break
            end = after
            after = end + direction
        return end


def _find_touching_links(scene: Scene, frame: str) -> set[str]:
    """Return the labels of the links to which the frame of a `Touch` is fixed."""
    if frame.partition(".")[0] in scene.objects:
        return {frame}
    robot = scene.robot
    joint = robot.model.frames[robot.model.getFrameId(frame)].parentJoint
    shapes = enumerate(robot.collision.geometryObjects)
    return {robot.link_of(i) for i, shape in shapes if shape.parentJoint == joint}
