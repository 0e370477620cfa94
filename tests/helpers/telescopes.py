"""Writes a robot with a telescope: a lift, four coupled segments, a wrist and an open hand."""

from __future__ import annotations

import itertools
from pathlib import Path

from helpers.grippers import write_cheeks_scene
from vkc_pin.world.scene.scene import Scene

__all__ = [
    "FOLLOWERS",
    "SEGMENT",
    "format_joint",
    "format_link",
    "write_coupled_scene",
    "write_telescope",
    "write_telescope_scene",
]

SEGMENT = 0.15  # extension of each segment [m]
FOLLOWERS = {f"out_{k}": "out_1" for k in (2, 3, 4)}
_TOOL = (
    '<joint name="tool_joint" type="fixed">'
    '<origin xyz="0.13 0 0" rpy="1.5707963267948966 0 1.5707963267948966"/>'
    '<parent link="hand"/><child link="tool"/></joint>'
)


def format_link(name: str, size: str = "", at: str = "0 0 0") -> str:
    """Return a link, with a box if `size` is not empty."""
    shape = f'<origin xyz="{at}"/><geometry><box size="{size}"/></geometry>' if size else ""
    return f'<link name="{name}">{f"<collision>{shape}</collision>" if size else ""}</link>'


def format_joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    at: str = "0 0 0",
    axis: str = "0 0 1",
    limits: tuple[float, float] = (-2.0, 2.0),
    *,
    velocity: float = 0.5,
    inside: str = "",
) -> str:
    """Return a joint; `inside` holds further elements."""
    limit = "" if kind == "continuous" else f'lower="{limits[0]}" upper="{limits[1]}" '
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{at}"/>'
        f'<parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/><limit {limit}velocity="{velocity}" effort="10"/>{inside}</joint>'
    )


def write_telescope(
    folder: Path, *, couplings: str | None = None, mimics: str = "", more: str = ""
) -> Path:
    """Write the robot's URDF, SRDF and robot.yaml into a folder, and return the last.

    At 0 the arm is retracted, and the hand points along x of the base, 0.46 m up; the tool's z axis
    is along x, its x axis along y.

    Args:
        folder: Output folder.
        couplings: Couplings of robot.yaml. Default: the second to fourth segment follow the first.
        mimics: Mimic joints of the URDF: "first" (segments follow the first one), "chain" (each
            follows the previous one), or "" (none).
        more: Further lines of robot.yaml.
    """
    parts = [
        format_link("body", "0.44 0.4 0.3", "0 0 0.2"),
        format_link("mast", "0.06 0.06 1.3", "0 0 0.65"),
    ]
    parts.append(format_joint("mast_joint", "fixed", "body", "mast", "0 0 0.36"))
    parts += [
        format_link("carriage", "0.06 0.12 0.1"),
        format_joint("lift", "prismatic", "mast", "carriage", "0.08 0 0.1", "0 0 1", (0.0, 1.0)),
    ]
    below = "carriage"
    at = "0.05 0 0"
    for k in range(1, 5):
        width = 0.1 - 0.018 * k
        leader = {"first": "out_1", "chain": f"out_{k - 1}"}.get(mimics, "") if k > 1 else ""
        inside = f'<mimic joint="{leader}"/>' if leader else ""
        parts += [format_link(f"segment_{k}", f"0.2 {width} {width}", "0.1 0 0")]
        parts.append(
            format_joint(
                f"out_{k}",
                "prismatic",
                below,
                f"segment_{k}",
                at,
                "1 0 0",
                (0.0, SEGMENT),
                inside=inside,
            )
        )
        below = f"segment_{k}"
        at = "0.005 0 0"
    for name, axis, at in (
        ("yaw", "0 0 1", "0.24 0 0"),
        ("pitch", "0 1 0", "0.05 0 0"),
        ("roll", "1 0 0", "0.05 0 0"),
    ):
        parts += [
            format_link(name, "0.03 0.03 0.03", "0.02 0 0"),
            format_joint(f"{name}_joint", "revolute", below, name, at, axis, (-3.0, 3.0)),
        ]
        below = name
    parts += [
        format_link("hand", "0.03 0.12 0.03", "0.03 0 0"),
        format_joint("hand_joint", "fixed", below, "hand", "0.03 0 0"),
        format_link("tool"),
        _TOOL,
    ]
    for name, side in (("finger_a", 1), ("finger_b", -1)):
        parts += [format_link(name, "0.1 0.01 0.02", f"0.05 {side * 0.005} 0")]
        parts.append(format_joint(f"{name}_joint", "fixed", "hand", name, f"0.045 {side * 0.04} 0"))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.urdf").write_text(
        f'<robot name="robot">{"".join(parts)}</robot>', encoding="utf-8"
    )
    arm = ["carriage", *(f"segment_{k}" for k in range(1, 5))]
    hand = ["yaw", "pitch", "roll", "hand", "finger_a", "finger_b"]
    pairs = [
        *itertools.combinations(arm, 2),
        *itertools.combinations(hand, 2),
        ("body", "mast"),
        ("mast", "carriage"),
    ]
    pairs += [("mast", name) for name in arm] + list(itertools.product(arm[1:], ["yaw", "pitch"]))
    disabled = "".join(
        f'<disable_collisions link1="{one}" link2="{other}" reason="Adjacent"/>'
        for one, other in dict.fromkeys(pairs)
    )
    (folder / "robot.srdf").write_text(f'<robot name="robot">{disabled}</robot>', encoding="utf-8")
    text = (
        ", ".join(f"{joint}: {leader}" for joint, leader in FOLLOWERS.items())
        if couplings is None
        else couplings
    )
    lines = [
        "urdf: robot.urdf",
        "srdf: robot.srdf",
        "tool_frame: tool",
        "touch_links: [hand, finger_a, finger_b]",
    ]
    lines += [f"couplings: {{{text}}}"] if text else []
    (folder / "robot.yaml").write_text("\n".join(lines) + f"\n{more}", encoding="utf-8")
    return folder / "robot.yaml"


def write_telescope_scene(folder: Path, *, base: str = "omni") -> Scene:
    """Return a scene with the robot in front of a drawer within reach.

    Args:
        folder: Output folder of the robot.
        base: Kind of the base.
    """
    robot = write_telescope(folder, more="home: {out_1: 0.05, lift: 0.4}\n")
    document = write_cheeks_scene(robot, height=0.9, gap=0.1).document
    document |= {"robot": {"name": robot.name, "base": base}, "start": {"base": [0.1, 0.0, 0.0]}}
    return Scene.from_document(document, folder)


def write_coupled_scene(folder: Path, *, base: str = "omni", more: str = "") -> Scene:
    """Return a scene with a drawer and a robot with several kinds of coupled joints.

    Args:
        folder: Output folder of the robot.
        base: Kind of the base.
        more: Further lines of robot.yaml.
    """
    couplings = (
        "out_2: {joint: out_1, multiplier: 0.5}, "
        "out_3: {joint: out_1, multiplier: -0.5, offset: 0.15}, out_4: {joint: out_2}, "
        "pitch_joint: {joint: lift, multiplier: 1.5, offset: -0.6}, "
        "roll_joint: {joint: yaw_joint, multiplier: -3.0}"
    )
    robot = write_telescope(folder, couplings=couplings, more=more)
    document = write_cheeks_scene(robot, height=0.9, gap=0.1).document
    document["robot"] = {"name": robot.name, "base": base}
    return Scene.from_document(document, folder)
