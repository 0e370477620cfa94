#!/bin/sh
# Pinocchio 4.1.0: of SRDF states of one name it keeps the first and says that it keeps the last.
#
# Behaviour: of two <group_state> "home", of the groups "upper" and "whole",
# loadReferenceConfigurations keeps that of "upper": the joint that "whole" alone states stays at 0
# instead of 1. With verbose=True it prints "Only the last instance of home is being used", the
# opposite; by default it prints nothing. removeCollisionPairs ignores <disable_default_collisions>:
# all three pairs of the link are left, without a message.
#
# One would guess: the last instance, as the message says, or one state of each group; and no pairs
# of a link that is excluded by default, as in MoveIt, which defines the format.
#
# Source: stack-of-tasks/pinocchio, include/pinocchio/parsers/srdf.hxx (loadReferenceConfigurations
# inserts into a map by the name of the state; removeCollisionPairs reads "disable_collisions");
# moveit/srdfdom, src/model.cpp (loadGroupStates, loadCollisionDefaults).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pin==4.1.0
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import pathlib
import sys

import pinocchio as pin

folder = pathlib.Path(sys.argv[1])
shape = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
links = "".join(f'<link name="l{k}">{shape}</link>' for k in range(4))
joints = "".join(
    f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
    '<origin xyz="0 0 1"/><axis xyz="0 1 0"/>'
    '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
    for k in range(3)
)
urdf, srdf = folder / "r.urdf", folder / "r.srdf"
urdf.write_text(f'<robot name="r">{links}{joints}</robot>')
srdf.write_text("""<robot name="r">
<group name="whole"><chain base_link="l0" tip_link="l3"/></group>
<group name="upper"><chain base_link="l1" tip_link="l3"/></group>
<group_state name="home" group="upper">
  <joint name="j1" value="0.5"/><joint name="j2" value="0.6"/></group_state>
<group_state name="home" group="whole">
  <joint name="j0" value="1"/><joint name="j1" value="1.1"/><joint name="j2" value="1.2"/></group_state>
<disable_collisions link1="l0" link2="l2" reason="Never"/>
<disable_default_collisions link="l3"/></robot>""")
model = pin.buildModelFromUrdf(str(urdf))
shapes = pin.buildGeomFromUrdf(model, str(urdf), pin.GeometryType.COLLISION)
shapes.addAllCollisionPairs()
pin.removeCollisionPairs(model, shapes, str(srdf), True)
pin.loadReferenceConfigurations(model, str(srdf), True)
pairs = [(pair.first, pair.second) for pair in shapes.collisionPairs]
of_default = sum(3 in pair for pair in pairs)
home = model.referenceConfigurations["home"].tolist()
print("pairs of l3:", of_default, "expected: 0; home:", home, "expected: [1, 1.1, 1.2]")
sys.exit(0 if of_default == 3 and home == [0.0, 0.5, 0.6] and (0, 2) not in pairs else 1)
PYTHON
