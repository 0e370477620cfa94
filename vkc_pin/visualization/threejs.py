"""Defines three.js elements that meshcat-python lacks: normals, ghosts, and shadows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import meshcat.geometry as g
import numpy as np
from meshcat.path import Path

from vkc_pin.utils.arrays import Floats
from vkc_pin.visualization.triangles import Solid

__all__ = ["Ghost", "Sun", "Triangles", "Unshadow", "add_node", "encode_colour", "make_material"]

_GHOST_OPACITY = 0.30


class Triangles(g.TriangularMeshGeometry):
    """Triangles with the normals of a `Solid`."""

    def __init__(self, solid: Solid) -> None:
        super().__init__(solid.vertices, solid.faces)
        self.normals = solid.normals

    def lower(self, object_data: dict[str, Any]) -> dict[str, Any]:
        """Return three.js JSON."""
        data: dict[str, Any] = super().lower(object_data)
        data["data"]["attributes"]["normal"] = g.pack_numpy_array(self.normals.T)
        return data


class Ghost(g.Object):
    """A translucent body without visible back faces: it is drawn into the depth buffer first."""

    def __init__(self, solid: Solid, colour: Sequence[float]) -> None:
        flat = g.MeshLambertMaterial(
            color=encode_colour(colour), opacity=_GHOST_OPACITY, transparent=True, side=2
        )
        super().__init__(Triangles(solid), flat)
        self.depth = g.MeshBasicMaterial(transparent=True, side=2, colorWrite=False)

    def lower(self) -> dict[str, Any]:
        """Return three.js JSON."""
        data: dict[str, Any] = {
            "metadata": {"version": 4.5, "type": "Object"},
            "geometries": [],
            "materials": [],
        }
        self.geometry.lower_in_object(data)
        children = []
        for order, layer in enumerate((self.depth, self.material)):
            layer.lower_in_object(data)
            mesh = {
                "type": "Mesh",
                "geometry": self.geometry.uuid,
                "material": layer.uuid,
                "renderOrder": order + 1,
            }
            children.append({"uuid": f"{self.uuid}-{order}", **mesh})
        data["object"] = {"uuid": self.uuid, "type": "Group", "children": children}
        return data


class Sun(g.Object):
    """A distant light that casts shadows over a room.

    Args:
        centre: Centre of the room, shape (3,) [m].
        reach: Radius of the room [m].
        camera: From the camera's target to the camera, shape (3,): the light comes from the left of
            there, and from above.
    """

    def __init__(self, centre: Floats, reach: float, camera: Floats) -> None:
        g.SceneElement.__init__(self)
        towards = np.array([camera[0], camera[1], 0.0]) / max(
            1e-9, float(np.hypot(camera[0], camera[1]))
        )
        left = np.array([towards[1], -towards[0], 0.0])
        self.position = centre + 20.0 * (
            0.35 * towards + 0.40 * left + 0.85 * np.array([0.0, 0.0, 1.0])
        )
        self.reach = reach + 2.0

    def lower(self) -> dict[str, Any]:
        """Return three.js JSON."""
        matrix = np.eye(4)
        matrix[:3, 3] = self.position
        size = self.reach + float(np.linalg.norm(self.position[:2])) * 0.1
        box = {
            "left": -size,
            "right": size,
            "top": size,
            "bottom": -size,
            "near": 1.0,
            "far": 60.0,
        }
        shadow = {"bias": -0.0004, "normalBias": 0.02, "radius": 2.5, "mapSize": [2048, 2048]}
        camera = {"uuid": f"{self.uuid}-camera", "type": "OrthographicCamera", "zoom": 1.0, **box}
        light = {"uuid": self.uuid, "type": "DirectionalLight", "color": 0xFFFFFF, "intensity": 0.5}
        return {
            "metadata": {"version": 4.5, "type": "Object"},
            "geometries": [],
            "materials": [],
            "object": {
                **light,
                "matrix": matrix.T.ravel().tolist(),
                "shadow": {**shadow, "camera": camera},
            },
        }


class Unshadow:
    """A command that disables the shadow at `path`; meshcat's SetProperty lowers names."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def lower(self) -> dict[str, Any]:
        """Return the command as it is sent."""
        where = self.path.append("<object>").lower()
        return {"type": "set_property", "path": where, "property": "castShadow", "value": False}


def make_material(
    colour: Sequence[float], opacity: float = 1.0, *, one_sided: bool = False
) -> g.Material:
    """Make a slightly shiny material; translucent ones do not write to the depth buffer."""
    options = {"shininess": 25, "specular": 0x1A1A1A, "side": 0 if one_sided else 2}
    return g.MeshPhongMaterial(
        color=encode_colour(colour), opacity=opacity, depthWrite=opacity >= 1.0, **options
    )


def encode_colour(colour: Sequence[float]) -> int:
    """Encode red, green and blue in [0, 1] as one integer."""
    red, green, blue = (round(255.0 * min(1.0, max(0.0, float(c)))) for c in colour[:3])
    return (red << 16) + (green << 8) + blue


def add_node(taken: set[str], above: str, *names: str) -> str:
    """Return the path of a new node in the viewer's tree, and add it to `taken`.

    Invalid characters become "_", and "_" is appended until the path is unique.
    """
    path = "/".join([above, *(re.sub(r"[^\w.\-]", "_", name) for name in names)])
    while path in taken:
        path += "_"
    taken.add(path)
    return path
