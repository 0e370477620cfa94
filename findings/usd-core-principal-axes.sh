#!/bin/sh
# usd-core 26.11: ComputeMassProperties returns principal axes that were never set.
#
# Behaviour: of a body that states mass, diagonalInertia and centerOfMass, but no principalAxes,
# UsdPhysics.RigidBodyAPI.ComputeMassProperties returns the mass, the moments and the centre, and a
# quaternion of arbitrary numbers, such as (-462300830, 4.5636e-41, -257192450, 4.5636e-41), others
# in every process. Without centerOfMass it returns (1, 0, 0, 0).
#
# One would guess: (1, 0, 0, 0) in both cases, since principalAxes is not stated, and moments are
# along the body's axes then.
#
# Source: PixarAnimationStudios/OpenUSD, pxr/usd/usdPhysics/rigidBodyAPI.cpp, ComputeMassProperties
# (not read: inferred from what it returns).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet usd-core==26.11
"$folder/venv/bin/python" - <<'PYTHON'
from pxr import Gf, Usd, UsdGeom, UsdPhysics


def report(prim):
    """Return the mass information of a cube with an edge of 2."""
    information = UsdPhysics.RigidBodyAPI.MassInformation()
    information.volume = 8.0
    information.inertia = Gf.Matrix3f(8.0 * 4.0 / 6.0)
    information.centerOfMass = Gf.Vec3f(0.0)
    information.localPos = Gf.Vec3f(0.0)
    information.localRot = Gf.Quatf(1.0)
    return information


for has_centre in (False, True):
    stage = Usd.Stage.CreateInMemory()
    cube = UsdGeom.Cube.Define(stage, "/body").GetPrim()
    body = UsdPhysics.RigidBodyAPI.Apply(cube)
    UsdPhysics.CollisionAPI.Apply(cube)
    mass = UsdPhysics.MassAPI.Apply(cube)
    mass.CreateMassAttr(3.0)
    mass.CreateDiagonalInertiaAttr((1.0, 2.0, 3.0))
    if has_centre:
        mass.CreateCenterOfMassAttr((1.0, 0.0, 0.0))
    axes = body.ComputeMassProperties(report)[3]
    print("with a centre:" if has_centre else "without a centre:", axes)
PYTHON
