"""Writes USD files with usd-core, and computes motions from what its physics parser reports."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from pxr import Gf, Tf, Usd, UsdGeom, UsdPhysics, Vt

from vkc_pin.importing.description import Description, Joint, Part

UP = {"Z": np.eye(3), "Y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}
"""Rotations of stages to z up."""
AXES = {"X": np.eye(3)[0], "Y": np.eye(3)[1], "Z": np.eye(3)[2]}


def create_stage(file: Path, *, metres: float = 1.0, up: str = "Z", kilograms: float = 1.0) -> Any:
    """Return a new stage with its units stated."""
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    UsdGeom.SetStageUpAxis(stage, up)
    UsdPhysics.SetStageKilogramsPerUnit(stage, kilograms)
    return stage


def make_quaternion(rotation: np.ndarray) -> Any:
    """Return a rotation matrix as a quaternion of usd-core."""
    quaternion = pin.Quaternion(rotation)
    imaginary = map(float, (quaternion.x, quaternion.y, quaternion.z))
    return Gf.Quatf(float(quaternion.w), *imaginary)


def set_matrix(prim: Any, matrix: np.ndarray) -> None:
    """Place a prim in its parent by a matrix for columns, shape (4, 4)."""
    op = UsdGeom.Xformable(prim).AddTransformOp(UsdGeom.XformOp.PrecisionDouble)
    op.Set(Gf.Matrix4d(np.asarray(matrix, float).T.tolist()))


def add_body(stage: Any, path: str, matrix: np.ndarray | None = None) -> Any:
    """Add a rigid body."""
    body = UsdGeom.Xform.Define(stage, path)
    if matrix is not None:
        set_matrix(body, matrix)
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    return body.GetPrim()


def add_box(stage: Any, path: str, size: Any = (1.0, 1.0, 1.0), at: Any = (0.0, 0.0, 0.0)) -> Any:
    """Add a collider that is a box."""
    cube = UsdGeom.Cube.Define(stage, path)
    cube.CreateSizeAttr(1.0)
    cube.AddTranslateOp().Set(Gf.Vec3d(*map(float, at)))
    cube.AddScaleOp().Set(Gf.Vec3f(*map(float, size)))
    UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
    return cube.GetPrim()


def add_joint(
    stage: Any,
    path: str,
    kind: str,
    body0: str | None,
    body1: str | None,
    *,
    at0: Any = (0.0, 0.0, 0.0),
    at1: Any = (0.0, 0.0, 0.0),
    axis: str = "X",
    limits: tuple[float | None, float | None] = (None, None),
) -> Any:
    """Add a joint, such as `kind` "Revolute"; frames are not rotated."""
    joint = getattr(UsdPhysics, f"{kind}Joint" if kind else "Joint").Define(stage, path)
    if body0 is not None:
        joint.CreateBody0Rel().SetTargets([body0])
    if body1 is not None:
        joint.CreateBody1Rel().SetTargets([body1])
    joint.CreateLocalPos0Attr(Gf.Vec3f(*map(float, at0)))
    joint.CreateLocalPos1Attr(Gf.Vec3f(*map(float, at1)))
    if kind in ("Revolute", "Prismatic"):
        joint.CreateAxisAttr(axis)
        if limits[0] is not None:
            joint.CreateLowerLimitAttr(limits[0])
        if limits[1] is not None:
            joint.CreateUpperLimitAttr(limits[1])
    return joint


def add_mesh(stage: Any, path: str, mesh: Any) -> Any:
    """Add the triangles of a trimesh."""
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(mesh.vertices, np.float32)))
    faces = np.asarray(mesh.faces, np.int32)
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel()))
    return prim.GetPrim()


# Descriptions


def write_description(
    description: Description, file: Path, *, metres: float, up: str, kilograms: float
) -> None:
    """Write a description as USD, each link as a body whose frame is the link's, at zero."""
    stage = create_stage(file, metres=metres, up=up, kilograms=kilograms)
    root = UsdGeom.Xform.Define(stage, "/model")
    if not description.is_world:
        UsdPhysics.ArticulationRootAPI.Apply(root.GetPrim())
    names = {name: Tf.MakeValidIdentifier(name) for name in description.links}
    placements = description.compute_placements()
    for name, link in description.links.items():
        is_world = description.is_world and name == description.root
        path = f"/model/{names[name]}"
        matrix = np.eye(4)
        matrix[:3, :3] = UP[up].T @ placements[name].rotation
        matrix[:3, 3] = UP[up].T @ placements[name].translation / metres
        if is_world:
            set_matrix(UsdGeom.Xform.Define(stage, path), matrix)
        else:
            body = add_body(stage, path, matrix)
            _write_mass(body, link.inertia, metres, kilograms)
        for number, part in enumerate(link.collision):
            _write_shape(stage, f"{path}/collision_{number}", part, metres)
    for joint in description.joints.values():
        _write_joint(stage, joint, names, metres, kilograms)
    stage.Save()


