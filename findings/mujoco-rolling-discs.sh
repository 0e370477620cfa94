#!/bin/sh
# MuJoCo 3.12.0: two discs that rest on a level box roll away by themselves.
#
# Behaviour: a body of two cylinders (radius 50 mm, width 10 mm, 0.4 kg in all) is put at rest, with
# its axis level, 1 mm above a level box. It rolls on and on: after 6 s it has turned by 0.23 rad
# and moved by 11.5 mm, with elliptic friction cones, a time step of 2 ms and no force but gravity.
# With <option ccd_tolerance="1e-12"/> instead of the default, 1e-6, it turns by 0.1 mrad. The eight
# contacts that the general convex solver finds on the rims are not symmetric, and their normals are
# as inexact as the tolerance lets them be. MuJoCo 4.0.0 has four contacts and turns by 7 µrad with
# the default.
#
# One would guess: that it stays, up to micrometres, since the tolerance is one of distances [m].
#
# Source: google-deepmind/mujoco, src/engine/engine_collision_gjk.c and engine_collision_convex.c
# (contacts of cylinders and boxes); documentation, XML reference, option/ccd_tolerance.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==3.12.0
"$folder/venv/bin/python" - <<'PYTHON'
import math

import mujoco

MODEL = """<mujoco>
  <option timestep="0.002" cone="elliptic" impratio="10" integrator="implicitfast" {option}/>
  <worldbody>
    <geom type="box" size="0.5 0.5 0.02" pos="0 0 0.7"/>
    <body pos="0 0 0.771">
      <freejoint/>
      <geom type="cylinder" size="0.05 0.005" pos="0.15 0 0" euler="0 90 0" mass="0.1"/>
      <geom type="cylinder" size="0.05 0.005" pos="-0.15 0 0" euler="0 90 0" mass="0.1"/>
      <geom type="capsule" size="0.01" fromto="-0.4 0 0 0.4 0 0" mass="0.2"
        contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>"""


def turn(option: str) -> float:
    """Return the angle by which the body has turned after 6 s [rad]."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(option=option))
    data = mujoco.MjData(model)
    for _ in range(3000):
        mujoco.mj_step(model, data)
    w, *axis = data.qpos[3:]
    return 2.0 * math.atan2(math.hypot(*axis), abs(w))


default, fine = turn(""), turn('ccd_tolerance="1e-12"')
print(f"after 6 s: {default:.3f} rad with the default, {1e3 * fine:.2f} mrad with 1e-12")
assert default > 0.1, default
assert fine < 1e-3, fine
PYTHON
