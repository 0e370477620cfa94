"""Reads the prims of a USD stage with usd-core (https://openusd.org) in a child process.

Composition, instances, transforms and bindings are usd-core's. Values stay as the file has them, in
its units and axes, and not stated ones are None. The schemas' attributes are read here and not the
records of `UsdPhysics.LoadUsdPhysicsFromRange`, which takes a body that does not exist as the world
and ignores a hinge's only limit. This module imports little, since the child process imports it.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.isolation import run_isolated
from vkc_pin.utils.optional_imports import import_optional

_LISTED = 8  # paths in a note
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")  # not C:, a drive
_QUOTED = re.compile(r" : '(.*)'\s*$", re.DOTALL)  # the message in an error of usd-core
_UNLIMITED = 0.5e38
"""Numbers beyond which limits count as infinite, as in UsdPhysics."""
# Errors of composition that leave content out; others concern targets and opinions
_INCOMPLETE = (
    "ErrorArcCycle",
    "ErrorInvalidAssetPath",
    "ErrorInvalidSublayerPath",
    "ErrorSublayerCycle",
    "ErrorUnresolvedPrimPath",
)
_SHAPES = {
    "Cube": "cube",
    "Sphere": "sphere",
    "Cylinder": "cylinder",
    "Cylinder_1": "cylinder",
    "Capsule": "capsule",
    "Capsule_1": "capsule",
    "Cone": "cone",
    "Mesh": "mesh",
}
"""Type of a prim → kind of shape."""
_JOINTS = {
    "PhysicsFixedJoint": "fixed",
    "PhysicsRevoluteJoint": "revolute",
    "PhysicsPrismaticJoint": "prismatic",
    "PhysicsSphericalJoint": "spherical",
    "PhysicsDistanceJoint": "distance",
    "PhysicsJoint": "generic",
}
"""Type of a prim → kind of joint."""
JOINT_AXES = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
"""Axes of a generic joint."""
# Inputs of shaders for colour and opacity: of UsdPreviewSurface, and of NVIDIA's OmniPBR
_COLOUR_INPUTS = ("diffuseColor", "diffuse_color_constant")
_OPACITY_INPUTS = ("opacity", "opacity_constant")


@dataclass(frozen=True, eq=False)
class UsdMass:
    """The mass properties that a prim states; None where it states nothing.

    Attributes:
        mass: Mass.
        density: Density.
        centre: Centre of mass in the prim's frame, shape (3,).
        moments: Principal moments of inertia, shape (3,).
        axes: Quaternion of the principal axes in the prim's frame (w, x, y, z).
    """

    mass: float | None = None
    density: float | None = None
    centre: Floats | None = None
    moments: Floats | None = None
    axes: Floats | None = None


@dataclass(frozen=True, eq=False)
class UsdMesh:
    """Polygons of a mesh.

    Attributes:
        points: Vertices, shape (n, 3).
        counts: Number of corners of each polygon, shape (m,).
        corners: Vertices of all polygons, shape (sum of `counts`,).
        is_left_handed: Whether corners turn clockwise, seen from outside.
    """

    points: Floats
    counts: Ints
    corners: Ints
    is_left_handed: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class UsdShape:
    """A shape.

    Attributes:
        path: Path of the prim.
        body: Path of the rigid body that it belongs to; None if it is static.
        kind: "cube", "sphere", "cylinder", "capsule", "cone" or "mesh".
        size: Edge; radius; radii at the lower and upper end, and height; radius and height.
        axis: "X", "Y" or "Z", along which the height is.
        mesh: Polygons, if it is a mesh.
        matrix: Frame in the stage, shape (4, 4), which may scale.
        colour: Red, green, blue and opacity.
        is_visual: Whether it is rendered.
        collides: Whether it collides.
        approximation: How a mesh collides, as in `UsdPhysics.MeshCollisionAPI`.
        mass: The mass properties that it states as a collider.
        material_density: Density of its physical material.
    """

    path: str
    body: str | None
    kind: str
    size: tuple[float, ...]
    axis: str
    mesh: UsdMesh | None
    matrix: Floats
    colour: tuple[float, float, float, float] | None
    is_visual: bool
    collides: bool
    approximation: str
    mass: UsdMass
    material_density: float | None


@dataclass(frozen=True, eq=False)
class UsdBody:
    """A rigid body: its path, its frame in the stage, shape (4, 4), and stated mass properties."""

    path: str
    matrix: Floats
    is_kinematic: bool
    mass: UsdMass


class UsdEnd(NamedTuple):
    """A joint's frame on one side.

    Attributes:
        body: Path of the rigid body; None for the world.
        matrix: Frame of the prim that the joint names, in the stage, shape (4, 4).
        position: Origin of the joint's frame in it, shape (3,).
        rotation: Quaternion of the joint's frame in it (w, x, y, z).
    """

    body: str | None
    matrix: Floats
    position: Floats
    rotation: Floats


class UsdMimic(NamedTuple):
    """A joint whose position y follows that of `leader`, a path: y = offset + factor · x."""

    leader: str
    offset: float
    factor: float
    element: str


@dataclass(frozen=True, eq=False, kw_only=True)
class UsdJoint:
    """A joint; positions are degrees or lengths of the stage.

    Attributes:
        path: Path of the prim.
        kind: "fixed", "revolute", "prismatic", "spherical", "distance" or "generic".
        ends: Its frames on both sides.
        axis: "X", "Y" or "Z", of a hinge or slide.
        limits: Lower and upper limit, by axis for a generic joint, otherwise by "".
        max_forces: Largest force or torque of each drive: by axis for a generic joint, otherwise by
            "angular" or "linear".
        max_velocity: Largest velocity; None if not stated.
        is_excluded: Whether it is cut from the tree of joints.
        mimic: The joint that it follows.
    """

    path: str
    kind: str
    ends: tuple[UsdEnd, UsdEnd]
    axis: str
    limits: Mapping[str, tuple[float, float]]
    max_forces: Mapping[str, float]
    max_velocity: float | None
    is_excluded: bool
    mimic: UsdMimic | None


@dataclass(frozen=True, eq=False)
class UsdStage:
    """The physics and the shapes of a stage.

    Attributes:
        metres: Length of its unit [m].
        kilograms: Mass of its unit [kg].
        up: Vertical axis, "Y" or "Z".
        bodies: Rigid bodies.
        shapes: Shapes that are rendered or collide.
        joints: Enabled joints.
        roots: Paths of the prims that are roots of articulations.
        notes: Omissions.
    """

    metres: float
    kilograms: float
    up: str
    bodies: list[UsdBody] = field(default_factory=list)
    shapes: list[UsdShape] = field(default_factory=list)
    joints: list[UsdJoint] = field(default_factory=list)
    roots: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)


def load_usd_stage(file: Path, packages: Mapping[str, Path]) -> UsdStage:
    """Return the physics and the shapes of a USD file.

    Layers are read from its folder and from those of `packages` alone.

    Raises:
        InputError: usd-core is not installed, cannot read the file, or exceeds a limit; or layers
            are missing, unreadable or elsewhere; or there is no physics.
    """
    import_optional("pxr", "usd", purpose="a USD file", file=file)
    path = file.resolve()
    folders = [str(path.parent)]
    folders += [str(folder.resolve()) for folder in packages.values()]
    return run_isolated(_load, path, file, folders, program="usd-core", file=file)


def _load(path: Path, file: Path, folders: Sequence[str]) -> UsdStage:
    """Return the content of the stage at an absolute `path`; messages name `file`."""
    # Plugins could resolve addresses in networks, and search paths lead to other folders.
    for variable in ("PXR_PLUGINPATH_NAME", "PXR_AR_DEFAULT_SEARCH_PATH"):
        os.environ.pop(variable, None)
    from pxr import Tf, Usd

    try:
        layers = _open_layers(path, file, folders)
        return _Reader(Usd.Stage.Open(layers[0]), file).read()
    # usd-core quotes damaged layers in messages, which may be no text.
    except (Tf.ErrorException, UnicodeDecodeError) as error:
        problem = f"USD cannot read the file: {_find_message(error)}"
        raise InputError(problem, file=file, expected=_READABLE) from error


# Layers

_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
_READABLE = "a layer that is neither damaged nor encrypted"


def _open_layers(path: Path, file: Path, folders: Sequence[str]) -> list[Any]:
    """Return the layer at `path` and all that it refers to, before they are composed.

    Missing layers are left to composition, which ignores those of variants that are not selected.
    """
    from pxr import Ar, Sdf

    # Which code reads a file is decided by its suffix.
    if path.suffix.lower() not in _SUFFIXES:
        expected = f"the suffix {', '.join(_SUFFIXES)}"
        raise InputError("USD cannot read the file", file=file, expected=expected, got=path.suffix)
    root = Sdf.Layer.FindOrOpen(str(path))
    if root is None:
        raise InputError("USD cannot read the file", file=file, expected=_READABLE)
    layers = [root]
    known = {root.identifier}
    for layer in layers:
        for address in layer.GetCompositionAssetDependencies():
            if not address:  # a reference to another prim of the layer
                continue
            if _URL.match(address):
                _raise_outside(file, layer, address, folders)
            anchored = Sdf.ComputeAssetPathRelativeToLayer(layer, address)
            place, _ = Sdf.Layer.SplitIdentifier(anchored)
            resolved = Ar.GetResolver().Resolve(place)
            if not resolved or anchored in known:
                continue
            known.add(anchored)
            # A file inside a package is as far as the package itself.
            outer, _ = Ar.SplitPackageRelativePathOuter(resolved.GetPathString())
            if not _is_inside(outer, folders):
                _raise_outside(file, layer, address, folders)
            layers.append(_open_layer(anchored, file, layer, address))
    return layers


def _open_layer(anchored: str, file: Path, layer: Any, address: str) -> Any:
    """Return a layer that another one names by its `address`."""
    from pxr import Sdf, Tf

    try:
        opened = Sdf.Layer.FindOrOpen(anchored)
    except (Tf.ErrorException, UnicodeDecodeError) as error:
        opened = None
        message = _find_message(error)
    else:
        message = "of no known format"
    if opened is None:
        raise InputError(
            f"a layer that {_name_layer(layer)} refers to cannot be read: {message}",
            file=file,
            field=address,
            expected=_READABLE,
        )
    return opened


def _is_inside(path: str, folders: Iterable[str]) -> bool:
    real = Path(os.path.realpath(path))
    return any(real.is_relative_to(folder) for folder in folders)


def _raise_outside(file: Path, layer: Any, address: str, folders: Sequence[str]) -> None:
    """Raise an error about a layer that is not in a folder of the file."""
    raise InputError(
        f"{_name_layer(layer)} refers to a layer elsewhere: nothing is fetched",
        file=file,
        field=address,
        expected=f"layers in {', '.join(folders)}, or in a folder that is stated "
        "(packages, --package NAME=FOLDER)",
    )


def _name_layer(layer: Any) -> str:
    return os.path.basename(layer.identifier)  # noqa: PTH119 - may be inside a package


def _find_message(error: Exception) -> str:
    """Return the message of an error of usd-core in one line; quoted bytes may be no text."""
    try:
        text = str(error)
    except UnicodeDecodeError as other:
        text = str(other)
    match = _QUOTED.search(text)
    return " ".join((match[1] if match else text).split())


# Prims


class _Reader:
    """Reads the prims of a stage at its first time."""

    def __init__(self, stage: Any, file: Path) -> None:
        from pxr import Usd, UsdGeom, UsdPhysics

        self._stage = stage
        self._file = file
        self._time = Usd.TimeCode.EarliestTime()
        self._frames = UsdGeom.XformCache(self._time)
        self._found = UsdStage(
            float(UsdGeom.GetStageMetersPerUnit(stage)),
            float(UsdPhysics.GetStageKilogramsPerUnit(stage)),
            str(UsdGeom.GetStageUpAxis(stage)),
        )
        self._bodies = set[str]()  # paths
        self._meshes: dict[str, UsdMesh | None] = {}  # by path in the prototype
        self._left_out = dict[str, list[str]]()  # paths by reason

    def read(self) -> UsdStage:
        """Return the physics and the shapes."""
        self._check_composition()
        self._check_units()
        prims = list(self._list_prims())
        self._check_physics(prims)
        for prim in prims:
            with self._explain_types(prim):
                self._read_body(prim)
        for prim in prims:
            with self._explain_types(prim):
                self._read_shape(prim)
                self._read_joint(prim)
        for reason, paths in self._left_out.items():
            more = ", ..." if len(paths) > _LISTED else ""
            self._found.notes.append(f"{reason}: {', '.join(paths[:_LISTED])}{more}")
        return self._found

    def _check_composition(self) -> None:
        """Check that no content is missing; other errors of composition are notes."""
        errors = self._stage.GetCompositionErrors()
        texts = dict.fromkeys(str(error).strip().splitlines()[0] for error in errors)
        incomplete = [error for error in errors if type(error).__name__ in _INCOMPLETE]
        if incomplete:
            listed = dict.fromkeys(str(error).strip().splitlines()[0] for error in incomplete)
            raise InputError(
                f"layers or prims are missing: {'; '.join(listed)}",
                file=self._file,
                expected="all layers that the file refers to, in its folder",
            )
        self._found.notes.extend(texts)

    def _check_units(self) -> None:
        from pxr import UsdGeom

        found = self._found
        for name, value in (("metersPerUnit", found.metres), ("kilogramsPerUnit", found.kilograms)):
            if not 0.0 < value < math.inf:
                raise InputError(
                    "wrong unit", file=self._file, field=name, expected="above 0", got=value
                )
        if not UsdGeom.StageHasAuthoredMetersPerUnit(self._stage):
            found.notes.append("the file states no metersPerUnit: centimetres, as USD specifies")
        if not self._stage.HasAuthoredMetadata("upAxis"):
            found.notes.append(f"the file states no upAxis: {found.up}, as USD specifies")

    def _list_prims(self) -> Iterator[Any]:
        """Yield all prims that are active and defined, those of instances at each of their places.

        Raises:
            InputError: A prim has value clips, which are layers; or points place colliders.
        """
        from pxr import Usd, UsdGeom

        visible = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
        walk = iter(Usd.PrimRange(self._stage.GetPseudoRoot(), visible))
        for prim in walk:
            if prim.HasAuthoredMetadata("clips"):
                expected = "values in the layers themselves"
                raise self._make_error(prim, "value clips are not read", expected=expected)
            if prim.IsA(UsdGeom.PointInstancer):
                self._leave_out_instancer(prim)
                walk.PruneChildren()
                continue
            if UsdGeom.Xformable(prim) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying():
                self._leave_out("animated, hence read at its first time", prim)
            yield prim

    def _leave_out_instancer(self, instancer: Any) -> None:
        """Note that an instancer is not read, if none of its prototypes has physics."""
        from pxr import Usd, UsdGeom

        prototypes = UsdGeom.PointInstancer(instancer).GetPrototypesRel().GetForwardedTargets()
        roots = [instancer, *map(self._stage.GetPrimAtPath, prototypes)]
        for root in roots:
            if not root:
                continue
            below = Usd.PrimRange(root, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
            if any(_has_physics(prim) for prim in below):
                raise self._make_error(
                    instancer,
                    "a point instancer places colliders",
                    expected="instances that are prims (`instanceable`)",
                )
        self._leave_out("point instancers are left out", instancer)

    def _check_physics(self, prims: Iterable[Any]) -> None:
        if not any(_has_physics(prim) for prim in prims):
            raise InputError(
                "the USD has no physics",
                file=self._file,
                expected="prims with PhysicsRigidBodyAPI or PhysicsCollisionAPI",
                got="shapes to look at alone",
            )

    def _leave_out(self, reason: str, prim: Any) -> None:
        self._left_out.setdefault(reason, []).append(str(prim.GetPath()))

    def _make_error(
        self, prim: Any, problem: str, *, expected: object = None, got: object = None
    ) -> InputError:
        path = str(prim.GetPath())
        return InputError(problem, file=self._file, field=path, expected=expected, got=got)

    @contextlib.contextmanager
    def _explain_types(self, prim: Any) -> Iterator[None]:
        """Name the prim of a value that a layer states with another type than its schema."""
        try:
            yield
        except (InputError, UnicodeDecodeError):
            raise
        except (AttributeError, OverflowError, TypeError, ValueError) as error:
            message = " ".join(str(error).split())
            raise self._make_error(prim, f"a value of a wrong type: {message}") from error

    def _find_matrix(self, prim: Any) -> Floats:
        """Return the frame of a prim in the stage, for columns, shape (4, 4)."""
        matrix = np.array(self._frames.GetLocalToWorldTransform(prim)).T
        if not np.isfinite(matrix).all():
            raise self._make_error(prim, "the transform is not finite", expected="finite numbers")
        return matrix

    # Bodies

    def _read_body(self, prim: Any) -> None:
        from pxr import UsdPhysics

        path = str(prim.GetPath())
        if prim.HasAPI(UsdPhysics.ArticulationRootAPI):
            self._found.roots.add(path)
        for schema in _list_schemas(prim):
            if schema.startswith("PhysxTendon"):
                self._leave_out("tendons are left out", prim)
                break
        if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
            return
        body = UsdPhysics.RigidBodyAPI(prim)
        if not self._get(body.GetRigidBodyEnabledAttr()):
            self._leave_out("disabled rigid bodies do not move by themselves", prim)
            return
        matrix = self._find_matrix(prim)
        if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
            expected = "scales that are not 0"
            raise self._make_error(prim, "a body without volume", expected=expected)
        is_kinematic = bool(self._get(body.GetKinematicEnabledAttr()))
        self._bodies.add(path)
        self._found.bodies.append(UsdBody(path, matrix, is_kinematic, self._read_mass(prim)))

    def _find_body(self, prim: Any) -> str | None:
        """Return the path of the body that a prim belongs to; None if it is static."""
        while prim and not prim.IsPseudoRoot():
            path = str(prim.GetPath())
            if path in self._bodies:
                return path
            prim = prim.GetParent()
        return None

    def _read_mass(self, prim: Any) -> UsdMass:
        """Return the mass properties that a prim states; the schema's defaults state nothing."""
        from pxr import UsdPhysics

        if not prim.HasAPI(UsdPhysics.MassAPI):
            return UsdMass()
        mass = UsdPhysics.MassAPI(prim)
        centre = np.array(self._get(mass.GetCenterOfMassAttr()), float)
        moments = np.array(self._get(mass.GetDiagonalInertiaAttr()), float)
        axes = _read_quaternion(self._get(mass.GetPrincipalAxesAttr()))
        return UsdMass(
            self._read_positive(prim, mass.GetMassAttr()),
            self._read_positive(prim, mass.GetDensityAttr()),
            centre if np.isfinite(centre).all() else None,
            moments if np.isfinite(moments).all() and moments.any() else None,
            axes if np.isfinite(axes).all() and axes.any() else None,
        )

    def _read_positive(self, prim: Any, attribute: Any) -> float | None:
        """Return a mass or density, or None for 0, which states nothing."""
        value = float(self._get(attribute))
        if not 0.0 <= value < math.inf:
            name = attribute.GetName()
            raise self._make_error(prim, f"wrong {name}", expected="0 or more", got=value)
        return value or None

    # Shapes

    def _read_shape(self, prim: Any) -> None:
        from pxr import UsdGeom

        if not prim.IsA(UsdGeom.Gprim):
            return
        collider = self._find_collider(prim)
        image = UsdGeom.Imageable(prim)
        is_shown = image.ComputeVisibility(self._time) != UsdGeom.Tokens.invisible
        purposes = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
        is_visual = is_shown and image.ComputePurpose() in purposes
        if collider is None and not is_visual:
            return
        kind = _SHAPES.get(str(prim.GetTypeName()))
        if kind is None:
            name = prim.GetTypeName()
            self._leave_out(f"prims of type {name} have no volume that is read: left out", prim)
            return
        matrix = self._find_matrix(prim)
        mesh = self._read_mesh(prim) if kind == "mesh" else None
        size, axis = self._read_size(prim, kind)
        has_size = mesh is not None if kind == "mesh" else _has_size(kind, size)
        if not has_size or not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
            self._leave_out("shapes without size are left out", prim)
            return
        shape = UsdShape(
            path=str(prim.GetPath()),
            body=self._find_body(prim),
            kind=kind,
            size=size,
            axis=axis,
            mesh=mesh,
            matrix=matrix,
            colour=self._read_colour(prim),
            is_visual=is_visual,
            collides=collider is not None,
            approximation="none" if collider is None else self._read_approximation(prim, collider),
            mass=UsdMass() if collider is None else self._read_collider_mass(prim, collider),
            material_density=None if collider is None else self._read_material_density(prim),
        )
        self._found.shapes.append(shape)

    def _find_collider(self, prim: Any) -> Any:
        """Return the prim whose collision API holds for a shape: it or one above; None without.

        URDF importers of Isaac Sim state it on the group, because its shapes are instances.
        """
        from pxr import UsdPhysics

        while prim and not prim.IsPseudoRoot():
            if prim.HasAPI(UsdPhysics.CollisionAPI):
                is_enabled = self._get(UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr())
                return prim if is_enabled else None
            if str(prim.GetPath()) in self._bodies:
                return None
            prim = prim.GetParent()
        return None

    def _read_approximation(self, prim: Any, collider: Any) -> str:
        from pxr import UsdPhysics

        for stated in (prim, collider):
            if stated.HasAPI(UsdPhysics.MeshCollisionAPI):
                return str(self._get(UsdPhysics.MeshCollisionAPI(stated).GetApproximationAttr()))
        return "none"

    def _read_collider_mass(self, prim: Any, collider: Any) -> UsdMass:
        """Return the mass properties of a collider that is not the body itself."""
        for stated in (prim, collider):
            if str(stated.GetPath()) not in self._bodies:
                mass = self._read_mass(stated)
                if mass.mass is not None or mass.density is not None:
                    return mass
        return UsdMass()

    def _read_material_density(self, prim: Any) -> float | None:
        from pxr import UsdPhysics, UsdShade

        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
        if not material or not material.GetPrim().HasAPI(UsdPhysics.MaterialAPI):
            return None
        physics = UsdPhysics.MaterialAPI(material.GetPrim())
        return self._read_positive(material.GetPrim(), physics.GetDensityAttr())

    def _read_size(self, prim: Any, kind: str) -> tuple[tuple[float, ...], str]:
        """Return the sizes of a shape as in `UsdShape`, and its axis."""
        from pxr import UsdGeom

        if kind == "mesh":
            return (), "Z"
        schema = getattr(UsdGeom, str(prim.GetTypeName()))(prim)
        if kind == "cube":
            return (float(self._get(schema.GetSizeAttr())),), "Z"
        if kind == "sphere":
            return (float(self._get(schema.GetRadiusAttr())),), "Z"
        axis = str(self._get(schema.GetAxisAttr()))
        height = float(self._get(schema.GetHeightAttr()))
        if hasattr(schema, "GetRadiusTopAttr"):
            bottom = float(self._get(schema.GetRadiusBottomAttr()))
            top = float(self._get(schema.GetRadiusTopAttr()))
        else:
            bottom = float(self._get(schema.GetRadiusAttr()))
            top = bottom
        if kind == "cone":
            return (bottom, height), axis
        return (bottom, top, height), axis

    def _read_mesh(self, prim: Any) -> UsdMesh | None:
        """Return the polygons of a mesh without holes; None if there are none.

        Instances of a mesh share them.
        """
        source = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
        key = str(source.GetPath())
        if key not in self._meshes:
            self._meshes[key] = self._read_polygons(prim)
        return self._meshes[key]

    def _read_polygons(self, prim: Any) -> UsdMesh | None:
        from pxr import UsdGeom

        mesh = UsdGeom.Mesh(prim)
        points = _read_array(self._get(mesh.GetPointsAttr()), float).reshape(-1, 3)
        counts = _read_array(self._get(mesh.GetFaceVertexCountsAttr()), int)
        corners = _read_array(self._get(mesh.GetFaceVertexIndicesAttr()), int)
        if not len(points) or not len(counts):
            return None
        is_wrong = counts.min() < 0 or counts.sum() != len(corners)
        if is_wrong or (len(corners) and not 0 <= corners.min() <= corners.max() < len(points)):
            expected = f"corners of {len(points)} points"
            got = f"faces with {counts.sum()} corners, and {len(corners)} indices"
            raise self._make_error(prim, "wrong faces", expected=expected, got=got)
        if not np.isfinite(points).all():
            raise self._make_error(prim, "points are not finite", expected="finite numbers")
        holes = _read_array(self._get(mesh.GetHoleIndicesAttr()), int)
        is_kept = np.ones(len(counts), bool)
        is_kept[holes[(holes >= 0) & (holes < len(counts))]] = False
        corners = corners[np.repeat(is_kept, counts)]
        counts = counts[is_kept]
        if not len(counts):
            return None
        orientation = self._get(mesh.GetOrientationAttr())
        return UsdMesh(points, counts, corners, orientation == UsdGeom.Tokens.leftHanded)

    def _read_colour(self, prim: Any) -> tuple[float, float, float, float] | None:
        """Return the colour of a shape's material, else its own if it has one."""
        from pxr import UsdGeom, UsdShade

        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        if material:
            colour = self._read_material_colour(material)
            if colour is not None:
                return colour
        shape = UsdGeom.Gprim(prim)
        colours = _read_array(self._get(shape.GetDisplayColorAttr()), float).reshape(-1, 3)
        if not len(colours):
            return None
        opacities = _read_array(self._get(shape.GetDisplayOpacityAttr()), float)
        red, green, blue = (float(value) for value in colours[0])
        return red, green, blue, float(opacities[0]) if len(opacities) else 1.0

    def _read_material_colour(self, material: Any) -> tuple[float, float, float, float] | None:
        """Return the colour of a material; None if a texture states it."""
        for context in ("", "mdl"):
            shader, _, _ = material.ComputeSurfaceSource(context)
            if not shader:
                continue
            colour = self._read_input(shader, _COLOUR_INPUTS)
            if colour is not None and len(colour) == 3:
                opacity = self._read_input(shader, _OPACITY_INPUTS)
                red, green, blue = (float(value) for value in colour)
                return red, green, blue, 1.0 if opacity is None else float(opacity)
        return None

    def _read_input(self, shader: Any, names: Iterable[str]) -> Any:
        """Return the value of the first of some inputs that is stated and not connected."""
        for name in names:
            found = shader.GetInput(name)
            if found and not found.HasConnectedSource():
                value = found.Get(self._time)
                if value is not None:
                    return value
        return None

    # Joints

    def _read_joint(self, prim: Any) -> None:
        from pxr import UsdPhysics

        name = str(prim.GetTypeName())
        if not prim.IsA(UsdPhysics.Joint):
            if name.endswith("Joint"):
                self._leave_out(f"joints of type {name} are left out", prim)
            return
        joint = UsdPhysics.Joint(prim)
        if not self._get(joint.GetJointEnabledAttr()):
            self._leave_out("disabled joints are left out", prim)
            return
        ends = (
            self._read_end(prim, joint.GetBody0Rel(), joint.GetLocalPos0Attr(), "Rot0"),
            self._read_end(prim, joint.GetBody1Rel(), joint.GetLocalPos1Attr(), "Rot1"),
        )
        if ends[0].body == ends[1].body:
            self._leave_out("joints that connect nothing are left out", prim)
            return
        kind = _JOINTS.get(name, "generic")
        velocity = self._get(prim.GetAttribute("physxJoint:maxJointVelocity"))
        found = UsdJoint(
            path=str(prim.GetPath()),
            kind=kind,
            ends=ends,
            axis=self._read_axis(prim, kind),
            limits=self._read_limits(prim, kind),
            max_forces=self._read_forces(prim),
            max_velocity=None if velocity is None else float(velocity),
            is_excluded=bool(self._get(joint.GetExcludeFromArticulationAttr())),
            mimic=self._read_mimic(prim),
        )
        self._found.joints.append(found)

    def _read_end(self, prim: Any, relation: Any, position: Any, rotation: str) -> UsdEnd:
        """Return the frame of a joint on one side; without a body, it is in the stage's frame."""
        targets = relation.GetForwardedTargets()
        if len(targets) > 1:
            got = ", ".join(map(str, targets))
            problem = f"{relation.GetName()} names several prims"
            raise self._make_error(prim, problem, expected="one prim", got=got)
        body = None
        matrix: Floats = np.eye(4)
        if targets:
            target = self._stage.GetPrimAtPath(targets[0])
            if not target:
                problem = f"{relation.GetName()} names a prim that does not exist"
                raise self._make_error(prim, problem, expected="a prim", got=str(targets[0]))
            matrix = self._find_matrix(target)
            body = self._find_body(target)
        quaternion = _read_quaternion(self._get(prim.GetAttribute(f"physics:local{rotation}")))
        origin = np.array(self._get(position), float)
        if not (np.isfinite(origin).all() and np.linalg.norm(quaternion) > 0.0):
            expected = "a finite position and a quaternion that is not 0"
            raise self._make_error(prim, "wrong frame of a joint", expected=expected)
        return UsdEnd(body, matrix, origin, quaternion)

    def _read_axis(self, prim: Any, kind: str) -> str:
        if kind in ("revolute", "prismatic"):
            return str(self._get(prim.GetAttribute("physics:axis")))
        return "X"

    def _read_limits(self, prim: Any, kind: str) -> dict[str, tuple[float, float]]:
        """Return the limits of a joint; those that are not stated are infinite."""
        from pxr import UsdPhysics

        if kind in ("revolute", "prismatic"):
            low = self._get(prim.GetAttribute("physics:lowerLimit"))
            high = self._get(prim.GetAttribute("physics:upperLimit"))
            return {"": self._make_limits(prim, low, high)}
        limits = dict[str, tuple[float, float]]()
        for name in _list_instances(prim, "PhysicsLimitAPI"):
            limit = UsdPhysics.LimitAPI(prim, name)
            low = self._get(limit.GetLowAttr())
            high = self._get(limit.GetHighAttr())
            limits[name] = self._make_limits(prim, low, high)
        return limits

    def _make_limits(self, prim: Any, low: float, high: float) -> tuple[float, float]:
        if math.isnan(low) or math.isnan(high):
            expected = "numbers, or infinity for none"
            raise self._make_error(prim, "wrong limits", expected=expected, got=f"{low}, {high}")
        lower = float(low) if low > -_UNLIMITED else -math.inf
        upper = float(high) if high < _UNLIMITED else math.inf
        return lower, upper

    def _read_forces(self, prim: Any) -> dict[str, float]:
        from pxr import UsdPhysics

        forces = dict[str, float]()
        for name in _list_instances(prim, "PhysicsDriveAPI"):
            drive = UsdPhysics.DriveAPI(prim, name)
            forces[name] = float(self._get(drive.GetMaxForceAttr()))
        return forces

    def _read_mimic(self, prim: Any) -> UsdMimic | None:
        """Return the coupling of a joint by Newton's or by PhysX's schema.

        The first states y = coef0 + coef1 · x, the second y + gearing · x + offset = 0.
        """
        for schema in _list_schemas(prim):
            name, _, instance = schema.partition(":")
            if name == "NewtonMimicAPI":
                is_enabled = self._get(prim.GetAttribute("newton:mimicEnabled"))
                if is_enabled is False:
                    continue
                leader = self._find_target(prim, "newton:mimicJoint")
                offset = self._get(prim.GetAttribute("newton:mimicCoef0")) or 0.0
                factor = self._get(prim.GetAttribute("newton:mimicCoef1"))
                factor = 1.0 if factor is None else factor
                return UsdMimic(leader, float(offset), float(factor), name)
            if name == "PhysxMimicJointAPI":
                prefix = f"physxMimicJoint:{instance}"
                leader = self._find_target(prim, f"{prefix}:referenceJoint")
                offset = self._get(prim.GetAttribute(f"{prefix}:offset")) or 0.0
                factor = self._get(prim.GetAttribute(f"{prefix}:gearing"))
                factor = 1.0 if factor is None else factor
                return UsdMimic(leader, -float(offset), -float(factor), name)
        return None

    def _find_target(self, prim: Any, name: str) -> str:
        """Return the path of the only target of a relationship."""
        relation = prim.GetRelationship(name)
        targets = relation.GetForwardedTargets() if relation else []
        if len(targets) != 1:
            problem = f"{name} does not name one joint"
            raise self._make_error(prim, problem, expected="one joint", got=len(targets))
        return str(targets[0])

    def _get(self, attribute: Any) -> Any:
        """Return the value of an attribute at the stage's first time; None if there is none."""
        return attribute.Get(self._time) if attribute else None


