"""Proposes attachments for an object at its bars, knobs and edges, checked with a robot's hand."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.candidates import Candidate, Piece, Thickness, find_candidates
from vkc_pin.importing.proposals.fitting import (
    GraspMotion,
    HandClearance,
    Obstruction,
    Opening,
    find_named_handles,
    find_openings,
    score_grasp,
)
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.importing.proposals.proposal import Proposal, Proposals
from vkc_pin.importing.proposals.pushing import Push, find_pushes
from vkc_pin.utils.arguments import check_instance, check_integer, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.models.articulated_object import ArticulatedObject, Attachment, Freedom
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot

_TRIED = 600  # grasps of one body that are checked with the hand, the best by geometry
_RETREAT = 0.25  # [m] straight path along which a hand must be able to retreat
_STEP = 0.015  # [m] step of that path
# [m] by which a fingertip grasp must extend beyond the centre of the grasped part
_OVERLAP = 0.005
# Two grasps are similar if they are near each other and turned by less than 60°.
_NEAR = 0.06  # [m]
_SIMILAR = 0.5  # cosine of this angle
# Factor for the rank of a grasp that differs from a better one by a rotation about the approach:
# what one of them cannot reach, the other mostly cannot reach either.
_TURNED = 0.5
_ROOM = (0.02, 0.01)  # [m] extra clearances that increase the score
_SLACK = 0.05  # [m] slide to either side above which the score does not increase further
_HIDDEN = 0.4  # factor for places at which the object blocks a straight forearm
_WORTH = 0.1  # smallest score, relative to the best grasp of a joint
_ROUND = 0.01  # [m] openings are multiples of this, and smaller than fully open by at least this
_PUSHED = 60  # places on faces that are checked with the hand
_PUSH = 0.3  # factor for the score of a push, which cannot pull the joint back
_APART = 0.25  # [m] smallest distance of two pushes of a joint, which slide along the face
_PUSH_STEPS = 8  # positions of the joint at which the clearance of a push is checked
_TILT = 0.4  # [rad] rotation of the hand about the contact of a push
_TILT_ROOM = 0.005  # [m] standoff that this rotation takes
_CLOSING = np.array([1.0, 0.0, 0.0])  # along which both fingers touch a face
_LITTLE = 0.1  # smallest travel of a joint, relative to its range, that counts as opening it


@dataclass
class _Tally:
    """Counts of rejected grasps of one body."""

    thickness: Thickness = field(default_factory=Thickness)
    blocked: Counter[Obstruction] = field(default_factory=Counter)
    cramped: int = 0
    pieces: int = 0
    places: list[pin.SE3] = field(default_factory=list)  # of the tool, in the base frame


class _Kept(NamedTuple):
    """A proposal and its grasp."""

    proposal: Proposal
    grasp: Candidate


def propose_attachments(
    item: ArticulatedObject,
    robot: str | Robot = "husky_ur5e",
    *,
    dist_safe: float = 0.02,
    grasp_clearance: float = 0.005,
    most: int = 3,
) -> Proposals:
    """Propose attachments of an object for a robot's hand.

    Every convex piece of a moving link is cut into cross-sections. Where its thickness fits between
    the open fingers, and their pads meet faces off which they do not slip, there is a bar, a knob
    or an edge. The open hand is placed there, and retreats straight, among all shapes of the closed
    object; then it follows the joint as it opens. Where fully open fingers have no clearance, a
    gripper's fingers are tried closer together; the attachment then has this `opening`. Joints
    whose links offer no grasp, such as sliding doors without a handle, get pushes on their faces.

    Args:
        item: The object, standing upright on its lowest point.
        robot: The robot with the hand: a name, a file, or a robot.
        dist_safe: Clearance between hand and object, as in `Options` [m].
        grasp_clearance: Clearance between the touch links and the grasped link [m].
        most: Largest number of proposals for one joint.

    Returns:
        The attachments, best first, and the reason why a joint has none.

    Raises:
        InputError: The robot has no touch links, they leave no room at its tool frame, or an
            argument is invalid.
        UnknownNameError: The robot is unknown.
    """
    check_instance(item, ArticulatedObject, "object")
    check_integer(most, "most", low=1, high=100)
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    for name, value in (("dist_safe", dist_safe), ("grasp_clearance", grasp_clearance)):
        check_number(value, name, "a distance [m]", low=0.0, high=1.0)
    search = _Search(item, robot, dist_safe, grasp_clearance, most)
    best_first = sorted(search.propose(), key=lambda proposal: -proposal.score)
    found = search.assign_names(best_first)
    opened = set[str]()
    for proposal in found:
        opened.update(proposal.opens)
    failed = [opening for opening in search.openings.values() if opening.joint not in opened]
    names = [opening.joint for opening in failed]
    because = {opening.joint: search.explain_failure(opening, names) for opening in failed}
    rejected = {opening.joint: tuple(search.tallies[opening.number].places) for opening in failed}
    return Proposals(item, search.hand, tuple(found), because, rejected)


class _Search:
    def __init__(
        self,
        item: ArticulatedObject,
        robot: Robot,
        dist_safe: float,
        grasp_clearance: float,
        most: int,
    ) -> None:
        self.item = item
        self.robot = robot
        self.hand = make_hand(robot)
        self.most = most
        self.safe = dist_safe
        self.close = grasp_clearance
        self.pieces: dict[int, list[Piece]] = {}
        for shape in item.collision.geometryObjects:
            self.pieces.setdefault(int(shape.parentJoint), []).append(Piece.from_shape(shape))
        self.openings = find_openings(item, self.pieces)
        self.fitting = HandClearance(item, self.hand, dist_safe, grasp_clearance)
        self.narrower: dict[float, HandClearance] = {}
        self.closed = self.fitting.state.copy()
        self.tallies: dict[int, _Tally] = {}
        self.blockers: dict[int, set[int]] = {}
        self._handles = {} if item.urdf is None else find_named_handles(read_urdf(item.urdf).root)

    def propose(self) -> list[Proposal]:
        """Return the proposals for all joints.

        Joints that can be opened while all others are closed come first. Parts that block other
        joints are then opened as far as a hand opens them. Where this ends, a push may go on.
        """
        found = {number: self._propose_in_state(number, {}) for number in self.openings}
        closed_tallies = dict(self.tallies)
        self.blockers = {number: self._find_blockers(number) for number in found}
        tried = {number: dict[str, float]() for number in found}
        stuck = [number for number, proposals in found.items() if not proposals]
        while stuck:
            if not self._open_after_others(found, tried):
                number = stuck.pop(0)
                found[number] = found[number] or self._propose_pushes(number)
        all_proposals = list[Proposal]()
        for number, proposals in found.items():
            all_proposals += proposals
            if not proposals:
                self.tallies[number] = closed_tallies[number]
        return all_proposals

    def _open_after_others(
        self, found: dict[int, list[Proposal]], tried: dict[int, dict[str, float]]
    ) -> bool:
        """Propose grasps of joints that have none, with other joints open as `found` can open them.

        Args:
            found: Proposals by joint number, which are updated.
            tried: Conditions under which each joint was tried last, which are updated.

        Returns:
            Whether the conditions of a joint differ from those tried last.
        """
        is_new = False
        for number in found:
            if found[number]:
                continue
            when = self._find_conditions(number, found)
            if when != tried[number]:
                is_new = True
                tried[number] = when
                found[number] = self._propose_in_state(number, when)
                self.blockers[number] |= self._find_blockers(number)
        return is_new

    def _find_blockers(self, number: int) -> set[int]:
        """Return the joints that move links which block the hand, without the joint's own."""
        supports = self.item.model.supports
        above = set[int]()
        for obstruction in self.tallies[number].blocked:
            if obstruction.what == "others":
                above.update(supports[self._find_joint(obstruction.link)])
        own = {k for k in self.openings if number in supports[k]}
        own.update(supports[number])
        # Joint 0 is the world.
        return above - own - {0}

    def _find_conditions(
        self, number: int, found: Mapping[int, list[Proposal]]
    ) -> dict[str, float]:
        """Return positions of joints that are to be opened before, in this order.

        These are the blocking joints that a hand opens, and those that must be open for it.
        """
        own = {self.openings[k].joint for k in self.item.model.supports[number] if k}
        conditions = dict[str, float]()
        for blocker in sorted(self.blockers[number]):
            opening = self.openings[blocker]
            best = _find_widest(opening, found)
            if best is None:
                continue
            before = {**best.when, opening.joint: best.opens[opening.joint]}
            if own.isdisjoint(before):
                conditions |= before
        return conditions

    def _propose_pushes(self, number: int) -> list[Proposal]:
        """Return pushes for a joint whose links offer no grasp, best first; at most two."""
        if self._is_latched(number):
            return []
        opening = self.openings[number]
        self.fitting.place(self.closed)
        at = self.fitting.joint(number).copy()
        pushes = list[Push]()
        for piece in self.pieces.get(number, ()):
            pushes += find_pushes(piece, at, opening, self.hand.width)
        pushes.sort(key=lambda push: -push.quality)
        found = list[Proposal]()
        taken = list[Floats]()
        for push in pushes[:_PUSHED]:
            where = push.placement.translation
            if any(np.linalg.norm(where - other) < _APART for other in taken):
                continue
            opened = self._follow_push(push, opening)
            share = _compute_share(opening, opened)
            if share <= _LITTLE:
                continue
            found.append(
                Proposal(
                    attachment=self._make_push(push),
                    kind="push",
                    named=False,
                    thickness=0.0,
                    score=_PUSH * push.quality * min(share, 1.0),
                    opens={opening.joint: opened},
                )
            )
            taken.append(where)
        found.sort(key=lambda proposal: -proposal.score)
        return found[: min(2, self.most)]

    def _make_push(self, push: Push) -> Attachment:
        """Return the attachment of a push; see `assign_names` for its name."""
        link = push.piece.link
        frame = self.item.model.frames[self.item.link_frame(link)]
        low, high = push.slide
        slide = Freedom("_slide", "prismatic", _CLOSING, low, high)
        turn = Freedom("_turn", "revolute", _CLOSING, -_TILT, _TILT)
        return Attachment(
            name=link,
            link=link,
            placement=frame.placement.inverse() * push.placement,
            joint="listed",
            freedoms=(slide, turn) if low < high else (turn,),
            standoff=_TILT_ROOM,
            contact="push",
        )

    def _is_latched(self, number: int) -> bool:
        """Return whether a latch holds a closed joint, and no joint below it releases the latch."""
        opening = self.openings[number]
        model = self.item.model
        path = {str(model.names[k]) for k in model.supports[number]}
        for latch in self.item.latches:
            is_engaged = latch.joint == opening.joint and latch.is_engaged(opening.closed)
            if is_engaged and latch.released_by not in path:
                return True
        return False

    def _follow_push(self, push: Push, opening: Opening) -> float:
        """Return how far a hand pushes a joint open, [rad] or [m], before it is obstructed."""
        ahead = _retreat(self.hand.tip + self.close + _TILT_ROOM)
        link = push.piece.link
        reached = opening.closed
        for value in np.linspace(opening.closed, opening.opened, _PUSH_STEPS + 1).tolist():
            state = self.closed.copy()
            state[opening.coordinate] = value
            self.fitting.place(state)
            tool = self.fitting.joint(opening.number) * push.placement * ahead
            obstruction = self.fitting.find_obstruction(tool, link)
            # The hand arrives at the closed joint.
            if obstruction is None and value == opening.closed:
                obstruction = self._check_retreat(tool, link)
            if obstruction is not None:
                break
            reached = value
        self.fitting.place(self.closed)
        return float(reached)

    def _find_joint(self, link: str) -> int:
        return int(self.item.model.frames[self.item.link_frame(link)].parentJoint)

    def _propose_in_state(self, number: int, when: dict[str, float]) -> list[Proposal]:
        """Return the proposals for a joint with other joints at positions `when`."""
        opening = self.openings[number]
        tally = _Tally(pieces=len(self.pieces.get(number, ())))
        self.tallies[number] = tally
        state = self.closed.copy()
        for joint, value in when.items():
            state[self.item.coordinates.index(joint)] = value
        self.fitting.place(state)
        kept = list[_Kept]()
        for best, grasp, named in self._list_candidates(opening, tally)[:_TRIED]:
            ranks = _rank(kept)
            if len(kept) >= self.most and best <= ranks[self.most - 1][0]:
                break
            if _has_better(kept, grasp, best):
                continue
            self.fitting.place(state)
            proposal = self._evaluate(best, grasp, opening, tally, named)
            if proposal is None:
                proposal = self._evaluate_narrower(best, grasp, opening, named, state)
            if proposal is None or _has_better(kept, grasp, proposal.score):
                continue
            proposal = dataclasses.replace(proposal, when=when)
            kept = [item for item in kept if not _are_similar(grasp, proposal, item.grasp)]
            kept.append(_Kept(proposal, grasp))
            kept.sort(key=lambda item: -item.proposal.score)
        chosen = [proposal for _, proposal in _rank(kept)[: self.most]]
        return [proposal for proposal in chosen if proposal.score >= _WORTH * chosen[0].score]

    def _list_candidates(
        self, opening: Opening, tally: _Tally
    ) -> list[tuple[float, Candidate, bool]]:
        """Return the grasps for a joint with their scores, best first, and whether it has a name.

        Thicknesses are counted in `tally`. Grasps of equal scores are in the order of the file.
        """
        at = self.fitting.joint(opening.number).copy()
        up = at.rotation[2]
        candidates = list[tuple[float, Candidate, bool]]()
        for piece in self.pieces.get(opening.number, ()):
            named = self._handles.get(piece.name, False)
            for grasp in find_candidates(piece, self.hand, self.close, up, tally.thickness):
                score = score_grasp(grasp, at * grasp.placement, opening, named=named)
                candidates.append((score, grasp, named))
        candidates.sort(key=lambda entry: -entry[0])
        return candidates

    def _evaluate_narrower(
        self, best: float, grasp: Candidate, opening: Opening, named: bool, state: Floats
    ) -> Proposal | None:
        """Evaluate a grasp with fingers as close as it allows; None if they cannot be closer."""
        room = _ROUND * float(np.ceil((grasp.thickness + 2.0 * self.close) / _ROUND - 1e-9))
        width = self.robot.opening(room)
        if width is None or not room <= width <= self.hand.opening - _ROUND:
            return None
        if width not in self.narrower:
            hand = make_hand(self.robot.opened(width))
            self.narrower[width] = HandClearance(self.item, hand, self.safe, self.close)
        fully_open = self.fitting
        self.fitting = self.narrower[width]
        try:
            self.fitting.place(state)
            found = self._evaluate(best, grasp, opening, _Tally(), named)
        finally:
            self.fitting = fully_open
        if found is None:
            return None
        attachment = dataclasses.replace(found.attachment, opening=width)
        return dataclasses.replace(found, attachment=attachment)

    def _evaluate(
        self, best: float, grasp: Candidate, opening: Opening, tally: _Tally, named: bool
    ) -> Proposal | None:
        """Evaluate a grasp with the hand placed there.

        Args:
            best: Score by geometry, which clearances can only reduce.
            grasp: The grasp.
            opening: Opening motion of the joint.
            tally: Counts of rejected grasps, which are updated.
            named: Whether the piece is named as a handle.
        """
        link = grasp.piece.link
        at_joint = self.fitting.joint(opening.number)
        furthest = 0.0
        if grasp.kind != "edge":
            furthest = max(0.0, self.fitting.hand.tip - _OVERLAP)
        obstructions = list[Obstruction]()
        for standoff in dict.fromkeys((0.0, furthest / 2.0, furthest)):
            tool = at_joint * grasp.placement * _retreat(standoff)
            obstruction = self.fitting.find_obstruction(tool, link)
            if obstruction is None:
                obstruction = self._check_retreat(tool, link)
            if obstruction is None:
                break
            obstructions.append(obstruction)
        else:
            tally.blocked[obstructions[0]] += 1
            tally.places.append(at_joint * grasp.placement)
            return None
        room = self._find_room(tool, link)
        motion = GraspMotion(self.fitting, grasp, standoff)
        opens = self._follow_joints(motion, opening.number)
        if opening.joint not in opens:
            tally.cramped += 1
            tally.places.append(at_joint * grasp.placement)
            return None
        kind, freedoms = motion.freedoms()
        share = _compute_share(opening, opens[opening.joint])
        score = (
            best
            * min(share, 1.0)
            * (0.5 + 0.5 * min(motion.slack / _SLACK, 1.0))
            * (0.7 + 0.3 * room / _ROOM[0])
        )
        if self.fitting.is_hidden(tool):
            score *= _HIDDEN
        if standoff:
            score *= 1.0 - 0.2 * standoff / max(furthest, 1e-9)
        frame = self.item.model.frames[self.item.link_frame(link)]
        attachment = Attachment(
            name=link,
            link=link,
            placement=frame.placement.inverse() * grasp.placement,
            joint=kind,
            freedoms=freedoms,
            standoff=standoff,
        )
        return Proposal(
            attachment=attachment,
            kind=grasp.kind,
            named=named,
            thickness=grasp.thickness,
            score=score,
            opens=opens,
        )

    def _find_room(self, tool: pin.SE3, link: str) -> float:
        """Return the largest of the extra clearances that a hand at `tool` has [m], or 0."""
        for room in _ROOM:
            if self.fitting.find_obstruction(tool, link, extra_clearance=room) is None:
                return room
        return 0.0

    def _follow_joints(self, motion: GraspMotion, number: int) -> dict[str, float]:
        """Return how far a hand opens a joint and those below it, [rad] or [m], if far enough."""
        opens = dict[str, float]()
        for joint in self.item.model.supports[number]:
            # Joint 0 is the world.
            if joint == 0:
                continue
            opening = self.openings[joint]
            reached = motion.follow(opening)
            least = _LITTLE * abs(opening.opened - opening.closed)
            if abs(reached - opening.closed) > least:
                opens[opening.joint] = reached
        return opens

    def _check_retreat(self, tool: pin.SE3, link: str) -> Obstruction | None:
        """Return what obstructs a hand that retreats straight, if anything."""
        for distance in np.arange(_STEP, _RETREAT + _STEP / 2.0, _STEP):
            obstruction = self.fitting.find_obstruction(tool * _retreat(distance), link)
            if obstruction is not None:
                return obstruction
        return None

    def assign_names(self, found: Iterable[Proposal]) -> list[Proposal]:
        """Return the proposals with names that are distinct from each other and from joints."""
        taken = set(self.item.coordinates.names)
        renamed = list[Proposal]()
        for proposal in found:
            stem = f"{proposal.attachment.link}_{proposal.kind}"
            name = stem
            number = 1
            # Degrees of freedom are called like this.
            while not taken.isdisjoint((name, f"{name}_slide", f"{name}_turn")):
                number += 1
                name = f"{stem}_{number}"
            taken.update((name, f"{name}_slide", f"{name}_turn"))
            attachment = dataclasses.replace(proposal.attachment, name=name)
            renamed.append(dataclasses.replace(proposal, attachment=attachment))
        return renamed

    def explain_failure(self, opening: Opening, closed: Collection[str]) -> str:
        """Return the reason why no link that a joint moves directly offers a grasp.

        Args:
            opening: Opening motion of the joint.
            closed: All joints that no hand can open.
        """
        tally = self.tallies[opening.number]
        if not tally.pieces:
            return "the link that it moves has no shape"
        if opening.opened == opening.closed:
            return "its limits leave it no travel"
        counts = tally.thickness
        fits = counts.tried - counts.too_thick
        if not fits:
            apart = f"{1e3 * self.hand.opening:.0f} mm apart"
            sides = f"with {1e3 * self.close:.0f} mm on both sides"
            text = f"nothing of it fits between the fingers, {apart}, {sides}"
            if np.isfinite(counts.thinnest):
                text += f", it is {1e3 * counts.thinnest:.0f} mm at its thinnest"
            return text
        reasons = list[str]()
        for obstruction, count in tally.blocked.most_common(3):
            least = 1e3 * (self.close if obstruction.what == "fingers" else self.safe)
            near = f"are not {least:.0f} mm from {obstruction.link}"
            if obstruction.what == "floor":
                near = "place the hand below the object's support"
            reasons.append(f"{count} {near}")
        if tally.cramped:
            reasons.append(
                f"{tally.cramped} let it open by less than a tenth before the hand collides"
            )
        text = f"of {min(fits, _TRIED)} places that are thin enough, {', '.join(reasons)}"
        blockers = [self.openings[k].joint for k in sorted(self.blockers[opening.number])]
        shut = [joint for joint in blockers if joint in closed]
        if shut:
            text += f"; no hand can open {' or '.join(shut)} before, which is in the way"
        return text


