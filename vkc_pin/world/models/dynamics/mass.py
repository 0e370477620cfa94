"""Sets the masses of objects and computes inertias of solids of uniform density."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from vkc_pin.world.files.hulls import compute_hull
from vkc_pin.world.models.shapes import triangulate

__all__ = ["compute_mass", "compute_solid_inertia", "set_mass"]


def compute_mass(model: pin.Model) -> float:
    """Return the total mass of all links of a model [kg]."""
    return float(sum(inertia.mass for inertia in model.inertias))


def set_mass(model: pin.Model, collision: pin.GeometryModel, mass: float) -> None:
    """Scale the inertias of a model to a given total mass.

    If the model has no mass, its collision shapes are assumed to be solids of uniform density.
    Without collision shapes, all mass is placed at the origin of the base link.

    Args:
        model: Changed in place.
        collision: Collision shapes of the model.
        mass: Total mass, 0 or more [kg].
    """
    if not compute_mass(model) > 0.0:
        for shape in collision.geometryObjects:
            model.inertias[shape.parentJoint] += shape.placement.act(compute_solid_inertia(shape))
        if not compute_mass(model) > 0.0:
            model.inertias[0] = pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3)))
    factor = mass / compute_mass(model)
    for joint, inertia in enumerate(model.inertias):
        model.inertias[joint] = pin.Inertia(
            factor * inertia.mass, inertia.lever, factor * np.asarray(inertia.inertia)
        )


def compute_solid_inertia(shape: pin.GeometryObject, density: float = 1.0) -> pin.Inertia:
    """Return the inertia of a convex shape of uniform `density` [kg/m³], in its own frame."""
    solid = compute_hull(triangulate(shape.geometry)[0])
    solid.density = density
    return pin.Inertia(
        float(solid.mass), np.asarray(solid.center_mass), np.asarray(solid.moment_inertia)
    )
