"""Finds shapes around a whole hand, which keep its fingers from all that they could take hold of."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import triangulate

__all__ = ["find_envelopes", "remove_collision_shapes"]

_FEW = 3  # links that a shape has to be around, at least: palm and two fingers
_MOST = 0.5  # of the hand that is in it, at least: fingertips may reach out
_SLACK = 1e-3  # [m] by which a corner may lie beyond it


def find_envelopes(robot: Robot) -> dict[str, float]:
    """Return the links that are nothing but a shape around the hand → how much of the hand is in it, from 0 to 1.

    Such are links fixed to the tool frame that are not seen, while others there are, and in whose
    shapes most of the others is: safety boxes, made for programs that do not know where the fingers
    are.

    Args:
        robot: The robot; its hand is its `touch_links`, or else all links that are fixed to its
            tool frame.
    """
    joint = robot.model.frames[robot.model.getFrameId(robot.tool_frame)].parentJoint
    seen = {shape.link for shape in robot.file.shapes("visual")}
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
    found = dict[str, float]()
    for link in surfaces.keys() - seen if seen & surfaces.keys() else ():
        others = [corners[other] for other in hand if other != link]
        for _, sides in surfaces[link] if len(others) >= _FEW else ():
            within = float(np.mean([_inside(sides, points).mean() for points in others]))
            if within >= _MOST:
                found[link] = max(within, found.get(link, 0.0))
    return dict(sorted(found.items()))


def remove_collision_shapes(root: ElementTree.Element, links: Collection[str]) -> None:
    """Take what collides of some links out of a URDF."""
    for link in (element for element in root.findall("link") if element.get("name") in links):
        for shape in link.findall("collision"):
            link.remove(shape)


def _inside(faces: Floats, points: Floats) -> Floats:
    """Return which points, shape (n, 3), are in the convex solid of triangles, shape (m, 3, 3), as 0 or 1, shape (n,)."""
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, base = normals[lengths > 0.0] / lengths[lengths > 0.0, None], faces[lengths > 0.0, 0]
    normals *= np.sign(np.einsum("ij,ij->i", normals, base - faces.reshape(-1, 3).mean(axis=0)))[
        :, None
    ]
    beyond = (points @ normals.T - np.einsum("ij,ij->i", normals, base)).max(axis=1)
    return (beyond <= _SLACK).astype(float)
