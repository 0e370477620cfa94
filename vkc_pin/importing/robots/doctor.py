"""Examines a robot's description: what makes plans impossible, what slows them down, and what is missing."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.importing.convex import compute_concavity
from vkc_pin.importing.proposals.hand import make_hand
from vkc_pin.importing.robots.envelopes import find_envelopes
from vkc_pin.importing.robots.rest_configuration import Clearances, find_inseparable_pairs
from vkc_pin.options import Options
from vkc_pin.utils.arguments import number, whole
from vkc_pin.world.files.meshes import load_mesh
from vkc_pin.world.models.couplings.limits import DEFAULT_JOINT_VELOCITY
from vkc_pin.world.models.dynamics.torque_limits import UNLIMITED
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot

__all__ = ["Diagnosis", "Finding", "doctor"]

_SAMPLES = 200
_CONCAVE = 0.03  # [m]
_LISTED = 6


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        level: "fault" (plans fail), "warning" (some do, or figures are made up), "note".
        topic: "home", "pairs", "limits", "effort", "mass", "hand", "shapes", "guessed" or "file".
        text: What was found.
        hint: What would mend it, or "".
    """

    level: str
    topic: str
    text: str
    hint: str = ""


@dataclass(frozen=True)
class Diagnosis:
    """What was found out about a robot.

    Attributes:
        name: The robot.
        findings: Faults first, in whatever order they are given.
    """

    name: str
    findings: tuple[Finding, ...]

    def __post_init__(self) -> None:
        order = ("fault", "warning", "note")
        object.__setattr__(
            self,
            "findings",
            tuple(sorted(self.findings, key=lambda finding: order.index(finding.level))),
        )

    @property
    def healthy(self) -> bool:
        """Whether no fault was found."""
        return all(finding.level != "fault" for finding in self.findings)

    def __str__(self) -> str:
        counts = {
            level: sum(finding.level == level for finding in self.findings)
            for level in ("fault", "warning")
        }
        said = ", ".join(f"{count} {level}{'s' * (count != 1)}" for level, count in counts.items())
        lines = [f"{self.name}: {said}"]
        for finding in self.findings:
            lines.append(f"  {finding.level:7} {finding.topic:8} {finding.text}")
            if finding.hint:
                lines.append(f"{'':19}→ {finding.hint}")
        return "\n".join(lines)


def doctor(
    robot: str | Path | Robot,
    *,
    margin: float | None = None,
    samples: int = _SAMPLES,
    seed: int = 0,
) -> Diagnosis:
    """Examine a robot.

    Looked at are home (collisions, pairs closer than the margin, the floor), pairs of links that
    random configurations never bring apart by the margin, limits, efforts and masses that the files
    do not name, the hand, and meshes that are far from convex.

    Args:
        robot: A robot, or what `load_robot` takes.
        margin: The clearance that motions keep [m]; by default `Options.dist_safe`.
        samples: How many random configurations to look at.
        seed: Of the random numbers.

    Raises:
        InputError: The robot cannot be loaded, or an argument is wrong.
    """
    whole(samples, "samples", low=1)
    kept = (
        Options().dist_safe
        if margin is None
        else number(margin, "margin", "a clearance [m]", low=0.0, above=True)
    )
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        examined = robot if isinstance(robot, Robot) else load_robot(robot)
    findings = [
        *_home(examined, kept),
        *_pairs(examined, kept, samples, seed),
        *_numbers(examined),
        *_hand(examined),
    ]
    findings += [
        *_shapes(examined),
        *(Finding("warning", "loading", str(one.message)) for one in told),
    ]
    return Diagnosis(examined.name, tuple(findings))


def _home(robot: Robot, margin: float) -> list[Finding]:
    look, found = Clearances(robot), []
    look.place(robot.home)
    hint = "another `home` in robot.yaml (`vkc-pin import-robot` looks for one), or an SRDF that allows the pair"
    for one, other, distance in look.links(margin):
        text = f"{one} and {other} are {1e3 * distance:.1f} mm apart at home, the margin is {1e3 * margin:.0f} mm"
        if distance <= 0.0:
            text = f"{one} and {other} collide at home ({-1e3 * distance:.1f} mm deep)"
        found.append(Finding("fault", "home", text, hint))
    low = [(link, height) for link, height in look.floor() if height < margin]
    if low:
        text = ", ".join(f"{link} ({1e3 * height:.0f} mm)" for link, height in low[:_LISTED])
        found.append(
            Finding(
                "fault",
                "home",
                f"at home below the floor, or less than the margin above it: {text}",
                hint,
            )
        )
    if not found:
        text = (
            f"free: {1e3 * look.least():.0f} mm between links that are kept apart, and to the floor"
        )
        found.append(Finding("note", "home", text))
    return found


def _pairs(robot: Robot, margin: float, samples: int, seed: int) -> list[Finding]:
    hint = "if they are neighbours by design, allow them in the SRDF: `vkc-pin srdf`, `<disable_collisions>`"
    found = [
        Finding(
            "fault",
            "pairs",
            f"{one} and {other} were never more than {1e3 * furthest:.1f} mm apart",
            hint,
        )
        for (one, other), furthest in find_inseparable_pairs(
            robot, margin, samples=samples, seed=seed
        ).items()
    ]
    pairs = [
        (robot.link_of(pair.first), robot.link_of(pair.second))
        for pair in robot.collision.collisionPairs
    ]
    count = f"{len(set(pairs))} pairs of links are kept apart ({len(pairs)} of convex pieces)"
    return [*found, Finding("note", "pairs", count)]