def _has_size(kind: str, size: tuple[float, ...]) -> bool:
    """Return whether a shape has a volume; a capsule without height is a sphere."""
    if kind in ("cylinder", "capsule"):
        bottom, top, height = size
        is_long = height >= 0.0 if kind == "capsule" else height > 0.0
        return min(bottom, top) >= 0.0 and bottom + top > 0.0 and is_long
    return min(size) > 0.0


def _has_physics(prim: Any) -> bool:
    from pxr import UsdPhysics

    return bool(prim.HasAPI(UsdPhysics.RigidBodyAPI) or prim.HasAPI(UsdPhysics.CollisionAPI))


def _list_schemas(prim: Any) -> list[str]:
    """Return the names of a prim's API schemas, also of those that usd-core does not know."""
    stated = prim.GetMetadata("apiSchemas")
    return [] if stated is None else [str(name) for name in stated.GetAppliedItems()]


def _list_instances(prim: Any, schema: str) -> list[str]:
    """Return the instances of a schema of usd-core that is applied several times."""
    names = list[str]()
    for applied in map(str, prim.GetAppliedSchemas()):
        name, _, instance = applied.partition(":")
        if name == schema:
            names.append(instance)
    return names


def _read_quaternion(value: Any) -> Floats:
    """Return a quaternion of usd-core (w, x, y, z), shape (4,)."""
    return np.array([value.GetReal(), *value.GetImaginary()], float)


def _read_array(value: Any, kind: type) -> Any:
    """Return the array of an attribute, empty if it has no value."""
    return np.array([] if value is None else value, kind)
