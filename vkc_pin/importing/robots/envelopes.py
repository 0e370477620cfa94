"""Finds collision shapes that enclose a whole hand, so that its fingers could not grasp."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import triangulate

__all__ = ["find_envelopes", "remove_collision_shapes"]

_MIN_LINKS = 3  # smallest number of links of the hand: palm and two fingers
_MIN_FRACTION = 0.5  # smallest enclosed fraction of the hand: fingertips may protrude
_SLACK = 1e-3  # [m] by which an enclosed vertex may lie outside


def find_envelopes(robot: Robot) -> dict[str, float]:
    """Map each link that merely encloses the hand to the enclosed fraction of the hand.

    Such links are fixed to the tool frame, have no visual shape although other links of the hand
    have one, and enclose most of the hand. They are safety boxes for programs that do not know the
    fingers.
    """
    joint = robot.model.frames[robot.model.getFrameId(robot.tool_frame)].parentJoint
    visible = {shape.link for shape in robot.file.read_shapes("visual")}
    surfaces: dict[str, list[tuple[Floats, Floats]]] = {}
    for k, shape in enumerate(robot.collision.geometryObjects):
        if shape.parentJoint == joint:
            points, faces = triangulate(shape.geometry)
            placed = np.asarray(
                points @ shape.placement.rotation.T + shape.placement.translation, float
            )
            surfaces.setdefault(robot.link_of(k), []).append((placed, placed[faces]))
    corners = {link: np.vstack([points for points, _ in parts]) for link, parts in surfaces.items()}
    hand = [link for link in corners if link in (robot.touch_links or corners)]
    envelopes = dict[str, float]()
    for link in surfaces.keys() - visible if visible & surfaces.keys() else ():
        others = [corners[other] for other in hand if other != link]
        for _, sides in surfaces[link] if len(others) >= _MIN_LINKS else ():
            fraction = float(np.mean([_check_inside(sides, points).mean() for points in others]))
            if fraction >= _MIN_FRACTION:
                envelopes[link] = max(fraction, envelopes.get(link, 0.0))
    return dict(sorted(envelopes.items()))


def remove_collision_shapes(root: ElementTree.Element, links: Collection[str]) -> None:
    """Remove the collision shapes of some links from a URDF."""
    for link in (element for element in root.findall("link") if element.get("name") in links):
        for shape in link.findall("collision"):
            link.remove(shape)


def _check_inside(faces: Floats, points: Floats) -> Floats:
    """Return 1 for points, shape (n, 3), inside a convex mesh, shape (m, 3, 3), else 0: (n,)."""
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, base = normals[lengths > 0.0] / lengths[lengths > 0.0, None], faces[lengths > 0.0, 0]
    normals *= np.sign(np.einsum("ij,ij->i", normals, base - faces.reshape(-1, 3).mean(axis=0)))[
        :, None
    ]
    distances = (points @ normals.T - np.einsum("ij,ij->i", normals, base)).max(axis=1)
    return (distances <= _SLACK).astype(float)
