"""Writes a cabinet with a flap and any handle."""

from __future__ import annotations

from pathlib import Path

from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.object_file import load_object

BAR = (
    '<collision{}><origin xyz="-0.08 0.5 0" />'
    '<geometry><box size="0.02 0.02 0.3"/></geometry></collision>'
)
"""Upright bar, its back 70 mm in front of a flap that is hinged at y = 0."""


def write_flap(
    folder: Path,
    handle: str = "",
    *,
    thick: float = 0.02,
    before: str = "",
    behind: float = 0.03,
    attachments: str = "[]",
) -> ArticulatedObject:
    """Return a cabinet, 0.6 m wide and 0.8 m high, with a flap that opens towards -x.

    Args:
        folder: Output folder.
        handle: More URDF elements of the flap, whose frame is on the hinge at half height.
        thick: Thickness of the flap [m].
        before: More URDF elements of the case.
        behind: Gap between flap and case [m].
        attachments: Attachments of the description, as YAML.
    """
    middle = 0.2 + behind + thick / 2.0
    text = f"""<robot name="flap">
  <link name="case">
    <collision>
      <geometry><box size="0.4 0.6 0.8"/></geometry><origin xyz="{middle} 0.3 0.5"/>
    </collision>{before}
  </link>
  <link name="flap">
    <collision>
      <geometry><box size="{thick} 0.6 0.8"/></geometry><origin xyz="0 0.3 0"/>
    </collision>{handle}
  </link>
  <joint name="hinge" type="revolute">
    <parent link="case"/><child link="flap"/><origin xyz="0 0 0.5"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1.5" velocity="1" effort="1"/>
  </joint>
</robot>"""
    (folder / "flap.urdf").write_text(text)
    (folder / "flap.yaml").write_text(f"urdf: flap.urdf\nattachments: {attachments}\n")
    return load_object(folder / "flap.yaml")
