"""Writes a robot's collision/*.stl from its visual geometry, and prints the README's table.

Usage: python tools/make_collision.py robots/husky_ur5e [LINK ...]

A planner's time grows with the number of pieces and their corners. So each link is cut by parallel
planes into as few slabs as wanted, at the places where the hulls' volume becomes smallest, and the
hull of each slab is replaced by a polytope of few corners that still contains it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from cutting import cut, solid_volume
from numpy.typing import NDArray

from vkc_pin.world.files.hulls import compute_outer_hull
from vkc_pin.world.files.urdf import UrdfFile, read_urdf
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.models.robot_schema import find_python_packages, read_robot

CORNERS = 40  # of a piece, at most


class Link(NamedTuple):
    """How the geometry of a link becomes pieces, and how finely its volume is measured."""

    pieces: int = 1
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)  # normal of the planes that cut it
    groups: tuple[tuple[int, ...], ...] = ()  # the visual elements of each piece, instead of a cut
    pitch: float = 0.001  # [m]


# A finger's tip is a piece of its own: the hull of a whole finger would reach far into the opening
# between the pads.
_FINGER = Link(groups=((0, 1, 2), (3, 4)))
_BODY = (0, 1, 2, 5, 6, 7, 8, 9, 10, 11)
_LEFT_WHEELS = (3, 12, 14, 16, 18)
_RIGHT_WHEELS = (4, 13, 15, 17, 19)
ROBOTS = {
    "husky_ur5e": {
        "ur_base_link_inertia": Link(),
        "shoulder_link": Link(),
        "upper_arm_link": Link(3, (1.0, 0.0, 0.0)),
        "forearm_link": Link(2, (1.0, 0.0, 0.0)),
        "wrist_1_link": Link(),
        "wrist_2_link": Link(),
        "wrist_3_link": Link(),
        "gripper_link": Link(),
        "base_link": Link(groups=(_BODY, _LEFT_WHEELS, _RIGHT_WHEELS), pitch=0.004),
        "gripper_right_finger": _FINGER,
        "gripper_left_finger": _FINGER,
    }
}


def main() -> None:
    """Write the files and print one row of the table per link."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robot", type=Path, help=f"folder of a robot: {', '.join(ROBOTS)}")
    parser.add_argument("links", nargs="*", metavar="LINK", help="only these links")
    given = parser.parse_args()
    folder = given.robot.resolve()
    if folder.name not in ROBOTS:
        parser.error(f"there are no settings for '{folder.name}'")
    links = ROBOTS[folder.name]
    if unknown := [link for link in given.links if link not in links]:
        parser.error(f"there are no settings for link '{unknown[0]}'")
    settings, document = read_robot(folder / "robot.yaml")
    file = read_urdf(folder / settings.urdf, find_python_packages(settings.packages, document))
    print(
        "| link | pieces | corners | solid [l] | pieces' volume [l] | overhead |\n"
        "| --- | --- | --- | --- | --- | --- |"
    )
    for link in given.links or links:
        meshes = visual_meshes(file, link)
        pieces = convex_pieces(meshes, links[link])
        named = sum(
            f"package://{folder.name}/collision/{link}_" in line for line in file.text.splitlines()
        )
        if named != len(pieces):
            raise SystemExit(f"{file.path.name} names {named} pieces of {link}, not {len(pieces)}")
        for k, piece in enumerate(pieces):
            write_atomically(
                folder / "collision" / f"{link}_{k}.stl", piece.export(file_type="stl")
            )
        solid = solid_volume(meshes, pitch=links[link].pitch)
        union = solid_volume(pieces, pitch=0.002)
        corners = ", ".join(str(len(piece.vertices)) for piece in pieces)
        excess = 100 * (union / solid - 1)
        print(
            f"| `{link}` | {len(pieces)} | {corners} | {1e3 * solid:.3f} "
            f"| {1e3 * union:.3f} | {excess:.0f} % |",
            flush=True,
        )


def visual_meshes(file: UrdfFile, link: str) -> list[trimesh.Trimesh]:
    """Return the visual geometry of a link, one mesh per element, in the link's frame, [m]."""
    return [shape.make_mesh() for shape in file.read_shapes("visual") if shape.link == link]


def convex_pieces(meshes: list[trimesh.Trimesh], link: Link) -> list[trimesh.Trimesh]:
    """Return the pieces of a link; every point of `meshes` lies in one of them."""
    points: list[NDArray[np.float64]]
    if link.groups:
        points = [np.vstack([meshes[k].vertices for k in group]) for group in link.groups]
    else:
        points = cut(trimesh.util.concatenate(meshes), link.pieces, axis=link.axis)
    return [compute_outer_hull(piece, vertices=CORNERS) for piece in points]


if __name__ == "__main__":
    main()
