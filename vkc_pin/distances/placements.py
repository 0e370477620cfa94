"""Placements as twelve numbers: the columns of the rotation, then the translation [m]."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.lib.stride_tricks import as_strided

from vkc_pin.arrays import Floats

__all__ = ["ShapePlacements", "columns_of"]

_NUMBERS = 12


def columns_of(placements: Sequence[pin.SE3]) -> Floats:
    """Return placements as numbers, shape (n, 12): the columns of each rotation, then the translation [m]."""
    columns = np.empty((len(placements), _NUMBERS))
    for row, placement in zip(columns, placements, strict=True):
        row[:9], row[9:] = placement.rotation.T.ravel(), placement.translation
    return columns


class ShapePlacements:
    """Where the shapes of a model are, at one configuration after the other.

    Args:
        model: The model.
        geometry: The shapes on its joints, M of them.
    """

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        self._model, self._geometry = model, geometry
        self._data, self._placed = model.createData(), pin.GeometryData(geometry)
        self._numbers = _memory(self._placed.oMg)

    def at(self, q: Floats) -> Floats:
        """Return the placements in the world at Pinocchio's configurations, shape (W, nq): shape (W, M, 12), see `columns_of`."""
        found = np.empty((len(q), len(self._placed.oMg), _NUMBERS))
        for row, configuration in zip(found, q, strict=True):
            pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._placed, configuration)
            row[:] = columns_of(self._placed.oMg) if self._numbers is None else self._numbers
        return found


def _memory(placements: pin.StdVec_SE3) -> Floats | None:
    """Return the memory of Pinocchio's placements as an array, shape (n, 12); None if they lie otherwise than they do so far.

    To read them one by one takes ten times as long as to compute them.
    """
    if not len(placements):
        return np.empty((0, _NUMBERS))
    size, first = np.dtype(float).itemsize, placements[0].rotation
    places = [(placed.rotation.ctypes.data, placed.translation.ctypes.data) for placed in placements]
    begins = [first.ctypes.data + _NUMBERS * size * k for k in range(len(places))]
    expected = [(begin, begin + 9 * size) for begin in begins]
    if places != expected or first.strides != (size, 3 * size):
        return None
    return as_strided(first, (len(placements), _NUMBERS), (_NUMBERS * size, size), writeable=False)
