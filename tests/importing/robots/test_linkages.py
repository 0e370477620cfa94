from __future__ import annotations

from pathlib import Path

import pytest

import vkc_pin as vkc
from vkc_pin.importing.robots.sources import read_source

mujoco = pytest.importorskip("mujoco")

# One side of a four-bar gripper: driver and spring link of equal length carry the finger upright.
SIDE = """<body name="{0}_driver" pos="0 {1}0.03 0.05" quat="{2}">
  <joint name="{0}_driver_turn" axis="1 0 0" range="{3}"/>
  <geom type="box" size="0.01 0.02 0.003" pos="0 0.02 0"/>
  <body name="{0}_coupler" pos="0 0.04 0">
    <joint name="{0}_coupler_turn" axis="1 0 0" range="-1.57 1.57"/>
    <geom type="box" size="0.01 0.003 0.01" pos="0 0 0.01"/>{4}</body></body>
<body name="{0}_link" pos="0 {1}0.03 0.08" quat="{2}">
  <joint name="{0}_link_turn" axis="1 0 0" range="-1.57 1.57"/>
  <geom type="box" size="0.01 0.02 0.003" pos="0 0.02 0"/>
  <body name="{0}_finger" pos="0 0.04 0">
    <joint name="{0}_finger_turn" axis="1 0 0" range="-1.57 1.57"/>
    <geom type="box" size="0.01 0.003 0.025" pos="0 0 0.025"/>{5}</body></body>"""
CONNECT = '<connect body1="{0}_finger" body2="{0}_coupler" anchor="0 0 -0.03"/>'
SITES = '<connect site1="{0}_one" site2="{0}_other"/>'
COUPLED = '<joint joint1="right_driver_turn" joint2="left_driver_turn"/>'


def write_linkage(
    folder: Path,
    travel: str = "0 1.2",
    connect: str = CONNECT,
    coupled: str = COUPLED,
    tail: str = "",
) -> Path:
    """Write an arm of five joints with a gripper that is open by 140 mm at joint position 0."""
    arm, end = "", ""
    for k, axis in enumerate(("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1")):
        arm += f'''<body name="arm_{k}" pos="0 0 {0.25 if k else 0.2}">
            <joint name="j{k}" axis="{axis}" range="-2 2"/>
            <geom type="box" size="0.03 0.03 0.08" pos="0 0 0.12"/>'''
        end += "</body>"
    palm = '<body name="palm" pos="0 0 0.2"><geom type="box" size="0.03 0.05 0.01" pos="0 0 0.03"/>'
    sites = ('<site name="{0}_other"/>', '<site name="{0}_one" pos="0 0 -0.03"/>')
    sides = "".join(
        SIDE.format(name, sign, turn, travel, *(site.format(name) for site in sites))
        for name, sign, turn in (("right", "", "1 0 0 0"), ("left", "-", "0 0 0 1"))
    )
    loops = "".join(connect.format(name) for name in ("right", "left"))
    (folder / "arm.xml").write_text(f"""<mujoco><compiler angle="radian"/><worldbody>
      <body name="base"><geom type="box" size="0.2 0.2 0.1" pos="0 0 0.1"/>
      {arm}{palm}{sides}</body>{end}</body></worldbody>
      <equality>{loops}{coupled}</equality>{tail}</mujoco>""")
    return folder / "arm.xml"


@pytest.mark.parametrize("connect", [CONNECT, SITES])
@pytest.mark.parametrize("coupled", [COUPLED, ""])
def test_linkages_stay_closed(tmp_path: Path, connect: str, coupled: str) -> None:
    """The linkage is a parallelogram: the finger stays upright at every driver angle."""
    converted = read_source(
        write_linkage(tmp_path, connect=connect, coupled=coupled),
        tmp_path,
        packages={},
        arguments={},
    )
    assert len(converted.linkages) == (1 if coupled else 2)
    angles = set()
    for linkage in converted.linkages:
        assert set(linkage[0].values()) == {0.0}
        for state in linkage:
            for side in {name.split("_")[0] for name in state}:
                driver = state[f"{side}_driver_turn"]
                assert state[f"{side}_link_turn"] == pytest.approx(driver, abs=1e-3)
                assert state[f"{side}_finger_turn"] == pytest.approx(-driver, abs=1e-3)
                angles.add(round(driver, 2))
    assert {0.0, 1.2} <= angles


def test_linkage_gripper_opens_with_its_loops_closed(tmp_path: Path) -> None:
    imported = vkc.importing.import_robot(write_linkage(tmp_path), tmp_path / "out", samples=50)
    gripper = imported.robot.gripper
    assert gripper is not None
    assert len(gripper.names) == 6  # all but the couplers, which only close the loops
    # Fingers are 3 mm thick to either side, on links of 40 mm at 30 mm from the middle.
    assert gripper.max_opening == pytest.approx(2 * (0.03 + 0.04 - 0.003), abs=1e-3)
    assert "between the fingers of a linkage" in str(imported)
    assert "to 134 mm" in str(imported)
    assert imported.diagnosis.healthy


@pytest.mark.parametrize("travel", ["0 0", "0 0.0001"])
def test_linkage_without_travel_keeps_the_pose_of_the_file(tmp_path: Path, travel: str) -> None:
    file = write_linkage(tmp_path, travel=travel)
    imported = vkc.importing.import_robot(file, tmp_path / "out", samples=50)
    assert imported.robot.gripper is None
    assert "the gripper does not move: its fingers stay 134 mm apart" in str(imported)
    assert imported.diagnosis.healthy