def _retreat(distance: float) -> pin.SE3:
    """Return the motion by a distance [m] against the direction of approach."""
    return pin.SE3(np.eye(3), np.array([0.0, 0.0, -distance]))


def _compute_share(opening: Opening, reached: float) -> float:
    """Return the part of its range by which a joint is open at a position, [rad] or [m]."""
    return abs(reached - opening.closed) / max(abs(opening.opened - opening.closed), 1e-9)


def _find_widest(opening: Opening, found: Mapping[int, list[Proposal]]) -> Proposal | None:
    """Return the first of the proposals that open a joint furthest, or None if none opens it."""
    widest = None
    furthest = -1.0
    for proposals in found.values():
        for proposal in proposals:
            if opening.joint in proposal.opens:
                travel = abs(proposal.opens[opening.joint] - opening.closed)
                if travel > furthest:
                    widest = proposal
                    furthest = travel
    return widest


def _has_better(kept: Sequence[_Kept], grasp: Candidate, score: float) -> bool:
    """Return whether a similar grasp of at least this score has been kept."""
    for item in kept:
        is_better = item.proposal.score >= score
        if is_better and _are_similar(item.grasp, item.proposal, grasp):
            return True
    return False


def _rank(kept: Sequence[_Kept]) -> list[tuple[float, Proposal]]:
    """Return proposals with their ranks, best first."""
    ranked = list[tuple[float, Proposal]]()
    for number, item in enumerate(kept):
        count = 0
        for better in kept[:number]:
            count += _are_similar(better.grasp, better.proposal, item.grasp, turned=True)
        ranked.append((item.proposal.score * _TURNED**count, item.proposal))
    return sorted(ranked, key=lambda entry: -entry[0])


def _are_similar(
    taken: Candidate, proposal: Proposal, other: Candidate, *, turned: bool = False
) -> bool:
    """Return whether a grasp is similar to a proposed one.

    Args:
        taken: The grasp of the proposal.
        proposal: The proposal, whose hand may slide along the bar.
        other: The other grasp.
        turned: Whether it may be rotated about the approach.
    """
    first = taken.placement
    second = other.placement
    if first.rotation[:, 2] @ second.rotation[:, 2] < _SIMILAR:
        return False
    if not turned and abs(first.rotation[:, 1] @ second.rotation[:, 1]) < _SIMILAR:
        return False
    offset = first.rotation.T @ (second.translation - first.translation)
    low = 0.0
    high = 0.0
    for freedom in proposal.attachment.freedoms:
        if freedom.kind == "prismatic":
            low = freedom.lower
            high = freedom.upper
            break
    offset[1] -= min(max(offset[1], low), high)
    return bool(np.linalg.norm(offset) < _NEAR)
