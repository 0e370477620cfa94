"""Defines joint resistances and masses of objects, and torque limits of robots."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.fields import JointSchema, NonNegative, Number
from vkc_pin.world.files.hulls import compute_hull
from vkc_pin.world.files.kinematic_tree import parse_numbers
from vkc_pin.world.files.xml import make_element_error, read_xml
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.shapes import triangulate

UNLIMITED = 1e300
"""Effort limits of Pinocchio above this mean that there is no limit."""
_SAMPLES = 200  # random configurations in which a motor must hold the arm


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
    resistances = dict[str, Resistance]()
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        if name not in names:
            continue
        values = _read_urdf_resistance(urdf, joint)
        described = joints.get(name, ObjectJointSchema())
        if described.springref is not None and described.stiffness is None:
            raise document.make_error(
                ("joints", name, "springref"),
                "springref without stiffness",
                expected="stiffness as well",
                got=described.springref,
            )
        keys = {"friction", "damping", "stiffness", "springref"}
        values.update(described.model_dump(include=keys, exclude_none=True))
        resistances[name] = Resistance(**values)
    return resistances


def _read_urdf_resistance(urdf: Path, joint: ElementTree.Element) -> dict[str, float]:
    """Return the friction and damping that a URDF states for a joint."""
    name = joint.get("name", "")
    values = dict[str, float]()
    for dynamics in joint.findall("dynamics"):
        for key in ("friction", "damping"):
            (value,) = parse_numbers(urdf, dynamics, key, 1, default="0", where=name)
            if value < 0.0:
                raise make_element_error(
                    urdf,
                    dynamics,
                    "friction and damping must not be negative",
                    field=f"{name}: dynamics {key}",
                    expected="0 or more",
                    got=value,
                )
            values[key] = value
    return values


def compute_mass(model: pin.Model) -> float:
    """Return the total mass of all links of a model [kg]."""
    return float(sum(inertia.mass for inertia in model.inertias))


def compute_inertia(model: pin.Model, q: Floats) -> pin.Inertia:
    """Return the inertia of all links of a model at q, shape (nq,), in the universe frame."""
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    total = pin.Inertia.Zero()
    for placement, inertia in zip(data.oMi, model.inertias, strict=True):
        total = total + placement.act(inertia)
    return total


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
        scaled = factor * np.asarray(inertia.inertia)
        model.inertias[joint] = pin.Inertia(factor * inertia.mass, inertia.lever, scaled)


def compute_solid_inertia(shape: pin.GeometryObject, density: float = 1.0) -> pin.Inertia:
    """Return the inertia of a convex shape of uniform `density` [kg/m³], in its own frame."""
    vertices, _ = triangulate(shape.geometry)
    solid = compute_hull(vertices)
    solid.density = density
    center = np.asarray(solid.center_mass)
    rotational_inertia = np.asarray(solid.moment_inertia)
    return pin.Inertia(float(solid.mass), center, rotational_inertia)


@dataclass(frozen=True, eq=False)
class TorqueLimits:
    """Torque and force limits of a robot's joints.

    Attributes:
        limits: Limit of each coordinate, shape (n,) [N·m], [N]; infinite for the base and where the
            limit is unknown.
        notes: Reasons why limits are unknown, one line each.
    """

    limits: Floats
    notes: tuple[str, ...] = ()

    @property
    def is_known(self) -> bool:
        """Whether any limit is known."""
        return bool(np.isfinite(self.limits).any())


def compute_torque_limits(
    model: pin.Model, coordinates: Coordinates, lower: Floats, upper: Floats
) -> TorqueLimits:
    """Return the torque limits of a robot.

    Limits are unknown if the URDF has no masses or no effort limit. They are also discarded if they
    cannot hold the arm at rest with an empty hand in all sampled configurations: such values are
    placeholders, or the model lacks a counterbalancing spring.

    Args:
        model: The robot; joint 1 is the base.
        coordinates: Coordinates of the robot; the first three are the base's.
        lower: Lower position limits, shape (n,) [m], [rad].
        upper: Upper position limits, shape (n,) [m], [rad].
    """
    limits = np.asarray(model.effortLimit, float)[: coordinates.size].copy()
    limits[:3] = np.inf
    arm_mass = sum(inertia.mass for inertia in list(model.inertias)[2:])
    if not arm_mass > 0.0:
        unlimited = np.full_like(limits, np.inf)
        return TorqueLimits(unlimited, ("the URDF states no masses of the arm",))
    is_stated = (limits > 0.0) & (limits < UNLIMITED)
    limits[~is_stated] = np.inf
    names = np.array(coordinates.names)
    notes = list[str]()
    unstated = names[3:][~is_stated[3:]]
    if len(unstated):
        notes.append(f"the URDF states no effort of {', '.join(unstated)}")
    gravity = _sample_gravity_torques(model, coordinates, lower, upper)
    for k in np.flatnonzero((gravity > limits) & is_stated):
        unit = {"m": "N", "rad": "N·m"}[coordinates.units[k]]
        notes.append(
            f"{names[k]}: the effort limit of {limits[k]:g} {unit} cannot hold the arm, "
            f"which needs up to {gravity[k]:.3g} {unit}"
        )
        limits[k] = np.inf
    return TorqueLimits(limits, tuple(notes))


def _sample_gravity_torques(
    model: pin.Model, coordinates: Coordinates, lower: Floats, upper: Floats
) -> Floats:
    """Return the largest gravity torques in random configurations, shape (n,) [N·m], [N]."""
    rng = np.random.default_rng(0)
    low = np.maximum(lower, -np.pi)
    high = np.maximum(low, np.minimum(upper, np.pi))
    data = model.createData()
    largest = np.zeros(coordinates.size)
    for z in rng.uniform(low, high, (_SAMPLES, len(low))):
        gravity = pin.computeGeneralizedGravity(model, data, coordinates.q(z))
        largest = np.maximum(largest, np.abs(gravity))
    return largest
