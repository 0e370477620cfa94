#!/bin/sh
# mujoco 4.0.0: a specification that has attached two bodies of one other writes XML that mujoco
# cannot read.
#
# Behaviour: `attach_body` of two bodies of the same specification, with the same prefix, compiles,
# and both bodies have their names. `to_xml` lists the default class "room/main" once for each body,
# and `MjModel.from_xml_string` refuses that text: "repeated default class name". With one body, or
# with different prefixes, it is read.
#
# One would guess: that a compiled specification can be saved and read again, and that classes of
# one specification are copied once.
#
# Source: google-deepmind/mujoco, src/user/user_objects.cc, where a frame or body is attached, and
# src/xml/xml_native_writer.cc, section "default". Pull request 3333, closed, describes it for one
# specification that is attached twice.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==4.0.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mujoco

ROOM = """<mujoco><worldbody>
<body name="table"><geom size="0.1"/></body>
<body name="shelf" pos="1 0 0"><geom size="0.1"/></body>
</worldbody></mujoco>"""


def save(prefixes):
    """Return whether what a specification with attached bodies writes can be read."""
    home = mujoco.MjSpec()
    room = mujoco.MjSpec.from_string(ROOM)
    frame = home.worldbody.add_frame()
    for body, prefix in zip(list(room.worldbody.bodies), prefixes):
        frame.attach_body(body, prefix, "")
    assert home.compile().nbody == 1 + len(prefixes)
    text = home.to_xml()
    count = text.count('class="room/main"')
    try:
        mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        return count, str(error).splitlines()[0]
    return count, "read"


one, two, apart = save(["room/"]), save(["room/", "room/"]), save(["room/", "other/"])
print(f"one body: {one}; two bodies: {two}; with different prefixes: {apart}")
found = one[1] == "read" and apart[1] == "read" and two[0] == 2 and "repeated" in two[1]
sys.exit(0 if found else 1)
PYTHON