def _write_mass(body: Any, inertia: pin.Inertia, metres: float, kilograms: float) -> None:
    mass = UsdPhysics.MassAPI.Apply(body)
    mass.CreateMassAttr(inertia.mass / kilograms)
    moments, axes = np.linalg.eigh(inertia.inertia)
    axes = axes * np.sign(np.linalg.det(axes))
    unit = kilograms * metres**2
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*map(float, moments / unit)))
    mass.CreatePrincipalAxesAttr(make_quaternion(axes))
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*map(float, inertia.lever / metres)))


def _write_shape(stage: Any, path: str, part: Part, metres: float) -> None:
    matrix = part.placement.homogeneous.copy()
    matrix[:3, 3] /= metres
    if part.kind == "box":
        matrix[:3, :3] *= np.array(part.size) / metres
        shape = UsdGeom.Cube.Define(stage, path)
        shape.CreateSizeAttr(1.0)
    elif part.kind == "sphere":
        shape = UsdGeom.Sphere.Define(stage, path)
        shape.CreateRadiusAttr(part.size[0] / metres)
    elif part.kind in ("cylinder", "capsule"):
        schema = UsdGeom.Cylinder if part.kind == "cylinder" else UsdGeom.Capsule
        shape = schema.Define(stage, path)
        shape.CreateRadiusAttr(part.size[0] / metres)
        shape.CreateHeightAttr(part.size[1] / metres)
    else:
        mesh = part.make_mesh()
        mesh.apply_transform(part.placement.inverse().homogeneous)
        shape = UsdGeom.Mesh(add_mesh(stage, path, mesh.apply_scale(1.0 / metres)))
    set_matrix(shape, matrix)
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())


def _write_joint(
    stage: Any, joint: Joint, names: Mapping[str, str], metres: float, kilograms: float
) -> None:
    if joint.kind == "floating":
        return
    kinds = {"fixed": "Fixed", "prismatic": "Prismatic"}
    kind = kinds.get(joint.kind, "Revolute")
    unit = metres if kind == "Prismatic" else np.pi / 180.0
    low, high = joint.limits or (-np.inf, np.inf)
    path = f"/model/joint_{Tf.MakeValidIdentifier(joint.name)}"
    ends = (f"/model/{names[joint.parent]}", f"/model/{names[joint.child]}")
    prim = add_joint(stage, path, kind, *ends, limits=(low / unit, high / unit))
    # The joint's frame has its x axis along the axis.
    along = pin.Quaternion.FromTwoVectors(np.eye(3)[0], joint.axis).toRotationMatrix()
    origin = joint.placement.translation / metres
    prim.CreateLocalPos0Attr(Gf.Vec3f(*map(float, origin)))
    prim.CreateLocalRot0Attr(make_quaternion(joint.placement.rotation @ along))
    prim.CreateLocalRot1Attr(make_quaternion(along))
    if joint.effort is not None:
        drive = UsdPhysics.DriveAPI.Apply(
            prim.GetPrim(), "linear" if kind == "Prismatic" else "angular"
        )
        force = kilograms * metres * (1.0 if kind == "Prismatic" else metres)
        drive.CreateMaxForceAttr(joint.effort / force)


