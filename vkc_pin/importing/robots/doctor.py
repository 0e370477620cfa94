"""Examines a robot's description for faults, slow geometry and missing data."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.importing.convex import compute_concavity
from vkc_pin.importing.proposals.hand import Hand, has_fingers, make_hand
from vkc_pin.importing.robots.hand_checks import (
    TASK_HEIGHTS,
    find_envelopes,
    find_grasp_heights,
    find_missing_tasks,
)
from vkc_pin.importing.robots.rest_configuration import Clearances, find_inseparable_pairs
from vkc_pin.options import Options
from vkc_pin.utils.arguments import check_integer, check_number
from vkc_pin.world.files.meshes import load_mesh
from vkc_pin.world.files.srdf import format_names
from vkc_pin.world.models.couplings import (
    DEFAULT_JOINT_VELOCITY,
    DEFAULT_SLIDE_VELOCITY,
    find_joint_path,
)
from vkc_pin.world.models.dynamics import UNLIMITED
from vkc_pin.world.models.gripper import find_thickest_rod
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.models.robot_model import build_full_model
from vkc_pin.world.models.shapes import compute_bounding_box
from vkc_pin.world.models.wheels import describe_misplaced_axle, find_drive, is_on_axle

_SAMPLES = 200
_CONCAVE = 0.03  # [m] protrusion of a hull above which it is reported
_COUNTED = ("fault", "limitation", "warning")  # levels whose number is reported
_LISTED = 6  # names in a list
_DEFAULT_VELOCITIES = (DEFAULT_JOINT_VELOCITY, DEFAULT_SLIDE_VELOCITY)
_BAR = 0.015  # [m] thickness of common handles
_LIFTS = np.arange(-5, 11) / 10.0  # [m] by which a robot may be raised
# Beyond these sizes of robots and travels of joints, a unit is probably wrong.
_SMALL = 0.05  # [m]
_LARGE = 8.0  # [m]
_MANY_TURNS = 12.0 * np.pi  # [rad]
_LONG = 10.0  # [m]
_UNLIMITED_TURNS = 2000.0  # [rad] travels above this mean that a joint is unlimited
_IMPLAUSIBLE_VELOCITY = 1e3  # [rad/s], [m/s] limits from this on count as none


@dataclass(frozen=True)
class Finding:
    """A finding of the examination.

    Attributes:
        level: "fault" (planning fails), "limitation" (a common task that the robot cannot do),
            "warning" (planning may fail, or values are assumed), "note".
        topic: "home", "pairs", "base", "units", "limits", "effort", "mass", "hand", "shapes",
            "guessed" or "file".
        text: The finding.
        hint: A remedy, or "".
    """

    level: str
    topic: str
    text: str
    hint: str = ""


@dataclass(frozen=True)
class Diagnosis:
    """Findings about a robot.

    Attributes:
        name: The robot's name.
        findings: Findings, sorted by level with faults first.
    """

    name: str
    findings: tuple[Finding, ...]

    def __post_init__(self) -> None:
        order = (*_COUNTED, "note")
        by_level = sorted(self.findings, key=lambda finding: order.index(finding.level))
        object.__setattr__(self, "findings", tuple(by_level))

    @property
    def healthy(self) -> bool:
        """Whether no fault was found."""
        return all(finding.level != "fault" for finding in self.findings)

    def __str__(self) -> str:
        counts = list[str]()
        for level in _COUNTED:
            count = sum(finding.level == level for finding in self.findings)
            counts.append(f"{count} {level}" if count == 1 else f"{count} {level}s")
        lines = [f"{self.name}: {', '.join(counts)}"]
        for finding in self.findings:
            lines.append(f"  {finding.level:10} {finding.topic:8} {finding.text}")
            if finding.hint:
                lines.append(f"{'':22}→ {finding.hint}")
        return "\n".join(lines)


def doctor(
    robot: str | Path | Robot,
    *,
    margin: float | None = None,
    samples: int = _SAMPLES,
    seed: int = 0,
) -> Diagnosis:
    """Examine a robot.

    The examination covers the home configuration (collisions, pairs closer than the margin, the
    floor), pairs of links that no random configuration separates by the margin, the axle of wheels,
    missing limits, efforts and masses, units, the hand and the bars that it can grasp, and meshes
    that are far from convex.

    Args:
        robot: A robot, or an argument of `load_robot`.
        margin: Clearance of motions [m]; defaults to `Options.dist_safe`.
        samples: Number of random configurations.
        seed: Random seed.

    Raises:
        InputError: The robot cannot be loaded, or an argument is invalid.
    """
    check_integer(samples, "samples", low=1, high=1_000_000)
    clearance = Options().dist_safe
    if margin is not None:
        clearance = check_number(margin, "margin", "a clearance [m]", low=0.0, strict=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loaded = robot if isinstance(robot, Robot) else load_robot(robot)
    findings = [
        *_check_home(loaded, clearance),
        *_check_pairs(loaded, clearance, samples, seed),
        *_check_wheels(loaded),
        *_check_units(loaded),
        *_check_limits(loaded),
        *_check_masses(loaded),
        *_check_hand(loaded, seed),
        *_check_shapes(loaded),
    ]
    findings += [Finding("warning", "loading", str(warning.message)) for warning in caught]
    return Diagnosis(loaded.name, tuple(findings))


def _check_home(robot: Robot, margin: float) -> list[Finding]:
    findings = list[Finding]()
    distances = Clearances(robot)
    distances.place(robot.home)
    hint = (
        "another `home` in robot.yaml (`vkc-pin import-robot` searches for one), "
        "or an SRDF that allows the pair"
    )
    for one, other, distance in distances.links(margin):
        text = (
            f"{one} and {other} are {1e3 * distance:.1f} mm apart at home, "
            f"the margin is {1e3 * margin:.0f} mm"
        )
        if distance <= 0.0:
            text = f"{one} and {other} collide at home ({-1e3 * distance:.1f} mm deep)"
        findings.append(Finding("fault", "home", text, hint))
    low = [(link, height) for link, height in distances.floor() if height < margin]
    if low:
        listed = ", ".join(f"{link} ({1e3 * height:.0f} mm)" for link, height in low[:_LISTED])
        text = f"below the floor at home, or less than the margin above it: {listed}"
        findings.append(Finding("fault", "home", text, hint))
    if not findings:
        text = f"free: clearance {1e3 * distances.least():.0f} mm between links and to the floor"
        findings.append(Finding("note", "home", text))
    return findings


def _check_pairs(robot: Robot, margin: float, samples: int, seed: int) -> list[Finding]:
    hint = (
        "if they are neighbours by design, allow them in the SRDF: "
        "`vkc-pin srdf`, `<disable_collisions>`"
    )
    findings = list[Finding]()
    inseparable = find_inseparable_pairs(robot, margin, samples=samples, seed=seed)
    for (one, other), furthest in inseparable.items():
        text = f"{one} and {other} were never more than {1e3 * furthest:.1f} mm apart"
        findings.append(Finding("fault", "pairs", text, hint))
    pairs = list(robot.collision.collisionPairs)
    links = {(robot.link_of(pair.first), robot.link_of(pair.second)) for pair in pairs}
    text = f"{len(links)} pairs of links are checked ({len(pairs)} of convex pieces)"
    findings.append(Finding("note", "pairs", text))
    return findings


def _check_wheels(robot: Robot) -> list[Finding]:
    """Report an axle away from the root, with which wheels would slide sideways."""
    full = build_full_model(robot.file)
    path = [str(full.names[joint]) for joint in find_joint_path(full, robot.tool_frame)]
    drive = find_drive(full, robot.file, path)
    if drive is None or is_on_axle(drive) or robot.base == "fixed":
        return []
    level = "warning" if robot.base == "omni" else "fault"
    text = f"{describe_misplaced_axle(drive)}: as a `{drive.kind}` base its wheels would slide"
    hint = "a root link there, with x in the direction in which they roll, "
    hint += "as `vkc-pin import-robot` writes it"
    return [Finding(level, "base", text, hint)]


def _check_units(robot: Robot) -> list[Finding]:
    """Report sizes and joint limits that no robot has."""
    findings = list[Finding]()
    sizes = dict[str, float]()
    for k, shape in enumerate(robot.collision.geometryObjects):
        _, half_extents = compute_bounding_box(shape)
        size = 2.0 * float(half_extents.max())
        link = robot.link_of(k)
        sizes[link] = max(size, sizes.get(link, 0.0))
    hint = "is the mesh in mm or cm? Set `scale` of its <mesh>, e.g. 0.001 for mm"
    for link, size in sizes.items():
        if size > _LARGE:
            findings.append(Finding("fault", "units", f"{link} is {size:.3g} m long", hint))
    if sizes:
        largest = max(sizes, key=sizes.__getitem__)
        if sizes[largest] < _SMALL:
            text = f"the largest link, {largest}, is only {1e3 * sizes[largest]:.3g} mm long"
            findings.append(Finding("fault", "units", text, "are the lengths in metres?"))
    for k, name in enumerate(robot.coordinates.names[3:], 3):
        low = float(robot.lower[k])
        high = float(robot.upper[k])
        if not np.isfinite([low, high]).all():
            continue
        travel = high - low
        slides = robot.coordinates.units[k] == "m"
        is_implausible = _MANY_TURNS < travel < _UNLIMITED_TURNS
        if slides:
            is_implausible = travel > _LONG
        if is_implausible:
            text = f"{name} moves from {low:.4g} to {high:.4g} {'m' if slides else 'rad'}"
            hint = f"are its limits in {'mm' if slides else 'degrees'}?"
            findings.append(Finding("warning", "units", text, hint))
    return findings


def _check_limits(robot: Robot) -> list[Finding]:
    planned_joints = {name: k for k, name in enumerate(robot.coordinates.names) if k > 2}
    no_velocity = dict[str, list[str]]()  # joints by assumed limit
    no_effort = list[str]()
    unlimited = list[str]()
    for joint in robot.file.root.findall("joint"):
        name = joint.get("name", "")
        if name not in planned_joints:
            continue
        k = planned_joints[name]
        limit = joint.find("limit")
        velocity = float(limit.get("velocity", "0")) if limit is not None else 0.0
        is_stated = 0.0 < velocity < _IMPLAUSIBLE_VELOCITY
        if not is_stated and robot.velocity[k] in _DEFAULT_VELOCITIES:
            rate = f"{robot.velocity[k]:.3g} {robot.coordinates.units[k]}/s"
            no_velocity.setdefault(rate, []).append(name)
        if not 0.0 < robot.model.effortLimit[k] < UNLIMITED:
            no_effort.append(name)
        if joint.get("type") == "continuous":
            unlimited.append(name)
    findings = list[Finding]()
    if no_velocity:
        assumed = list[str]()
        for rate, joints in no_velocity.items():
            assumed.append(f"{format_names(joints)} (assumed: {rate})")
        text = f"no velocity limit in the file: {'; '.join(assumed)}"
        hint = "`joints: {NAME: {velocity: ...}}` in robot.yaml, from the data sheet"
        findings.append(Finding("warning", "limits", text, hint))
    if unlimited:
        findings.append(Finding("note", "limits", f"unlimited rotation: {format_names(unlimited)}"))
    if no_effort:
        text = f"no effort limit: {format_names(no_effort)} (their torques are not limited)"
        hint = "`joints: {NAME: {effort: ...}}` in robot.yaml"
        findings.append(Finding("note", "effort", text, hint))
    for note in robot.torque_limits.notes:
        # Joints without limits have been listed.
        if "no effort" not in note:
            findings.append(Finding("note", "effort", note))
    return findings


def _check_masses(robot: Robot) -> list[Finding]:
    """Report links with shapes for which the file states no mass."""
    with_mass = set[str]()
    for link in robot.file.root.findall("link"):
        if _read_mass(link) > 0.0:
            with_mass.add(link.get("name", ""))
    massless = [link for link in robot.links if link not in with_mass]
    if not massless:
        return []
    text = f"links with a shape but no mass: {format_names(massless)} (massless)"
    return [Finding("note", "mass", text)]


def _read_mass(link: ElementTree.Element) -> float:
    element = link.find("inertial/mass")
    try:
        return 0.0 if element is None else float(element.get("value", "0"))
    except ValueError:
        return 0.0


def _check_hand(robot: Robot, seed: int) -> list[Finding]:
    findings = list[Finding]()
    for link, share in find_envelopes(robot).items():
        text = f"{link} encloses {share:.0%} of the hand: the fingers cannot reach anything"
        hint = "remove its <collision> from the URDF, as `vkc-pin import-robot` does"
        findings.append(Finding("warning", "hand", text, hint))
    if not robot.touch_links:
        text = "no link may touch what is grasped: it can reach poses, but not grasp objects"
        hint = "`touch_links` in robot.yaml: palm and fingers, if it has a hand"
        findings.append(Finding("limitation", "hand", text, hint))
        return findings
    frame = robot.model.frames[robot.model.getFrameId(robot.tool_frame)]
    heights = list[float]()  # of the hand's shapes along the approach, from the tool frame
    for k, shape in enumerate(robot.collision.geometryObjects):
        if robot.link_of(k) in robot.touch_links and shape.parentJoint == frame.parentJoint:
            centre = shape.placement.act(np.asarray(shape.geometry.aabb_center, float))
            heights.append(float(frame.placement.actInv(centre)[2]))
    if not heights:
        text = f"none of the touch_links moves with the tool frame {robot.tool_frame}"
        findings.append(Finding("warning", "hand", text))
    elif min(heights) > 0.0:
        text = f"the hand lies in front of its tool frame {robot.tool_frame}"
        hint = "z of the tool frame is the direction of approach, x the closing direction"
        findings.append(Finding("fault", "hand", text, hint))
    try:
        findings += _check_grasps(robot, make_hand(robot), seed)
    except InputError as error:
        if has_fingers(robot):
            hint = f"attachments need {error.expected}"
            findings.append(Finding("fault", "hand", f"{error.problem}: it cannot grasp", hint))
        else:
            text = f"{error.problem}: it can reach poses, but not grasp objects"
            findings.append(Finding("limitation", "hand", text))
    return findings


def _check_grasps(robot: Robot, hand: Hand, seed: int) -> list[Finding]:
    """Report which bars the hand can grasp, and where."""
    findings = list[Finding]()
    room = min(hand.opening, find_thickest_rod(hand.touch))
    thickness = max(0.0, room - 2.0 * Options().grasp_clearance)
    if thickness < _BAR:
        text = f"it cannot grasp bars more than {1e3 * thickness:.0f} mm thick"
        findings.append(Finding("limitation", "hand", text, "open the fingers further"))
    heights = find_grasp_heights(robot, seed=seed)
    where = list[str]()
    for kind in ("level", "upright"):
        found = heights[kind]
        if len(found):
            where.append(f"{kind} ones at {found.min():.1f} to {found.max():.1f} m")
    if where:
        text = f"it grasps bars up to {1e3 * thickness:.0f} mm thick: {', '.join(where)}"
        findings.append(Finding("note", "hand", text))
    missing = find_missing_tasks(heights)
    if missing:
        text = f"it cannot {' or '.join(missing)}: level bars, see below"
        hint = "no other height of its base suits all of this"
        if not len(heights["level"]):
            text = "it cannot grasp level bars, such as most handles: no configuration holds one"
            hint = "a wrist that rolls the hand with clearance, or a tool frame turned about z"
        hint = _suggest_height(robot, seed) or hint
        findings.append(Finding("limitation", "hand", text, hint))
    return findings


def _suggest_height(robot: Robot, seed: int) -> str:
    """Return the height at which a robot can do common tasks, as text, or ""."""
    clearances = Clearances(robot)
    clearances.place(robot.home)
    lowest = min((height for _, height in clearances.floor(moved=False)), default=0.0)
    suitable = list[float]()
    # The base stays above the floor.
    for lift in _LIFTS[max(lowest, 0.0) + _LIFTS > 0.0].tolist():
        found = find_grasp_heights(robot, lift=lift, heights=TASK_HEIGHTS, seed=seed)
        if not find_missing_tasks(found):
            suitable.append(lift)
    if not suitable:
        return ""
    middle = suitable[len(suitable) // 2]
    where = f"{abs(middle):.1f} m {'higher' if middle > 0.0 else 'lower'}"
    height = round(robot.height + middle, 3)
    return f"mounted {where}, it can: `base: {{height: {height:g}}}` in robot.yaml"


def _check_shapes(robot: Robot) -> list[Finding]:
    link_of_mesh = dict[tuple[Path, tuple[float, ...]], str]()
    for shape in robot.file.read_shapes("collision"):
        if shape.file is not None and (shape.file, shape.size) not in link_of_mesh:
            link_of_mesh[shape.file, shape.size] = shape.link
    concave = list[tuple[float, str, str]]()
    for (file, size), link in link_of_mesh.items():
        protrusion = compute_concavity(load_mesh(file, size))
        if protrusion > _CONCAVE:
            concave.append((protrusion, link, file.name))
    if not concave:
        return []
    concave.sort(reverse=True)
    listed = [f"{link} ({1e3 * out:.0f} mm, {name})" for out, link, name in concave[:_LISTED]]
    text = f"hulls protrude far over their meshes: {', '.join(listed)}"
    hint = "`vkc-pin import-robot` cuts them into convex pieces"
    return [Finding("warning", "shapes", text, hint)]
