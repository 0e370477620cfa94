"""Makes few, small, tight convex pieces that contain the geometry of a robot's links; run by hand, once per robot.

A planner's time grows with the number of pieces and their vertices. So each link is cut by parallel planes into as few
slabs as wanted, at the places where the hulls' volume becomes smallest, and the hull of each slab is replaced by a
polytope of few vertices that still contains it: an intersection of half-spaces that all touch the hull. Nothing here
runs when a robot is loaded.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vkc_pin.errors import UnknownNameError
from vkc_pin.robot_files import RobotFile

if TYPE_CHECKING:
    import trimesh

__all__ = ["cut", "outer_hull", "solid_volume", "visual_meshes", "write_stl"]


def outer_hull(points: ArrayLike, *, vertices: int = 40, gap: float = 5e-4) -> trimesh.Trimesh:
    """Return a convex polytope of few vertices that contains `points`.

    It starts as the box along the principal axes of the hull and is cut, again and again, by the plane that touches
    the hull and lies deepest below one of the polytope's corners.

    Args:
        points: Shape (n, 3), [m].
        vertices: The largest number of its vertices.
        gap: No cut takes away less than this [m]: where it ends before `vertices` is reached.

    Returns:
        The polytope; every point lies in it (up to rounding, 1e-9 m).
    """
    import trimesh

    hull = trimesh.convex.convex_hull(np.asarray(points, float))
    corners = np.asarray(hull.vertices)
    normals = _directions(hull)
    offsets = (corners @ normals.T).max(axis=0)
    axes = np.linalg.eigh(np.cov(corners.T))[1].T
    best = None
    for frame in (np.eye(3), axes):
        box = np.vstack([frame, -frame])
        chosen_normals, chosen_offsets = box, (corners @ box.T).max(axis=0)
        polytope = _intersect(chosen_normals, chosen_offsets, corners)
        for _ in range(4 * vertices):
            depth = (np.asarray(polytope.vertices) @ normals.T).max(axis=0) - offsets
            order = np.argsort(-depth)[:12]
            trials = []
            for k in order[depth[order] > gap]:
                planes = np.vstack([chosen_normals, normals[k]]), np.append(chosen_offsets, offsets[k])
                trial = _intersect(*planes, corners)
                if len(trial.vertices) <= vertices:
                    trials.append((trial, planes))
            if not trials:
                break
            polytope, (chosen_normals, chosen_offsets) = min(trials, key=lambda trial: trial[0].volume)
        if best is None or polytope.volume < best.volume:
            best = polytope
    assert best is not None
    return best


def cut(mesh: trimesh.Trimesh, pieces: int, *, axis: ArrayLike, steps: int = 24) -> list[NDArray[np.float64]]:
    """Cut `mesh` by `pieces` − 1 planes across `axis` so that the volume of the pieces' hulls is smallest.

    Args:
        mesh: Any triangles; they need not be closed.
        pieces: At least 1.
        axis: Normal of the planes, shape (3,).
        steps: Number of places along the mesh where a plane may lie.

    Returns:
        For each piece its points, shape (n, 3), the corners of the cut included: the pieces' hulls contain the mesh.
    """
    direction = np.asarray(axis, float) / np.linalg.norm(np.asarray(axis, float))
    if pieces == 1:
        return [np.asarray(mesh.vertices)]
    along = np.asarray(mesh.vertices) @ direction
    places = np.linspace(along.min(), along.max(), steps + 1)
    points: dict[tuple[int, int], NDArray[np.float64]] = {}
    volumes: dict[tuple[int, int], float] = {}
    for low, high in itertools.combinations(range(steps + 1), 2):
        slab = _slab(mesh, direction, places[low], places[high])
        points[low, high], volumes[low, high] = slab, _hull_volume(slab)
    bounds = [(0, *inner, steps) for inner in itertools.combinations(range(1, steps), pieces - 1)]
    best = min(bounds, key=lambda cuts: sum(volumes[pair] for pair in itertools.pairwise(cuts)))
    return [points[pair] for pair in itertools.pairwise(best)]


def solid_volume(meshes: Sequence[trimesh.Trimesh], *, pitch: float = 0.001) -> float:
    """Return the volume [m³] of the solid whose skin `meshes` are.

    A maker's mesh is an open skin with loose screws: it has no volume of its own. So cells of width `pitch` are counted
    that have skin on both sides along at least two of the three axes, and half of those that the skin itself fills.
    """
    low = np.min([mesh.bounds[0] for mesh in meshes], axis=0) - 2.0 * pitch
    size = np.ceil((np.max([mesh.bounds[1] for mesh in meshes], axis=0) - low) / pitch).astype(int) + 3
    skin = np.zeros(size, bool)
    for mesh in meshes:
        points = mesh.subdivide_to_size(0.7 * pitch, max_iter=20).vertices
        skin[tuple(np.floor((points - low) / pitch).astype(int).T)] = True
    enclosed = np.zeros(size, int)
    for axis in range(3):
        before = np.logical_or.accumulate(skin, axis=axis)
        after = np.flip(np.logical_or.accumulate(np.flip(skin, axis), axis=axis), axis)
        enclosed += before & after
    inside = (enclosed >= 2) & ~skin
    return float((inside.sum() + 0.5 * skin.sum()) * pitch**3)


def visual_meshes(file: RobotFile, link: str) -> list[trimesh.Trimesh]:
    """Return the visual geometry of a link of a robot, one mesh per element, in the link's frame, [m].

    Raises:
        InputError: The robot or a mesh of it cannot be read.
        UnknownNameError: The robot has no such link.
    """
    shapes = file.shapes("visual")
    found = [shape.mesh() for shape in shapes if shape.link == link]
    if not found:
        raise UnknownNameError("link with visual geometry", link, dict.fromkeys(shape.link for shape in shapes), file=file.path)
    return found


def _directions(hull: trimesh.Trimesh, count: int = 400) -> NDArray[np.float64]:
    """Return the normals worth trying: those of the hull's faces, and some spread evenly over the sphere."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    spread = np.stack([np.sqrt(1.0 - z**2) * np.cos(turn), np.sqrt(1.0 - z**2) * np.sin(turn), z], axis=1)
    _, first = np.unique(np.asarray(hull.face_normals).round(2), axis=0, return_index=True)
    return np.vstack([np.asarray(hull.face_normals)[np.sort(first)], spread])


