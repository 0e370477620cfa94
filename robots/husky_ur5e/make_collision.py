"""Writes collision/*.stl from the visual geometry of husky_ur5e.urdf, and prints the table of README.md.

Run it from anywhere: python robots/husky_ur5e/make_collision.py [LINK ...]
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import trimesh

from vkc_pin.convexify import cut, outer_hull, solid_volume, visual_meshes, write_stl
from vkc_pin.robot_files import read_urdf

FOLDER = Path(__file__).resolve().parent
# Link → number of pieces, and the axis across which it is cut.
PIECES = {
    "ur_base_link_inertia": (1, (0, 0, 1)),
    "shoulder_link": (1, (0, 0, 1)),
    "upper_arm_link": (3, (1, 0, 0)),
    "forearm_link": (2, (1, 0, 0)),
    "wrist_1_link": (1, (0, 0, 1)),
    "wrist_2_link": (1, (0, 0, 1)),
    "wrist_3_link": (1, (0, 0, 1)),
    "gripper_link": (1, (0, 0, 1)),
}
# Links whose pieces are hulls of given visual elements. A finger's tip is a piece of its own: the hull of a whole finger
# would reach far into the opening between the pads.
FINGER = ((0, 1, 2), (3, 4))
GROUPS = {
    "base_link": ((0, 1, 2, 5, 6, 7, 8, 9, 10, 11), (3, 12, 14, 16, 18), (4, 13, 15, 17, 19)),  # body, left, right wheels
    "gripper_right_finger": FINGER,
    "gripper_left_finger": FINGER,
}
VERTICES = 40


def main() -> None:
    """Write the files and print one row of the table per link."""
    file = read_urdf(FOLDER / "husky_ur5e.urdf", {"airo_models": airo_models()})
    print("| link | pieces | corners | solid [l] | pieces' volume [l] | overhead |\n| --- | --- | --- | --- | --- | --- |")
    for link in sys.argv[1:] or (*PIECES, *GROUPS):
        meshes = visual_meshes(file, link)
        if link in GROUPS:
            points = [np.vstack([meshes[k].vertices for k in group]) for group in GROUPS[link]]
        else:
            count, axis = PIECES[link]
            points = cut(trimesh.util.concatenate(meshes), count, axis=axis)
        pieces = [outer_hull(piece, vertices=VERTICES) for piece in points]
        named = sum(f"package://husky_ur5e/collision/{link}_" in line for line in file.text.splitlines())
        if named != len(pieces):
            raise SystemExit(f"husky_ur5e.urdf names {named} pieces of {link}, not {len(pieces)}")
        for k, piece in enumerate(pieces):
            write_stl(piece, FOLDER / "collision" / f"{link}_{k}.stl")
        solid, union = solid_volume(meshes, pitch=0.004 if link == "base_link" else 0.001), solid_volume(pieces, pitch=0.002)
        corners, excess = ", ".join(str(len(piece.vertices)) for piece in pieces), 100 * (union / solid - 1)
        print(f"| `{link}` | {len(pieces)} | {corners} | {1e3 * solid:.3f} | {1e3 * union:.3f} | {excess:.0f} % |", flush=True)


def airo_models() -> Path:
    """Return the folder of the package that holds the meshes."""
    spec = importlib.util.find_spec("airo_models")
    if spec is None or spec.origin is None:
        raise SystemExit("pip install airo-models")
    return Path(spec.origin).parent


if __name__ == "__main__":
    main()
