#!/bin/sh
# coal 3.0.3: closed forms for overlapping spheres, capsules and cylinders are wrong where centres
# and axes meet.
#
# Behaviour: for a sphere whose centre is 1 mm below the end of a cylinder of radius 50 mm, and
# 10 mm off its axis, the signed distance is that to the lateral surface, -44 mm, along the radius;
# with the centre 1 mm above the end, it is -3 mm, along the axis. Two capsules whose axes cross
# have the right distance and a normal of zero. A capsule with half length 0 in place of the sphere,
# which coal hands to GJK and EPA, gets -5 mm.
#
# One would guess: the smallest translation that separates the shapes, as for a sphere in a box, and
# a distance that is continuous in the placement; a unit normal for every pair.
#
# Source: coal-library/coal, src/narrowphase/details.h, sphereCylinderDistance, and
# src/distance/capsule_capsule.cpp.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet coal==3.0.3 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import coal
import numpy as np


def measure(first, second, rotation, position):
    result = coal.DistanceResult()
    where = coal.Transform3s(np.asarray(rotation, float), np.asarray(position, float))
    coal.distance(first, coal.Transform3s(), second, where, coal.DistanceRequest(), result)
    return result.min_distance, result.normal


can, ball, pill = coal.Cylinder(0.05, 0.1), coal.Sphere(0.004), coal.Capsule(0.004, 1e-9)
above, _ = measure(can, ball, np.eye(3), [0.01, 0.0, 0.051])
below, sideways = measure(can, ball, np.eye(3), [0.01, 0.0, 0.049])
general, upwards = measure(can, pill, np.eye(3), [0.01, 0.0, 0.049])
rods, across = measure(
    coal.Capsule(0.05, 0.6), coal.Capsule(0.03, 0.4), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.zeros(3)
)
print(f"centre above the end: {above:.4f}, below it: {below:.4f} along {sideways}, expected -0.0050")
print(f"a capsule in place of the sphere: {general:.4f} along {upwards}")
print(f"capsules that cross: {rods:.4f}, normal {across}, expected a unit vector")
found = (
    abs(above + 0.003) < 1e-6
    and abs(below + 0.044) < 1e-6
    and abs(sideways[0]) > 0.99
    and abs(general + 0.005) < 1e-5
    and abs(upwards[2]) > 0.99
    and abs(rods + 0.08) < 1e-6
    and np.linalg.norm(across) < 1e-6
)
sys.exit(0 if found else 1)
PYTHON