def _intersect(normals: NDArray[Any], offsets: NDArray[Any], inner: NDArray[Any]) -> trimesh.Trimesh:
    """Return the polytope {x: normals·x ≤ offsets}; `inner` are points in it."""
    import trimesh
    from scipy.spatial import HalfspaceIntersection

    centre = inner.mean(axis=0)
    corners = HalfspaceIntersection(np.column_stack([normals, -offsets]), centre).intersections
    corners = corners[np.isfinite(corners).all(axis=1)]
    _, first = np.unique(corners.round(7), axis=0, return_index=True)
    return trimesh.convex.convex_hull(corners[np.sort(first)])


def _slab(mesh: trimesh.Trimesh, direction: NDArray[Any], low: float, high: float) -> NDArray[np.float64]:
    """Return the points of `mesh` between two planes, with those where its edges cross them."""
    vertices, edges = np.asarray(mesh.vertices), np.asarray(mesh.edges_unique)
    along = vertices @ direction
    parts = [vertices[(along >= low - 1e-12) & (along <= high + 1e-12)]]
    start, end = along[edges[:, 0]], along[edges[:, 1]]
    for place in (low, high):
        crossing = (start - place) * (end - place) < 0.0
        share = ((place - start[crossing]) / (end[crossing] - start[crossing]))[:, None]
        parts.append(vertices[edges[crossing, 0]] * (1.0 - share) + vertices[edges[crossing, 1]] * share)
    return np.vstack(parts)


def _hull_volume(points: NDArray[Any]) -> float:
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):
        return 0.0


def write_stl(mesh: trimesh.Trimesh, path: Path) -> None:
    """Write `mesh` as a binary STL file, at once: a reader never sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".part")
    draft.write_bytes(mesh.export(file_type="stl"))
    draft.replace(path)
