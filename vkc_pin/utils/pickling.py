"""Lets Python pickle and copy what scenes consist of: read-only dictionaries and shapes."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, TypeVar

import coal
import pinocchio as pin

K = TypeVar("K")
V = TypeVar("V")


def freeze(values: Mapping[K, V]) -> Mapping[K, V]:
    """Return a read-only copy of a dictionary."""
    return MappingProxyType(dict(values))


def _reduce_dictionary(values: MappingProxyType[Any, Any]) -> tuple[Any, ...]:
    return freeze, (dict(values),)


def _reduce_shape(shape: pin.GeometryObject) -> tuple[Any, ...]:
    """Pickle a shape in a model: Pinocchio 4.1 restores models, but no single shapes.

    It restores no classes of Python; these come with the shape.
    """
    if not type(shape.geometry).__module__.startswith("coal"):
        whole = pin.GeometryObject(shape)
        own = shape.geometry
        whole.geometry = coal.Sphere(1.0)
        return _restore_own_shape, (whole, own)
    model = pin.GeometryModel()
    model.addGeometryObject(shape)
    return _restore_shape, (model,)


def _restore_shape(model: pin.GeometryModel) -> pin.GeometryObject:
    return pin.GeometryObject(model.geometryObjects[0])


def _restore_own_shape(shape: pin.GeometryObject, geometry: Any) -> pin.GeometryObject:
    whole = pin.GeometryObject(shape)
    whole.geometry = geometry
    return whole


copyreg.pickle(MappingProxyType, _reduce_dictionary)
copyreg.pickle(pin.GeometryObject, _reduce_shape)
