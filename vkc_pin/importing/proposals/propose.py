"""Proposes attachments for an object at its bars, knobs and edges, checked with a robot's hand."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

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
_HELD = 0.005
# Distance [m] and cosine of the angle (60°) below which two grasps are similar
_NEAR, _SIMILAR = 0.06, 0.5
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
_TILT, _TILT_ROOM = 0.4, 0.005  # [rad] rotation about the contact, and the standoff that it takes
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
    found = search.assign_names(sorted(search.propose(), key=lambda proposal: -proposal.score))
    opened = {joint for proposal in found for joint in proposal.opens}
    closed = [opening for opening in search.openings.values() if opening.joint not in opened]
    names = [opening.joint for opening in closed]
    because = {opening.joint: search.explain_failure(opening, names) for opening in closed}
    numbers = {opening.joint: number for number, opening in search.openings.items()}
    rejected = {joint: tuple(search.tallies[numbers[joint]].places) for joint in because}
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
        self.item, self.robot, self.hand, self.most = item, robot, make_hand(robot), most
        self.safe, self.close = dist_safe, grasp_clearance
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

        Joints that can be opened while all others are closed come first. Parts in the way of other
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
        for number, proposals in found.items():
            if not proposals:
                self.tallies[number] = closed_tallies[number]
        return [proposal for proposals in found.values() for proposal in proposals]

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
        for number in [number for number, proposals in found.items() if not proposals]:
            when = self._find_conditions(number, found)
            if when != tried[number]:
                is_new = True
                tried[number] = when
                found[number] = self._propose_in_state(number, when)
                self.blockers[number] |= self._find_blockers(number)
        return is_new

    def _find_blockers(self, number: int) -> set[int]:
        """Return the joints that move links in the way of the hand, without the joint's own."""
        supports = self.item.model.supports
        links = {
            blocked.link for blocked in self.tallies[number].blocked if blocked.what == "others"
        }
        above = {k for link in links for k in supports[self._find_joint(link)]}
        own = {k for k in self.openings if number in supports[k]} | set(supports[number])
        return above - own - {0}

    def _find_conditions(
        self, number: int, found: Mapping[int, list[Proposal]]
    ) -> dict[str, float]:
        """Return positions of joints that are to be opened before, in this order.

        These are the joints in the way that a hand opens, and those that must be open for it.
        """
        own = {self.openings[k].joint for k in self.item.model.supports[number] if k}
        conditions = dict[str, float]()
        for blocker in sorted(self.blockers[number]):
            opening = self.openings[blocker]
            ways = [
                proposal
                for proposals in found.values()
                for proposal in proposals
                if opening.joint in proposal.opens
            ]
            if ways:
                best = max(ways, key=lambda way: abs(way.opens[opening.joint] - opening.closed))
                before = {**best.when, opening.joint: best.opens[opening.joint]}
                if own.isdisjoint(before):
                    conditions |= before
        return conditions

    def _propose_pushes(self, number: int) -> list[Proposal]:
        """Return pushes for a joint whose links offer no grasp, best first; at most two."""
        opening, hand = self.openings[number], self.hand
        if self._is_latched(number):
            return []
        self.fitting.place(self.closed)
        at = self.fitting.joint(number).copy()
        pushes = [
            push
            for piece in self.pieces.get(number, ())
            for push in find_pushes(piece, at, opening, hand.width)
        ]
        found, taken = list[Proposal](), list[Floats]()
        for push in sorted(pushes, key=lambda push: -push.quality)[:_PUSHED]:
            where = push.placement.translation
            if any(np.linalg.norm(where - other) < _APART for other in taken):
                continue
            link, opened = push.piece.link, self._follow_push(push, opening)
            share = abs(opened - opening.closed) / max(abs(opening.opened - opening.closed), 1e-9)
            if share <= _LITTLE:
                continue
            placement = self.item.model.frames[self.item.link_frame(link)].placement.inverse()
            slide = Freedom("_slide", "prismatic", _CLOSING, *push.slide)
            turn = Freedom("_turn", "revolute", _CLOSING, -_TILT, _TILT)
            attachment = Attachment(
                name=link,
                link=link,
                placement=placement * push.placement,
                joint="listed",
                freedoms=(slide, turn) if push.slide[0] < push.slide[1] else (turn,),
                standoff=_TILT_ROOM,
                contact="push",
            )
            score = _PUSH * push.quality * min(share, 1.0)
            found.append(Proposal(attachment, "push", False, 0.0, score, {opening.joint: opened}))
            taken.append(where)
        return sorted(found, key=lambda proposal: -proposal.score)[: min(2, self.most)]

    def _is_latched(self, number: int) -> bool:
        """Return whether a latch holds a closed joint, and no joint below it releases the latch."""
        opening, model = self.openings[number], self.item.model
        path = {str(model.names[k]) for k in model.supports[number]}
        return any(
            latch.joint == opening.joint
            and latch.is_engaged(opening.closed)
            and latch.released_by not in path
            for latch in self.item.latches
        )

    def _follow_push(self, push: Push, opening: Opening) -> float:
        """Return how far a hand pushes a joint open, [rad] or [m], before it is obstructed."""
        ahead = _retreat(self.hand.tip + self.close + _TILT_ROOM)
        link, reached = push.piece.link, opening.closed
        for value in np.linspace(opening.closed, opening.opened, _PUSH_STEPS + 1).tolist():
            state = self.closed.copy()
            state[opening.coordinate] = value
            self.fitting.place(state)
            tool = self.fitting.joint(opening.number) * push.placement * ahead
            blocked = self.fitting.find_obstruction(tool, link)
            if blocked or (value == opening.closed and self._check_retreat(tool, link)):
                break
            reached = value
        self.fitting.place(self.closed)
        return float(reached)

    def _find_joint(self, link: str) -> int:
        return int(self.item.model.frames[self.item.link_frame(link)].parentJoint)

    def _propose_in_state(self, number: int, when: dict[str, float]) -> list[Proposal]:
        """Return the proposals for a joint with other joints at positions `when`."""
        tally = self.tallies[number] = _Tally(pieces=len(self.pieces.get(number, ())))
        state = self.closed.copy()
        for joint, value in when.items():
            state[self.item.coordinates.index(joint)] = value
        self.fitting.place(state)
        at, opening = self.fitting.joint(number).copy(), self.openings[number]
        ranked = [
            (score_grasp(grasp, at * grasp.placement, opening, named=named), grasp, named)
            for piece in self.pieces.get(number, ())
            for named in (self._handles.get(piece.name, False),)
            for grasp in find_candidates(
                piece, self.hand, self.close, at.rotation[2], tally.thickness
            )
        ]
        ranked.sort(key=lambda entry: -entry[0])  # stable, hence in file order for equal scores
        kept = list[tuple[Proposal, Candidate]]()
        for best, grasp, named in ranked[:_TRIED]:
            ranks = _rank(kept)
            if len(kept) >= self.most and best <= ranks[self.most - 1][0]:
                break
            if any(
                best <= other.score and _are_similar(taken, other, grasp) for other, taken in kept
            ):
                continue
            self.fitting.place(state)
            proposal = self._evaluate(
                best, grasp, opening, tally, named
            ) or self._evaluate_narrower(best, grasp, opening, named, state)
            if proposal is None or any(
                _are_similar(taken, other, grasp) and other.score >= proposal.score
                for other, taken in kept
            ):
                continue
            proposal = dataclasses.replace(proposal, when=when)
            kept = [
                (other, taken) for other, taken in kept if not _are_similar(grasp, proposal, taken)
            ]
            kept = sorted([*kept, (proposal, grasp)], key=lambda entry: -entry[0].score)
        chosen = [proposal for _, proposal in _rank(kept)[: self.most]]
        return [proposal for proposal in chosen if proposal.score >= _WORTH * chosen[0].score]

    def _evaluate_narrower(
        self, best: float, grasp: Candidate, opening: Opening, named: bool, state: Floats
    ) -> Proposal | None:
        """Evaluate a grasp with fingers as close as it allows; None if they cannot be closer."""
        room = _ROUND * float(np.ceil((grasp.thickness + 2.0 * self.close) / _ROUND - 1e-9))
        wide = self.robot.opening(room)
        if wide is None or not room <= wide <= self.hand.opening - _ROUND:
            return None
        if wide not in self.narrower:
            self.narrower[wide] = HandClearance(
                self.item, make_hand(self.robot.opened(wide)), self.safe, self.close
            )
        fully_open, self.fitting = self.fitting, self.narrower[wide]
        try:
            self.fitting.place(state)
            found = self._evaluate(best, grasp, opening, _Tally(), named)
        finally:
            self.fitting = fully_open
        return found and dataclasses.replace(
            found, attachment=dataclasses.replace(found.attachment, opening=wide)
        )

    def _evaluate(
        self, best: float, grasp: Candidate, opening: Opening, tally: _Tally, named: bool
    ) -> Proposal | None:
        """Evaluate a grasp with the hand placed there."""
        link, at = grasp.piece.link, self.fitting.joint(opening.number)
        furthest = max(0.0, self.fitting.hand.tip - _HELD) if grasp.kind != "edge" else 0.0
        reasons = list[Obstruction]()
        for standoff in dict.fromkeys((0.0, furthest / 2.0, furthest)):
            tool = at * grasp.placement * _retreat(standoff)
            blocked = self.fitting.find_obstruction(tool, link) or self._check_retreat(tool, link)
            if blocked is None:
                break
            reasons.append(blocked)
        else:
            tally.blocked[reasons[0]] += 1
            tally.places.append(at * grasp.placement)
            return None
        room = next(
            (
                room
                for room in _ROOM
                if self.fitting.find_obstruction(tool, link, extra_clearance=room) is None
            ),
            0.0,
        )
        grip, opens = GraspMotion(self.fitting, grasp, standoff), dict[str, float]()
        for joint in self.item.model.supports[opening.number]:
            if joint:
                joint_opening = self.openings[joint]
                reached = grip.follow(joint_opening)
                if abs(reached - joint_opening.closed) > _LITTLE * abs(
                    joint_opening.opened - joint_opening.closed
                ):
                    opens[joint_opening.joint] = reached
        if opening.joint not in opens:
            tally.cramped += 1
            tally.places.append(at * grasp.placement)
            return None
        kind, freedom = grip.freedoms()
        share = abs(opens[opening.joint] - opening.closed) / max(
            abs(opening.opened - opening.closed), 1e-9
        )
        score = (
            best
            * min(share, 1.0)
            * (0.5 + 0.5 * min(grip.slack / _SLACK, 1.0))
            * (0.7 + 0.3 * room / _ROOM[0])
        )
        if self.fitting.is_hidden(tool):
            score *= _HIDDEN
        score *= 1.0 - 0.2 * standoff / max(furthest, 1e-9) if standoff else 1.0
        frame = self.item.model.frames[self.item.link_frame(link)]
        placement = frame.placement.inverse() * grasp.placement
        return Proposal(
            Attachment(
                name=link,
                link=link,
                placement=placement,
                joint=kind,
                freedoms=freedom,
                standoff=standoff,
            ),
            grasp.kind,
            named,
            grasp.thickness,
            score,
            opens,
        )

    def _check_retreat(self, tool: pin.SE3, link: str) -> Obstruction | None:
        """Return what obstructs a hand that retreats straight, if anything."""
        for joint_opening in np.arange(_STEP, _RETREAT + _STEP / 2.0, _STEP):
            if (
                blocked := self.fitting.find_obstruction(tool * _retreat(joint_opening), link)
            ) is not None:
                return blocked
        return None

    def assign_names(self, found: Iterable[Proposal]) -> list[Proposal]:
        """Return the proposals with names that are distinct from each other and from joints."""
        taken, out = set(self.item.coordinates.names), list[Proposal]()
        for proposal in found:
            stem, number = f"{proposal.attachment.link}_{proposal.kind}", 1
            while not taken.isdisjoint(
                names := {
                    (name := stem if number == 1 else f"{stem}_{number}"),
                    f"{name}_slide",
                    f"{name}_turn",
                }
            ):
                number += 1
            taken |= names
            out.append(
                dataclasses.replace(
                    proposal, attachment=dataclasses.replace(proposal.attachment, name=name)
                )
            )
        return out

    def explain_failure(self, opening: Opening, closed: Collection[str]) -> str:
        """Return the reason why no link that a joint moves directly offers a grasp.

        Args:
            opening: Opening motion of the joint.
            closed: All joints that no hand can open.
        """
        tally, hand = self.tallies[opening.number], self.hand
        counts, rejected = tally.thickness, tally.blocked.most_common()
        if not tally.pieces:
            return "the link that it moves has no shape"
        if opening.opened == opening.closed:
            return "its limits leave it no travel"
        fits = counts.tried - counts.too_thick
        if not fits:
            thinnest = (
                f", it is {1e3 * counts.thinnest:.0f} mm at its thinnest"
                if np.isfinite(counts.thinnest)
                else ""
            )
            clear = 1e3 * self.close
            between = (
                f"the fingers, {1e3 * hand.opening:.0f} mm apart, with {clear:.0f} mm on both sides"
            )
            return f"nothing of it fits between {between}{thinnest}"
        reasons = []
        for blocked, count in rejected[:3]:
            least = 1e3 * (self.close if blocked.what == "fingers" else self.safe)
            near = (
                "place the hand below the object's support"
                if blocked.what == "floor"
                else f"are not {least:.0f} mm from {blocked.link}"
            )
            reasons.append(f"{count} {near}")
        if tally.cramped:
            reasons.append(
                f"{tally.cramped} let it open by less than a tenth before the hand collides"
            )
        text = f"of {min(fits, _TRIED)} places that are thin enough, " + ", ".join(reasons)
        blockers = [self.openings[k].joint for k in sorted(self.blockers[opening.number])]
        shut = [joint for joint in blockers if joint in closed]
        if shut:
            text += f"; no hand can open {' or '.join(shut)} before, which is in the way"
        return text


