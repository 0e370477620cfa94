"""Proposes attachments for an object: bars, knobs and edges of its links, tried with a robot's hand."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.candidates import Candidate, Thickness, find_candidates
from vkc_pin.importing.proposals.fitting import Blocked, Fitting
from vkc_pin.importing.proposals.freedom import Grip
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.importing.proposals.proposal import Proposal, Proposals
from vkc_pin.importing.proposals.ranking import (
    Opening,
    find_named_handles,
    find_openings,
    score_grasp,
)
from vkc_pin.importing.proposals.sections import Piece
from vkc_pin.utils.arguments import instance, number, whole
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.models.articulated_object import ArticulatedObject, Attachment
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot

__all__ = ["propose_attachments"]

_TRIED = 600  # of one body, the best ones by geometry: the hand is not put to more
_WAY = 0.25  # [m]: how far a hand must be able to draw back straight
_STEP = 0.015  # [m]: of that way
# [m]: what is in the fingers at least goes so far beyond its middle, if they take it with their
# tips
_HELD = 0.005
_NEAR, _ALIKE = (
    0.06,
    0.5,
)  # [m], cosine: grasps closer together than that, turned by less than 60°, are one
# of the rank of a hand that only is turned about its approach, where a better one is proposed: what
# one
_TURNED = 0.5
# of the two cannot reach, the other mostly cannot either
_ROOM = (0.02, 0.01)  # [m]: more clearance than needed is better, up to this
_SLACK = 0.05  # [m]: to either side; so is more of a bar to hold on to, up to this
_WORTH = 0.1  # of the score of a joint's best grasp: what has less is of no use beside it
_ROUND = 0.01  # [m]: openings are whole multiples, and narrower by as much at least
_LITTLE = 0.1  # of a joint's range: by a grasp that opens less, it cannot be opened


@dataclass
class _Tally:
    """Why places of one body were given up."""

    thickness: Thickness = field(default_factory=Thickness)
    blocked: Counter[Blocked] = field(default_factory=Counter)
    cramped: int = 0
    pieces: int = 0


def propose_attachments(
    item: ArticulatedObject,
    robot: str | Robot = "husky_ur5e",
    *,
    dist_safe: float = 0.02,
    grasp_clearance: float = 0.005,
    most: int = 3,
) -> Proposals:
    """Propose where a robot's hand can take hold of an object.

    Every convex piece of a link that moves is looked at in cross-section. Where its thickness fits
    between the open fingers, and their pads meet faces that they do not slip off from, is a bar, a
    knob or an edge. The hand is put there, fingers open, and drawn back straight, among all shapes
    of the closed object; then it goes along as the joint opens. Where fingers that are fully open
    have no room, those of a gripper that opens are tried closer together; the attachment has that
    `opening` then.

    Args:
        item: The object, standing upright on what its lowest point touches.
        robot: Whose hand; the name of a robot, its file, or a robot.
        dist_safe: What the hand must keep from the object, as in `Options` [m],
        grasp_clearance: but its touch links from the link that they hold [m].
        most: How many are proposed for one joint, at most.

    Returns:
        The attachments, best first, and why a joint has none.

    Raises:
        InputError: The robot's description names no touch links, or they leave no room at its tool
            frame; wrong arguments.
        UnknownNameError: There is no such robot.
    """
    instance(item, ArticulatedObject, "object")
    whole(most, "most", low=1, high=100)
    robot = robot if isinstance(robot, Robot) else load_robot(robot)
    for name, value in (("dist_safe", dist_safe), ("grasp_clearance", grasp_clearance)):
        number(value, name, "a distance [m]", low=0.0, high=1.0)
    search = _Search(item, robot, dist_safe, grasp_clearance, most)
    found = [
        proposal for number in range(1, item.model.njoints) for proposal in search.body(number)
    ]
    found = search.named(sorted(found, key=lambda proposal: -proposal.score))
    because = {
        opening.joint: search.because(opening)
        for opening in search.openings.values()
        if not any(opening.joint in proposal.opens for proposal in found)
    }
    return Proposals(item, search.hand, tuple(found), because)


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
        self.fitting = Fitting(item, self.hand, dist_safe, grasp_clearance)
        self.narrower: dict[float, Fitting] = {}
        self.closed = self.fitting.state.copy()
        self.tallies: dict[int, _Tally] = {}
        self._handles = {} if item.urdf is None else find_named_handles(read_urdf(item.urdf).root)

    def body(self, number: int) -> list[Proposal]:
        """Return the proposals for what joint `number` moves itself, best first.

        If a part that another joint moves is in the way, as the door of a dishwasher is before its
        rack, that one is opened.
        """
        found = self._placed(number, {})
        if not found:
            links = {
                blocked.link for blocked in self.tallies[number].blocked if blocked.what == "others"
            }
            above = {k for link in links for k in self.item.model.supports[self._joint_of(link)]}
            own = {k for k in self.openings if number in self.item.model.supports[k]} | set(
                self.item.model.supports[number]
            )
            others = [self.openings[k] for k in sorted(above - own - {0})]
            if others:
                before = self.tallies[number]
                found = self._placed(number, {other.joint: other.opened for other in others})
                self.tallies[number] = self.tallies[number] if found else before
        return found

    def _joint_of(self, link: str) -> int:
        return int(self.item.model.frames[self.item.link_frame(link)].parentJoint)

    def _placed(self, number: int, when: dict[str, float]) -> list[Proposal]:
        """Return the proposals for what a joint moves itself while others are at some values."""
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
        ranked.sort(
            key=lambda entry: -entry[0]
        )  # stable: the order of the file where they are alike
        kept = list[tuple[Proposal, Candidate]]()
        for best, grasp, named in ranked[:_TRIED]:
            ranks = _ranks(kept)
            if len(kept) >= self.most and best <= ranks[self.most - 1][0]:
                break
            if any(best <= other.score and _alike(taken, other, grasp) for other, taken in kept):
                continue
            self.fitting.place(state)
            proposal = self._tried(best, grasp, opening, tally, named) or self._tried_narrower(
                best, grasp, opening, named, state
            )
            if proposal is None or any(
                _alike(taken, other, grasp) and other.score >= proposal.score
                for other, taken in kept
            ):
                continue
            proposal = dataclasses.replace(proposal, when=when)
            kept = [(other, taken) for other, taken in kept if not _alike(grasp, proposal, taken)]
            kept = sorted([*kept, (proposal, grasp)], key=lambda entry: -entry[0].score)
        chosen = [proposal for _, proposal in _ranks(kept)[: self.most]]
        return [proposal for proposal in chosen if proposal.score >= _WORTH * chosen[0].score]

    def _tried_narrower(
        self, best: float, grasp: Candidate, opening: Opening, named: bool, state: Floats
    ) -> Proposal | None:
        """Return what becomes of a grasp with the fingers no further apart than it takes; None if they do not come closer."""
        room = _ROUND * float(np.ceil((grasp.thickness + 2.0 * self.close) / _ROUND - 1e-9))
        wide = self.robot.opening(room)
        if wide is None or not room <= wide <= self.hand.opening - _ROUND:
            return None
        if wide not in self.narrower:
            self.narrower[wide] = Fitting(
                self.item, make_hand(self.robot.opened(wide)), self.safe, self.close
            )
        open_, self.fitting = self.fitting, self.narrower[wide]
        try:
            self.fitting.place(state)
            found = self._tried(best, grasp, opening, _Tally(), named)
        finally:
            self.fitting = open_
        return found and dataclasses.replace(
            found, attachment=dataclasses.replace(found.attachment, opening=wide)
        )

    def _tried(
        self, best: float, grasp: Candidate, opening: Opening, tally: _Tally, named: bool
    ) -> Proposal | None:
        """Return what becomes of a grasp when the hand is put there; None if there is no room, which `tally` gets to know."""
        link, at = grasp.piece.link, self.fitting.joint(opening.number)
        furthest = max(0.0, self.fitting.hand.tip - _HELD) if grasp.kind != "edge" else 0.0
        reasons = list[Blocked]()
        for standoff in dict.fromkeys((0.0, furthest / 2.0, furthest)):
            tool = at * grasp.placement * _back(standoff)
            blocked = self.fitting.find_obstruction(tool, link) or self._drawn_back(tool, link)
            if blocked is None:
                break
            reasons.append(blocked)
        else:
            tally.blocked[reasons[0]] += 1
            return None
        room = next(
            (
                room
                for room in _ROOM
                if self.fitting.find_obstruction(tool, link, more=room) is None
            ),
            0.0,
        )
        grip, opens = Grip(self.fitting, grasp, standoff), dict[str, float]()
        for joint in self.item.model.supports[opening.number]:
            if joint:
                way = self.openings[joint]
                reached = grip.follow(way)
                if abs(reached - way.closed) > _LITTLE * abs(way.opened - way.closed):
                    opens[way.joint] = reached
        if opening.joint not in opens:
            tally.cramped += 1
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

    def _drawn_back(self, tool: pin.SE3, link: str) -> Blocked | None:
        """Return what is in the way of a hand that draws back straight."""
        for way in np.arange(_STEP, _WAY + _STEP / 2.0, _STEP):
            if (blocked := self.fitting.find_obstruction(tool * _back(way), link)) is not None:
                return blocked
        return None

    def named(self, found: Iterable[Proposal]) -> list[Proposal]:
        """Return proposals with names that differ from each other and from those of joints."""
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

    def because(self, opening: Opening) -> str:
        """Return why a joint cannot be opened by anything that it moves itself."""
        tally, hand = self.tallies[opening.number], self.hand
        seen, given_up = tally.thickness, tally.blocked.most_common()
        if not tally.pieces:
            return "what it moves has no shape of its own"
        if opening.opened == opening.closed:
            return "its limits leave it no way to go"
        fits = seen.tried - seen.too_thick
        if not fits:
            thinnest = (
                f", it is {1e3 * seen.thinnest:.0f} mm at its thinnest"
                if np.isfinite(seen.thinnest)
                else ""
            )
            clear = 1e3 * self.close
            between = (
                f"the fingers, {1e3 * hand.opening:.0f} mm apart, with {clear:.0f} mm on both sides"
            )
            return f"nothing of it fits between {between}{thinnest}"
        said = []
        for blocked, count in given_up[:3]:
            least = 1e3 * (self.close if blocked.what == "fingers" else self.safe)
            near = (
                "have the hand go below what it stands on"
                if blocked.what == "floor"
                else f"are not {least:.0f} mm from {blocked.link}"
            )
            said.append(f"{count} {near}")
        if tally.cramped:
            said.append(
                f"{tally.cramped} let it open by less than a tenth before the hand meets the rest"
            )
        return f"of {min(fits, _TRIED)} places that are thin enough, " + ", ".join(said)


def _back(way: float) -> pin.SE3:
    """Return the motion against the direction of approach by a way [m]."""
    return pin.SE3(np.eye(3), np.array([0.0, 0.0, -way]))


def _ranks(kept: list[tuple[Proposal, Candidate]]) -> list[tuple[float, Proposal]]:
    """Return proposals by rank, the best first: by score, but less for a hand that is only turned where a better one is."""
    ranked, better = list[tuple[float, Proposal]](), list[tuple[Proposal, Candidate]]()
    for proposal, grasp in kept:
        count = sum(_alike(taken, other, grasp, turned=True) for other, taken in better)
        ranked.append((proposal.score * _TURNED**count, proposal))
        better.append((proposal, grasp))
    return sorted(ranked, key=lambda entry: -entry[0])


def _alike(taken: Candidate, proposal: Proposal, other: Candidate, *, turned: bool = False) -> bool:
    """Return whether a grasp is about one that is proposed: from the same side, and where the hand can slide to from there.

    The hand is held the same way as well, unless it may be `turned` about its approach.
    """
    first, second = taken.placement, other.placement
    if first.rotation[:, 2] @ second.rotation[:, 2] < _ALIKE:
        return False
    if not turned and abs(first.rotation[:, 1] @ second.rotation[:, 1]) < _ALIKE:
        return False
    apart = first.rotation.T @ (second.translation - first.translation)
    slide = next((item for item in proposal.attachment.freedoms if item.kind == "prismatic"), None)
    low, high = (slide.lower, slide.upper) if slide else (0.0, 0.0)
    apart[1] -= min(max(apart[1], low), high)
    return bool(np.linalg.norm(apart) < _NEAR)
