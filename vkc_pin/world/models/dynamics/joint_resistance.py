"""What the joints of objects resist with: friction, damping, and springs such as those of door closers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.fields import JointSchema, NotNegative, Number
from vkc_pin.world.files.kinematic_tree import numbers_of
from vkc_pin.world.files.xml import line_of, read_xml

__all__ = ["ObjectJointSchema", "Resistance", "read_resistances"]


@dataclass(frozen=True, kw_only=True)
class Resistance:
    """What a joint of an object resists with, in the terms of URDF and MuJoCo; nothing, where nobody says anything.

    Attributes:
        friction: Coulomb's, against any motion, however slow [N·m] or [N]; URDF's `friction`,
            MuJoCo's `frictionloss`.
        damping: Against the velocity [N·m·s/rad] or [N·s/m].
        stiffness: Of a spring that pulls the joint to `springref` [N·m/rad] or [N/m].
        springref: Where the spring is relaxed [rad] or [m]; far outside the joint's limits for one
            that is wound up.
    """

    friction: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0
    springref: float = 0.0

    def force(self, position: Any, velocity: Any) -> Any:
        """Return what must be applied to the joint beyond its inertia and weight, [N·m] or [N]; friction is 0 at rest.

        stiffness · (position − springref) + damping · velocity + friction · sign(velocity)

        Args:
            position: [rad] or [m], a number or an array.
            velocity: [rad/s] or [m/s], of the same shape.
        """
        return (
            self.stiffness * (position - self.springref)
            + self.damping * velocity
            + self.friction * np.sign(velocity)
        )


class ObjectJointSchema(JointSchema):
    """What a URDF cannot say about a joint of an object, and what it resists with; see `Resistance`."""

    friction: NotNegative | None = None
    damping: NotNegative | None = None
    stiffness: NotNegative | None = None
    springref: Number | None = None


def read_resistances(
    document: Document,
    joints: Mapping[str, ObjectJointSchema],
    urdf: Path,
    text: str | None,
    names: Sequence[str],
) -> dict[str, Resistance]:
    """Return what each joint of an object resists with: as its description says, else as its URDF's `<dynamics>` does, else 0.

    Args:
        document: The description.
        joints: What it says about joints, which exist.
        urdf: The URDF, which was read before.
        text: What it says, where that stands elsewhere.
        names: Of the joints that move.

    Raises:
        InputError: A number of the URDF is none, or negative, or a spring has a place but no
            stiffness.
    """
    _, root = read_xml(urdf, "URDF", text)
    found = dict[str, Resistance]()
    for joint in root.findall("joint"):
        name, stated = joint.get("name", ""), dict[str, float]()
        if name not in names:
            continue
        for dynamics in joint.findall("dynamics"):
            for key in ("friction", "damping"):
                (stated[key],) = numbers_of(urdf, dynamics, key, 1, default="0", where=name)
                if stated[key] < 0.0:
                    problem, field, line = (
                        "a joint cannot drive itself",
                        f"{name}: dynamics {key}",
                        line_of(dynamics),
                    )
                    raise InputError(
                        problem,
                        file=urdf,
                        line=line,
                        field=field,
                        expected="0 or more",
                        got=stated[key],
                    )
        given = joints.get(name, ObjectJointSchema())
        if given.springref is not None and given.stiffness is None:
            problem, expected = "a spring without stiffness", "stiffness beside it"
            raise document.error(
                ("joints", name, "springref"), problem, expected=expected, got=given.springref
            )
        own = given.model_dump(
            include={"friction", "damping", "stiffness", "springref"}, exclude_none=True
        )
        found[name] = Resistance(**{**stated, **own})
    return found
