"""Tests the friction, damping and springs of joints, and their forces."""

from __future__ import annotations

import pytest
from helpers.objects import URDF, load_object_text
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.errors import InputError
from vkc_pin.world.models.dynamics import Resistance

TAIL = "attachments: []\n"
REAL = st.floats(-1e3, 1e3)


def add_dynamics(attributes: str) -> str:
    return URDF.replace('<axis xyz="0 0 1"/>', f'<axis xyz="0 0 1"/><dynamics {attributes}/>')


def test_resistance_is_zero_by_default() -> None:
    item = load_object_text(URDF, f"urdf: thing.urdf\n{TAIL}")
    assert item.resistance == {"hinge": Resistance(), "knob": Resistance()}
    assert Resistance().force(0.7, -0.3) == 0.0


def test_the_description_overrides_the_urdf_per_value() -> None:
    urdf = add_dynamics('friction="2" damping="0.5"')
    plain = load_object_text(urdf, f"urdf: thing.urdf\n{TAIL}").resistance["hinge"]
    assert plain == Resistance(friction=2.0, damping=0.5)
    text = (
        f"urdf: thing.urdf\njoints: {{hinge: {{friction: 0, stiffness: 4, springref: -2}}}}\n{TAIL}"
    )
    assert load_object_text(urdf, text).resistance["hinge"] == Resistance(
        friction=0.0, damping=0.5, stiffness=4.0, springref=-2.0
    )


@given(
    REAL,
    REAL,
    st.builds(
        Resistance,
        friction=REAL.map(abs),
        damping=REAL.map(abs),
        stiffness=REAL.map(abs),
        springref=REAL,
    ),
)
def test_friction_and_damping_dissipate_and_springs_store_energy(
    position: float, velocity: float, resistance: Resistance
) -> None:
    passive = Resistance(stiffness=resistance.stiffness, springref=resistance.springref)
    dissipated = (
        resistance.force(position, velocity) - passive.force(position, velocity)
    ) * velocity
    assert dissipated == pytest.approx(
        resistance.friction * abs(velocity) + resistance.damping * velocity**2, rel=1e-6, abs=1e-6
    )
    step = 1e-3
    energy = [
        resistance.stiffness / 2.0 * (position + sign * step - resistance.springref) ** 2
        for sign in (-1.0, 1.0)
    ]
    gradient = (energy[1] - energy[0]) / (2.0 * step)
    assert passive.force(position, velocity) == pytest.approx(gradient, rel=1e-6, abs=1e-3)


@pytest.mark.parametrize(
    ("fields", "field", "problem"),
    [
        ("friction: -1", "joints.hinge.friction", "friction"),
        ("damping: fast", "joints.hinge.damping", "damping"),
        ("stiffness: .nan", "joints.hinge.stiffness", "stiffness"),
        ("springref: 1.0", "joints.hinge.springref", "springref without stiffness"),
    ],
)
def test_invalid_values_raise_with_their_line(fields: str, field: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        load_object_text(URDF, f"urdf: thing.urdf\njoints:\n  hinge:\n    {fields}\n{TAIL}")
    assert (caught.value.field, caught.value.line) == (field, 4)


@pytest.mark.parametrize(
    "attributes", ['friction="-1"', 'damping="much"', 'damping="1 2"', 'friction="inf"']
)
def test_invalid_urdf_dynamics_raise_with_their_line(attributes: str) -> None:
    with pytest.raises(InputError) as caught:
        load_object_text(
            add_dynamics(attributes).replace("<link", "\n<link"), f"urdf: thing.urdf\n{TAIL}"
        )
    assert caught.value.line == 4
    assert caught.value.field == f"hinge: dynamics {attributes.partition('=')[0]}"
    assert str(caught.value.file).endswith("thing.urdf")
