"""Tests masses of objects: stated, scaled, or computed from shapes."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.objects import load_object_text

from vkc_pin.errors import InputError
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.object_file import load_object

BOX = '<collision><origin xyz="0 0 0.2"/><geometry><box size="0.2 0.4 0.6"/></geometry></collision>'


def load_block(contents: str, more: str = "mass: 6.0") -> ArticulatedObject:
    urdf = f'<robot name="t"><link name="block">{contents}</link></robot>'
    return load_object_text(urdf, f"urdf: thing.urdf\nfree: true\n{more}\nattachments: []\n")


def test_masses_of_the_urdf_are_scaled_uniformly() -> None:
    plain = load_object("broom")
    heavy = load_object(
        {"urdf": "broom.urdf", "free": True, "mass": 6.5, "attachments": []},
        folder="scenes/objects",
    )
    assert plain.mass == pytest.approx(0.65)
    assert heavy.mass == pytest.approx(6.5)
    for before, after in zip(plain.model.inertias, heavy.model.inertias, strict=True):
        np.testing.assert_allclose(after.lever, before.lever)
        np.testing.assert_allclose(after.inertia, 10.0 * np.asarray(before.inertia), rtol=1e-12)


def test_without_masses_shapes_are_solids() -> None:
    (inertia,) = load_block(BOX).model.inertias
    np.testing.assert_allclose(inertia.lever, [0.0, 0.0, 0.2], atol=1e-12)
    moments = 6.0 / 12.0 * np.array([0.4**2 + 0.6**2, 0.2**2 + 0.6**2, 0.2**2 + 0.4**2])
    np.testing.assert_allclose(inertia.inertia, np.diag(moments), atol=1e-9)


def test_without_shapes_the_mass_is_at_the_origin() -> None:
    (inertia,) = load_block("").model.inertias
    assert inertia.mass == 6.0
    assert not np.asarray(inertia.lever).any()


def test_mass_is_zero_by_default_and_may_be_zero() -> None:
    assert load_block(BOX, "").mass == 0.0
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    inertial = f'<inertial><mass value="2"/>{inertia}</inertial>'
    assert load_block(BOX + inertial, "").mass == 2.0
    assert load_block(BOX + inertial, "mass: 0").mass == 0.0


@pytest.mark.parametrize("value", ["-1.0", "heavy", ".inf"])
def test_invalid_masses_raise(value: str) -> None:
    with pytest.raises(InputError) as caught:
        load_block("", f"mass: {value}")
    assert (caught.value.field, caught.value.line) == ("mass", 3)


def test_fixed_objects_cannot_have_a_mass() -> None:
    with pytest.raises(InputError, match="applies to free objects only") as caught:
        load_object_text(
            '<robot name="t"><link name="a"/></robot>',
            "urdf: thing.urdf\nmass: 3\nattachments: []\n",
        )
    assert (caught.value.field, caught.value.line) == ("mass", 2)
