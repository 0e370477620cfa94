"""Reads joint friction, damping and springs of articulated objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.fields import JointSchema, NonNegative, Number
from vkc_pin.world.files.kinematic_tree import parse_numbers
from vkc_pin.world.files.xml import make_element_error, read_xml

__all__ = ["ObjectJointSchema", "Resistance", "read_resistances"]


@dataclass(frozen=True, kw_only=True)
class Resistance:
    """Passive forces of an object's joint, with the parameters of URDF and MuJoCo.

    Attributes:
        friction: Coulomb friction [N·m] or [N]; `friction` in URDF, `frictionloss` in MuJoCo.
        damping: Viscous damping coefficient [N·m·s/rad] or [N·s/m].
        stiffness: Stiffness of a spring that pulls the joint to `springref` [N·m/rad] or [N/m].
        springref: Rest position of the spring [rad] or [m]; outside the joint's limits if the
            spring is preloaded.
    """

    friction: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0
    springref: float = 0.0

    def force(self, position: Any, velocity: Any) -> Any:
        """Return the force or torque that overcomes the resistance [N], [N·m]; no friction at rest.

        stiffness · (position − springref) + damping · velocity + friction · sign(velocity)

        Args:
            position: Joint position, a number or an array [rad] or [m].
            velocity: Joint velocity, of the same shape [rad/s] or [m/s].
        """
        return (
            self.stiffness * (position - self.springref)
            + self.damping * velocity
            + self.friction * np.sign(velocity)
        )


class ObjectJointSchema(JointSchema):
    """Properties of an object's joint that a URDF lacks, and its resistance; see `Resistance`."""

    friction: NonNegative | None = None
    damping: NonNegative | None = None
    stiffness: NonNegative | None = None
    springref: Number | None = None


def read_resistances(
    document: Document,
    joints: Mapping[str, ObjectJointSchema],
    urdf: Path,
    text: str | None,
    names: Sequence[str],
) -> dict[str, Resistance]:
    """Return the resistance of each movable joint of an object.

    Values of the description take precedence over those of `<dynamics>` in the URDF. The default
    is 0.

    Args:
        document: The description.
        joints: Settings of the joints in the description; the joints exist.
        urdf: Path of the URDF.
        text: Text of the URDF, if it is part of the description.
        names: Names of the movable joints.
    """
    _, root = read_xml(urdf, "URDF", text)
    resistance = dict[str, Resistance]()
    for joint in root.findall("joint"):
        name, stated = joint.get("name", ""), dict[str, float]()
        if name not in names:
            continue
        for dynamics in joint.findall("dynamics"):
            for key in ("friction", "damping"):
                (stated[key],) = parse_numbers(urdf, dynamics, key, 1, default="0", where=name)
                if stated[key] < 0.0:
                    problem, got = "friction and damping must not be negative", stated[key]
                    field, expected = f"{name}: dynamics {key}", "0 or more"
                    raise make_element_error(
                        urdf, dynamics, problem, field=field, expected=expected, got=got
                    )
        given = joints.get(name, ObjectJointSchema())
        if given.springref is not None and given.stiffness is None:
            problem, expected = "springref without stiffness", "stiffness as well"
            raise document.make_error(
                ("joints", name, "springref"), problem, expected=expected, got=given.springref
            )
        described = given.model_dump(
            include={"friction", "damping", "stiffness", "springref"}, exclude_none=True
        )
        resistance[name] = Resistance(**{**stated, **described})
    return resistance
