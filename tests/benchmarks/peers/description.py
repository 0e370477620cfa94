"""Writes a virtual kinematic chain and its surroundings as URDF and SRDF.

A grasped object is an inverted branch of the hand; fixed objects are attached to the root. Each
shape is a link `shape_<number>`, so that pairs can be disabled and have own margins.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.hulls import compute_hull

from .sampled import compute_finite_limits

GROUP = "chain"
FRAME = "goal_frame"
_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
_AROUND = 1.06  # radius of the corners of 42 that lie around a unit sphere
_PLUGINS = "package://tesseract_support/urdf/contact_manager_plugins.yaml"  # of its wheel
_EFFORT = 1000.0  # nobody asks


@dataclass(frozen=True)
class Description:
    """Files of a chain.

    Attributes:
        urdf: URDF file.
        srdf: SRDF file.
        joints: Names of the joints, in the order of the chain's coordinates.
        margins: (link, link) → clearance that the planner has to keep [m].
    """

    urdf: Path
    srdf: Path
    joints: tuple[str, ...]
    margins: dict[tuple[str, str], float]


def describe(problem: TrajectoryProblem, folder: Path, *, by_body: bool = False) -> Description:
    """Write URDF, SRDF and meshes of a problem to a folder.

    The second shape of each pair is inflated by the clearance that the planner does not keep.

    Args:
        problem: Problem with one phase.
        folder: Existing folder.
        by_body: Whether the planner keeps one clearance per pair of bodies, else none.

    Raises:
        InputError: The chain has a joint that URDF does not support.
    """
    (part,) = problem.contacts.phases
    root = ET.Element("robot", {"name": "chain", "tesseract:make_convex": "true"})
    ET.SubElement(root, "link", name="world")
    names = tuple(name.replace(".", "_") for name in problem.chain.names)
    _add_joints(root, problem, names)
    if problem.pose_goals:
        goal = problem.pose_goals[0]
        ET.SubElement(root, "link", name=FRAME)
        _joint(root, f"to_{FRAME}", "fixed", f"body_{goal.row.joint}", FRAME, goal.local)
    margins = dict(zip(map(tuple, part.pairs.tolist()), part.margins.tolist(), strict=True))
    least: dict[frozenset[int], float] = {}  # of each pair of bodies
    for (i, j), margin in margins.items():
        bodies = frozenset((part.joint[i], part.joint[j]))
        least[bodies] = min(margin, least.get(bodies, margin)) if by_body else 0.0
    links: dict[str, tuple[int, float]] = {}
    kept: dict[frozenset[str], float] = {}
    for (i, j), margin in margins.items():
        own = least[frozenset((part.joint[i], part.joint[j]))]
        rest = max(0.0, margin - own)
        one = f"shape_{i}"
        other = _thick(j, rest)
        links |= {one: (i, 0.0), other: (j, rest)}
        kept[frozenset((one, other))] = own
    for name, (number, thicker) in links.items():
        shape = part.shapes[number]
        link = ET.SubElement(root, "link", name=name)
        body = "world" if part.joint[number] == 0 else f"body_{part.joint[number]}"
        _joint(root, f"to_{name}", "fixed", body, name, shape.placement)
        _collision(link, shape.geometry, thicker, folder / f"{name}.stl")
    moved = {name for name, (number, _) in links.items() if part.joint[number]}
    unchecked = list[tuple[str, str]]()
    for one, other in combinations(links, 2):
        if frozenset((one, other)) not in kept and (one in moved or other in moved):
            unchecked.append((one, other))
    urdf = folder / "chain.urdf"
    srdf = folder / "chain.srdf"
    ET.ElementTree(root).write(urdf)
    ET.ElementTree(_make_semantics(names, unchecked)).write(srdf)
    margin_by_links = dict[tuple[str, str], float]()
    for pair, own in kept.items():
        one, other = sorted(pair)
        margin_by_links[one, other] = own
    return Description(urdf, srdf, names, margin_by_links)


def _add_joints(root: ET.Element, problem: TrajectoryProblem, names: Sequence[str]) -> None:
    """Add the bodies of a chain, and a joint for each of its coordinates."""
    chain = problem.chain
    model = chain.model
    lower, upper = compute_finite_limits(problem)
    at = 0
    for j in range(1, model.njoints):
        parent = f"body_{model.parents[j]}" if model.parents[j] else "world"
        placement = model.jointPlacements[j]
        moves = _list_moves(model, j)
        for k, (form, axis) in enumerate(moves):
            child = f"body_{j}" if k + 1 == len(moves) else f"body_{j}_{k}"
            ET.SubElement(root, "link", name=child)
            joint = _joint(root, names[at], form, parent, child, placement)
            ET.SubElement(joint, "axis", xyz=_numbers(axis))
            limit = ET.SubElement(joint, "limit")
            limit.set("lower", repr(float(lower[at])))
            limit.set("upper", repr(float(upper[at])))
            limit.set("velocity", repr(float(chain.velocity[at])))
            limit.set("effort", repr(_EFFORT))
            parent = child
            placement = pin.SE3.Identity()
            at += 1
    if at != len(names):
        raise InputError("joints move together", field=", ".join(names))


def _make_semantics(names: Sequence[str], unchecked: Sequence[tuple[str, str]]) -> ET.Element:
    """Return an SRDF with a group of joints, and pairs of links that are not checked."""
    semantics = ET.Element("robot", name="chain")
    group = ET.SubElement(semantics, "group", name=GROUP)
    for name in names:
        ET.SubElement(group, "joint", name=name)
    # Tesseract cannot do without it.
    ET.SubElement(semantics, "contact_managers_plugin_config", filename=_PLUGINS)
    for one, other in unchecked:
        ET.SubElement(semantics, "disable_collisions", link1=one, link2=other, reason="Never")
    return semantics


def _list_moves(model: Any, joint: int) -> list[tuple[str, tuple[float, ...]]]:
    """Return type and axis of the URDF joints that a joint is made of."""
    short = str(model.joints[joint].shortname()).removeprefix("JointModel")
    if short == "Planar":
        return [("prismatic", _AXES["X"]), ("prismatic", _AXES["Y"]), ("revolute", _AXES["Z"])]
    form = "prismatic" if short[0] == "P" else "revolute"
    if short[-1] in _AXES and short[0] in "RP":
        return [(form, _AXES[short[-1]])]
    if short in ("RevoluteUnaligned", "RevoluteUnboundedUnaligned", "PrismaticUnaligned"):
        return [(form, tuple(_axis(model, joint)))]
    raise InputError("no joint of a URDF", field=str(model.names[joint]), got=short)


def _thick(number: int, thicker: float) -> str:
    return f"shape_{number}" if thicker == 0.0 else f"shape_{number}_{round(1e5 * thicker)}"


def _axis(model: Any, joint: int) -> Floats:
    """Return the axis of a joint in its own frame, shape (3,)."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    columns = pin.getJointJacobian(model, data, joint, pin.LOCAL)[:, model.idx_vs[joint]]
    return np.asarray(columns[3:] if np.linalg.norm(columns[3:]) > 0.5 else columns[:3])