# What usd-core says


def place_bodies(file: Path, root: str, values: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return the motions of bodies from their places in the file, in metres with z up.

    Frames of joints are those that usd-core's physics parser reports; `body0` carries `body1`, or
    the reverse where `body1` is nearer to `root`.

    Args:
        file: A stage whose bodies are a tree, apart from joints that are excluded.
        root: Path of the body that stays in its place, or "" for the world.
        values: Positions of joints by their paths, degrees or lengths of the stage.

    Returns:
        By path: shape (4, 4).
    """
    stage = Usd.Stage.Open(str(file))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        found = UsdPhysics.LoadUsdPhysicsFromRange(stage, ["/"])
    kinds = UsdPhysics.ObjectType
    cache = UsdGeom.XformCache()
    at_rest = {"": np.eye(4)}
    for path, _ in zip(*found.get(kinds.RigidBody, ((), ())), strict=True):
        matrix = cache.GetLocalToWorldTransform(stage.GetPrimAtPath(path)).RemoveScaleShear()
        at_rest[str(path)] = np.array(matrix).T
    edges = list[tuple[str, str, np.ndarray, np.ndarray, np.ndarray]]()
    for kind in (kinds.FixedJoint, kinds.RevoluteJoint, kinds.PrismaticJoint):
        for path, joint in zip(*found.get(kind, ((), ())), strict=True):
            if joint.excludeFromArticulation:
                continue
            value = values.get(str(path), 0.0)
            motion = np.eye(4)
            if kind != kinds.FixedJoint:
                axis = AXES[str(joint.axis)[-1]]
                if kind == kinds.RevoluteJoint:
                    motion[:3, :3] = pin.exp3(np.radians(value) * axis)
                else:
                    motion[:3, 3] = value * axis
            first = _make_frame(joint.localPose0Position, joint.localPose0Orientation)
            second = _make_frame(joint.localPose1Position, joint.localPose1Orientation)
            edges.append((str(joint.body0), str(joint.body1), first, motion, second))
    moved = {root: at_rest[root]}
    while len(moved) < len(at_rest):
        before = len(moved)
        for one, other, first, motion, second in edges:
            if one in moved and other not in moved:
                moved[other] = moved[one] @ first @ motion @ np.linalg.inv(second)
            elif other in moved and one not in moved:
                back = np.linalg.inv(first @ motion @ np.linalg.inv(second))
                moved[one] = moved[other] @ back
        if len(moved) == before:
            break
    metric = np.eye(4)
    metric[:3, :3] = UsdGeom.GetStageMetersPerUnit(stage) * UP[UsdGeom.GetStageUpAxis(stage)]
    inverse = np.linalg.inv(metric)
    return {
        path: metric @ pose @ np.linalg.inv(at_rest[path]) @ inverse for path, pose in moved.items()
    }


def compute_corners(file: Path, path: str) -> np.ndarray:
    """Return the corners of a cube in its place in the file, shape (8, 3) [m], with z up."""
    stage = Usd.Stage.Open(str(file))
    cube = UsdGeom.Cube.Get(stage, path)
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(cube.GetPrim())).T
    half = 0.5 * cube.GetSizeAttr().Get()
    corners = half * np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    in_stage = corners @ matrix[:3, :3].T + matrix[:3, 3]
    metres = UsdGeom.GetStageMetersPerUnit(stage)
    return metres * in_stage @ UP[UsdGeom.GetStageUpAxis(stage)].T


def _make_frame(position: Any, orientation: Any) -> np.ndarray:
    frame = np.eye(4)
    w, (x, y, z) = orientation.GetReal(), orientation.GetImaginary()
    frame[:3, :3] = pin.Quaternion(w, x, y, z).normalized().toRotationMatrix()
    frame[:3, 3] = np.array(position)
    return frame