def _numbers(robot: Robot) -> list[Finding]:
    planned, found = {name: k for k, name in enumerate(robot.coordinates.names) if k > 2}, []
    speed, effort, turning = [], [], []
    for joint in robot.file.root.findall("joint"):
        name, limit = joint.get("name", ""), joint.find("limit")
        if name not in planned:
            continue
        velocity = float(limit.get("velocity", "0")) if limit is not None else 0.0
        if not 0.0 < velocity < 1e3 and robot.velocity[planned[name]] == DEFAULT_JOINT_VELOCITY:
            speed.append(name)
        if not 0.0 < robot.model.effortLimit[planned[name]] < UNLIMITED:
            effort.append(name)
        if joint.get("type") == "continuous":
            turning.append(name)
    heavy = {link.get("name", "") for link in robot.file.root.findall("link") if _mass(link) > 0.0}
    light = [link for link in robot.links if link not in heavy]
    if speed:
        used = ", ".join(f"{robot.velocity[planned[name]]:.3g}" for name in speed)
        hint = "`joints: {NAME: {velocity: ...}}` in robot.yaml, from the data sheet"
        found.append(
            Finding(
                "warning", "limits", f"no speed in the file: {_list(speed)} (taken: {used})", hint
            )
        )
    if turning:
        found.append(Finding("note", "limits", f"turn without end: {_list(turning)}"))
    if effort:
        hint = "`joints: {NAME: {effort: ...}}` in robot.yaml"
        found.append(
            Finding(
                "note",
                "effort",
                f"no effort: {_list(effort)} (their torques are not limited)",
                hint,
            )
        )
    found += [
        Finding("note", "effort", note) for note in robot.efforts.notes if "no effort" not in note
    ]
    if light:
        found.append(
            Finding(
                "note",
                "mass",
                f"links with a shape but no mass: {_list(light)} (they weigh nothing)",
            )
        )
    return found


def _mass(link: ElementTree.Element) -> float:
    element = link.find("inertial/mass")
    try:
        return 0.0 if element is None else float(element.get("value", "0"))
    except ValueError:
        return 0.0


def _hand(robot: Robot) -> list[Finding]:
    found = []
    try:
        make_hand(robot)
    except InputError as error:
        if robot.touch_links:
            hint = f"attachments are proposed for {error.expected}, see docs/robots.md"
            found.append(
                Finding("warning", "hand", f"{error.problem}: it takes hold of nothing", hint)
            )
    for link, share in find_envelopes(robot).items():
        text = f"{link} is a shape around the hand, {share:.0%} of which is in it: the fingers get at nothing"
        hint = "remove its <collision> from the URDF, as `vkc-pin import-robot` does"
        found.append(Finding("warning", "hand", text, hint))
    if not robot.touch_links:
        hint = "`touch_links` in robot.yaml: palm and fingers; without them a grasp is reported as a collision"
        found.append(Finding("warning", "hand", "no link may touch what is grasped", hint))
        return found
    frame = robot.model.frames[robot.model.getFrameId(robot.tool_frame)]
    behind = []
    for k, shape in enumerate(robot.collision.geometryObjects):
        if robot.link_of(k) in robot.touch_links and shape.parentJoint == frame.parentJoint:
            centre = shape.placement.act(np.asarray(shape.geometry.aabb_center, float))
            behind.append(float(frame.placement.actInv(centre)[2]))
    if behind and min(behind) > 0.0:
        hint = "z of the tool frame is the direction of approach, x the one in which the fingers close, see docs/robots.md"
        found.append(
            Finding(
                "fault",
                "hand",
                f"the hand lies in front of its tool frame {robot.tool_frame}",
                hint,
            )
        )
    elif not behind:
        found.append(
            Finding(
                "warning",
                "hand",
                f"none of the touch_links moves with the tool frame {robot.tool_frame}",
            )
        )
    return found


def _shapes(robot: Robot) -> list[Finding]:
    found, seen = [], {}
    for shape in robot.file.shapes("collision"):
        if shape.file is not None and (shape.file, shape.size) not in seen:
            seen[shape.file, shape.size] = shape.link
    deep = []
    for (file, size), link in seen.items():
        stands_out = compute_concavity(load_mesh(file, size))
        if stands_out > _CONCAVE:
            deep.append((stands_out, link, file.name))
    if deep:
        text = ", ".join(
            f"{link} ({1e3 * out:.0f} mm, {name})"
            for out, link, name in sorted(deep, reverse=True)[:_LISTED]
        )
        hint = "`vkc-pin import-robot` cuts them into convex pieces"
        found.append(
            Finding("warning", "shapes", f"hulls stand out far over their meshes: {text}", hint)
        )
    return found


def _list(names: list[str]) -> str:
    return ", ".join(names[:_LISTED]) + (f", ... ({len(names)})" if len(names) > _LISTED else "")