def _retreat(joint_opening: float) -> pin.SE3:
    """Return the motion by a distance [m] against the direction of approach."""
    return pin.SE3(np.eye(3), np.array([0.0, 0.0, -joint_opening]))


def _rank(kept: list[tuple[Proposal, Candidate]]) -> list[tuple[float, Proposal]]:
    """Return proposals with their ranks, best first."""
    ranked, better = list[tuple[float, Proposal]](), list[tuple[Proposal, Candidate]]()
    for proposal, grasp in kept:
        count = sum(_are_similar(taken, other, grasp, turned=True) for other, taken in better)
        ranked.append((proposal.score * _TURNED**count, proposal))
        better.append((proposal, grasp))
    return sorted(ranked, key=lambda entry: -entry[0])


def _are_similar(
    taken: Candidate, proposal: Proposal, other: Candidate, *, turned: bool = False
) -> bool:
    """Return whether a grasp is similar to a proposed one."""
    first, second = taken.placement, other.placement
    if first.rotation[:, 2] @ second.rotation[:, 2] < _SIMILAR:
        return False
    if not turned and abs(first.rotation[:, 1] @ second.rotation[:, 1]) < _SIMILAR:
        return False
    offset = first.rotation.T @ (second.translation - first.translation)
    slide = next((item for item in proposal.attachment.freedoms if item.kind == "prismatic"), None)
    low, high = (slide.lower, slide.upper) if slide else (0.0, 0.0)
    offset[1] -= min(max(offset[1], low), high)
    return bool(np.linalg.norm(offset) < _NEAR)