def _joint(
    root: ET.Element, name: str, form: str, parent: str, child: str, placement: pin.SE3
) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=form)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    rotation = pin.rpy.matrixToRpy(placement.rotation)
    ET.SubElement(joint, "origin", xyz=_numbers(placement.translation), rpy=_numbers(rotation))
    return joint


def _collision(link: ET.Element, shape: Any, thicker: float, file: Path) -> None:
    """Add a shape, inflated by `thicker` [m], to a link, as a mesh unless it is simple."""
    collision = ET.SubElement(link, "collision", name=link.attrib["name"])
    geometry = ET.SubElement(collision, "geometry")
    if isinstance(shape, coal.Sphere):
        ET.SubElement(geometry, "sphere", radius=repr(shape.radius + thicker))
    elif isinstance(shape, coal.Box) and not thicker:
        ET.SubElement(geometry, "box", size=_numbers(2.0 * np.asarray(shape.halfSide)))
    elif isinstance(shape, coal.Cylinder) and not thicker:
        sizes = {"radius": shape.radius, "length": 2.0 * shape.halfLength}
        ET.SubElement(
            geometry, "cylinder", {name: repr(float(size)) for name, size in sizes.items()}
        )
    else:
        import trimesh

        if isinstance(shape, coal.Convex):
            points = np.asarray(shape.points())
        elif isinstance(shape, coal.Box):
            points = trimesh.creation.box(2.0 * np.asarray(shape.halfSide)).vertices
        elif isinstance(shape, coal.Cylinder):
            points = trimesh.creation.cylinder(
                shape.radius, 2.0 * shape.halfLength, sections=32
            ).vertices
        else:
            ball = shape.radius * _AROUND * trimesh.creation.icosphere(subdivisions=1).vertices
            points = np.concatenate(
                [ball + np.array([0.0, 0.0, end]) for end in (-shape.halfLength, shape.halfLength)]
            )
        if thicker:
            around = thicker * _AROUND * trimesh.creation.icosphere(subdivisions=1).vertices
            points = (points[:, None] + around).reshape(-1, 3)
        compute_hull(points).export(file)
        ET.SubElement(
            geometry,
            "mesh",
            {"filename": f"file://{file.resolve()}", "tesseract:make_convex": "true"},
        )
        checking = ET.SubElement(link, "collision_checking")
        ET.SubElement(checking, "convex", name=link.attrib["name"])


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
